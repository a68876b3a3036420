"""What a servo calibration is about: the servos of a file, the arm that they move, and where it may go."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, Self

import numpy as np
from armcal.arm.joints import unknown_joint
from armcal.arm.servo import PulseClock, PulseTable
from armcal.base.arrays import Array
from armcal.base.settings import Angle, Compliance, Duration, InputPath, Length, Settings, UnitOf
from armcal.config.servo_file import ServoFile, load_servo_file
from armcal.config.validate import validate
from armcal.devices.clock import Clock
from armcal.devices.device import (
    DeviceIdentity,
    DeviceRefusedError,
    DeviceState,
    JointDevice,
    open_device,
    state_of,
)
from armcal.devices.wiring import servo_file_of
from armcal.errors import ConfigError, DataError, InputError, Location
from armcal.io.journal import JOURNAL, Journal, KeptJournal, has_journal
from armcal.io.plain_files import writing
from armcal.run.experiment import Experiment
from pydantic import Field, model_validator
from scipy.interpolate import BSpline, make_interp_spline
from typing_extensions import override

from armcal_bench.bench import SECTION, AcquisitionSettings, ArrivalSettings, Bench
from armcal_bench.drive import PathPlanner
from armcal_bench.preparation import Prepared, clearance_of, of_poses, run_limits
from armcal_bench.run_log import LEFT_OUT as PASSED
from armcal_bench.run_log import MEASURED, Log, Progress
from armcal_bench.tracked_body import RigidArm

PositiveAngle = Annotated[Angle, Field(gt=0)]
PositiveDuration = Annotated[Duration, Field(gt=0)]
Angles = Annotated[tuple[float, ...], UnitOf("angle")]
PulseRange = Annotated[tuple[float, float], UnitOf("time")]


class ServoCalibrationSettings(Settings):
    """What ``armcal servo`` measures, and how. When the arm stands is as in ``acquisition.settle``."""

    servos: InputPath | None = None  # the servo file to improve; the device's own where it is not given
    joints: tuple[str, ...] = ()  # those to calibrate; all of the servo file
    knots: Angles = ()  # of all tables; without them each keeps its own, its ends as far as the joint is measured
    base: dict[str, Angle] = Field(default_factory=dict)  # where joints stand while another is measured; others at zero
    ranges: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)  # else the limits of the run
    step: PositiveAngle = math.radians(10)  # between the angles of a sweep, or of a guided calibration
    approach: PositiveAngle = math.radians(4)  # from how far a joint comes, so that its play is taken up
    pulses: PulseRange = (500e-6, 2600e-6)  # no other is ever set, nor one outside the servo's ``pulse_range``
    rate_deg_per_s: Annotated[float, Field(gt=0, le=60)] = 20.0
    period: PositiveDuration = 0.02  # between two steps of a motion
    zero: Literal["kept", "model"] = "kept"  # the pulse at zero stays, or angles are absolute by model and tracker
    sag: Literal["none", "model", "fitted"] = "fitted"  # which compliances give what the springs take out
    sag_sd: Annotated[Compliance, Field(gt=0)] = 0.2  # how far fitted ones may well be from the model's
    rotation_sd: PositiveAngle = math.radians(0.03)  # of a settled rotation about an axis
    least_radius: Length = 0.03  # of a circle that shows an angle, where a tracker sees positions only
    guided_sd: PositiveAngle = math.radians(0.5)  # how well a joint is put at an angle by eye
    check: PositiveAngle = math.radians(10)  # how far ``--check`` moves a joint
    silence: PositiveDuration = 1.0  # of the host, after which a board that can goes back to the base pose

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


@dataclass(frozen=True)
class KnownServo:
    joint: str  # that it turns
    board: str  # that drives it
    table: PulseTable  # as stated; pulses by the board's oscillator
    clock: PulseClock  # of the board
    knots: tuple[float, ...] = ()  # angles (rad) that the table is to be given at; empty: those of the stated one

    @property
    def angles(self) -> Array:
        return np.array(self.knots or self.table.angles)

    def pulses_at(self, angles: Array) -> Array:
        return np.asarray(piecewise(np.array(self.table.angles), np.array(self.table.pulses))(angles))


def piecewise(at: Array, values: Array) -> BSpline:
    """Linear between points (``at`` rises), and beyond the ends as before them."""
    return make_interp_spline(at, values, k=1)


AT = (SECTION, "servo")
_LOOK_STEP = math.radians(2.0)
ANYWHERE = ArrivalSettings.si(astray=100.0, astray_turned=2 * math.pi)


@dataclass(frozen=True)
class Setup:
    bench: Bench  # the configured one
    settings: ServoCalibrationSettings  # of the calibration
    path: Path  # of the servo file
    file: ServoFile  # what it states
    joints: tuple[str, ...]  # those to calibrate
    base: Mapping[str, float]  # where every servo's joint stands while others are measured (rad)
    ranges: Mapping[str, tuple[float, float]]  # over which each joint may be moved from there (rad)
    nominal: RigidArm  # the arm by its model
    planner: PathPlanner  # of straight ways on which nothing comes too near, if that is stated

    @classmethod
    def of(cls, experiment: Experiment) -> Self:
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
        for key in ("joints", "base", "ranges"):
            if fault := unknown_joint(getattr(settings, key), moved):
                where = experiment.source.where((*AT, key))
                raise ConfigError(f"{fault}.", where=where, hint="Name joints that have a servo in the servo file.")
        if not moved:
            text = "the servo file has no servo of a joint of this arm."
            hint = f"Name them as the joints: {', '.join(file.servos)} are not in the model."
            raise ConfigError(text, where=experiment.source.where((SECTION, "device")), hint=hint)
        stated = settings.base or bench.settings.acquisition.park
        base = {joint: stated.get(joint, 0.0) for joint in moved}
        limited = {**bench.settings.acquisition.limits, **settings.ranges}
        acquisition = bench.settings.acquisition.model_copy(update={"limits": limited})
        limits = dict(zip(arm.commanded, run_limits(experiment, acquisition, arm).tolist(), strict=True))
        ends, nominal = np.array(list(limits.values())), RigidArm(arm, experiment.parameters)
        planner = PathPlanner(clearance_of(experiment, arm), ends, np.zeros((0, len(limits))), _LOOK_STEP)
        setup = cls(bench, settings, path, file, settings.joints or moved, base, {}, nominal, planner)
        return replace(setup, ranges=setup._clear_ranges(experiment, limits))

    def known(self, joint: str) -> KnownServo:
        servo = self.file.servos[joint]
        return KnownServo(joint, servo.board, servo.table, self.file.boards[servo.board].clock, self.knots_of(joint))

    def knots_of(self, joint: str) -> tuple[float, ...]:
        """Angles (rad) that a table is to be given at: as configured, else its own; its ends reach over the range."""
        if self.settings.knots:
            return self.settings.knots
        stated, (low, high) = self.file.servos[joint].angles, self.ranges[joint]
        ends = min(stated[0], low), max(stated[-1], high)
        inner = stated[1:-1] or ((0.0,) if ends[0] < 0 < ends[1] else ())
        return (ends[0], *inner, ends[1])

    def pulses_of(self, joint: str) -> tuple[float, float]:
        borne, allowed = self.file.servos[joint].pulse_range, self.settings.pulses
        return max(borne[0], allowed[0]), min(borne[1], allowed[1])

    def _clear_ranges(
        self, experiment: Experiment, limits: Mapping[str, tuple[float, float]]
    ) -> dict[str, tuple[float, float]]:
        where = experiment.source.where((*AT, "base"))
        for joint, angle in self.base.items():
            (shortest, longest), pulse = self.pulses_of(joint), float(self.file.servos[joint].table.pulse(angle))
            if not shortest <= pulse <= longest:
                raise ConfigError(
                    f"in the base pose {joint}, at {math.degrees(angle):.1f} deg, needs a pulse of {1e6 * pulse:.0f} "
                    f"us, expected {1e6 * shortest:.0f} to {1e6 * longest:.0f} us.",
                    where=where,
                    hint="Choose another base pose; correct the servo's table, whose angles may lie a turn away; or "
                    "widen bench.servo.pulses or its pulse_range if the servo's data sheet allows it.",
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

    @property
    def acquisition(self) -> AcquisitionSettings:
        """Of the runs: an arm whose tables may be wrong is anywhere; it rests in the base pose."""
        own = self.settings
        changes: dict[str, Any] = {"rate_deg_per_s": own.rate_deg_per_s, "period": own.period, "silence": own.silence}
        changes |= {"park": dict(self.base), "at_end": "hold", "angles": "commanded", "arrival": ANYWHERE}
        return self.bench.settings.acquisition.model_copy(update=changes)

    def run(
        self,
        device: "PulsedJoints",
        poses: Mapping[str, Mapping[str, float]],
        sides: Mapping[str, Mapping[str, int]] = MappingProxyType({}),
    ) -> Prepared:
        """A run through poses by id: where joints are that are not in the base pose (rad), and from where they come."""
        joints = device.joint_names
        angles = np.array([[{**self.base, **pose}[joint] for joint in joints] for pose in poses.values()])
        approaches = np.array([[float(sides.get(name, {}).get(joint, 0)) for joint in joints] for name in poses])
        ends = np.array([self.ranges[joint] for joint in joints])
        standing = device.standing(self.base)
        park = np.array([standing[joint] for joint in joints])
        return of_poses(self.bench, self.acquisition, device, tuple(poses), angles, approaches, ends, park)

    def _pose(self, other: Mapping[str, float]) -> Array:
        return np.array([{**self.base, **other}.get(joint, 0.0) for joint in self.bench.arm.commanded])


class PulsedJoints(JointDevice):
    """Servos by the tables that a calibration was begun with, as far as pulses are allowed: a table's end is no end."""

    def __init__(self, setup: Setup, servos: Mapping[str, KnownServo] = MappingProxyType({})) -> None:
        self._setup, self._own = setup, {joint: setup.known(joint) for joint in setup.base}
        self._servos = servos or self._own
        self._device: Any = setup.bench.device()  # a JointDevice and, as ``open`` checks, a PulseDevice
        self._set: dict[str, int] = {}

    @property
    @override
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self._device.joint_names)

    @override
    def open(self, clock: Clock) -> DeviceIdentity:
        if not hasattr(self._device, "set_pulse"):
            raise DeviceRefusedError(
                "this device cannot set pulses by their length.", hint="Calibrate servos with a device like pca9685."
            )
        self._set = {}
        identity = open_device(self._device, clock)
        # A path home of another run must not be gone now.
        self._device.guard([], math.radians(self._setup.settings.rate_deg_per_s), self._setup.settings.silence)
        return identity

    @override
    def state(self) -> DeviceState:
        state = state_of(self._device)
        self._set = {joint: _counts(self._own[joint], angle) for joint, angle in state.angles.items()}
        return DeviceState({joint: self.angle(joint, n) for joint, n in self._set.items()}, state.took_over)

    @override
    def standing(self, angles: Mapping[str, float]) -> dict[str, float]:
        return {joint: self.angle(joint, self._allowed(joint, angle)) for joint, angle in angles.items()}

    @override
    def energise(self, joint: str, angle: float) -> None:
        self._set_counts(joint, self._allowed(joint, angle))

    @override
    def command(self, angles: Mapping[str, float]) -> None:
        for joint, angle in angles.items():
            if (counts := self._allowed(joint, angle)) != self._set.get(joint):
                self._set_counts(joint, counts)

    @override
    def keep_alive(self) -> None:
        self._device.keep_alive()

    @override
    def guard(self, waypoints: Sequence[Mapping[str, float]], rate: float, after_s: float) -> bool:
        """The device has the angles of its own tables, and goes no farther than these."""

        def own(joint: str, angle: float) -> float:
            table = self._own[joint].table
            same = float(table.angle(self.pulse(joint, self.counts(joint, angle))))
            return min(max(same, table.angles[0]), table.angles[-1])

        stated = [{joint: own(joint, angle) for joint, angle in waypoint.items()} for waypoint in waypoints]
        return bool(self._device.guard(stated, rate, after_s))

    @override
    def release(self, joint: str) -> None:
        self._set.pop(joint, None)
        self._device.release(joint)

    @override
    def close(self) -> None:
        self._device.close()

    def angle(self, joint: str, counts: int) -> float:
        return float(self._servos[joint].table.angle(self.pulse(joint, counts)))

    def pulse(self, joint: str, counts: int) -> float:
        return counts * self._servos[joint].clock.tick

    def counts(self, joint: str, angle: float) -> int:
        return _counts(self._servos[joint], angle)

    def turn_counts(self, joint: str, turn: float) -> int:
        """The counts of a turn (rad) where the table has least."""
        servo = self._servos[joint]
        return max(int(turn * servo.table.least_slope / servo.clock.tick) - 1, 1)

    def rises(self, joint: str) -> bool:
        pulses = self._servos[joint].table.pulses
        return pulses[0] < pulses[-1]

    def _allowed(self, joint: str, angle: float) -> int:
        counts, (low, high) = self.counts(joint, angle), self._setup.pulses_of(joint)
        if not low <= self.pulse(joint, counts) <= high:
            raise DeviceRefusedError(
                f"{joint}: found a pulse of {1e6 * self.pulse(joint, counts):.0f} us, expected {1e6 * low:.0f} to "
                f"{1e6 * high:.0f} us.",
                hint="Narrow bench.servo.ranges; or widen bench.servo.pulses, or its pulse_range by the data sheet.",
            )
        return counts

    def _set_counts(self, joint: str, counts: int) -> None:
        self._device.set_pulse(joint, self.pulse(joint, counts))
        self._set[joint] = counts


