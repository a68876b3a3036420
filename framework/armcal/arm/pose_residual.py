"""Pose residuals: what an arm's physical model leaves, as a function of the commands that is learned from records.

Corrections are of the joints, which then stand that much farther than the model has them, and of the tool, which
stands at R Exp(turn), p + shift, where R and p are what the model says of it then.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from armcal.base.arrays import Array
from armcal.base.se3 import Expression, Transform, small_rotation
from armcal.base.settings import Settings

OF_TOOL = ("shift_x", "shift_y", "shift_z", "turn_x", "turn_y", "turn_z")
"""Corrections of a tool: shifts (m) in the arm's base frame, a rotation vector (rad) in the tool's."""
CORRECTION = "correction."
"""Of channels of records that carry corrections, ``ARM.correction.shift_x`` and so on: ``Arm.correction_channels``."""
SURROUNDINGS = ("payload", "temperature")
"""What errors may depend on beside commands and approaches, where it was recorded (kg, deg C)."""
MARGIN, LEAST_MARGIN = 0.1, math.radians(1)
"""A joint may be so much of its recorded range beyond it, and a degree (17 mm) if it hardly moved."""
_Settings = Settings


def correction_names(joint_names: Sequence[str]) -> tuple[str, ...]:
    """Of the tool, and of each joint (rad or m), in this order, as records carry them after the arm's name."""
    return tuple(CORRECTION + name for name in (*OF_TOOL, *(f"joint_{joint}" for joint in joint_names)))


@dataclass(frozen=True)
class Postures:
    """Where an arm was commanded to go: commands (rad or m) and directions of approach (-1, 0, 1), joints x N each."""

    commands: Array
    approaches: Array
    surroundings: Mapping[str, Array] = field(default_factory=dict)  # those of ``SURROUNDINGS`` that are known (N each)

    def subset(self, chosen: Any) -> Postures:
        """Some of them."""
        around = {name: column[chosen] for name, column in self.surroundings.items()}
        return Postures(self.commands[:, chosen], self.approaches[:, chosen], around)


@dataclass(frozen=True)
class ModelErrors:
    """What a model leaves, in units of the noise, and how corrections would change it.

    Nothing of it is what the model's parameters can do: the fit took that.
    """

    postures: Postures  # of the records (N)
    dimensions: tuple[str, ...]  # ``angle`` or ``length`` of each joint
    residuals: Array  # in units of their noise and the record's weight (N x rows)
    slopes: Array  # of them by the corrections (N x rows x corrections)
    of_tool: int  # how many of the tool's corrections a record determines: 0, 3 (shifts) or 6


class PoseResidual(ABC):
    """Base of pose residuals. Learned, it corrects where joints and tools are; before that it changes nothing.

    Attributes:
        Settings: the class of its checked settings, which hold what was learned.
        settings: its own, checked.
        joint_names: of the arm, from the base to the tip.
        conditions: columns of the surroundings that what it has learned depends on, beside the load.
        knows_load: whether it depends on the load.
    """

    conditions: Sequence[str] = ()
    knows_load: bool = False
    Settings: ClassVar[type[_Settings]] = Settings

    def __init__(self, settings: Any, joint_names: Sequence[str]) -> None:
        self.settings = settings
        self.joint_names = tuple(joint_names)

    @property
    @abstractmethod
    def is_learned(self) -> bool:
        """Whether it corrects anything."""

    @abstractmethod
    def learned(self, errors: ModelErrors) -> PoseResidual | None:
        """The same with what records say; None where they are too few. What it has learned before is a mere start.

        Where more than one joint is beyond the commands of these records (``MARGIN``), it corrects nothing.
        """

    @abstractmethod
    def correction(
        self, commands: Expression, approaches: Expression, surroundings: Mapping[str, Expression]
    ) -> Expression:
        """Corrections (6 + joints x 1).

        Args:
            commands: of all joints (joints x 1; rad or m).
            approaches: directions of approach (joints x 1; -1, 0, 1).
            surroundings: those of ``SURROUNDINGS`` that are known (1 x 1 each).
        """

    @abstractmethod
    def deviations(self, postures: Postures) -> Array:
        """Standard deviations of corrections (6 + joints x N): small near what was learned, large far from it."""

    def corrections(self, postures: Postures) -> Array:
        """Corrections (6 + joints x N)."""
        around = postures.surroundings
        parts = (ca.SX.sym("commands", len(self.joint_names)), ca.SX.sym("approaches", len(self.joint_names)))
        known = {name: ca.SX.sym(name) for name in around}
        correction = ca.densify(self.correction(*parts, known))
        many = ca.Function("correction", [*parts, *known.values()], [correction], {"cse": True})
        return np.asarray(many(postures.commands, postures.approaches, *(row[None] for row in around.values())).full())

    def __reduce__(self) -> Any:
        return type(self), (self.settings, self.joint_names)


def reached(commands: Array) -> tuple[tuple[float, float], ...]:
    """How far joints (joints x N) moved, with margins: smallest and largest command of each."""
    margins = np.maximum(MARGIN * np.ptp(commands, axis=1), LEAST_MARGIN)
    ends = zip(commands.min(axis=1) - margins, commands.max(axis=1) + margins, strict=True)
    return tuple((float(low), float(high)) for low, high in ends)


def corrected(base_T_tool: Transform, correction: Expression) -> Transform:
    turned = ca.mtimes(base_T_tool.rotation, small_rotation(correction[3:6]))
    return Transform(turned, base_T_tool.translation + correction[:3])
