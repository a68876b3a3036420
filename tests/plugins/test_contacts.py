"""Sockets, clamps, planes and closed chains against numpy and scipy."""

from __future__ import annotations

from dataclasses import replace

import contact_oracle as co
import numpy as np
import pytest
from armcal.base import se3
from armcal.errors import InputError
from armcal.estimate.identifiability import require_solvable
from armcal.estimate.polish import restricted, settled, started, untrained
from armcal.problem.variants import with_joint_noise
from armcal_contact.contacts import BallInSocket, ClampedTool, PlaneContact
from armcal_dualarm.two_arms import ClosedChain
from armcal_ipopt.estimator import IpoptEstimator
from contact_oracle import LEFT
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

needs_logarithm = pytest.mark.skipif(not hasattr(se3, "rotation_vector"), reason="no logarithm of rotations yet")
MM, MRAD = 1e-3, 1e-3


def solved(problem, records):
    """The started problem and its optimum by entry name."""
    begun = started(problem.with_records(records))
    solution = IpoptEstimator(IpoptEstimator.Settings()).solve(begun, begun.parameters.nominal())
    assert solution.verdict.converged, solution.verdict.status
    return begun, solution.values


def matrix(position, rotation):
    """A pose (4 x 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose


def pose_in(v, name):
    """A pose that stands in values by entry name."""
    parts = [v[n] for n in v if n.startswith(f"{name}_rotation[")]
    rotation = Rotation.from_quat([*parts[1:], parts[0]])
    return matrix([v[f"{name}_{axis}"] for axis in "xyz"], rotation)


def difference(here, there):
    """Position (m) and rotation vector (rad) of one pose in another (N x 6)."""
    between = np.linalg.inv(here) @ there
    turned = Rotation.from_matrix(between[:, :3, :3]).as_rotvec()
    return np.hstack([between[:, :3, 3], turned])


def state(position, rotation):
    """A pose as settings."""
    x, y, z, w = rotation.as_quat()
    return {"position": tuple(position), "quaternion": (w, x, y, z)}


# ---------------------------------------------------------------- planes


def on_plane(normal, offset, tip=(0, 0, 0)):
    """How far the tip of a tool is beyond a plane (N x 1)."""
    return lambda poses: ((poses @ np.array([*tip, 1.0]))[:, :3] @ np.array(normal) - offset)[:, None]


def touches_of_plane(normal, offset, tip, count, seed, scatter):
    """Joint angles whose tip lies on a plane, but for the scatter across it."""
    off = np.random.default_rng(seed).normal(0, scatter, count)
    each = [co.touching(LEFT, on_plane(normal, offset + x, tip), 1, 100 * seed + i) for i, x in enumerate(off)]
    return np.concatenate(each)


@pytest.mark.parametrize("stated", [(0.0, 0.0, 1.0), (0.3, -1.0, 0.2), (-1.0, 0.0, 0.0)], ids=str)
@pytest.mark.parametrize("tilt", [0.02, 0.6, 1.3])
@pytest.mark.slow
def test_the_plane_found_is_the_one_of_least_squares(stated, tilt):
    """With an exact arm nothing is left but the plane: that of the smallest singular value of the points."""
    mean = np.array(stated) / np.linalg.norm(stated)
    across = np.cross(mean, [0.3, 0.5, 0.81])
    normal = Rotation.from_rotvec(tilt * across / np.linalg.norm(across)).apply(mean)
    tip = (0.0, 0.01, 0.06)
    q = touches_of_plane(normal, normal @ [0.25, 0.1, 0.25], tip, 12, 3, 0.3 * MM)
    plane = PlaneContact(PlaneContact.Settings.si(noise=0.3 * MM, tip=tip, normal=stated), ("arm",))
    data = co.dataset([(co.joints(q), {"plane": "table"})])
    problem, records = co.Bench({"arm": co.the_arm(LEFT)}, {"plane": plane}).problem(data)
    begun, values = solved(problem, records)
    points = co.points(LEFT, q, tip)
    centre = points.mean(axis=0)
    best = np.linalg.svd(points - centre)[2][2]
    best = best * np.sign(best @ normal)
    v = co.by_name(begun.parameters, values)
    assert v["plane.table.offset"] == pytest.approx(best @ centre, abs=1e-9)
    left = begun.with_records(records).residuals(values)[0][0]
    np.testing.assert_allclose(left, (points - centre) @ best, atol=1e-9)
    assert np.hypot(v["plane.table.tilt_1"], v["plane.table.tilt_2"]) == pytest.approx(np.arccos(best @ mean), abs=1e-8)


def test_two_planes_and_a_length_of_the_arm_come_back_together():
    truth = {**co.named(LEFT), "arm.mdh.theta3": 0.01}
    parts = []
    for number, (name, normal) in enumerate({"table": (0, 0, 1), "wall": (0.6, 0, 0.8)}.items()):
        at = on_plane(normal, 0.2 + 0.1 * number)
        parts.append((co.joints(co.touching(LEFT, at, 14, 5 + number, truth)), {"plane": name}))
    plane = PlaneContact(PlaneContact.Settings.si(noise=0.1 * MM, normal=(0.2, 0, 1)), ("arm",))
    made = co.Bench({"arm": co.the_arm(LEFT)}, {"plane": plane}, ("arm.mdh.theta3",))
    problem, records = made.problem(co.dataset(parts))
    require_solvable(problem.with_records(records), problem.parameters.nominal())
    begun, values = solved(problem, records)
    v = co.by_name(begun.parameters, values)
    assert v["arm.mdh.theta3"] == pytest.approx(0.01, abs=1e-7)
    assert [v["plane.table.offset"], v["plane.wall.offset"]] == pytest.approx([0.2, 0.3], abs=1e-7)


# ---------------------------------------------------------------- clamps

HOLD = matrix((0.25, 0.1, 0.3), Rotation.from_euler("xyz", [170, 20, -60], degrees=True))


def clamp(**settings):
    chosen = {"noise": 0.1 * MM, "orientation_noise": 0.5 * MRAD, **settings}
    return ClampedTool(ClampedTool.Settings.si(**chosen), ("arm",))


def held(pose):
    """What a clamp leaves open (N x 6)."""
    return lambda poses: difference(np.broadcast_to(pose, poses.shape), poses)


def clamped(pose, count, seed, scatter=0.0, v=None):
    q = co.touching(co.SEVEN, held(pose), count, seed, v)
    return q + np.random.default_rng(seed).normal(0, 1, q.shape) * scatter


def clamp_bench(measurement, free=(), **changed):
    return co.Bench({"arm": co.the_arm(co.SEVEN)}, {"clamp": measurement}, free, **changed)


@needs_logarithm
def test_what_a_clamp_leaves_open_is_the_pose_of_the_tool_in_it():
    random = np.random.default_rng(3)
    fixture = (random.normal(0, 0.3, 3), Rotation.random(random_state=4))
    point = (random.normal(0, 0.3, 3), Rotation.random(random_state=5))
    q = co.random_joints(co.SEVEN, 20, 6)
    measurement = clamp(fixture=state(*fixture), points={"bench": state(*point)})
    problem, records = clamp_bench(measurement).problem(co.dataset([(co.joints(q), {"point": "bench"})]))
    assert problem.parameters.free == ()
    found = problem.with_records(records).residuals(problem.parameters.nominal())[0]
    where = matrix(*fixture) @ matrix(*point)
    expected = difference(np.broadcast_to(where, (20, 4, 4)), co.tool_poses(co.SEVEN, q))
    np.testing.assert_allclose(found, expected.T, atol=1e-9)


@needs_logarithm
@pytest.mark.parametrize("turn", [0.0, 3.0, np.pi], ids=str)
def test_an_unknown_clamp_starts_at_the_tool_wherever_that_points(turn):
    pose = HOLD @ matrix((0, 0, 0), Rotation.from_rotvec([turn, 0, 0]))
    q = clamped(pose, 3, 8)
    fixture = state((0.1, 0.2, 0.0), Rotation.from_euler("z", 2.0))
    problem, records = clamp_bench(clamp(fixture=fixture)).problem(co.dataset([(co.joints(q), {"point": "bench"})]))
    begun = started(problem.with_records(records))
    assert np.abs(begun.with_records(records).residuals(begun.parameters.nominal())[0]).max() < 1e-7
    v = co.by_name(begun.parameters, begun.parameters.nominal())
    np.testing.assert_allclose(pose_in(v, "clamp.fixture") @ pose_in(v, "clamp.bench.point"), pose, atol=1e-7)


@pytest.mark.slow
@needs_logarithm
def test_a_clamp_that_only_judges_settles_at_the_pose_of_least_squares():
    q = clamped(HOLD, 6, 9, 3e-3)
    other = clamped(HOLD @ matrix((0.1, 0, 0), Rotation.identity()), 5, 10, 3e-3)
    parts = [(co.joints(q), {"point": "judged"}), (co.joints(other), {"point": "trained"})]
    problem, records = clamp_bench(clamp()).problem(co.dataset(parts))
    problem = started(problem.with_records(records))
    begun = restricted(problem.with_records(records).subset(np.arange(6, 11)))
    values = begun.parameters.nominal()
    found = settled(begun.with_records(records), values)
    poses = co.tool_poses(co.SEVEN, q)

    def rows(x):
        pose = HOLD @ matrix(x[:3], Rotation.from_rotvec(x[3:]))
        return (difference(np.broadcast_to(pose, poses.shape), poses) / [*[0.1 * MM] * 3, *[0.5 * MRAD] * 3]).ravel()

    best = least_squares(rows, np.zeros(6), x_scale=1e-2, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    expected = HOLD @ matrix(best[:3], Rotation.from_rotvec(best[3:]))
    v, before = co.by_name(problem.parameters, found), co.by_name(problem.parameters, values)
    np.testing.assert_allclose(pose_in(v, "clamp.judged.point"), expected, atol=1e-7)
    still = [n for n in v if not n.startswith("clamp.judged.")]
    assert all(v[n] == before[n] for n in still)
    assert np.abs(found - values).max() > 1e-5, "it did not move at all"
    every = co.by_name(problem.parameters, settled(untrained(problem).with_records(records), values))
    np.testing.assert_allclose(pose_in(every, "clamp.judged.point"), expected, atol=1e-7)


@pytest.mark.slow
@needs_logarithm
def test_points_known_only_to_each_other_tell_arm_and_fixture():
    truth = {**co.named(co.SEVEN), "arm.mdh.a3": 0.033, "arm.mdh.theta4": 0.004}
    fixture = matrix((0.2, 0.05, 0.1), Rotation.from_euler("xyz", [0.1, -0.2, 0.4]))
    places = {
        "one": (np.array([0.0, 0.0, 0.2]), Rotation.from_euler("xyz", [170, 20, -60], degrees=True)),
        "two": (np.array([0.12, 0.03, 0.25]), Rotation.from_euler("xyz", [150, -10, 30], degrees=True)),
        "new": (np.array([0.05, -0.2, 0.3]), Rotation.from_euler("xyz", [180, 0, 90], degrees=True)),
    }
    parts = [
        (co.joints(clamped(fixture @ matrix(*place), 5, 20 + i, 0.0, truth)), {"point": name})
        for i, (name, place) in enumerate(places.items())
    ]
    known = {name: state(*places[name]) for name in ("one", "two")}
    measurement = clamp(points=known, fixture=state((0.2, 0.05, 0.1), Rotation.identity()))
    free = ("clamp.fixture_*", "arm.mdh.a3", "arm.mdh.theta4")
    problem, records = clamp_bench(measurement, free).problem(co.dataset(parts))
    begun, values = solved(problem, records)
    v = co.by_name(begun.parameters, values)
    np.testing.assert_allclose(pose_in(v, "clamp.fixture"), fixture, atol=1e-6)
    np.testing.assert_allclose(pose_in(v, "clamp.new.point"), matrix(*places["new"]), atol=1e-6)
    assert [v["arm.mdh.a3"], v["arm.mdh.theta4"]] == pytest.approx([0.033, 0.004], abs=1e-7)


# ---------------------------------------------------------------- closed chains

ACROSS = replace(co.SEVEN, base=(("x", 0.7), ("rz", 3.0)))


def two_arms(**settings):
    chosen = {"noise": 0.1 * MM, "orientation_noise": 0.5 * MRAD, **settings}
    arms = {"left": co.the_arm(co.SEVEN, "left", 1e-3), "right": co.the_arm(ACROSS, "right", 3e-3)}
    return arms, ClosedChain(ClosedChain.Settings.si(**chosen), ("left", "right"))


def both_poses(q_left, q_right):
    return co.tool_poses(co.SEVEN, q_left), co.tool_poses(ACROSS, q_right)


@needs_logarithm
@pytest.mark.parametrize("labels", [(), ("clamp",)], ids=["one clamp", "named"])
def test_a_closed_chain_leaves_open_how_the_clamp_is_off(labels):
    q_left, q_right = co.random_joints(co.SEVEN, 9, 1), co.random_joints(co.SEVEN, 9, 2)
    key, pose = ("steel" if labels else "one"), (np.array([0.01, 0.02, 0.05]), Rotation.random(random_state=3))
    arms, chain = two_arms(clamps={key: state(*pose)}, group_labels=labels)
    part = ({**co.joints(q_left, "left"), **co.joints(q_right, "right")}, dict.fromkeys(labels, key))
    problem, records = co.Bench(arms, {"chain": chain}).problem(co.dataset([part]))
    found = problem.with_records(records).residuals(problem.parameters.nominal())[0]
    left, right = both_poses(q_left, q_right)
    np.testing.assert_allclose(found, difference(left @ matrix(*pose), right).T, atol=1e-9)
    told, _ = problem.with_records(records).nuisance_starts(problem.parameters.nominal()), None
    between = np.linalg.inv(left) @ right
    np.testing.assert_allclose(told[0][:3].T, between[:, :3, 3], atol=1e-12)
    turned = Rotation.from_quat(told[0][[4, 5, 6, 3]].T).as_matrix()
    np.testing.assert_allclose(turned, between[:, :3, :3], atol=1e-10)


@needs_logarithm
def test_both_arms_of_a_closed_chain_bring_the_noise_of_their_joints():
    q_left, q_right = co.random_joints(co.SEVEN, 2, 1), co.random_joints(co.SEVEN, 2, 2)
    arms, chain = two_arms()
    data = co.dataset([({**co.joints(q_left, "left"), **co.joints(q_right, "right")}, {})])
    problem, records = co.Bench(arms, {"chain": chain}).problem(data)
    problem = started(problem.with_records(records))
    values = problem.parameters.nominal()
    v = co.by_name(problem.parameters, values)
    clamp_pose = pose_in(v, "chain.one.clamp")
    columns = []
    for side, sd in ((0, 1e-3), (1, 3e-3)):
        for step in 1e-6 * np.eye(7):
            ends = []
            for sign in (1, -1):
                q = [q_left.copy(), q_right.copy()]
                q[side] += sign * step
                left, right = both_poses(*q)
                ends.append(difference(left @ clamp_pose, right))
            columns.append(sd * (ends[0] - ends[1]) / 2e-6)
    slopes = np.stack(columns, axis=-1)
    own = np.diag([0.1 * MM] * 3 + [0.5 * MRAD] * 3) ** 2
    whitening = np.moveaxis(with_joint_noise(problem.with_records(records), values).records[0].whitening, 2, 0)[:2]
    covariance = own + slopes @ np.swapaxes(slopes, 1, 2)
    np.testing.assert_allclose(
        whitening @ covariance @ np.swapaxes(whitening, 1, 2), np.tile(np.eye(6), (2, 1, 1)), atol=2e-5
    )


@pytest.mark.slow
@needs_logarithm
def test_two_arms_that_hold_each_other_tell_a_length_of_either_and_the_clamp():
    truth = {**co.named(co.SEVEN, "left"), "left.mdh.a3": 0.033}
    middle = co.random_joints(co.SEVEN, 2, 5).ravel()

    def between(q):
        left = co.tool_poses(co.SEVEN, q[:, :7], truth, "left")
        return np.linalg.inv(left) @ co.tool_poses(ACROSS, q[:, 7:])

    hold = between(middle[None])[0]
    around = middle + np.random.default_rng(6).uniform(-0.6, 0.6, (30, 14))
    q = co.at_rest(lambda q: held(hold)(between(q)), around)
    q = q[np.abs(held(hold)(between(q))).max(axis=1) < 1e-12][:12]
    assert len(q) == 12
    parts = [({**co.joints(q[:, :7], "left"), **co.joints(q[:, 7:], "right")}, {})]
    arms, chain = two_arms()
    problem, records = co.Bench(arms, {"chain": chain}, ("left.mdh.a3",)).problem(co.dataset(parts))
    begun, values = solved(problem, records)
    v = co.by_name(begun.parameters, values)
    assert v["left.mdh.a3"] == pytest.approx(0.033, abs=1e-7)
    np.testing.assert_allclose(pose_in(v, "chain.one.clamp"), hold, atol=1e-6)


# ---------------------------------------------------------------- bad settings

ARMS = ("left", "right")
SOCKET = {"between": ("a", "b"), "distance": 0.05, "noise": 1e-4}
REFUSED = {
    "ball without noise": lambda: BallInSocket.Settings.si(noise=0.0),
    "ball with negative noise": lambda: BallInSocket.Settings.si(noise=-1e-4),
    "distance without noise": lambda: BallInSocket.Settings.si(noise=1e-4, distances=({**SOCKET, "noise": 0.0},)),
    "distance of nothing": lambda: BallInSocket.Settings.si(noise=1e-4, distances=({**SOCKET, "distance": 0.0},)),
    "one socket twice": lambda: BallInSocket.Settings.si(noise=1e-4, distances=({**SOCKET, "between": ("a", "a")},)),
    "plane without noise": lambda: PlaneContact.Settings.si(noise=0.0),
    "normal of no length": lambda: PlaneContact.Settings.si(noise=1e-4, normal=(0.0, 0.0, 0.0)),
    "normal that is no number": lambda: PlaneContact.Settings.si(noise=1e-4, normal=(float("nan"), 0.0, 1.0)),
    "clamp without noise": lambda: ClampedTool.Settings.si(noise=1e-4, orientation_noise=0.0),
    "chain of one arm": lambda: ClosedChain.Settings.si(left="a", right="a", noise=1e-4, orientation_noise=1e-3),
    "chain without noise": lambda: ClosedChain.Settings.si(noise=0.0, orientation_noise=1e-3),
    "unknown arm": lambda: BallInSocket(BallInSocket.Settings.si(noise=1e-4, arm="middle"), ARMS),
    "no arm of two": lambda: PlaneContact(PlaneContact.Settings.si(noise=1e-4), ARMS),
    "unknown side": lambda: ClosedChain(
        ClosedChain.Settings.si(left="middle", noise=1e-4, orientation_noise=1e-3), ARMS
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_settings_that_make_no_sense_are_refused_in_words(case):
    with pytest.raises((ValueError, InputError)) as told:
        REFUSED[case]()
    assert any(word in str(told.value) for word in ("found", "say which", "no arm", "greater than 0", "finite"))


def test_where_one_of_two_arms_has_to_be_named_both_are():
    with pytest.raises(ValueError, match="left, right"):
        BallInSocket(BallInSocket.Settings.si(noise=1e-4), ARMS)
