"""How the truth moves over a mission: creep, temperature, and what happens to joints and camera."""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from armcal.arm.environment import gravity_tilt
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.config.selection import quantity
from armcal.errors import ConfigError
from armcal.estimate.simulation import DAY_S, MissionEvent
from scipy.spatial.transform import Rotation

from armcal_simulation.mission.events import (
    BendSettings,
    BiasSettings,
    BumpSettings,
    ClimateSettings,
    CreepSettings,
    Event,
    PayloadSettings,
    PlaySettings,
    SlipSettings,
    SwapSettings,
    TiltedSettings,
    label_of,
    parsed_creep,
)
from armcal_simulation.mission.settings import MissionSettings, TemperatureSettings

_WALK_STEP_S = 3600.0


@dataclass(frozen=True)
class Path:
    """A parameter's change over time: by entry, straight lines between known moments (s; SI).

    A moment that stands there twice is a jump, from then on.
    """

    entry: int
    times: Array
    changes: Array


@dataclass(frozen=True)
class Warming:
    """A parameter's change for each K above a reference: by entry (SI)."""

    entry: int
    per_kelvin: float
    reference: float


@dataclass(frozen=True)
class MovingTruth:
    """The truth at any time: stated values, and what moves them; see ``MissionTruth``."""

    parameters: Parameters
    paths: tuple[Path, ...]
    warmings: tuple[Warming, ...]
    temperature: TemperatureSettings
    events: tuple[Event, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return self.parameters.entry_names

    @property
    def moving(self) -> tuple[str, ...]:
        entries = {change.entry for change in (*self.paths, *self.warmings)}
        return tuple(self.names[i] for i in sorted(entries))

    def values_at(self, times: Array) -> Array:
        """Value vectors (N x entries, SI)."""
        values = np.tile(self.parameters.nominal(), (len(times), 1))
        for path in self.paths:
            values[:, path.entry] += np.interp(times, path.times, path.changes)
        warmth = self.temperature_at(times)
        for warming in self.warmings:
            values[:, warming.entry] += warming.per_kelvin * (warmth - warming.reference)
        return values

    def camera_T_base_at(self, times: Array) -> Array:  # noqa: N802
        """Where what is measured in the base frame is seen (N x 4 x 4, m)."""
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        for bump in (event for event in self.events if isinstance(event, BumpSettings)):
            moved = np.eye(4)
            moved[:3, :3], moved[:3, 3] = Rotation.from_rotvec(bump.turn).as_matrix(), bump.shift
            after = times >= bump.day * DAY_S
            poses[after] = moved @ poses[after]
        for bias in (event for event in self.events if isinstance(event, BiasSettings)):
            days = np.clip(times / DAY_S, bias.day, math.inf if bias.until is None else bias.until) - bias.day
            poses[:, :3, 3] += days[:, None] * np.array(bias.per_day)
        return poses

    def temperature_at(self, times: Array) -> Array:
        """N, degrees Celsius."""
        sine, since_warmest = self.temperature, times - self.temperature.warmest * 3600.0
        mean, swing = np.full(len(times), sine.mean), np.full(len(times), sine.swing)
        for climate in (event for event in self.events if isinstance(event, ClimateSettings)):
            after = times >= climate.day * DAY_S
            mean[after], swing[after] = climate.mean, climate.swing
        return mean + swing * np.cos(2 * np.pi * since_warmest / sine.period)

    def payload_at(self, times: Array) -> Array:
        """Mass (kg) and centre in the tool frame (m) of all that hangs there, N x 4."""
        mass, moment = np.zeros(len(times)), np.zeros((len(times), 3))
        for payload in (event for event in self.events if isinstance(event, PayloadSettings)):
            last = math.inf if payload.until is None else payload.until
            there = (times >= payload.day * DAY_S) & (times < last * DAY_S)
            mass += there * payload.mass
            moment += there[:, None] * (payload.mass * np.array(payload.lever))
        return np.column_stack([mass, moment / np.where(mass > 0, mass, 1.0)[:, None]])


def moving_truth(parameters: Parameters, settings: MissionSettings, random: np.random.Generator) -> MovingTruth:
    """The truth of a mission over stated values.

    Raises:
        ConfigError: no such parameter, no single number, or a wrong unit.
    """
    warmings = [
        Warming(_entry(parameters, name), _amount(parameters, name, thermal.per_K), thermal.reference)
        for glob, thermal in settings.thermal.items()
        for name in parameters.select([glob])
    ]
    events = tuple(sorted(settings.events, key=lambda event: event.day))
    paths = (*_creeping(parameters, settings, random), *_of_events(parameters, settings))
    return MovingTruth(parameters, paths, tuple(warmings), settings.temperature, events)


def scheduled(settings: MissionSettings, joints: Sequence[str]) -> tuple[MissionEvent, ...]:
    """The events of the mission, in order; a payload that is set down is another one then. ``joints`` in order."""
    events: list[MissionEvent] = []
    for event in settings.events:
        joint, until, beside = getattr(event, "joint", ""), event.day, ""
        if isinstance(event, CreepSettings | PlaySettings | BiasSettings):
            until = settings.days if event.until is None else min(event.until, settings.days)
        if isinstance(event, BendSettings):
            beside = dict(pairwise(joints)).get(joint, "")
        events.append(MissionEvent(event.kind, event.day * DAY_S, joint, label_of(event), until * DAY_S, beside))
        if isinstance(event, PayloadSettings) and event.until is not None and event.until < settings.days:
            down = event.until * DAY_S
            events.append(MissionEvent(event.kind, down, "", "payload set down", down))
    return tuple(sorted(events, key=lambda event: event.time))


def _creeping(parameters: Parameters, settings: MissionSettings, random: np.random.Generator) -> Iterator[Path]:
    end = settings.days * DAY_S
    for glob, text in settings.creep.items():
        for name in parameters.select([glob]):
            amount, over, walks = _creep(parameters, name, text)
            entry = _entry(parameters, name)
            if not walks:
                yield Path(entry, np.array([0.0, end]), np.array([0.0, amount * end / over]))
                continue
            times = np.append(np.arange(0.0, end, _WALK_STEP_S), end)
            steps = random.normal(0, 1, len(times) - 1) * amount * np.sqrt(np.diff(times) / over)
            yield Path(entry, times, np.concatenate([[0.0], np.cumsum(steps)]))


def _of_events(parameters: Parameters, settings: MissionSettings) -> Iterator[Path]:
    """Creep and play that begin on a day, and jumps."""
    for event in settings.events:
        begin, jumps = event.day * DAY_S, dict[str, float]()
        if isinstance(event, CreepSettings | PlaySettings):
            amount, over, _ = _creep(parameters, event.parameter, event.change)
            if isinstance(event, PlaySettings) and not amount > 0:
                text = f"simulation.events: found play that changes by {event.change}, expected one that grows."
                raise ConfigError(text, hint="Write an amount above zero, such as 0.3 deg in 10 d.")
            end = (settings.days if event.until is None else event.until) * DAY_S
            times, changes = np.array([begin, end]), np.array([0.0, amount * (end - begin) / over])
            yield Path(_entry(parameters, event.parameter), times, changes)
        elif isinstance(event, SlipSettings):
            block = parameters[parameters.select([event.parameter])[0]]
            if block.unit != "rad":
                raise ConfigError(
                    f"simulation.events: {block.name} is no angle.", hint="Give the joint's offset, such as theta3."
                )
            jumps = {event.parameter: event.turned}
        elif isinstance(event, TiltedSettings):
            jumps = {block.name: turn for block, turn in zip(gravity_tilt(), event.turn, strict=True)}
        elif isinstance(event, SwapSettings | BendSettings):
            jumps = {name: _amount(parameters, name, change) for name, change in event.changes.items()}
        for name, change in jumps.items():
            yield Path(_entry(parameters, name), np.array([begin, begin]), np.array([0.0, change]))


def _creep(parameters: Parameters, name: str, text: str) -> tuple[float, float, bool]:
    """The amount (SI), over how many s, and whether it walks at random."""
    written: str | float
    written, over, walks = parsed_creep(text)
    with contextlib.suppress(ValueError):  # without a unit: the plain number that dimensionless parameters have
        written = float(written)
    return _amount(parameters, name, written), over, walks


def _entry(parameters: Parameters, name: str) -> int:
    place = parameters.entries_of(parameters.select([name])[0])
    if place.stop - place.start != 1:
        raise ConfigError(f"simulation: {name} is no single number.", hint="Only single numbers move in a mission.")
    return place.start


def _amount(parameters: Parameters, name: str, text: str | float) -> float:
    return quantity(parameters[parameters.select([name])[0]], text, None, ())
