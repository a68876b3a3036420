"""Recordings of ROS 2, written by rosbags: an arm that goes from rest to rest while a tracker watches it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.measure.tables import write_csv
from armcal.run.experiment import Experiment
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.LATEST)
NAMES = tuple(f"q{i}" for i in range(1, 7))
CHANNELS = tuple(f"arm.{name}" for name in NAMES)
_NONE = (0.0, 0.0, 0.0, 1.0)
BEGIN_S = 1_700_000_000.0
CONFIG = """
name: recorded
arms:
  arm:
    model:
      type: mdh
      convention: standard
      rows:
        - {d_mm: 150, alpha_deg: 90}
        - {a_mm: 300}
        - {a_mm: 250}
        - {d_mm: 110, alpha_deg: 90}
        - {d_mm: 90, alpha_deg: -90}
        - {d_mm: 80}
measurements: {tracker: {type: tip_position, noise_mm: 0.2, target_mm: [0, 30, 40]}}
statics: {gravity_m_s2: [0, 0, -9.81], body: earth, payload_g: 0}
parameters: {free: ["arm.mdh.theta[2-5]", "arm.mdh.[ad]?"], priors: {"arm.mdh.theta?": 5 deg, "arm.mdh.[ad]?": 5 mm}}
simulation:
  type: elastic_arm
  truth: truth.yaml
  seed: 3
  noise_mm: 0.2
  poses: {kind: random, count: 2, levels_rad: {q1: [0, 0], q2: [0, 0], q3: [0, 0], q4: [0, 0], q5: [0, 0], q6: [0, 0]}}
data: {type: csv, path: rests.csv}
validation: {holdout: 0.2, folds: 0, seed: 1}
"""
TRUTH = {"arm.mdh.theta2": "1.5 deg", "arm.mdh.theta3": "-2 deg", "arm.mdh.a2": "302 mm", "arm.mdh.d1": "151 mm"}


def message(kind: str, **fields: Any) -> Any:
    """One of ROS 2's standard messages."""
    return TYPES.types[kind](**fields)


