"""A rigid motion as parameters: three coordinates, and a rotation that stays one."""

from collections.abc import Mapping, Sequence

import casadi as ca

from armcal.base.domains import Rotation
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.se3 import Expression, Transform

LENGTH_SCALE_M = 0.01
ANGLE_SCALE_RAD = 0.05
NO_TURN = (1.0, 0.0, 0.0, 0.0)


def point_blocks(name: str, position: Sequence[float]) -> tuple[ParameterBlock, ...]:
    """``name_x``, ``name_y``, ``name_z`` (m)."""
    return tuple(scalar(f"{name}_{axis}", "m", x, LENGTH_SCALE_M) for axis, x in zip("xyz", position, strict=True))


def point_expression(name: str, values: Mapping[str, Expression]) -> Expression:
    """The point (3x1, m) that the blocks of ``point_blocks`` stand for."""
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
    """The motion that the blocks of ``pose_blocks`` stand for."""
    return Transform(rotation_of(values[f"{name}_rotation"]), point_expression(name, values))


def rotation_of(quaternion: Expression) -> Expression:
    """The rotation matrix (3x3) of a unit quaternion (w, x, y, z). [Murray1994]"""
    w, x, y, z = (quaternion[i] for i in range(4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
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
