"""Recordings of ROS 2 (folders or files), as ``rosbags`` reads them; and the reader ``rosbag2``: a record a rest."""

from __future__ import annotations

import hashlib
import math
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, NoReturn

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.settings import Angle, Duration, InputPath, Length, Settings
from armcal.calibration.rigid_chain import nominal_tools
from armcal.io.plain_files import refuse
from armcal.measure.checks import read_as
from armcal.measure.reader import ReadRequest
from armcal.measure.rests import StillSettings, deviations_of_mean, judged, last_motions, mean_pose, rests
from armcal.plugins import library, said
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

JOINT_STATE = "sensor_msgs/msg/JointState"
_PURPOSE = "reading recordings of ROS 2"
_ZERO, _SAME = "with the stamp zero", "with the stamp of the one before"
_EARLIER = "with a stamp before that of an earlier one"
# A larger part of the messages, and times are not to be trusted
_MOST = {_ZERO: 0.5, _SAME: 0.5, _EARLIER: 0.01}
Clock = Literal["header", "receive"]  # Times are stamps of headers, or when the recorder received messages


class Topic(NamedTuple):
    name: str
    type: str  # of its messages (``sensor_msgs/msg/JointState``)


class Stamps:
    """Times of one topic's messages, in order; those that cannot be are counted."""

    def __init__(self, topic: str, clock: Clock) -> None:
        self.topic, self.count = topic, 0
        self._latest = -math.inf  # the last time (s since 1970)
        self._clock = clock
        self.faults = Counter[str]()  # why messages are left out
        self._delays = array("d")

    def time(self, stamp: int, received: int) -> float | None:
        """Seconds since 1970 (arguments in ns); None where it is missing, repeated or before an earlier one."""
        self.count += 1
        chosen = stamp if self._clock == "header" else received
        time = chosen / 1e9
        if not chosen or time <= self._latest:
            self.faults[_ZERO if not chosen else _SAME if time == self._latest else _EARLIER] += 1
            return None
        self._latest = time
        self._delays.append((received - chosen) / 1e9)
        return time

    @property
    def delay(self) -> float:
        """The median time from measurement to receipt, by both clocks (s); NaN before the first message."""
        return float(np.median(self._delays)) if self._delays else float("nan")

    def check(self, place: str) -> list[str]:
        """What was left out, sentences; refused if stamps are zero, constant or backwards in too many messages."""
        for cause, most in _MOST.items():
            if (count := self.faults[cause]) > max(most * self.count, 1):
                what = cause.removeprefix("with ")
                text = f"{count} of {self.count} messages of {self.topic} have {what}, expected times of measurement."
                hint = f"Set stamps: receive for {self.topic}, or give each program that publishes a topic of its own."
                refuse(place, text, hint)
        listed = ", ".join(f"{count} {cause}" for cause, count in self.faults.most_common())
        return [f"of {self.count} messages of {self.topic} some were left out: {listed}."] if listed else []


