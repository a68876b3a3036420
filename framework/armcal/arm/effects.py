"""Joint effects: what stands between the commanded and the real displacement of a joint."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from armcal.arm.model import Chain, Vector3
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression


@dataclass(frozen=True)
class JointCommand:
    """What is recorded of one joint: its commanded displacement (rad or m) and the direction it came from.

    ``approach`` is the sign of the joint's last motion, 0 where it is not known.
    """

    index: int
    commanded: Expression
    approach: Expression


@dataclass(frozen=True)
class Spring:
    """An elastic deflection at a site.

    Attributes:
        site: 0 for the mount, i for joint i (from 1).
        directions: unit vectors in the site's frame (after the joint's motion), one a coordinate; empty for the
            joint's own axis.
        law: generalised loads (N m, or N on a prismatic joint's own axis; one a coordinate) to deflections (rad or m).
    """

    site: int
    directions: tuple[Vector3, ...]
    law: Callable[[Expression], Expression]

    @property
    def size(self) -> int:
        """How many coordinates it has."""
        return max(1, len(self.directions))


@dataclass(frozen=True)
class Condition:
    """A recorded number of the surroundings that an effect reads.

    Attributes:
        name: of its column, without the unit suffix (``humidity``).
        dimension: of its unit, ``dimensionless`` for a pure number; may be left out for a column that any record may
            carry (``temperature``).
    """

    name: str
    dimension: str | None = None


class JointEffect(Protocol):
    """What a plugin provides to describe servos, gears and springs; it holds for any arm model.

    ``parameters`` have local names; values come as CasADi expressions under the same names. An expression
    may branch on what was recorded (a command, an approach), never on a parameter.
    """

    def parameters(self) -> Sequence[ParameterBlock]:
        """Every number of the effect."""

    def displacement(self, command: JointCommand, values: Mapping[str, Expression]) -> Expression:
        """What the effect adds to the joint's commanded displacement (rad or m)."""

    def springs(self, values: Mapping[str, Expression]) -> Sequence[Spring]:
        """The effect's elastic deflections."""


@runtime_checkable
class ShapeEffect(JointEffect, Protocol):
    """A joint effect that also changes the arm's shape with what is recorded of its surroundings."""

    @property
    def conditions(self) -> Sequence[str | Condition]:
        """The recorded numbers it reads; a bare name is a column that any record may carry (``temperature``, in C).

        Every measured record must have them. A prediction may lack them: ``shaped`` uses a reference value then, or
        lets the ``KeyError`` of the missing name pass, and the prediction is refused.
        """

    def shaped(self, chain: Chain, conditions: Mapping[str, Expression], values: Mapping[str, Expression]) -> Chain:
        """The chain under these conditions."""
