"""Two changes at once, as a blow makes: the likeliest single ones, two by two."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from armcal_online.tracking.hypotheses import Explanation, Hypothesis

LEAST_RECORDS = 3
"""So many records that do not fit are needed: two fit two changes of their own too easily."""
_MOST = 7
_TOGETHER = 0.01
"""How probable it is that another certain change comes with one."""
_ENOUGH = 0.9


def is_enough(single: Explanation, large: int) -> bool:
    """Whether one change explains all records since that do not fit, and most of their misfit.

    A change of everything is not enough: it would explain two changes as well.
    """
    if single.hypothesis.kind == "general_change":
        return False
    return single.large >= large and single.share >= _ENOUGH


def pairs(singles: Sequence[Explanation], changes: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Steps of joints and motions of instruments of the stated size, two by two.

    Args:
        singles: the likeliest first; only changes of the likeliest joints and instruments are combined.
        changes: all single changes.
    """
    subjects = list(dict.fromkeys(single.hypothesis.subject for single in singles))
    kinds = ("joint_slipped", "sensor_moved")
    of = {change.subject: change for change in changes if change.kind in kinds and change.scale == 1.0}
    known = [of[subject] for subject in subjects if subject in of][:_MOST]
    return tuple(
        Hypothesis(
            "two_changes",
            f"{one.subject} and {other.subject}",
            np.hstack([one.directions, other.directions]),
            1.0,
            max(one.log_prior, other.log_prior) + math.log(_TOGETHER),
            np.zeros_like(one.step),
            parts=(one, other),
        )
        for one, other in combinations(known, 2)
    )
