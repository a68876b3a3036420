"""Rigid motions as CasADi expressions: the one place where rotations and transforms are composed.

Transforms are written ``a_T_b``: they map coordinates in frame b to coordinates in frame a.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from armcal.base.arrays import Array
from armcal.plugins import refuse

Expression = Any  # A CasADi ``SX`` (or a number where a constant is meant)

if hasattr(ca.GlobalOptions, "setNumpyMode"):
    # A plugin may call numpy's functions on expressions: shapes are those of every version of CasADi, and no notice.
    ca.GlobalOptions.setNumpyMode(-1)

_SERIES_TERMS = 10
_MOTION_TERMS = 12
_HALVINGS = 3
_ARCSINE_TERMS = 11
_NO_AXIS = 1e-30
"""Put on an axis so that half a turn exactly, whose axis this way does not determine, is still half a turn."""


@dataclass(frozen=True)
class Transform:
    """A rigid motion: ``rotation`` (3x3 SX) and ``translation`` (3x1 SX, m)."""

    rotation: Expression
    translation: Expression

    def __matmul__(self, other: Transform) -> Transform:
        """a_T_c = a_T_b @ b_T_c; what turns or moves nothing is not multiplied, which takes most of the time."""
        if self.rotation.is_eye():
            rotation, moved = other.rotation, other.translation
        else:
            rotation = self.rotation if other.rotation.is_eye() else ca.mtimes(self.rotation, other.rotation)
            moved = ca.mtimes(self.rotation, other.translation) if other.translation.nnz() else other.translation
        return Transform(rotation, moved + self.translation if self.translation.nnz() else moved)

    def apply(self, point: Expression) -> Expression:
        """A point (3x1, m) given in frame b, in frame a."""
        return ca.mtimes(self.rotation, point) + self.translation

    def inverse(self) -> Transform:
        back = self.rotation.T
        return Transform(back, -ca.mtimes(back, self.translation))

    def matrix(self) -> Expression:
        bottom = ca.horzcat(ca.SX(1, 3), ca.SX(1))
        return ca.vertcat(ca.horzcat(self.rotation, self.translation), bottom)


def column(method: Callable[..., Any], returned: Any, rows: int | None, expected: str) -> Expression:
    """What a method of a component returned, as an expression (rows x 1, any length if None); or a PluginError."""
    try:
        given = ca.SX(returned)
    except (NotImplementedError, TypeError):
        refuse(method, f"{returned!r}", expected)
    if given.shape != (given.shape[0] if rows is None else rows, 1):
        refuse(method, " x ".join(map(str, given.shape)) + " numbers", expected)
    return given


def evaluated(expression: Expression) -> Array:
    return np.asarray(ca.evalf(ca.densify(ca.SX(expression))).full())


def identity() -> Transform:
    return Transform(ca.SX.eye(3), ca.SX(3, 1))


def translation(x: Expression, y: Expression, z: Expression) -> Transform:
    """A translation (m); zeros stay structurally zero, so that they cost nothing later."""
    return Transform(ca.SX.eye(3), ca.sparsify(ca.vertcat(ca.SX(x), ca.SX(y), ca.SX(z))))


def cos_sin(angle: Expression) -> tuple[Expression, Expression]:
    """Cosine and sine of an angle (rad), exact for constant multiples of a right angle.

    cos(pi/2) in floating point is 6e-17, which as a factor would cost operations everywhere after it and mean nothing.
    """
    angle = ca.SX(angle)
    if angle.is_constant():
        value = float(angle)
        quarter_turns = round(value / (math.pi / 2))
        if abs(value - quarter_turns * math.pi / 2) < 1e-15 * max(1, abs(quarter_turns)):
            cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter_turns % 4]
            return ca.SX(cosine), ca.SX(sine)
    return ca.cos(angle), ca.sin(angle)


def rotation_about(axis: str, angle: Expression) -> Transform:
    cosine, sine = cos_sin(angle)
    places, numbers = {  # column by column
        "x": (([0, 1, 2, 1, 2], [0, 1, 1, 2, 2]), (1, cosine, sine, -sine, cosine)),
        "y": (([0, 2, 1, 0, 2], [0, 0, 1, 2, 2]), (cosine, -sine, 1, sine, cosine)),
        "z": (([0, 1, 0, 1, 2], [0, 0, 1, 1, 2]), (cosine, sine, -sine, cosine, 1)),
    }[axis]
    rotation = ca.SX(ca.Sparsity.triplet(3, 3, *places), ca.vertcat(*numbers))
    return Transform(ca.sparsify(rotation), ca.SX(3, 1))


def translation_along(axis: str, distance: Expression) -> Transform:
    return translation(*[distance if axis == name else 0.0 for name in "xyz"])


def skew(vector: Expression) -> Expression:
    x, y, z = vector[0], vector[1], vector[2]
    zero = ca.SX(1, 1)
    return ca.vertcat(ca.horzcat(zero, -z, y), ca.horzcat(z, zero, -x), ca.horzcat(-y, x, zero))


def rotation_about_unit(axis: Expression, angle: Expression) -> Expression:
    """The rotation matrix of ``angle`` (rad) about a unit vector (3x1). Rodrigues' formula [Murray1994]."""
    cosine, sine = cos_sin(angle)
    cross = skew(axis)
    return ca.sparsify(ca.SX.eye(3) + sine * cross + (1 - cosine) * ca.mtimes(cross, cross))


