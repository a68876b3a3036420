"""The bus over a real pty: repeats, time-outs, echoes, late and damaged answers, and who is there."""

from __future__ import annotations

import os
import time

import pytest
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError
from armcal_servobus.bus import Bus, BusSettings, FoundServo

from tests.plugins.servobus.fake_bus import FakeBus, sts, xl430


def opened(fake: FakeBus, **settings: object) -> Bus:
    protocol = "dynamixel2" if fake.protocol == 2 else "feetech"
    bus = Bus(BusSettings.model_validate({"port": fake.path, "protocol": protocol, **settings}), {1: "arm.q1"})
    bus.open()
    return bus


def servos_on(bus: Bus, ids=range(31)) -> list[FoundServo]:
    return [servo for servo in (bus.looked_at(number) for number in bus.present(ids)) if servo is not None]


class Faulty:
    """Spoils the answers whose turn is named, counted from when it is begun."""

    def __init__(self, turns: set[int], spoil) -> None:
        self.turns, self.spoil, self.turn = turns, spoil, -1

    def __call__(self, answer: bytes) -> bytes:
        self.turn += 1
        return self.spoil(answer) if self.turn in self.turns else answer


def flipped(answer: bytes) -> bytes:
    return answer[:-1] + bytes((answer[-1] ^ 0x10,))


def lost(answer: bytes) -> bytes:
    return b""


@pytest.mark.parametrize("echoes", [False, True])
@pytest.mark.parametrize(("protocol", "servo", "place"), [(0, sts, 56), (2, xl430, 132)])
def test_reads_and_writes(protocol, servo, place, echoes):
    with FakeBus([servo(1, 100), servo(2, 300)], protocol, echoes) as fake:
        bus = opened(fake)
        assert bus.present(range(4)) == [1, 2] and bus.read(2, place, 2) == (300).to_bytes(2, "little")
        bus.write(1, 36, b"\x07")
        assert fake.servos[0].memory[36] == 7
        data = bus.read_all([2, 1], place, 2)
        assert data == {1: (100).to_bytes(2, "little"), 2: (300).to_bytes(2, "little")}
        bus.write_all(46, {1: b"\x01\x02", 2: b"\x03\x04"})
        assert bus.read(2, 46, 2) == b"\x03\x04" and fake.servos[0].memory[46:48] == b"\x01\x02"
        assert not +bus.counts
        bus.close()


def test_a_ping_whose_echo_looks_like_an_answer_finds_nobody():
    """FF FF 01 02 01 FB is a ping of id 1, and the answer of a servo 1 that lacks voltage."""
    with FakeBus([sts(2)], echoes=True) as fake:
        bus = opened(fake, reply_ms=10)
        assert bus.present(range(4)) == [2]
        bus.close()


@pytest.mark.parametrize("spoil", [flipped, lost, lambda answer: answer[:4], lambda answer: b"\xff\x00" + answer])
def test_spoilt_answers_are_asked_for_again(spoil):
    with FakeBus([sts(1, 100), sts(2, 200)]) as fake:
        bus = opened(fake, reply_ms=20)
        fake.mangle = Faulty({0, 2, 5}, spoil)
        assert bus.read(1, 56, 2) == (100).to_bytes(2, "little")
        assert bus.read_all([1, 2], 56, 2) == {1: (100).to_bytes(2, "little"), 2: (200).to_bytes(2, "little")}
        assert bus.read(2, 56, 2) == (200).to_bytes(2, "little")
        bus.close()


def test_an_answer_that_comes_too_late_is_not_taken_for_the_next():
    """Nothing in an answer says to which question it belongs."""
    with FakeBus([sts(1, 100)]) as fake:
        bus = opened(fake, reply_ms=20, tries=1)
        late: list[bytes] = []
        fake.mangle = lambda answer: late.append(answer) or b""
        with pytest.raises(DeviceLostError):
            bus.read(1, 56, 2)
        fake.mangle = lambda answer: answer
        os.write(fake.master, late[0])
        assert bus.read(1, 42, 2) == b"\0\0"
        bus.close()


