"""The simulator of contacts: postures that truly touch by numpy, noise of the stated size, faults in words."""

from __future__ import annotations

from dataclasses import replace

import contact_oracle as co
import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.errors import ConfigError
from armcal.estimate.estimator import estimate
from armcal.estimate.polish import started
from armcal.estimate.simulation import SimulationRequest
from armcal.measure.reader import ReadRequest, requested_channels
from armcal.measure.tables import write_csv
from armcal.problem.variants import with_joint_noise
from armcal_contact.contacts import ClampedTool, PlaneContact
from armcal_dualarm.two_arms import ClosedChain
from armcal_ipopt.estimator import IpoptEstimator
from armcal_simulation.simulators import ContactsSettings, ContactsSimulator
from armcal_tracker.csv_reader import CsvReader, CsvSettings
from contact_oracle import BALL, LEFT, RIGHT, SPOTS, ball
from scipy.spatial.transform import Rotation

NO_RECORDS = Dataset((), {}, {"position": (), "socket": (), "plane": (), "point": ()})
TRUTH = {
    **{f"balls.{key}.{axis}": x for key, spot in SPOTS.items() for axis, x in zip("xyz", spot, strict=True)},
    "left.mdh.a2": 0.303,
    "left.mdh.theta3": 0.01,
}
KEYS = ("front/hole_0", "shelf/hole_0")
TRUTH_OF_KEYS = {n: x for n, x in TRUTH.items() if n.startswith("balls.") and n.split(".")[1] in KEYS}
TRUTH_OF_FRONT = {n: x for n, x in TRUTH_OF_KEYS.items() if KEYS[0] in n}


def sockets(joint_noise=0.0, **settings):
    """One arm and its sockets."""
    arm = co.the_arm(LEFT, "left", joint_noise)
    return co.Bench({"left": arm}, {"balls": ball(("left",), **settings)}, ("left.mdh.a2", "left.mdh.theta3"))


def shared_sockets():
    """Two arms and the sockets of the left one."""
    arms = {"left": co.the_arm(LEFT, "left"), "right": co.the_arm(RIGHT, "right")}
    measurements = {"balls": ball(), "others": ball(arm="right", centre=(0, 0, 0), sockets_of="balls")}
    return co.Bench(arms, measurements)


def request_for(made):
    return SimulationRequest(made.arms, made.measurements, made.parameters(NO_RECORDS), co.SURROUNDINGS)


def simulated(tmp_path, made, groups, truth=None, **settings):
    """Records of a simulator with the truth in a file."""
    path = tmp_path / "truth.yaml"
    chosen = truth or {n: x for n, x in TRUTH.items() if not n.startswith("balls.") or n.split(".")[1] in KEYS}
    unit = {n: "rad" if "theta" in n or "tilt" in n else "m" for n in chosen}
    path.write_text("".join(f"{n}: {float(x)!r} {unit[n]}\n" for n, x in chosen.items()) or "{}\n", encoding="utf-8")
    settings = {"truth": str(path), "groups": groups, "count": 6, "within": 1.2, **settings}
    return ContactsSimulator(ContactsSettings.si(**settings)).simulate(request_for(made))


def angles(data, arm, joints=4):
    return np.stack([data.channels[f"{arm}.q{i}"] for i in range(1, joints + 1)], axis=1)


def test_every_posture_has_the_ball_in_its_socket(tmp_path):
    data = simulated(tmp_path, sockets(), {"balls": KEYS})
    assert len(data) == 12
    at = co.points(LEFT, angles(data, "left"), BALL, TRUTH, "left")
    keys = [f"{p}/{s}" for p, s in zip(data.extra["position"], data.extra["socket"], strict=True)]
    assert keys == [key for key in KEYS for _ in range(6)]
    np.testing.assert_allclose(at, [SPOTS[key] for key in keys], atol=1e-8)
    wrong = co.points(LEFT, angles(data, "left"), BALL, None, "left")
    assert np.abs(wrong - at).max() > 1e-3, "the truth is the nominal arm: the test is empty"
    assert np.unique(angles(data, "left").round(6), axis=0).shape[0] == 12
    assert np.abs(angles(data, "left")).max() <= 1.5 * 1.2