def header(time: float, frame: str = "") -> Any:
    nanoseconds = round(time * 1e9)
    stamp = message("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def vector(kind: str, values: Sequence[float]) -> Any:
    return message(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", map(float, values), strict=False)))


def joint_state(time: float, names: Sequence[str], values: Sequence[float]) -> Any:
    nothing = np.zeros(0)
    position = np.array(values, dtype=float)
    own = {"name": list(names), "position": position, "velocity": nothing, "effort": nothing}
    return message("sensor_msgs/msg/JointState", header=header(time), **own)


def point(time: float, place: Sequence[float], frame: str = "world") -> Any:
    return message("geometry_msgs/msg/PointStamped", header=header(time, frame), point=vector("Point", place))


def transform(
    time: float, parent: str, child: str, place: Sequence[float], turn: Sequence[float] = (0, 0, 0, 1)
) -> Any:
    moved = message(
        "geometry_msgs/msg/Transform", translation=vector("Vector3", place), rotation=vector("Quaternion", turn)
    )
    kind = "geometry_msgs/msg/TransformStamped"
    return message(kind, header=header(time, parent), child_frame_id=child, transform=moved)


Sent = tuple[float, str, str, Any]
"""When it was received (s), its topic, its type, and the message."""


def _received(entry: Sent) -> float:
    return entry[0]


def write_bag(path: Path, sent: Iterable[Sent], storage: str = "mcap", compressed: str = "") -> Path:
    listed = sorted(sent, key=_received) if isinstance(sent, list) else sent
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compressed:
        writer.set_compression(CompressionMode[compressed.upper()], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for received, topic, kind, content in listed:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(connections[topic], round(received * 1e9), bytes(TYPES.serialize_cdr(content, kind)))
    return path


@dataclass(frozen=True)
class Tour:
    """An arm that goes from rest to rest, and what a tracker sees of it.

    Attributes:
        config: the configuration, whose data are the CSV file of the rests.
        joints: times (s) and angles (N x 6; rad).
        seen: times (s) and measured positions (M x 3; m), in the order of time.
        rests: begin and end of each (s).
    """

    config: Path
    joints: tuple[Array, Array]
    seen: tuple[Array, Array]
    rests: Array

    def sent(self, ahead: float = 0.0, names: Sequence[str] = NAMES) -> list[Sent]:
        """Its messages; the tracker's clock is ahead, and all are received 3 ms after they were measured."""
        late = 0.003
        sent: list[Sent] = [
            (t + late, "/joint_states", "sensor_msgs/msg/JointState", joint_state(t, names, q))
            for t, q in zip(*self.joints, strict=True)
        ]
        sent += [
            (t + late, "/tip", "geometry_msgs/msg/PointStamped", point(t + ahead, p))
            for t, p in zip(*self.seen, strict=True)
        ]
        return sent


def made_tour(
    folder: Path, rests: int = 30, joint_hz: float = 100.0, seen_hz: float = 60.0, seed: int = 5, play_deg: float = 0.0
) -> Tour:
    """A tour through random poses: 0.9 s of rest, then motions of 0.6 to 1.2 s; the true arm is that of ``TRUTH``.

    ``play_deg``: by how much each joint turns, after it turned back, before what it carries follows.
    """
    (folder / "truth.yaml").write_text("".join(f"{name}: {value}\n" for name, value in TRUTH.items()))
    config = folder / "arm.yaml"
    config.write_text(CONFIG)
    random = np.random.default_rng(seed)
    poses = random.uniform(-1.3, 1.3, (rests, len(NAMES)))
    begins = BEGIN_S + np.concatenate([[0.0], np.cumsum(0.9 + random.uniform(0.6, 1.2, rests - 1))])
    ends = begins + 0.9

    def joints_at(times: Array) -> Array:
        before = np.clip(np.searchsorted(begins, times, side="right") - 1, 0, rests - 1)
        after = np.minimum(before + 1, rests - 1)
        lasting = np.where(after > before, begins[after] - ends[before], 1.0)
        part = np.clip((times - ends[before]) / lasting, 0.0, 1.0)
        part = part**3 * (10 - 15 * part + 6 * part**2)
        return np.asarray(poses[before] + part[:, None] * (poses[after] - poses[before]))

    times = np.arange(BEGIN_S, ends[-1], 1 / joint_hz)
    joints = joints_at(times) + random.normal(0.0, 2e-5, (len(times), len(NAMES)))
    seen_at = np.arange(BEGIN_S + 0.0021, ends[-1], 1 / seen_hz)
    experiment = Experiment.load(config, (f"simulation.seed={seed}",))
    seen = simulated(experiment, with_play(joints_at(seen_at), np.radians(play_deg) / 2))
    exact = Dataset(tuple(map(str, range(rests))), dict(zip(CHANNELS, poses.T, strict=True)))
    request = replace(experiment.simulation_request, poses=exact)
    write_csv(
        folder / "rests.csv", experiment.simulator().simulate(request), experiment.request(measured=True).channels
    )
    return Tour(config, (times, joints), (seen_at, seen), np.column_stack([begins, ends]))


def with_play(joints: Array, half: float) -> Array:
    """What follows joints (N x n; rad) that have so much play to either side."""
    followed = joints.copy()
    for i in range(1, len(joints)):
        followed[i] = np.clip(followed[i - 1], joints[i] - half, joints[i] + half)
    return followed


def simulated(experiment: Experiment, joints: Array) -> Array:
    """Measured positions (N x 3; m) of the true arm at joints (N x 6)."""
    listed = Dataset(tuple(map(str, range(len(joints)))), dict(zip(CHANNELS, joints.T, strict=True)))
    made = experiment.simulator().simulate(replace(experiment.simulation_request, poses=listed))
    return made.stacked(["tracker.x", "tracker.y", "tracker.z"]).T


def of_bag(tour: Tour, bag: Path, **measured: Any) -> Path:
    """The tour's configuration, with a recording in place of the CSV file."""
    settings = yaml.safe_load(tour.config.read_text())
    measured = {"topic": "/tip", **measured}
    settings["data"] = {"type": "rosbag2", "path": bag.name, "measurements": {"tracker": measured}}
    path = tour.config.with_name(f"{bag.stem}.yaml")
    path.write_text(yaml.safe_dump(settings))
    return path
