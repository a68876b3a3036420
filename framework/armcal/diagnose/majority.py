"""Do some records contradict the others? A fit to the majority leaves them far off, and the others near."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armcal.base.domains import Array
from armcal.diagnose.fit_rows import FitRows

LEAST_SHARE = 0.1
"""Of the records: fewer than these are outliers, which the other tests name one by one."""
FAR, FAR_IN_NOISE = 8.0, 5.0
"""Of the lower quartile of all residuals, and of the declared noise: what is far. Of three equal normal coordinates
one record in 10^15 is."""
LEAST_SCALE = 1.5
"""Residuals in units of the declared noise: a tenth of the records five standard deviations off make more."""
_ROUNDS = 60
_QUARTILE = 0.25
_SMALLEST = 1e-9
_RUN = 0.9
"""So much of a run of records from one place on is far, and so little of those before, where something moved there."""


@dataclass(frozen=True)
class Minority:
    """Records that contradict the others.

    Attributes:
        far: which of the records looked at.
        typical_mm: of those that agree, what they are off by (median).
        far_mm: of those that do not, likewise.
        since: the first of them in the recording, if it is all those from there on (or up to there); else None.
    """

    far: NDArray[np.intp]
    typical_mm: float
    far_mm: float
    since: int | None


def minority(rows: FitRows, noise_scale: float, position: NDArray[np.intp]) -> Minority | None:
    """The records that a fit to the majority leaves far off, if they are many; None if there is no such split.

    The fit minimises the sum of residual lengths, to first order from the estimate, by weights that are their inverse
    [Huber1981]: up to half of the records may be off by anything.

    Args:
        rows: of the fit, records of any weight.
        noise_scale: of the estimate; a fit whose residuals are as small as their noise has no such records.
        position: how many records were recorded before each (N).
    """
    acting = np.flatnonzero(_lengths(rows, rows.residual) > 0)
    if noise_scale < LEAST_SCALE or len(acting) < 1 / LEAST_SHARE:
        return None
    data, weights = len(rows.record_of), np.ones(len(rows.residual))
    for _ in range(_ROUNDS):
        step = np.linalg.lstsq(rows.slopes * weights[:, None], -rows.residual * weights, rcond=1e-9)[0]
        residual = rows.residual + rows.slopes @ step
        lengths = _lengths(rows, residual)
        floor = max(_SMALLEST, 0.1 * float(np.quantile(lengths, _QUARTILE)))
        weights[:data] = 1 / np.sqrt(np.maximum(lengths, floor))[rows.record_of]
    limit = max(FAR * float(np.quantile(lengths[acting], _QUARTILE)), FAR_IN_NOISE)
    far, near = acting[lengths[acting] > limit], acting[lengths[acting] <= limit]
    if len(far) < LEAST_SHARE * len(acting) or len(far) > len(near):
        return None
    sizes = rows.errors(residual) * 1000.0
    return Minority(far, float(np.median(sizes[near])), float(np.median(sizes[far])), _since(far, near, position))


def _lengths(rows: FitRows, residual: Array) -> Array:
    return np.asarray(np.linalg.norm(residual[rows.by_record], axis=1))


def _since(far: NDArray[np.intp], near: NDArray[np.intp], position: NDArray[np.intp]) -> int | None:
    """The far record from which on (in recorded order) nearly all are far, and before which nearly none is."""
    order = np.sort(np.concatenate([position[far], position[near]]))
    is_far = np.isin(order, position[far])
    if not is_far[-1]:
        return None
    after = np.cumsum(is_far[::-1])[::-1]
    count = np.arange(len(order), 0, -1)
    best = int(np.argmax(after - (count - after)))
    inside, outside = float(np.mean(is_far[best:])), float(np.mean(is_far[:best])) if best else 1.0
    return int(order[best]) if inside >= _RUN and outside <= 1 - _RUN else None
