"""What a simulated mission gives beside its records: the truth at any time, and what was scheduled to happen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.estimate.simulation import SimulationRequest

DAY_S = 86400.0
EventKind = Literal["slip", "swap", "bump"]


@dataclass(frozen=True)
class MissionEvent:
    """Something that happened to the arm or the camera.

    Attributes:
        kind: ``slip`` (a horn slipped on its shaft), ``swap`` (a servo was replaced), ``bump`` (the camera moved).
        time: s since the mission began.
        joint: whose, ``arm.q3``; empty for the camera.
        label: a few words for figures and tables.
    """

    kind: EventKind
    time: float
    joint: str
    label: str


class MissionTruth(Protocol):
    """The truth at any time of the mission (s since it began)."""

    @property
    def names(self) -> tuple[str, ...]:
        """The canonical entries of all parameters."""

    @property
    def moving(self) -> tuple[str, ...]:
        """Those that change over the mission."""

    def values_at(self, times: Array) -> Array:
        """Value vectors (N x entries, SI)."""

    def camera_T_base_at(self, times: Array) -> Array:  # noqa: N802
        """Where what is measured in the base frame is seen, once the camera has moved (N x 4 x 4, m)."""

    def temperature_at(self, times: Array) -> Array:
        """N, degrees Celsius."""


@dataclass(frozen=True)
class Mission:
    """A simulated mission.

    Attributes:
        records: what arrived, in order.
        times: of the records, s since the mission began (N).
        outliers: which measurements were made wrong (N).
        truth: at any time.
        events: in order.
        power_cuts: s since the mission began, in order.
        began: what the records' clock showed when the mission began, s.
        seconds: how long it lasts.
        lost: how many records never arrived.
    """

    records: Dataset
    times: Array
    outliers: NDArray[np.bool_]
    truth: MissionTruth
    events: tuple[MissionEvent, ...]
    power_cuts: tuple[float, ...]
    began: float
    seconds: float
    lost: int


@runtime_checkable
class MissionSimulator(Protocol):
    """A simulator that knows the truth over time."""

    def simulate(self, request: SimulationRequest) -> Dataset:
        """The records alone."""

    def mission(self, request: SimulationRequest) -> Mission:
        """Records and truth; the same request gives the same mission."""
