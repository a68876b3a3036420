"""Checks on devices, trackers, joint streams and cameras.

No port is opened, for something may be plugged in. Live sources never wait; damaged bytes are counted, never raised.
"""

import math
import socket
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from contextlib import closing, suppress
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

from armcal.devices.clock import Clock, RealClock
from armcal.devices.device import DeviceError, DeviceLostError, open_device, standing_at, state_of
from armcal.devices.link import LinkIdentity
from armcal.devices.live import frames_of, refused_by, samples_of, shots_of
from armcal.errors import InputError
from armcal.testing.checking import ContractError, NotRun, Subject, check, expect

T = TypeVar("T")
JOINTS = ("q1", "q2")  # that a device's ``EXAMPLE`` must know
CHANNELS = ("arm.q1", "arm.q2")  # of a joint stream
_NEAR_RAD, _SAME_RAD = 0.02, 1e-9  # so near to an angle must a board's pulses come; so near are equal angles
_REGISTERS = 256
_PATIENCE_S = 5.0  # whoever takes longer than this to say what has come is waiting
_DAMAGED = (
    b"\xff\xfe\xfd broken\n",
    b"[" * 20_000 + b"\n",
    b'{"frame": 1e999, "time_s": NaN, "bodies": {"0": [1]}}\n',
    b"fr 1\r\n6d 1 [0 1.0][nan nan\r\n",
    b"1,2,3\n1,2\n,,\n",
    bytes(np.random.default_rng(9).integers(0, 256, 3000, dtype=np.uint8)) + b"\n",
)


# --- devices --------------------------------------------------------------------------------------------------------


@check("device")
def an_angle_that_pulses_cannot_set_is_refused(s: Subject) -> None:
    device = s.build(JOINTS, _MemoryLink())
    for angle in (math.nan, 1e3):
        with suppress(InputError):
            standing = device.standing({JOINTS[0]: angle})
            refused = "expected that it is refused by armcal.devices.device.DeviceRefusedError"
            raise ContractError(f"found {standing} for {angle:g} rad, {refused}")


@check("device", needed=True)
def on_a_bus_of_registers_it_sets_the_angles_that_it_says(s: Subject) -> None:
    s.link = _MemoryLink()
    device = s.device = s.build(JOINTS, s.link)
    try:
        open_device(device, RealClock())
    except (DeviceError, InputError) as refusal:
        raise NotRun(f"its board is no bus of registers: {refusal}") from refusal
    for joint, angle in zip(JOINTS, (0.2, -0.3), strict=True):
        device.energise(joint, angle)
    _expect_at(device, dict(zip(JOINTS, (0.2, -0.3), strict=True)), "energise()")
    device.command(dict(zip(JOINTS, (-0.4, 0.5), strict=True)))
    _expect_at(device, dict(zip(JOINTS, (-0.4, 0.5), strict=True)), "command()")


@check("device")
def its_state_is_read_from_the_board_and_a_released_joint_has_no_angle(s: Subject) -> None:
    before, there = deepcopy(s.link.registers), state_of(s.device).angles
    s.device.command(dict.fromkeys(JOINTS, 0.15))
    expect(s.link.registers != before, "found nothing written to the board by command()")
    s.link.registers = before
    angles = state_of(s.device).angles
    same = all(abs(angles[joint] - there[joint]) <= _SAME_RAD for joint in JOINTS)
    advice = "it is read from the board: read its pulses, do not remember them"
    expect(same, f"found {angles} after the board was put back, expected {there}; {advice}")
    s.device.release(JOINTS[0])
    left = set(state_of(s.device).angles)
    rule = "what is let go has no angle"
    expect(left == {JOINTS[1]}, f"found angles of {', '.join(sorted(left))} after release() of {JOINTS[0]}: {rule}")


@check("device")
def it_passes_on_that_the_link_was_lost(s: Subject) -> None:
    s.link.lost = "the link was cut."
    at = {JOINTS[1]: -0.2}
    calls = {"state": (), "command": (at,), "energise": (JOINTS[0], 0.1), "keep_alive": (), "release": (JOINTS[0],)}
    for name, given in calls.items():
        with suppress(DeviceError):
            getattr(s.device, name)(*given)
            raise ContractError(
                f"found no error at {name}() of a lost link, expected armcal.devices.device.DeviceError"
            )


