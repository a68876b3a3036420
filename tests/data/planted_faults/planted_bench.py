"""Sound devices, links, trackers and joint streams, and twins of each with one fault planted."""

from __future__ import annotations

import json
import math
import socket
import struct
import time
from collections import Counter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from armcal.base.settings import InputPath, Settings
from armcal.devices.device import DeviceError, DeviceIdentity, DeviceLostError, DeviceRefusedError, DeviceState
from armcal.devices.live import JointSample, TrackerFrame

_BOARD, _LIMIT = 0x20, 3.0


class NoSettings(Settings):
    pass


class Board:
    """Sound: two bytes a joint, in tenths of a milliradian; the highest value is no pulse."""

    Settings: ClassVar[Any] = NoSettings
    nothing = b"\xff\x7f"

    def __init__(self, settings: Any, joint_names: Any, link: Any) -> None:
        self.joint_names, self.link, self.is_open = tuple(joint_names), link, False

    def open(self, clock: Any) -> Any:
        identity = self.link.open(clock)
        for joint in self.joint_names:
            if self.raw(joint) == b"\0\0":
                self.put(joint, self.nothing)
        self.is_open = True
        return DeviceIdentity("board", "0", identity.boots)

    def state(self) -> Any:
        self.check()
        found = {joint: self.raw(joint) for joint in self.joint_names}
        return DeviceState({j: struct.unpack("<h", raw)[0] / 1e4 for j, raw in found.items() if raw != self.nothing})

    def standing(self, angles: Any) -> Any:
        return {joint: self.counts(angle) / 1e4 for joint, angle in angles.items()}

    def energise(self, joint: Any, angle: Any) -> None:
        self.check()
        self.put(joint, struct.pack("<h", self.counts(angle)))

    def command(self, angles: Any) -> None:
        for joint, angle in angles.items():
            self.energise(joint, angle)

    def keep_alive(self) -> None:
        self.check()
        self.link.read(_BOARD, 0, 1)

    def guard(self, waypoints: Any, rate: Any, after_s: Any) -> bool:
        return False

    def release(self, joint: Any) -> None:
        self.check()
        self.put(joint, self.nothing)

    def close(self) -> None:
        self.is_open = False

    def check(self) -> None:
        if not self.is_open:
            raise DeviceLostError("it is not open.")

    def counts(self, angle: Any) -> int:
        if not math.isfinite(angle) or abs(angle) > _LIMIT:
            raise DeviceRefusedError(f"found {angle} rad.")
        return round(1e4 * angle)

    def raw(self, joint: Any) -> bytes:
        return self.link.read(_BOARD, 2 * self.joint_names.index(joint), 2)

    def put(self, joint: Any, data: bytes) -> None:
        self.link.write(_BOARD, bytes((2 * self.joint_names.index(joint),)) + data)


class SetsTheMirroredAngle(Board):
    def energise(self, joint: Any, angle: Any) -> None:
        super().energise(joint, -angle)


class SetsDegrees(Board):
    def standing(self, angles: Any) -> Any:
        return {joint: math.degrees(angle) for joint, angle in super().standing(angles).items()}


class RemembersItsAngles(Board):
    """Says what it was told last, whatever stands in the board."""

    def open(self, clock: Any) -> Any:
        self.told: dict[str, float] = {}
        return super().open(clock)

    def energise(self, joint: Any, angle: Any) -> None:
        super().energise(joint, angle)
        self.told[joint] = self.standing({joint: angle})[joint]

    def release(self, joint: Any) -> None:
        super().release(joint)
        self.told.pop(joint, None)

    def state(self) -> Any:
        super().state()
        return DeviceState(dict(self.told))


class SwallowsALostLink(Board):
    def put(self, joint: Any, data: bytes) -> None:
        try:
            super().put(joint, data)
        except DeviceError:
            return


class SaysItLivesAlone(Board):
    def keep_alive(self) -> None:
        self.check()


class TakesAnyAngle(Board):
    def counts(self, angle: Any) -> int:
        return round(1e4 * min(max(angle, -_LIMIT), _LIMIT)) if angle == angle else 0


class KeepsPulsesOnRelease(Board):
    def release(self, joint: Any) -> None:
        self.check()
        self.raw(joint)


class UdpSettings(Settings):
    port: int = 0


