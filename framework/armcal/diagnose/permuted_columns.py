"""Other ways to read the columns of a recording: joints' signs, orders and units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from armcal.arm.assembly import Arm

Wires = Mapping[str, tuple[str, float]]
"""Channels, each read as another one times a factor."""
_DEGREES = 180 / np.pi
_MOST_SIGNS = 8
_AXES = "xyz"


def single_joints(arm: Arm) -> list[tuple[str, Wires]]:
    """Each joint's sign, each two joints of a kind exchanged, and all angles in another unit."""
    joints = tuple(arm.commanded)
    angles = {joint: joint for joint, dimension in arm.commanded.items() if dimension == "angle"}
    readings: list[tuple[str, Wires]] = [
        (f"the sign of {joint} reversed", _wires(arm, {joint: joint}, -1.0)) for joint in joints
    ]
    for one, other in combinations(joints, 2):
        if arm.commanded[one] == arm.commanded[other]:
            readings.append((f"{one} and {other} exchanged", _wires(arm, {one: other, other: one}, 1.0)))
    for factor in (_DEGREES, 1 / _DEGREES):
        readings.append((f"joint angles {factor:.3g} times as large", _wires(arm, angles, factor)))
    return readings


def several_joints(arm: Arm) -> Iterator[tuple[str, Wires]]:
    """The signs of several joints, and joints in reverse order or shifted."""
    joints = tuple(arm.commanded)
    for size in range(2, len(joints) + 1) if len(joints) <= _MOST_SIGNS else ():
        for chosen in combinations(joints, size):
            words = f"the signs of {', '.join(chosen[:-1])} and {chosen[-1]} reversed"
            yield words, _wires(arm, {joint: joint for joint in chosen}, -1.0)
    if len(set(arm.commanded.values())) == 1:
        orders = [joints[::-1], *(joints[step:] + joints[:step] for step in range(1, len(joints)))]
        for order in orders if len(joints) > 2 else ():
            yield (
                f"({', '.join(order)}) taken for ({', '.join(joints)})",
                _wires(arm, dict(zip(joints, order, strict=True)), 1.0),
            )


def axes_words(order: Sequence[int], signs: Sequence[float]) -> str:
    """Axes in this order, with these signs."""
    moved = [i for i in range(3) if order[i] != i]
    negative = [_AXES[order[i]] for i in range(3) if signs[i] < 0]
    if len(moved) == 2 and not negative:
        return f"{_AXES[moved[0]]} and {_AXES[moved[1]]} exchanged"
    if not moved:
        return f"the sign{'s' * (len(negative) > 1)} of {' and '.join(negative)} reversed"
    taken = (f"{'-' if sign < 0 else ''}{_AXES[axis]}" for axis, sign in zip(order, signs, strict=True))
    return f"({', '.join(taken)}) taken for (x, y, z)"


def _wires(arm: Arm, joints: Mapping[str, str], factor: float) -> dict[str, tuple[str, float]]:
    """Commands and approaches of some joints read as those of others, times a factor; of approaches, times its sign."""
    return {
        f"{arm.name}.{part}{joint}": (f"{arm.name}.{part}{other}", scale)
        for joint, other in joints.items()
        for part, scale in (("", factor), ("approach.", float(np.sign(factor))))
    }
