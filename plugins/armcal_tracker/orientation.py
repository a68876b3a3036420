"""Columns of an orientation: quaternion, rotation matrix, angles or rotation vector; what else they might mean."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation
from typing_extensions import override

QUATERNION = ("qw", "qx", "qy", "qz")
TURNS = ("turn1", "turn2", "turn3")
MATRIX = tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
_OTHER = {"xyzw": "wxyz", "wxyz": "xyzw"}
_Nine = tuple[str, str, str, str, str, str, str, str, str]


class Orientation(Settings):
    """How a file gives base_T_body's rotation.

    Values are numbers of all records, one row each, in the order of ``mapped``.
    """

    kind: ClassVar[str]
    """What one of them is called."""

    @property
    def declared(self) -> str:
        raise NotImplementedError

    def mapped(self) -> Mapping[str, str]:
        raise NotImplementedError

    def size(self, values: Array) -> Array:
        """How large each is (N); zero for none at all."""
        return np.ones(len(values))

    def fault(self, values: Array) -> Array:
        """How far each is from a rotation or a reflection (N)."""
        return np.zeros(len(values))

    def rotations(self, values: Array) -> Rotation:
        """Of each record.

        Raises:
            ValueError: a value is none.
        """
        raise NotImplementedError

    def others(self, values: Array) -> Mapping[str, Rotation]:
        raise NotImplementedError


class QuaternionColumns(Orientation):
    """The four columns of a quaternion, as they stand in the file, and in which order its parts stand in them."""

    kind = "quaternion"
    columns: tuple[str, str, str, str]
    order: Literal["xyzw", "wxyz"]

    @property
    @override
    def declared(self) -> str:
        return f"order: {self.order}"

    @override
    def mapped(self) -> dict[str, str]:
        own = dict(zip(self.order, self.columns, strict=True))
        return {name: own[name[1]] for name in QUATERNION}

    @override
    def size(self, values: Array) -> Array:
        return np.asarray(np.linalg.norm(values, axis=1))

    @override
    def fault(self, values: Array) -> Array:
        return np.abs(self.size(values) - 1)

    @override
    def rotations(self, values: Array) -> Rotation:
        return Rotation.from_quat(values[:, [1, 2, 3, 0]])

    @override
    def others(self, values: Array) -> dict[str, Rotation]:
        """The other order; it is the inverse between two fixed rotations, so that no turn of records shows it."""
        other = _OTHER[self.order]
        in_file = values[:, ["wxyz".index(part) for part in self.order]]
        exchanged = Rotation.from_quat(in_file[:, [other.index(part) for part in "xyzw"]])
        return {f"order: {other}, or as body_T_base,": exchanged}


class RotationColumns(Orientation):
    """The nine columns of a rotation matrix, row by row."""

    kind = "rotation matrix"
    columns: _Nine

    @property
    @override
    def declared(self) -> str:
        return "the matrix row by row"

    @override
    def mapped(self) -> dict[str, str]:
        return dict(zip(MATRIX, self.columns, strict=True))

    @override
    def size(self, values: Array) -> Array:
        return np.asarray(np.abs(values).max(axis=1))

    @override
    def fault(self, values: Array) -> Array:
        matrices = values.reshape(-1, 3, 3)
        squares = np.swapaxes(matrices, 1, 2) @ matrices
        return np.asarray(np.abs(squares - np.eye(3)).max(axis=(1, 2)))

    @override
    def rotations(self, values: Array) -> Rotation:
        return Rotation.from_matrix(values.reshape(-1, 3, 3))

    @override
    def others(self, values: Array) -> dict[str, Rotation]:
        return {"it column by column, that is as body_T_base,": self.rotations(values).inv()}


class AnglesColumns(Orientation):
    """The three columns of roll, pitch and yaw: R = Rz(yaw) Ry(pitch) Rx(roll), turns about fixed axes.

    Any three angles are a rotation, three zeros too.
    """

    kind = "triple of roll, pitch and yaw"
    columns: tuple[str, str, str]
    unit: Literal["deg", "rad"]

    @property
    @override
    def declared(self) -> str:
        return f"R = Rz(yaw) Ry(pitch) Rx(roll) in {self.unit}"

    @override
    def mapped(self) -> dict[str, str]:
        return dict(zip(TURNS, self.columns, strict=True))

    @override
    def rotations(self, values: Array) -> Rotation:
        return Rotation.from_euler("xyz", values, degrees=self.unit == "deg")

    @override
    def others(self, values: Array) -> dict[str, Rotation]:
        degrees = self.unit == "deg"
        return {
            "it as rotation_vector": Rotation.from_rotvec(values, degrees=degrees),
            "R = Rx(roll) Ry(pitch) Rz(yaw)": Rotation.from_euler("XYZ", values, degrees=degrees),
            f"unit: {'rad' if degrees else 'deg'}": Rotation.from_euler("xyz", values, degrees=not degrees),
        }


class EulerColumns(AnglesColumns):
    """The three columns of Euler angles, and their convention, as SciPy has it.

    ``order`` names the axes in the order of the columns: small letters are turns about fixed axes (``xyz``: R = Rz Ry
    Rx, as ``rpy``), capitals about the axes that turned before (``XYZ``: R = Rx Ry Rz).
    """

    kind = "triple of Euler angles"
    order: Annotated[str, Field(pattern="^([xyz]{3}|[XYZ]{3})$")]

    @model_validator(mode="after")
    def _three_turns(self) -> Self:
        if self.order[0] == self.order[1] or self.order[1] == self.order[2]:
            raise ValueError(f"found the order {self.order!r}, expected neighbours to differ: XYZ, ZYX, ZYZ, xyz, ...")
        return self

    @property
    @override
    def declared(self) -> str:
        return f"order: {self.order} in {self.unit}"

    @override
    def rotations(self, values: Array) -> Rotation:
        return Rotation.from_euler(self.order, values, degrees=self.unit == "deg")

    @override
    def others(self, values: Array) -> dict[str, Rotation]:
        degrees, other = self.unit == "deg", self.order.swapcase()
        return {
            f"order: {other}": Rotation.from_euler(other, values, degrees=degrees),
            "it as that of body_T_base": self.rotations(values).inv(),
            f"unit: {'rad' if degrees else 'deg'}": Rotation.from_euler(self.order, values, degrees=not degrees),
        }


class VectorColumns(AnglesColumns):
    """The three columns of a rotation vector: its direction is the axis, its length the angle."""

    kind = "rotation vector"

    @property
    @override
    def declared(self) -> str:
        return f"the rotation vector of base_T_body in {self.unit}"

    @override
    def rotations(self, values: Array) -> Rotation:
        return Rotation.from_rotvec(values, degrees=self.unit == "deg")

    @override
    def others(self, values: Array) -> dict[str, Rotation]:
        degrees = self.unit == "deg"
        return {
            "it as rpy": Rotation.from_euler("xyz", values, degrees=degrees),
            "it as that of body_T_base": self.rotations(values).inv(),
            f"unit: {'rad' if degrees else 'deg'}": Rotation.from_rotvec(values, degrees=not degrees),
        }


def reflections(values: Array) -> Array:
    """Places of matrices (N x 9) that mirror; none among quaternions (N x 4)."""
    if values.shape[1] != len(MATRIX):
        return np.zeros(0, dtype=np.intp)
    return np.flatnonzero(np.linalg.det(values.reshape(-1, 3, 3)) < 0)