def _counts(servo: KnownServo, angle: float) -> int:
    return int(servo.clock.counts(servo.table.pulse(angle)))


BEGUN, POSE, ANGLE, LEFT_OUT = "begun", "pose", "angle", "left_out"  # Kinds of entries

_SAME = 1e-6


class Record:
    """The observations in a folder's journal; what is there is read at once, and written to when needed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / JOURNAL
        self._journal: Journal | None = None
        self._entries: list[Mapping[str, Any]] = []
        if has_journal(folder):
            with KeptJournal(folder) as journal:
                self._entries = [{"kind": entry.kind, **entry.content} for entry in journal.entries()]
        if self._entries and self._entries[0]["kind"] != BEGUN:
            text = "its first entry does not say by which tables it was begun."
            raise DataError(text, where=Location(str(self.path)), hint="Give another --out.")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ending: object) -> None:
        self._close()

    @property
    def entries(self) -> tuple[Mapping[str, Any], ...]:
        return tuple(self._entries)

    @property
    def begun(self) -> Mapping[str, Any] | None:
        return self._entries[0] if self._entries else None

    def set_aside(self) -> Path:
        self._opened()
        self._close()
        kept = next_name(self.path)
        with writing(self.path, "Give --out a writable folder."):
            self.path.rename(kept)
        self._entries = []
        return kept

    def append(self, kind: str, values: Mapping[str, Any]) -> None:
        self._opened().record(kind, dict(values))
        self._entries.append({"kind": kind, **values})

    def _opened(self) -> Journal:
        if self._journal is None:
            self._journal = Journal(self.folder, {})
        return self._journal

    def _close(self) -> None:
        if self._journal is not None:
            self._journal.close()
        self._journal = None


class SweepLog(Log):
    """Of a run whose poses are those of sweeps: what was observed goes to the record, and no more.

    A pose is called by its joint, counts and side: ``q3 307 +``. What an earlier run left out is tried once more.
    """

    def __init__(self, record: Record) -> None:
        self._record, entries = record, record.entries
        measured = {pose_name(e["joint"], e["counts"], e["came"]): e for e in entries if e["kind"] == POSE}
        warm = next((entry for entry in reversed(entries) if entry.get("warmth")), None)
        self.progress = Progress(measured)
        if warm is not None:
            self.progress = Progress(measured, thermal_state=warm["warmth"], at=float(warm["at"]))

    @override
    def record(self, kind: str, content: Mapping[str, Any]) -> None:
        self.progress = self.progress.after(kind, content)
        if kind not in (MEASURED, PASSED):
            return
        joint, counts, side = str(content["pose"]).rsplit(" ", 2)
        line: dict[str, Any] = {"joint": joint, "counts": int(counts), "came": 1 if side == "+" else -1}
        if kind == PASSED:
            self._record.append(LEFT_OUT, {**line, "at": self.progress.at, "why": content["why"]})
            return
        deviations = [float(d) if np.isfinite(d) else None for d in content["deviation"]] + content["turn_deviation"]
        line |= {"at": content["at"], "warmth": content["warmth"], "told": content["standing"]}
        line |= {key: content[key] for key in ("position", "rotation", "frames")}
        self._record.append(POSE, {**line, "deviations": deviations})


def pose_name(joint: str, counts: int, came: int) -> str:
    return f"{joint} {counts} {'+' if came > 0 else '-'}"


def next_name(path: Path) -> Path:
    """The first of ``NAME.before-1``, ``NAME.before-2``, ... that is free, for a file that is to be kept."""
    number = 1
    while (kept := path.with_name(f"{path.name}.before-{number}")).exists():
        number += 1
    return kept


def begin(setup: Setup, record: Record, device: DeviceIdentity) -> None:
    """The first entry of a record; it is written when nothing is left that could refuse the run."""
    if record.begun is None:
        servos = {joint: _as_stated(setup, joint) for joint in setup.base}
        content = {"servos": servos, "device": device.name, "adapter": device.adapter, "base": dict(setup.base)}
        record.append(BEGUN, content)


def check_same(setup: Setup, record: Record, device: DeviceIdentity) -> None:
    begun = record.begun
    if begun is None:
        return
    where = Location(str(record.path))
    adapter = str(begun.get("adapter", ""))
    if adapter and device.adapter and adapter != device.adapter:
        text = f"it was begun with the adapter {adapter!r}, found {device.adapter!r}."
        raise InputError(text, where=where, hint="Connect the one that it was begun with, or give a new --out.")
    moved = [joint for joint, angle in setup.base.items() if abs(begun["base"].get(joint, angle) - angle) > _SAME]
    if moved:
        raise InputError(
            f"it was begun with another base pose: {moved[0]} stood at {_deg(begun['base'][moved[0]])}, not at "
            f"{_deg(setup.base[moved[0]])}.",
            where=where,
            hint="Give the base pose that it was begun with, or a new --out.",
        )
    for joint in setup.base:
        stated, before = _as_stated(setup, joint), begun["servos"].get(joint, {})
        if any(stated[key] != before.get(key) for key in ("board", "channel", "oscillator_hz", "prescale")):
            text = f"it was begun with another board, channel or oscillator of {joint}."
            raise InputError(text, where=where, hint="Give a new --out.")


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.1f} deg"


def _as_stated(setup: Setup, joint: str) -> dict[str, Any]:
    servo = setup.file.servos[joint]
    clock = setup.file.boards[servo.board].clock
    return {
        "board": str(servo.board),
        "channel": servo.channel,
        "oscillator_hz": clock.oscillator_hz,
        "prescale": clock.prescale,
        "angles": list(servo.angles),
        "pulses": list(servo.pulses),
    }


def stated_by(setup: Setup, begun: Mapping[str, Any]) -> dict[str, KnownServo]:
    """All servos, as they were when a record was begun."""
    servos = {joint: setup.known(joint) for joint in setup.base}
    for joint, stated in begun["servos"].items():
        if joint in servos:
            table = PulseTable(tuple(stated["angles"]), tuple(stated["pulses"]))
            clock = PulseClock(stated["oscillator_hz"], stated["prescale"])
            servos[joint] = replace(servos[joint], table=table, clock=clock)
    return servos
