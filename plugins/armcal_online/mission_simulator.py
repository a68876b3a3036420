"""The simulator ``mission``: a rover's arm over some days, what befalls it, and what is measured of it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.joints import by_dimension, joint_limits, unknown_joint
from armcal.arm.statics import unstated_payload
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.settings import Angle, Angle3, Duration, InputPath, Length, Length3, Mass, Settings, Temperature
from armcal.base.units import amount_in_time
from armcal.config.selection import quantity
from armcal.errors import ConfigError
from armcal.estimate.simulation import (
    OutlierSettings,
    SimulationRequest,
    approach_of,
    at_truth,
    measured_with_noise,
    with_channels,
    with_outliers,
)
from armcal.problem.problem import Problem
from pydantic import Field, field_validator, model_validator
from scipy.spatial.transform import Rotation

DAY_S, HOUR_S = 86400.0, 3600.0
_WALK_STEP_S = 3600.0
_STREAMS = ("times", "losses", "tilt", "poses", "creep", "noise", "outliers")
_LABELS = {
    "slip": "{joint} slips by {sizes}",
    "swap": "servo of {joint} replaced",
    "bend": "link behind {joint} bent ({sizes})",
    "creep": "{joint} creeps by {sizes}",
    "play": "play of {joint} grows by {sizes}",
    "tilt": "unreported tilt of {sizes}",
}
Day = Annotated[float, Field(ge=0)]
Hour = Annotated[float, Field(ge=0, le=24)]
Fraction = Annotated[float, Field(ge=0, le=1)]


def parsed_rate(text: str) -> tuple[str, float, bool]:
    """The amount as written, over how many s, and whether it walks at random; ValueError if it is not written so."""
    walks = text.strip().startswith("walk ")
    return *amount_in_time(text.strip().removeprefix("walk ").strip()), walks


class EventSettings(Settings):
    """What happens on a ``day``, counted from the mission's midnight; what grows or lasts does so ``until`` another."""

    day: Day
    until: Day | None = None

    @model_validator(mode="after")
    def _ends_later(self) -> Self:
        if self.until is not None and self.until <= self.day:
            raise ValueError(f"found until: {self.until:g} of an event on day {self.day:g}: write a later day")
        return self


class ArmEventSettings(EventSettings):
    """Parameters that jump (``{arm.mdh.theta3: 14.4 deg}``) or change from then on (``... 0.5 deg in 10 d``)."""

    kind: Literal["slip", "swap", "bend", "creep", "play", "tilt"]
    joint: str = "a joint"
    changes: Annotated[dict[str, str | float], Field(min_length=1)]

    @property
    def label(self) -> str:
        sizes = ", ".join(map(str, self.changes.values()))
        return _LABELS[self.kind].format(joint=self.joint, sizes=sizes)

    @property
    def grows(self) -> bool:
        return any(" in " in str(change) for change in self.changes.values())


class PayloadSettings(EventSettings):
    """The tool picks up a mass that no record reports."""

    kind: Literal["payload"]
    mass: Annotated[Mass, Field(gt=0)]
    lever: Length3 = (0.0, 0.0, 0.0)  # its centre in the tool frame
    grows: ClassVar[bool] = False

    @property
    def label(self) -> str:
        return f"unreported payload of {1000 * self.mass:.0f} g at {1000 * math.hypot(*self.lever):.0f} mm"


class CameraSettings(EventSettings):
    """What is measured is turned about the base's origin (a rotation vector), shifted, and moves away ``per_day``."""

    kind: Literal["bump", "bias"]
    shift: Length3 = (0.0, 0.0, 0.0)
    turn: Angle3 = (0.0, 0.0, 0.0)
    per_day: Length3 = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _moves(self) -> Self:
        if self.kind == "bias" and not self.grows:
            raise ValueError("found a bias that does not grow: write for example per_day_mm: [0.3, 0, 0]")
        return self

    @property
    def grows(self) -> bool:
        return any(self.per_day)

    @property
    def label(self) -> str:
        shift, turn, per_day = (math.hypot(*vector) for vector in (self.shift, self.turn, self.per_day))
        if self.kind == "bias":
            return f"camera's bias grows by {1000 * per_day:.2f} mm a day"
        return f"camera bumped by {1000 * shift:.1f} mm, {math.degrees(turn):.1f} deg"


