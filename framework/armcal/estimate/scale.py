"""Whether the size of everything is seen: contacts fit a smaller arm in a smaller world just as well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armcal.base.domains import Array
from armcal.estimate.identifiability import Identifiability
from armcal.estimate.structure import random_records
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.tool_motion import along, apart_from, tools, unseen_motions

UNSEEN_SCALE = "scale is not observable: the same arm, larger or smaller with all it touches, fits as well"
GIVE_A_LENGTH = "give one length: a known distance, a tracker's record, or a dimension of the arm that is held"
_WITHIN = 1e-4
"""Of the size of the workspace: what may be left of a growth of all tool positions in proportion."""
_POSES = 60


def scale_is_unseen(problem: Problem, values: Array, records: Sequence[FactorRecords], known: Identifiability) -> bool:
    """Whether some undetermined combination makes all tools' positions grow in proportion.

    Asked of the tools, not of the parameters: which numbers take part in a growth differs from model to model. A
    growth may go along with a motion of everything, and with another point of a tool being the one that is meant.

    Raises:
        NotConvergedError: a pose has no elastic equilibrium.
    """
    if not len(known.null):
        return False
    poses = problem.subset(random_records(problem, records), np.arange(_POSES, dtype=np.intp))
    at, axes = tools(problem, values, poses)
    moves = [along(problem, values, poses, direction) for direction in known.null]
    growth = (at - at.mean(axis=(0, 2), keepdims=True)).ravel()
    left = apart_from(np.array([move.ravel() for move in moves] + unseen_motions(at, axes)).T, growth[:, None])
    return bool(np.linalg.norm(left) < _WITHIN * np.linalg.norm(growth))