class Udp:
    """Sound: a JSON object a datagram."""

    Settings: ClassVar[Any] = UdpSettings
    EXAMPLE: ClassVar[Any] = {"port": 0}

    def __init__(self, settings: Any) -> None:
        self.settings, self.socket, self.clock = settings, None, None
        self.refused: Counter[str] = Counter()

    @property
    def address(self) -> Any:
        return self.socket.getsockname()

    def open(self, clock: Any) -> None:
        self.close()
        self.socket, self.clock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), clock
        self.socket.setblocking(self.waits())
        self.socket.bind(("127.0.0.1", self.settings.port))

    def waits(self) -> bool:
        return False

    def frames(self) -> Any:
        found: list[Any] = []
        while self.socket is not None:
            try:
                data = self.socket.recv(65536)
            except BlockingIOError:
                break
            found += self.read(data)
        return found

    def read(self, data: bytes) -> Any:
        try:
            return [self.understood(data)]
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
            self.count()
            return []

    def count(self) -> None:
        self.refused["not a frame"] += 1

    def understood(self, data: bytes) -> Any:
        told = json.loads(data)
        bodies = {name: np.array(pose, dtype=float).reshape(4, 4) for name, pose in told["bodies"].items()}
        return TrackerFrame(int(told["frame"]), self.clock.now(), None, bodies)

    def close(self) -> None:
        if self.socket is not None:
            self.socket.close()
        self.socket = None


class Blocks(Udp):
    def waits(self) -> bool:
        return True

    def frames(self) -> Any:
        if self.socket is not None:
            self.socket.settimeout(60)
        return super().frames()


class RaisesOnDamage(Udp):
    def read(self, data: bytes) -> Any:
        return [self.understood(data)]


class RaisesOnDeepNesting(Udp):
    def read(self, data: bytes) -> Any:
        if data.startswith(b"[["):
            raise RecursionError("too deep")
        return super().read(data)


class CountsNothing(Udp):
    def count(self) -> None:
        pass


class SleepsInFrames(Udp):
    def frames(self) -> Any:
        time.sleep(60 if self.socket is not None else 0)
        return super().frames()


class FileSettings(Settings):
    path: InputPath


class Lines:
    """Sound: two numbers a line of a file that grows."""

    Settings: ClassVar[Any] = FileSettings
    EXAMPLE: ClassVar[Any] = {"path": "/no/such/folder/joints.txt"}
    ended = False

    def __init__(self, settings: Any) -> None:
        self.path, self.file, self.clock, self.channels = Path(settings.path), None, None, ()
        self.refused: Counter[str] = Counter()

    def open(self, clock: Any, channels: Any) -> None:
        self.close()
        self.clock, self.channels = clock, channels
        try:
            self.file = self.path.open("rb")
        except OSError as fault:
            raise DeviceRefusedError(f"it cannot be read ({fault}).") from fault

    def samples(self) -> Any:
        lines = self.file.read().split(b"\n") if self.file is not None else []
        return [sample for line in lines if line.strip() for sample in self.read(line)]

    def read(self, line: bytes) -> Any:
        try:
            numbers = [float(cell) for cell in line.split(b",")]
            if len(numbers) != len(self.channels) or not all(map(math.isfinite, numbers)):
                raise ValueError("not as many numbers as joints")
        except ValueError:
            self.refused["not a reading"] += 1
            return []
        return [JointSample(self.clock.now(), None, dict(zip(self.channels, numbers, strict=True)))]

    def close(self) -> None:
        if self.file is not None:
            self.file.close()
        self.file = None


class RaisesOnDamagedLine(Lines):
    def read(self, line: bytes) -> Any:
        numbers = [float(cell) for cell in line.split(b",")]
        return [JointSample(self.clock.now(), None, dict(zip(self.channels, numbers, strict=False)))]


class RaisesWhereNoFileIs(Lines):
    def open(self, clock: Any, channels: Any) -> None:
        self.file = self.path.open("rb")


class ReadsItsOwnFormat:
    """Sound as far as it can be seen: a reader of a format that the checks do not know."""

    Settings: ClassVar[Any] = FileSettings

    def __init__(self, settings: Any) -> None:
        self.path = settings.path

    def read(self, request: Any) -> Any:
        raise DeviceRefusedError(f"{self.path} is no file of this format.")
