"""Joints and measurements of a recording, message by message: rests, and what was measured in them."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Angle, Duration, Length, Settings
from armcal.io.plain_files import refuse
from armcal.measure.rests import StillSettings, rests
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from armcal_ros2.bag import Stamps, Topic, TopicSettings, nanoseconds

GUARD_S = 0.1  # At the end of a rest, before joints are seen to move
_THINNED_S = 0.01  # Joints are kept so far apart: 25 MB for an hour of seven of them
_LARGEST = 1e6  # No joint stands so far away, in any unit
_JUMP, _MOST_RETURNS = 20.0, 0.1
"""A larger part of messages that jump by so many spreads, to where the joints just were: two programs publish them."""


class JointsSettings(TopicSettings):
    """Where joint angles come from.

    ``names`` maps joints of the arm (``q1``, with several arms ``left.q1``) to those of the recording; others have
    their own name there. ``unit`` is rad as ROS has it, or deg where the driver errs.
    """

    names: dict[str, str] = Field(default_factory=dict)
    unit: Literal["rad", "deg"] = "rad"


class RestSettings(Settings):
    """What a rest is.

    Attributes:
        spread: by how much no turning joint moves in it; ``sliding_spread``: no sliding one.
        drift: by how much the mean of the measured positions may differ between a rest's halves.
    """

    window: Annotated[Duration, Field(gt=0)] = 0.5  # how long it lasts at least
    spread: Annotated[Angle, Field(gt=0)] = math.radians(0.1)
    sliding_spread: Annotated[Length, Field(gt=0)] = 0.0002
    settle: Annotated[Duration, Field(ge=0)] = 0.2  # what passes after joints stopped before measurements count
    drift: Annotated[Length, Field(gt=0)] = 0.001


@dataclass(frozen=True)
class JointRest:
    """A rest of the joints: begin and end (s), means and standard deviations by joint (rad or m)."""

    begin: float
    end: float
    means: Array
    scatter: Array


class JointLog:
    """Joint states as they come: rests, and directions of motion.

    Args:
        names: of the joints as the recording has them.
        slides: which of them slide.
        settings: where they come from; still: what rests are.

    Attributes:
        names: of the joints.
        topic: their topic; if none was stated, the first that has joint states.
        rests: complete once it is closed; shorter ones than a rest's window, to be listed, too.
        stamps: the times of the messages.
        largest: absolute positions, by joint (rad or m), once it is closed.
    """

    def __init__(
        self, names: Sequence[str], slides: Sequence[bool], settings: JointsSettings, still: RestSettings
    ) -> None:
        self.names = tuple(names)
        self._limits = np.where(slides, still.sliding_spread, still.spread)
        self._scale = np.where(slides, 1.0, math.radians(1.0) if settings.unit == "deg" else 1.0)
        self._window, self._settle = still.window, still.settle
        self._places: dict[tuple[str, ...], list[int]] = {}
        self._times, self._rows = array("d"), array("d")
        self._turned_at: list[tuple[float, Array]] = []
        self._furthest: Array | None = None
        self._direction = np.zeros(len(self.names))
        self._before: list[Array] = []  # where the joints were last, and where before that, apart
        self._returns = 0
        self._lacking: Counter[str] = Counter()
        self._faulty = 0
        self.largest = np.zeros(len(self.names))
        self._seen: set[str] = set()
        self.rests: list[JointRest] = []
        self.topic = settings.topic
        self.stamps = Stamps(settings.topic or "", settings.stamps)
        self._others: set[str] = set()

    def add(self, topic: str, message: Any, received: int) -> None:
        """The next message, a sensor_msgs/JointState."""
        if self.topic is None:
            self.topic = self.stamps.topic = topic
        if topic != self.topic:
            self._others.add(topic)
            return
        names = tuple(message.name)
        if names not in self._places:
            self._seen |= set(names)
            self._places[names] = [names.index(name) for name in self.names if name in names]
        places = self._places[names]
        if len(places) < len(self.names):
            if places:
                self._lacking[next(name for name in self.names if name not in names)] += 1
            return
        time = self.stamps.time(nanoseconds(message.header.stamp), received)
        if time is None:
            return
        if len(message.position) != len(names) or not (np.abs(row := message.position[places]) < _LARGEST).all():
            self._faulty += 1
            return
        self._take(time, row * self._scale)

    def close(self, place: str) -> list[str]:
        """The end of the recording: what was left out, sentences.

        Raises:
            DataError: nothing in it can be used.
        """
        times, rows = np.array(self._times), np.array(self._rows).reshape(-1, len(self.names)).T
        self.largest = np.abs(rows).max(axis=1, initial=0.0)
        still = StillSettings.si(window=self._window / 2, spread=1.0)
        for rest in rests(rows / self._limits[:, None], (), times, still):
            part = slice(rest.start, rest.stop)
            self.rests.append(self._rest(times[part], rows[:, part]))
        topic, count = self.topic, self.stamps.count
        if self._others or topic is None or not (self._seen or count):
            text = f"found {', '.join(sorted(filter(None, (topic, *self._others)))) or 'no topic'} with joint states"
            hint = "Set joints: {topic: NAME} in the data section; armcal bag info lists what is there."
            refuse(place, f"{text}, expected one.", hint)
        if not count:
            lacking = [name for name in self.names if name not in self._seen]
            have = ", ".join(sorted(self._seen)) or "none"
            hint = "Give joints: {names: {JOINT: NAME IN THE RECORDING}} in the data section."
            missing = f"joint {lacking[0]}" if lacking else "message with all joints of the arm"
            refuse(place, f"found no {missing} in {topic}; its joints are {have}.", hint)
        remarks = self.stamps.check(place)
        if self._faulty == count:
            hint = "Repair the driver, or record again."
            refuse(place, f"none of {count} messages of {topic} has a finite position for each joint.", hint)
        if self._returns > _MOST_RETURNS * count:
            text = f"the joints of {topic} jump to and fro between two sets of values in {self._returns} of {count}"
            hint = "Stop one of them, such as joint_state_publisher beside a controller, and record again."
            refuse(place, f"{text} messages: two programs publish it.", hint)
        if self._lacking:
            (name, some), *_ = self._lacking.most_common()
            remarks.append(f"{some} messages of {topic} name some joints of the arm without {name}: left out.")
        if self._faulty:
            text = f"{self._faulty} of {count} messages of {topic} have positions that are missing or not finite"
            remarks.append(f"{text}: left out.")
        pauses = np.diff(times)
        if (pauses > self._window).any():
            longest = int(np.argmax(pauses))
            text = f"{topic} is silent {(pauses > self._window).sum()} times, for up to {pauses[longest]:.1f} s"
            text += f" (from {times[longest]:.2f})"
            remarks.append(f"{text}: a rest ends there.")
        return remarks

    def approach(self, time: float) -> Array:
        """The sign of each joint's last motion before a time; 0 where it has not moved."""
        place = bisect_right(self._turned_at, time, key=lambda entry: entry[0])
        return self._turned_at[place - 1][1] if place else np.zeros(len(self.names))

    def _take(self, time: float, row: Array) -> None:
        if self._before and (np.abs(row - self._before[0]) > _JUMP * self._limits).any():
            self._returns += int((np.abs(row - self._before[-1]) <= self._limits).all())
            self._before.insert(1, self._before[0])
        self._before[:] = [row, *self._before[1:2]]
        if not self._times or time - self._times[-1] >= _THINNED_S:
            self._times.append(time)
            self._rows.extend(row.tolist())
        if self._furthest is None:
            self._furthest = row
        moved = row - self._furthest
        beyond = np.abs(moved) > self._limits
        if beyond.any():
            self._furthest = np.where(beyond, row, self._furthest)
            direction = np.where(beyond, np.sign(moved), self._direction)
            if (direction != self._direction).any():
                self._turned_at.append((time, direction))
                self._direction = direction

    def _rest(self, times: Array, rows: Array) -> JointRest:
        begin, end = float(times[0]), float(times[-1])
        settled = (times >= begin + self._settle) & (times <= end - GUARD_S)
        joints = rows[:, settled] if settled.any() else rows
        return JointRest(begin, end, joints.mean(axis=1), joints.std(axis=1))


