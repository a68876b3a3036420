"""When records of a mission are made, which of them arrive, and how the rover stands meanwhile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array
from armcal.estimate.mission_truth import DAY_S
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from armcal_simulation.mission_settings import LossSettings, RecordSettings, TemperatureSettings, TiltSettings

_HOUR_S = 3600.0


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


def arriving(times: Array, losses: LossSettings, random: np.random.Generator) -> NDArray[np.bool_]:
    """Which records arrive (N): not in an hour without contact, nor if they are lost alone."""
    hours = np.floor(times / _HOUR_S).astype(int)
    silent = random.random(int(hours.max(initial=0)) + 1) < losses.hours
    return ~silent[hours] & (random.random(len(times)) >= losses.fraction)


@dataclass(frozen=True)
class Stands:
    """How the rover stood: from when (M, s), turned by which rotation vector (M x 3, rad), and as it reads that."""

    since: Array
    turns: Array
    readings: Array

    @classmethod
    def drawn(
        cls,
        days: float,
        tilt: TiltSettings,
        hours: tuple[float, float],
        gravity: Array,
        random: np.random.Generator,
    ) -> Stands:
        """Tilts about random level axes, uniform up to the most; a new one after each drive in working hours."""
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
        """level_R_rover at these times, by the true turns or by the readings."""
        return Rotation.from_rotvec(turns[np.searchsorted(self.since, times, side="right") - 1])

    def gravity(self, times: Array, level: Array, turns: Array) -> Array:
        """Gravity in the rover's base frame (3 x N), from that of the level rover (3)."""
        return np.asarray(self.at(times, turns).inv().apply(level).T)


def temperatures(times: Array, settings: TemperatureSettings) -> Array:
    """Degrees Celsius (N)."""
    since_warmest = times - settings.warmest * _HOUR_S
    return settings.mean + settings.swing * np.cos(2 * np.pi * since_warmest / settings.period)
