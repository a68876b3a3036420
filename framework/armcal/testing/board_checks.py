"""Checks on links to servo boards, devices, simulated benches; no port is opened, for something may be plugged in."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from armcal.devices.clock import Clock, RealClock
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError, JointDevice
from armcal.devices.link import GuardedLink, LinkIdentity
from armcal.errors import InputError
from armcal.testing.results import ContractError, NotRun, Recorder, expect, raises_only
from armcal.testing.settings_checks import Subject

JOINTS = ("q1", "q2")
"""The joints that a device's ``EXAMPLE`` must know."""
_NEAR_RAD = 0.02
"""So near to an angle must a board's pulses come."""
_SAME_RAD = 1e-9
_REGISTERS = 256


def check_bench(record: Recorder, subject: Subject) -> None:
    """That it can be asked to serve; serving takes an experiment and does not end by itself."""
    with record.needed("it builds"):
        bench = subject.build()
    with record.check("it serves"):
        expect(callable(getattr(bench, "serve", None)), "found no method serve")


def check_link(record: Recorder, subject: Subject) -> None:
    """That it is a link, and says so when it is not open."""
    with record.needed("it builds"):
        link = subject.build()
    _check_methods(record, link, ("open", "write", "read"))
    with record.check("it may be closed before it was opened, and twice"):
        link.close()
        link.close()
    with record.check("reading before it is opened is an error of the device"):
        _expect_lost(lambda: link.read(64, 0, 1))
    with record.check("writing before it is opened is one too"):
        _expect_lost(lambda: link.write(64, b"\0\0"))
    if isinstance(link, GuardedLink):
        with record.check("a beat before it is opened is one too"):
            _expect_lost(link.beat)
        with record.check("nobody took over before it was opened"):
            expect(not link.took_over, "found that it was")


def check_device(record: Recorder, subject: Subject) -> None:
    """That it moves the joints that it is given, and passes on what its link says."""
    with record.needed("it builds"):
        device = subject.build(JOINTS, _MemoryLink("nobody is there."))
    methods = [name for name in vars(JointDevice) if not name.startswith("_") and name != "joint_names"]
    _check_methods(record, device, methods)
    with record.check("it moves its joints"):
        expect(tuple(device.joint_names) == JOINTS, f"found {device.joint_names}, expected {JOINTS}")
    with record.check("it may be closed before it was opened, and twice"):
        device.close()
        device.close()
    own_port = "port" in subject.example  # one that is not there is refused
    with record.check("a link without anybody is an error of the device"):
        _expect_lost(lambda: device.open(RealClock()), *((DeviceRefusedError,) if own_port else ()))
    for call in (device.state, device.keep_alive, lambda: device.energise(JOINTS[0], 0.0)):
        with record.check("so is every call before it is opened"):
            _expect_lost(call)
    with record.check("angles that pulses can set stand where they are told"):
        once = device.standing(dict.fromkeys(JOINTS, 0.1))
        again = device.standing(once)
        near = all(abs(again[joint] - once[joint]) < _SAME_RAD for joint in JOINTS)
        expect(near, f"found {again}, expected {once}, since standing() had given these angles")
    for angle in (math.nan, 1e3):
        with record.check(f"an angle of {angle:g} rad is refused"):
            try:
                standing = device.standing({JOINTS[0]: angle})
            except InputError:
                continue
            raise ContractError(f"found {standing}, expected armcal.devices.device.DeviceRefusedError")
    _check_on_a_bus(record, subject)


def _check_methods(record: Recorder, made: Any, names: Sequence[str]) -> None:
    for name in names:
        with record.check(f"it has {name}()"):
            expect(callable(getattr(made, name, None)), f"found no {name}(), see armcal_bench")


def _check_on_a_bus(record: Recorder, subject: Subject) -> None:
    """What it does with a board that keeps what is written to it."""
    link = _MemoryLink()
    with record.needed("it opens on a bus of registers"):
        device = subject.build(JOINTS, link)
        try:
            device.open(RealClock())
        except (DeviceError, InputError) as refusal:
            raise NotRun(f"its board is no bus of registers: {refusal}") from refusal
    with record.check("it sets the angles that it says"):
        for joint, angle in zip(JOINTS, (0.2, -0.3), strict=True):
            device.energise(joint, angle)
        _expect_at(device, dict(zip(JOINTS, (0.2, -0.3), strict=True)), "energise()")
        commands = dict(zip(JOINTS, (-0.4, 0.5), strict=True))
        device.command(commands)
        _expect_at(device, commands, "command()")
    with record.check("its state is read from the board, not remembered"):
        before, there = link.snapshot(), device.state().angles
        device.command(dict.fromkeys(JOINTS, 0.15))
        expect(link.snapshot() != before, "found nothing written to the board by command()")
        link.restore(before)
        angles = device.state().angles
        same = all(abs(angles[joint] - there[joint]) <= _SAME_RAD for joint in JOINTS)
        expect(
            same,
            f"found {angles} after the board was put back, expected {there}: read its pulses, do not remember them",
        )
    with record.check("a joint that is let go has no angle"):
        device.release(JOINTS[0])
        angles = device.state().angles
        expect(JOINTS[0] not in angles, f"found {JOINTS[0]} with an angle after release(), expected it to hang free")
        expect(JOINTS[1] in angles, f"found {JOINTS[1]} without an angle after release() of {JOINTS[0]}")
    link.lost = "the link was cut."
    calls: dict[str, Callable[[], object]] = {
        "state": device.state,
        "command": lambda: device.command({JOINTS[1]: -0.2}),
        "energise": lambda: device.energise(JOINTS[0], 0.1),
        "keep_alive": device.keep_alive,
        "release": lambda: device.release(JOINTS[0]),
    }
    for name, call in calls.items():
        with record.check(f"{name}() passes on that the link was lost"):
            _expect_lost(call)


def _expect_at(device: Any, commands: Mapping[str, float], after: str) -> None:
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


def _expect_lost(call: Callable[[], object], *others: type[Exception]) -> None:
    expected: tuple[type[Exception], ...] = (DeviceError, *others)
    try:
        with raises_only(*expected):
            call()
    except expected:
        return
    raise ContractError("found no error, expected armcal.devices.device.DeviceError")


class _MemoryLink:
    """A bus whose devices are 256 registers each, which keep what is written.

    Attributes:
        lost: why nobody answers; every call raises ``DeviceLostError`` with it unless it is empty.
    """

    def __init__(self, lost: str = "") -> None:
        self.lost = lost
        self._registers: dict[int, bytearray] = {}

    def open(self, clock: Clock) -> LinkIdentity:
        """An adapter without an id."""
        self._answer()
        return LinkIdentity("", "registers of the contract's checks")

    def write(self, address: int, data: bytes) -> None:
        self._answer()
        memory = self._of(address)
        for place, value in enumerate(data[1:], start=data[0]):
            memory[place % _REGISTERS] = value

    def read(self, address: int, register: int, count: int) -> bytes:
        self._answer()
        memory = self._of(address)
        return bytes(memory[(register + i) % _REGISTERS] for i in range(count))

    def close(self) -> None:
        """Nothing: what is kept stays."""

    def snapshot(self) -> Mapping[int, bytes]:
        return {address: bytes(memory) for address, memory in self._registers.items()}

    def restore(self, snapshot: Mapping[int, bytes]) -> None:
        self._registers = {address: bytearray(memory) for address, memory in snapshot.items()}

    def _answer(self) -> None:
        if self.lost:
            raise DeviceLostError(self.lost)

    def _of(self, address: int) -> bytearray:
        return self._registers.setdefault(address, bytearray(_REGISTERS))
