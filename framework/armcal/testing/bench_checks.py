"""Checks on links, devices, trackers, joint streams, cameras and simulated benches.

No port is opened, for something may be plugged in. Live sources never wait; damaged bytes are counted, never raised.
"""

import math
import socket
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from contextlib import closing, suppress
from copy import deepcopy
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

from armcal.devices.clock import Clock, RealClock
from armcal.devices.device import (
    DeviceError,
    DeviceLostError,
    DeviceRefusedError,
    JointDevice,
    open_device,
    standing_at,
    state_of,
)
from armcal.devices.link import LinkIdentity
from armcal.devices.live import frames_of, refused_by, samples_of
from armcal.errors import InputError
from armcal.testing.checking import ContractError, NotRun, Subject, check, expect, raises_only

T = TypeVar("T")
JOINTS, CHANNELS = ("q1", "q2"), ("arm.q1", "arm.q2")
"""The joints that a device's ``EXAMPLE`` must know, and the channels of a joint stream."""
_NEAR_RAD, _SAME_RAD, _REGISTERS = 0.02, 1e-9, 256
"""So near to an angle must a board's pulses come; so near are equal angles."""
_PATIENCE_S, _TRIES = 5.0, 20
"""Whoever takes longer than this to say what has come is waiting."""
_DAMAGED = (
    b"",
    b"\n",
    b"\xff\xfe\xfd broken\n",
    b"{\n",
    b"[" * 20_000 + b"\n",
    b'{"frame": 1e999, "time_s": NaN, "bodies": {"0": [1]}}\n',
    b"fr 1\r\n6d 1 [0 1.0][nan nan\r\n",
    b"\0" * 100 + b"\n",
    b"1,2,3\n1,2\n,,\n",
    bytes(np.random.default_rng(9).integers(0, 256, 3000, dtype=np.uint8)) + b"\n",
)


def _expect_methods(made: Any, *names: str) -> None:
    lacking = [name for name in names if not callable(getattr(made, name, None))]
    expect(not lacking, f"found no {', '.join(lacking)}, expected methods as in docs/hooks.md")


def _expect_lost(what: str, call: Callable[[], object], *others: type[Exception]) -> None:
    expected: tuple[type[Exception], ...] = (DeviceError, *others)
    with suppress(*expected):
        with raises_only(*expected, when=f" at {what}"):
            call()
        raise ContractError(f"found no error at {what}, expected armcal.devices.device.DeviceError")


# --- links, devices, simulated benches ------------------------------------------------------------------------------


@check("bench")
def it_can_serve(s: Subject) -> None:  # serving takes an experiment and does not end by itself
    _expect_methods(s.built, "serve")


@check("link")
def the_link_is_lost_before_it_is_opened_and_may_be_closed_twice(s: Subject) -> None:
    link = s.built
    _expect_methods(link, "open", "write", "read")
    link.close()
    link.close()
    _expect_lost("reading before it is opened", lambda: link.read(64, 0, 1))
    _expect_lost("writing before it is opened", lambda: link.write(64, b"\0\0"))


@check("device", needed=True)
def the_device_builds_and_has_its_methods(s: Subject) -> None:
    s.built = s.build(JOINTS, _MemoryLink("nobody is there."))
    _expect_methods(
        s.built, *(name for name in vars(JointDevice) if not name.startswith("_") and name != "joint_names")
    )
    expect(tuple(s.built.joint_names) == JOINTS, f"found {s.built.joint_names}, expected {JOINTS}")


@check("device")
def without_its_link_every_call_is_an_error_and_it_may_be_closed_twice(s: Subject) -> None:
    device = s.built
    device.close()
    device.close()
    own_port = "port" in s.example  # one that is not there is refused
    refused = (DeviceRefusedError,) if own_port else ()
    _expect_lost("open() of a link without anybody", lambda: device.open(RealClock()), *refused)
    for call in (device.state, device.keep_alive, lambda: device.energise(JOINTS[0], 0.0)):
        _expect_lost("a call before it is opened", call)


@check("device")
def angles_that_pulses_can_set_stand_where_they_are_told(s: Subject) -> None:
    once = standing_at(s.built, dict.fromkeys(JOINTS, 0.1))
    again = standing_at(s.built, once)
    near = all(abs(again[joint] - once[joint]) < _SAME_RAD for joint in JOINTS)
    expect(near, f"found {again}, expected {once}, since standing() had given these angles")
    for angle in (math.nan, 1e3):
        with suppress(InputError):
            standing = s.built.standing({JOINTS[0]: angle})
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
    angles = state_of(s.device).angles
    expect(JOINTS[0] not in angles, f"found {JOINTS[0]} with an angle after release(): what is let go has no angle")
    expect(JOINTS[1] in angles, f"found {JOINTS[1]} without an angle after release() of {JOINTS[0]}")