def nanoseconds(stamp: Any) -> int:
    """The time of a header (ns since 1970)."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


_METADATA = "metadata.yaml"
_KINDS = (".mcap", ".db3")
_EXPECTED = "Give a recording of ROS 2: a folder with metadata.yaml, or a file .mcap or .db3."
_RECOVER = (
    "If its recorder was killed: mcap recover FILE.mcap -o NEW.mcap makes a whole file of what it wrote, ros2 bag "
    "reindex FOLDER the metadata.yaml."
)


class Bag:
    """A recording (folder or file); ``rosbags`` reads its messages from the files whenever they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics = Counter[Topic]()  # how many messages each has; complete once messages were asked for
        self.remarks: list[str] = []  # what of it is missing or could not be read, sentences
        self._files = [path]
        if not path.exists():
            refuse(path, "there is no such file or folder.", "Check the spelling and the directory.")
        if not path.is_dir() and path.suffix not in _KINDS:
            hint = "Convert it with rosbags-convert." if path.suffix == ".bag" else _EXPECTED
            refuse(path, f"found the ending {path.suffix or 'none'}, expected .mcap or .db3.", hint)
        for journal in path.glob("*.db3-wal"):
            if journal.stat().st_size:
                self.remarks.append(
                    f"{journal.name} holds messages that are not read: its recorder was killed. To have them, run "
                    f"sqlite3 {journal.name.removesuffix('-wal')} 'pragma wal_checkpoint(truncate)'."
                )
        if path.is_dir() and not (path / _METADATA).exists():  # which names its files
            files = [file for file in path.iterdir() if file.suffix in _KINDS]
            if not files:
                refuse(path, f"found no {_METADATA} and no file .mcap or .db3 in it.", _EXPECTED)
            self._files = sorted(files, key=lambda file: [int(n) for n in re.findall(r"\d+", file.name)])
            self.remarks.append(f"{_METADATA} is missing: the recorder was killed, or the file was not copied.")

    def messages(self, is_read: Callable[[Topic], bool]) -> Iterator[tuple[Topic, int, bytes, Any]]:
        """The messages of chosen topics, of each file by their time: when they were received (ns since 1970), their
        bytes, and what rosbags made of them.
        """
        rosbag2, typesys = (library(f"rosbags.{name}", _PURPOSE) for name in ("rosbag2", "typesys"))
        types, unread = typesys.get_typestore(typesys.Stores.LATEST), Counter[Topic]()
        self.topics.clear()
        for file in self._files:
            count = 0
            try:
                with rosbag2.Reader(file) as reader:
                    topics = {one.id: Topic(one.topic, one.msgtype) for one in reader.connections}
                    self.topics.update({topics[one.id]: one.msgcount for one in reader.connections})
                    chosen = [one for one in reader.connections if is_read(topics[one.id])]
                    for connection, received, data in reader.messages(chosen) if chosen else ():
                        count += 1
                        try:
                            content = types.deserialize_cdr(data, connection.msgtype)
                        except Exception:  # damaged bytes or a type that is not standard
                            unread[topics[connection.id]] += 1
                            continue
                        yield topics[connection.id], received, bytes(data), content
            except Exception as fault:  # of damaged files rosbags has no one error
                text = f"it is cut off, damaged or no recording, after {count} messages ({said(fault)})."
                refuse(file, text, f"{_EXPECTED} {_RECOVER}")
        for topic, lost in unread.items():
            self.remarks.append(f"{lost} messages of {topic.name} ({topic.type}) could not be decoded: left out.")


GUARD_S = 0.1  # At the end of a rest, before joints are seen to move
_THINNED_S = 0.01  # Joints are kept so far apart: 25 MB for an hour of seven of them
_LARGEST = 1e6  # No joint stands so far away, in any unit
_NO_POSITION = "whose positions are missing or not finite"
_JUMP, _MOST_RETURNS = 20.0, 0.1
"""A larger part of messages that jump by so many spreads, to where the joints just were: two programs publish them."""


class JointsSettings(Settings):
    """Where joint angles come from.

    ``names`` maps joints of the arm (``q1``, with several arms ``left.q1``) to those of the recording; others have
    their own name there. ``unit`` is rad as ROS has it, or deg where the driver errs.
    """

    topic: str | None = None
    stamps: Clock = "header"
    names: dict[str, str] = Field(default_factory=dict)
    unit: Literal["rad", "deg"] = "rad"


class RestSettings(Settings):
    """What a rest is."""

    window: Annotated[Duration, Field(gt=0)] = 0.5  # how long it lasts at least
    spread: Annotated[Angle, Field(gt=0)] = math.radians(0.1)  # by how much no turning joint moves in it
    sliding_spread: Annotated[Length, Field(gt=0)] = 0.0002  # and no sliding one
    settle: Annotated[Duration, Field(ge=0)] = 0.2  # what passes after joints stopped before measurements count
    drift: Annotated[Length, Field(gt=0)] = 0.001  # by how much means of the measured positions in its halves differ


@dataclass(frozen=True)
class JointRest:
    """A rest of the joints: begin and end (s); by joint."""

    begin: float
    end: float
    means: Array  # rad or m
    scatter: Array  # standard deviations
    approach: Array  # the sign of the last motion; 0 where there was none