Event = Annotated[ArmEventSettings | PayloadSettings | CameraSettings, Field(discriminator="kind")]


class RecordSettings(Settings):
    every: Annotated[Duration, Field(gt=0)] = 600.0  # in the mean, at random
    hours: tuple[Hour, Hour] = (8.0, 18.0)  # from and to, each day
    ranges: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)  # by default each joint's limits
    travel: dict[str, tuple[Length, Length]] = Field(default_factory=dict)  # of sliding joints


class LossSettings(Settings):
    fraction: Fraction = 0.0  # of the records, which never arrive
    hours: Fraction = 0.0  # in which there is no contact


class TiltSettings(Settings):
    most: Annotated[Angle, Field(ge=0)] = 0.0  # how the rover stands, anew after each drive
    drives_per_day: Annotated[float, Field(ge=0)] = 3.0
    error: Annotated[Angle, Field(ge=0)] = 0.0  # of its reading, standard deviation about each axis


class TemperatureSettings(Settings):
    mean: Temperature = 20.0
    swing: Temperature = 0.0  # up and down from the mean
    period: Annotated[Duration, Field(gt=0)] = 86400.0
    warmest: float = 14.0  # hour


class ThermalSettings(Settings):
    per_K: str | float  # with its unit (0.002 deg)
    reference: Temperature = 20.0


class MissionSettings(Settings):
    """The truth, and the mission over it. Events of the same ``day`` come at once."""

    truth: InputPath
    days: Annotated[float, Field(gt=0, le=3660)]
    start: str | None = None  # of the mission's midnight; without a date time counts from 0
    seed: Annotated[int, Field(ge=0)] = 0
    records: RecordSettings = Field(default_factory=RecordSettings)
    losses: LossSettings = Field(default_factory=LossSettings)
    tilt: TiltSettings = Field(default_factory=TiltSettings)
    temperature: TemperatureSettings = Field(default_factory=TemperatureSettings)
    thermal: dict[str, ThermalSettings] = Field(default_factory=dict)
    creep: dict[str, str] = Field(default_factory=dict)  # "0.05 deg in 30 d"; "walk ..." has that as its final sd
    events: tuple[Event, ...] = ()
    power_cuts: tuple[Day, ...] = ()
    noise: Annotated[Length, Field(ge=0)] | None = None  # by default what each measurement declares
    outliers: OutlierSettings = Field(default_factory=OutlierSettings)

    @field_validator("creep")
    @classmethod
    def _readable(cls, value: dict[str, str]) -> dict[str, str]:
        for text in value.values():
            parsed_rate(text)
        return value

    @model_validator(mode="after")
    def _sane(self) -> Self:
        try:
            dated = self.start is None or datetime.fromisoformat(self.start).tzinfo is not None
        except ValueError:
            dated = False
        if not dated:
            raise ValueError(f"found the start {self.start!r}, expected a date and zone: write 2031-03-01T00:00:00Z")
        for event in self.events:
            if event.day >= self.days:
                raise ValueError(
                    f"found the {event.kind} on day {event.day:g}, expected one before the mission ends after "
                    f"{self.days:g} days: change its day, or leave it out"
                )
        return self

    @property
    def began(self) -> float:
        """What the clock shows at the mission's midnight: unix seconds, or 0 without a date."""
        return datetime.fromisoformat(self.start).timestamp() if self.start else 0.0


