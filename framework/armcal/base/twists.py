"""Motions along general twists: of any pitch, and of any length. [Murray1994]"""

from __future__ import annotations

import math

import casadi as ca

from armcal.base import se3
from armcal.base.se3 import Expression, Transform

_SERIES_TERMS = 12


def turning_motion(angular: Expression, linear: Expression, displacement: Expression) -> Transform:
    """exp(twist * displacement) of a twist that turns: ``angular`` (3x1, not zero) and ``linear`` (3x1, m).

    Nothing is divided by the displacement, so it is exact and smooth at zero and at any angle.
    """
    rate = ca.norm_2(angular)
    cross = se3.skew(angular / rate)
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
    cross = se3.skew(vector)
    squared = ca.mtimes(cross, cross)
    along = ca.SX.eye(3) + second * cross + third * squared
    return Transform(ca.SX.eye(3) + first * cross + second * squared, ca.mtimes(along, linear * displacement))


def _series(squared: Expression, start: int) -> Expression:
    """1/start! - squared/(start + 2)! + ..."""
    total = ca.SX(0)
    for term in reversed(range(_SERIES_TERMS)):
        total = total * squared + (-1) ** term / math.factorial(2 * term + start)
    return total