class JointLog:
    """Joint states as they come, by their names in the recording; once it is closed, the rests among them.

    ``slides`` says which of these joints slide. Rests shorter than the window are there too, to be listed.
    """

    def __init__(
        self, names: Sequence[str], slides: Sequence[bool], settings: JointsSettings, still: RestSettings
    ) -> None:
        self.names = tuple(names)
        self._limits = np.where(slides, still.sliding_spread, still.spread)
        self._scale = np.where(slides, 1.0, math.radians(1.0) if settings.unit == "deg" else 1.0)
        self._still = still
        self._places: dict[tuple[str, ...], list[int]] = {}
        self._times, self._rows = array("d"), array("d")
        self._before: list[Array] = []  # where the joints were last, and where before that, apart
        self._returns = 0
        self._others = set[str]()
        self._stated = settings.topic  # if none is, the first that has joint states
        self.stamps = Stamps(settings.topic or "", settings.stamps)
        self.largest = np.zeros(len(self.names))  # absolute positions, by joint (rad or m), once it is closed
        self.rests: list[JointRest] = []

    def reads(self, topic: Topic) -> bool:
        return topic.type == JOINT_STATE and self._stated in (None, topic.name)

    def add(self, topic: Topic, message: Any, received: int) -> None:
        if topic.name != (self.stamps.topic or topic.name):
            self._others.add(topic.name)
            return
        self.stamps.topic = topic.name
        names = tuple(message.name)
        if names not in self._places:
            self._places[names] = [names.index(name) for name in self.names if name in names]
        places = self._places[names]
        if len(places) < len(self.names):
            if places:
                self.stamps.faults[f"without {next(name for name in self.names if name not in names)}"] += 1
            return
        time = self.stamps.time(nanoseconds(message.header.stamp), received)
        if time is None:
            return
        if len(message.position) != len(names) or not (np.abs(row := message.position[places]) < _LARGEST).all():
            self.stamps.faults[_NO_POSITION] += 1
            return
        row = row * self._scale
        if self._before and (np.abs(row - self._before[0]) > _JUMP * self._limits).any():
            self._returns += int((np.abs(row - self._before[-1]) <= self._limits).all())
            self._before.insert(1, self._before[0])
        self._before[:] = [row, *self._before[1:2]]
        if not self._times or time - self._times[-1] >= _THINNED_S:
            self._times.append(time)
            self._rows.extend(row.tolist())

    def close(self, place: str) -> list[str]:
        """The end of the recording: what was left out, sentences; refused if nothing can be used."""
        times, rows = np.array(self._times), np.array(self._rows).reshape(-1, len(self.names)).T
        self.largest = np.abs(rows).max(axis=1, initial=0.0)
        still = StillSettings.si(window=self._still.window / 2, spread=1.0)
        motions = np.array([last_motions(row, limit) for row, limit in zip(rows, self._limits, strict=True)])
        for rest in rests(rows / self._limits[:, None], (), times, still):
            begin, end, joints = float(times[rest.start]), float(times[rest.stop - 1]), rows[:, rest]
            settled = (times[rest] >= begin + self._still.settle) & (times[rest] <= end - GUARD_S)
            joints = joints[:, settled] if settled.any() else joints
            approach = motions[:, rest.stop - 1]
            self.rests.append(JointRest(begin, end, joints.mean(axis=1), joints.std(axis=1), approach))
        topic, count, named = self.stamps.topic, self.stamps.count, set().union(*self._places)
        if self._others or not topic or not (named or count):
            text = f"found {', '.join(sorted(filter(None, (topic, *self._others)))) or 'no topic'} with joint states"
            hint = "Set joints: {topic: NAME} in the data section; armcal bag info lists what is there."
            refuse(place, f"{text}, expected one.", hint)
        if not count:
            lacking = [name for name in self.names if name not in named]
            hint = "Give joints: {names: {JOINT: NAME IN THE RECORDING}} in the data section."
            missing = f"joint {lacking[0]}" if lacking else "message with all joints of the arm"
            refuse(place, f"found no {missing} in {topic}; its joints are {', '.join(sorted(named)) or 'none'}.", hint)
        remarks = self.stamps.check(place)
        if self.stamps.faults[_NO_POSITION] == count:
            hint = "Repair the driver, or record again."
            refuse(place, f"none of {count} messages of {topic} has a finite position for each joint.", hint)
        if self._returns > _MOST_RETURNS * count:
            text = f"the joints of {topic} jump to and fro between two sets of values in {self._returns} of {count}"
            hint = "Stop one of them, such as joint_state_publisher beside a controller, and record again."
            refuse(place, f"{text} messages: two programs publish it.", hint)
        pauses = np.diff(times)
        if (silent := pauses > self._still.window).any():
            longest = int(np.argmax(pauses))
            text = f"{topic} is silent {silent.sum()} times, for up to {pauses[longest]:.1f} s"
            remarks.append(f"{text} (from {times[longest]:.2f}): a rest ends there.")
        return remarks


