"""Sources of records whose content is known, for checks on readers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from armcal.base.domains import Array
from armcal.measure.measurement import Measurement
from armcal.measure.reader import ReadRequest, requested_channels
from armcal.testing.planar import ARM, QUATERNION, TRACKER, WALLS, Body, Tip, Walls, planar_arms
from armcal.testing.results import expect

_ANGLES_DEG = np.array([(10.0, -20.0), (30.0, 45.0), (-60.0, 5.0), (90.0, 120.0)])
_LINKS_M = (0.3, 0.25)
_DIGITS = 6


@dataclass(frozen=True)
class Source:
    """Files, and what they say to whom.

    Attributes:
        files: by name.
        path: which of them the setting ``path`` names; all of them, the folder, if it is empty.
        channels: the records in SI, by channel.
        measurements: what is measured, by instance.
    """

    files: Mapping[str, bytes]
    path: str
    channels: Mapping[str, Array]
    measurements: Mapping[str, Measurement]

    @property
    def count(self) -> int:
        """How many records."""
        return len(next(iter(self.channels.values())))

    @property
    def request(self) -> ReadRequest:
        """For a planar arm called ``arm``, and what is measured."""
        return request(self.measurements)


def request(measurements: Mapping[str, Measurement]) -> ReadRequest:
    """For a planar arm called ``arm``."""
    arms = planar_arms([ARM])
    return ReadRequest(arms, measurements, requested_channels(arms, measurements, measured=True))


def sources(made: Any) -> Iterator[Source]:
    """A component's own ``EXAMPLE_SOURCE``, else plain tables of a tip and of a body."""
    own = getattr(made, "EXAMPLE_SOURCE", None)
    if own is None:
        yield _table({TRACKER: Tip()}, ())
        yield _table({TRACKER: Body()}, QUATERNION)
        return
    expect(
        isinstance(own, Mapping) and set(own) == {"files", "path", "channels"},
        f"found EXAMPLE_SOURCE = {own!r}, expected a mapping with files, path and channels",
    )
    files = {name: text.encode() if isinstance(text, str) else text for name, text in own["files"].items()}
    channels = {name: np.array(values, dtype=float) for name, values in own["channels"].items()}
    measures = any(name.startswith(f"{TRACKER}.") for name in channels)
    yield Source(files, own["path"], channels, {TRACKER: Tip()} if measures else {WALLS: Walls()})


def _table(measurements: Mapping[str, Measurement], more: tuple[str, ...]) -> Source:
    """Columns by name with their unit, as ``csv`` reads them; the arm is where its nominal parameters say."""
    first, both = np.radians(_ANGLES_DEG[:, 0]), np.radians(_ANGLES_DEG.sum(axis=1))
    upper, fore = _LINKS_M
    x, z = upper * np.cos(first) + fore * np.cos(both), -upper * np.sin(first) - fore * np.sin(both)
    tips = np.round(1000 * np.stack([x, 0 * x, z], axis=1), _DIGITS)
    turned = np.stack([np.cos(both / 2), 0 * both, np.sin(both / 2), 0 * both], axis=1)
    turned *= np.where(turned[:, :1] < 0, -1, 1)
    cells = np.hstack([_ANGLES_DEG, tips, turned[:, : len(more)]])
    header = ",".join(("id", "q1_deg", "q2_deg", "x_mm", "y_mm", "z_mm", *more))
    rows = [",".join((f"r{i}", *(f"{float(cell)!r}" for cell in row))) for i, row in enumerate(cells)]
    names = (f"{ARM}.q1", f"{ARM}.q2", *(f"{TRACKER}.{name}" for name in ("x", "y", "z", *more)))
    factors = (*(math.pi / 180,) * 2, *(1e-3,) * 3, *(1.0,) * len(more))
    channels = {name: factor * cells[:, i] for i, (name, factor) in enumerate(zip(names, factors, strict=True))}
    return Source({"data.csv": "\n".join([header, *rows, ""]).encode()}, "data.csv", channels, measurements)
