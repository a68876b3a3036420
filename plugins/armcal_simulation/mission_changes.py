"""How the truth moves over a mission: creep, temperature, and what happens to joints and camera."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.config.selection import quantity
from armcal.errors import ConfigError
from armcal.estimate.simulation import DAY_S, MissionEvent
from scipy.spatial.transform import Rotation

from armcal_simulation.mission_settings import (
    BumpSettings,
    MissionSettings,
    SlipSettings,
    TemperatureSettings,
    parsed_creep,
)

_WALK_STEP_S = 3600.0


@dataclass(frozen=True)
class Path:
    """A parameter's change over time: by entry, straight lines between known moments (s; SI)."""

    entry: int
    times: Array
    changes: Array


@dataclass(frozen=True)
class Step:
    """A parameter's jump: by entry, from a moment on (s; SI)."""

    entry: int
    time: float
    change: float


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
    steps: tuple[Step, ...]
    warmings: tuple[Warming, ...]
    bumps: tuple[BumpSettings, ...]
    temperature: TemperatureSettings

    @property
    def names(self) -> tuple[str, ...]:
        """The canonical entries of all parameters."""
        return self.parameters.entry_names

    @property
    def moving(self) -> tuple[str, ...]:
        """Those that change, in the order of all."""
        entries = {change.entry for change in (*self.paths, *self.steps, *self.warmings)}
        return tuple(self.names[i] for i in sorted(entries))

    def values_at(self, times: Array) -> Array:
        """Value vectors (N x entries, SI)."""
        values = np.tile(self.parameters.nominal(), (len(times), 1))
        for path in self.paths:
            values[:, path.entry] += np.interp(times, path.times, path.changes)
        for step in self.steps:
            values[:, step.entry] += np.where(times >= step.time, step.change, 0.0)
        warmth = self.temperature_at(times)
        for warming in self.warmings:
            values[:, warming.entry] += warming.per_kelvin * (warmth - warming.reference)
        return values

    def camera_T_base_at(self, times: Array) -> Array:  # noqa: N802
        """Where what is measured in the base frame is seen (N x 4 x 4, m)."""
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        for bump in self.bumps:
            moved = np.eye(4)
            moved[:3, :3], moved[:3, 3] = Rotation.from_rotvec(bump.turn).as_matrix(), bump.shift
            after = times >= bump.day * DAY_S
            poses[after] = moved @ poses[after]
        return poses

    def temperature_at(self, times: Array) -> Array:
        """N, degrees Celsius."""
        sine, since_warmest = self.temperature, times - self.temperature.warmest * 3600.0
        return sine.mean + sine.swing * np.cos(2 * np.pi * since_warmest / sine.period)


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
    bumps = [event for event in settings.events if isinstance(event, BumpSettings)]
    return MovingTruth(
        parameters,
        tuple(_paths(parameters, settings, random)),
        tuple(_steps(parameters, settings)),
        tuple(warmings),
        tuple(sorted(bumps, key=lambda bump: bump.day)),
        settings.temperature,
    )


def scheduled(settings: MissionSettings) -> tuple[MissionEvent, ...]:
    """The events within the mission, in order."""
    events: list[MissionEvent] = []
    for event in settings.events:
        if isinstance(event, SlipSettings):
            label = f"{event.joint} slips by {math.degrees(_slip(event)):.1f} deg"
        elif isinstance(event, BumpSettings):
            shift, turn = (float(np.linalg.norm(vector)) for vector in (event.shift, event.turn))
            label = f"camera bumped by {1000 * shift:.1f} mm, {math.degrees(turn):.1f} deg"
        else:
            label = f"servo of {event.joint} replaced"
        if event.day < settings.days:
            events.append(MissionEvent(event.kind, event.day * DAY_S, getattr(event, "joint", ""), label))
    return tuple(sorted(events, key=lambda event: event.time))


def _slip(event: SlipSettings) -> float:
    return event.angle if event.angle is not None else 2 * math.pi * (event.teeth or 0) / event.of_teeth


def _paths(parameters: Parameters, settings: MissionSettings, random: np.random.Generator) -> Iterator[Path]:
    end = settings.days * DAY_S
    for glob, text in settings.creep.items():
        written: str | float
        written, over, walks = parsed_creep(text)
        with contextlib.suppress(ValueError):  # without a unit: the plain number that dimensionless parameters have
            written = float(written)
        for name in parameters.select([glob]):
            amount = _amount(parameters, name, written)
            entry = _entry(parameters, name)
            if not walks:
                yield Path(entry, np.array([0.0, end]), np.array([0.0, amount * end / over]))
                continue
            times = np.append(np.arange(0.0, end, _WALK_STEP_S), end)
            steps = random.normal(0, 1, len(times) - 1) * amount * np.sqrt(np.diff(times) / over)
            yield Path(entry, times, np.concatenate([[0.0], np.cumsum(steps)]))


def _steps(parameters: Parameters, settings: MissionSettings) -> Iterator[Step]:
    for event in settings.events:
        if isinstance(event, BumpSettings):
            continue
        if isinstance(event, SlipSettings):
            block = parameters[parameters.select([event.parameter])[0]]
            if block.unit != "rad":
                raise ConfigError(
                    f"simulation.events: {block.name} is no angle.", hint="Give the joint's offset, such as theta3."
                )
            yield Step(_entry(parameters, event.parameter), event.day * DAY_S, _slip(event))
            continue
        for name, change in event.changes.items():
            yield Step(_entry(parameters, name), event.day * DAY_S, _amount(parameters, name, change))


def _entry(parameters: Parameters, name: str) -> int:
    """Where a parameter of one number stands among the entries."""
    place = parameters.entries_of(parameters.select([name])[0])
    if place.stop - place.start != 1:
        raise ConfigError(f"simulation: {name} is no single number.", hint="Only single numbers move in a mission.")
    return place.start


def _amount(parameters: Parameters, name: str, text: str | float) -> float:
    return quantity(parameters[parameters.select([name])[0]], text, None, ())
