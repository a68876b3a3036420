"""Joint states of a recording: where joints stood still, and how they came there."""

import math
from array import array
from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Angle, Duration, Length, Settings
from armcal.io.plain_files import refuse
from armcal.measure.rests import LiveRests, Rows, StillSettings
from pydantic import Field

from armcal_ros2.stamps import Stamps, TopicSettings, nanoseconds

GUARD_S = 0.1
"""At the end of a rest, before joints are seen to move."""
_BLOCK = 1000
_LARGEST = 1e6
"""No joint stands so far away, in any unit."""
THINNED_S = 0.01
MOST_THINNED = 400_000
"""So many moments of the motion are kept, enough for an hour."""


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
        window: how long it lasts at least.
        spread: by how much no turning joint moves in it; ``sliding_spread``: no sliding one.
        settle: what passes after joints stopped before measurements count.
        drift: by how much the mean of the measured positions may differ between a rest's halves.
    """

    window: Annotated[Duration, Field(gt=0)] = 0.5
    spread: Annotated[Angle, Field(gt=0)] = math.radians(0.1)
    sliding_spread: Annotated[Length, Field(gt=0)] = 0.0002
    settle: Annotated[Duration, Field(ge=0)] = 0.2
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
