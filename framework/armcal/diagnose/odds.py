"""Which of several causes residuals speak for: odds among all that were tried, and something that was not.

A cause is a set of columns; the logarithm of its odds against noise is that of the Schwarz criterion [Schwarz1978]. A
smooth function of the pose, or of time, stands for what is not among the causes, with the odds of its marginal
likelihood, and is as likely as a cause that leaves more than the declared noise. Several causes at once are judged one
by one, each in the presence of the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from armcal.base.arrays import Array, Indices
from armcal.diagnose.dependences import Dependence
from armcal.diagnose.score_tests import own_basis
from armcal.diagnose.smooth import CLEAR, IMITATED, Kernels, smooth

UNLISTED = "something that is none of these"
CHANCE = "nothing: it may be chance"
NOISE_LEVEL = 0.05
NEGLIGIBLE = 0.1
"""Of what causes take up: less than this may be what is not linear in them."""
CHANGING = "something that changes with time and is none of these"


@dataclass(frozen=True)
class Odds:
    """What speaks for one cause beside others.

    Attributes:
        share: of the odds of all causes, of what is not among them, and of chance, the cause's own.
        alternatives: in words, those that it does not beat 20 to 1, the most likely first.
        chance: the share of nothing at all.
    """

    share: float
    alternatives: tuple[str, ...]
    chance: float


@dataclass(frozen=True)
class Contest:
    """All causes for the residuals of a fit.

    Attributes:
        causes: that were tried.
        columns: of each (rows x k).
        residual: of the fit (rows).
        basis: of what the fit takes up (rows x n), orthonormal.
        by_record: the data's rows as (records x rows a record), in recorded order.
        fold: of each row, which part of the recording judges it.
        pose, time: correlations of the records.
    """

    causes: Sequence[Dependence]
    columns: Sequence[Array]
    residual: Array
    basis: Array
    by_record: Indices
    fold: Indices
    pose: Kernels
    time: Kernels

    @cached_property
    def names(self) -> tuple[str, ...]:
        """What stands for one cause: a jump is one wherever it is, a drift of the whole any function of time."""
        names = []
        for cause in self.causes:
            once = f"{cause.kind} {cause.subject}" if cause.jumps else cause.words
            names.append(CHANGING if cause.kind == "order" and not cause.subject else once)
        return tuple(names)

    def beside(self, others: Sequence[int]) -> tuple[Array, Array]:
        basis = self.basis
        for other in others:
            basis = np.hstack([basis, own_basis(self.columns[other], basis)[0]])
        added = basis[:, self.basis.shape[1] :]
        return self.residual - added @ (added.T @ self.residual), basis

    def time_imitated(self) -> float:
        over_time = smooth(self.residual, self.basis, self.by_record, self.time).function
        return self.pose.imitate(over_time[self.by_record])

    def likeliest(self, others: Sequence[int], independence: float) -> int:
        return int(np.argmax(self._gains(*self.beside(others), others, independence)))

    def odds(self, cause: int, others: Sequence[int], independence: float) -> Odds:
        """Of a cause beside others in the model; ``independence`` is how much of a record each record is worth."""
        residual, basis = self.beside(others)
        gains = self._gains(residual, basis, others, independence)
        shown = dict.fromkeys(self.names, -np.inf)
        for name, gain in zip(self.names, gains, strict=True):
            shown[name] = float(np.logaddexp(shown[name], gain - np.log(self.names.count(name))))
        mine = self.names[cause]
        for words, kernels in ((UNLISTED, self.pose), (CHANGING, self.time)):
            evidence = independence * smooth(residual, basis, self.by_record, kernels).evidence
            shown[words] = max(shown.get(words, -np.inf), evidence)
        # What is none of the causes cannot be excluded where what is left is far from noise or follows the pose, or
        # poses were in order.
        after, whole = self.beside([*others, cause])
        beyond = float(after @ after) - chdtri(len(after) - whole.shape[1], NOISE_LEVEL)
        left = beyond > NEGLIGIBLE * float(residual @ residual - after @ after)
        left = left or smooth(after, whole, self.by_record, self.pose).evidence * independence > CLEAR
        timely = self.causes[cause].jumps or self.causes[cause].kind == "order"
        if left or (timely and self.pose.imitate((residual - after)[self.by_record]) > IMITATED):
            shown[UNLISTED] = max(shown[UNLISTED], shown[mine])
        shown[CHANCE] = float(np.log(len(self.causes)))  # nothing is as likely beforehand as all causes together
        total = float(np.logaddexp.reduce(list(shown.values())))
        close = [name for name, gain in shown.items() if gain > shown[mine] - CLEAR and name != mine]
        of_name = dict(zip(reversed(self.names), [c.words for c in reversed(self.causes)], strict=True))
        alternatives = tuple(of_name.get(name, name) for name in sorted(close, key=lambda name: -shown[name]))
        return Odds(float(np.exp(shown[mine] - total)), alternatives, float(np.exp(shown[CHANCE] - total)))

    def _gains(self, residual: Array, basis: Array, others: Sequence[int], independence: float) -> Array:
        total, freedom = max(float(residual @ residual), 1e-300), len(residual) - basis.shape[1]
        gains = np.full(len(self.causes), -np.inf)
        for i in set(range(len(self.causes))) - set(others):
            own = own_basis(self.columns[i], basis)[0]
            if own.shape[1]:
                left = max(1 - float(np.sum((own.T @ residual) ** 2)) / total, 1e-12)
                gains[i] = -0.5 * independence * freedom * np.log(left)
                gains[i] -= 0.5 * own.shape[1] * np.log(max(freedom * independence, 2.0))
        return gains
