"""What a recording holds: topics, frames, joints and their rests, and the data section that would read it."""

from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armcal.errors import DataError, Location

from armcal_ros2.bag import Bag
from armcal_ros2.joints import JointLog, JointsSettings, RestSettings
from armcal_ros2.message import JOINT_STATE
from armcal_ros2.samples import MEASURED, TRANSFORMS
from armcal_ros2.stamps import nanoseconds

_MOST_FRAMES = 200
_LATEST = 20
"""So many stamps of joint states are kept: transforms that are computed from them come at once."""


@dataclass
class TopicSummary:
    """A topic: its type, messages, first and last receipt (s since 1970), and frames (of transforms ``a -> b``).

    ``computed`` counts transforms, by frame, with the very stamp of a joint state: robot_state_publisher's.
    """

    type: str
    first: float
    last: float = 0.0
    count: int = 0
    frames: dict[str, int] = field(default_factory=dict)
    computed: Counter[str] = field(default_factory=Counter)

    @property
    def measured(self) -> list[str]:
        return [frame for frame, count in self.frames.items() if 2 * self.computed[frame] < count]


@dataclass(frozen=True)
class Survey:
    """Topics by name, joint states by topic, and what is missing or wrong."""

    topics: dict[str, TopicSummary]
    joints: dict[str, JointLog]
    remarks: list[str]

    def content(self) -> dict[str, Any]:
        rests = {name: [[rest.begin, rest.end] for rest in log.rests] for name, log in self.joints.items()}
        topics = {name: vars(topic) for name, topic in self.topics.items()}
        names = {name: list(log.names) for name, log in self.joints.items()}
        return {"topics": topics, "joints": names, "rests": rests, "remarks": self.remarks}

    def data(self, path: Path) -> dict[str, Any]:
        """A data section; empty without joint states or without measurements."""
        section: dict[str, Any] = {"type": "rosbag2", "path": str(path)}
        if not self.joints:
            return {}
        topic, log = max(self.joints.items(), key=lambda entry: len(entry[1].rests))
        section["joints"] = {"topic": topic}
        numbered = {f"q{i}": name for i, name in enumerate(log.names, start=1)}
        if set(numbered) != set(log.names):
            section["joints"]["names"] = numbered
        measured: dict[str, dict[str, str]] = {}
        for name, summary in self.topics.items():
            if summary.type not in MEASURED or name.endswith("_static") or not summary.measured:
                continue
            instance = f"tracker{len(measured) + 1}" if measured else "tracker"
            measured[instance] = {"topic": name}
            if summary.type == TRANSFORMS:
                parent, _, child = summary.measured[-1].partition(" -> ")
                measured[instance] |= {"frame": child, "reference": parent}
        return {**section, "measurements": measured} if measured else section


def survey(bag: Bag) -> Survey:
    """Once through the recording.

    Raises:
        DataError: it is none, or holds no message.
        PluginError: rosbags is not there.
    """
    topics, joints, remarks = dict[str, TopicSummary](), dict[str, JointLog](), list[str]()
    stamps = deque[int](maxlen=_LATEST)
    for (topic, received, _), message in bag.decoded(lambda topic: topic.type in (JOINT_STATE, *MEASURED)):
        time = received / 1e9
        own = topics.setdefault(topic.name, TopicSummary(topic.type, time))
        own.count, own.last, own.first = own.count + 1, max(own.last, time), min(own.first, time)
        if message is None or (topic.type == JOINT_STATE and not message.name):
            continue
        if topic.type == JOINT_STATE:
            if topic.name not in joints:
                own_settings, still = JointsSettings(topic=topic.name), [False] * len(message.name)
                joints[topic.name] = JointLog(message.name, still, own_settings, RestSettings())
            joints[topic.name].add(topic.name, message, received)
            stamps.append(nanoseconds(message.header.stamp) or -1)
            continue
        for part in message.transforms if topic.type == TRANSFORMS else [message]:
            child = getattr(part, "child_frame_id", "")
            frame = f"{part.header.frame_id} -> {child}" if child else part.header.frame_id
            if frame in own.frames or len(own.frames) < _MOST_FRAMES:
                own.frames[frame] = own.frames.get(frame, 0) + 1
                if child and nanoseconds(part.header.stamp) in stamps:
                    own.computed[frame] += 1
    if not topics:
        hint = "Record again, or give another recording."
        raise DataError(
            "found no message in it.", where=Location(str(bag.path)), hint=f"{' '.join(bag.remarks)} {hint}"
        )
    for log in joints.values():
        try:
            remarks += log.close(str(bag.path))
        except DataError as fault:
            remarks.append(f"{fault.message} {fault.hint}")
    for name, topic_summary in topics.items():
        if sum(topic_summary.computed.values()) and not topic_summary.measured:
            remarks.append(f"all frames in {name} are computed from the joints: they measure nothing.")
    return Survey(topics, joints, [*bag.remarks, *remarks])
