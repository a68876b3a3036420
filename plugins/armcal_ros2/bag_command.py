"""``armcal bag``: what a recording holds, the data section that would read it, and images taken out of it."""

from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import click
import numpy as np
import yaml
from armcal.cli.common import FILE, Console, speaking
from armcal.errors import DataError
from armcal.io.plain_files import refuse, require_new, write_new

from armcal_ros2.reader import (
    GUARD_S,
    JOINT_STATE,
    MEASURED,
    TRANSFORMS,
    Bag,
    JointLog,
    JointRest,
    JointsSettings,
    RestSettings,
    Stamps,
    nanoseconds,
)

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_LATEST = 20  # So many stamps of joint states are kept: transforms that are computed from them come at once


@dataclass
class TopicSummary:
    type: str
    first: float | None = None  # when its messages were received (s since 1970), of topics that calibrate
    last: float | None = None
    count: int = 0
    frames: Counter[str] = field(default_factory=Counter)  # messages by frame, of transforms ``a -> b``
    computed: Counter[str] = field(default_factory=Counter)  # with the very stamp of a joint state: not measured

    @property
    def measured(self) -> list[str]:
        return [frame for frame, count in self.frames.items() if 2 * self.computed[frame] < count]


def survey(bag: Bag) -> tuple[dict[str, TopicSummary], dict[str, JointLog], list[str]]:
    """Once through the recording: topics by name, joint states by topic, what is missing or wrong."""
    topics, joints, remarks = dict[str, TopicSummary](), dict[str, JointLog](), list[str]()
    stamps = deque[int](maxlen=_LATEST)
    for topic, received, _, message in bag.messages(lambda topic: topic.type in (JOINT_STATE, *MEASURED)):
        time = received / 1e9
        own = topics.setdefault(topic.name, TopicSummary(topic.type, time))
        own.last, own.first = max(own.last or time, time), min(own.first or time, time)
        if topic.type == JOINT_STATE and message.name:
            if topic.name not in joints:
                own_settings, slides = JointsSettings(topic=topic.name), [False] * len(message.name)
                joints[topic.name] = JointLog(message.name, slides, own_settings, RestSettings())
            joints[topic.name].add(topic, message, received)
            stamps.append(nanoseconds(message.header.stamp) or -1)
        for part in getattr(message, "transforms", [message]) if topic.type in MEASURED else ():
            child = getattr(part, "child_frame_id", "")
            frame = f"{part.header.frame_id} -> {child}" if child else part.header.frame_id
            own.frames[frame] += 1
            own.computed[frame] += int(bool(child) and nanoseconds(part.header.stamp) in stamps)
    for topic, count in bag.topics.items():
        topics.setdefault(topic.name, TopicSummary(topic.type)).count += count
    if not any(own.count for own in topics.values()):
        refuse(
            bag.path, "found no message in it.", " ".join([*bag.remarks, "Record again, or give another recording."])
        )
    for log in joints.values():
        try:
            remarks += log.close(str(bag.path))
        except DataError as fault:
            remarks.append(f"{fault.message} {fault.hint}")
    for name, summary in topics.items():
        if summary.computed.total() and not summary.measured:
            remarks.append(f"all frames in {name} are computed from the joints: they measure nothing.")
    return topics, joints, [*bag.remarks, *remarks]


def _numbered(names: Sequence[str], ending: str = "") -> dict[str, str]:
    """Names by joint (``q1`` and so on); empty where they are called so."""
    numbered = {f"q{i}{ending}": name for i, name in enumerate(names, start=1)}
    return {} if set(numbered) == set(names) else numbered


def _data_section(path: Path, topics: Mapping[str, TopicSummary], joints: Mapping[str, JointLog]) -> dict[str, Any]:
    """One that would read it; empty without joint states."""
    if not joints:
        return {}
    topic, log = max(joints.items(), key=lambda entry: len(entry[1].rests))
    names = _numbered(log.names)
    stated = {"topic": topic, "names": names} if names else {"topic": topic}
    section: dict[str, Any] = {"type": "rosbag2", "path": str(path), "joints": stated}
    measured: dict[str, dict[str, str]] = {}
    for name, summary in topics.items():
        if summary.type not in MEASURED or name.endswith("_static") or not summary.measured:
            continue
        instance = f"tracker{len(measured) + 1}" if measured else "tracker"
        measured[instance] = {"topic": name}
        if summary.type == TRANSFORMS:
            parent, _, child = summary.measured[-1].partition(" -> ")
            measured[instance] |= {"frame": child, "reference": parent}
    return {**section, "measurements": measured} if measured else section