@check("device")
def it_passes_on_that_the_link_was_lost(s: Subject) -> None:
    device, s.link.lost = s.device, "the link was cut."
    at = {JOINTS[1]: -0.2}
    calls = {"state": (), "command": (at,), "energise": (JOINTS[0], 0.1), "keep_alive": (), "release": (JOINTS[0],)}
    for name, given in calls.items():
        _expect_lost(f"{name}()", partial(getattr(device, name), *given))


def _expect_at(device: Any, commands: Mapping[str, float], after: str) -> None:
    angles, standing = state_of(device).angles, standing_at(device, commands)
    for joint, angle in commands.items():
        expect(joint in angles, f"found no angle of {joint} after {after}, expected {angle:g} rad")
        for what, value in (("state()", angles[joint]), ("standing()", standing[joint])):
            near = abs(value - angle) <= _NEAR_RAD
            expect(near, f"found {value:.4f} rad of {joint} in {what} after {after}, expected {angle:g}")
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


@check("camera")
def the_camera_refuses_without_a_measurement_and_may_be_closed_at_any_time(s: Subject) -> None:
    camera = s.built
    camera.close()
    with suppress(InputError):
        with raises_only(InputError):
            _within(lambda: camera.open(RealClock(), {}))
        raise ContractError("found it open without a camera's measurement, expected a refusal")
    expect(isinstance(camera.gives_shots, bool), f"found gives_shots = {camera.gives_shots!r}, expected true or false")
    camera.close()
    camera.close()
    expect(_within(camera.shots) == [], "found an image after close(), expected none")


@check("tracker", "joints", needed=True)
def it_opens_or_refuses_by_an_armcal_error(s: Subject) -> None:
    is_tracker = s.kind == "tracker"
    s.opening = () if is_tracker else (CHANNELS,)
    s.take = frames_of if is_tracker else samples_of
    s.built.close()
    with suppress(InputError), raises_only(InputError):
        _within(lambda: s.built.open(RealClock(), *s.opening))


@check("tracker", "joints")
def it_gives_what_has_come_without_waiting_and_nothing_once_closed(s: Subject) -> None:
    _within(lambda: s.take(s.built))
    if s.kind == "joints":
        expect(isinstance(s.built.ended, bool), f"found ended = {s.built.ended!r}, expected true or false")
    refused_by(s.built)
    s.built.close()
    s.built.close()
    expect(_within(lambda: s.take(s.built)) == [], "found something that came after close(), expected nothing")


@check("tracker", "joints")
def damaged_bytes_are_passed_over_and_counted(s: Subject) -> None:
    """By UDP or in a file: each is passed over, and some of them are counted."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "live")
        path.touch()
        source = s.made(s.made.Settings.model_validate(_settings_to_feed(s, path)))
        try:
            source.open(RealClock(), *s.opening)
        except InputError as refusal:
            raise NotRun(f"it does not open: {refusal}") from refusal
        with closing(source), path.open("ab", 0) as file, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            address = getattr(source, "address", None)
            for data in _DAMAGED:
                if address is None:
                    file.write(data)
                else:
                    sender.sendto(data, tuple(address))
                with raises_only(expected="them counted in refused", when=f" for the bytes {data[:20]!r}"):
                    _within(lambda: s.take(source))
            for _ in range(_TRIES):
                if sum(refused_by(source).values()):
                    return
                _within(lambda: s.take(source))
    raise ContractError("found nothing in refused after damaged bytes, expected each to be counted by its reason")


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
    waits = f"found it still waiting after {_PATIENCE_S:g} s, expected what has come by now, at once"
    expect(future.done(), waits)
    return future.result()


def _settings_to_feed(s: Subject, path: Path) -> Mapping[str, Any]:
    example, fields = dict(s.example), type(s.settings).model_fields
    if isinstance(example.get("port"), int):  # not that of a serial line
        return {**example, "port": 0, **({"host": "127.0.0.1"} if "host" in fields else {})}
    for name in ("path", "source"):
        if name in fields:
            return {**example, name: str(path)}
    raise NotRun("its settings have no port, path or source by which the checks could feed it")