@dataclass(frozen=True)
class Truth:
    """The truth at any time (s since the mission began): stated values, and what moves them."""

    parameters: Parameters
    paths: tuple[tuple[int, Array, Array], ...]  # an entry's change by straight lines; a moment twice is a jump
    warmings: tuple[tuple[int, float, float], ...]  # an entry's change for each K above a reference
    temperature: TemperatureSettings
    cameras: tuple[CameraSettings, ...]

    @classmethod
    def over(cls, parameters: Parameters, settings: MissionSettings, random: np.random.Generator) -> Self:
        paths, end = list[tuple[int, Array, Array]](), settings.days * DAY_S
        for glob, text in settings.creep.items():
            paths += [_path(parameters, name, text, (0.0, end), random) for name in parameters.select([glob])]
        for event in settings.events:
            span = event.day * DAY_S, end if event.until is None else event.until * DAY_S
            if isinstance(event, ArmEventSettings):
                for glob, change in event.changes.items():
                    paths.append(_path(parameters, parameters.select([glob])[0], change, span, random))
            elif isinstance(event, PayloadSettings):
                sizes = (event.mass, *(event.mass * lever for lever in event.lever))
                for block, size in zip(unstated_payload(), sizes, strict=True):
                    held = np.array([0.0, size, size, 0.0 if event.until else size])
                    paths.append((_entry(parameters, block.name), np.repeat(span, 2), held))
        warmings = tuple(
            (_entry(parameters, name), quantity(parameters[name], thermal.per_K, None, ()), thermal.reference)
            for glob, thermal in settings.thermal.items()
            for name in parameters.select([glob])
        )
        cameras = sorted((e for e in settings.events if isinstance(e, CameraSettings)), key=lambda event: event.day)
        return cls(parameters, tuple(paths), warmings, settings.temperature, tuple(cameras))

    def values_at(self, times: Array) -> Array:
        values = np.tile(self.parameters.nominal(), (len(times), 1))
        for entry, moments, changes in self.paths:
            values[:, entry] += np.interp(times, moments, changes)
        warmth = self.temperature_at(times)
        for entry, per_kelvin, reference in self.warmings:
            values[:, entry] += per_kelvin * (warmth - reference)
        return values

    def temperature_at(self, times: Array) -> Array:
        sine = self.temperature
        return sine.mean + sine.swing * np.cos(2 * np.pi * (times - sine.warmest * HOUR_S) / sine.period)

    def camera_T_base_at(self, times: Array) -> Array:  # noqa: N802
        """Where what is measured in the base frame is seen, once the camera has moved (N x 4 x 4, m)."""
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        for event in self.cameras:
            moved = np.eye(4)
            moved[:3, :3], moved[:3, 3] = Rotation.from_rotvec(event.turn).as_matrix(), event.shift
            after = times >= event.day * DAY_S
            poses[after] = moved @ poses[after]
            days = np.clip(times / DAY_S, event.day, math.inf if event.until is None else event.until) - event.day
            poses[:, :3, 3] += days[:, None] * np.array(event.per_day)
        return poses


def _path(
    parameters: Parameters, name: str, text: str | float, span: tuple[float, float], random: np.random.Generator
) -> tuple[int, Array, Array]:
    block, entry, (begin, end) = parameters[name], _entry(parameters, name), span
    if not (isinstance(text, str) and " in " in text):
        return entry, np.array([begin, begin]), np.array([0.0, quantity(block, text, None, ())])
    written, over, walks = parsed_rate(text)
    amount = quantity(block, float(written) if block.unit == "1" else written, None, ())
    if not walks:
        return entry, np.array([begin, end]), np.array([0.0, amount * (end - begin) / over])
    times = np.append(np.arange(begin, end, _WALK_STEP_S), end)
    steps = random.normal(0, 1, len(times) - 1) * amount * np.sqrt(np.diff(times) / over)
    return entry, times, np.concatenate([[0.0], np.cumsum(steps)])


def _entry(parameters: Parameters, name: str) -> int:
    place = parameters.entries_of(name)
    if place.stop - place.start != 1:
        raise ConfigError(f"simulation: {name} is no single number.", hint="Only single numbers move in a mission.")
    return int(place.start)


@dataclass(frozen=True)
class Mission:
    """A simulated mission: what arrived of it, and its truth; times in s since it began."""

    records: Dataset
    times: Array
    outliers: Mask  # which measurements were made wrong (N)
    truth: Truth
    lost: int  # how many records never arrived
    settings: MissionSettings
    power_cuts: tuple[float, ...]


