"""The last readings of a stream, and the posture that they show while nothing moves."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from armcal.arm.assembly import Arm, command_channels
from armcal.base.settings import Angle, Duration, Length, Settings
from armcal.base.units import display_unit, to_unit
from armcal.devices.live import JointSample
from pydantic import Field, model_validator

_FULL_TURN = 2 * math.pi * (1 + 1e-9)
_LONG_ENOUGH = 0.8  # Of the window: readings need not fall on its ends
_MOST = 100_000


@dataclass(frozen=True)
class JointKinds:
    """What the channels of some arms are."""

    dimensions: Mapping[str, str]  # ``angle`` or ``length`` by channel, in order
    endless: frozenset[str]  # channels of joints that may turn on and on

    @classmethod
    def of(cls, arms: Mapping[str, Arm]) -> Self:
        dimensions = command_channels(arms)
        endless = {f"{name}.{j.name}" for name, arm in arms.items() for j in arm.nominal_chain.joints if j.endless}
        return cls(dimensions, frozenset(endless & set(dimensions)))

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(self.dimensions)

    def fault_of(self, angles: Mapping[str, float]) -> str:
        """Why these cannot be joint angles, a sentence; empty if they can."""
        lacking = [channel for channel in self.dimensions if channel not in angles]
        if lacking:
            return f"the readings have no {lacking[0]}: found {len(angles)} joints, expected {len(self.dimensions)}."
        for channel, kind in self.dimensions.items():
            value = angles[channel]
            if not math.isfinite(value):
                return f"the reading of {channel} is {value}, which is no angle."
            if kind == "angle" and channel not in self.endless and abs(value) > _FULL_TURN:
                return (
                    f"{channel} would stand at {value:.6g} rad, more than one turn (2 pi rad): does the stream give "
                    "degrees, or turns of the motor?"
                )
        return ""


@dataclass(frozen=True)
class Mean:
    """The readings of a window."""

    angles: Mapping[str, float]  # means by channel
    spread: float  # of the joint that moved most (rad or m)
    readings: int
    labels: Mapping[str, str]
    stamp: float | None


class SampleWindow:
    """The newest readings; times are the source's own where it gives them.

    Args:
        kinds: of the joints.
        length: how much is kept (s).
        spread, sliding_spread: how far turning and sliding joints may move in it (rad, m).
        least: how many readings it needs.
    """

    def __init__(self, kinds: JointKinds, length: float, spread: float, sliding_spread: float, least: int) -> None:
        self._kinds, self._length, self._least = kinds, length, least
        limits = {"angle": spread, "length": sliding_spread}
        self._limits = np.array([limits[kind] for kind in kinds.dimensions.values()])
        self._samples: deque[tuple[float, JointSample]] = deque(maxlen=_MOST)

    def add(self, sample: JointSample) -> None:
        """The next reading; where time or labels jump, those before are forgotten."""
        at = sample.arrived if sample.stamp is None else sample.stamp
        if self._samples:
            last_at, last = self._samples[-1]
            is_other = last.labels != sample.labels or (last.stamp is None) != (sample.stamp is None)
            if is_other or not 0 <= at - last_at <= self._length:
                self._samples.clear()
        self._samples.append((at, sample))
        while at - self._samples[0][0] > self._length * (1 + 1e-9):
            self._samples.popleft()

    def clear(self) -> None:
        self._samples.clear()

    @property
    def is_filling(self) -> bool:
        lasts = self._samples[-1][0] - self._samples[0][0] if self._samples else 0.0
        return len(self._samples) < self._least or lasts < _LONG_ENOUGH * self._length

    def mean(self) -> Mean | str:
        """The posture, or why there is none: a sentence."""
        count = len(self._samples)
        if not count:
            return "no joint readings came."
        lasts = self._samples[-1][0] - self._samples[0][0]
        if self.is_filling:
            return (
                f"only {count} readings over {lasts:.2f} s are there, expected {self._least} over "
                f"{self._length:g} s: wait, or let the source send more often."
            )
        newest = self._samples[-1][1]
        rows = np.array([[s.angles[channel] for channel in self._kinds.channels] for _, s in self._samples])
        spreads = np.ptp(rows, axis=0)
        worst = int(np.argmax(spreads / self._limits))
        if spreads[worst] > self._limits[worst]:
            channel = self._kinds.channels[worst]
            unit = display_unit(self._kinds.dimensions[channel]).name
            moved, allowed = (f"{to_unit(amount[worst], unit):.3g} {unit}" for amount in (spreads, self._limits))
            return (
                f"the arm does not stand still: {channel} moved by {moved} within {self._length:g} s "
                f"(allowed: {allowed})."
            )
        return Mean(
            angles=dict(zip(self._kinds.channels, rows.mean(axis=0).tolist(), strict=True)),
            spread=float(spreads[worst]),
            readings=count,
            labels=newest.labels,
            stamp=None if newest.stamp is None else float(np.mean([at for at, _ in self._samples])),
        )


class RecordingSettings(Settings):
    """How postures are captured.

    Attributes:
        spread: no turning joint moves by more within the window; ``sliding_spread``: no sliding one.
        alike: postures of one group whose joints all differ by less are reported as nearly the same.
        groups: names that the digits stand for, ``[front/hole_0, front/hole_1]``; an asterisk keeps what was named
            before. Without any, those that the measurements' settings speak of.
    """

    window: Duration = 0.5  # a posture is the mean of the readings of so long
    samples: Annotated[int, Field(ge=2)] = 5  # it has at least so many
    spread: Angle = math.radians(0.2)
    sliding_spread: Length = 0.0002
    stale: Duration = 1.0  # a stream that is silent for longer does not show where the arm stands now
    rest: Duration = 1.0  # with ``--capture still``, how long the arm must stand before it is captured by itself
    moved: Angle = math.radians(5.0)  # and how far a joint must have gone since the posture before
    alike: Angle = math.radians(2.0)
    groups: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _above_zero(self) -> Self:
        for name in ("window", "spread", "sliding_spread", "stale", "rest", "moved", "alike"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} is not above zero")
        return self