TRANSFORMS = "tf2_msgs/msg/TFMessage"
_FIELDS = {
    "geometry_msgs/msg/PoseStamped": ("pose", "position", "orientation"),
    "geometry_msgs/msg/PointStamped": ("", "point", ""),
    "geometry_msgs/msg/TransformStamped": ("transform", "translation", "rotation"),
}
MEASURED = (*_FIELDS, TRANSFORMS)  # The types of messages that measure
_NORM_TOLERANCE = 1e-3
_STATIC = "/tf_static"
_MOST_OTHERS = 0.01
_FEWEST_SAMPLES = 4


class MeasuredSettings(Settings):
    """Where a measurement comes from.

    ``topic`` is one of PoseStamped, PointStamped or TransformStamped; ``frame`` is then the frame_id that its headers
    must have. Of transforms (``/tf``) the pose of ``frame`` in ``reference`` is read. With ``inverted`` poses are those
    of the instrument in the body, as of a marker that a camera on the hand sees, and their inverses are read.
    ``clock_offset`` is how far the clock of its stamps is ahead of that of the joints.
    """

    topic: str
    stamps: Clock = "header"
    frame: str | None = None
    reference: str | None = None
    inverted: bool = False
    clock_offset: Duration = 0.0

    @model_validator(mode="after")
    def _both_frames(self) -> MeasuredSettings:
        if self.reference is not None and self.frame is None:
            raise ValueError("found reference without frame, expected both: the pose of frame in reference")
        return self


@dataclass(frozen=True)
class _Seen:
    """What a measurement saw in a rest."""

    pose: Array  # the mean (4 x 4)
    deviation: float = math.nan  # of its place (m)
    samples: int = 0
    fault: str = ""  # why there is none


