"""Whether the size of everything is seen: contacts fit a smaller arm in a smaller world just as well."""

from __future__ import annotations

import numpy as np

from armcal.base.domains import Array, Pose, ScrewAxis
from armcal.base.parameters import ParameterBlock, Parameters
from armcal.solve.identifiability import Identifiability

UNSEEN_SCALE = "scale is not observable: the same arm, larger or smaller with all it touches, fits as well"
GIVE_A_LENGTH = "give one length: a known distance, a tracker's record, or a dimension of the arm that is held"
_WITHIN = 1e-5
"""Sine of the angle between a growth of all lengths and what the records do not determine."""


def scale_is_unseen(parameters: Parameters, values: Array, known: Identifiability) -> bool:
    """Whether a growth of all free lengths in proportion is among the undetermined directions.

    Args:
        parameters: of the problem.
        values: where it was judged.
        known: what the records determine there.
    """
    null = known.null
    if not len(null):
        return False
    parts = [_growth(block, values[parameters.entries_of(block.name)]) for block in parameters.free]
    growth = np.concatenate([np.zeros(0), *parts])
    chain = parameters.entries_jacobian(values)
    direction = np.linalg.lstsq(chain, growth, rcond=None)[0] / parameters.scales()
    length = float(np.linalg.norm(direction))
    if length == 0 or not np.allclose(chain @ (direction * parameters.scales()), growth, atol=1e-9):
        return False
    basis = np.linalg.qr(null.T)[0]
    left = direction - basis @ (basis.T @ direction)
    return float(np.linalg.norm(left)) < _WITHIN * length


def _growth(block: ParameterBlock, entries: Array) -> Array:
    """How a block's canonical entries change when all lengths grow in proportion."""
    if isinstance(block.domain, Pose):
        return np.concatenate([np.zeros(4), entries[4:]])
    if isinstance(block.domain, ScrewAxis):
        return np.concatenate([np.zeros(3), entries[3:]])
    return entries if block.unit == "m" else np.zeros(len(entries))
