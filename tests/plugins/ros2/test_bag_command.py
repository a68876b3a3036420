"""``armcal bag``: what a recording holds, and bad input."""

from __future__ import annotations

import csv
import json
import sys
from typing import Any

import numpy as np
import pytest
import recorded_bags as bags
import yaml
from armcal.errors import DataError, InputError, PluginError
from armcal.run.experiment import Experiment
from armcal_ros2.bag_command import bag as command
from click.testing import CliRunner


@pytest.fixture(scope="module")
def tour(tmp_path_factory: pytest.TempPathFactory) -> bags.Tour:
    return bags.made_tour(tmp_path_factory.mktemp("tour"), rests=6)


def test_info_lists_topics_and_rests_and_suggests_a_data_section_that_reads(tour: bags.Tour) -> None:
    path = bags.write_bag(tour.config.with_name("listed"), tour.sent())
    done = CliRunner().invoke(command, ["info", str(path), "--json"], catch_exceptions=False)
    content = json.loads(done.stdout)
    assert content["topics"]["/joint_states"]["count"] == len(tour.joints[0])
    assert content["topics"]["/tip"]["type"] == "geometry_msgs/msg/PointStamped"
    assert content["topics"]["/tip"]["frames"] == {"world": len(tour.seen[0])}
    assert [len(rests) for rests in content["rests"].values()] == [6]
    settings = yaml.safe_load(tour.config.read_text()) | {"data": content["data"] | {"path": path.name}}
    config = tour.config.with_name("suggested.yaml")
    config.write_text(yaml.safe_dump(settings))
    assert len(Experiment.load(config).read()) == 6
    shown = CliRunner().invoke(command, ["info", str(path)], catch_exceptions=False).stdout
    assert "6 rests of 0.9 to 1.0 s" in shown and "type: rosbag2" in shown


@pytest.mark.parametrize("tracked", [True, False])
def test_frames_that_are_computed_from_joints_are_not_suggested(tour: bags.Tour, tracked: bool) -> None:
    """robot_state_publisher stamps transforms as the joint states that they are computed from."""
    joints = [m for m in tour.sent() if m[1] == "/joint_states"]
    times = tour.joints[0]
    frames = [bags.transform(t, "link5", "link6", [0.1, 0, 0]) for t in times]
    frames += [bags.transform(t + 0.0017, "world", "marker", [0.1, 0, 0]) for t in times[::3] if tracked]
    kind = "tf2_msgs/msg/TFMessage"
    sent = [(f.header.stamp.sec + f.header.stamp.nanosec / 1e9 + 0.004, f) for f in frames]
    listed = [*joints, *((t, "/tf", kind, bags.message(kind, transforms=[frame])) for t, frame in sent)]
    path = bags.write_bag(tour.config.with_name(f"frames_{tracked}"), listed)
    content = json.loads(CliRunner().invoke(command, ["info", str(path), "--json"], catch_exceptions=False).stdout)
    suggested = content["data"].get("measurements", {})
    assert suggested == ({"tracker": {"topic": "/tf", "frame": "marker", "reference": "world"}} if tracked else {})
    assert any("computed from the joints" in text for text in content["remarks"]) != tracked


def test_a_recording_of_images_alone_is_answered_with_the_command_that_takes_them_out(tour: bags.Tour) -> None:
    sent = [m for m in tour.sent() if m[1] == "/joint_states"]
    seen = image(bags.BEGIN_S, np.zeros((4, 4), np.uint8), "mono8")
    path = bags.write_bag(
        tour.config.with_name("pictures"), [*sent, (bags.BEGIN_S, "/eye", "sensor_msgs/msg/Image", seen)]
    )
    shown = CliRunner().invoke(command, ["info", str(path)], catch_exceptions=False).stdout
    assert f"armcal bag images {path} --topic /eye" in shown and "type: rosbag2" not in shown


def test_joint_states_without_names_are_counted(tour: bags.Tour) -> None:
    sent = [entry for entry in tour.sent() if entry[1] == "/tip"]
    sent += [(t, "/joint_states", "sensor_msgs/msg/JointState", bags.joint_state(t, [], [])) for t in tour.joints[0]]
    path = bags.write_bag(tour.config.with_name("nameless"), sent)
    content = json.loads(CliRunner().invoke(command, ["info", str(path), "--json"], catch_exceptions=False).stdout)
    assert content["topics"]["/joint_states"]["count"] == len(tour.joints[0])
    assert content["joints"] == {} and content["data"] == {}


