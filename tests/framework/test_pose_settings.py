"""Poses as configurations state them and as parameters: against scipy, round trips, and what is refused."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from armcal.base.parameters import Parameters
from armcal.base.poses import PoseSettings, pose_blocks, pose_transform, quaternion_expression, rotation_of
from armcal.base.quaternions import PRINTED, nearest_rotation, quaternion_of
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

angles = st.floats(-np.pi, np.pi, allow_nan=False)
HALF_TURNS = [Rotation.from_rotvec(np.pi * np.array(axis)) for axis in np.eye(3)]
AWKWARD = [
    Rotation.identity(),
    *HALF_TURNS,
    Rotation.from_rotvec(np.pi * np.array([1, 1, 0]) / np.sqrt(2)),
    Rotation.from_rotvec((np.pi - 1e-9) * np.array([1, 2, -2]) / 3),
    Rotation.from_rotvec([1e-12, 0, 0]),
    *Rotation.random(20, random_state=1),
]
DOUBLE_TURN = 2 * np.pi / 3
THIRDS = [Rotation.from_rotvec(DOUBLE_TURN * np.array(axis) / np.sqrt(3)) for axis in ([1, 1, 1], [-1, 1, 1])]


def as_rotation(quaternion):
    """From w, x, y, z."""
    return Rotation.from_quat([*quaternion[1:], quaternion[0]])


def stated(**values):
    return PoseSettings.si(**values)


def numbers(expression):
    return np.array(ca.DM(expression))


# ---------------------------------------------------------------- three ways to state a rotation


@pytest.mark.parametrize("rotation", AWKWARD + THIRDS)
def test_a_matrix_a_quaternion_and_their_expressions_are_one_rotation(rotation):
    matrix = rotation.as_matrix()
    x, y, z, w = rotation.as_quat()
    by_matrix = stated(rotation=tuple(map(tuple, matrix))).unit_quaternion
    by_quaternion = stated(quaternion=(w, x, y, z)).unit_quaternion
    symbolic = numbers(quaternion_expression(ca.SX(matrix))).ravel()
    for found in (by_matrix, by_quaternion, symbolic):
        assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(as_rotation(found).as_matrix(), matrix, atol=1e-12)
    np.testing.assert_allclose(numbers(rotation_of(ca.SX(list(by_quaternion)))), matrix, atol=1e-12)
    assert quaternion_of(matrix)[0] >= 0


@given(angles, angles, angles)
def test_roll_pitch_and_yaw_turn_about_the_fixed_axes_in_this_order(roll, pitch, yaw):
    found = as_rotation(stated(rpy=(roll, pitch, yaw)).unit_quaternion)
    expected = Rotation.from_euler("xyz", [roll, pitch, yaw])
    assert (found.inv() * expected).magnitude() < 1e-9


def test_no_rotation_is_no_turn_and_degrees_are_read():
    assert stated().unit_quaternion == (1.0, 0.0, 0.0, 0.0)
    written = PoseSettings.model_validate({"position_mm": [10, 20, 30], "rpy_deg": [0, 0, 90]})
    assert written.position == pytest.approx((0.01, 0.02, 0.03))
    np.testing.assert_allclose(as_rotation(written.unit_quaternion).apply([1, 0, 0]), [0, 1, 0], atol=1e-12)


def test_a_pose_survives_being_written_as_a_configuration():
    for given_pose in ({"rpy": (0.1, -0.2, 3.0)}, {"quaternion": (0.5, -0.5, 0.5, 0.5)}, {}):
        one = stated(position=(0.1, -0.2, 0.3), **given_pose)
        other = PoseSettings.model_validate(one.to_config())
        assert other.position == pytest.approx(one.position)
        np.testing.assert_allclose(other.unit_quaternion, one.unit_quaternion, atol=1e-15)


@pytest.mark.parametrize("digits", [3, 4, 6])
def test_a_printed_matrix_is_taken_for_the_nearest_rotation(digits):
    for rotation in AWKWARD:
        printed = rotation.as_matrix().round(digits)
        found = nearest_rotation(printed)
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(found) == pytest.approx(1.0)
        assert np.linalg.norm(found - printed) <= np.linalg.norm(rotation.as_matrix() - printed) + 1e-14
        taken = as_rotation(stated(rotation=tuple(map(tuple, printed))).unit_quaternion)
        assert (taken.inv() * rotation).magnitude() < 3 * 10.0**-digits


# ---------------------------------------------------------------- as parameters


def test_blocks_stand_for_the_pose_they_were_made_of():
    rotation, position = Rotation.random(random_state=7), (0.1, -0.2, 0.3)
    x, y, z, w = rotation.as_quat()
    blocks = stated(position=position, quaternion=(w, x, y, z)).blocks("here")
    assert [b.name for b in blocks] == ["here_x", "here_y", "here_z", "here_rotation"]
    found = pose_transform("here", {b.name: ca.SX(list(b.nominal)) for b in blocks})
    np.testing.assert_allclose(numbers(found.rotation), rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(numbers(found.translation).ravel(), position, atol=1e-15)


def test_any_increment_leads_to_a_rotation_and_back():
    """On the way rotations stay rotations, and small increments are rotation vectors in rad."""
    x, y, z, w = Rotation.random(random_state=8).as_quat()
    blocks = pose_blocks("here", (0, 0, 0), (w, x, y, z))
    parameters = Parameters(blocks).with_free([b.name for b in blocks])
    place, start = parameters.entries_of("here_rotation"), as_rotation((w, x, y, z))
    for seed, size in enumerate((1e-8, 1e-3, 0.5, 2.0)):
        step = size * np.random.default_rng(seed).normal(size=6)
        values = parameters.retract(step)
        assert np.linalg.norm(values[place]) == pytest.approx(1.0, abs=1e-12)
        turned = (start.inv() * as_rotation(values[place])).magnitude()
        if size < 0.1:
            assert turned == pytest.approx(np.linalg.norm(step[3:]), rel=1e-5)
        if np.linalg.norm(step[3:]) < np.pi:
            np.testing.assert_allclose(parameters.local(values), step, atol=1e-9)


def test_the_quaternion_expression_serves_a_whole_function():
    """Where its branches meet as well."""
    matrix = ca.SX.sym("r", 3, 3)
    function = ca.Function("q", [matrix], [quaternion_expression(matrix)])
    for rotation in AWKWARD + THIRDS:
        found = np.array(function(rotation.as_matrix())).ravel()
        assert (as_rotation(found).inv() * rotation).magnitude() < 1e-7


# ---------------------------------------------------------------- refused

MIRROR = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))
STRETCHED = ((1.0 + 3 * PRINTED, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
REFUSED = {
    "a reflection": ({"rotation": MIRROR}, "reflection"),
    "two axes swapped": ({"rotation": ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))}, "reflection"),
    "a stretched matrix": ({"rotation": STRETCHED}, "no rotation"),
    "a matrix of zeros": ({"rotation": ((0.0,) * 3,) * 3}, "found"),
    "a matrix in degrees": ({"rotation": ((90.0, 0.0, 0.0), (0.0, 90.0, 0.0), (0.0, 0.0, 90.0))}, "no rotation"),
    "a long quaternion": ({"quaternion": (1.0, 0.0, 0.0, 1.0)}, "length 1.4142, expected 1"),
    "a quaternion of nothing": ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "length 0.0000"),
    "a quaternion of three": ({"quaternion": (1.0, 0.0, 0.0)}, "quaternion"),
    "two rows": ({"rotation": MIRROR[:2]}, "rotation"),
    "two ways at once": ({"quaternion": (1.0, 0.0, 0.0, 0.0), "rpy": (0.0, 0.0, 0.0)}, "quaternion and rpy"),
    "no number": ({"rotation": ((float("nan"), 0.0, 0.0), *MIRROR[1:])}, "finite"),
    "no number in a quaternion": ({"quaternion": (float("nan"), 0.0, 0.0, 0.0)}, "finite"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_pose_is_refused_in_words(case):
    values, word = REFUSED[case]
    with pytest.raises(ValidationError, match=word):
        stated(**values)


def test_angles_without_a_unit_are_refused():
    with pytest.raises(ValidationError, match="rpy"):
        PoseSettings.model_validate({"rpy": [0, 0, 90]})
