"""What the methods of a bench's parts return, checked where it is used: a plugin's may return anything.

Each function calls a method, and raises `PluginError` with its file, line and name, what it returned and what was
expected. What the method itself raises passes.
"""

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import Any, Literal, NoReturn

import numpy as np

from armcal.devices.clock import Clock
from armcal.devices.device import DeviceIdentity, DeviceState, JointDevice, MeasuringDevice
from armcal.devices.link import Link, LinkIdentity
from armcal.devices.live import JointSample, JointStream, LiveCamera, RestStream, Shot, Tracker, TrackerFrame
from armcal.measure.measurement import Measurement
from armcal.plugin_faults import refuse

Method = Callable[..., Any]
_UNSEEN = "or None of a body that is not seen"


def open_device(device: JointDevice, clock: Clock) -> DeviceIdentity:
    """The device, opened; see ``JointDevice.open`` for what it raises."""
    identity = device.open(clock)
    if not isinstance(identity, DeviceIdentity):
        refuse(device.open, identity, "a DeviceIdentity")
    texts = (identity.name, identity.digest, identity.adapter)
    if not _is_all(str, texts) or not isinstance(identity.boots, int | None):
        refuse(device.open, f"{identity}", "a DeviceIdentity of texts, and of boots that are a whole number or None")
    return identity


def open_link(link: Link, clock: Clock) -> LinkIdentity:
    """The link, opened; see ``Link.open`` for what it raises."""
    identity = link.open(clock)
    if not isinstance(identity, LinkIdentity):
        refuse(link.open, identity, "a LinkIdentity")
    return identity


def bytes_from(link: Link, address: int, register: int, count: int) -> bytes:
    """So many bytes of a device on a link, from a register on; see ``Link.read`` for what it raises."""
    data = link.read(address, register, count)
    if not isinstance(data, bytes) or len(data) != count:
        given = f"{len(data)} bytes" if isinstance(data, bytes) else data
        refuse(link.read, given, f"bytes, {count} of them")
    return data


def state_of(device: JointDevice) -> DeviceState:
    state = device.state()
    if not isinstance(state, DeviceState):
        refuse(device.state, state, "a DeviceState")
    _check_numbers(device.state, state.angles, "DeviceState.angles")
    if not set(state.angles) <= set(device.joint_names):
        refuse(device.state, f"angles of {', '.join(state.angles)}", f"joints of {', '.join(device.joint_names)}")
    return state


def standing_at(device: JointDevice, angles: Mapping[str, float]) -> dict[str, float]:
    """The angles that pulses can set nearest to these (rad)."""
    standing = device.standing(angles)
    _check_numbers(device.standing, standing, "angles (rad)")
    if set(standing) != set(angles):
        refuse(device.standing, f"angles of {', '.join(standing) or 'no joint'}", f"those of {', '.join(angles)}")
    return standing


def measured_angles(device: JointDevice) -> dict[str, float]:
    """Where the joints stand (rad), by servos that know; empty for others."""
    if not isinstance(device, MeasuringDevice):
        return {}
    measured = device.measured()
    _check_numbers(device.measured, measured, "angles (rad)")
    if set(measured) != set(device.joint_names):
        given = f"angles of {', '.join(measured) or 'no joint'}"
        refuse(device.measured, given, f"those of {', '.join(device.joint_names)}")
    return measured


def frames_of(tracker: Tracker) -> Sequence[TrackerFrame]:
    """All frames that came since the last call."""
    frames = tracker.frames()
    _check_list(tracker.frames, frames, TrackerFrame)
    for frame in frames:
        _check_moment(tracker.frames, frame.arrived, frame.stamp)
        if not isinstance(frame.counter, int) or not isinstance(frame.bodies, Mapping):
            given = f"the counter {frame.counter!r:.40} and bodies of type {type(frame.bodies).__name__}"
            refuse(tracker.frames, given, "a whole number, and a mapping of names to world_T_body")
        for name, pose in frame.bodies.items():
            if pose is None:
                continue
            if not isinstance(pose, np.ndarray) or pose.shape != (4, 4) or pose.dtype != np.float64:
                given = f"{name!r} as {type(pose).__name__} of the shape {np.shape(pose)}"
                refuse(tracker.frames, given, f"world_T_body (4 x 4 numbers of numpy, m), {_UNSEEN}")
            if not np.isfinite(pose[:3, 3]).all():
                refuse(tracker.frames, f"{name!r} at {pose[:3, 3]}", f"a position (m), {_UNSEEN}")
    return frames


