"""How far off the tip was before a decision, as the instruments see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array
from armcal.errors import ArmcalError
from armcal.estimate.validation import error_dimension, error_unit

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.hypotheses import Recent
from armcal_online.tracking.observer import Observer


@dataclass(frozen=True)
class TipError:
    """The median size of an error, in thousandths of SI; how it was found, as words to go after it.

    ``unit`` is mm, or mrad where nothing measured is a length.
    """

    size: float
    unit: str
    source: str


def tip_error(
    observer: Observer, recent: Sequence[Recent], since: int, before: Belief, after: Belief
) -> TipError | None:
    """The error of the predicted readings before a decision.

    Where the decision explains the records by a move of the estimate, it is how far the predictions move at the last
    recorded poses, free of noise. Where it does not, nothing better is known than how far the readings since lie from
    their predictions.

    Args:
        observer: of the recalibration.
        recent: the last records, in order.
        since: the number of the first record that the decision affects.
        before: the belief without the decision.
        after: the belief that explains the records; the one before where nothing does.

    Returns:
        None where no reading has a length (or an angle, where nothing measured is a length), or none is predictable.
    """
    space = observer.space
    old, new = (space.inside(belief.values(space)) for belief in (before, after))
    if not np.array_equal(old, new):
        sizes = [size for record in recent for size in _sizes(observer, record, old, new)]
        source = f"median move of the prediction at the last {len(recent)} recorded poses"
    else:
        late = [record for record in recent if record.sequence >= since]
        sizes = [size for record in late for size in _sizes(observer, record, old, None)]
        source = f"median distance of the last {len(late)} readings from their predictions"
    return TipError(1000 * float(np.median(sizes)), error_unit(observer.problem), source) if sizes else None


def _sizes(observer: Observer, record: Recent, old: Array, new: Array | None) -> list[float]:
    """Of each reading of a record, how far its prediction moves from old values to new, or lies from it without new."""
    counted, sizes = error_dimension(observer.problem), []
    for reading in record.readings:
        dimensions = observer.problem.kernels[reading.factor].factor.dimensions
        rows = [i for i, dimension in enumerate(dimensions) if dimension == counted]
        if not rows:
            continue
        try:
            miss = observer.linearise(old, reading)[0]
            if new is not None:
                miss = miss - observer.linearise(new, reading)[0]
        except ArmcalError:
            continue
        sizes.append(float(np.linalg.norm(miss[rows])))
    return sizes
