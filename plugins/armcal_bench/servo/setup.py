"""What a servo calibration is about: the servos of a file, the arm that they move, and where it may go."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from armcal.arm.clearance import ClearanceCheck
from armcal.config.servo_file import ServoFile, load_servo_file
from armcal.config.validate import validate
from armcal.errors import ConfigError
from armcal.run.experiment import Experiment

from armcal_bench.acquisition.heat import HeatModel, Torques
from armcal_bench.acquisition.preparation import clearance_of, heat_of, run_limits
from armcal_bench.bench import SECTION, Bench
from armcal_bench.hazards import HazardJudge
from armcal_bench.servo.known import KnownBoard, KnownServo, MeasuredPulse
from armcal_bench.servo.nominal import NominalArm
from armcal_bench.servo.settings import ServoCalibrationSettings
from armcal_bench.wiring import servo_file_of

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
        nominal: what the model says.
        heat: of the servos, and the torques that heat them.
        check: what is too near, if that is stated.
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
    heat: tuple[HeatModel, Torques]
    check: ClearanceCheck | None
    judge: HazardJudge

    @classmethod
    def of(cls, experiment: Experiment) -> Setup:
        """Of an experiment's bench.

        Raises:
            ConfigError: the bench, its servo section or the servo file is refused, or the base pose is not clear.
        """
        bench = Bench.of(experiment)
        settings = ServoCalibrationSettings()
        if bench.settings.servo is not None:
            settings = validate(ServoCalibrationSettings, experiment.source, AT)
        path = settings.servos or _path_of_device(experiment, bench)
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
        joints = settings.joints or moved
        heat = heat_of(experiment, bench.settings.acquisition, arm)
        check = clearance_of(experiment, arm)
        rest = np.array([base.get(joint, 0.0) for joint in arm.commanded])
        judge = HazardJudge(tuple(arm.commanded), moved, np.array(list(limits.values())), heat[1], rest)
        setup = cls(bench, settings, path, file, joints, base, {}, nominal, heat, check, judge)
        setup._check_base_pulses(experiment)
        return replace(setup, ranges=setup.clear_ranges(experiment, limits))

    def known(self, joint: str) -> KnownServo:
        """A servo as the file states it."""
        servo = self.file.servos[joint]
        return KnownServo(joint, servo.board, servo.table, self.settings.trusted.get(joint), self.knots_of(joint))

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
        """The boards as the file states them, with the pulses measured at their pins."""
        return {name: KnownBoard(board.clock, self._measured(name)) for name, board in self.file.boards.items()}

    def _check_base_pulses(self, experiment: Experiment) -> None:
        """Before anything moves: half of the joints in the base pose would be worse than none."""
        for joint, angle in self.base.items():
            (low, high), pulse = self.pulses_of(joint), float(self.file.servos[joint].table.pulse(angle))
            if not low <= pulse <= high:
                raise ConfigError(
                    f"in the base pose {joint}, at {math.degrees(angle):.1f} deg, needs a pulse of {1e6 * pulse:.0f} "
                    f"us, expected {1e6 * low:.0f} to {1e6 * high:.0f} us.",
                    where=experiment.source.where((*AT, "base")),
                    hint="Choose another base pose, or widen bench.servo.pulses or the servo's pulse_range if the "
                    "servo bears it.",
                )

    def _measured(self, board: str) -> tuple[MeasuredPulse, ...]:
        stated = [measured_pulse for measured_pulse in self.settings.measured_pulses if measured_pulse.board == board]
        return tuple(MeasuredPulse(m.counts, 1e-6 * m.microseconds, 1e-6 * m.sd_microseconds) for m in stated)

    def clear_ranges(self, experiment: Experiment, limits: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
        """How far each joint may go from the base pose, within its limits and table and without coming too near."""
        check = self.check
        where = experiment.source.where((*AT, "base"))
        found = {}
        for joint in self.base:
            low, high = (float(limit) for limit in limits[joint])
            if not low <= self.base[joint] <= high:
                raise ConfigError(
                    f"{joint} stands at {math.degrees(self.base[joint]):.1f} deg in the base pose, expected "
                    f"{math.degrees(low):.1f} to {math.degrees(high):.1f} deg.",
                    where=where,
                    hint="Choose another base pose, or another range.",
                )
            found[joint] = (self._end(check, joint, low), self._end(check, joint, high))
        if check is not None and not check(self._pose({}).reshape(-1, 1)).allowed[0]:
            raise ConfigError(
                "the base pose is too near to something, by plan.clearance.", where=where, hint="Choose another."
            )
        return found

    def _end(self, check: ClearanceCheck | None, joint: str, limit: float) -> float:
        """The last angle before something comes too near, on the way from the base pose to a limit."""
        start = self.base[joint]
        count = math.ceil(abs(limit - start) / _LOOK_STEP) + 1
        way = np.linspace(start, limit, max(count, 2))
        if check is None:
            return limit
        allowed = check(np.array([self._pose({joint: angle}) for angle in way]).T).allowed
        blocked = np.flatnonzero(~allowed)
        return limit if not len(blocked) else float(way[max(blocked[0] - 1, 0)])

    def clear_between(self, start: Mapping[str, float], goal: Mapping[str, float]) -> bool:
        """Whether nothing comes too near on the straight way between two poses (rad by joint)."""
        if self.check is None:
            return True
        ends = np.array([self._pose(start), self._pose(goal)])
        count = math.ceil(float(np.abs(ends[1] - ends[0]).max()) / _LOOK_STEP) + 2
        way = ends[0][:, None] + np.linspace(0.0, 1.0, count) * (ends[1] - ends[0])[:, None]
        return bool(self.check(way).allowed.all())

    def _pose(self, other: Mapping[str, float]) -> Any:
        return np.array([{**self.base, **other}.get(joint, 0.0) for joint in self.bench.arm.commanded])


def _path_of_device(experiment: Experiment, bench: Bench) -> Path:
    servo_file = servo_file_of(bench)
    if servo_file is None:
        raise ConfigError(
            "found no servo file.",
            where=experiment.source.where((SECTION, "device")),
            hint="Name it in bench.device.servos, or in bench.servo.servos.",
        )
    return servo_file


def _check_names(
    experiment: Experiment, settings: ServoCalibrationSettings, file: ServoFile, moved: tuple[str, ...]
) -> None:
    for key in ("joints", "base", "ranges", "trusted"):
        if unknown := [joint for joint in getattr(settings, key) if joint not in moved]:
            raise ConfigError(
                f"no servo of the arm is called {unknown[0]!r}.",
                where=experiment.source.where((*AT, key)),
                hint=f"Servos of this arm are {', '.join(moved) or 'none'}; see the servo file.",
            )
    if not moved:
        raise ConfigError(
            "the servo file has no servo of a joint of this arm.",
            where=experiment.source.where((SECTION, "device")),
            hint=f"Name them as the joints: {', '.join(file.servos)} are not in the model.",
        )
    for index, measured in enumerate(settings.measured_pulses):
        if measured.board not in file.boards:
            raise ConfigError(
                f"no board is called {str(measured.board)!r}.",
                where=experiment.source.where((*AT, "measured_pulses", index)),
                hint=f"Boards are {', '.join(file.boards)}.",
            )
