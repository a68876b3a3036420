"""Tip errors over a mission: the frozen and the recalibrated calibration against the truth at each moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from armcal.arm.assembly import ArmState
from armcal.arm.environment import unstated_payload
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.se3 import Expression
from armcal.config.system import System
from armcal.errors import ConfigError, NotConvergedError
from armcal.estimate.simulation import Mission, with_channels
from armcal.functions.batch_function import EvaluatorChoice
from armcal.measure.contact import Contact
from armcal.measure.measurement import Measurement
from armcal.problem.factor_records import FactorRecords
from armcal.problem.problem import Problem

from armcal_online.mission.judge import ErrorCurve
from armcal_online.mission.log import MissionLog, newest
from armcal_online.mission.references import Series
from armcal_online.mission.settings import MissionRunSettings

_HOUR_S = 3600.0
_PAYLOAD = ("payload", "payload_x", "payload_y", "payload_z")


def error_curve(
    system: System,
    parameters: Parameters,
    mission: Mission,
    log: MissionLog,
    settings: MissionRunSettings,
    evaluator: EvaluatorChoice = "auto",
    references: Mapping[str, Series] | None = None,
) -> ErrorCurve:
    """Mean distance (m) between a calibration's tip and the true one, as the camera sees it, in fixed random poses.

    ``system`` is the arm on its mission, in the gravity of the level rover; nominal ``parameters`` are those of the
    calibration before launch; ``references`` are other calibrations over time, by name.

    Raises:
        ConfigError: calibration and truth do not describe the same arm.
    """
    if tuple(mission.truth.names) != parameters.entry_names:
        raise ConfigError(
            "the calibration's parameters are not those of the simulated arm.",
            hint="Let mission.experiment describe the same arm, effects and measurements as the mission.",
        )
    hours = np.arange(0.0, mission.seconds, _HOUR_S)
    times = np.unique(np.concatenate([mission.times, hours]))
    frozen, true = parameters.nominal(), mission.truth.values_at(times)
    entries = dict(zip(parameters.entry_names, frozen.tolist(), strict=True))
    estimates = tuple(
        (time, np.array([values.get(name, value) for name, value in entries.items()])) for time, values in log.estimates
    )
    series = {"frozen": ((0.0, frozen),), **(references or {}), "recalibrated": estimates}
    loads = {time: load for time, values in log.estimates if (load := _payload_found(values)).any()}
    estimated = [values for of_one in series.values() for _, values in of_one]
    differing = np.any(np.vstack([true, *estimated]) != frozen, axis=0)
    changing = [block.name for block in parameters.blocks if differing[parameters.entries_of(block.name)].any()]
    arm, instrument = next(iter(system.arms.values())), next(iter(system.measurements))
    poses = random_poses(mission.records, tuple(arm.commanded), arm.name, settings.poses, settings.seed)
    tips = Tips.of(system, instrument, parameters, changing, poses, evaluator)
    seen = _true_tips(tips, poses, mission, times, true)
    errors = {
        name: _errors(tips, poses, of_one, loads if name == "recalibrated" else {}, times, seen)
        for name, of_one in series.items()
    }
    is_record, is_hour = np.isin(times, mission.times), np.isin(times, hours)
    return ErrorCurve(times, is_hour, is_record, errors, log.levels_at(times))


def _true_tips(tips: Tips, poses: Dataset, mission: Mission, times: Array, values: Array) -> Array:
    """Where the camera sees the tips (times x poses x 3, m), with whatever hangs on the tool."""
    cameras = mission.truth.camera_T_base_at(times)
    loads, load_of = np.unique(mission.truth.payload_at(times), axis=0, return_inverse=True)
    loaded = [tips.again(with_payload(poses, load)) for load in loads]
    seen = np.zeros((len(times), len(poses), 3))
    for i, (load, camera) in enumerate(zip(load_of.ravel(), cameras, strict=True)):
        seen[i] = loaded[load].at(values[i]) @ camera[:3, :3].T + camera[:3, 3]
    return seen


def _payload_found(values: Mapping[str, float]) -> Array:
    """The payload that a recalibration found: its mass (kg) and its centre in the tool frame (m)."""
    mass, *moments = (values.get(block.name, 0.0) for block in unstated_payload())
    return np.array([mass, *(moment / (mass or 1.0) for moment in moments)])


def _errors(
    unloaded: Tips, poses: Dataset, series: Series, loads: Mapping[float, Array], times: Array, seen: Array
) -> Array:
    """Mean distance of a calibration's tips from those seen, at each time (m); ``loads`` are payloads that it knows.

    One whose springs do not hold the arm predicts nothing: it is off by as much as the tips lie apart.
    """
    numbers = newest([time for time, _ in series], times)
    errors, now, tips = np.zeros(len(times)), seen[0], unloaded.again(poses)
    for i in range(len(times)):
        if i == 0 or numbers[i] != numbers[i - 1]:
            if loads:
                tips = unloaded.again(with_payload(poses, loads.get(series[numbers[i]][0], np.zeros(4))))
            try:
                now = tips.at(series[numbers[i]][1])
            except NotConvergedError:
                now = np.full_like(now, np.nan)
        off = float(np.linalg.norm(now - seen[i], axis=1).mean())
        errors[i] = off if np.isfinite(off) else float(np.linalg.norm(np.ptp(seen[i], axis=0)))
    return errors


class Seen(Contact):
    """An instrument's readings in place of its residual, so that the compiled residual gives them."""

    def __init__(self, instrument: Measurement) -> None:
        self._instrument = instrument
        self.arms = tuple(instrument.arms)
        self._width = len(instrument.channels())

    def residual(
        self, arms: Mapping[str, ArmState], measured: Mapping[str, Expression], values: Mapping[str, Expression]
    ) -> Expression:
        return ca.vertcat(*self._instrument.outputs(arms, values).values())

    def noise(self) -> tuple[float, ...]:
        return (1.0,) * self._width


