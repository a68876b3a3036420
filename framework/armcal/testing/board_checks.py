"""Checks on links to servo boards and on devices; no port is opened, for something may be plugged in there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from armcal.bench.clock import Clock, RealClock
from armcal.bench.device import JointDevice
from armcal.bench.faults import DeviceError, DeviceLostError
from armcal.bench.link import GuardedLink, LinkIdentity
from armcal.testing.results import ContractError, Recorder, expect
from armcal.testing.settings_checks import Subject

JOINTS = ("q1", "q2")
"""The joints that a device's ``EXAMPLE`` must know."""


class _NoLink:
    """A link with nobody at the other end."""

    def open(self, clock: Clock) -> LinkIdentity:
        raise DeviceLostError("nobody is there.")

    def write(self, address: int, data: bytes) -> None:
        raise DeviceLostError("nobody is there.")

    def read(self, address: int, register: int, count: int) -> bytes:
        raise DeviceLostError("nobody is there.")

    def close(self) -> None:
        pass


def check_link(record: Recorder, subject: Subject) -> None:
    """That it is a link, and says so when it is not open."""
    link: Any = record.check("it builds", lambda: subject.made(subject.settings))
    if link is None:
        return
    for name in ("open", "write", "read"):
        record.check(f"it has {name}()", lambda n=name: _callable(link, n))  # type: ignore[misc]
    record.check("it may be closed before it was opened, and twice", lambda: (link.close(), link.close()))
    record.check("reading before it is opened is an error of the device", lambda: _lost(lambda: link.read(64, 0, 1)))
    record.check("writing before it is opened is one too", lambda: _lost(lambda: link.write(64, b"\0\0")))
    if isinstance(link, GuardedLink):
        record.check("a beat before it is opened is one too", lambda: _lost(link.beat))
        record.check("nobody took over before it was opened", lambda: expect(not link.took_over, "found that it was"))


def check_device(record: Recorder, subject: Subject) -> None:
    """That it moves the joints that it is given, and passes on what its link says."""
    device: Any = record.check("it builds", lambda: subject.made(subject.settings, JOINTS, _NoLink()))
    if device is None:
        return
    for name in [name for name in vars(JointDevice) if not name.startswith("_") and name != "joint_names"]:
        record.check(f"it has {name}()", lambda n=name: _callable(device, n))  # type: ignore[misc]
    names = device.joint_names
    record.check("it moves its joints", lambda: expect(tuple(names) == JOINTS, f"found {names}, expected {JOINTS}"))
    record.check("it may be closed before it was opened, and twice", lambda: (device.close(), device.close()))
    record.check("a link without anybody is an error of the device", lambda: _lost(lambda: device.open(RealClock())))
    for call in (device.state, device.keep_alive, lambda: device.energise(JOINTS[0], 0.0)):
        record.check("so is every call before it is opened", lambda c=call: _lost(c))  # type: ignore[misc]
    record.check("angles that pulses can set stand where they are told", lambda: _stands(device))


def _callable(made: Any, name: str) -> None:
    expect(callable(getattr(made, name, None)), f"found no {name}(), see armcal.bench")


def _lost(call: Callable[[], Any]) -> None:
    try:
        call()
    except DeviceError:
        return
    except Exception as fault:
        raise ContractError(
            f"found {type(fault).__name__} ({fault}), expected armcal.bench.faults.DeviceError"
        ) from fault
    expect(False, "found no error, expected armcal.bench.faults.DeviceError")


def _stands(device: Any) -> None:
    once = device.standing(dict.fromkeys(JOINTS, 0.1))
    again = device.standing(once)
    near = all(abs(again[joint] - once[joint]) < 1e-9 for joint in JOINTS)
    expect(near, f"found {again}, expected {once}, since standing() had given these angles")
