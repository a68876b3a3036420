"""Why a target cannot be reached, in a sentence."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from armcal.base.domains import Array
from armcal.calibration.compensation.finder import Rows, Solutions
from armcal.calibration.compensation.request import Mask, Targets

_AT_LIMIT = 1e-6


def why_not(
    joints: Sequence[str],
    limits: Array,
    commands: Array,
    targets: Targets,
    solutions: Solutions,
    had: Mask,
    bounds: Array,
    position_can_be_had: Callable[[Rows], Mask],
) -> tuple[str, ...]:
    """A sentence for each target that is not had; empty for the others.

    Args:
        joints: their names (n).
        limits: n x 2 (rad or m).
        commands: the nearest ones (n x N).
        targets: what was asked.
        solutions: what was found.
        had: which are reached.
        bounds: how near the arm can come at most (N; m).
        position_can_be_had: from targets' rows to whether their positions can be reached with any rotation.
    """
    lost = np.flatnonzero(~had)
    turned = np.zeros(len(had), dtype=bool)
    near = lost[(bounds[lost] == 0) & ~solutions.forbidden[lost]]
    if targets.rotations is not None and near.size:
        turned[near] = position_can_be_had(near)
    said = [""] * len(had)
    for row in lost.tolist():
        said[row] = _sentence(joints, limits, commands[:, row], solutions, bounds[row], bool(turned[row]), row)
    return tuple(said)


def _sentence(
    joints: Sequence[str], limits: Array, commands: Array, solutions: Solutions, bound: float, turned: bool, row: int
) -> str:
    if solutions.there[row]:
        return "the load is more than the springs hold there"
    if bound > 0:
        return f"out of reach: no command comes nearer than {1000 * bound:.1f} mm"
    if solutions.forbidden[row]:
        return "all commands found that reach it are too near to something"
    held = [
        joint
        for joint, q, (low, high) in zip(joints, commands, limits, strict=True)
        if q <= low + _AT_LIMIT or q >= high - _AT_LIMIT
    ]
    at_limits = f"; the nearest has {', '.join(held)} at the limit" if held else ""
    if turned:
        return f"the position can be reached, but not with this rotation{at_limits}"
    return f"no command was found that reaches it{at_limits}"
