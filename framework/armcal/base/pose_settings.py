"""A pose as a configuration states it: a position, and a rotation in one of three ways."""

from typing import Self

import numpy as np
from pydantic import model_validator

from armcal.base.domains import Array
from armcal.base.parameters import ParameterBlock
from armcal.base.pose_blocks import NO_TURN, pose_blocks
from armcal.base.quaternions import PRINTED, nearest_rotation, quaternion_of, rotation_matrix, rpy_matrices
from armcal.base.settings import Angle3, Length3, Settings

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
        """The rotation as w, x, y, z."""
        if self.quaternion is not None:
            q = np.array(self.quaternion) / np.linalg.norm(self.quaternion)
            return tuple(float(x) for x in q)
        if self.rotation is not None:
            return quaternion_of(nearest_rotation(np.array(self.rotation)))
        return NO_TURN if self.rpy is None else quaternion_of(rpy_matrices(np.array(self.rpy)))

    @property
    def matrix(self) -> Array:
        """The homogeneous matrix (4 x 4, m)."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation_matrix(np.array(self.unit_quaternion)), self.position
        return matrix

    def blocks(self, name: str) -> tuple[ParameterBlock, ...]:
        """As parameters; see ``pose_blocks``."""
        return pose_blocks(name, self.position, self.unit_quaternion)