class MissionOfDays:
    Settings: ClassVar[type[MissionSettings]] = MissionSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "truth": "truth.yaml",
        "days": 2,
        "records": {"every_min": 60, "ranges_deg": {"q1": [-60, 60], "q2": [-90, 90]}},
        "tilt": {"most_deg": 20, "error_deg": 0.2},
        "thermal": {"arm.planar.a?": {"per_K": "0.004 mm"}},
        "creep": {"arm.planar.theta1": "walk 0.1 deg in 30 d"},
        "events": [{"kind": "slip", "day": 1, "joint": "arm.q2", "changes": {"arm.planar.theta2": "14.4 deg"}}],
    }

    def __init__(self, settings: MissionSettings) -> None:
        self._settings = settings

    def simulate(self, request: SimulationRequest) -> Dataset:
        return self.mission(request).records

    def mission(self, request: SimulationRequest) -> Mission:
        """Records of the first arm; gravity is that of the request while the rover stands level."""
        settings = self._settings
        _check(request, settings)
        # a generator for each purpose, so that a change of one setting leaves the others' draws alone
        seeds = np.random.SeedSequence(settings.seed).spawn(len(_STREAMS))
        random = {name: np.random.default_rng(seed) for name, seed in zip(_STREAMS, seeds, strict=True)}
        parameters = with_payload(at_truth(request, settings.truth).parameters)
        truth = Truth.over(parameters, settings, random["creep"])
        times = record_times(settings.days, settings.records, random["times"])
        hours = np.floor(times / HOUR_S).astype(int)
        silent = (random["losses"].random(int(hours.max(initial=0)) + 1) < settings.losses.hours)[hours]
        kept = np.flatnonzero(~silent & (random["losses"].random(len(times)) >= settings.losses.fraction))
        if not len(kept):
            hint = "Make the mission longer, lose fewer records, and end the hours later than they begin."
            raise ConfigError("simulation: no record arrives in this mission.", hint=hint)
        felt, stated = gravity_over(times, settings, np.array(request.environment.gravity), random["tilt"])
        commands = self._commands(next(iter(request.arms.values())), times, truth, random["poses"])
        exact = measured_while_moving(request, with_channels(commands, felt), times, truth)
        noisy = measured_with_noise(request, with_channels(commands, felt), exact, random["noise"], settings.noise)
        read, wrong = with_outliers(noisy, settings.outliers, random["outliers"])
        return Mission(
            records=with_channels(commands, {**stated, **read}).subset(kept),
            times=times[kept],
            outliers=wrong[kept],
            truth=truth,
            lost=len(times) - len(kept),
            settings=settings,
            power_cuts=tuple(sorted(day * DAY_S for day in settings.power_cuts if day < settings.days)),
        )

    def _commands(self, arm: Arm, times: Array, truth: Truth, random: np.random.Generator) -> Dataset:
        records, keys = self._settings.records, ("simulation.records.ranges", "simulation.records.travel")
        stated = by_dimension(arm.commanded, records.ranges, records.travel, keys)
        positions: list[Array] = []
        for joint, span in joint_limits(arm.nominal_chain, stated).items():
            if span is None:
                text = f"simulation.records: found no range of {joint}, and the arm states no limits of it."
                raise ConfigError(text, hint=f"Write for example ranges_deg: {{{joint}: [-90, 90]}}.")
            positions.append(random.uniform(*span, len(times)))
        angles = np.array(positions)
        channels = {f"{arm.name}.{joint}": angles[i] for i, joint in enumerate(arm.commanded)}
        channels |= {f"{arm.name}.approach.{j}": row for j, row in zip(arm.commanded, approach_of(angles), strict=True)}
        channels |= {"time": times + self._settings.began, "temperature": truth.temperature_at(times)}
        channels |= {"sequence": np.arange(1.0, len(times) + 1), "payload": np.zeros(len(times))}
        return Dataset(tuple(f"m{i}" for i in range(1, len(times) + 1)), channels, source="simulation")


