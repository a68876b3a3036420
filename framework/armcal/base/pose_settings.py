"""A pose as a configuration states it: a position, and a rotation in one of three ways."""

from typing import Self

import numpy as np
from pydantic import model_validator

from armcal.base.domains import Array
from armcal.base.parameters import ParameterBlock
from armcal.base.pose_blocks import NO_TURN, pose_blocks
from armcal.base.quaternions import rotation_matrix
from armcal.base.settings import Angle3, Length3, Settings

PRINTED = 2e-3
"""A printed matrix may be so far from a rotation, entry by entry; it is taken for the nearest one."""

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


def nearest_rotation(matrix: Array) -> Array:
    """The proper rotation nearest to a printed one (3x3). [Higham1989]

    Raises:
        ValueError: it is no rotation, not even a printed one.
    """
    left, _, right = np.linalg.svd(matrix)
    nearest = left @ right
    if np.linalg.det(nearest) < 0:
        raise ValueError("found a reflection (determinant -1), expected a rotation: check the order of rows and axes")
    worst = float(np.abs(nearest - matrix).max())
    if worst > PRINTED:
        raise ValueError(f"found a matrix that is no rotation: it is off by {worst:.3g}; give rows of unit length")
    return np.asarray(nearest)


def quaternion_of(rotation: Array) -> tuple[float, ...]:
    """The unit quaternion (w, x, y, z; w >= 0) of a rotation matrix, from its largest component. [Shepperd1978]"""
    trace = float(np.trace(rotation))
    squares = np.array([trace, *np.diag(rotation)])
    largest = int(np.argmax(squares))
    q = np.empty(4)
    if largest == 0:
        q[0] = 1 + trace
        q[1:] = [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = rotation[k, j] - rotation[j, k]
        q[1 + i] = 1 + rotation[i, i] - rotation[j, j] - rotation[k, k]
        q[1 + j], q[1 + k] = rotation[j, i] + rotation[i, j], rotation[k, i] + rotation[i, k]
    q = q / np.linalg.norm(q)
    return tuple(float(x) for x in (q if q[0] >= 0 else -q))


def rpy_matrices(rpy: Array) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll) (... x 3 x 3) from roll, pitch, yaw (... x 3; rad)."""
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(rpy), -1, 0), np.moveaxis(np.sin(rpy), -1, 0)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
