"""The reader ``rosbag2``: rests of a simulated arm, recorded with rosbags, read without ROS."""

from __future__ import annotations

import heapq
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded_bags as bags
import yaml
from armcal.base.dataset import Dataset
from armcal.errors import DataError
from armcal.run.experiment import Experiment
from armcal_ros2.reader import is_inverted
from scipy.spatial.transform import Rotation

TOPIC = "geometry_msgs/msg/PointStamped"


@pytest.fixture(scope="module")
def tour(tmp_path_factory: pytest.TempPathFactory) -> bags.Tour:
    return bags.made_tour(tmp_path_factory.mktemp("tour"), rests=12)


@pytest.fixture
def name(tour: bags.Tour, request: pytest.FixtureRequest) -> Path:
    """Where a recording of this test may stand, beside the configuration."""
    return tour.config.with_name("".join(c if c.isalnum() else "_" for c in request.node.name))


def read(tour: bags.Tour, bag: Path, joints: dict[str, Any] | None = None, **measured: Any) -> Dataset:
    config = bags.of_bag(tour, bag, **measured)
    if joints:
        settings = yaml.safe_load(config.read_text())
        settings["data"]["joints"] = joints
        config.write_text(yaml.safe_dump(settings))
    return Experiment.load(config).read()


def require_rests(dataset: Dataset, tour: bags.Tour) -> None:
    """Joints as the CSV file of the rests has them, positions within the noise of a mean."""
    exact = Experiment.load(tour.config).read()
    assert len(dataset) == len(exact)
    np.testing.assert_allclose(dataset.stacked(bags.CHANNELS), exact.stacked(bags.CHANNELS), atol=2e-5)
    seen = [f"tracker.{axis}" for axis in "xyz"]
    apart = dataset.stacked(seen) - exact.stacked(seen)  # the CSV file has one reading of 0.2 mm each
    assert np.sqrt((apart**2).mean()) < 0.25e-3


@pytest.mark.quick("sqlite3-")
@pytest.mark.parametrize(
    ("storage", "compressed"),
    [("mcap", ""), ("mcap", "storage"), ("mcap", "message"), ("sqlite3", ""), ("sqlite3", "message")],
)
def test_rests_are_read_from_every_kind_of_file(tour: bags.Tour, name: Path, storage: str, compressed: str) -> None:
    bag = bags.write_bag(name, tour.sent(), storage, compressed)
    dataset = read(tour, bag)
    require_rests(dataset, tour)
    assert dataset.ids[:2] == ("rest1", "rest2") and not dataset.set_aside
    middles = tour.rests.mean(axis=1)
    np.testing.assert_allclose(dataset.column("time"), middles, atol=0.05)
    assert [text for text in dataset.warnings if "rest" not in text.rpartition("/")[2]] == []


def test_joints_are_found_by_name_in_any_order(tour: bags.Tour, name: Path) -> None:
    names = [f"joint_{i}" for i in (3, 1, 2, 6, 5, 4)]
    shuffled = replace(tour, joints=(tour.joints[0], tour.joints[1][:, [2, 0, 1, 5, 4, 3]]))
    bag = bags.write_bag(name, shuffled.sent(names=names))
    require_rests(read(tour, bag, {"names": {f"q{i}": f"joint_{i}" for i in range(1, 7)}}), tour)
    with pytest.raises(DataError, match=r"no joint q1 in /joint_states; .* joint_1, joint_2"):
        read(tour, bag)
    with pytest.raises(DataError, match=r"joints\.names\.q9, expected joints of the arm: q1"):
        read(tour, bag, {"names": {"q9": "joint_1"}})


@pytest.mark.slow
def test_approaches_are_the_last_motion_before_a_rest(tour: bags.Tour, name: Path) -> None:
    dataset = read(tour, bags.write_bag(name, tour.sent()))
    angles = dataset.stacked(bags.CHANNELS)
    sides = dataset.stacked([f"arm.approach.q{i}" for i in range(1, 7)])
    assert (sides[:, 0] == 0).all()
    np.testing.assert_array_equal(sides[:, 1:], np.sign(np.diff(angles, axis=1)))


