"""Checks on links to servo boards, devices, simulated benches; no port is opened, for something may be plugged in."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from armcal.devices.clock import RealClock
from armcal.devices.device import JointDevice
from armcal.devices.faults import DeviceError
from armcal.devices.link import GuardedLink
from armcal.errors import InputError
from armcal.testing.memory_link import MemoryLink, NoLink
from armcal.testing.results import ContractError, NotRun, Recorder, expect
from armcal.testing.settings_checks import Subject

JOINTS = ("q1", "q2")
"""The joints that a device's ``EXAMPLE`` must know."""
_NEAR_RAD = 0.02
"""So near to an angle must a board's pulses come."""
_SAME_RAD = 1e-9


def check_link(record: Recorder, subject: Subject) -> None:
    """That it is a link, and says so when it is not open."""
    link: Any = record.check("it builds", subject.build)
    if link is None:
        return
    for name in ("open", "write", "read"):
        record.check(f"it has {name}()", _callable, link, name)
    record.check("it may be closed before it was opened, and twice", lambda: (link.close(), link.close()))
    record.check("reading before it is opened is an error of the device", _lost, lambda: link.read(64, 0, 1))
    record.check("writing before it is opened is one too", _lost, lambda: link.write(64, b"\0\0"))
    if isinstance(link, GuardedLink):
        record.check("a beat before it is opened is one too", _lost, link.beat)
        record.check("nobody took over before it was opened", lambda: expect(not link.took_over, "found that it was"))


def check_device(record: Recorder, subject: Subject) -> None:
    """That it moves the joints that it is given, and passes on what its link says."""
    device: Any = record.check("it builds", subject.build, JOINTS, NoLink())
    if device is None:
        return
    for name in [name for name in vars(JointDevice) if not name.startswith("_") and name != "joint_names"]:
        record.check(f"it has {name}()", _callable, device, name)
    names = device.joint_names
    record.check("it moves its joints", lambda: expect(tuple(names) == JOINTS, f"found {names}, expected {JOINTS}"))
    record.check("it may be closed before it was opened, and twice", lambda: (device.close(), device.close()))
    record.check("a link without anybody is an error of the device", _lost, lambda: device.open(RealClock()))
    for call in (device.state, device.keep_alive, lambda: device.energise(JOINTS[0], 0.0)):
        record.check("so is every call before it is opened", _lost, call)
    record.check("angles that pulses can set stand where they are told", _stands, device)
    for angle in (math.nan, 1e3):
        record.check(f"an angle of {angle:g} rad is refused", _refused, device, angle)
    _check_on_a_bus(record, subject)


def check_bench(record: Recorder, subject: Subject) -> None:
    """That it can be asked to serve; serving takes an experiment and does not end by itself."""
    bench: Any = record.check("it builds", subject.build)
    if bench is not None:
        record.check("it serves", lambda: expect(callable(getattr(bench, "serve", None)), "found no method serve"))


def _check_on_a_bus(record: Recorder, subject: Subject) -> None:
    """What it does with a board that keeps what is written to it."""
    link = MemoryLink()
    device = record.check("it opens on a bus of registers", _opened, subject, link)
    record.check("it sets the angles that it says", _sets, device)
    record.check("its state is read from the board, not remembered", _reads, device, link)
    record.check("a joint that is let go has no angle", _lets_go, device)
    link.is_lost = True
    calls: dict[str, Callable[[Any], Any]] = {
        "state": lambda opened: opened.state(),
        "command": lambda opened: opened.command({JOINTS[1]: -0.2}),
        "energise": lambda opened: opened.energise(JOINTS[0], 0.1),
        "keep_alive": lambda opened: opened.keep_alive(),
        "release": lambda opened: opened.release(JOINTS[0]),
    }
    for name, call in calls.items():
        record.check(f"{name}() passes on that the link was lost", _passes_on_loss, device, call)


def _opened(subject: Subject, link: MemoryLink) -> Any:
    device = subject.made(subject.settings, JOINTS, link)
    try:
        device.open(RealClock())
    except (DeviceError, InputError) as refusal:
        raise NotRun(f"its board is no bus of registers: {refusal}") from refusal
    return device


def _require_open(device: Any) -> None:
    if device is None:
        raise NotRun("it did not open")


def _sets(device: Any) -> None:
    _require_open(device)
    for joint, angle in zip(JOINTS, (0.2, -0.3), strict=True):
        device.energise(joint, angle)
    _at(device, dict(zip(JOINTS, (0.2, -0.3), strict=True)), "energise()")
    commands = dict(zip(JOINTS, (-0.4, 0.5), strict=True))
    device.command(commands)
    _at(device, commands, "command()")


def _at(device: Any, commands: Mapping[str, float], after: str) -> None:
    angles, standing = device.state().angles, device.standing(commands)
    for joint, angle in commands.items():
        expect(joint in angles, f"found no angle of {joint} after {after}, expected {angle:g} rad")
        for what, value in (("state()", angles[joint]), ("standing()", standing[joint])):
            off = abs(value - angle)
            expect(off <= _NEAR_RAD, f"found {value:.4f} rad of {joint} in {what} after {after}, expected {angle:g}")
        off = abs(angles[joint] - standing[joint])
        expect(
            off <= _SAME_RAD, f"found {joint} at {angles[joint]:.6f} rad after {after}, expected {standing[joint]:.6f}"
        )


def _reads(device: Any, link: MemoryLink) -> None:
    _require_open(device)
    before, there = link.snapshot(), device.state().angles
    device.command(dict.fromkeys(JOINTS, 0.15))
    expect(link.snapshot() != before, "found nothing written to the board by command()")
    link.restore(before)
    angles = device.state().angles
    same = all(abs(angles[joint] - there[joint]) <= _SAME_RAD for joint in JOINTS)
    expect(
        same, f"found {angles} after the board was put back, expected {there}: read its pulses, do not remember them"
    )


def _lets_go(device: Any) -> None:
    _require_open(device)
    device.release(JOINTS[0])
    angles = device.state().angles
    expect(JOINTS[0] not in angles, f"found {JOINTS[0]} with an angle after release(), expected it to hang free")
    expect(JOINTS[1] in angles, f"found {JOINTS[1]} without an angle after release() of {JOINTS[0]}")


def _refused(device: Any, angle: float) -> None:
    try:
        standing = device.standing({JOINTS[0]: angle})
    except InputError:
        return
    raise ContractError(f"found {standing}, expected armcal.devices.faults.DeviceRefusedError")


def _callable(made: Any, name: str) -> None:
    expect(callable(getattr(made, name, None)), f"found no {name}(), see armcal_bench")


def _lost(call: Callable[[], Any]) -> None:
    try:
        call()
    except DeviceError:
        return
    except Exception as fault:
        raise ContractError(
            f"found {type(fault).__name__} ({fault}), expected armcal.devices.faults.DeviceError"
        ) from fault
    expect(False, "found no error, expected armcal.devices.faults.DeviceError")


def _passes_on_loss(device: Any, call: Callable[[Any], Any]) -> None:
    _require_open(device)
    _lost(lambda: call(device))


def _stands(device: Any) -> None:
    once = device.standing(dict.fromkeys(JOINTS, 0.1))
    again = device.standing(once)
    near = all(abs(again[joint] - once[joint]) < 1e-9 for joint in JOINTS)
    expect(near, f"found {again}, expected {once}, since standing() had given these angles")