def channels_of(commanded: Mapping[str, Mapping[str, str]], names: Mapping[str, str]) -> dict[str, str]:
    """The name in the recording of each joint channel (``arm.q1``), from the arms' joints and the settings."""
    alone = len(commanded) == 1
    result = {}
    for arm, joints in commanded.items():
        for joint in joints:
            own = names.get(f"{arm}.{joint}", names.get(joint) if alone else None)
            result[f"{arm}.{joint}"] = own or joint
    return result


TRANSFORMS = "tf2_msgs/msg/TFMessage"
_FIELDS: Mapping[str, tuple[str, str, str]] = MappingProxyType(
    {
        "geometry_msgs/msg/PoseStamped": ("pose", "position", "orientation"),
        "geometry_msgs/msg/PointStamped": ("", "point", ""),
        "geometry_msgs/msg/TransformStamped": ("transform", "translation", "rotation"),
    }
)
MEASURED = (*_FIELDS, TRANSFORMS)  # The types of messages that measure
_NORM_TOLERANCE = 1e-3
_STATIC = "/tf_static"
_MOST_SAMPLES = 1000
_MOST_OTHERS = 0.01


class MeasuredSettings(TopicSettings):
    """Where a measurement comes from.

    ``topic`` is one of PoseStamped, PointStamped or TransformStamped; ``frame`` is then the frame_id that its headers
    must have. Of transforms (``/tf``) the pose of ``frame`` in ``reference`` is read. With ``inverted`` poses are those
    of the instrument in the body, as of a marker that a camera on the hand sees, and their inverses are read.
    ``clock_offset`` is how far the clock of its stamps is ahead of that of the joints.
    """

    topic: str
    frame: str | None = None
    reference: str | None = None
    inverted: bool = False
    clock_offset: Duration = 0.0

    @model_validator(mode="after")
    def _both_frames(self) -> MeasuredSettings:
        if self.reference is not None and self.frame is None:
            raise ValueError("found reference without frame, expected both: the pose of frame in reference")
        return self