@pytest.mark.slow
def test_a_stated_clock_offset_moves_the_measurement(tour: bags.Tour, name: Path) -> None:
    bag = bags.write_bag(name, tour.sent(ahead=1.3))
    require_rests(read(tour, bag, clock_offset_s=1.3), tour)
    with pytest.raises(
        DataError, match=r"0 of 12 rests are records.*1\.3 s ahead of those of /joint_states.*clock_offset"
    ):
        read(tour, bag)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ({"q2": "q3"}, "found q3 for q2 and q3, expected one joint"),
        ({"j1": "q1"}, "found joints.names.j1, expected joints of the arm: q1.*leave out"),
    ],
)
def test_names_that_cannot_be_are_refused(tour: bags.Tour, name: Path, names: dict[str, str], expected: str) -> None:
    with pytest.raises(DataError, match=expected):
        read(tour, bags.write_bag(name, []), joints={"names": names})


def test_a_data_section_without_a_measurement_is_refused(tour: bags.Tour, name: Path) -> None:
    config = bags.of_bag(tour, bags.write_bag(name, []))
    settings = yaml.safe_load(config.read_text())
    settings["data"] |= {"measurements": {}}
    config.write_text(yaml.safe_dump(settings))
    with pytest.raises(DataError, match=r"found no measurements, expected a topic for one of tracker\..*bag images"):
        Experiment.load(config).read()


def test_a_clock_that_is_a_little_off_is_named(tour: bags.Tour, name: Path) -> None:
    """The times of receipt do not show so little; the measured point moves where the joints stand."""
    text = " ".join(read(tour, bags.write_bag(name, tour.sent(ahead=0.4))).warnings)
    assert "tracker moves in " in text and "set clock_offset_s: 0." in text


def test_rests_that_cannot_be_used_are_listed(tour: bags.Tour, name: Path) -> None:
    begin, end = tour.rests[3]
    at, seen = tour.seen
    hidden = (at > begin - 0.2) & (at < end + 0.2)
    creeping = seen + np.outer(np.clip(at - tour.rests[6, 0], 0, 0.9), [0.02, 0, 0])
    kept = replace(tour, seen=(at[~hidden], creeping[~hidden]))
    sent = [
        m for m in kept.sent() if not (m[1] == "/joint_states" and tour.rests[8, 0] + 0.3 < m[0] < tour.rests[8, 1])
    ]
    dataset = read(tour, bags.write_bag(name, sent))
    reasons = {record.record_id: record.reason for record in dataset.set_aside}
    assert reasons.keys() == {"rest4", "rest7", "rest9"}
    assert (
        "no measurement" in reasons["rest4"] and "still moving" in reasons["rest7"] and "too short" in reasons["rest9"]
    )
    text = " ".join(dataset.warnings)
    assert "9 of 12 rests are records; left out: rest4: tracker: no measurement" in text
    assert "is silent 1 times, for up to 0.6" in text


def posed(tour: bags.Tour) -> list[bags.Sent]:
    """A tracker and a marker in a tree of transforms, beside frames of others."""
    stand = Rotation.from_euler("z", 30, degrees=True)
    sent = [m for m in tour.sent() if m[1] == "/joint_states"]
    static = bags.transform(bags.BEGIN_S, "world", "camera", [1.0, 2.0, 0.5], stand.as_quat())
    kind = "tf2_msgs/msg/TFMessage"
    sent.append((bags.BEGIN_S, "/tf_static", kind, bags.message(kind, transforms=[static])))
    for t, p in zip(*tour.seen, strict=True):
        inside = stand.inv().apply(p - [1.0, 2.0, 0.5])
        parts = [bags.transform(t, "world", "cart", [t % 1, 0, 0]), bags.transform(t, "camera", "marker", inside)]
        sent += [(t, "/tf", kind, bags.message(kind, transforms=[part])) for part in parts]
    return sent


