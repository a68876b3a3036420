"""A rover's arm over some days: tilts, warmth, creep, mishaps, and records of which some are lost or wrong."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.joints import Limits, by_dimension, joint_limits, unknown_joint
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError
from armcal.estimate.mission_truth import DAY_S, Mission
from armcal.estimate.simulation import SimulationRequest, with_channels
from armcal.testing import EXAMPLE_TRUTH
from numpy.typing import NDArray

from armcal_simulation.mission_changes import MovingTruth, moving_truth, scheduled
from armcal_simulation.mission_schedule import Stands, arriving, record_times
from armcal_simulation.mission_settings import MissionSettings, RecordSettings, began_at
from armcal_simulation.motions import approach_of
from armcal_simulation.moving_arm import measured_while_moving
from armcal_simulation.outliers import with_outliers
from armcal_simulation.readings import disturbed

_STREAMS = ("times", "losses", "tilt", "poses", "creep", "noise", "outliers")


class MissionOfDays:
    """The simulator ``mission``; see ``MissionSimulator``."""

    Settings: ClassVar[type[MissionSettings]] = MissionSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "truth": str(EXAMPLE_TRUTH),
        "days": 2,
        "start": "2031-03-01T00:00:00Z",
        "seed": 1,
        "records": {"every_min": 60, "ranges_deg": {"q1": [-60, 60], "q2": [-90, 90]}},
        "losses": {"fraction": 0.05, "hours": 0.1},
        "tilt": {"most_deg": 20, "drives_per_day": 2, "error_deg": 0.2},
        "temperature": {"mean_C": -20, "swing_C": 40, "period_h": 24},
        "thermal": {"arm.planar.a?": {"per_K": "0.004 mm"}},
        "creep": {"arm.planar.theta1": "walk 0.1 deg in 30 d", "arm.planar.theta2": "0.1 deg in 30 d"},
        "events": [
            {"kind": "slip", "day": 0.5, "joint": "arm.q2", "parameter": "arm.planar.theta2", "teeth": 1},
            {"kind": "swap", "day": 1, "joint": "arm.q1", "changes": {"arm.planar.theta1": "2 deg"}},
            {"kind": "bump", "day": 1.5, "shift_mm": [3, 0, 1], "turn_deg": [0, 0.5, 0]},
        ],
        "power_cuts": [1.4],
        "outliers": {"fraction": 0.05, "size_mm": 30},
    }

    def __init__(self, settings: MissionSettings) -> None:
        self._settings = settings

    def simulate(self, request: SimulationRequest) -> Dataset:
        """The records that arrive; see ``mission``."""
        return self.mission(request).records

    def mission(self, request: SimulationRequest) -> Mission:
        """Records of the first arm, and the truth.

        Gravity is that of the request while the rover stands level, and the records have it as the rover reads it.

        Raises:
            ConfigError: a parameter, joint or measurement does not fit.
        """
        settings = self._settings
        _check(request, settings)
        random = dict(zip(_STREAMS, _streams(settings.seed), strict=True))
        truth = moving_truth(_true(request, settings).parameters, settings, random["creep"])
        times = record_times(settings.days, settings.records, random["times"])
        there = arriving(times, settings.losses, random["losses"])
        level = np.array(request.environment.gravity)
        stands = Stands.drawn(settings.days, settings.tilt, settings.records.hours, level, random["tilt"])
        arm = next(iter(request.arms.values()))
        commands = self._commands(arm, times, truth, random["poses"])
        standing = with_channels(commands, _gravity(stands.gravity(times, level, stands.turns)))
        read, wrong = self._read(request, standing, times, truth, random)
        shown = with_channels(standing, {**_gravity(stands.gravity(times, level, stands.readings)), **read})
        kept = np.flatnonzero(there)
        return Mission(
            records=shown.subset(kept),
            times=times[kept],
            outliers=wrong[kept],
            truth=truth,
            events=scheduled(settings),
            power_cuts=tuple(sorted(day * DAY_S for day in settings.power_cuts if day < settings.days)),
            began=began_at(settings.start),
            seconds=settings.days * DAY_S,
            lost=int(np.sum(~there)),
        )

    def _commands(self, arm: Arm, times: Array, truth: MovingTruth, random: np.random.Generator) -> Dataset:
        """Where the arm is told to go, and when; nothing hangs on the tool."""
        spans = _spans(arm, self._settings.records)
        angles = np.array([random.uniform(low, high, len(times)) for low, high in spans])
        approach = approach_of(angles) if len(times) else angles
        channels = {f"{arm.name}.{joint}": angles[i] for i, joint in enumerate(arm.commanded)}
        channels |= {f"{arm.name}.approach.{joint}": approach[i] for i, joint in enumerate(arm.commanded)}
        channels |= {"time": times + began_at(self._settings.start), "temperature": truth.temperature_at(times)}
        channels |= {"sequence": np.arange(1.0, len(times) + 1), "payload": np.zeros(len(times))}
        return Dataset(tuple(f"m{i}" for i in range(1, len(times) + 1)), channels, source="simulation")

    def _read(
        self,
        request: SimulationRequest,
        standing: Dataset,
        times: Array,
        truth: MovingTruth,
        random: Mapping[str, np.random.Generator],
    ) -> tuple[dict[str, Array], NDArray[np.bool_]]:
        """What instruments read, and which records are wrong."""
        exact = measured_while_moving(request, standing, truth.values_at(times))
        seen = _seen(exact, tuple(request.measurements), truth.camera_T_base_at(times))
        noisy = disturbed(request, standing, seen, self._settings.noise, random["noise"])
        return with_outliers(noisy, self._settings.outliers, random["outliers"])


def _streams(seed: int) -> list[np.random.Generator]:
    """One source of randomness for each purpose, so that a change of one setting leaves the others' draws alone."""
    return [np.random.default_rng(each) for each in np.random.SeedSequence(seed).spawn(len(_STREAMS))]


