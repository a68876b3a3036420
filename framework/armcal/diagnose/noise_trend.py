"""Whether the scatter of residuals depends on something: time, place, a joint's angle, a torque.

Squares of residuals, leverage counted, are regressed on one thing after another [Koenker1981]; all of them at once keep
their level (Bonferroni). What does as well as the best, within 20 to 1, is named beside it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, fdtrc

from armcal.base.arrays import Array, Indices
from armcal.diagnose.dependences import Records
from armcal.diagnose.fit_rows import FitRows
from armcal.diagnose.smooth import CLEAR, Kernels, smooth
from armcal.problem.motion import recorded_order

LEVEL = 0.05
LACK = 0.01
TIMES_REPEATS = 3.0
"""How many times what repeats scatter residuals are, for the rest to be worth a word: no model is perfect."""
_FEWEST_REPEATS = 5
_MM = 1000.0


@dataclass(frozen=True)
class NoiseTrend:
    """What the scatter depends on.

    Attributes:
        words: as the end of a sentence.
        p_value: that it does not, over all things looked at.
        low, high: scatter in units of the declared noise, in the third of the records with the least and most of it.
        alternatives: what else may be meant, the most likely first.
    """

    words: str
    p_value: float
    low: float
    high: float
    alternatives: tuple[str, ...]


def noise_trend(residual: Array, basis: Array, by_record: Indices, here: Records, place: Array) -> NoiseTrend | None:
    """What the scatter of a residual (rows, whitened) depends on; None where nothing shows.

    ``basis`` is what the fit takes up (rows x n), ``place`` what instruments read (3 x N; m), or nothing (0 x N).
    """
    leverage = np.sum(basis[by_record] ** 2, axis=2)
    squares = np.mean(residual[by_record] ** 2 / np.maximum(1 - leverage, 0.05), axis=1)
    tried = [(words, f) for words, f in _features(here, place) if np.ptp(f) > 1e-9 * max(1.0, float(np.abs(f).max()))]
    spread = float(squares.std())
    if not tried or not spread:
        return None
    explained = np.array([np.corrcoef(squares, f)[0, 1] ** 2 for _, f in tried])
    best, count = int(np.argmax(explained)), len(squares)
    p = min(1.0, len(tried) * float(chdtrc(1, count * explained[best])))
    if p > LEVEL:
        return None
    gains = -0.5 * count * np.log1p(-np.minimum(explained, 1 - 1e-12))
    close = [i for i in np.argsort(-gains) if i != best and gains[i] > gains[best] - CLEAR]
    thirds = np.array_split(np.argsort(tried[best][1], kind="stable"), 3)
    low, high = (float(np.sqrt(np.mean(squares[part]))) for part in (thirds[0], thirds[-1]))
    return NoiseTrend(tried[best][0], p, low, high, tuple(tried[i][0] for i in close))


def _features(here: Records, place: Array) -> Iterator[tuple[str, Array]]:
    yield "the recorded order", recorded_order(here.dataset)
    for axis, coordinate in zip("xyz", place, strict=False):
        yield f"the coordinate {axis}", coordinate
    if len(place):
        yield "the distance from the instrument", np.linalg.norm(place, axis=0)
    for channel in here.motion.channels:
        joint = channel.rpartition(".")[2]
        command = np.nan_to_num(here.dataset.column(channel))
        yield f"the command of {joint}", command
        yield (
            f"how far {joint} is from the middle of its commands",
            np.abs(command - (command.min() + command.max()) / 2),
        )
    for loads in here.motion.loads.values():
        for number, effort in enumerate(loads.efforts, start=1):
            yield f"the load on joint {number}", np.abs(np.nan_to_num(effort))


@dataclass(frozen=True)
class Repeats:
    """What records of one pose say of noise.

    Attributes:
        scatter_mm: of a record about the mean of its pose (root mean square).
        left_mm: of all residuals (root mean square).
        records, poses: how many repeats there are, and of how many poses.
        p_value: that residuals are as repeats have them.
        shared: whether the means of poses nearby miss alike.
    """

    scatter_mm: float
    left_mm: float
    records: int
    poses: int
    p_value: float
    shared: bool

    @property
    def exceeded(self) -> bool:
        return self.p_value < LACK and self.left_mm > TIMES_REPEATS * self.scatter_mm


def repeats_of(residual: Array, basis: Array, rows: FitRows, pose: Indices, kernels: Kernels) -> Repeats | None:
    """Of a fit's residual (rows), which took up a basis (rows x n); None where hardly a ``pose`` (N) was repeated."""
    by_record, size = rows.by_record, np.bincount(pose)
    again = int(np.sum(size - 1))
    if again < _FEWEST_REPEATS:
        return None
    means = np.zeros((len(size), len(pose)))
    means[pose, np.arange(len(pose))] = 1 / size[pose]
    own, off = means @ residual[by_record], np.zeros_like(residual)
    off[by_record] = residual[by_record] - own[pose]
    acting = int(np.sum(np.any(residual[by_record] != 0, axis=0)))
    spare, pure = again * acting, float(off @ off)
    lacking = len(pose) * acting - basis.shape[1] - spare
    lack = max(float(np.sum(residual[by_record] ** 2)) - pure, 0.0)
    ratio = lack / max(lacking, 1) / max(pure / spare, 1e-300)
    return Repeats(
        float(np.sqrt(np.sum(rows.errors(off) ** 2) / again)) * _MM,
        float(np.sqrt(np.mean(rows.errors(residual) ** 2))) * _MM,
        again + int(np.sum(size > 1)),
        int(np.sum(size > 1)),
        float(fdtrc(lacking, spare, ratio)) if lacking > 0 else 1.0,
        _shared(own, np.einsum("gn,nrc->grc", means, basis[by_record]), pose, kernels),
    )


def _shared(own: Array, taken_up: Array, pose: Indices, kernels: Kernels) -> bool:
    within, first = np.linalg.qr(taken_up.reshape(own.size, -1))[0], np.unique(pose, return_index=True)[1]
    if within.shape[1] >= own.size:
        return False
    left, places = own.ravel() - within @ (within.T @ own.ravel()), np.arange(own.size).reshape(own.shape)
    of_poses = Kernels(tuple(kernel[np.ix_(first, first)] for kernel in kernels.kernels))
    return bool(smooth(left, within, places, of_poses).evidence > CLEAR)