@click.group()
def bag() -> None:
    """Look into a recording of ROS 2 (rosbag2), and take images out of it."""


@bag.command()
@click.argument("path", type=FILE)
@speaking
def info(console: Console, path: Path) -> None:
    """Topics, times and rests of the recording PATH, and a data section for a configuration."""
    topics, joints, remarks = survey(Bag(path))
    data = _data_section(path, topics, joints)
    console.result(
        {
            "topics": {name: vars(topic) for name, topic in topics.items()},
            "joints": {name: list(log.names) for name, log in joints.items()},
            "rests": {name: [[rest.begin, rest.end] for rest in log.rests] for name, log in joints.items()},
            "remarks": remarks,
            "data": data,
        }
    )
    begin = min((topic.first for topic in topics.values() if topic.first is not None), default=0.0)
    rows = (
        (name, topic.type, topic.count, *("" if t is None else f"{t - begin:.1f}" for t in (topic.first, topic.last)))
        for name, topic in topics.items()
    )
    console.table("Topics", ("topic", "type", "messages", "from s", "to s"), rows, left=("type",))
    for name, log in joints.items():
        lengths = [rest.end - rest.begin for rest in log.rests]
        spans = f" of {min(lengths):.1f} to {max(lengths):.1f} s" if lengths else ""
        console.line(f"{name}: {len(lengths)} rests{spans}; joints {', '.join(log.names)}.")
    for remark in remarks:
        console.warn(remark)
    if data.get("measurements"):
        _show_data(console, data, "names" in data["joints"])
    for name, topic in topics.items() if data else ():
        if topic.type in _IMAGES:
            console.line(f"Images of its rests: armcal bag images {path} --topic {name} --out FOLDER")


@bag.command()
@click.argument("path", type=FILE)
@click.option("--out", required=True, type=FILE, help="The folder for images, joints.csv and camera_info.yaml.")
@click.option("--topic", metavar="NAME", help="Of the images, where there are several.")
@click.option("--joints", metavar="NAME", help="Of the joint states, where there are several.")
@click.option("--clock-offset-ms", default=0.0, help="How far the camera's clock is ahead of that of the joints.")
@speaking
def images(
    console: Console, path: Path, out: Path, topic: str | None, joints: str | None, clock_offset_ms: float
) -> None:
    """Take one image of each rest out of the recording PATH, for the reader images."""
    recording = Bag(path)
    topics, logs, remarks = survey(recording)
    seen = _only(path, [name for name, own in topics.items() if own.type in _IMAGES], topic, "images", "--topic")
    log = logs[_only(path, list(logs), joints, "joint states", "--joints")]
    rests = [rest for rest in log.rests if rest.end - rest.begin >= RestSettings().window]
    table, information = out / "joints.csv", out / "camera_info.yaml"
    require_new([table, information])
    out.mkdir(parents=True, exist_ok=True)
    stamps, written, infos = Stamps(seen, "header"), dict[int, str](), list[Any]()
    candidates = _in_rests(recording, seen, rests, stamps, clock_offset_ms / 1000, infos)
    for place, within in groupby(candidates, itemgetter(0)):  # only the nearest yet is held
        suffix, picture = picture_of(min(within, key=itemgetter(1))[2], seen)
        written[place] = f"rest{place + 1:04d}{suffix}"
        write_new({out / written[place]: picture})
    remarks += stamps.check(str(path))
    if not written:
        refuse(path, f"found no image of {seen} in {len(rests)} rests.", " ".join(remarks) or "Record again.")
    if len(written) < len(rests):
        remarks.append(f"{len(rests) - len(written)} of {len(rests)} rests have no image.")
    lines = [",".join(["image", "time_s", *(f"{name}_rad" for name in log.names)])]
    for place, name in written.items():
        middle = (rests[place].begin + rests[place].end) / 2
        lines.append(",".join([name, *map(repr, [middle, *rests[place].means.tolist()])]))
    files = {table: ("\n".join(lines) + "\n").encode()}
    for info in infos[:1]:
        distortion = [float(x) for x in info.d]
        camera = {
            "image_width": int(info.width),
            "image_height": int(info.height),
            "camera_matrix": {"rows": 3, "cols": 3, "data": [float(x) for x in info.k]},
            "distortion_model": info.distortion_model,
            "distortion_coefficients": {"rows": 1, "cols": len(distortion), "data": distortion},
        }
        files[information] = yaml.safe_dump(camera, sort_keys=False).encode()
    write_new(files)
    names = _numbered([f"{name}_rad" for name in log.names], "_rad")
    poses = {"type": "csv", "path": str(table), "columns": names} if names else str(table)
    data = {"type": "images", "folder": str(out), "poses": poses}
    console.result({"images": [*written.values()], "files": [str(file) for file in files], "data": data})
    console.line(f"{len(written)} images written: {out}")
    for remark in remarks:
        console.warn(remark)
    _show_data(console, data, bool(names))