def test_transforms_are_read_by_frames(tour: bags.Tour, name: Path) -> None:
    bag = bags.write_bag(name, posed(tour))
    require_rests(read(tour, bag, topic="/tf", reference="world", frame="marker"), tour)
    with pytest.raises(DataError, match=r"no way from the frame world to flange.*camera, cart, marker, world"):
        read(tour, bag, topic="/tf", reference="world", frame="flange")
    with pytest.raises(DataError, match="Give reference and frame"):
        read(tour, bag, topic="/tf")


@pytest.mark.slow
def test_poses_are_read_with_their_orientation(tour: bags.Tour, name: Path) -> None:
    """Quaternions of either sign; those that are zero, as trackers send where they see no body, are left out."""
    turns = Rotation.random(len(tour.rests), random_state=4).as_quat()
    sent = [m for m in tour.sent() if m[1] == "/joint_states"]
    kind = "geometry_msgs/msg/PoseStamped"
    for i, (t, p) in enumerate(zip(*tour.seen, strict=True)):
        turn = turns[np.clip(np.searchsorted(tour.rests[:, 0], t) - 1, 0, None)]
        q = bags.vector("Quaternion", turn * (-1, 1, 0)[i % 3])
        pose = bags.message("geometry_msgs/msg/Pose", position=bags.vector("Point", p), orientation=q)
        sent.append((t, "/tip", kind, bags.message(kind, header=bags.header(t, "world"), pose=pose)))
    config = bags.of_bag(tour, bags.write_bag(name, sent))
    settings = yaml.safe_load(config.read_text())
    settings["measurements"]["tracker"] |= {"type": "tip_pose", "orientation_noise_deg": 0.1}
    config.write_text(yaml.safe_dump(settings))
    dataset = Experiment.load(config).read()
    quaternions = dataset.stacked([f"tracker.{axis}" for axis in ("qx", "qy", "qz", "qw")]).T
    np.testing.assert_allclose(quaternions, turns * np.sign(turns[:, 3:]), atol=1e-9)
    assert any("whose quaternion is zero" in text for text in dataset.warnings)


def test_inverted_poses_are_read_the_right_way_round(tour: bags.Tour, name: Path) -> None:
    """As of a marker that a camera on the hand sees."""
    turn = Rotation.from_euler("xyz", [20, -30, 140], degrees=True)
    sent = [m for m in tour.sent() if m[1] == "/joint_states"]
    kind, q = "geometry_msgs/msg/PoseStamped", bags.vector("Quaternion", turn.inv().as_quat())
    for t, p in zip(*tour.seen, strict=True):
        place = bags.vector("Point", -turn.inv().apply(p))
        pose = bags.message("geometry_msgs/msg/Pose", position=place, orientation=q)
        sent.append((t, "/tip", kind, bags.message(kind, header=bags.header(t, "hand"), pose=pose)))
    require_rests(read(tour, bags.write_bag(name, sent), inverted=True), tour)


@pytest.mark.parametrize("off_m", [1e-3, 5e-3])
def test_poses_that_are_the_wrong_way_round_are_recognised(off_m: float) -> None:
    """Of any base and body, on an arm that is some mm off its nominal one."""
    random = np.random.default_rng(1)
    tools, (base, body) = poses(random, 30, 0.5), poses(random, 2, 1.0)
    measured = base @ tools @ body
    measured[:, :3, 3] += random.normal(0, off_m, (30, 3))
    assert is_inverted(tools, np.linalg.inv(measured)) and not is_inverted(tools, measured)
    assert not is_inverted(tools[:20], np.linalg.inv(measured)[:20]), "too few"
    measured[:, :3, :3] = np.nan
    assert not is_inverted(tools, measured), "points have no inverse"


