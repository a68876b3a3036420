"""Measured positions and poses of a recording: messages of one topic, or of two frames of a tree of transforms."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Duration
from armcal.io.plain_files import refuse
from pydantic import model_validator
from scipy.spatial.transform import Rotation

from armcal_ros2.joints import MOST_THINNED, THINNED_S, JointRest
from armcal_ros2.message import Topic
from armcal_ros2.stamps import Stamps, TopicSettings, nanoseconds

TRANSFORMS = "tf2_msgs/msg/TFMessage"
_FIELDS: Mapping[str, tuple[str, str, str]] = MappingProxyType(
    {
        "geometry_msgs/msg/PoseStamped": ("pose", "position", "orientation"),
        "geometry_msgs/msg/PointStamped": ("", "point", ""),
        "geometry_msgs/msg/TransformStamped": ("transform", "translation", "rotation"),
    }
)
MEASURED = (*_FIELDS, TRANSFORMS)
"""The types of messages that measure."""
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