def small_rotation(vector: Expression) -> Expression:
    """The rotation matrix of a rotation vector (3x1, rad), smooth at zero.

    Rodrigues' formula [Murray1994] with both of its coefficients as power series in the squared angle: exact to double
    precision below one radian, far more than an elastic deflection or an increment is.
    """
    squared = ca.dot(vector, vector)
    sinc, versine = ca.SX(0), ca.SX(0)
    for term in reversed(range(_SERIES_TERMS)):
        sign = (-1) ** term
        sinc = sinc * squared + sign / math.factorial(2 * term + 1)
        versine = versine * squared + sign / math.factorial(2 * term + 2)
    cross = skew(vector)
    return ca.SX.eye(3) + sinc * cross + versine * ca.mtimes(cross, cross)


def rotation_vector(rotation: Expression) -> Expression:
    """The rotation vector (3x1, rad; up to pi long) of a rotation matrix (3x3): the logarithm, smooth at zero.

    By the quaternion (w > 0), halved until the arcsine's power series is exact to double precision. [Murray1994]
    Nothing is divided by the angle, and nothing branches. At pi the vector jumps to the other end of its axis; short
    of it by d rad, rounding is about 1e-16 / d rad.
    """
    r = rotation
    vector = ca.vertcat(r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]) + _NO_AXIS
    real = 1 + ca.trace(r)
    length = ca.sqrt(real * real + ca.dot(vector, vector))
    real, vector = real / length, vector / length
    for _ in range(_HALVINGS):
        real = ca.sqrt((1 + real) / 2)
        vector = vector / (2 * real)
    squared, factor = ca.dot(vector, vector), ca.SX(0)
    for term in reversed(range(_ARCSINE_TERMS)):
        factor = factor * squared + math.comb(2 * term, term) / (4**term * (2 * term + 1))
    return 2 ** (_HALVINGS + 1) * factor * vector


def screw_motion(angular: Expression, linear: Expression, displacement: Expression) -> Transform:
    """exp(screw * displacement) of a unit revolute screw through the origin, or a prismatic one. [Murray1994]

    ``angular`` is a unit vector (3x1) or structurally zero; ``linear`` (3x1) is the direction of a prismatic joint.
    """
    if ca.SX(angular).nnz() == 0:
        return Transform(ca.SX.eye(3), linear * displacement)
    return Transform(rotation_about_unit(angular, displacement), ca.SX(3, 1))


def solve_near_identity(matrix: Expression, right: Expression) -> Expression:
    """matrix^-1 right by elimination without pivoting [Golub2013]: a third of the operations of CasADi's own solve.

    For matrices that differ little from the identity, as one minus the slope of a contraction does.
    """
    whole, size = ca.horzcat(ca.densify(matrix), ca.densify(right)), matrix.size1()
    rows = [whole[i, :] for i in range(size)]
    for i in range(size):
        for j in range(i + 1, size):
            factor = rows[j][i] / rows[i][i]
            rows[j] = ca.horzcat(rows[j][: i + 1], rows[j][i + 1 :] - factor * rows[i][i + 1 :])
    solved: list[Expression] = [None] * size
    for i in reversed(range(size)):
        known = [rows[i][k] * solved[k] for k in range(i + 1, size)]
        solved[i] = (rows[i][size:] - sum(known, ca.SX(0))) / rows[i][i]
    return ca.vertcat(*solved)


def turning_motion(angular: Expression, linear: Expression, displacement: Expression) -> Transform:
    """exp(twist * displacement) of a twist that turns: ``angular`` (3x1, not zero) and ``linear`` (3x1, m).

    Nothing is divided by the displacement, so it is exact and smooth at zero and at any angle.
    """
    rate = ca.norm_2(angular)
    cross = skew(angular / rate)
    squared = ca.mtimes(cross, cross)
    angle = rate * displacement
    versine = 1 - ca.cos(angle)
    rotation = ca.SX.eye(3) + ca.sin(angle) * cross + versine * squared
    along = displacement * ca.SX.eye(3) + versine / rate * cross + (displacement - ca.sin(angle) / rate) * squared
    return Transform(rotation, ca.mtimes(along, linear))


def sliding_motion(angular: Expression, linear: Expression, displacement: Expression) -> Transform:
    """exp(twist * displacement) of a twist that slides, and may turn a little: ``angular`` (3x1) may be zero.

    By power series, smooth at zero ``angular``; exact to double precision while it turns by less than one radian.
    """
    vector = angular * displacement
    squared_angle = ca.dot(vector, vector)
    first, second, third = (_series(squared_angle, start) for start in (1, 2, 3))
    cross = skew(vector)
    squared = ca.mtimes(cross, cross)
    along = ca.SX.eye(3) + second * cross + third * squared
    return Transform(ca.SX.eye(3) + first * cross + second * squared, ca.mtimes(along, linear * displacement))


def _series(squared: Expression, start: int) -> Expression:
    """1/start! - squared/(start + 2)! + ..."""
    total = ca.SX(0)
    for term in reversed(range(_MOTION_TERMS)):
        total = total * squared + (-1) ** term / math.factorial(2 * term + start)
    return total