def poses(random: np.random.Generator, count: int, reach: float) -> np.ndarray:
    """Any poses (N x 4 x 4; m)."""
    made = np.tile(np.eye(4), (count, 1, 1))
    made[:, :3, :3] = Rotation.random(count, random_state=random.integers(100)).as_matrix()
    made[:, :3, 3] = random.uniform(-reach, reach, (count, 3))
    return made


Change = Callable[[list[bags.Sent]], list[bags.Sent]]


def _stamped(stamp: Callable[[int, float], float]) -> Change:
    def changed(sent: list[bags.Sent]) -> list[bags.Sent]:
        points = [entry for entry in sent if entry[1] == "/tip"]
        rest = [entry for entry in sent if entry[1] != "/tip"]
        for i, (received, topic, kind, content) in enumerate(points):
            place = content.point
            rest.append((received, topic, kind, bags.point(stamp(i, received), [place.x, place.y, place.z])))
        return rest

    return changed


def _with_positions(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def changed(sent: list[bags.Sent]) -> list[bags.Sent]:
        return [
            (t, topic, kind, bags.joint_state(t, m.name, change(m.position)) if topic == "/joint_states" else m)
            for t, topic, kind, m in sent
        ]

    return changed


def _framed(sent: list[bags.Sent]) -> list[bags.Sent]:
    for i, entry in enumerate(sent):
        if entry[1] == "/tip" and i % 2:
            entry[3].header.frame_id = "map"
    return sent


@pytest.mark.quick("<lambda>-found no rest of at least 0.5 s", "<lambda>-no topic with joint states")
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (_stamped(lambda i, t: 0.0), "have the stamp zero.*stamps: receive"),
        (_stamped(lambda i, t: bags.BEGIN_S), "have the stamp of the one before"),
        (_stamped(lambda i, t: t - (i % 2)), "have a stamp before that of an earlier one"),
        (_stamped(lambda i, t: t + 1e6 * (i == 2)), "have a stamp before that of an earlier one.*stamps: receive"),
        (_with_positions(np.degrees), "more than one turn.*unit: deg"),
        (_with_positions(lambda q: q * np.nan), "finite position"),
        (_with_positions(lambda q: q[:3]), "finite position"),
        (_framed, "several frames in /tip: .*world.*expected one"),
        (lambda sent: [m for m in sent if m[1] != "/tip"], r"no such topic for tracker \(/tip\)"),
        (lambda sent: [m for m in sent if m[1] == "/tip"], "no topic with joint states"),
        (lambda sent: [*sent, (sent[0][0], "/other", *sent[0][2:])], "found /joint_states, /other with joint states"),
        (lambda sent: [m for m in sent if m[0] < bags.BEGIN_S + 0.2], "found no rest of at least 0.5 s"),
    ],
)
def test_recordings_that_are_refused(tour: bags.Tour, name: Path, change: Change, expected: str) -> None:
    bag = bags.write_bag(name, change(tour.sent()))
    with pytest.raises(DataError, match=expected):
        read(tour, bag)


@pytest.mark.slow
def test_topics_that_measure_nothing_are_refused(tour: bags.Tour, name: Path) -> None:
    bag = bags.write_bag(name, tour.sent())
    with pytest.raises(
        DataError, match=r"the type sensor_msgs/msg/JointState for tracker.*Topics that measure are /tip"
    ):
        read(tour, bag, topic="/joint_states")
    with pytest.raises(DataError, match=r"the type geometry_msgs/msg/PointStamped .*expected TFMessage"):
        read(tour, bag, reference="world", frame="tip")