@dataclass(frozen=True)
class Tips:
    """Fixed poses of an arm, and a problem that gives its tip there.

    Deflections of the last call are where the next one starts, so that values that change little cost little.
    """

    problem: Problem
    records: tuple[FactorRecords, ...]

    @classmethod
    def of(
        cls,
        system: System,
        instrument: str,
        parameters: Parameters,
        changing: Sequence[str],
        poses: Dataset,
        evaluator: EvaluatorChoice,
    ) -> Tips:
        """Compile for values that differ in the blocks ``changing``; in the system's own gravity and load."""
        free = parameters.with_free(changing)
        seen = {instrument: Seen(system.measurements[instrument])}
        problem = Problem.build(system.arms, seen, free, system.environment, poses, evaluator, groups={})
        return cls(problem, problem.records(poses))

    def again(self, poses: Dataset) -> Tips:
        return Tips(self.problem, self.problem.records(poses))

    def at(self, values: Array) -> Array:
        """Tips (poses x 3, m) at a value vector.

        Raises:
            NotConvergedError: a pose has no elastic equilibrium.
        """
        return self.problem.residuals(values, self.records)[0].T


def random_poses(records: Dataset, joints: Sequence[str], arm: str, count: int, seed: int) -> Dataset:
    random, channels = np.random.default_rng(seed), {}
    for joint in joints:
        angles = records.column(f"{arm}.{joint}")
        channels[f"{arm}.{joint}"] = random.uniform(angles.min(), angles.max(), count)
        channels[f"{arm}.approach.{joint}"] = random.choice([-1.0, 1.0], count)
    return with_payload(Dataset(tuple(map(str, range(count))), channels, source="random poses"), np.zeros(4))


def with_payload(poses: Dataset, payload: Array) -> Dataset:
    """The poses with a payload: its mass (kg) and its centre in the tool frame (m)."""
    channels = {name: np.full(len(poses), payload[i]) for i, name in enumerate(_PAYLOAD)}
    return with_channels(poses, channels)
