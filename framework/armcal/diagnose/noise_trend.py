"""Whether the scatter of residuals depends on something: time, place, a joint's angle, a torque.

Squares of residuals, leverage counted, are regressed on one thing after another [Koenker1981]; all of them at once keep
their level (Bonferroni). What does as well as the best, within 20 to 1, is named beside it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from armcal.base.arrays import Array, Indices
from armcal.diagnose.dependences import Records
from armcal.diagnose.smooth import CLEAR
from armcal.problem.motion import recorded_order

LEVEL = 0.05


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
