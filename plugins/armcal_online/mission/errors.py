"""Tip errors over a mission: the frozen and the recalibrated calibration against the truth at each moment."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.config.system import System
from armcal.errors import ConfigError
from armcal.estimate.mission_truth import Mission
from armcal.functions.batch_function import EvaluatorChoice

from armcal_online.mission.judge import ErrorCurve, Flags
from armcal_online.mission.mission_log import MissionLog
from armcal_online.mission.settings import MissionRunSettings
from armcal_online.mission.tips import Tips, random_poses

_HOUR_S = 3600.0


def error_curve(
    system: System,
    parameters: Parameters,
    mission: Mission,
    log: MissionLog,
    settings: MissionRunSettings,
    evaluator: EvaluatorChoice = "auto",
) -> ErrorCurve:
    """Mean distance between a calibration's tip and the true one, as the camera sees it, in fixed random poses.

    Args:
        system: the arm on its mission: gravity of the level rover.
        parameters: nominal values are those of the calibration before launch.
        mission: records and truth.
        log: the estimates over time.
        settings: how many poses.
        evaluator: of the arm.

    Raises:
        ConfigError: calibration and truth do not describe the same arm.
    """
    if tuple(mission.truth.names) != parameters.entry_names:
        raise ConfigError(
            "the calibration's parameters are not those of the simulated arm.",
            hint="Let mission.experiment describe the same arm, effects and measurements as the mission.",
        )
    times, is_record, is_hour = _moments(mission)
    true, estimated = mission.truth.values_at(times), [_vector(parameters, found) for _, found in log.estimates]
    frozen = parameters.nominal()
    arm, instrument = next(iter(system.arms.values())), next(iter(system.measurements))
    poses = random_poses(mission.records, tuple(arm.commanded), arm.name, settings.poses, settings.seed)
    everything = np.vstack([frozen, true, *estimated])
    differing = set(np.flatnonzero(np.any(everything != frozen, axis=0)).tolist())
    changing = [b.name for b in parameters.blocks if differing & set(range(*_span(parameters, b.name)))]
    tips = Tips.of(system, instrument, parameters, changing, poses, evaluator)
    ours, start, cameras = tips.again(poses), tips.again(poses).at(frozen), mission.truth.camera_T_base_at(times)
    found, errors, last = log.estimate_numbers(times), np.zeros((2, len(times))), -1
    now = start
    for i in range(len(times)):
        if found[i] != last:
            last = int(found[i])
            now = ours.at(estimated[last])
        truth = tips.at(true[i]) @ cameras[i, :3, :3].T + cameras[i, :3, 3]
        errors[:, i] = [float(np.linalg.norm(each - truth, axis=1).mean()) for each in (start, now)]
    return ErrorCurve(times, is_hour, is_record, errors[0], errors[1], log.levels_at(times))


def _moments(mission: Mission) -> tuple[Array, Flags, Flags]:
    """Every record's time and every hour; and which are which."""
    hours = np.arange(0.0, mission.seconds, _HOUR_S)
    times = np.unique(np.concatenate([mission.times, hours]))
    return times, np.isin(times, mission.times), np.isin(times, hours)


def _vector(parameters: Parameters, found: Mapping[str, float]) -> Array:
    """The calibration's values with those of an estimate."""
    values, place = parameters.nominal(), {name: i for i, name in enumerate(parameters.entry_names)}
    for name, value in found.items():
        values[place[name]] = value
    return values


def _span(parameters: Parameters, name: str) -> tuple[int, int]:
    place = parameters.entries_of(name)
    return place.start, place.stop