def test_time_is_bounded_and_the_joint_is_named():
    with FakeBus([sts(2)]) as fake:
        bus = opened(fake, reply_ms=20)
        before = time.monotonic()
        with pytest.raises(DeviceLostError, match=r"arm\.q1 \(id 1\) does not answer \(3 tries\)"):
            bus.read(1, 56, 2)
        assert time.monotonic() - before < 0.6
        fake.mangle = flipped
        with pytest.raises(DeviceError, match=r"id 2 arrive damaged \(3 of 3 tries\).*two servos have this id"):
            bus.read(2, 56, 2)
        assert bus.counts["damaged"] == 3
        bus.close()


def test_a_write_that_nobody_acknowledges_is_read_back():
    with FakeBus([sts(1)]) as fake:
        bus = opened(fake, reply_ms=10)
        fake.mangle = lambda answer: answer if len(answer) > 6 else b""
        bus.write(1, 40, b"\x01")
        assert fake.servos[0].memory[40] == 1
        fake.servos[0].write = lambda address, data: None
        with pytest.raises(DeviceError, match="holds 01 at register 40 after 00 was written"):
            bus.write(1, 40, b"\x00")
        bus.close()


def test_ports_that_are_not_there(tmp_path):
    with pytest.raises(DeviceRefusedError, match="no such serial port"):
        Bus(BusSettings(port=tmp_path / "none")).open()


@pytest.mark.slow
def test_all_servos_are_found():
    with FakeBus([sts(1, 10), sts(3, 30), sts(250, 40)]) as fake:
        bus = opened(fake)
        fake.servos[1].alarm = 0x20
        found_servos = servos_on(bus)
        assert [(s.id, s.model, s.firmware, s.position) for s in found_servos] == [
            (1, "sts3215", "3.10", 10), (3, "sts3215", "3.10", 30), (250, "sts3215", "3.10", 40)
        ]  # fmt: skip
        assert found_servos[1].alarms == ("overload",) and found_servos[0].voltage_V == 12.1
        assert not any(s.doubled for s in found_servos)
        bus.close()


def test_a_servo_whose_answer_was_lost_is_asked_again():
    with FakeBus([sts(1), sts(2)]) as fake:
        lost = []

        def mangle(answer):
            if answer[2] == 2 and len(lost) < 2:  # of the ping of all, and of its own
                lost.append(answer)
                return b""
            return answer

        fake.mangle = mangle
        bus = opened(fake)
        assert [servo.id for servo in servos_on(bus, range(4))] == [1, 2] and len(lost) == 2
        bus.close()


@pytest.mark.slow
@pytest.mark.parametrize("protocol", [0, 2])
def test_two_servos_with_one_id_are_seen(protocol):
    servo = xl430 if protocol == 2 else sts
    with FakeBus([servo(2), servo(3, 100), servo(3, 900)], protocol) as fake:
        bus = opened(fake, reply_ms=20)
        doubled = {s.id: s.doubled for s in servos_on(bus, range(5))}
        assert doubled == {2: False, 3: True}
        bus.close()


@pytest.mark.slow
def test_two_servos_that_talk_at_once_are_seen():
    """On a wire both pull low: what arrives is the AND of both."""
    with FakeBus([sts(2), sts(3, 100), sts(3, 900)]) as fake:
        held: list[bytes] = []

        def collide(answer: bytes) -> bytes:
            if answer[2] != 3:
                return answer
            if not held:
                held.append(answer)
                return b""
            return bytes(a & b for a, b in zip(held.pop(), answer, strict=False))

        bus = opened(fake, reply_ms=20)
        fake.mangle = collide
        doubled = {s.id: s.doubled for s in servos_on(bus, range(5))}
        assert doubled == {2: False, 3: True}
        bus.close()
