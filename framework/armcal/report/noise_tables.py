"""The report's tables of suspicious records and of variance components, as rows of finished text."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armcal.estimate.variance import Component
from armcal.report.numbers import NONE, fixed
from armcal.run.noise import NoiseResult

_MM = 1000.0


@dataclass(frozen=True)
class SuspiciousRow:
    """A record beyond its limit."""

    row: str
    record_id: str
    measurement: str
    deviations: str
    limit: str
    error: str
    fate: str


@dataclass(frozen=True)
class ScatterRow:
    """A variance component in a customary unit."""

    name: str
    share: str
    sd: str
    unit: str
    interval: str
    rms: str


def suspicious_rows(noise: NoiseResult, most: int) -> tuple[SuspiciousRow, ...]:
    """The farthest first."""
    return tuple(
        SuspiciousRow(
            str(s.row) if s.row else NONE,
            s.record_id,
            s.measurement,
            fixed(s.deviations, 1),
            fixed(s.limit, 1),
            fixed(s.error_mm, 2),
            s.fate,
        )
        for s in noise.suspicious[:most]
    )


def scatter_rows(noise: NoiseResult) -> tuple[ScatterRow, ...]:
    """The largest share first; empty if none was estimated."""
    if noise.components is None:
        return ()
    return tuple(_scatter(c) for c in sorted(noise.components.components, key=lambda c: -c.share))


def _scatter(c: Component) -> ScatterRow:
    factor, unit = {"rad": (180 / np.pi, "deg"), "m": (_MM, "mm")}.get(c.unit, (1.0, "\u00d7 declared noise"))
    interval = f"{fixed(factor * c.lower, 3)} to {fixed(factor * c.upper, 3)}"
    return ScatterRow(c.name, f"{100 * c.share:.1f} %", fixed(factor * c.sd, 3), unit, interval, fixed(_MM * c.rms, 3))
