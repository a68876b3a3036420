"""What a servo calibration is about: the servos of a file, the arm that they move, and where it may go."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise, permutations, takewhile
from pathlib import Path
from typing import Annotated, Literal, Protocol, Self, TypeVar

import numpy as np
from armcal.arm.joints import unknown_joint
from armcal.arm.servo import PulseClock, PulseTable
from armcal.base.arrays import Array
from armcal.base.settings import Angle, Compliance, Duration, InputPath, Length, Settings, UnitOf
from armcal.config.servo_file import ServoFile, load_servo_file
from armcal.config.validate import validate
from armcal.devices.device import (
    DeviceError,
    DeviceIdentity,
    DeviceRefusedError,
    JointDevice,
    PulseDevice,
    open_device,
    state_of,
)
from armcal.devices.wiring import servo_file_of
from armcal.errors import ConfigError, InputError
from armcal.run.experiment import Experiment
from pydantic import Field, model_validator

from armcal_bench.acquisition.drive import Motion, PathPlanner
from armcal_bench.acquisition.heat import HeatModel, ThermalState
from armcal_bench.acquisition.preparation import clearance_of, heat_of, run_limits
from armcal_bench.acquisition.recovery import Recovery
from armcal_bench.acquisition.tracker_monitor import MotionGate
from armcal_bench.bench import SECTION, Bench
from armcal_bench.hazards import HazardJudge
from armcal_bench.servo.rigid_arm import RigidArm
from armcal_bench.servo.tables import KnownBoard, KnownServo, MeasuredPulse

PositiveAngle = Annotated[Angle, Field(gt=0)]
PositiveDuration = Annotated[Duration, Field(gt=0)]
Angles = Annotated[tuple[float, ...], UnitOf("angle")]
PulseRange = Annotated[tuple[float, float], UnitOf("time")]


class MeasuredPulseSettings(Settings):
    """A pulse measured at a pin of a board, by an oscilloscope for example."""

    board: str
    counts: Annotated[int, Field(ge=1, le=4095)]
    microseconds: Annotated[float, Field(gt=0)]
    sd_microseconds: Annotated[float, Field(gt=0)] = 0.1


class ServoCalibrationSettings(Settings):
    """What ``armcal servo`` measures, and how. When the arm stands is as in ``acquisition.settle``.

    Attributes:
        knots: the angles that all tables are to be given at; without them each table keeps its own, and its ends reach
            as far as the joint is measured.
        base: where the other joints stand while one is measured; joints that are not named stand at zero.
        ranges: over which joints are moved; the limits of ``acquisition`` or ``plan`` where none are given here.
        approach: how far a joint comes from below or above before it is measured, so that its play is taken up.
        pulses: no pulse outside this range is ever set, nor one outside the servo's own ``pulse_range``.
        rate_deg_per_s: the fastest that a joint is moved, by its stated table.
        zero: ``kept``: each servo's pulse at zero stays; ``model``: angles are absolute, by the model and the tracker.
        sag: what springs give is taken from the model's compliances, fitted with the tables, or not reckoned with.
        sag_sd: how far compliances may well be from the model's, where they are fitted.
        measured_pulses: pulses measured at boards' pins: they determine the oscillators.
        trusted: joints whose stated tables are believed, by how well: they determine the oscillators too.
        silence: after this silence of the host a board that can brings the arm back to the base pose.
    """

    servos: InputPath | None = None  # the servo file to improve; the device's own where it is not given
    joints: tuple[str, ...] = ()  # those to calibrate; all of the servo file
    knots: Angles = ()
    base: dict[str, Angle] = Field(default_factory=dict)
    ranges: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)
    step: PositiveAngle = math.radians(10)  # between the angles of a sweep, or of a guided calibration
    approach: PositiveAngle = math.radians(4)
    pulses: PulseRange = (500e-6, 2600e-6)
    rate_deg_per_s: Annotated[float, Field(gt=0, le=60)] = 20.0
    period: PositiveDuration = 0.02  # between two steps of a motion
    zero: Literal["kept", "model"] = "kept"
    sag: Literal["none", "model", "fitted"] = "fitted"
    sag_sd: Annotated[Compliance, Field(gt=0)] = 0.2
    rotation_sd: PositiveAngle = math.radians(0.03)  # of a settled rotation about an axis
    least_radius: Length = 0.03  # of a circle that shows an angle, where a tracker sees positions only
    guided_sd: PositiveAngle = math.radians(0.5)  # how well a joint is put at an angle by eye
    measured_pulses: tuple[MeasuredPulseSettings, ...] = ()
    trusted: dict[str, PositiveDuration] = Field(default_factory=dict)
    check: PositiveAngle = math.radians(10)  # how far ``--check`` moves a joint
    silence: PositiveDuration = 1.0

    @model_validator(mode="after")
    def _usable(self) -> Self:
        if len(self.knots) == 1 or not all(a < b for a, b in pairwise(self.knots)):
            raise ValueError("the knots do not rise, or are fewer than two")
        if not 0 < self.pulses[0] < self.pulses[1]:
            raise ValueError("the range of pulses does not rise from above zero: give [shortest, longest]")
        for joint, (low, high) in self.ranges.items():
            if not low < high:
                raise ValueError(f"the range of {joint} does not rise: give [lowest, highest]")
        return self


AT = (SECTION, "servo")
_LOOK_STEP = math.radians(2.0)


@dataclass(frozen=True)
class Setup:
    """All that is known before anything moves."""

    bench: Bench  # the configured one
    settings: ServoCalibrationSettings  # of the calibration
    path: Path  # of the servo file
    file: ServoFile  # what it states
    joints: tuple[str, ...]  # those to calibrate
    base: Mapping[str, float]  # where every servo's joint stands while others are measured (rad)
    ranges: Mapping[str, tuple[float, float]]  # over which each joint may be moved from there (rad)
    nominal: RigidArm  # the arm by its model
    heat: HeatModel  # of the servos
    planner: PathPlanner  # of straight ways on which nothing comes too near, if that is stated
    judge: HazardJudge  # of what is dangerous in the first motions

    @classmethod
    def of(cls, experiment: Experiment) -> Self:
        """Of an experiment's bench.

        Raises:
            ConfigError: the bench, its servo section or the servo file is refused, or the base pose is not clear.
        """
        bench = Bench.of(experiment)
        settings = ServoCalibrationSettings()
        if bench.settings.servo is not None:
            settings = validate(ServoCalibrationSettings, experiment.source, AT)
        path = settings.servos or servo_file_of(experiment.source)
        if path is None:
            raise ConfigError(
                "found no servo file.",
                where=experiment.source.where((SECTION, "device")),
                hint="Name it in bench.device.servos, or in bench.servo.servos. Servos on a serial bus have no pulses: "
                "armcal bus sets their zeros.",
            )
        file = load_servo_file(path)
        arm = bench.arm
        moved = tuple(joint for joint in arm.commanded if joint in file.servos)
        _check_names(experiment, settings, file, moved)
        stated = settings.base or bench.settings.acquisition.park
        base = {joint: stated.get(joint, 0.0) for joint in moved}
        limited = {**bench.settings.acquisition.limits, **settings.ranges}
        acquisition = bench.settings.acquisition.model_copy(update={"limits": limited})
        limits = dict(zip(arm.commanded, run_limits(experiment, acquisition, arm).tolist(), strict=True))
        nominal = RigidArm(arm, experiment.parameters)
        heat = heat_of(experiment, bench.settings.acquisition, arm)
        ends = np.array(list(limits.values()))
        planner = PathPlanner(clearance_of(experiment, arm), ends, np.zeros((0, len(limits))), _LOOK_STEP)
        rest = np.array([base.get(joint, 0.0) for joint in arm.commanded])
        judge = HazardJudge(tuple(arm.commanded), moved, ends, heat.torques, rest)
        setup = cls(bench, settings, path, file, settings.joints or moved, base, {}, nominal, heat, planner, judge)
        return replace(setup, ranges=setup._clear_ranges(experiment, limits))

    def known(self, joint: str) -> KnownServo:
        servo = self.file.servos[joint]
        return KnownServo(joint, servo.board, servo.table, self.settings.trusted.get(joint), self.knots_of(joint))

    def table_of(self, joint: str) -> tuple[PulseTable, PulseClock]:
        servo = self.file.servos[joint]
        return servo.table, self.file.boards[servo.board].clock

    def knots_of(self, joint: str) -> tuple[float, ...]:
        """Angles (rad) that a table is to be given at: as configured, else its own; its ends reach over the range.

        So the table of a servo that turns farther than the others is not cut to theirs.
        """
        if self.settings.knots:
            return self.settings.knots
        stated, (low, high) = self.file.servos[joint].angles, self.ranges[joint]
        ends = min(stated[0], low), max(stated[-1], high)
        inner = stated[1:-1] or ((0.0,) if ends[0] < 0 < ends[1] else ())
        return (ends[0], *inner, ends[1])

    def pulses_of(self, joint: str) -> tuple[float, float]:
        """The shortest and the longest pulse (s) that may be set: what the servo bears, and what is configured."""
        borne, allowed = self.file.servos[joint].pulse_range, self.settings.pulses
        return max(borne[0], allowed[0]), min(borne[1], allowed[1])

    def boards(self) -> dict[str, KnownBoard]:
        measured: dict[str, tuple[MeasuredPulse, ...]] = {}
        for pulse in self.settings.measured_pulses:
            known = MeasuredPulse(pulse.counts, 1e-6 * pulse.microseconds, 1e-6 * pulse.sd_microseconds)
            measured[pulse.board] = (*measured.get(pulse.board, ()), known)
        return {name: KnownBoard(board.clock, measured.get(name, ())) for name, board in self.file.boards.items()}

    def _clear_ranges(
        self, experiment: Experiment, limits: Mapping[str, tuple[float, float]]
    ) -> dict[str, tuple[float, float]]:
        """How far each joint may go from the base pose, within its limits and table and without coming too near.

        Raises:
            ConfigError: the base pose is not allowed; half of the joints in it would be worse than none.
        """
        where = experiment.source.where((*AT, "base"))
        for joint, angle in self.base.items():
            (shortest, longest), pulse = self.pulses_of(joint), float(self.file.servos[joint].table.pulse(angle))
            if not shortest <= pulse <= longest:
                raise ConfigError(
                    f"in the base pose {joint}, at {math.degrees(angle):.1f} deg, needs a pulse of {1e6 * pulse:.0f} "
                    f"us, expected {1e6 * shortest:.0f} to {1e6 * longest:.0f} us.",
                    where=where,
                    hint="Choose another base pose, or widen bench.servo.pulses or the servo's pulse_range if the "
                    "servo bears it.",
                )
            low, high = limits[joint]
            if not low <= angle <= high:
                raise ConfigError(
                    f"{joint} stands at {math.degrees(angle):.1f} deg in the base pose, expected "
                    f"{math.degrees(low):.1f} to {math.degrees(high):.1f} deg.",
                    where=where,
                    hint="Choose another base pose, or another range.",
                )
        if not self.planner.allowed(self._pose({})):
            text = "the base pose is too near to something, by plan.clearance."
            raise ConfigError(text, where=where, hint="Choose another.")
        return {joint: (self._end(joint, limits[joint][0]), self._end(joint, limits[joint][1])) for joint in self.base}

    def _end(self, joint: str, limit: float) -> float:
        if self.planner.clear(self._pose({}), self._pose({joint: limit})):
            return limit
        start = self.base[joint]
        way = np.linspace(start, limit, math.ceil(abs(limit - start) / _LOOK_STEP) + 1)
        allowed = takewhile(lambda angle: self.planner.allowed(self._pose({joint: float(angle)})), way)
        return float(list(allowed)[-1])

    def clear_between(self, start: Mapping[str, float], goal: Mapping[str, float]) -> bool:
        """Whether nothing comes too near on the straight way between two poses (rad by joint)."""
        return self.planner.clear(self._pose(start), self._pose(goal))

    def _pose(self, other: Mapping[str, float]) -> Array:
        return np.array([{**self.base, **other}.get(joint, 0.0) for joint in self.bench.arm.commanded])


def _check_names(
    experiment: Experiment, settings: ServoCalibrationSettings, file: ServoFile, moved: tuple[str, ...]
) -> None:
    for key in ("joints", "base", "ranges", "trusted"):
        if fault := unknown_joint(getattr(settings, key), moved):
            where = experiment.source.where((*AT, key))
            raise ConfigError(f"{fault}.", where=where, hint="Name joints that have a servo in the servo file.")
    if not moved:
        text = "the servo file has no servo of a joint of this arm."
        hint = f"Name them as the joints: {', '.join(file.servos)} are not in the model."
        raise ConfigError(text, where=experiment.source.where((SECTION, "device")), hint=hint)
    for index, measured in enumerate(settings.measured_pulses):
        if measured.board not in file.boards:
            text = f"no board is called {str(measured.board)!r}."
            hint = f"Boards are {', '.join(file.boards)}."
            raise ConfigError(text, where=experiment.source.where((*AT, "measured_pulses", index)), hint=hint)


T = TypeVar("T")
_BETWEEN_JOINTS_S = 0.5
_LONGEST_LOSS_S = 30.0


class ServoDevice(JointDevice, PulseDevice, Protocol):
    """What a servo calibration needs: joints moved by pulses."""


class Mover(Motion):
    """Moves servos; ``counts`` holds each one's as they were set, and ``came`` the sign of its last step.

    Args:
        setup: how fast and how far servos may be moved, and the tables by which the device reports its angles.
        device: opened by ``open``.
        servos: tables and their boards' clocks by joint: what angles are turned into pulses by.
        gate: asked in every step.
    """

    device: ServoDevice

    def __init__(
        self, setup: Setup, device: ServoDevice, servos: Mapping[str, tuple[PulseTable, PulseClock]], gate: MotionGate
    ) -> None:
        thermal_state = ThermalState(setup.heat, tuple(setup.bench.arm.commanded), setup.base, gate.clock)
        super().__init__(device, gate.clock, tuple(setup.base), setup.settings.period, thermal_state)
        self.setup, self.servos, self.gate = setup, servos, gate
        self.counts: dict[str, int] = {}
        self.came: dict[str, int] = {}
        self._guarded: Mapping[str, float] = {}
        self._rate = math.radians(setup.settings.rate_deg_per_s)  # the fastest, by the stated tables (rad/s)

    def open(self) -> DeviceIdentity:
        """Open the device and learn which pulses it makes; nothing moves.

        Raises:
            DeviceRefusedError: it cannot set pulses, or is not the right one.
        """
        if not hasattr(self.device, "set_pulse"):
            raise DeviceRefusedError(
                "this device cannot set pulses by their length.", hint="Calibrate servos with a device like pca9685."
            )
        identity = open_device(self.device, self.clock)
        self._recovery = Recovery(self.device, identity, self.gate, _LONGEST_LOSS_S)
        # A path home of another run must not be gone now.
        self.device.guard([], self._rate, self.setup.settings.silence)
        self.counts |= self._running()
        return identity

    @property
    def angles(self) -> dict[str, float]:
        """The angles that the pulses ask for by the stated tables (rad, by joint)."""
        angles = {j: float(self.servos[j][0].angle(self.pulse(j, counts))) for j, counts in self.counts.items()}
        return {joint: angle for joint, angle in angles.items() if math.isfinite(angle)}

    def counts_at(self, joint: str, angle: float) -> int:
        """The counts that the stated table gives for an angle (rad)."""
        return _counts(*self.servos[joint], angle)

    def pulse(self, joint: str, counts: int) -> float:
        return counts * self.servos[joint][1].tick

    def _counts_per_rad(self, joint: str) -> float:
        """By the stated table, where it is least."""
        table, clock = self.servos[joint]
        return table.least_slope / clock.tick

    def approach_counts(self, joint: str) -> int:
        return max(int(self.setup.settings.approach * self._counts_per_rad(joint)) - 1, 1)

    def energise(self, joint: str, counts: int) -> None:
        """A joint's first pulse; nothing if it gets pulses already."""
        if joint not in self.counts:
            self._set(joint, counts)
            self.stand(_BETWEEN_JOINTS_S, self.gate.resting)

    def go(self, joint: str, counts: int) -> None:
        """Move a joint to a pulse, no faster than allowed.

        Raises:
            InputError: the pulse is outside the range that is allowed.
            StopRequested: on the way; the joint holds.
        """
        self.check(joint, counts)
        at, step = float(self.counts[joint]), self._rate * self._counts_per_rad(joint) * self.period
        if counts != self.counts[joint]:
            self.came[joint] = 1 if counts > at else -1
        while self.counts[joint] != counts:
            self.tick(self.gate.resting)
            at += math.copysign(min(step, abs(counts - at)), counts - at)
            if (near := math.floor(at + 0.5)) != self.counts[joint]:
                self._set(joint, near)

    def come_to(self, joint: str, counts: int, came: int) -> None:
        """Move a joint to a pulse with rising pulses (1) or falling ones (-1), with its play taken up; see ``go``."""
        aside = counts - came * self.approach_counts(joint)
        if came * (aside - self.counts[joint]) < 0 or self.came.get(joint) != came:
            self.go(joint, aside)
        self.go(joint, counts)

    def check(self, joint: str, counts: int) -> None:
        """Whether a pulse is allowed.

        Raises:
            InputError: it is not.
        """
        low, high = self.setup.pulses_of(joint)
        if not low <= self.pulse(joint, counts) <= high:
            raise InputError(
                f"{joint}: found a pulse of {1e6 * self.pulse(joint, counts):.0f} us, expected {1e6 * low:.0f} to "
                f"{1e6 * high:.0f} us.",
                hint="Narrow bench.servo.ranges; or widen bench.servo.pulses or its pulse_range if the servo bears it.",
            )

    def to_base(self) -> None:
        """Every servo to the base pose, one by one; those without pulses get their first.

        Raises:
            DeviceRefusedError: no order of the joints keeps clear on the way from where the arm stands.
        """
        setup = self.setup
        goals = {joint: self.counts_at(joint, angle) for joint, angle in setup.base.items()}
        for joint, counts in goals.items():
            self.energise(joint, counts)
        start = self.angles
        away = [joint for joint, counts in goals.items() if self.counts[joint] != counts]
        for order in permutations(away):
            arrived = [{**start, **{joint: setup.base[joint] for joint in order[:n]}} for n in range(len(order) + 1)]
            if all(setup.clear_between(here, there) for here, there in pairwise(arrived)):
                for joint in order:
                    self.go(joint, goals[joint])
                return
        hint = "Bring it nearer by armcal servo --guided, or release it and put it there by hand."
        raise DeviceRefusedError("no way to the base pose is clear from where the arm stands.", hint=hint)

    def guard(self, base: Mapping[str, float]) -> bool:
        """What the board is to do when the host falls silent: back to a pose (rad by joint), slowly."""
        self._guarded = dict(base)
        return self.device.guard([base] if base else [], self._rate, self.setup.settings.silence)

    def hold(self) -> bool:
        """The board is to stay where it is when the host falls silent. False: the board is lost."""
        try:
            self.guard({})
        except DeviceError:
            return False
        return True

    def persist(self, action: Callable[[], T]) -> T:
        """Do it; when the device fails, open it again, let every joint have the pulse that it had, and do it again.

        Raises:
            DeviceLost: it does not come back.
        """
        return self._recovery.persist(action, self._restore)

    def _restore(self) -> None:
        # No way home is known while joints hang free.
        self.device.guard([], self._rate, self.setup.settings.silence)
        before, running = dict(self.counts), self._running()
        self.counts |= running
        self.came.clear()
        for joint in before:
            if joint not in running:
                self._set(joint, before[joint])
                self.stand(_BETWEEN_JOINTS_S, self.gate.resting)
        if self._guarded:
            self.guard(self._guarded)

    def _running(self) -> dict[str, int]:
        angles = state_of(self.device).angles
        moved = {joint: angle for joint, angle in angles.items() if joint in self.setup.base}
        return {joint: _counts(*self.setup.table_of(joint), angle) for joint, angle in moved.items()}

    def _set(self, joint: str, counts: int) -> None:
        self.check(joint, counts)
        self.device.set_pulse(joint, self.pulse(joint, counts))
        self.counts[joint] = counts


def _counts(table: PulseTable, clock: PulseClock, angle: float) -> int:
    return int(clock.counts(table.pulse(angle)))
