"""What compensation is asked, and what it answers; arrays, a row or column a target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from armcal.base.arrays import Array, Indices, Mask

Redundancy = Literal["nearest", "stiffest", "least_sag", "coolest"]
FARTHEST_M = 1e6  # A target beyond this is a slip of a unit, and its square may be no number
_ORTHOGONAL = 1e-6


@dataclass(frozen=True)
class Targets:
    """Where the tool shall be.

    Attributes:
        positions: of the tool's origin in the base frame (N x 3; m).
        rotations: base_R_tool (N x 3 x 3); None where only positions count.
        acting: what acts on the arm (LOAD_CHANNELS x N; SI, base frame).
        approach: from where each joint comes (n x N; -1, 0, 1; 0: not known).
        conditions: of the surroundings, by name (N each).

    Raises:
        ValueError: arrays of other shapes, numbers that are none, or matrices that are no rotations.
    """

    positions: Array
    rotations: Array | None
    acting: Array
    approach: Array
    conditions: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.positions)
        _check("positions", self.positions, (count, 3))
        if np.abs(self.positions).max(initial=0.0) > FARTHEST_M:
            raise ValueError(f"found positions beyond {FARTHEST_M:g} m")
        _check("approach", self.approach, (len(self.approach), count))
        _check("what acts on the arm", self.acting, (len(self.acting), count))
        if self.rotations is None:
            return
        _check("rotations", self.rotations, (count, 3, 3))
        square = self.rotations.transpose(0, 2, 1) @ self.rotations
        off = np.abs(square - np.eye(3)).max(axis=(1, 2)) > _ORTHOGONAL
        bad = np.flatnonzero(off | (np.linalg.det(self.rotations) < 0))
        if bad.size:
            raise ValueError(f"the matrix of target {bad[0] + 1} is no rotation")

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def joined(cls, parts: Sequence[Targets]) -> Targets:
        """Those of several parts, one after another."""
        first = parts[0]
        return cls(
            np.concatenate([part.positions for part in parts]),
            None if first.rotations is None else np.concatenate([part.rotations for part in parts]),
            np.concatenate([part.acting for part in parts], axis=1),
            np.concatenate([part.approach for part in parts], axis=1),
            {name: np.concatenate([part.conditions[name] for part in parts]) for name in first.conditions},
        )

    def subset(self, rows: Indices) -> Targets:
        """Some of them."""
        turned = None if self.rotations is None else self.rotations[rows]
        conditions = {name: values[rows] for name, values in self.conditions.items()}
        return Targets(self.positions[rows], turned, self.acting[:, rows], self.approach[:, rows], conditions)


@dataclass(frozen=True)
class Commands:
    """What to command, and where that leads.

    Attributes:
        joints: the commanded joints (n).
        joint_angles: what to command (N x n; rad, or m on sliding joints); of a target that cannot be reached, the
            nearest that was found.
        counts: what a servo board is told (N x n; 0 of joints without a pulse table); None for an arm without one.
        base_T_tool: where the calibrated arm's tool then is (N x 4 x 4), quantisation and elasticity included.
        base_T_point: and the point that is brought to targets: the tool itself, or the target that was measured.
        distances: from that point to the target (N; m).
        turns: from its rotation to the target's (N; rad); zeros where only positions count.
        reached: whether the target is reached, up to what the counts leave (N).
        reasons: why not; empty for those that are reached (N).
        bounds: no command brings the arm nearer than this (N; m); zero where nothing is known.
        moves: along a path, of each joint from the target before (N x n; rad or m); None for single targets.
        approach: from where each joint comes (N x n; -1, 0, 1), as far as that was told or follows from the path.
    """

    joints: tuple[str, ...]
    joint_angles: Array
    counts: NDArray[np.int64] | None
    base_T_tool: Array
    base_T_point: Array
    distances: Array
    turns: Array
    reached: Mask
    reasons: tuple[str, ...]
    bounds: Array
    approach: Array
    moves: Array | None = None

    def __len__(self) -> int:
        return len(self.joint_angles)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Those of several parts of the targets, one after another."""
        columns: dict[str, Any] = {
            part.name: [getattr(commands, part.name) for commands in parts] for part in fields(cls)
        }
        whole: dict[str, Any] = {
            name: None if column[0] is None else np.concatenate(column) for name, column in columns.items()
        }
        whole["joints"], whole["reasons"] = parts[0].joints, tuple(why for part in parts for why in part.reasons)
        return cls(**whole)


@dataclass(frozen=True)
class Options:
    """How commands are chosen.

    Attributes:
        limits: lowest and highest command by joint (rad or m), instead of the model's.
        redundancy: which of many commands: nearest to the start, stiffest against a force at the tool, with the least
            sag, or the coolest (least torque).
        reach_m: targets of this size count as had (m).
        reach_rad: and of this size of turn (rad).
        seed: of the random starts.

    Raises:
        ValueError: there is no such redundancy.
    """

    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    redundancy: Redundancy = "nearest"
    reach_m: float = 1e-9
    reach_rad: float = 1e-8
    seed: int = 0

    def __post_init__(self) -> None:
        if self.redundancy not in get_args(Redundancy):
            raise ValueError(
                f"found the redundancy {self.redundancy!r}, expected one of {', '.join(get_args(Redundancy))}"
            )


def _check(what: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"found {what} of the shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"found {what} that are not finite numbers")
