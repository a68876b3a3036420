"""Rigid motions as expressions, against scipy's Rotation and plain matrices."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from armcal.base import se3
from scipy.spatial.transform import Rotation

AXES = "xyz"
UNITS = dict(zip(AXES, np.eye(3), strict=True))


def numbers(expression):
    return np.array(ca.DM(ca.evalf(ca.densify(ca.SX(expression)))))


def evaluated(build, *arguments):
    """What an expression of symbols gives at numbers."""
    symbols = [ca.SX.sym(f"a{i}", np.size(a)) for i, a in enumerate(arguments)]
    function = ca.Function("f", symbols, [ca.densify(build(*symbols))])
    return np.array(function(*arguments))


def made_up(random):
    """A constant motion and its matrix."""
    turn, shift = Rotation.random(random_state=random), random.normal(size=3)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), shift
    return se3.Transform(ca.SX(turn.as_matrix()), ca.SX(shift)), matrix


@pytest.mark.parametrize("axis", AXES)
def test_a_turn_about_a_coordinate_axis_is_scipys(axis):
    for angle in np.random.default_rng(0).uniform(-7, 7, 50):
        found = evaluated(lambda a: se3.rotation_about(axis, a).rotation, angle)
        expected = Rotation.from_rotvec(angle * UNITS[axis]).as_matrix()
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("quarters", [-1000, -5, -4, -3, -2, -1, 0, 1, 2, 3, 4, 5, 7, 1001])
def test_constant_right_angles_are_exact(axis, quarters):
    found = numbers(se3.rotation_about(axis, quarters * math.pi / 2).rotation)
    expected = np.round(Rotation.from_rotvec(quarters % 4 * math.pi / 2 * UNITS[axis]).as_matrix())
    assert np.array_equal(found, expected)


@pytest.mark.parametrize("angle", [1e-12, math.pi / 2 + 1e-12, math.radians(90.0001), -math.pi + 1e-9, 1e-14])
def test_an_angle_near_a_right_angle_is_not_rounded_to_it(angle):
    found = numbers(se3.rotation_about("z", angle).rotation)
    assert found[1, 0] == pytest.approx(math.sin(angle), rel=1e-15, abs=0)
    assert found[0, 0] == pytest.approx(math.cos(angle), rel=1e-15, abs=0)


def test_a_right_angle_as_a_parameter_is_still_differentiated():
    angle = ca.SX.sym("angle")
    slope = ca.jacobian(ca.vec(se3.rotation_about("x", angle).rotation), angle)
    found = np.array(ca.Function("f", [angle], [ca.densify(slope)])(math.pi / 2)).reshape(3, 3).T
    np.testing.assert_allclose(found, [[0, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-15)


def test_zeros_of_turns_and_shifts_cost_nothing():
    assert se3.rotation_about("z", math.pi / 2).rotation.nnz() == 3
    assert se3.translation(0, 0, ca.SX.sym("z")).translation.nnz() == 1
    assert se3.translation_along("y", 0.0).translation.nnz() == 0


def test_translations_go_along_their_own_axis():
    for axis, unit in UNITS.items():
        np.testing.assert_array_equal(numbers(se3.translation_along(axis, 0.3).translation).ravel(), 0.3 * unit)


def test_composition_inverse_and_points_are_those_of_homogeneous_matrices():
    random = np.random.default_rng(1)
    for _ in range(30):
        (one, a), (two, b), point = made_up(random), made_up(random), random.normal(size=3)
        np.testing.assert_allclose(numbers((one @ two).matrix()), a @ b, rtol=0, atol=1e-14)
        np.testing.assert_allclose(numbers(one.inverse().matrix()), np.linalg.inv(a), rtol=0, atol=1e-14)
        np.testing.assert_allclose(numbers(one.apply(ca.SX(point))).ravel(), (a @ [*point, 1])[:3], rtol=0, atol=1e-14)
        np.testing.assert_allclose(numbers((one @ one.inverse()).matrix()), np.eye(4), rtol=0, atol=1e-14)


def test_the_identity_changes_nothing():
    one, a = made_up(np.random.default_rng(2))
    np.testing.assert_array_equal(numbers((se3.identity() @ one).matrix()), a)
    np.testing.assert_array_equal(numbers((one @ se3.identity()).matrix()), a)


def test_skew_is_the_cross_product():
    random = np.random.default_rng(3)
    a, b = random.normal(size=3), random.normal(size=3)
    np.testing.assert_allclose(evaluated(se3.skew, a) @ b, np.cross(a, b), rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-4, 0.01, 0.3, 0.9, 0.999])
def test_a_small_rotation_is_exact_from_nothing_to_a_radian(angle):
    random = np.random.default_rng(4)
    for _ in range(10):
        axis = random.normal(size=3)
        vector = angle * axis / np.linalg.norm(axis)
        found = evaluated(se3.small_rotation, vector)
        np.testing.assert_allclose(found, Rotation.from_rotvec(vector).as_matrix(), rtol=0, atol=5e-16)
        np.testing.assert_allclose(found @ found.T, np.eye(3), rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.9])
def test_a_small_rotation_has_the_slope_and_curvature_of_the_exponential(angle):
    vector = ca.SX.sym("v", 3)
    matrix = ca.vec(se3.small_rotation(vector))
    slope = ca.jacobian(matrix, vector)
    twice = ca.jacobian(ca.vec(slope), vector)
    function = ca.Function("f", [vector], [ca.densify(slope), ca.densify(twice)])
    at = angle * np.array([2.0, -3, 6]) / 7
    first, second = (np.array(m) for m in function(at))
    step = 1e-5
    for column, shift in enumerate(step * np.eye(3)):
        ahead, behind = (Rotation.from_rotvec(at + s * shift).as_matrix().T.ravel() for s in (1, -1))
        np.testing.assert_allclose(first[:, column], (ahead - behind) / (2 * step), rtol=0, atol=1e-9)
        one, two = (np.array(function(at + s * shift)[0]) for s in (1, -1))
        curvature = ((one - two) / (2 * step)).T.ravel()
        np.testing.assert_allclose(second[:, column], curvature, rtol=0, atol=1e-8)


def test_a_turn_about_any_unit_vector_is_scipys():
    random = np.random.default_rng(5)
    for angle in random.uniform(-4, 4, 30):
        axis = random.normal(size=3)
        axis /= np.linalg.norm(axis)
        found = evaluated(se3.rotation_about_unit, axis, angle)
        np.testing.assert_allclose(found, Rotation.from_rotvec(angle * axis).as_matrix(), rtol=0, atol=2e-15)


def test_a_screw_motion_turns_or_slides():
    axis, amount = np.array([0.6, 0.0, 0.8]), 0.7
    turned = se3.screw_motion(ca.SX(axis), ca.SX(3, 1), amount)
    np.testing.assert_allclose(
        numbers(turned.rotation), Rotation.from_rotvec(amount * axis).as_matrix(), rtol=0, atol=2e-16
    )
    slid = se3.screw_motion(ca.SX(3, 1), ca.SX(axis), amount)
    np.testing.assert_allclose(numbers(slid.translation).ravel(), amount * axis, rtol=0, atol=1e-16)
    np.testing.assert_array_equal(numbers(slid.rotation), np.eye(3))
