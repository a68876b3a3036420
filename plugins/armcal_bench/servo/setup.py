"""What a servo calibration is about: the servos of a file, the arm that they move, and where it may go."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Self

import numpy as np
from armcal.arm.joints import unknown_joint
from armcal.arm.servo import PulseClock, PulseTable
from armcal.base.arrays import Array
from armcal.config.servo_file import ServoFile, load_servo_file
from armcal.config.validate import validate
from armcal.devices.wiring import servo_file_of
from armcal.errors import ConfigError
from armcal.run.experiment import Experiment

from armcal_bench.acquisition.heat import HeatModel
from armcal_bench.acquisition.path_planner import PathPlanner
from armcal_bench.acquisition.preparation import clearance_of, heat_of, run_limits
from armcal_bench.bench import SECTION, Bench
from armcal_bench.hazards import HazardJudge
from armcal_bench.servo.nominal import NominalArm
from armcal_bench.servo.problem import KnownBoard, KnownServo, MeasuredPulse
from armcal_bench.servo.settings import ServoCalibrationSettings

AT = (SECTION, "servo")
_LOOK_STEP = math.radians(2.0)


@dataclass(frozen=True)
class Setup:
    """All that is known before anything moves.

    Attributes:
        bench: the configured one.
        settings: of the calibration.
        path: of the servo file.
        file: what it states.
        joints: those to calibrate.
        base: where every servo's joint stands while others are measured (rad).
        ranges: over which each joint may be moved from there (rad).
        nominal: the arm by its model.
        heat: of the servos.
        planner: of straight ways on which nothing comes too near, if that is stated.
        judge: of what is dangerous in the first motions.
    """

    bench: Bench
    settings: ServoCalibrationSettings
    path: Path
    file: ServoFile
    joints: tuple[str, ...]
    base: Mapping[str, float]
    ranges: Mapping[str, tuple[float, float]]
    nominal: NominalArm
    heat: HeatModel
    planner: PathPlanner
    judge: HazardJudge

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
        nominal = NominalArm.of(arm, experiment.parameters, experiment.system.environment)
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
