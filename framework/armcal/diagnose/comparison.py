"""Models compared on the same records: how much better, how sure, and which records gain."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.domains import Array
from armcal.estimate.bootstrap import BlockLength, automatic_block_length, standard_error_of_mean

MOST_LISTED = 10


@dataclass(frozen=True)
class Change:
    """One model against another, record by record; negative is better.

    Attributes:
        against: the other model.
        mean: of the differences of each record's error.
        standard_error: of that mean, from blocks of neighbouring records; the fitted models are taken as given.
        block: how many neighbours a block has.
        helped: the share of records whose error is smaller.
        most_helped: ids and differences of the records that gain most.
        most_hurt: of those that lose most.
    """

    against: str
    mean: float
    standard_error: float
    block: int
    helped: float
    most_helped: tuple[tuple[str, float], ...]
    most_hurt: tuple[tuple[str, float], ...]


def change(errors: Array, others: Array, against: str, ids: Sequence[str], block: BlockLength = "auto") -> Change:
    """Errors (N) of one model against those of another on the same records in recorded order; nan where not judged."""
    both = np.flatnonzero(np.isfinite(errors) & np.isfinite(others))
    gained = errors[both] - others[both]
    length = automatic_block_length(gained) if block == "auto" else block
    order = both[np.argsort(gained, kind="stable")]
    listed = [(str(ids[i]), float(errors[i] - others[i])) for i in order]
    return Change(
        against=against,
        mean=float(np.mean(gained)) if len(both) else float("nan"),
        standard_error=standard_error_of_mean(gained, length),
        block=length,
        helped=float(np.mean(gained < 0)) if len(both) else float("nan"),
        most_helped=tuple(pair for pair in listed[:MOST_LISTED] if pair[1] < 0),
        most_hurt=tuple(pair for pair in listed[::-1][:MOST_LISTED] if pair[1] > 0),
    )


def simplest_good(means: Array, freedoms: Sequence[int], changes: Sequence[Change]) -> int:
    """The model with the fewest parameters whose mean error is within one standard error of the lowest. [Hastie2009]

    Args:
        means: mean error of each model (M).
        freedoms: how many parameters each has (M).
        changes: each model against the one with the lowest mean (M).
    """
    best = int(np.nanargmin(means))
    good = [i for i, c in enumerate(changes) if i == best or c.mean <= c.standard_error]
    return min(good, key=lambda i: (freedoms[i], means[i]))