@pytest.mark.slow
def test_a_recording_of_several_files_is_one(tour: bags.Tour, name: Path) -> None:
    """Without metadata.yaml the second file comes before the tenth."""
    sent = sorted(tour.sent(), key=lambda entry: entry[0])
    name.mkdir()
    for number, first in ((1, 0), (2, len(sent) // 3), (10, len(sent) // 2)):
        last = {1: len(sent) // 3, 2: len(sent) // 2, 10: len(sent)}[number]
        part = bags.write_bag(name.with_name(f"{name.name}_{number}"), sent[first:last])
        (part / f"{part.name}.mcap").rename(name / f"part_{number}.mcap")
    require_rests(read(tour, name), tour)


def test_times_of_receipt_stand_for_stamps_that_are_zero(tour: bags.Tour, name: Path) -> None:
    bag = bags.write_bag(name, _stamped(lambda i, t: 0.0)(tour.sent()))
    require_rests(read(tour, bag, stamps="receive"), tour)


@pytest.mark.slow
def test_degrees_are_read_where_they_are_stated(tour: bags.Tour, name: Path) -> None:
    bag = bags.write_bag(name, _with_positions(np.degrees)(tour.sent()))
    require_rests(read(tour, bag, {"unit": "deg"}), tour)


def test_a_few_faulty_messages_are_counted(tour: bags.Tour, name: Path) -> None:
    sent = tour.sent()
    for k in (40, 41, 42):
        t, topic, kind, m = sent[k]
        sent[k] = (t, topic, kind, bags.joint_state(t, m.name, [np.nan, *m.position[1:]]))
    t, topic, kind, m = sent[50]
    sent[50] = (t, topic, kind, bags.joint_state(t, m.name[:2], m.position[:2]))
    dataset = read(tour, bags.write_bag(name, sent))
    require_rests(dataset, tour)
    text = " ".join(dataset.warnings)
    assert "some were left out: 3 whose positions are missing or not finite, 1 without q3" in text


def test_a_clock_that_is_set_after_the_first_messages_costs_them_alone(tour: bags.Tour, name: Path) -> None:
    sent = tour.sent()
    for k in (0, 1, 2):
        t, topic, kind, m = sent[k]
        sent[k] = (t, topic, kind, bags.joint_state(t - 1e9, m.name, m.position))
    require_rests(read(tour, bags.write_bag(name, sent)), tour)


def test_two_programs_that_publish_the_joints_are_named(tour: bags.Tour, name: Path) -> None:
    """A controller, and joint_state_publisher, which sends zeros under the same topic."""
    sent = []
    for place, (t, topic, kind, m) in enumerate(tour.sent()):
        sent.append((t, topic, kind, m))
        if topic == "/joint_states" and not place % 2:
            sent.append((t + 1e-4, topic, kind, bags.joint_state(t + 1e-4, m.name[::-1], [0.0] * len(m.name))))
    with pytest.raises(DataError, match=r"jump to and fro between two sets of values.*two programs publish it"):
        read(tour, bags.write_bag(name, sent))


@pytest.mark.slow
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_gigabytes_of_images_take_no_memory(tmp_path: Path, storage: str) -> None:
    """2.2 GB: the whole process stays below 200 MB."""
    tour = bags.made_tour(tmp_path, rests=12)
    pixels = np.random.default_rng(0).integers(0, 255, 4_000_000, np.uint8)
    own = {"height": 1000, "width": 4000, "encoding": "mono8", "is_bigendian": 0, "step": 4000, "data": pixels}
    times = np.linspace(tour.rests[0, 0], tour.rests[-1, 1], 550)
    images = (
        (t, "/image", "sensor_msgs/msg/Image", bags.message("sensor_msgs/msg/Image", header=bags.header(t), **own))
        for t in times
    )
    bag = bags.write_bag(
        tmp_path / "bag", heapq.merge(sorted(tour.sent(), key=received), images, key=received), storage
    )
    assert sum(path.stat().st_size for path in bag.iterdir()) > 2.2e9
    code = (
        "import resource, sys; from armcal.run.experiment import Experiment; "
        "print(len(Experiment.load(sys.argv[1]).read()), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    # by way of a shell: what a process took before it became another one counts for its peak
    command = f'{sys.executable} -c "{code}" {bags.of_bag(tour, bag)}'
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=True)
    records, kilobytes = map(int, done.stdout.split())
    assert records == 12 and kilobytes < 200_000


def received(entry: bags.Sent) -> float:
    return entry[0]