def samples_of(stream: JointStream, which: Literal["samples", "lasting"] = "samples") -> Sequence[JointSample]:
    """All joint readings that came since the last call; or the rest that lasts, of a stream that gives rests."""
    method = stream.lasting if which == "lasting" and isinstance(stream, RestStream) else stream.samples
    samples = method()
    _check_list(method, samples, JointSample)
    for sample in samples:
        _check_moment(method, sample.arrived, sample.stamp)
        if not isinstance(sample.angles, Mapping) or not _is_all(int | float, sample.angles.values()):
            refuse(method, f"the angles {sample.angles!r:.60}", "a mapping of channels to numbers (rad or m)")
        if not isinstance(sample.labels, Mapping) or not _is_all(str, sample.labels.values()):
            refuse(method, f"the labels {sample.labels!r:.60}", "a mapping of names to texts")
    return samples


def shots_of(camera: LiveCamera) -> Sequence[Shot]:
    """All images that came by themselves since the last call."""
    shots = camera.shots()
    _check_list(camera.shots, shots, Shot)
    for shot in shots:
        _check_shot(camera.shots, shot)
    return shots


def shot_of(camera: LiveCamera) -> Shot:
    shot = camera.shoot()
    _check_shot(camera.shoot, shot)
    return shot


def refused_by(part: Tracker | JointStream) -> Mapping[str, int]:
    refused = part.refused
    if not isinstance(refused, Mapping) or not _is_all(int, refused.values()):
        _refuse_attribute(part, "refused", "a mapping of reasons to counts")
    return refused


def check_joint_names(device: JointDevice, joints: tuple[str, ...]) -> None:
    if device.joint_names != joints:
        _refuse_attribute(device, "joint_names", f"{joints}, as it was given them")


def check_seen(camera: LiveCamera, measurements: Mapping[str, Measurement]) -> None:
    if camera.measurement not in measurements:
        _refuse_attribute(camera, "measurement", f"one of {', '.join(measurements)}")


def _refuse_attribute(part: Any, name: str, expected: str) -> NoReturn:
    declared = getattr(type(part), name, None)
    given = f"{getattr(part, name)!r:.60} as {name}"
    refuse(declared if isinstance(declared, property) else type(part), given, expected)


def _check_shot(method: Method, shot: Any) -> None:
    if not isinstance(shot, Shot):
        refuse(method, shot, "a Shot")
    if not isinstance(shot.content, bytes) or not _is_all(str, (shot.suffix, shot.seen, shot.fault)):
        texts = f"{shot.suffix!r:.20}, {shot.seen!r:.40} and {shot.fault!r:.40}"
        refuse(method, f"a {type(shot.content).__name__}, {texts}", "a Shot of bytes and texts: suffix, seen, fault")
    _check_numbers(method, shot.values, "Shot.values")


def _check_list(method: Method, items: Any, kind: type) -> None:
    if not isinstance(items, Sequence) or not _is_all(kind, items):
        given = next((item for item in items if not isinstance(item, kind)), None) if isinstance(items, list) else items
        refuse(method, given, f"a list of {kind.__name__}")


def _check_moment(method: Method, arrived: Any, stamp: Any) -> None:
    for name, moment in (("arrived", arrived), ("stamp", stamp)):
        if not _is_number(moment) and (moment is not None or name == "arrived"):
            refuse(method, f"{name} {moment!r:.40}", "seconds" if name == "arrived" else "seconds, or None")


def _check_numbers(method: Method, values: Any, name: str) -> None:
    if not isinstance(values, Mapping) or not all(map(_is_number, values.values())):
        refuse(method, f"{name} {values!r:.80}", "a mapping of names to numbers")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and isfinite(value)


def _is_all(kind: Any, values: Any) -> bool:
    return all(isinstance(value, kind) for value in values)
