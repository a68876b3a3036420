"""What a bench is measured with, live: joint readings of arms guided by hand, trackers, cameras."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import isfinite, isnan
from typing import Any, Protocol

import numpy as np

from armcal.base.arrays import Array
from armcal.devices.clock import Clock
from armcal.measure.measurement import Measurement
from armcal.plugins import expecting, refuse


@dataclass(frozen=True)
class JointSample:
    """One reading of all joints."""

    arrived: float  # when it came, by the bench's clock (s)
    stamp: float | None  # when it was taken, by the source's own clock (s), where it says so
    angles: Mapping[str, float]  # by channel (``arm.q1``; rad, or m of sliding joints)
    labels: Mapping[str, str] = field(default_factory=dict)  # text that came with it (a socket's name)


class JointStream(Protocol):
    """A live source of joint readings."""

    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        """Begin to listen for these channels.

        Raises:
            DeviceRefusedError: the source is not there or is taken.
            ConfigError: its settings name no such channel, or leave one out.
        """

    def samples(self) -> list[JointSample]:
        """All that came since the last call; it never waits. What cannot be read is counted in ``refused``."""

    @property
    def ended(self) -> bool:
        """Nothing more will come."""

    @property
    def refused(self) -> Mapping[str, int]:
        """How many lines were passed over, by reason."""

    def close(self) -> None:
        """Stop. May be called twice."""


REPEATED = "a repeated frame number"  # in ``Tracker.refused``, for frames that came before


@dataclass(frozen=True)
class TrackerFrame:
    """One moment as a tracker saw it: ``world_T_body`` of bodies; its rotation is NaN where only a place is known."""

    counter: int  # the tracker's frame number; rises by one from frame to frame, more where frames were lost
    arrived: float  # when it came, by the bench's clock (``Clock.now``, s)
    stamp: float | None  # when it was taken, by the tracker's own clock (s), where it says so
    bodies: Mapping[str, Array | None] = field(default_factory=dict)  # 4 x 4 (m) by its own name; None: not seen


class Tracker(Protocol):
    """A live source of frames."""

    def open(self, clock: Clock) -> None:
        """Begin to listen.

        Raises:
            DeviceRefusedError: the port is taken, or the file is not there.
        """

    def frames(self) -> list[TrackerFrame]:
        """All that came since the last call, in the order of arrival; it never waits, and never raises for what came.

        What cannot be read is passed over and counted in ``refused``.
        """

    @property
    def refused(self) -> Mapping[str, int]:
        """How many datagrams or lines were passed over, by reason."""

    def close(self) -> None:
        """Stop. May be called twice."""


@dataclass(frozen=True)
class Shot:
    """One image and what it says."""

    content: bytes  # of the image file that is to be kept
    suffix: str  # of its name, ``.png``
    seen: str  # what it shows, for people; without a full stop
    values: Mapping[str, float] = field(default_factory=dict)  # what was seen, by channel (``camera.u_3``, SI)
    fault: str = ""  # why it says nothing, a sentence; empty if it does


class LiveCamera(Protocol):
    """A live source of images.

    Attributes:
        measurement: the instance whose channels it gives; known once it is open.
        gives_shots: whether images come by themselves, one for each posture; else they are asked for.
    """

    measurement: str
    gives_shots: bool

    def open(self, clock: Clock, measurements: Mapping[str, Measurement]) -> None:
        """Begin.

        Args:
            clock: the bench's.
            measurements: by instance; one of them is this camera's.

        Raises:
            DeviceRefusedError: there is no such camera, or it is taken.
            ConfigError: none of the measurements is a camera's, or several are and none is named.
            PluginError: a library is not there.
        """

    def shots(self) -> list[Shot]:
        """All that came by themselves since the last call; it never waits for one."""

    def shoot(self) -> Shot:
        """An image taken now; one with a fault where the camera gives none."""

    def close(self) -> None:
        """Stop. May be called twice."""


def frames_of(tracker: Tracker) -> list[TrackerFrame]:
    frames = tracker.frames()
    with expecting(tracker.frames, frames, "a list of TrackerFrame(counter, arrived, stamp, bodies)"):
        frames = list(frames)
        for frame in frames:
            _check_moments(tracker.frames, frame.arrived, frame.stamp, frame.counter)
            for name, pose in frame.bodies.items():
                if pose is not None and not (pose.shape == (4, 4) and np.isfinite(pose[:3, 3]).all()):
                    given = f"{name!r} of the shape {pose.shape}: {pose}"
                    refuse(tracker.frames, given, "world_T_body (4 x 4, m), or None of a body that is not seen")
    return frames


def samples_of(stream: JointStream) -> list[JointSample]:
    samples, expected = stream.samples(), "a list of JointSample(arrived, stamp, angles, labels), of numbers and texts"
    with expecting(stream.samples, samples, expected):
        samples = list(samples)
        for sample in samples:
            _check_moments(stream.samples, sample.arrived, sample.stamp)
            _ = [isnan(angle) for angle in sample.angles.values()], "".join(sample.labels.values())
    return samples


def refused_by(source: Tracker | JointStream) -> Mapping[str, int]:
    refused, own = source.refused, getattr(type(source), "refused", None)
    method = own if isinstance(own, property) else type(source)
    with expecting(method, refused, "refused as a mapping from reasons, texts, to counts"):
        _ = sum(refused.values()), "".join(refused.keys())
    return refused


def shots_of(camera: LiveCamera) -> list[Shot]:
    return [_checked(camera.shots, shot) for shot in camera.shots()]


def shot_of(camera: LiveCamera) -> Shot:
    return _checked(camera.shoot, camera.shoot())


def _checked(method: Callable[..., Any], shot: Any) -> Shot:
    with expecting(method, shot, "a Shot of bytes and texts: suffix, seen, fault"):
        _ = memoryview(shot.content), shot.suffix + shot.seen + shot.fault
        if not all(map(isfinite, shot.values.values())):
            refuse(method, f"Shot.values {shot.values}", "finite numbers by channel")
        checked: Shot = shot
    return checked


def _check_moments(method: Callable[..., Any], arrived: float, stamp: float | None, counter: int = 0) -> None:
    if not (isfinite(arrived) and isfinite(counter) and (stamp is None or isfinite(stamp))):
        refuse(method, f"arrived {arrived}, stamp {stamp} and counter {counter}", "finite numbers; stamp may be None")
