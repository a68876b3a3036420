"""Domains: where a value may live, and whether increments move it as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from armcal.base.domains import Interval, Pose, Rotation, ScrewAxis, Semidefinite, symmetric
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import sqrtm
from scipy.spatial.transform import Rotation as Reference

DOMAINS = [Interval(), Rotation(), Pose(), ScrewAxis(), Semidefinite()]
ENTRIES = {"Interval": 1, "Rotation": 4, "Pose": 7, "ScrewAxis": 6, "Semidefinite": 6}
every_domain = pytest.mark.parametrize("domain", DOMAINS, ids=lambda d: type(d).__name__)
seeds = st.integers(0, 2**32 - 1)
checked = settings(max_examples=60, deadline=None, derandomize=True)


def unit(random, size):
    vector = random.normal(size=size)
    return vector / np.linalg.norm(vector)


def made_up(domain, random):
    """A value of the domain."""
    if isinstance(domain, Interval):
        return random.normal(size=1)
    if isinstance(domain, Rotation):
        return unit(random, 4)
    if isinstance(domain, Pose):
        return np.concatenate([unit(random, 4), random.normal(size=3)])
    if isinstance(domain, ScrewAxis):
        direction = unit(random, 3)
        return np.concatenate([direction, -np.cross(direction, random.normal(size=3))])
    root = random.normal(size=(3, 3)) + 2 * np.eye(3)
    matrix = root @ root.T
    return matrix[np.triu_indices(3)]


def increment(domain, random, size):
    return random.uniform(-size, size, domain.dof)


def same_value(domain, one, other, tolerance):
    """Equal as elements: a quaternion and its negative are one rotation."""
    if isinstance(domain, (Rotation, Pose)) and one[:4] @ other[:4] < 0:
        other = np.concatenate([-other[:4], other[4:]])
    np.testing.assert_allclose(one, other, rtol=0, atol=tolerance * max(1.0, np.abs(one).max()))


@every_domain
def test_the_number_of_entries_and_of_increments_is_what_every_user_of_a_block_relies_on(domain):
    random = np.random.default_rng(1)
    value = made_up(domain, random)
    assert len(domain.entries) == ENTRIES[type(domain).__name__] == len(value)
    jacobian = domain.retract_jacobian(value, np.zeros(domain.dof))
    assert jacobian.shape == (len(domain.entries), domain.dof)


@every_domain
@checked
@given(seed=seeds)
def test_local_gives_back_the_increment_that_retract_was_given(domain, seed):
    random = np.random.default_rng(seed)
    base, delta = made_up(domain, random), increment(domain, random, 0.4)
    if isinstance(domain, Semidefinite):
        # Only a semidefinite matrix is the root of its square: keep it so.
        delta *= 0.5 * math.sqrt(np.linalg.eigvalsh(symmetric(base)).min())
    found = domain.local(base, domain.retract(base, delta))
    np.testing.assert_allclose(found, delta, rtol=0, atol=1e-8 if isinstance(domain, Semidefinite) else 1e-12)


@pytest.mark.quick("Interval")
@every_domain
@checked
@given(seed=seeds)
def test_retract_by_the_local_increment_arrives_at_the_value(domain, seed):
    random = np.random.default_rng(seed)
    base, value = made_up(domain, random), made_up(domain, random)
    if isinstance(domain, ScrewAxis) and abs(base[:3] @ value[:3]) < 0.1:
        value = domain.retract(base, increment(domain, random, 1.0))
    same_value(domain, value, domain.retract(base, domain.local(base, value)), 1e-9)


@pytest.mark.quick("Interval")
@every_domain
@checked
@given(seed=seeds)
def test_no_increment_stays_where_it_is(domain, seed):
    base = made_up(domain, np.random.default_rng(seed))
    same_value(domain, base, domain.retract(base, np.zeros(domain.dof)), 1e-14)
    np.testing.assert_allclose(domain.local(base, base), 0, atol=1e-14)


@every_domain
@pytest.mark.parametrize("size", [0.0, 1e-7, 1e-4, 0.03, 0.8], ids=lambda s: f"within {s:g}")
def test_the_jacobian_of_retract_is_that_of_central_differences(domain, size):
    random = np.random.default_rng(7)
    for _ in range(20):
        base, delta, step = made_up(domain, random), increment(domain, random, size), 1e-5
        numeric = np.empty((len(domain.entries), domain.dof))
        for column, shift in enumerate(step * np.eye(domain.dof)):
            ahead, behind = domain.retract(base, delta + shift), domain.retract(base, delta - shift)
            numeric[:, column] = (ahead - behind) / (2 * step)
        found = domain.retract_jacobian(base, delta)
        np.testing.assert_allclose(found, numeric, rtol=0, atol=1e-9 * max(1.0, np.abs(found).max()))


@pytest.mark.quick("Interval")
@every_domain
@checked
@given(seed=seeds, size=st.sampled_from([1e-9, 0.1, 3.0, 50.0]))
def test_an_increment_never_leaves_the_domain(domain, seed, size):
    random = np.random.default_rng(seed)
    value = domain.retract(made_up(domain, random), increment(domain, random, size))
    assert domain.check(value) == ""
    if isinstance(domain, (Rotation, Pose)):
        assert abs(np.linalg.norm(value[:4]) - 1) < 1e-14
    if isinstance(domain, ScrewAxis):
        assert abs(np.linalg.norm(value[:3]) - 1) < 1e-14
        assert abs(value[:3] @ value[3:]) < 1e-14 * max(1.0, np.abs(value).max())
    if isinstance(domain, Semidefinite):
        lowest = np.linalg.eigvalsh(symmetric(value))[0]
        assert lowest >= -1e-13 * np.abs(value).max()


@pytest.mark.quick("Interval", "Rotation")
@every_domain
def test_repeated_retraction_does_not_drift_out_of_the_domain(domain):
    random = np.random.default_rng(3)
    value = made_up(domain, random)
    for _ in range(2000):
        value = domain.retract(value, increment(domain, random, 0.01))
    assert domain.check(value) == ""
    if not isinstance(domain, (Interval, Semidefinite)):
        assert abs(np.linalg.norm(value[: 3 if isinstance(domain, ScrewAxis) else 4]) - 1) < 1e-13


@checked
@given(seed=seeds)
def test_rotation_increments_are_rotation_vectors_in_the_moved_frame(seed):
    random = np.random.default_rng(seed)
    base, vector = unit(random, 4), random.normal(size=3)
    found = Rotation().retract(base, vector)
    expected = Reference.from_quat(base, scalar_first=True) * Reference.from_rotvec(vector)
    same_value(Rotation(), expected.as_quat(scalar_first=True), found, 1e-14)


@checked
@given(seed=seeds)
def test_rotation_local_is_the_logarithm(seed):
    random = np.random.default_rng(seed)
    base, value = unit(random, 4), unit(random, 4)
    one, two = (Reference.from_quat(q, scalar_first=True) for q in (base, value))
    np.testing.assert_allclose(Rotation().local(base, value), (one.inv() * two).as_rotvec(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-16, 1e-9, 1.0, math.pi - 1e-9, math.pi])
def test_rotation_local_holds_at_no_turn_and_at_half_a_turn(angle):
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3
    value = Rotation().retract(np.array([1.0, 0, 0, 0]), vector)
    found = Rotation().local(np.array([1.0, 0, 0, 0]), value)
    off = min(np.abs(found - vector).max(), np.abs(found + vector).max() if angle > 3 else np.inf)
    assert off <= 1e-14


@checked
@given(seed=seeds)
def test_pose_increments_compose_as_rigid_motions_in_the_moved_frame(seed):
    random = np.random.default_rng(seed)
    base, delta = made_up(Pose(), random), random.normal(size=6)
    found = Pose().retract(base, delta)
    turned = Reference.from_quat(base[:4], scalar_first=True)
    np.testing.assert_allclose(found[4:], base[4:] + turned.apply(delta[3:]), rtol=0, atol=1e-13)
    expected = (turned * Reference.from_rotvec(delta[:3])).as_quat(scalar_first=True)
    same_value(Rotation(), expected, found[:4], 1e-14)


@checked
@given(seed=seeds)
def test_a_screw_axis_turned_alone_still_passes_through_its_nearest_point(seed):
    random = np.random.default_rng(seed)
    base = made_up(ScrewAxis(), random)
    nearest = np.cross(base[:3], base[3:])
    turned = ScrewAxis().retract(base, np.array([*random.uniform(-1, 1, 2), 0, 0]))
    np.testing.assert_allclose(np.cross(turned[:3], nearest) + turned[3:], 0, atol=1e-13)
    shifted = ScrewAxis().retract(base, np.array([0, 0, *random.uniform(-1, 1, 2)]))
    np.testing.assert_allclose(shifted[:3], base[:3], rtol=0, atol=1e-15)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3)]).tolist(), ids=str)
def test_a_screw_axis_along_a_coordinate_axis_through_the_origin_has_four_independent_increments(axis):
    base = np.array([*axis, 0, 0, 0])
    assert np.linalg.matrix_rank(ScrewAxis().retract_jacobian(base, np.zeros(4)), tol=1e-6) == 4


def test_the_six_entries_of_a_semidefinite_matrix_are_its_upper_triangle_row_by_row():
    expected = [[1, 2, 3], [2, 4, 5], [3, 5, 6]]
    assert symmetric(np.array([1.0, 2, 3, 4, 5, 6])).tolist() == expected


def test_a_semidefinite_value_of_lower_rank_can_be_written_as_an_increment():
    """A fit may end with one stiff direction: everything after it starts with the increment of that value."""
    base = np.array([1.0, 0, 0, 1, 0, 1]) * 1e-3
    edge = Semidefinite().retract(base, np.array([0, 0, 0, 0, 0, -math.sqrt(1e-3)]))
    assert Semidefinite().check(edge) == ""
    found = Semidefinite().retract(base, Semidefinite().local(base, edge))
    np.testing.assert_allclose(found, edge, rtol=0, atol=1e-15)


@checked
@given(seed=seeds)
def test_an_increment_of_a_semidefinite_matrix_is_added_to_its_symmetric_root(seed):
    random = np.random.default_rng(seed)
    base, delta = made_up(Semidefinite(), random), random.normal(size=6)
    root = np.real(sqrtm(symmetric(base))) + symmetric(delta)
    found = symmetric(Semidefinite().retract(base, delta))
    np.testing.assert_allclose(found, root @ root, rtol=0, atol=1e-12 * np.abs(found).max())


@every_domain
@checked
@given(seed=seeds)
def test_coordinates_lead_to_the_place_they_were_taken_of(domain, seed):
    random = np.random.default_rng(seed)
    base, delta = made_up(domain, random), increment(domain, random, 0.1)
    coordinates = domain.coordinates(base, delta)
    back = domain.from_coordinates(base, coordinates)
    same_value(domain, domain.retract(base, delta), domain.retract(base, back), 1e-9)


@every_domain
def test_the_jacobian_of_coordinates_is_that_of_differences(domain):
    random, step = np.random.default_rng(8), 1e-6
    for _ in range(10):
        base, delta = made_up(domain, random), increment(domain, random, 0.1)
        sides = [
            [domain.coordinates(base, delta + sign * shift) for shift in step * np.eye(domain.dof)] for sign in (1, -1)
        ]
        numeric = (np.array(sides[0]) - np.array(sides[1])).T / (2 * step)
        found = domain.coordinates_jacobian(base, delta)
        np.testing.assert_allclose(found, numeric, rtol=0, atol=1e-7 * max(1.0, np.abs(found).max()))


@every_domain
def test_entries_move_with_coordinates_as_differences_say(domain):
    random, step = np.random.default_rng(9), 1e-6
    for _ in range(10):
        base, delta = made_up(domain, random), increment(domain, random, 0.05)
        at = domain.coordinates(base, delta)
        sides = []
        for sign in (1, -1):
            moved = [domain.from_coordinates(base, at + sign * shift) for shift in step * np.eye(domain.dof)]
            sides.append(np.array([domain.retract(base, one) for one in moved]))
        numeric = (sides[0] - sides[1]).T / (2 * step)
        found = domain.entries_jacobian(base, domain.from_coordinates(base, at))
        np.testing.assert_allclose(found, numeric, rtol=0, atol=1e-6 * max(1.0, np.abs(found).max()))


@checked
@given(seed=seeds)
def test_coordinates_outside_the_cone_lead_to_the_nearest_matrix_inside(seed):
    """Nearest by Frobenius' norm: negative eigenvalues become zero."""
    random = np.random.default_rng(seed)
    base = made_up(Semidefinite(), random)
    matrix = random.normal(size=(3, 3))
    matrix = matrix + matrix.T
    outside = matrix[np.triu_indices(3)] - base
    found = symmetric(Semidefinite().retract(base, Semidefinite().from_coordinates(base, outside)))
    sizes, directions = np.linalg.eigh(matrix)
    nearest = directions @ np.diag(np.maximum(sizes, 0)) @ directions.T
    np.testing.assert_allclose(found, nearest, rtol=0, atol=1e-12 * max(1.0, np.abs(base).max()))