def image(time: float, grey: np.ndarray, encoding: str) -> Any:
    """An image whose pixels are shades of grey, in an encoding of ROS."""
    height, width = grey.shape
    wide = {"mono8": [0], "rgb8": [0, 0, 0], "bgra8": [0, 0, 0, 0], "yuv422_yuy2": [0, 1], "mono16": [1, 0]}[encoding]
    pixels = np.stack([grey, np.full_like(grey, 128)], axis=2)[:, :, wide].reshape(height, -1)
    padded = np.hstack([pixels, np.zeros((height, 5), np.uint8)])  # rows may be longer than their pixels
    own = {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": padded.shape[1]}
    return bags.message("sensor_msgs/msg/Image", header=bags.header(time, "eye"), data=padded.reshape(-1), **own)


def camera_info(time: float) -> Any:
    region = bags.message(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    matrix = np.array([600.0, 0, 320, 0, 600, 240, 0, 0, 1])
    own = {"height": 480, "width": 640, "distortion_model": "plumb_bob", "d": np.zeros(5), "k": matrix, "roi": region}
    more = {"r": np.eye(3).ravel(), "p": np.zeros(12), "binning_x": 0, "binning_y": 0}
    return bags.message("sensor_msgs/msg/CameraInfo", header=bags.header(time, "eye"), **own, **more)


def shown_at(tour: bags.Tour, times: np.ndarray) -> np.ndarray:
    """A grey value for each time that says how far it is from the middle of its rest: 200 in the middle."""
    away = np.abs(times[:, None] - tour.rests.mean(axis=1)).min(axis=1)
    return np.clip(200 - 200 * away, 0, 255).astype(np.uint8)


@pytest.mark.quick("mono8")
@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "bgra8", "yuv422_yuy2", "mono16"])
def test_images_of_rests_are_taken_out(tour: bags.Tour, encoding: str) -> None:
    times = np.arange(tour.rests[0, 0], tour.rests[-1, 1], 0.1)
    sent = tour.sent(names=[f"joint_{i}" for i in range(1, 7)])
    for t, value in zip(times, shown_at(tour, times), strict=True):
        picture = image(t + 0.5, np.full((4, 6), value), encoding)
        sent.append((t, "/eye/image_raw", "sensor_msgs/msg/Image", picture))
        sent.append((t, "/eye/camera_info", "sensor_msgs/msg/CameraInfo", camera_info(t)))
    bag = bags.write_bag(tour.config.with_name(f"seen_{encoding}"), sent)
    out = tour.config.with_name(f"out_{encoding}")
    arguments = ["images", str(bag), "--out", str(out), "--clock-offset-ms", "500"]
    done = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert "6 images written" in done.stdout and "q1_rad: joint_1_rad" in done.stdout
    rows = list(csv.DictReader((out / "joints.csv").read_text().splitlines()))
    exact = Experiment.load(tour.config).read()
    assert [row["image"] for row in rows] == [f"rest{i:04d}.pgm" for i in range(1, 7)]
    for i, row in enumerate(rows):
        assert [float(row[f"joint_{k}_rad"]) for k in range(1, 7)] == pytest.approx(
            exact.stacked(bags.CHANNELS)[:, i], abs=3e-5
        )
        head, pixels = (out / row["image"]).read_bytes().split(b"\n255\n")
        assert head == b"P5\n6 4" and set(pixels) <= set(range(189, 201)), "the image nearest to the middle of the rest"
    assert yaml.safe_load((out / "camera_info.yaml").read_text())["camera_matrix"]["data"][0] == 600
    with pytest.raises(InputError, match=r"joints\.csv"):
        CliRunner().invoke(command, arguments, catch_exceptions=False)


def test_compressed_images_are_kept_as_they_are(tour: bags.Tour) -> None:
    sent, content = tour.sent(), b"\xff\xd8 a photograph \xff\xd9"
    for t in np.arange(tour.rests[0, 0], tour.rests[-1, 1], 0.1):
        own = {"format": "jpeg", "data": np.frombuffer(content, np.uint8)}
        picture = bags.message("sensor_msgs/msg/CompressedImage", header=bags.header(t), **own)
        sent.append((t, "/eye/image_raw/compressed", "sensor_msgs/msg/CompressedImage", picture))
    bag, out = bags.write_bag(tour.config.with_name("photographs"), sent), tour.config.with_name("photographs_out")
    CliRunner().invoke(command, ["images", str(bag), "--out", str(out)], catch_exceptions=False)
    assert [path.read_bytes() for path in sorted(out.glob("*.jpg"))] == [content] * 6
    with pytest.raises(DataError, match=r"expected /other.*--topic"):
        CliRunner().invoke(
            command, ["images", str(bag), "--out", str(out / "x"), "--topic", "/other"], catch_exceptions=False
        )


def test_without_rosbags_one_sentence_says_what_to_install(tour: bags.Tour, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bags.write_bag(tour.config.with_name("unread"), tour.sent()[:5])
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(PluginError, match=r"needs the library rosbags.*pip install 'armcal\[ros2\]'"):
        CliRunner().invoke(command, ["info", str(path)], catch_exceptions=False)
