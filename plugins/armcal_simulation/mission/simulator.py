"""A rover's arm over some days: tilts, warmth, creep, mishaps, and records of which some are lost or wrong."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.joints import by_dimension, joint_limits, unknown_joint
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.errors import ConfigError
from armcal.estimate.simulation import DAY_S, Mission, SimulationRequest, with_channels
from armcal.testing import EXAMPLE_TRUTH
from scipy.spatial.transform import Rotation

from armcal_simulation.mission.changes import MovingTruth, moving_truth, scheduled
from armcal_simulation.mission.events import PayloadSettings, PlaySettings
from armcal_simulation.mission.random_plan import befallen, probing_poses, random_plan
from armcal_simulation.mission.settings import LossSettings, MissionSettings, RecordSettings, TiltSettings, began_at
from armcal_simulation.readings import (
    approach_of,
    at_truth,
    disturbed,
    measured_while_moving,
    with_exchanged,
    with_outliers,
)

_STREAMS = ("times", "losses", "tilt", "poses", "creep", "noise", "outliers", "exchanged")
_HOUR_S = 3600.0
_PROBES = 40


def record_times(days: float, records: RecordSettings, random: np.random.Generator) -> Array:
    """When the arm is measured, s since the mission began, in order."""
    first, last = (hour * _HOUR_S for hour in records.hours)
    times: list[float] = []
    for day in range(int(np.ceil(days))):
        at = day * DAY_S + first + random.exponential(records.every)
        while at < min(day * DAY_S + last, days * DAY_S):
            times.append(at)
            at += random.exponential(records.every)
    return np.array(times)


def arriving(times: Array, losses: LossSettings, random: np.random.Generator) -> Mask:
    """Which records arrive (N): not in a gap or an hour without contact, nor if they are lost alone."""
    hours = np.floor(times / _HOUR_S).astype(int)
    silent = (random.random(int(hours.max(initial=0)) + 1) < losses.hours)[hours]
    for gap in losses.gaps:
        silent |= (times >= gap.day * DAY_S) & (times < gap.day * DAY_S + gap.duration)
    return ~silent & (random.random(len(times)) >= losses.fraction)


@dataclass(frozen=True)
class Stands:
    """How the rover stood: from when (M, s), turned by which rotation vector (M x 3, rad), and as it reads that."""

    since: Array
    turns: Array
    readings: Array

    @classmethod
    def drawn(
        cls, days: float, tilt: TiltSettings, hours: tuple[float, float], gravity: Array, random: np.random.Generator
    ) -> Self:
        drives = random.poisson(tilt.drives_per_day * days) if tilt.drives_per_day else 0
        day, hour = random.integers(0, int(np.ceil(days)), drives), random.uniform(*hours, drives)
        since = np.concatenate([[0.0], np.sort(day * DAY_S + hour * _HOUR_S)])
        down = gravity / np.linalg.norm(gravity)
        level = np.linalg.svd(down[None, :])[2][1:]
        azimuth = random.uniform(0, 2 * np.pi, len(since))
        axes = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1) @ level
        turns = axes * random.uniform(0, tilt.most, (len(since), 1))
        error = Rotation.from_rotvec(random.normal(0, 1, (len(since), 3)) * tilt.error)
        return cls(since, turns, (Rotation.from_rotvec(turns) * error).as_rotvec())

    def at(self, times: Array, turns: Array) -> Rotation:
        return Rotation.from_rotvec(turns[np.searchsorted(self.since, times, side="right") - 1])

    def gravity(self, times: Array, level: Array, turns: Array) -> Array:
        """Gravity in the rover's base frame (3 x N), from that of the level rover (3)."""
        return np.asarray(self.at(times, turns).inv().apply(level).T)


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
        return self.mission(request).records

    def mission(self, request: SimulationRequest) -> Mission:
        """Records of the first arm, and the truth.

        Gravity is that of the request while the rover stands level, and the records have it as the rover reads it.

        Raises:
            ConfigError: a parameter, joint or measurement does not fit.
        """
        settings = self._settings
        _check(request, settings)
        # a generator for each purpose, so that a change of one setting leaves the others' draws alone
        seeds = np.random.SeedSequence(settings.seed).spawn(len(_STREAMS))
        random = {name: np.random.default_rng(seed) for name, seed in zip(_STREAMS, seeds, strict=True)}
        truth = moving_truth(at_truth(request, settings.truth).parameters, settings, random["creep"])
        times = record_times(settings.days, settings.records, random["times"])
        there = arriving(times, settings.losses, random["losses"])
        level = np.array(request.environment.gravity)
        stands = Stands.drawn(settings.days, settings.tilt, settings.records.hours, level, random["tilt"])
        arm = next(iter(request.arms.values()))
        commands = self._commands(arm, times, truth, random["poses"])
        standing = with_channels(commands, _gravity(stands.gravity(times, level, stands.turns)))
        read, wrong, exchanged = self._read(request, standing, times, truth, random)
        shown = with_channels(standing, {**_gravity(stands.gravity(times, level, stands.readings)), **read})
        kept = np.flatnonzero(there)
        return Mission(
            records=shown.subset(kept),
            times=times[kept],
            outliers=wrong[kept],
            exchanged=exchanged[kept],
            truth=truth,
            events=scheduled(settings, _joints(request)),
            power_cuts=tuple(sorted(day * DAY_S for day in settings.power_cuts if day < settings.days)),
            began=began_at(settings.start),
            seconds=settings.days * DAY_S,
            lost=int(np.sum(~there)),
        )

    def planted(self, request: SimulationRequest, seed: int) -> Mapping[str, Any]:
        """Keys of these settings that plant a random selection of events and disturbances; the same for a seed.

        Raises:
            ConfigError: a joint has no range, or the truth names unknown parameters.
        """
        settings, random = self._settings.model_copy(update={"events": ()}), np.random.default_rng(0)
        true, arm = at_truth(request, settings.truth), next(iter(request.arms.values()))
        times, truth = np.arange(float(_PROBES)), moving_truth(true.parameters, settings, random)
        poses = probing_poses(self._commands(arm, times, truth, random), arm, random)
        plan = random_plan(befallen(true, poses), settings.days, _bends(request), seed)
        kept = settings.losses.to_config()
        return plan | ({"losses": {**kept, **plan["losses"]}} if "losses" in plan else {})

    def _commands(self, arm: Arm, times: Array, truth: MovingTruth, random: np.random.Generator) -> Dataset:
        """Random commands, and when the arm is there; nothing hangs on the tool."""
        records, keys = self._settings.records, ("simulation.records.ranges", "simulation.records.travel")
        stated = by_dimension(arm.commanded, records.ranges, records.travel, keys)
        positions: list[Array] = []
        for joint, span in joint_limits(arm.nominal_chain, stated).items():
            if span is None:
                text = f"simulation.records: found no range of {joint}, and the arm states no limits of it."
                raise ConfigError(text, hint=f"Write for example ranges_deg: {{{joint}: [-90, 90]}}.")
            positions.append(random.uniform(*span, len(times)))
        angles = np.array(positions)
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
    ) -> tuple[dict[str, Array], Mask, Mask]:
        """Readings of the cameras, where they stand at each time; which records are wrong, and which exchanged."""
        hung = zip(("payload", "payload_x", "payload_y", "payload_z"), truth.payload_at(times).T, strict=True)
        loaded = with_channels(standing, dict(hung))
        exact = measured_while_moving(request, loaded, truth.values_at(times))
        camera_T_base = truth.camera_T_base_at(times)
        for name in request.measurements:
            axes = [f"{name}.{axis}" for axis in "xyz"]
            position = np.stack([exact[axis] for axis in axes], axis=1)
            moved = np.einsum("nij,nj->ni", camera_T_base[:, :3, :3], position) + camera_T_base[:, :3, 3]
            exact |= dict(zip(axes, moved.T, strict=True))
        noisy = disturbed(request, standing, exact, self._settings.noise, random["noise"])
        wild, wrong = with_outliers(noisy, self._settings.outliers, random["outliers"])
        read, exchanged = with_exchanged(wild, self._settings.exchanged.fraction, random["exchanged"])
        return read, wrong, exchanged