def _true(request: SimulationRequest, settings: MissionSettings) -> SimulationRequest:
    source = load_config(settings.truth)
    parameters = with_values(request.parameters, source.data, source, ())
    return SimulationRequest(request.arms, request.measurements, parameters, request.environment)


def _check(request: SimulationRequest, settings: MissionSettings) -> None:
    for name, measurement in request.measurements.items():
        channels = tuple(channel.name for channel in measurement.channels())
        if channels != ("x", "y", "z"):
            raise ConfigError(
                f"simulation: {name} reads {', '.join(channels) or 'nothing'}, expected a position x, y, z.",
                hint="A mission is measured by instruments such as tip_position.",
            )
    joints = [f"{arm.name}.{joint}" for arm in request.arms.values() for joint in arm.commanded]
    for event in settings.events:
        joint = getattr(event, "joint", joints[0])
        if fault := unknown_joint([joint], joints):
            raise ConfigError(f"simulation.events: {fault}.")


def _spans(arm: Arm, records: RecordSettings) -> list[Limits]:
    """From where to where each joint is driven (rad, or m)."""
    keys = ("simulation.records.ranges", "simulation.records.travel")
    spans: list[Limits] = []
    for joint, span in joint_limits(
        arm.nominal_chain, by_dimension(arm.commanded, records.ranges, records.travel, keys)
    ).items():
        if span is None:
            raise ConfigError(
                f"simulation.records: nothing says how far {joint} is driven, and the arm states no limits of it.",
                hint=f"Write for example ranges_deg: {{{joint}: [-90, 90]}}.",
            )
        spans.append(span)
    return spans


def _gravity(vectors: Array) -> dict[str, Array]:
    return {f"gravity_{axis}": vectors[i] for i, axis in enumerate("xyz")}


def _seen(exact: Mapping[str, Array], instruments: tuple[str, ...], camera_T_base: Array) -> dict[str, Array]:
    """Positions as the cameras see them, where they stand now (channels of N, m)."""
    seen = dict(exact)
    for name in instruments:
        position = np.stack([exact[f"{name}.{axis}"] for axis in "xyz"], axis=1)
        moved = np.einsum("nij,nj->ni", camera_T_base[:, :3, :3], position) + camera_T_base[:, :3, 3]
        seen |= {f"{name}.{axis}": moved[:, i] for i, axis in enumerate("xyz")}
    return seen
