"""The reader ``rosbag2``: records from a recording of ROS 2, one a rest of the arm."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NoReturn

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.settings import InputPath, Settings
from armcal.calibration.rigid_chain import nominal_tools
from armcal.io.plain_files import refuse
from armcal.measure.checks import read_as
from armcal.measure.reader import ReadRequest
from armcal.measure.rests import deviations_of_mean, judged, mean_pose
from pydantic import Field
from scipy.spatial.transform import Rotation

from armcal_ros2.bag import JOINT_STATE, Bag, Topic
from armcal_ros2.samples import (
    GUARD_S,
    MEASURED,
    TRANSFORMS,
    JointLog,
    JointRest,
    JointsSettings,
    MeasuredLog,
    MeasuredSettings,
    RestSettings,
    channels_of,
)

_FEWEST = 26  # Twice the numbers of an affine map of the tool's pose
_MUCH_BETTER = 10.0  # So many times less is left of inverted poses


def joint_channels(request: ReadRequest) -> list[str]:
    return [f"{name}.{joint}" for name, arm in request.arms.items() for joint in arm.commanded]


def is_inverted(tools: Array, poses: Array) -> bool:
    """Whether it is the inverses of measured poses (N x 4 x 4; nan where there are none) that move as the tools do."""
    inverted = np.full_like(poses, np.nan)
    turned = np.isfinite(poses).all(axis=(1, 2))
    inverted[turned] = np.linalg.inv(poses[turned])
    return _MUCH_BETTER * _left(tools[turned], inverted[turned]) < _left(tools[turned], poses[turned])


def _left(tools: Array, poses: Array) -> float:
    known = np.isfinite(poses[:, :3, 3]).all(axis=1)
    if known.sum() < _FEWEST:
        return np.inf
    places, moved = poses[known, :3, 3], tools[known, :3].reshape(-1, 12)
    design = np.column_stack([np.ones(len(moved)), moved])
    left = places - design @ np.linalg.lstsq(design, places, rcond=None)[0]
    return float(np.sqrt((left**2).mean()))


_FEWEST_SAMPLES = 4
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


@dataclass(frozen=True)
class _Seen:
    """What a measurement saw in a rest: a mean pose (4 x 4), the deviation of its place (m), or why there is none."""

    pose: Array
    deviation: float = float("nan")
    samples: int = 0
    fault: str = ""


class Rosbag2Reader:
    """The reader ``rosbag2``; ``rows`` and ids number the rests, from 1."""

    Settings: ClassVar[type[BagSettings]] = BagSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"path": "/no/such/folder/recording"}

    def __init__(self, settings: BagSettings) -> None:
        self._settings = settings
        self._digest = hashlib.sha256()

    def read(self, request: ReadRequest) -> Dataset:
        """The means of all rests that were measured, in SI; the other rests are set aside with their reasons.

        Raises:
            DataError: there is no such recording, topic, frame or joint, or no rest that was measured.
            PluginError: rosbags is not there.
        """
        s, bag = self._settings, Bag(self._settings.path)
        unknown = sorted(set(s.measurements) - set(request.measurements))
        have = ", ".join(request.measurements) or "none"
        if not s.measurements and any(c.channel.partition(".")[0] in request.measurements for c in request.channels):
            hint = "Give measurements: {NAME: {topic: TOPIC}}; images are taken out of it with armcal bag images."
            self._refuse(f"found no measurements, expected a topic for one of {have}.", hint)
        if unknown:
            self._refuse(f"found measurements.{unknown[0]}, expected one of {have}.", "Correct the name.")
        self._digest = hashlib.sha256()
        joints = self._joints(bag, request)
        remarks = joints.close(str(s.path))
        rests = joints.rests
        self._refuse_degrees(request, np.abs([rest.means for rest in rests]).max(axis=0) if rests else joints.largest)
        if not rests:
            hint = "Let the arm stand at each pose, or give a wider spread_deg or a shorter window_s under still."
            self._refuse(f"found no rest of at least {s.still.window:g} s in {joints.stamps.topic}.", hint)
        logs = [MeasuredLog(name, own, rests) for name, own in s.measurements.items()]
        self._follow(bag, logs)
        for log in logs:
            remarks += log.close(str(s.path)) + self._clock_remarks(log, joints)
        dataset = self._dataset(request, joints, logs, (*bag.remarks, *remarks))
        return read_as(dataset, request, by_line=False)

    def _joints(self, bag: Bag, request: ReadRequest) -> JointLog:
        """The first time through: joints."""
        s = self._settings
        commanded = {name: arm.commanded for name, arm in request.arms.items()}
        names = channels_of(commanded, s.joints.names)
        alone = f"{next(iter(commanded))}." if len(commanded) == 1 else ""
        strange = [name for name in s.joints.names if name not in names and alone + name not in names]
        if strange:
            have = ", ".join(name.removeprefix(alone) for name in names)
            hint = "Correct the name, or leave out what has its own name in the recording."
            self._refuse(f"found joints.names.{strange[0]}, expected joints of the arm: {have}.", hint)
        if twice := [name for name in names.values() if [*names.values()].count(name) > 1]:
            both = " and ".join(joint.removeprefix(alone) for joint, name in names.items() if name == twice[0])
            self._refuse(f"found {twice[0]} for {both}, expected one joint of the recording each.", "Correct names.")
        slides = [kind == "length" for joints in commanded.values() for kind in joints.values()]
        log = JointLog(tuple(names.values()), slides, s.joints, s.still)
        self._follow(bag, [], log)
        return log

    def _follow(self, bag: Bag, logs: Sequence[MeasuredLog], joints: JointLog | None = None) -> None:
        """Once through the recording; each message goes to those that read its topic."""
        s = self._settings

        def is_read(topic: Topic) -> bool:
            is_joints = joints is not None and topic.type == JOINT_STATE and s.joints.topic in (None, topic.name)
            return is_joints or any(log.reads(topic) for log in logs)

        for topic, received, data, content in bag.messages(is_read):
            self._digest.update(data)
            if joints is not None and topic.type == JOINT_STATE:
                joints.add(topic.name, content, received)
            for log in logs:
                if log.reads(topic):
                    log.add(topic, content, received)
        types = {topic.name: topic.type for topic in bag.topics}
        for log in logs:
            self._require(log, types)

    def _require(self, log: MeasuredLog, types: Mapping[str, str]) -> None:
        """Refuse a topic that is not there, or whose messages (types by topic) measure nothing."""
        topic = log.settings.topic
        if types.get(topic) in log.types:
            return
        have = ", ".join(name for name, own in sorted(types.items()) if own in MEASURED) or "none"
        kind = f"the type {types[topic]}" if topic in types else "no such topic"
        expected = ", ".join(name.rpartition("/")[2] for name in log.types)
        hint = f"Topics that measure are {have}."
        if types.get(topic) == TRANSFORMS:
            hint = "Give reference and frame: the pose of frame in reference is read."
        self._refuse(f"found {kind} for {log.instance} ({topic}), expected {expected}.", hint)

    def _clock_remarks(self, log: MeasuredLog, joints: JointLog) -> list[str]:
        apart = joints.stamps.delay - log.stamps.delay
        if not abs(apart - log.offset) > _CLOCKS_APART_S:
            return []
        text = f"stamps of {log.settings.topic} are about {apart:.3g} s ahead of those of {joints.stamps.topic}"
        return [f"{text}, by the times of receipt. Set clock_offset_s: {apart:.3f} for {log.instance}."]

    def _dataset(
        self, request: ReadRequest, joints: JointLog, logs: Sequence[MeasuredLog], remarks: Sequence[str]
    ) -> Dataset:
        """A record a rest."""
        rests, count = joints.rests, len(joints.rests)
        names = joint_channels(request)
        means = np.array([rest.means for rest in rests]).T
        sides = np.array([joints.approach(rest.end) for rest in rests]).T
        channels = dict(zip(names, means, strict=True))
        channels |= {name.replace(".", ".approach.", 1): own for name, own in zip(names, sides, strict=True)}
        channels["time"] = np.array([(rest.begin + rest.end) / 2 for rest in rests])
        seen = {log.instance: [self._seen(log, i, rest) for i, rest in enumerate(rests)] for log in logs}
        extra = {"rest_s": tuple(f"{rest.end - rest.begin:.3f}" for rest in rests)}
        extra["joint_scatter"] = tuple(f"{rest.scatter.max():.2g}" for rest in rests)
        for name, own in seen.items():
            channels |= self._measured(name, request, own)
            self._refuse_inverted(request, name, channels, own)
            extra[f"{name}_samples"] = tuple(str(one.samples) for one in own)
            extra[f"{name}_scatter_mm"] = tuple(f"{1000 * one.deviation:.4f}" for one in own)
        faulty = {}
        for i, rest in enumerate(rests):
            faults = [f"{name}: {own[i].fault}" for name, own in seen.items() if own[i].fault]
            if rest.end - rest.begin < self._settings.still.window:
                faulty[i] = f"too short: {rest.end - rest.begin:.2f} s, at least {self._settings.still.window:g} s"
            elif faults and len(faults) == len(seen):
                faulty[i] = "; ".join(faults)
        ids, place = tuple(f"rest{i + 1}" for i in range(count)), str(self._settings.path)
        text = f"{count - len(faulty)} of {count} rests are records"
        if faulty:
            listed = "; ".join(f"{ids[i]}: {reason}" for i, reason in list(faulty.items())[:_NAMED])
            text += f"; left out: {listed}" + (f"; and {len(faulty) - _NAMED} more" if len(faulty) > _NAMED else "")
        remarks = [*remarks, *self._moving_remarks(logs, joints, seen)]
        if len(faulty) == count:
            self._refuse(f"{text}.", " ".join(remarks) or "Let the arm stand where it is measured.")
        warnings = tuple(f"{place}: {remark}" for remark in (*remarks, f"{text}."))
        digest = self._digest.hexdigest()
        dataset = Dataset(ids, channels, extra, tuple(range(1, count + 1)), place, digest, warnings=warnings)
        return dataset.without(faulty)

    def _refuse_inverted(
        self, request: ReadRequest, name: str, channels: Mapping[str, Array], seen: Sequence[_Seen]
    ) -> None:
        """Refuse poses whose inverses move as the nominal tools do."""
        own = request.measurements[name].arms[0]
        joints = np.array([channels[f"{own}.{joint}"] for joint in request.arms[own].commanded]).T
        if is_inverted(nominal_tools(request.arms[own], joints), np.array([one.pose for one in seen])):
            settings = self._settings.measurements[name]
            mend = f"Set inverted: {str(not settings.inverted).lower()} for {name}."
            text = f"the poses of {name} are those of its instrument in the body: their inverses move as the arm does"
            self._refuse(f"{text}.", mend if settings.reference is None else "Exchange frame and reference.")

    def _moving_remarks(
        self, logs: Sequence[MeasuredLog], joints: JointLog, seen: Mapping[str, Sequence[_Seen]]
    ) -> list[str]:
        remarks = []
        for log in logs:
            moves = [bool(one.fault) for one in seen[log.instance] if one.samples >= _FEWEST_SAMPLES]
            if 2 * sum(moves) > len(moves):
                apart = joints.stamps.delay - log.stamps.delay
                remark = f"{log.instance} moves in {sum(moves)} of {len(moves)} rests of the joints. It is on another"
                remark += f" arm, or not in m; or its clock is another: by the times of receipt it is {apart:.3f} s"
                remarks.append(f"{remark} ahead, set clock_offset_s: {apart:.3f} for {log.instance}.")
        return remarks

    def _seen(self, log: MeasuredLog, place: int, rest: JointRest) -> _Seen:
        """What a measurement saw in a rest once the arm had settled."""
        s, nothing = self._settings.still, np.full((4, 4), np.nan)
        rows = log.samples(place)
        at = rows[:, 0] - log.offset
        rows = rows[(at >= rest.begin + s.settle) & (at <= rest.end - GUARD_S)]
        if len(rows) < _FEWEST_SAMPLES:
            fault = f"no measurement ({len(rows)} samples, at least {_FEWEST_SAMPLES})"
            return _Seen(nothing, samples=len(rows), fault=fault)
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3, 3] = rows[:, 1:4]
        is_point = bool(np.isnan(rows[0, 4]))
        poses[:, :3, :3] = np.nan if is_point else Rotation.from_quat(rows[:, 4:]).as_matrix()
        stillness = judged(poses, s.drift)
        if stillness.why_not:
            return _Seen(nothing, samples=len(rows), fault=stillness.why_not)
        kept = poses[stillness.kept]
        mean = mean_pose(kept)
        return _Seen(mean, float(np.linalg.norm(deviations_of_mean(kept, mean)[:3])), len(kept))

    def _measured(self, name: str, request: ReadRequest, seen: Sequence[_Seen]) -> dict[str, Array]:
        """The channels of a measurement, NaN where it saw nothing.

        Raises:
            DataError: it reads what no pose has, or orientations of points.
        """
        poses = np.array([one.pose for one in seen])
        values = {axis: poses[:, i, 3] for i, axis in enumerate("xyz")}
        turned = np.isfinite(poses[:, 0, 0])
        quaternions = np.full((len(poses), 4), np.nan)
        if turned.any():
            quaternions[turned] = Rotation.from_matrix(poses[turned, :3, :3]).as_quat()
            quaternions[quaternions[:, 3] < 0] *= -1
        values |= {axis: quaternions[:, i] for i, axis in enumerate(("qx", "qy", "qz", "qw"))}
        needed = [channel.name for channel in request.measurements[name].channels()]
        lacking = [own for own in needed if own not in values]
        if lacking:
            hint = "Take images out with armcal bag images, or give another measurement."
            self._refuse(f"{name} reads {lacking[0]}, which a message of a pose does not hold.", hint)
        if "qw" in needed and not turned.any() and np.isfinite(values["x"]).any():
            topic = self._settings.measurements[name].topic
            self._refuse(f"{name} reads orientations, and {topic} has points.", "Set type: tip_position.")
        return {f"{name}.{own}": values[own] for own in needed}

    def _refuse_degrees(self, request: ReadRequest, positions: Array) -> None:
        """Angles beyond one turn of joints that do not turn on and on."""
        turning = {w.channel for w in request.channels if w.dimension == "angle" and not w.is_endless}
        for name, largest in zip(joint_channels(request), positions, strict=True):
            if name in turning and largest > _FULL_TURN:
                hint = "If these are degrees, set joints: {unit: deg}; if not, record angles within one turn."
                self._refuse(f"{name} stands at {largest:.6g} rad, more than one turn (2 pi rad).", hint)

    def _refuse(self, message: str, hint: str) -> NoReturn:
        refuse(self._settings.path, message, hint)
