"""Records in recorded order whose errors resemble their neighbours': resampled in blocks, so that this shows.

Circular blocks: the last records have the first as neighbours, so that every record is drawn as often. [Politis1992]
"""

import math
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from armcal.base.domains import Array

BlockLength = int | Literal["auto"]
_SIGNIFICANT = 2.0
_FEW = 8
"""Series shorter than this do not determine their own correlation."""


def automatic_block_length(series: Array) -> int:
    """The block length for a series (..., N), the longest of its rows'. [Politis2004] [Patton2009]

    Autocovariances count up to twice the lag behind which they are noise, by a flat-top window.
    """
    rows = np.atleast_2d(series)
    return max((_row_length(row[np.isfinite(row)]) for row in rows), default=1)


def _row_length(row: Array) -> int:
    count = len(row)
    centred = row - row.mean() if count else row
    if count < _FEW or not np.any(np.abs(centred) > 0):
        return 1
    window = max(5, math.ceil(math.sqrt(math.log10(count))))
    most_lag = min(math.ceil(math.sqrt(count)) + window, count - 1)
    covariance = np.array([centred[lag:] @ centred[: count - lag] / count for lag in range(most_lag + 1)])
    # The lag behind which a window of them is no larger than chance; the last larger one if there is none.
    large = np.abs(covariance[1:] / covariance[0]) >= _SIGNIFICANT * math.sqrt(math.log10(count) / count)
    quiet = np.flatnonzero(~sliding_window_view(large, window).any(axis=1))
    last = int(quiet[0]) if len(quiet) else int(np.flatnonzero(large).max(initial=0)) + 1
    reach = min(2 * max(last, 1), most_lag)
    lags = np.arange(1, reach + 1)
    flat_top = np.minimum(1.0, 2 * (1 - lags / reach))
    weighted = flat_top * covariance[1 : reach + 1]
    spectrum = covariance[0] + 2 * weighted.sum()
    slope = 2 * (lags @ weighted)
    if spectrum <= 0:
        return 1
    length = (1.5 * (slope / spectrum) ** 2 * count) ** (1 / 3)
    most = min(3 * math.sqrt(count), count / 3)
    return int(np.clip(round(length), 1, max(1, math.floor(most))))


def standard_error_of_mean(series: Array, block: int) -> float:
    """The standard deviation of the mean of a series (N) over its resamples in circular blocks, in closed form.

    That of one block's mean, times the square root of block length over N; corrected so that blocks of one record
    give the usual standard error of independent ones.
    """
    count = len(series)
    if count < 2:
        return float("nan")
    length = min(block, count)
    if length == count:
        return float("nan")
    around = np.concatenate([series, series[: length - 1]])
    sums = np.cumsum(np.concatenate([[0.0], around]))
    means = (sums[length:] - sums[:-length]) / length
    return float(np.sqrt(np.var(means) * length / count) * np.sqrt(count / (count - length)))


def draw_weights(count: int, block: int, random: np.random.Generator) -> Array:
    """How often each record is drawn (N, summing to N): circular blocks, the last one cut to fit."""
    length = min(block, count)
    starts = random.integers(0, count, -(-count // length))
    drawn: NDArray[np.intp] = (starts[:, None] + np.arange(length)[None, :]).ravel()[:count] % count
    return np.bincount(drawn, minlength=count).astype(float)