def _check(request: SimulationRequest, settings: MissionSettings) -> None:
    for name, measurement in request.measurements.items():
        channels = tuple(channel.name for channel in measurement.channels())
        if channels != ("x", "y", "z"):
            text = f"simulation: {name} reads {', '.join(channels) or 'nothing'}, expected a position x, y, z."
            raise ConfigError(text, hint="A mission is measured by instruments such as tip_position.")
    joints = [f"{arm.name}.{joint}" for arm in request.arms.values() for joint in arm.commanded]
    named = [e.joint for e in settings.events if isinstance(e, ArmEventSettings) and "joint" in e.model_fields_set]
    if fault := unknown_joint(named, joints):
        raise ConfigError(f"simulation.events: {fault}.")
    bends = next(iter(request.arms.values())).deflection_size and any(request.environment.gravity)
    if not bends and any(isinstance(event, PayloadSettings) for event in settings.events):
        hint = "Give the arm a spring effect, such as torsional_spring, and gravity in the section statics."
        raise ConfigError("simulation.events: a payload bends nothing here.", hint=hint)


def with_payload(parameters: Parameters) -> Parameters:
    """Those of a payload that no record reports as well."""
    return Parameters((*parameters.blocks, *(b for b in unstated_payload() if b.name not in parameters.names)))


def record_times(days: float, records: RecordSettings, random: np.random.Generator) -> Array:
    first, last = (hour * HOUR_S for hour in records.hours)
    times: list[float] = []
    for day in range(int(np.ceil(days))):
        at = day * DAY_S + first + random.exponential(records.every)
        while at < min(day * DAY_S + last, days * DAY_S):
            times.append(at)
            at += random.exponential(records.every)
    return np.array(times)


def gravity_over(
    times: Array, settings: MissionSettings, level: Array, random: np.random.Generator
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Gravity in the rover's base frame by channel (N each), true and as it reads it, from that of the level rover."""
    tilt, days = settings.tilt, settings.days
    drives = random.poisson(tilt.drives_per_day * days) if tilt.drives_per_day else 0
    day, hour = random.integers(0, int(np.ceil(days)), drives), random.uniform(*settings.records.hours, drives)
    since = np.concatenate([[0.0], np.sort(day * DAY_S + hour * HOUR_S)])
    horizontal = np.linalg.svd((level / np.linalg.norm(level))[None, :])[2][1:]
    azimuth = random.uniform(0, 2 * np.pi, len(since))
    axes = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1) @ horizontal
    turns = Rotation.from_rotvec(axes * random.uniform(0, tilt.most, (len(since), 1)))
    error = Rotation.from_rotvec(random.normal(0, 1, (len(since), 3)) * tilt.error)
    stand = np.searchsorted(since, times, side="right") - 1
    felt, stated = (
        {f"gravity_{axis}": row for axis, row in zip("xyz", turned[stand].inv().apply(level).T, strict=True)}
        for turned in (turns, turns * error)
    )
    return felt, stated


def measured_while_moving(
    request: SimulationRequest, commands: Dataset, times: Array, truth: Truth
) -> dict[str, Array]:
    """What every camera reads without noise (SI), by channel (N each), where arm and camera are at each time."""
    values, blocks = truth.values_at(times), truth.parameters.blocks
    differing = np.any(values != values[0], axis=0)
    moving = [block.name for block in blocks if differing[truth.parameters.entries_of(block.name)].any()]
    parameters = truth.parameters.with_nominal(values[0]).with_free(moving)
    parts = (request.arms, request.measurements, parameters, request.environment, commands)
    problem = Problem.build(*parts, evaluator="interpreted")
    shown = [problem.by_channel(problem.subset(np.array([i])).predict(row)) for i, row in enumerate(values)]
    cameras = truth.camera_T_base_at(times)
    exact = {name: np.concatenate([one[name] for one in shown]) for name in shown[0]}
    for name in request.measurements:
        axes = [f"{name}.{axis}" for axis in "xyz"]
        position = np.stack([exact[axis] for axis in axes], axis=1)
        moved = np.einsum("nij,nj->ni", cameras[:, :3, :3], position) + cameras[:, :3, 3]
        exact |= dict(zip(axes, moved.T, strict=True))
    return exact