def _expect_at(device: Any, commands: Mapping[str, float], after: str) -> None:
    angles, standing = state_of(device).angles, standing_at(device, commands)
    for joint, angle in commands.items():
        expect(joint in angles, f"found no angle of {joint} after {after}, expected {angle:g} rad")
        near = abs(standing[joint] - angle) <= _NEAR_RAD
        expect(near, f"found {standing[joint]:.4f} rad of {joint} in standing(), expected about {angle:g}")
        same = abs(angles[joint] - standing[joint]) <= _SAME_RAD
        expect(same, f"found {joint} at {angles[joint]:.6f} rad after {after}, expected {standing[joint]:.6f}")


class _MemoryLink:
    """A bus whose devices are 256 registers each, which keep what is written; ``lost`` says why nobody answers."""

    def __init__(self, lost: str = "") -> None:
        self.lost = lost
        self.registers: dict[int, bytearray] = {}

    def open(self, clock: Clock) -> LinkIdentity:
        self._of(0)
        return LinkIdentity("", "registers of the contract's checks")

    def write(self, address: int, data: bytes) -> None:
        for place, value in enumerate(data[1:], start=data[0]):
            self._of(address)[place % _REGISTERS] = value

    def read(self, address: int, register: int, count: int) -> bytes:
        return bytes(self._of(address)[(register + i) % _REGISTERS] for i in range(count))

    def close(self) -> None:
        pass

    def _of(self, address: int) -> bytearray:
        if self.lost:
            raise DeviceLostError(self.lost)
        return self.registers.setdefault(address, bytearray(_REGISTERS))


# --- live sources ---------------------------------------------------------------------------------------------------

# What has come of each kind of source, and what it is opened with beside the clock.
_TAKEN: Mapping[str, Callable[[Any], list[Any]]] = {"tracker": frames_of, "joints": samples_of, "camera": shots_of}
_OPENED: Mapping[str, tuple[Any, ...]] = {"tracker": (), "joints": (CHANNELS,), "camera": ({},)}


@check("tracker", "joints", "camera", needed=True)
def it_opens_or_refuses_by_an_armcal_error_never_waits_and_may_be_closed_twice(s: Subject) -> None:
    s.built.close()
    with suppress(InputError):
        _within(lambda: s.built.open(RealClock(), *_OPENED[s.kind]))
    _within(lambda: _TAKEN[s.kind](s.built))
    s.built.close()
    s.built.close()
    late = _within(lambda: _TAKEN[s.kind](s.built))
    expect(late == [], "found something that came after close(), expected nothing")


@check("tracker", "joints")
def damaged_bytes_are_passed_over_and_counted(s: Subject) -> None:
    """By UDP or in a file: each is passed over, and some of them are counted."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "live")
        path.touch()
        source = s.with_settings(**_settings_to_feed(s, path))
        try:
            source.open(RealClock(), *_OPENED[s.kind])
        except InputError as refusal:
            raise NotRun(f"it does not open: {refusal}") from refusal
        with closing(source), path.open("ab", 0) as file, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            address = getattr(source, "address", None)
            for data in _DAMAGED:
                if address is None:
                    file.write(data)
                else:
                    sender.sendto(data, tuple(address))
                _within(lambda: _TAKEN[s.kind](source))
            counted = sum(refused_by(source).values())
    expect(counted > 0, "found nothing in refused after damaged bytes, expected each to be counted by its reason")


def _within(call: Callable[[], T]) -> T:
    """What a call gives, if it does not wait."""
    future = Future[T]()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as fault:
            future.set_exception(fault)

    threading.Thread(target=run, daemon=True).start()
    wait([future], _PATIENCE_S)
    expect(future.done(), f"found it still waiting after {_PATIENCE_S:g} s, expected what has come by now, at once")
    return future.result()


def _settings_to_feed(s: Subject, path: Path) -> Mapping[str, Any]:
    fields = type(s.settings).model_fields
    if isinstance(s.example.get("port"), int):  # not that of a serial line
        return {"port": 0, **({"host": "127.0.0.1"} if "host" in fields else {})}
    for name, feed in (("path", str(path)), ("source", "udp:0")):
        if name in fields:
            return {name: feed}
    raise NotRun("its settings have no port, path or source by which the checks could feed it")
