"""What moves the joints of a bench, and what goes wrong with it."""

from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Protocol, runtime_checkable

from armcal.devices.clock import Clock
from armcal.errors import ArmcalError, InputError, Location
from armcal.plugins import expecting, refuse


class DeviceError(ArmcalError):
    """A device does not answer as it must; what it was told last may or may not have arrived."""


class DeviceLostError(DeviceError):
    """A device is gone: unplugged, or silent for longer than its link waits. It may come back."""


class DeviceResetError(DeviceError):
    """A device has started anew since it was opened: what it was told before is forgotten."""


class DeviceUnwellError(DeviceError):
    """A device works, and must not go on for long: a servo is too hot, or blocked. Raised once; it can be parked."""


class DeviceRefusedError(InputError):
    """A device is not the one that was calibrated, is used by another program, or cannot do what is asked."""


@dataclass(frozen=True)
class DeviceIdentity:
    """Which device a dataset was measured with."""

    name: str  # for people, one line
    digest: str  # of all that a calibration hangs on (board identity, oscillator, prescale, pulse tables), hex
    boots: int | None = None  # how often it has started, where it counts that
    adapter: str = ""  # what tells its adapter from all others, as ``LinkIdentity`` has it; empty if nothing does


@dataclass(frozen=True)
class DeviceState:
    """What a device is doing, read from it and not remembered."""

    angles: Mapping[str, float]  # of joints that get pulses: what the pulse asks for (rad); the others hang free
    took_over: bool = False  # it has driven by itself, since its host was silent


class JointDevice(Protocol):
    """Servos by joint name. Angles are commanded ones (rad), as in ``joint_angles`` of a dataset.

    Calls may raise ``DeviceError``, ``DeviceLostError`` or ``DeviceResetError``. After a loss or reset, ``open`` is
    called again; it moves nothing.
    """

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Those it moves."""

    def open(self, clock: Clock) -> DeviceIdentity:
        """Open, identify and prepare it. Pulses that run go on unchanged, and none begins.

        Raises:
            DeviceRefusedError: it is not the calibrated one, or its set-up does not read back.
        """

    def state(self) -> DeviceState:
        """Which joints get which pulses."""

    def standing(self, angles: Mapping[str, float]) -> dict[str, float]:
        """The angles that its pulses can set nearest to these (rad). Asks nothing of the device.

        Raises:
            DeviceRefusedError: an angle is outside a joint's pulse table.
        """

    def energise(self, joint: str, angle: float) -> None:
        """Begin a joint's pulses. A servo tells nobody where it stands, so it may jump: one joint at a time."""

    def command(self, angles: Mapping[str, float]) -> None:
        """Move joints that are energised, all at once, to absolute angles. Verified as far as the link allows.

        Raises:
            DeviceRefusedError: an angle is outside a joint's pulse table, or a joint is not energised.
        """

    def keep_alive(self) -> None:
        """Say that the host lives; to be called at least every 0.2 s.

        Raises:
            DeviceLostError: it has begun to drive by itself; ``open`` takes over again.
        """

    def guard(self, waypoints: Sequence[Mapping[str, float]], rate: float, after_s: float) -> bool:
        """Where to go after a silence of the host: through waypoints, no joint faster than ``rate`` (rad/s).

        False: this device cannot, and its pulses go on as they are.
        """

    def release(self, joint: str) -> None:
        """End a joint's pulses; a loaded joint drops."""

    def close(self) -> None:
        """Let go of it; pulses go on as they are. May be called twice."""


class PulseDevice(Protocol):
    """A device whose pulses can be set in seconds, before anybody knows which angles they make."""

    def set_pulse(self, joint: str, pulse: float) -> float:
        """Set a joint's pulse (s), beginning it if need be; gives the one that was set, by the stated oscillator."""

    def release(self, joint: str) -> None:
        """End a joint's pulses."""


@runtime_checkable
class MeasuringDevice(Protocol):
    """A device whose servos know where they stand, with pulses and without."""

    def measured(self) -> dict[str, float]:
        """Where all joints stand by their own encoders (rad)."""


def open_device(device: JointDevice, clock: Clock) -> DeviceIdentity:
    identity = device.open(clock)
    with expecting(device.open, identity, "a DeviceIdentity of texts"):
        _ = identity.name + identity.digest + identity.adapter
    return identity


def state_of(device: JointDevice) -> DeviceState:
    state = device.state()
    with expecting(device.state, state, "a DeviceState"):
        _check_angles(device.state, state.angles, device.joint_names)
    return state


def standing_at(device: JointDevice, angles: Mapping[str, float]) -> dict[str, float]:
    standing = device.standing(angles)
    _check_angles(device.standing, standing, angles, whole=True)
    return standing


def measured_angles(device: JointDevice) -> dict[str, float]:
    """Where the joints stand (rad), by servos that know; empty for others."""
    if not isinstance(device, MeasuringDevice):
        return {}
    measured = device.measured()
    _check_angles(device.measured, measured, device.joint_names, whole=True)
    return measured


def require_energised(joints: Iterable[str], energised: Container[str], where: Location | None = None) -> None:
    """Raise DeviceRefusedError if joints are to move that hang free: to be called by ``command`` of a device."""
    if limp := [joint for joint in joints if joint not in energised]:
        text = f"found commands for {', '.join(limp)}, which hang free."
        raise DeviceRefusedError(text, where=where, hint="Energise them first, one at a time.")


def _check_angles(method: Callable[..., Any], angles: Any, joints: Collection[str], *, whole: bool = False) -> None:
    expected = f"finite angles (rad) of {'all' if whole else 'some'} of {', '.join(joints)}"
    with expecting(method, angles, expected):
        others = angles.keys() ^ set(joints) if whole else angles.keys() - set(joints)
        if others or not all(map(isfinite, angles.values())):
            refuse(method, f"{angles}", expected)
