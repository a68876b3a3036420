"""A pose as a configuration states it, and as parameters: three coordinates, and a rotation that stays one."""

from collections.abc import Mapping, Sequence
from typing import Self

import casadi as ca
import numpy as np
from pydantic import model_validator

from armcal.base.arrays import Array
from armcal.base.domains import Rotation
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.quaternions import (
    PRINTED,
    nearest_rotation,
    quaternion_of,
    rotation_matrix,
    rotation_rows,
    rpy_matrices,
)
from armcal.base.se3 import Expression, Transform
from armcal.base.settings import Angle3, Length3, Settings

LENGTH_SCALE_M = 0.01
ANGLE_SCALE_RAD = 0.05
NO_TURN = (1.0, 0.0, 0.0, 0.0)


def point_blocks(name: str, position: Sequence[float]) -> tuple[ParameterBlock, ...]:
    return tuple(scalar(f"{name}_{axis}", "m", x, LENGTH_SCALE_M) for axis, x in zip("xyz", position, strict=True))


def point_expression(name: str, values: Mapping[str, Expression]) -> Expression:
    return ca.sparsify(ca.vertcat(*[values[f"{name}_{axis}"] for axis in "xyz"]))


def pose_blocks(
    name: str, position: Sequence[float] = (0.0, 0.0, 0.0), quaternion: Sequence[float] = NO_TURN
) -> tuple[ParameterBlock, ...]:
    """``name_x``, ``name_y``, ``name_z`` (m) and ``name_rotation`` (unit quaternion w, x, y, z; increments in rad).

    Position and rotation are blocks of their own, so that each has its unit, its typical scale and its prior.
    """
    turned = ParameterBlock(f"{name}_rotation", "rad", tuple(map(float, quaternion)), Rotation(), ANGLE_SCALE_RAD)
    return (*point_blocks(name, position), turned)


def pose_transform(name: str, values: Mapping[str, Expression]) -> Transform:
    return Transform(rotation_of(values[f"{name}_rotation"]), point_expression(name, values))


def rotation_of(quaternion: Expression) -> Expression:
    """The rotation matrix (3x3) of a unit quaternion (w, x, y, z). [Murray1994]"""
    rows = rotation_rows(*(quaternion[i] for i in range(4)))
    return ca.sparsify(ca.vertcat(*[ca.horzcat(*row) for row in rows]))


def quaternion_expression(rotation: Expression) -> Expression:
    """The unit quaternion (4x1; w, x, y, z) of a rotation matrix, of whichever component is largest. [Shepperd1978]

    It branches on its argument, so it serves to say where to start, not to be differentiated.
    """
    r, largest = rotation, sum((rotation[i, i] for i in range(3)), ca.SX(0))
    chosen = ca.vertcat(1 + largest, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    for i in range(3):
        j, k, parts = (i + 1) % 3, (i + 2) % 3, [ca.SX(0)] * 3
        parts[i] = 1 + r[i, i] - r[j, j] - r[k, k]
        parts[j], parts[k] = r[j, i] + r[i, j], r[k, i] + r[i, k]
        chosen = ca.if_else(r[i, i] > largest, ca.vertcat(r[k, j] - r[j, k], *parts), chosen)
        largest = ca.fmax(r[i, i], largest)
    return chosen / ca.norm_2(chosen)


_Row = tuple[float, float, float]


class PoseSettings(Settings):
    """A pose: ``position_m``, and at most one of ``rotation`` (three rows), ``quaternion`` (w, x, y, z) and ``rpy_deg``.

    Roll, pitch and yaw turn about the fixed axes x, y and z, in this order: R = Rz(yaw) Ry(pitch) Rx(roll).
    """  # noqa: E501

    position: Length3 = (0.0, 0.0, 0.0)
    rotation: tuple[_Row, _Row, _Row] | None = None
    quaternion: tuple[float, float, float, float] | None = None
    rpy: Angle3 | None = None

    @model_validator(mode="after")
    def _one_rotation(self) -> Self:
        given = [name for name in ("rotation", "quaternion", "rpy") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"found {' and '.join(given)}, expected one of them")
        if self.rotation is not None:
            nearest_rotation(np.array(self.rotation))
        if self.quaternion is not None and abs(float(np.linalg.norm(self.quaternion)) - 1) > PRINTED:
            raise ValueError(f"found a quaternion of length {np.linalg.norm(self.quaternion):.4f}, expected 1")
        return self

    @property
    def unit_quaternion(self) -> tuple[float, ...]:
        if self.quaternion is not None:
            q = np.array(self.quaternion) / np.linalg.norm(self.quaternion)
            return tuple(float(x) for x in q)
        if self.rotation is not None:
            return quaternion_of(nearest_rotation(np.array(self.rotation)))
        return NO_TURN if self.rpy is None else quaternion_of(rpy_matrices(np.array(self.rpy)))

    @property
    def matrix(self) -> Array:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation_matrix(np.array(self.unit_quaternion)), self.position
        return matrix

    def blocks(self, name: str) -> tuple[ParameterBlock, ...]:
        return pose_blocks(name, self.position, self.unit_quaternion)
