"""What is mapped: named numbers of each posture, with units and which end of them is good.

How dexterous the arm is follows from the singular values of the tool's Jacobian. Joints count by rad, a metre of a
sliding joint for ``1/length`` rad, and a turn of the tool for ``length`` metres a rad, so that they are metres a rad.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from armcal.base.arrays import Array, Indices, Mask

from armcal_capability.mechanics import MechanicsFunction

_MM = 1000.0
AT_ONCE = 16384
"""Postures in memory together."""
_NOTHING = 1e-9
"""Of the largest singular value: below it the arm has no such motion at all."""


@dataclass(frozen=True)
class Quantity:
    """A number of each posture.

    Attributes:
        name: with its unit (``sag_mm``).
        words: for figures and tables.
        unit: as shown; empty for a ratio.
        good: which end is good.
    """

    name: str
    words: str
    unit: str
    good: Literal["low", "high"] = "low"


CATALOGUE = (
    Quantity("sag_mm", "sag under the arm's own weight", "mm"),
    Quantity("deflection_mm", "further deflection under the load", "mm"),
    Quantity("give_mm_per_N", "give in the softest direction", "mm/N"),
    Quantity("effort_ratio", "torque of the joint nearest to its limit, of what its servo holds", ""),
    Quantity("smallest_mm_per_rad", "smallest singular value, position", "mm/rad", "high"),
    Quantity("manipulability", "Yoshikawa's manipulability, position", "SI", "high"),
    Quantity("inverse_condition", "1/condition, position", "", "high"),
    Quantity("pose_smallest_mm_per_rad", "smallest singular value, position and turn", "mm/rad", "high"),
    Quantity("pose_manipulability", "Yoshikawa's manipulability, position and turn", "SI", "high"),
    Quantity("pose_inverse_condition", "1/condition, position and turn", "", "high"),
    Quantity("expected_mm", "expected error of the calibrated arm", "mm"),
    Quantity("known_to_mm", "of which: parameters not known better", "mm"),
    Quantity("quantisation_mm", "of which: steps of the servos", "mm"),
    Quantity("nominal_mm", "error of the nominal model", "mm"),
)
"""All that there may be, in the order in which it is shown."""

BY_NAME: Mapping[str, Quantity] = {quantity.name: quantity for quantity in CATALOGUE}


@dataclass(frozen=True)
class Postures:
    """Postures that have an equilibrium, and what is known of each.

    Attributes:
        commands: joints x N (rad or m).
        positions: of the loaded tool (N x 3; m, base frame).
        rotations: base_R_tool (3 x 3 x N).
        efforts: on all joints of the chain (joints x N; N m or N).
        values: by quantity (N each; in the quantity's unit).
        levers: how far each commanded joint moves the tool (joints x N; m/rad, or m/m).
    """

    commands: Array
    positions: Array
    rotations: Array
    efforts: Array
    values: Mapping[str, Array]
    levers: Array

    def __len__(self) -> int:
        return len(self.positions)

    def subset(self, chosen: Mask | Indices) -> Postures:
        """Some of them, by place or by mask."""
        return Postures(
            self.commands[:, chosen],
            self.positions[chosen],
            self.rotations[:, :, chosen],
            self.efforts[:, chosen],
            {name: value[chosen] for name, value in self.values.items()},
            self.levers[:, chosen],
        )

    def with_values(self, more: Mapping[str, Array]) -> Postures:
        """With more quantities."""
        return replace(self, values={**self.values, **more})


@dataclass(frozen=True)
class Weights:
    """What quantities take into account.

    Attributes:
        slides: which commanded joints slide (n, bool).
        length: metres that a rad counts for.
        holding: what each joint of the chain holds (joints; N m or N; infinite where nothing is stated).
    """

    slides: Mask
    length: float
    holding: Array


def postures_at(function: MechanicsFunction, commands: Array, weights: Weights) -> Postures:
    """The postures at commands (joints x N) that have an equilibrium, with their mechanical quantities."""
    parts = [
        _part(function, np.ascontiguousarray(commands[:, start : start + AT_ONCE]), weights)
        for start in range(0, max(commands.shape[1], 1), AT_ONCE)
    ]
    postures = [part for part, _, _ in parts]
    values = {name: np.concatenate([part.values[name] for part in postures]) for name in postures[0].values}
    for prefix, place in (("", 1), ("pose_", 2)):
        singular = np.concatenate([part[place] for part in parts])
        measures = dexterity(singular, moves(singular))
        values |= {f"{prefix}{name}": measures[name] for name in ("manipulability", "inverse_condition")}
        values[f"{prefix}smallest_mm_per_rad"] = measures["smallest"] * _MM
    return Postures(
        np.concatenate([part.commands for part in postures], axis=1),
        np.concatenate([part.positions for part in postures]),
        np.concatenate([part.rotations for part in postures], axis=2),
        np.concatenate([part.efforts for part in postures], axis=1),
        values,
        np.concatenate([part.levers for part in postures], axis=1),
    )


def _part(function: MechanicsFunction, commands: Array, weights: Weights) -> tuple[Postures, Array, Array]:
    """Some postures, and singular values of the position's and the pose's Jacobian."""
    mechanics = function(commands)
    kept, values = mechanics.settled, {}
    if function.is_elastic:
        unloaded = function.without_load(commands, mechanics.states)
        values["sag_mm"] = np.linalg.norm(unloaded - function.weightless(commands), axis=0) * _MM
        if function.is_loaded:
            values["deflection_mm"] = np.linalg.norm(mechanics.positions - unloaded, axis=0) * _MM
        values["give_mm_per_N"] = singular_values(mechanics.compliances)[:, 0] * _MM
    if np.isfinite(weights.holding).any():
        values["effort_ratio"] = np.max(np.abs(mechanics.efforts) / weights.holding[:, None], axis=0)
    slopes = weighted(mechanics.slopes, weights.slides, weights.length)[kept]
    levers = np.linalg.norm(mechanics.slopes[:, :3], axis=1).T
    positions, rotations, efforts = mechanics.positions.T, mechanics.rotations, mechanics.efforts
    postures = Postures(commands, positions, rotations, efforts, values, levers).subset(kept)
    return postures, singular_values(slopes[:, :3]), singular_values(slopes)


def weighted(slopes: Array, slides: Mask, length: float) -> Array:
    """Jacobians (N x 6 x n; m, then rad, by rad or m) in metres by rad; ``slides`` are the joints that slide."""
    rows = np.array([1.0] * 3 + [length] * 3)
    columns = np.where(slides, length, 1.0)
    return np.asarray(slopes * rows[:, None] * columns)


def singular_values(slopes: Array) -> Array:
    """Of each Jacobian (N x m x n), the largest first (N x min(m, n))."""
    rows, columns = slopes.shape[1:]
    across = np.swapaxes(slopes, 1, 2)
    square = slopes @ across if rows <= columns else across @ slopes
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(square)[:, ::-1], 0.0)))


def moves(values: Array) -> int:
    if not values.size:
        return 0
    return int(np.sum(values.max(axis=0) > _NOTHING * values.max()))


def dexterity(values: Array, directions: int) -> Mapping[str, Array]:
    """Of the first ``directions``: Yoshikawa's measure [Yoshikawa1985], smallest singular value, 1/condition (N each).

    The condition itself has no mean: it is infinite at a singular posture.
    """
    used = values[:, : max(directions, 1)]
    largest, smallest = used[:, 0], used[:, -1]
    inverse = np.divide(smallest, largest, out=np.zeros(len(used)), where=largest > 0)
    return {"manipulability": np.prod(used, axis=1), "smallest": smallest, "inverse_condition": inverse}
