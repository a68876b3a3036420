"""Measured positions and poses of a recording: messages of one topic, or of two frames of a tree of transforms."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Angle, Duration, Length, Settings
from armcal.io.plain_files import refuse
from armcal.measure.rests import LiveRests, Rows, StillSettings
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from armcal_ros2.bag import Stamps, Topic, TopicSettings, nanoseconds

GUARD_S = 0.1  # At the end of a rest, before joints are seen to move
_BLOCK = 1000
_LARGEST = 1e6  # No joint stands so far away, in any unit
THINNED_S = 0.01
MOST_THINNED = 400_000  # So many moments of the motion are kept, enough for an hour


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
    """Joint states as they come: rests, directions of motion, and a thinned path.

    Args:
        names: of the joints as the recording has them.
        slides: which of them slide.
        settings: where they come from; rests: what rests are.

    Attributes:
        names: of the joints.
        topic: their topic; if none was stated, the first that has joint states.
        rests: those that are over.
        stamps: the times of the messages.
        largest: absolute positions, by joint (rad or m).
        gaps: begin and length of pauses of the messages that are longer than a rest's window (s).
    """

    def __init__(
        self, names: Sequence[str], slides: Sequence[bool], settings: JointsSettings, rests: RestSettings
    ) -> None:
        self.names, self._settings = tuple(names), settings
        self._limits = np.where(slides, rests.sliding_spread, rests.spread)
        self._scale = np.where(slides, 1.0, math.radians(1.0) if settings.unit == "deg" else 1.0)
        self._window, self._settle = rests.window, rests.settle
        self._places: dict[tuple[str, ...], list[int]] = {}
        # shorter pauses are found too, to be listed
        self._live = LiveRests(StillSettings.si(window=rests.window / 2, spread=1.0))
        self._times, self._rows = array("d"), list[Array]()
        self._turned_at: list[tuple[float, Array]] = []
        self._furthest: Array | None = None
        self._direction = np.zeros(len(self.names))
        self._path_times, self._path_rows = array("d"), array("f")
        self._lacking: Counter[str] = Counter()
        self._faulty = 0
        self.largest = np.zeros(len(self.names))
        self._seen: set[str] = set()
        self.rests: list[JointRest] = []
        self.gaps: list[tuple[float, float]] = []
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
        before = self.stamps.latest
        time = self.stamps.time(nanoseconds(message.header.stamp), received)
        if time is None:
            return
        if len(message.position) != len(names) or not (np.abs(row := message.position[places]) < _LARGEST).all():
            self._faulty += 1
            return
        if before is not None and time - before > self._window:
            self.gaps.append((before, time - before))
        self._take(time, row * self._scale)

    def close(self, place: str) -> list[str]:
        """The end of the recording: what was left out, sentences.

        Raises:
            DataError: nothing in it can be used.
        """
        self._flush()
        self.rests += [self._rest(rows) for rows in self._live.lasting()]
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
        if self._lacking:
            (name, some), *_ = self._lacking.most_common()
            remarks.append(f"{some} messages of {topic} name some joints of the arm without {name}: left out.")
        if self._faulty:
            text = f"{self._faulty} of {count} messages of {topic} have positions that are missing or not finite"
            remarks.append(f"{text}: left out.")
        if self.gaps:
            begin, length = max(self.gaps, key=lambda gap: gap[1])
            text = f"{topic} is silent {len(self.gaps)} times, for up to {length:.1f} s (from {begin:.2f})"
            remarks.append(f"{text}: a rest ends there.")
        return remarks

    def approach(self, time: float) -> Array:
        """The sign of each joint's last motion before a time; 0 where it has not moved."""
        place = bisect_right(self._turned_at, time, key=lambda entry: entry[0])
        return self._turned_at[place - 1][1] if place else np.zeros(len(self.names))

    def path(self) -> tuple[Array, Array]:
        """Times (N, s) and joints (N x joints; rad or m) about every 10 ms, as long as memory allows."""
        return np.array(self._path_times), np.array(self._path_rows, dtype=float).reshape(-1, len(self.names))

    def _take(self, time: float, row: Array) -> None:
        self._times.append(time)
        self._rows.append(row)
        self.largest = np.maximum(self.largest, np.abs(row))
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
        is_later = not self._path_times or time - self._path_times[-1] >= THINNED_S
        if is_later and len(self._path_times) < MOST_THINNED:
            self._path_times.append(time)
            self._path_rows.frombytes(row.astype(np.float32).tobytes())
        if len(self._rows) >= _BLOCK:
            self._flush()

    def _flush(self) -> None:
        if self._rows:
            rows = Rows(np.array(self._rows).T / self._limits[:, None], np.array(self._times), ())
            self.rests += [self._rest(part) for part in self._live.add(rows)]
        self._times, self._rows = array("d"), []

    def _rest(self, rows: Rows) -> JointRest:
        assert rows.time is not None
        begin, end = float(rows.time[0]), float(rows.time[-1])
        settled = (rows.time >= begin + self._settle) & (rows.time <= end - GUARD_S)
        joints = (rows.joints[:, settled] if settled.any() else rows.joints) * self._limits[:, None]
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
    ``clock_offset`` is how far the clock of its stamps is ahead of that of the joints; ``estimate`` finds it from the
    motions between rests.
    """

    topic: str
    frame: str | None = None
    reference: str | None = None
    inverted: bool = False
    clock_offset: Duration | Literal["estimate"] = 0.0

    @model_validator(mode="after")
    def _both_frames(self) -> MeasuredSettings:
        if self.reference is not None and self.frame is None:
            raise ValueError("found reference without frame, expected both: the pose of frame in reference")
        return self


class _Tree:
    """The newest transforms, by child frame: parent, message and time (None: always)."""

    def __init__(self) -> None:
        self.edges: dict[str, tuple[str, Any, float | None]] = {}

    def way(self, reference: str, frame: str) -> tuple[list[str], list[str]] | None:
        """The frames above a frame, itself first, and above another, as far as they are not the same; None without."""
        above, beside = self._above(frame), self._above(reference)
        shared = next((name for name in above if name in beside), None)
        return None if shared is None else (above[: above.index(shared)], beside[: beside.index(shared)])

    def pose(self, names: Sequence[str]) -> Array:
        """Of the first frame in the parent of the last (4 x 4)."""
        pose = np.eye(4)
        for name in names:
            moved = self.edges[name][1]
            t, q = moved.translation, moved.rotation
            step = np.eye(4)
            step[:3, :3] = Rotation.from_quat((q.x, q.y, q.z, q.w)).as_matrix()
            step[:3, 3] = (t.x, t.y, t.z)
            pose = step @ pose
        return pose

    def _above(self, frame: str) -> list[str]:
        names = [frame]
        while names[-1] in self.edges and self.edges[names[-1]][0] not in names:
            names.append(self.edges[names[-1]][0])
        return names


class MeasuredLog:
    """What a measurement saw, as messages come: in rests, or all along its path.

    Args:
        instance: the measurement's name.
        settings: where it comes from.
        rests: in order; without any, its path is kept, thinned.
        offset: how far its clock is ahead of that of the joints (s).

    Attributes:
        stamps: the times of its messages.
        by_rest: samples (8 each: s, m, quaternion xyzw) of each rest, by its place.
    """

    def __init__(
        self, instance: str, settings: MeasuredSettings, rests: Sequence[JointRest] = (), offset: float = 0.0
    ) -> None:
        self.instance, self.settings = instance, settings
        self.stamps = Stamps(settings.topic, settings.stamps)
        self.by_rest: dict[int, array[float]] = {}
        self._rests, self._begins, self.offset = rests, [rest.begin for rest in rests], offset
        self._tree = _Tree()
        self._frames: Counter[str] = Counter()
        self._faults: Counter[str] = Counter()
        self._path = array("d")
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

    def path(self) -> tuple[Array, Array]:
        """Times (N, s, by its own clock) and positions (N x 3, m)."""
        rows = np.array(self._path).reshape(-1, 8)
        return rows[:, 0], rows[:, 1:4]

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
            child = part.child_frame_id.lstrip("/")
            self._tree.edges[child] = (part.header.frame_id.lstrip("/"), part.transform, None if is_static else at)
            changed.add(child)
        way = self._tree.way((s.reference or "").lstrip("/"), (s.frame or "").lstrip("/"))
        if way is None or changed.isdisjoint(names := [*way[0], *way[1]]):
            return
        # where several frames move, the oldest says when all of the pose was seen
        times = (self._tree.edges[name][2] for name in names)
        oldest = min((at for at in times if at is not None), default=None)
        if oldest is None or oldest == self._moved_at:
            return
        self._moved_at = oldest
        time = self.stamps.time(round(oldest * 1e9), received)
        if time is not None:
            yield time, np.linalg.inv(self._tree.pose(way[1])) @ self._tree.pose(way[0])

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
        if not self._rests:
            is_later = not self._path or time - self._path[-8] >= THINNED_S
            if is_later and len(self._path) < 8 * MOST_THINNED:
                self._path.extend(sample)
            return
        place = bisect_right(self._begins, time - self.offset) - 1
        if place >= 0 and time - self.offset <= self._rests[place].end:
            kept = self.by_rest.setdefault(place, array("d"))
            if len(kept) < 8 * _MOST_SAMPLES:
                kept.extend(sample)