def _show_data(console: Console, data: dict[str, Any], named: bool) -> None:
    console.line("A data section for a configuration:")
    console.out.print(yaml.safe_dump({"data": data}, sort_keys=False, default_flow_style=None), soft_wrap=True)
    if named:
        console.line("# Leave q1, q2, ... out where the arm's joints are called as in the recording, as in a URDF.")


def _only(path: Path, names: Sequence[str], stated: str | None, what: str, option: str) -> str:
    chosen = names[0] if stated is None and len(names) == 1 else stated
    if chosen is None or chosen not in names:
        text = f"found topics with {what}: {', '.join(names) or 'none'}, expected {stated or 'one'}."
        refuse(path, text, f"Give {option} NAME." if names else "Record them too.")
    return chosen


def _in_rests(
    bag: Bag, topic: str, rests: Sequence[JointRest], stamps: Stamps, offset: float, infos: list[Any]
) -> Iterator[tuple[int, float, Any]]:
    """Each image in a rest: the rest's place, how far it is from the rest's middle (s), and the message."""
    begins, settle = [rest.begin for rest in rests], RestSettings().settle
    above = topic.removesuffix("/compressed").rpartition("/")[0]
    for own, received, _, message in bag.messages(lambda read: read.name in (topic, f"{above}/camera_info")):
        if own.type == _CAMERA_INFO:
            infos.append(message)
        elif (stamp := stamps.time(nanoseconds(message.header.stamp), received)) is not None:
            time = stamp - offset
            place = bisect_right(begins, time) - 1
            if place >= 0 and begins[place] + settle <= time <= rests[place].end - GUARD_S:
                yield place, abs(time - (begins[place] + rests[place].end) / 2), message


_MAGIC = {b"\xff\xd8": ".jpg", b"\x89PNG": ".png"}
_LUMA = {"r": 0.299, "g": 0.587, "b": 0.114, "y": 1.0, "_": 0.0}
# The bytes of a pixel by encoding: red, green, blue, brightness, and what does not count
_LAYOUTS = {
    "y": ("mono8", "8uc1"),
    "rgb": ("rgb8",),
    "bgr": ("bgr8", "8uc3"),
    "rgb_": ("rgba8",),
    "bgr_": ("bgra8",),
    "y_": ("yuv422_yuy2", "yuyv"),
    "_y": ("yuv422", "uyvy", "mono16", "16uc1"),
}
_ENCODINGS = {name: layout for layout, names in _LAYOUTS.items() for name in names}


def picture_of(message: Any, topic: str) -> tuple[str, bytes]:
    """The ending of a file's name and its content: as compressed, or grey values as PGM."""
    data = np.asarray(message.data, dtype=np.uint8)
    if not hasattr(message, "encoding"):
        content = data.tobytes()
        suffix = next((ending for magic, ending in _MAGIC.items() if content.startswith(magic)), None)
        if suffix is None:
            refuse(topic, f"found images compressed as {message.format!r}, expected JPEG or PNG.", "Record others.")
        return suffix, content
    layout = _ENCODINGS.get(message.encoding.lower())
    if layout is None:
        known = ", ".join(_ENCODINGS)
        refuse(topic, f"found images encoded as {message.encoding!r}, expected one of {known}.", "Record others.")
    if "16" in message.encoding and message.is_bigendian:
        layout = layout[::-1]
    rows = data.reshape(message.height, message.step)[:, : len(layout) * message.width]
    weights = [_LUMA[part] for part in layout]
    grey = np.round(rows.reshape(message.height, message.width, len(layout)) @ weights).astype(np.uint8)
    return ".pgm", f"P5\n{message.width} {message.height}\n255\n".encode() + grey.tobytes()
