"""Instruments that read the same of many points in one record, such as a camera of the corners of a board."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import casadi as ca
import numpy as np
from typing_extensions import override

from armcal.arm.assembly import ArmState
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.se3 import Expression
from armcal.measure.instrument import Instrument
from armcal.measure.measurement import Channel


@dataclass(frozen=True)
class Proposal:
    """Where a measurement's own parameters may start.

    Attributes:
        values: canonical entries by local name; none where nothing could be found.
        open: what the records leave open, a sentence; empty if nothing.
        close: which further records would close it, a sentence.
        undetermined: local names of the parameters that are left open.
    """

    values: Mapping[str, Array] = field(default_factory=dict)
    open: str = ""
    close: str = ""
    undetermined: tuple[str, ...] = ()


@dataclass(frozen=True)
class Reading:
    """What a measurement read in N records, and where its arm was.

    Attributes:
        frames: base_T_tool of each record (N x 4 x 4, m) as ``tool``, and ``base``; for one that is ``Carried``, the
            poses of its carriers.
        channels: each channel (N; NaN where it is missing), by local name.
        values: canonical entries of all its parameters, by local name.
        free: local names of those that may move.
        ids: what each record is called.
    """

    frames: Mapping[str, Array]
    channels: Mapping[str, Array]
    values: Mapping[str, Array]
    free: frozenset[str]
    ids: tuple[str, ...]


@runtime_checkable
class Proposing(Protocol):
    """What a measurement provides beside the rest if it finds its own parameters without a fit: a hand-eye pose."""

    def propose(self, reading: Reading) -> Proposal:
        """Its parameters from what it read, those that are free."""


@runtime_checkable
class Certifying(Protocol):
    """What a measurement provides beside the rest if it can show that no other answer is better."""

    def certificate(self, reading: Reading) -> str:
        """Whether its parameters are the best there are, as a sentence; empty if there is nothing to show."""


@runtime_checkable
class PointMeasurement(Protocol):
    """What a measurement provides beside the rest if it reads the same of each of many points.

    Its channels and its residual go point by point, ``u_0, v_0, u_1, v_1, ...``; its residual is measured minus
    predicted. A record may lack points: one of which a channel is missing (NaN) costs its rows, not the record.
    """

    @property
    def points(self) -> Array:
        """What distinguishes the points (P x k), in a number or several each."""

    def point_channels(self) -> Sequence[Channel]:
        """What is read of one point."""

    def point_outputs(
        self, arms: Mapping[str, ArmState], values: Mapping[str, Expression], point: Expression
    ) -> Expression:
        """What each of these would read without noise, of a point (k numbers)."""


@runtime_checkable
class LimitedView(Protocol):
    """What a measurement of many points provides beside the rest if it does not see all of them from everywhere."""

    def point_margin(
        self, arms: Mapping[str, ArmState], values: Mapping[str, Expression], point: Expression
    ) -> Expression:
        """A number above zero where a point is in view."""

    def visible(self, margins: Array) -> Mask:
        """Which points can be read (P x N) with these margins (P x N): of some boards all or none."""


@runtime_checkable
class Rendering(Protocol):
    """What a measurement of points in images provides beside the rest if it can draw the images."""

    def rendered(self, frames: Mapping[str, Array], values: Mapping[str, Array]) -> Iterator[bytes]:
        """An image file (PNG) of each record.

        Args:
            frames: base_T_frame of each record (N x 4 x 4, m), by the name of the frame, as in ``Proposing``.
            values: canonical entries of its parameters, by local name.

        Raises:
            PluginError: a library is not there.
        """


class PointInstrument(Instrument):
    """A base for such instruments of one arm: points, their channels, outputs and noise are all that differs."""

    @property
    @abstractmethod
    def points(self) -> Array:
        """What distinguishes the points (P x k)."""

    @abstractmethod
    def point_channels(self) -> Sequence[Channel]:
        """What is read of one point."""

    @abstractmethod
    def point_outputs(
        self, arms: Mapping[str, ArmState], values: Mapping[str, Expression], point: Expression
    ) -> Expression:
        """What each of these would read without noise, of a point (k numbers)."""

    @abstractmethod
    def point_noise(self) -> Sequence[float]:
        """Standard deviation of each of these."""

    @property
    def point_names(self) -> Sequence[str]:
        return [str(number) for number in range(len(self.points))]

    @override
    def channels(self) -> Sequence[Channel]:
        return [Channel(f"{c.name}_{name}", c.dimension) for name in self.point_names for c in self.point_channels()]

    @override
    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Expression]) -> Mapping[str, Expression]:
        shown = ca.vertcat(*(self.point_outputs(arms, values, ca.SX(list(point))) for point in self.points))
        return {channel.name: shown[i] for i, channel in enumerate(self.channels())}

    @override
    def noise(self) -> Sequence[float]:
        return tuple(self.point_noise()) * len(self.points)


def spread_points(points: Array, most: int) -> Indices:
    """At most so many of the points (N x k), in order: each next one as far as can be from those before it."""
    if len(points) <= most:
        return np.arange(len(points))
    chosen, apart = [0], np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < most:
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.sort(np.array(chosen, dtype=np.intp))
