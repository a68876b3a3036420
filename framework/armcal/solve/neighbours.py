"""Why neighbouring records miss alike: because of when they were measured, or because the arm stands alike."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from armcal.base.domains import Array

_FAR_SHARE, _FAR_RECORDS = 0.1, 20
_AS_ALIKE = 1.001
_FEWEST_PAIRS = 20
_SHIFTS = 199


@dataclass(frozen=True)
class Alikeness:
    """How residuals of pairs of records correlate.

    Attributes:
        neighbours: of records that follow one another and have a counterpart far off in the recording.
        far: of each with that counterpart, in which the arm stands at least as much alike.
        time_p: one-sided p-value that neighbours resemble each other no more than counterparts do.
        pose_p: one-sided p-value that counterparts do not resemble each other.
        pairs: how many there are.
    """

    neighbours: float
    far: float
    time_p: float
    pose_p: float
    pairs: int


def alikeness(
    residuals: Array, stance: Array, neighbours: NDArray[np.bool_], block: NDArray[np.intp]
) -> Alikeness | None:
    """Compare neighbours with counterparts.

    Args:
        residuals: whitened (records x rows), in recorded order.
        stance: how the arm stands, in numbers that residuals follow smoothly (records x features).
        neighbours: whether each record but the last is followed by its neighbour (records - 1).
        block: of each record; tests count blocks, not records.

    Returns:
        None if there are too few pairs.
    """
    spread = stance.std(axis=0)
    scaled = stance[:, spread > 1e-9 * max(float(spread.max(initial=0.0)), 1e-300)]
    scaled = scaled / scaled.std(axis=0)
    count, first = len(scaled), np.flatnonzero(neighbours)
    far = max(_FAR_RECORDS, round(_FAR_SHARE * count))
    pairs = []
    for i in first:
        distance = np.linalg.norm(scaled - scaled[i], axis=1)
        allowed = _AS_ALIKE * distance[i + 1] + 1e-9
        off = np.abs(np.arange(count) - i) >= far
        if np.any(off & (distance <= allowed)):
            pairs.append((i, int(np.argmin(np.where(off, distance, np.inf)))))
    if len(pairs) < _FEWEST_PAIRS:
        return None
    one, other = (np.array(each, dtype=np.intp) for each in zip(*pairs, strict=True))
    size = max(float(np.mean(np.sum(residuals**2, axis=1))), 1e-300)
    near = np.sum(residuals[one] * residuals[one + 1], axis=1) / size
    apart = np.sum(residuals[one] * residuals[other], axis=1) / size
    return Alikeness(
        float(near.mean()),
        float(apart.mean()),
        _above_zero(near - apart, block[one], block[other]),
        _by_shifts(residuals, one, other, far),
        len(pairs),
    )


def _by_shifts(residuals: Array, one: NDArray[np.intp], other: NDArray[np.intp], far: int) -> float:
    """One-sided p-value of the pairs' correlation: as large with the recording shifted round, against its own poses?"""
    count = len(residuals)
    shifts = np.unique(np.linspace(far, count - far, _SHIFTS).astype(np.intp))
    found = float(np.sum(residuals[one] * residuals[other]))
    shifted = [float(np.sum(residuals[(one + k) % count] * residuals[(other + k) % count])) for k in shifts]
    return (1 + int(np.sum(np.array(shifted) >= found))) / (1 + len(shifts))


def _above_zero(numbers: Array, one: NDArray[np.intp], other: NDArray[np.intp]) -> float:
    """One-sided p-value of a mean of pairs that may share the block of either member. [Cameron2011]"""
    left = numbers - numbers.mean()
    both = one * (int(other.max()) + 1) + other
    by_one, by_other, by_both = (float(np.sum(np.bincount(each, weights=left) ** 2)) for each in (one, other, both))
    variance = max(by_one, by_other, by_one + by_other - by_both)
    blocks = min(len(np.unique(one)), len(np.unique(other)))
    if blocks < 2 or not variance:
        return 1.0
    t = float(numbers.sum()) / np.sqrt(variance * blocks / (blocks - 1))
    return float(stdtr(blocks - 1, -t))
