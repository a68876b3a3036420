"""What a bench is measured with, live: joint readings of arms guided by hand, trackers, cameras."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import isfinite, isnan
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from pydantic import Field
from typing_extensions import override

from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.devices.clock import Clock, RealClock
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError, DeviceState, MeasuringDevice
from armcal.errors import ConfigError
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


_AGAIN_S = 0.5


class GuidedSettings(Settings):
    """How often the joints are read.

    ``torque`` is what becomes of servos that hold: they are a reason to refuse, or are let go one by one, so that a
    loaded arm drops.
    """

    rate_hz: Annotated[float, Field(gt=0, le=500)] = 50.0
    torque: Literal["refuse", "release"] = "refuse"


class GuidedDevice(MeasuringDevice, Protocol):
    """What ``GuidedJoints`` needs of a device; its methods are those of ``JointDevice``."""

    def open(self, clock: Clock) -> object: ...

    def state(self) -> DeviceState: ...

    def release(self, joint: str) -> None: ...

    def close(self) -> None: ...


class GuidedJoints(JointStream):
    """The joint stream of a device that knows where its joints stand; a base class for plugins of such devices.

    The arm is guided by hand: servos that hold are refused or let go, and all joints are read at a rate. What does not
    answer is counted, and asked again half a second later.
    """

    def __init__(self, settings: GuidedSettings, device_of: Callable[[tuple[str, ...]], GuidedDevice]) -> None:
        """``device_of`` makes the device whose joints are some channels; it raises ValueError if there is none."""
        self._settings, self._device_of = settings, device_of
        self._refused: Counter[str] = Counter()
        self._clock: Clock = RealClock()
        self._next = 0.0
        self._device: GuidedDevice | None = None

    def reopen(self, device: GuidedDevice) -> None:
        """After a reading that failed; a device whose ``open`` takes long is opened by a quicker way here."""
        device.open(self._clock)

    @override
    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        self.close()
        try:
            device = self._device_of(channels)
        except ValueError as fault:
            raise ConfigError(f"bench.joints: {fault}.", hint="Give each joint its servo.") from fault
        self._device, self._clock, self._next = device, clock, clock.now()
        try:
            device.open(clock)
            holding = list(device.state().angles)
            if holding and self._settings.torque == "refuse":
                text = f"{', '.join(holding)} hold, expected servos without torque, which can be guided by hand."
                hint = "Hold the arm, and give bench.joints: {torque: release}, which lets them go."
                raise DeviceRefusedError(text, hint=hint)
            for joint in reversed(holding):
                device.release(joint)
        except DeviceLostError as fault:
            self.close()
            raise DeviceRefusedError(fault.message, where=fault.where, hint=fault.hint) from fault
        except BaseException:
            self.close()
            raise

    @override
    def samples(self) -> list[JointSample]:
        if self._device is None or (now := self._clock.now()) < self._next:
            return []
        self._next = now + 1 / self._settings.rate_hz
        try:
            return [JointSample(now, None, self._device.measured())]
        except DeviceError as fault:
            self._refused[fault.message] += 1
            self._next = now + _AGAIN_S
        try:
            self.reopen(self._device)
        except (DeviceError, DeviceRefusedError) as again:
            self._refused[again.message] += 1
        return []

    @property
    @override
    def ended(self) -> bool:
        return self._device is None

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        return dict(self._refused)

    @override
    def close(self) -> None:
        if self._device is not None:
            self._device.close()
        self._device = None


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