class _Tree:
    """The newest transforms, by child frame: parent, pose in it (4 x 4, m) and time (None: always)."""

    def __init__(self) -> None:
        self.edges: dict[str, tuple[str, Array, float | None]] = {}

    def between(self, reference: str, frame: str) -> tuple[list[str], Array] | None:
        """The frames on the way from one to another, and the pose of the latter in the former; None without a way."""
        above, beside = self._above(frame), self._above(reference)
        if above[-1] != beside[-1]:
            return None
        while above and beside and above[-1] == beside[-1]:  # what is above both does not matter
            above.pop(), beside.pop()
        return [*above, *beside], np.linalg.inv(self._pose(beside)) @ self._pose(above)

    def _pose(self, names: Sequence[str]) -> Array:
        return reduce(lambda pose, name: self.edges[name][1] @ pose, names, np.eye(4))

    def _above(self, frame: str) -> list[str]:
        names = [frame]
        while names[-1] in self.edges and self.edges[names[-1]][0] not in names:
            names.append(self.edges[names[-1]][0])
        return names


class MeasuredLog:
    """What a measurement saw in rests, as messages come.

    Args:
        instance: the measurement's name.
        settings: where it comes from.
        rests: in order.

    Attributes:
        stamps: the times of its messages.
        by_rest: samples (8 each: s, m, quaternion xyzw) of each rest, by its place.
    """

    def __init__(self, instance: str, settings: MeasuredSettings, rests: Sequence[JointRest]) -> None:
        self.instance, self.settings = instance, settings
        self.stamps = Stamps(settings.topic, settings.stamps)
        self.by_rest: dict[int, array[float]] = {}
        self._rests, self._begins, self.offset = rests, [rest.begin for rest in rests], settings.clock_offset
        self._tree = _Tree()
        self._frames: Counter[str] = Counter()
        self._faults: Counter[str] = Counter()
        self._moved_at: float | None = None

    @property
    def types(self) -> tuple[str, ...]:
        return tuple(_FIELDS) if self.settings.reference is None else (TRANSFORMS,)

    def reads(self, topic: Topic) -> bool:
        """Whether messages of a topic are for it: its own, and transforms that hold for good."""
        is_static = self.settings.reference is not None and topic.name.endswith(_STATIC)
        return topic.type in self.types and (topic.name == self.settings.topic or is_static)

    def add(self, topic: Topic, message: Any, received: int) -> None:
        """The next message of a topic that it reads."""
        if topic.type == TRANSFORMS:
            for at, pose in self._moved(message, received, topic.name.endswith(_STATIC)):
                self._take(at, pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat())
            return
        self._frames[message.header.frame_id] += 1
        if self.settings.frame not in (None, message.header.frame_id):
            return
        time = self.stamps.time(nanoseconds(message.header.stamp), received)
        if time is None:
            return
        body, position, orientation = _FIELDS[topic.type]
        held = getattr(message, body) if body else message
        q = getattr(held, orientation) if orientation else None
        p = getattr(held, position)
        turn = None if q is None else np.array([q.x, q.y, q.z, q.w])
        self._take(time, np.array([p.x, p.y, p.z]), turn)

    def close(self, place: str) -> list[str]:
        """What was left out, sentences.

        Raises:
            DataError: nothing was measured, or its frames are not those that were asked for.
        """
        s, count = self.settings, self.stamps.count
        where = f"{place}, data.measurements.{self.instance}"
        if s.reference is not None and not count:
            frames = ", ".join(sorted({*self._tree.edges, *(edge[0] for edge in self._tree.edges.values())}))
            text = f"found no way from the frame {s.reference} to {s.frame} in {s.topic}; its frames are"
            refuse(where, f"{text} {frames[:400] or 'none'}.", "Correct frame and reference.")
        if not count:
            frames = ", ".join(f"{name or 'none'} ({some})" for name, some in self._frames.items()) or "no messages"
            refuse(where, f"found {frames} in {s.topic}, expected the frame {s.frame}.", "Correct frame.")
        usual = s.frame or max(self._frames, key=lambda name: self._frames[name], default="")
        others = sum(some for name, some in self._frames.items() if name != usual)
        if s.frame is None and others > _MOST_OTHERS * count:
            frames = ", ".join(f"{name or 'none'} ({some})" for name, some in self._frames.most_common())
            refuse(where, f"found several frames in {s.topic}: {frames}, expected one.", "Set frame to one of them.")
        remarks = self.stamps.check(where)
        if others:
            remarks.append(f"{others} messages of {s.topic} have other frames than {usual!r}.")
        if self._faults:
            listed = ", ".join(f"{some} whose {what}" for what, some in self._faults.most_common())
            remarks.append(f"of {count} messages of {s.topic} some were left out: {listed}.")
        return remarks

    def samples(self, rest: int) -> Array:
        """Those of a rest (N x 8: s, m, quaternion xyzw)."""
        return np.array(self.by_rest.get(rest, ()), dtype=float).reshape(-1, 8)

    def _moved(self, message: Any, received: int, is_static: bool) -> Iterator[tuple[float, Array]]:
        """Times and poses that new transforms give."""
        s, changed = self.settings, set[str]()
        for part in message.transforms:
            q = part.transform.rotation
            if not abs(math.hypot(q.x, q.y, q.z, q.w) - 1) <= _NORM_TOLERANCE:
                self._faults["quaternion is not of length 1"] += 1
                continue
            at = (nanoseconds(part.header.stamp) if s.stamps == "header" else received) / 1e9
            pose, place, child = np.eye(4), part.transform.translation, part.child_frame_id.lstrip("/")
            pose[:3, :3] = Rotation.from_quat((q.x, q.y, q.z, q.w)).as_matrix()
            pose[:3, 3] = (place.x, place.y, place.z)
            self._tree.edges[child] = (part.header.frame_id.lstrip("/"), pose, None if is_static else at)
            changed.add(child)
        way = self._tree.between((s.reference or "").lstrip("/"), (s.frame or "").lstrip("/"))
        if way is None or changed.isdisjoint(way[0]):
            return
        # where several frames move, the oldest says when all of the pose was seen
        times = (self._tree.edges[name][2] for name in way[0])
        oldest = min((at for at in times if at is not None), default=None)
        if oldest is None or oldest == self._moved_at:
            return
        self._moved_at = oldest
        time = self.stamps.time(round(oldest * 1e9), received)
        if time is not None:
            yield time, way[1]

    def _take(self, time: float, position: Array, turn: Array | None) -> None:
        if not np.isfinite(position).all():
            self._faults["position is not finite"] += 1
            return
        if turn is None:
            if self.settings.inverted:
                self._faults["orientation is missing, so that they have no inverse"] += 1
                return
            turn = np.full(4, np.nan)
        elif not abs((norm := float(np.linalg.norm(turn))) - 1) <= _NORM_TOLERANCE:
            self._faults["quaternion is zero" if norm < _NORM_TOLERANCE else "quaternion is not of length 1"] += 1
            return
        elif self.settings.inverted:
            inverse = Rotation.from_quat(turn).inv()
            position, turn = -inverse.apply(position), inverse.as_quat()
        sample = (time, *position.tolist(), *turn.tolist())
        place = bisect_right(self._begins, time - self.offset) - 1
        if place >= 0 and time - self.offset <= self._rests[place].end:
            kept = self.by_rest.setdefault(place, array("d"))
            if len(kept) < 8 * _MOST_SAMPLES:
                kept.extend(sample)