def test_the_same_seed_gives_the_same_records_and_another_seed_others(tmp_path):
    one, again, other = (simulated(tmp_path, sockets(1e-3), {"balls": KEYS}, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(angles(one, "left"), angles(again, "left"))
    assert one.ids == again.ids
    assert np.abs(angles(one, "left") - angles(other, "left")).max() > 1e-2


@pytest.mark.parametrize(
    ("of_arm", "stated", "expected"), [(2e-3, None, 2e-3), (2e-3, 5e-4, 5e-4), (2e-3, 0.0, 0.0), (0.0, 1e-3, 1e-3)]
)
@pytest.mark.slow
def test_joints_read_with_the_noise_that_is_stated_last(tmp_path, of_arm, stated, expected):
    chosen = {} if stated is None else {"joint_noise": stated}
    data = simulated(tmp_path, sockets(of_arm), {"balls": KEYS}, count=150, **chosen)
    exact = simulated(tmp_path, sockets(of_arm), {"balls": KEYS}, count=150, joint_noise=0.0)
    off = angles(data, "left") - angles(exact, "left")
    assert off.std() == pytest.approx(expected, rel=0.08, abs=1e-15)
    assert off.std(axis=0) == pytest.approx(np.full(4, expected), rel=0.15, abs=1e-15)
    assert np.abs(off.mean(axis=0)).max() <= 4 * expected / np.sqrt(len(off))


def test_two_arms_touch_the_same_sockets_under_ids_of_their_own(tmp_path):
    data = simulated(tmp_path, shared_sockets(), {"balls": KEYS[:1], "others": KEYS}, TRUTH_OF_KEYS)
    left = ~np.isnan(data.channels["left.q1"])
    assert left.tolist() == [True] * 6 + [False] * 12
    assert (~np.isnan(data.channels["right.q1"]) == ~left).all()
    at = co.points(RIGHT, angles(data, "right")[~left], (0, 0, 0), None, "right")
    keys = [f"{p}/{s}" for p, s in zip(data.extra["position"], data.extra["socket"], strict=True)]
    np.testing.assert_allclose(at, [SPOTS[key] for key in keys[6:]], atol=1e-8)
    assert len(set(data.ids)) == len(data), "ids stand twice"


def test_sockets_that_only_the_borrower_takes_up_lie_where_the_truth_says(tmp_path):
    data = simulated(tmp_path, shared_sockets(), {"others": KEYS[:1]}, TRUTH_OF_FRONT)
    at = co.points(RIGHT, angles(data, "right"), (0, 0, 0), None, "right")
    np.testing.assert_allclose(at, [SPOTS[KEYS[0]]] * 6, atol=1e-8)


def test_postures_lie_about_the_angles_asked_for(tmp_path):
    middle = co.touching(LEFT, co.in_socket(SPOTS[KEYS[0]], BALL), 1, 2)[0]
    around = {"left": {f"q{i}": float(x) for i, x in enumerate(middle, 1)}}
    data = simulated(tmp_path, sockets(), {"balls": KEYS[:1]}, TRUTH_OF_FRONT, around=around, within=0.4)
    assert np.abs(angles(data, "left") - middle).max() <= 1.5 * 0.4


def test_planes_clamps_and_closed_chains_hold_too(tmp_path):
    plane = PlaneContact(PlaneContact.Settings.si(noise=1e-4), ("arm",))
    tilted = {"plane.table.offset": 0.2, "plane.table.tilt_1": 0.2, "plane.table.tilt_2": -0.1}
    made = co.Bench({"arm": co.the_arm(LEFT)}, {"plane": plane})
    data = simulated(tmp_path, made, {"plane": ("table",)}, tilted, count=10)
    at = co.points(LEFT, angles(data, "arm"))
    normal = np.linalg.svd(at - at.mean(axis=0))[2][2]
    assert np.abs((at - at.mean(axis=0)) @ normal).max() < 1e-8
    assert abs(normal[2]) == pytest.approx(np.cos(np.hypot(0.2, 0.1)), abs=1e-7)
    assert abs(normal @ at[0]) == pytest.approx(0.2, abs=1e-7)

    turn = Rotation.from_euler("xyz", [170, 20, -60], degrees=True)
    x, y, z, w = turn.as_quat()
    known = {"position": (0.25, 0.1, 0.3), "quaternion": (w, x, y, z)}
    settings = ClampedTool.Settings.si(noise=1e-4, orientation_noise=5e-4, points={"bench": known})
    made = co.Bench({"arm": co.the_arm(co.SEVEN)}, {"clamp": ClampedTool(settings, ("arm",))})
    data = simulated(tmp_path, made, {"clamp": ("bench",)}, {"arm.mdh.a3": 0.032}, count=4, within=1.8)
    poses = co.tool_poses(co.SEVEN, angles(data, "arm", 7), {"arm.mdh.a3": 0.032})
    np.testing.assert_allclose(poses[:, :3, 3], [known["position"]] * 4, atol=1e-8)
    np.testing.assert_allclose(poses[:, :3, :3], [turn.as_matrix()] * 4, atol=1e-7)

    across = replace(co.SEVEN, base=(("x", 0.7), ("rz", 3.0)))
    arms = {"left": co.the_arm(co.SEVEN, "left"), "right": co.the_arm(across, "right")}
    grip = {"position": (0.0, 0.0, 0.05), "quaternion": (0.0, 1.0, 0.0, 0.0)}
    chain = ClosedChain(ClosedChain.Settings.si(noise=1e-4, orientation_noise=5e-4, clamps={"one": grip}), tuple(arms))
    data = simulated(tmp_path, co.Bench(arms, {"chain": chain}), {"chain": ("one",)}, {"left.mdh.a3": 0.03}, count=3)
    left, right = (co.tool_poses(c, angles(data, n, 7)) for c, n in ((co.SEVEN, "left"), (across, "right")))
    between = np.linalg.inv(left) @ right
    np.testing.assert_allclose(between[:, :3, 3], [grip["position"]] * 3, atol=1e-8)
    np.testing.assert_allclose(between[:, :3, :3], [np.diag([1.0, -1.0, -1.0])] * 3, atol=1e-7)


def test_records_and_labels_come_back_from_a_csv(tmp_path):
    made = shared_sockets()
    data = simulated(tmp_path, made, {"balls": KEYS[:1], "others": KEYS}, TRUTH_OF_KEYS, joint_noise=1e-3)
    wanted = requested_channels(made.arms, made.measurements, measured=True)
    path = tmp_path / "touches.csv"
    write_csv(path, data, wanted)
    back = CsvReader(CsvSettings.si(path=str(path))).read(ReadRequest(made.arms, made.measurements, wanted))
    assert back.ids == data.ids
    assert {k: v for k, v in back.extra.items() if k in ("position", "socket")} == dict(data.extra)
    for channel, values in data.channels.items():
        np.testing.assert_allclose(back.channels[channel], values, rtol=1e-14, equal_nan=True)
    one, records = made.problem(data)
    other, again = made.problem(back)
    values = co.away(one.parameters, 0.2, 1)
    assert other.with_records(again).cost(values) == pytest.approx(one.with_records(records).cost(values), rel=1e-9)


def test_what_was_simulated_is_found_within_its_intervals(tmp_path):
    data = simulated(tmp_path, sockets(1e-3), {"balls": KEYS}, count=15)
    problem, records = sockets(1e-3, noise=1e-6).problem(data)
    problem = started(problem.with_records(records))
    records = with_joint_noise(problem.with_records(records), problem.parameters.nominal()).records
    solution = IpoptEstimator(IpoptEstimator.Settings()).solve(
        problem.with_records(records), problem.parameters.nominal()
    )
    found = estimate(problem.with_records(records), solution)
    assert found.noise_scale == pytest.approx(1.0, abs=0.25)
    for name, value, sd in zip(found.names, found.values[list(found.free_entries)], found.deviations, strict=True):
        assert abs(value - TRUTH[name]) < 4 * sd, name


FAULTS = {
    "a socket out of reach": ({"balls": KEYS[:1]}, {"truth": {**TRUTH_OF_FRONT, "balls.front/hole_0.x": 3.0}}, "reach"),
    "a measurement that is not there": ({"nosuch": KEYS}, {"truth": {"left.mdh.a2": 0.3}}, "nosuch"),
    "a key of too few labels": ({"balls": ("hole_0",)}, {"truth": {"left.mdh.a2": 0.3}}, "hole_0"),
    "a key of too many labels": ({"balls": ("a/b/c",)}, {"truth": {"left.mdh.a2": 0.3}}, "a/b/c"),
    "a truth of a socket not taken up": ({"balls": KEYS[:1]}, {"truth": {"balls.shelf/hole_0.x": 0.1}}, "shelf"),
    "angles around of no arm": (
        {"balls": KEYS[:1]},
        {"truth": TRUTH_OF_FRONT, "around": {"middle": {"q1": 0.0}}},
        "left",
    ),
    "angles around of no joint": (
        {"balls": KEYS[:1]},
        {"truth": TRUTH_OF_FRONT, "around": {"left": {"q9": 0.0}}},
        "q9",
    ),
}


@pytest.mark.parametrize("case", FAULTS)
def test_what_cannot_be_simulated_is_told(tmp_path, case):
    groups, settings, word = FAULTS[case]
    with pytest.raises(ConfigError) as told:
        simulated(tmp_path, sockets(), groups, **settings)
    assert word in f"{told.value.message} {told.value.hint}"