@pytest.mark.parametrize(
    ("domain", "value"),
    [
        (Interval(0, 1), [-1e-12]),
        (Interval(0, 1), [1 + 1e-12]),
        (Interval(0, 1), [math.nan]),
        (Interval(), [math.nan]),
        (Interval(), [math.inf]),
        (Rotation(), [1, 1e-2, 0, 0]),
        (Rotation(), [0, 0, 0, 0]),
        (Rotation(), [math.nan, 0, 0, 0]),
        (Pose(), [2, 0, 0, 0, 0, 0, 0]),
        (Pose(), [1, 0, 0, 0, math.nan, 0, 0]),
        (Pose(), [1, 0, 0, 0, 0, math.inf, 0]),
        (ScrewAxis(), [0, 0, 1, 0, 0, 1e-6]),
        (ScrewAxis(), [0, 0, 1.01, 0, 0, 0]),
        (ScrewAxis(), [0, 0, 0, 1, 0, 0]),
        (ScrewAxis(), [0, 0, 1, math.nan, 0, 0]),
        (ScrewAxis(), [math.nan, 0, 1, 0, 0, 0]),
        (Semidefinite(), [1, 0, 0, -1e-6, 0, 1]),
        (Semidefinite(), [1e-3, 2e-3, 0, 1e-3, 0, 1e-3]),
        (Semidefinite(), [1, 0, 0, math.nan, 0, 1]),
        (Semidefinite(), [math.inf, 0, 0, 1, 0, 1]),
    ],
    ids=lambda x: type(x).__name__ if not isinstance(x, list) else str(x),
)
def test_a_value_outside_its_domain_is_refused_in_words(domain, value):
    assert domain.check(np.array(value, dtype=float))


@pytest.mark.parametrize(
    ("domain", "value"),
    [
        (Interval(0, 1), [0.0]),
        (Interval(0, 1), [1.0]),
        (Rotation(), [-1, 0, 0, 0]),
        (Pose(), [0, 0, 0, 1, 1e3, -1e3, 0]),
        (ScrewAxis(), [0, 0, -1, 5, -5, 0]),
        (Semidefinite(), [0, 0, 0, 0, 0, 0]),
        (Semidefinite(), [1, 1, 1, 1, 1, 1]),
    ],
    ids=lambda x: type(x).__name__ if not isinstance(x, list) else str(x),
)
def test_a_value_on_the_edge_of_its_domain_is_accepted(domain, value):
    assert domain.check(np.array(value, dtype=float)) == ""