class MeasuredLog:
    """What a measurement saw, as messages come."""

    def __init__(self, instance: str, settings: MeasuredSettings) -> None:
        self.instance, self.settings = instance, settings
        self.stamps = Stamps(settings.topic, settings.stamps)
        self.types = tuple(_FIELDS) if settings.reference is None else (TRANSFORMS,)
        self._samples = array("d")  # 13 each: s, and the upper rows of the pose (m)
        # the newest transforms, by child frame: parent, pose in it (4 x 4, m) and time (None: always)
        self._edges: dict[str, tuple[str, Array, float | None]] = {}
        self._frames = Counter[str]()
        self._moved_at: float | None = None

    def reads(self, topic: Topic) -> bool:
        is_static = self.settings.reference is not None and topic.name.endswith(_STATIC)
        return topic.type in self.types and (topic.name == self.settings.topic or is_static)

    def add(self, topic: Topic, message: Any, received: int) -> None:
        if topic.type == TRANSFORMS:
            self._follow(message, received, topic.name.endswith(_STATIC))
            return
        self._frames[message.header.frame_id] += 1
        if self.settings.frame not in (None, message.header.frame_id):
            return
        time = self.stamps.time(nanoseconds(message.header.stamp), received)
        if time is not None:
            body, position, orientation = _FIELDS[topic.type]
            content = getattr(message, body) if body else message
            self._keep(time, self._pose(getattr(content, position), getattr(content, orientation, None)))

    def close(self, place: str, types: Mapping[str, str]) -> list[str]:
        """What was left out, sentences; refused if nothing was measured, or not in the frames that were asked for.

        ``types`` are those of the messages in the recording, by topic.
        """
        s, count = self.settings, self.stamps.count
        if types.get(s.topic) not in self.types:
            have = ", ".join(name for name, own in sorted(types.items()) if own in MEASURED) or "none"
            kind = f"the type {types[s.topic]}" if s.topic in types else "no such topic"
            expected = ", ".join(name.rpartition("/")[2] for name in self.types)
            hint = f"Topics that measure are {have}."
            if types.get(s.topic) == TRANSFORMS:
                hint = "Give reference and frame: the pose of frame in reference is read."
            refuse(place, f"found {kind} for {self.instance} ({s.topic}), expected {expected}.", hint)
        where = f"{place}, data.measurements.{self.instance}"
        if s.reference is not None and not count:
            frames = ", ".join(sorted({*self._edges, *(edge[0] for edge in self._edges.values())}))
            text = f"found no way from the frame {s.reference} to {s.frame} in {s.topic}; its frames are"
            refuse(where, f"{text} {frames[:400] or 'none'}.", "Correct frame and reference.")
        listed = ", ".join(f"{name or 'none'} ({some})" for name, some in self._frames.most_common())
        if not count:
            refuse(
                where, f"found {listed or 'no messages'} in {s.topic}, expected the frame {s.frame}.", "Correct frame."
            )
        usual = s.frame or max(self._frames, key=lambda name: self._frames[name], default="")
        others = sum(some for name, some in self._frames.items() if name != usual)
        if s.frame is None and others > _MOST_OTHERS * count:
            refuse(where, f"found several frames in {s.topic}: {listed}, expected one.", "Set frame to one of them.")
        remarks = self.stamps.check(where)
        if others:
            remarks.append(f"{others} messages of {s.topic} have other frames than {usual!r}.")
        return remarks

    def seen(self, rests: Sequence[JointRest], still: RestSettings) -> Iterator[_Seen]:
        samples, offset = np.array(self._samples).reshape(-1, 13), self.settings.clock_offset
        spans = np.array([(rest.begin + still.settle, rest.end - GUARD_S) for rest in rests]) + offset
        for span in np.searchsorted(samples[:, 0], spans):
            rows = samples[slice(*span), 1:]
            poses = np.tile(np.eye(4), (len(rows), 1, 1))
            poses[:, :3] = rows.reshape(-1, 3, 4)
            fault = f"no measurement ({len(rows)} samples, at least {_FEWEST_SAMPLES})"
            if len(rows) >= _FEWEST_SAMPLES:
                stillness = judged(poses, still.drift)
                poses, fault = poses[stillness.kept], stillness.why_not
            if fault:
                yield _Seen(np.full((4, 4), np.nan), samples=len(rows), fault=fault)
                continue
            mean = mean_pose(poses)
            yield _Seen(mean, float(np.linalg.norm(deviations_of_mean(poses, mean)[:3])), len(poses))

    def _follow(self, message: Any, received: int, is_static: bool) -> None:
        s, changed = self.settings, set[str]()
        for part in message.transforms:
            pose, child = (
                self._pose(part.transform.translation, part.transform.rotation),
                part.child_frame_id.lstrip("/"),
            )
            if pose is not None:
                at = (nanoseconds(part.header.stamp) if s.stamps == "header" else received) / 1e9
                self._edges[child] = (part.header.frame_id.lstrip("/"), pose, None if is_static else at)
                changed.add(child)
        above, beside = self._above(s.frame or ""), self._above(s.reference or "")
        between = {*above} ^ {*beside}  # what is above both does not matter
        if above[-1] != beside[-1] or changed.isdisjoint(between):
            return
        # where several frames move, the oldest says when all of the pose was seen
        times = (self._edges[name][2] for name in between)
        oldest = min((at for at in times if at is not None), default=None)
        if oldest is None or oldest == self._moved_at:
            return
        self._moved_at = oldest
        time = self.stamps.time(round(oldest * 1e9), received)
        if time is not None:
            in_root, reference = (
                reduce(lambda pose, name: self._edges[name][1] @ pose, names[:-1], np.eye(4))
                for names in (above, beside)
            )
            self._keep(time, np.linalg.inv(reference) @ in_root)

    def _above(self, frame: str) -> list[str]:
        """A frame, its parent, and so on to the root."""
        names = [frame.lstrip("/")]
        while names[-1] in self._edges and self._edges[names[-1]][0] not in names:
            names.append(self._edges[names[-1]][0])
        return names

    def _pose(self, p: Any, q: Any) -> Array | None:
        """4 x 4 (m), of a point with a rotation of NaN; None, and counted, where it cannot be."""
        pose, fault, norm = np.eye(4), "", 1.0 if q is None else math.hypot(q.x, q.y, q.z, q.w)
        pose[:3, 3] = p.x, p.y, p.z
        if not np.isfinite(pose).all():
            fault = "whose position is not finite"
        elif q is None and self.settings.inverted:
            fault = "whose orientation is missing, so that they have no inverse"
        elif not abs(norm - 1) <= _NORM_TOLERANCE:
            fault = f"whose quaternion is {'zero' if norm < _NORM_TOLERANCE else 'not of length 1'}"
        if fault:
            self.stamps.faults[fault] += 1
            return None
        pose[:3, :3] = np.nan if q is None else Rotation.from_quat((q.x, q.y, q.z, q.w)).as_matrix()
        return pose

    def _keep(self, time: float, pose: Array | None) -> None:
        if pose is not None:
            rows = (np.linalg.inv(pose) if self.settings.inverted else pose)[:3]
            self._samples.extend((time, *rows.ravel().tolist()))