def _check(request: SimulationRequest, settings: MissionSettings) -> None:
    for name, measurement in request.measurements.items():
        channels = tuple(channel.name for channel in measurement.channels())
        if channels != ("x", "y", "z"):
            text = f"simulation: {name} reads {', '.join(channels) or 'nothing'}, expected a position x, y, z."
            raise ConfigError(text, hint="A mission is measured by instruments such as tip_position.")
    joints, effects = _joints(request), {f"{arm.name}.{name}" for arm in request.arms.values() for name in arm.effects}
    for event in settings.events:
        joint = getattr(event, "joint", joints[0])
        if fault := unknown_joint([joint], joints):
            raise ConfigError(f"simulation.events: {fault}.")
        if isinstance(event, PlaySettings) and event.parameter.rpartition(".")[0] not in effects:
            raise ConfigError(
                f"simulation.events: {event.parameter} is no play of a joint, it belongs to no joint effect.",
                hint="Give the arm an effect such as approach_backlash, and its half-width here (arm.lag.lag3).",
            )
        if isinstance(event, PayloadSettings) and not _bends(request):
            hint = "Give the arm a spring effect, such as torsional_spring, and gravity in the section statics."
            raise ConfigError("simulation.events: a payload bends nothing here.", hint=hint)


def _bends(request: SimulationRequest) -> bool:
    arm = next(iter(request.arms.values()))
    return bool(arm.deflection_size) and any(request.environment.gravity)


def _joints(request: SimulationRequest) -> list[str]:
    return [f"{arm.name}.{joint}" for arm in request.arms.values() for joint in arm.commanded]


def _gravity(vectors: Array) -> dict[str, Array]:
    return {f"gravity_{axis}": vectors[i] for i, axis in enumerate("xyz")}