_FEWEST = 26  # Twice the numbers of an affine map of the tool's pose
_MUCH_BETTER = 10.0  # So many times less remains of inverted poses


def is_inverted(tools: Array, poses: Array) -> bool:
    """Whether it is the inverses of measured poses (N x 4 x 4; nan where there are none) that move as the tools do."""
    turned = np.isfinite(poses).all(axis=(1, 2))
    if turned.sum() < _FEWEST:
        return False
    design = np.column_stack([np.ones(turned.sum()), tools[turned, :3].reshape(-1, 12)])
    places = np.hstack([np.linalg.inv(poses[turned])[:, :3, 3], poses[turned, :3, 3]])
    remaining = places - design @ np.linalg.lstsq(design, places, rcond=None)[0]
    inverse, direct = np.linalg.norm(remaining[:, :3]), np.linalg.norm(remaining[:, 3:])
    return bool(_MUCH_BETTER * inverse < direct)


_CLOCKS_APART_S = 0.5
_NAMED = 5
_FULL_TURN = 2 * np.pi * (1 + 1e-9)


class BagSettings(Settings):
    """Which recording (a folder, or a file .mcap or .db3), and which topics are what.

    ``joints`` is the topic of joint states, needed only where there are several; ``measurements`` maps each measurement
    to its topic; ``still`` says what a rest is.
    """

    path: InputPath
    joints: JointsSettings = Field(default_factory=JointsSettings)
    measurements: dict[str, MeasuredSettings] = Field(default_factory=dict)
    still: RestSettings = Field(default_factory=RestSettings)


class Rosbag2Reader:
    """The reader ``rosbag2``; ``rows`` and ids number the rests, from 1."""

    Settings: ClassVar[type[BagSettings]] = BagSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"path": "/no/such/folder/recording"}

    def __init__(self, settings: BagSettings) -> None:
        self._settings = settings

    def read(self, request: ReadRequest) -> Dataset:
        """The means of all rests that were measured, in SI; the other rests are set aside with their reasons."""
        s, bag, digest = self._settings, Bag(self._settings.path), hashlib.sha256()
        unknown = sorted(set(s.measurements) - set(request.measurements))
        have = ", ".join(request.measurements) or "none"
        if not s.measurements and any(c.channel.partition(".")[0] in request.measurements for c in request.channels):
            hint = "Give measurements: {NAME: {topic: TOPIC}}; images are taken out of it with armcal bag images."
            self._refuse(f"found no measurements, expected a topic for one of {have}.", hint)
        if unknown:
            self._refuse(f"found measurements.{unknown[0]}, expected one of {have}.", "Correct the name.")
        slides = [kind == "length" for arm in request.arms.values() for kind in arm.commanded.values()]
        channels = self._joint_channels(request)
        joints = JointLog(tuple(channels.values()), slides, s.joints, s.still)
        logs = [MeasuredLog(name, own) for name, own in s.measurements.items()]
        every: tuple[JointLog | MeasuredLog, ...] = (joints, *logs)
        for topic, received, data, content in bag.messages(lambda topic: any(log.reads(topic) for log in every)):
            digest.update(data)
            for log in every:
                if log.reads(topic):
                    log.add(topic, content, received)
        remarks = joints.close(str(s.path))
        rests = joints.rests
        turning = {w.channel for w in request.channels if w.dimension == "angle" and not w.is_endless}
        largest = np.abs([rest.means for rest in rests]).max(axis=0) if rests else joints.largest
        for name, position in zip(channels, largest, strict=True):
            if name in turning and position > _FULL_TURN:
                hint = "If these are degrees, set joints: {unit: deg}; if not, record angles within one turn."
                self._refuse(f"{name} stands at {position:.6g} rad, more than one turn (2 pi rad).", hint)
        if not rests:
            hint = "Let the arm stand at each pose, or give a wider spread_deg or a shorter window_s under still."
            self._refuse(f"found no rest of at least {s.still.window:g} s in {joints.stamps.topic}.", hint)
        types = {topic.name: topic.type for topic in bag.topics}
        for measured in logs:
            remarks += measured.close(str(s.path), types)
        dataset = self._dataset(request, list(channels), joints, logs, [*bag.remarks, *remarks])
        return read_as(replace(dataset, sha256=digest.hexdigest()), request, by_line=False)

    def _joint_channels(self, request: ReadRequest) -> dict[str, str]:
        """The name in the recording of each joint channel (``arm.q1``)."""
        names = self._settings.joints.names
        alone = f"{next(iter(request.arms))}." if len(request.arms) == 1 else ""
        channels = {}
        for arm, model in request.arms.items():
            for joint in model.commanded:
                channel = f"{arm}.{joint}"
                channels[channel] = names.get(channel, names.get(joint) if alone else None) or joint
        strange = [name for name in names if name not in channels and alone + name not in channels]
        if strange:
            have = ", ".join(name.removeprefix(alone) for name in channels)
            hint = "Correct the name, or leave out what has its own name in the recording."
            self._refuse(f"found joints.names.{strange[0]}, expected joints of the arm: {have}.", hint)
        if twice := [name for name, count in Counter(channels.values()).items() if count > 1]:
            both = " and ".join(joint.removeprefix(alone) for joint, name in channels.items() if name == twice[0])
            self._refuse(f"found {twice[0]} for {both}, expected one joint of the recording each.", "Correct names.")
        return channels

    def _dataset(
        self, request: ReadRequest, names: list[str], joints: JointLog, logs: Sequence[MeasuredLog], remarks: list[str]
    ) -> Dataset:
        rests, still, place = joints.rests, self._settings.still, str(self._settings.path)
        means = np.array([rest.means for rest in rests]).T
        sides = np.array([rest.approach for rest in rests]).T
        channels = dict(zip(names, means, strict=True))
        channels |= {name.replace(".", ".approach.", 1): own for name, own in zip(names, sides, strict=True)}
        channels["time"] = np.array([(rest.begin + rest.end) / 2 for rest in rests])
        extra = {"rest_s": tuple(f"{rest.end - rest.begin:.3f}" for rest in rests)}
        extra["joint_scatter"] = tuple(f"{rest.scatter.max():.2g}" for rest in rests)
        seen = {log.instance: [*log.seen(rests, still)] for log in logs}
        for log in logs:
            name, own = log.instance, seen[log.instance]
            channels |= self._measured(name, request, own)
            arm = request.measurements[name].arms[0]
            angles = np.array([channels[f"{arm}.{joint}"] for joint in request.arms[arm].commanded]).T
            if is_inverted(nominal_tools(request.arms[arm], angles), np.array([one.pose for one in own])):
                text = f"the poses of {name} are those of its instrument in the body: their inverses move as the arm"
                mend = f"Set inverted: {str(not log.settings.inverted).lower()} for {name}."
                if log.settings.reference is not None:
                    mend = "Exchange frame and reference."
                self._refuse(f"{text} does.", mend)
            remarks += self._clock_remarks(log, joints, own)
            extra[f"{name}_samples"] = tuple(str(one.samples) for one in own)
            extra[f"{name}_scatter_mm"] = tuple(f"{1000 * one.deviation:.4f}" for one in own)
        faulty = {}
        for i, rest in enumerate(rests):
            faults = [f"{name}: {own[i].fault}" for name, own in seen.items() if own[i].fault]
            if rest.end - rest.begin < still.window:
                faulty[i] = f"too short: {rest.end - rest.begin:.2f} s, at least {still.window:g} s"
            elif faults and len(faults) == len(seen):
                faulty[i] = "; ".join(faults)
        ids = tuple(f"rest{i + 1}" for i in range(len(rests)))
        text = f"{len(rests) - len(faulty)} of {len(rests)} rests are records"
        if faulty:
            listed = "; ".join(f"{ids[i]}: {reason}" for i, reason in list(faulty.items())[:_NAMED])
            text += f"; left out: {listed}" + (f"; and {len(faulty) - _NAMED} more" if len(faulty) > _NAMED else "")
        if len(faulty) == len(rests):
            self._refuse(f"{text}.", " ".join(remarks) or "Let the arm stand where it is measured.")
        warnings = tuple(f"{place}: {remark}" for remark in (*remarks, f"{text}."))
        rows = tuple(range(1, len(rests) + 1))
        return Dataset(ids, channels, extra, rows, place, warnings=warnings).without(faulty)

    def _clock_remarks(self, log: MeasuredLog, joints: JointLog, seen: Sequence[_Seen]) -> list[str]:
        """By the times of receipt the clocks differ, or a point moves while the joints rest, as if they did."""
        apart = joints.stamps.delay - log.stamps.delay
        moves = [bool(one.fault) for one in seen if one.samples >= _FEWEST_SAMPLES]
        clocks = f"stamps of {log.settings.topic} are about {apart:.3g} s ahead of those of {joints.stamps.topic}"
        if abs(apart - log.settings.clock_offset) > _CLOCKS_APART_S:
            return [f"{clocks}, by the times of receipt. Set clock_offset_s: {apart:.3f} for {log.instance}."]
        if 2 * sum(moves) <= len(moves):
            return []
        text = f"{log.instance} moves in {sum(moves)} of {len(moves)} rests of the joints. It is on another arm, or not"
        text += f" in m; or its clock is another: by the times of receipt {clocks}"
        return [f"{text}, set clock_offset_s: {apart:.3f} for {log.instance}."]

    def _measured(self, name: str, request: ReadRequest, seen: Sequence[_Seen]) -> dict[str, Array]:
        """The channels of a measurement, NaN where it saw nothing."""
        poses = np.array([one.pose for one in seen])
        turned = np.isfinite(poses[:, 0, 0])
        rows = np.column_stack([poses[:, :3, 3], np.full((len(poses), 4), np.nan)])
        if turned.any():
            rows[turned, 3:] = Rotation.from_matrix(poses[turned, :3, :3]).as_quat(canonical=True)
        values = dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), rows.T, strict=True))
        needed = [channel.name for channel in request.measurements[name].channels()]
        lacking = [own for own in needed if own not in values]
        if lacking:
            hint = "Take images out with armcal bag images, or give another measurement."
            self._refuse(f"{name} reads {lacking[0]}, which a message of a pose does not hold.", hint)
        if "qw" in needed and not turned.any() and np.isfinite(values["x"]).any():
            topic = self._settings.measurements[name].topic
            self._refuse(f"{name} reads orientations, and {topic} has points.", "Set type: tip_position.")
        return {f"{name}.{own}": values[own] for own in needed}

    def _refuse(self, message: str, hint: str) -> NoReturn:
        refuse(self._settings.path, message, hint)
