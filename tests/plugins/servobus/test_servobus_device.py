"""The device ``servobus`` on servos at the far end of a pty."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from armcal.devices.device import (
    DeviceError,
    DeviceLostError,
    DeviceRefusedError,
    DeviceResetError,
    DeviceUnwellError,
    MeasuringDevice,
)
from armcal_servobus.device import ServoBusDevice

from tests.plugins.servobus.fake_bus import FakeBus, FakeServo, sts, xl430

JOINTS = ("q1", "q2")


class Bench:
    """A clock that stands still but for its sleeps."""

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def wall(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds


def device(fake: FakeBus, changes: dict[str, object] | None = None, **settings: object) -> ServoBusDevice:
    is_x = fake.protocol == 2
    servo = {"model": "xl430-w250" if is_x else "sts3215", "range_deg": [-100, 100]}
    joints = {"arm.q1": {"id": 1, **servo, **(changes or {})}, "arm.q2": {"id": 2, "direction": -1, **servo}}
    whole = {"port": fake.path, "reply_ms": 20, "joints": joints, **settings}
    if is_x:
        whole["protocol"] = "dynamixel2"
    return ServoBusDevice(ServoBusDevice.Settings.model_validate(whole), JOINTS, None)


KINDS: list[tuple[int, Callable[..., FakeServo]]] = [(0, sts), (2, xl430)]


@pytest.mark.parametrize(("protocol", "servo"), KINDS)
def test_it_moves_where_it_is_commanded_and_reads_where_it_is(protocol, servo):
    with FakeBus([servo(1, 2148), servo(2, 1948)], protocol) as fake:
        made, clock = device(fake), Bench()
        identity = made.open(clock)
        assert "2 servos" in identity.name and len(identity.digest) == 64
        assert isinstance(made, MeasuringDevice) and made.state().angles == {}
        assert not [i for i in fake.instructions if i[1] in (3, 0x83)], "opening writes nothing"
        here = made.measured()
        assert here == {"q1": pytest.approx(100 * math.tau / 4096), "q2": pytest.approx(100 * math.tau / 4096)}
        for joint in JOINTS:
            made.energise(joint, here[joint])
        assert made.state().angles == made.standing(here)
        for degrees in range(-90, 91, 30):
            angles = dict.fromkeys(JOINTS, math.radians(degrees))
            made.command(angles)
            assert made.state().angles == made.standing(angles) == made.measured()
            made.keep_alive()
        made.release("q1")
        assert set(made.state().angles) == {"q2"}
        with pytest.raises(DeviceRefusedError, match="q1, which hang free"):
            made.command({"q1": 0.0})
        assert not made.guard([{"q1": 0.0}], 0.3, 1.0)
        made.close()


@pytest.mark.parametrize(("protocol", "servo"), KINDS)
def test_torque_comes_on_where_the_joint_stands(protocol, servo):
    with FakeBus([servo(1, 2500), servo(2)], protocol) as fake:
        made = device(fake)
        made.open(Bench())
        place, size, torque = (116, 4, 64) if protocol == 2 else (42, 2, 40)
        seen: list[int] = []
        write = fake.servos[0].write

        def watched(address: int, data: bytes) -> None:
            write(address, data)
            if fake.servos[0].memory[torque]:
                seen.append(int.from_bytes(fake.servos[0].memory[place : place + size], "little"))

        fake.servos[0].write = watched
        made.energise("q1", 0.0)
        made.state()
        made.close()
        assert seen[0] == 2500 and seen[-1] == 2048
        speed = fake.servos[0].memory[112 if protocol == 2 else 46]
        assert speed, "a speed of zero would be no limit"


def test_a_joint_that_hangs_beyond_its_range_is_not_energised():
    with FakeBus([sts(1, 4000), sts(2)]) as fake:
        made = device(fake)
        made.open(Bench())
        with pytest.raises(DeviceRefusedError, match=r"171\.\d+ deg for q1.*by hand"):
            made.energise("q1", 0.0)
        assert fake.servos[0].memory[40] == 0
        made.close()


def word(address: int, value: int, size: int = 2) -> dict[str, int]:
    return {f"r{address + i}": byte for i, byte in enumerate(value.to_bytes(size, "little"))}


@pytest.mark.quick(
    "servos2-changes2-q2 \\\\(id 2\\\\) is sts3250, expected sts3215",
    "servos3-changes3-homing offset -90, expected 90",
    "servos4-changes4-operating mode 1, expected 0",
    "servos5-changes5-angles of several turns",
    "servos6-changes6-stops at counts 1500 and 4095.*Narrow range_deg of q1 to \\\\[-48\\\\.2",
)
@pytest.mark.parametrize(
    ("servos", "changes", "words"),
    [
        ([sts(2)], {}, r"q1 \(id 1\) does not answer.*armcal bus find"),
        ([sts(2), sts(7)], {}, r"q1 \(id 1\) does not answer.*the id 7, which no joint has.*give it the id 1"),
        ([sts(1), sts(2, **word(3, 2825))], {}, r"q2 \(id 2\) is sts3250, expected sts3215"),
        ([sts(1, **word(31, 0x800 | 90)), sts(2)], {"offset": 90}, "homing offset -90, expected 90"),
        ([sts(1, r33=1), sts(2)], {}, "operating mode 1, expected 0"),
        ([sts(1, r18=28), sts(2)], {}, "angles of several turns"),
        ([sts(1, **word(9, 1500)), sts(2)], {}, r"stops at counts 1500 and 4095.*Narrow range_deg of q1 to \[-48\.2"),
        ([sts(1), sts(1, 900), sts(2)], {}, "Two servos may have the id 1"),
    ],
)
def test_what_is_not_as_configured_is_refused_before_anything_moves(servos, changes, words):
    with FakeBus(servos) as fake:
        made = device(fake, changes)
        with pytest.raises(DeviceRefusedError, match=words):
            made.open(Bench())
        assert not [i for i in fake.instructions if i[1] in (3, 0x83)]


@pytest.mark.slow
def test_a_bus_without_power_is_lost_and_comes_back():
    with FakeBus([]) as fake:
        made = device(fake)
        with pytest.raises(DeviceLostError, match="no servo answers at 1000000 baud"):
            made.open(Bench())
        fake.servos += [sts(1), sts(2)]
        made.open(Bench())
        made.close()


def energised(fake: FakeBus) -> tuple[ServoBusDevice, Bench]:
    made, clock = device(fake), Bench()
    made.open(clock)
    for joint, angle in made.measured().items():
        made.energise(joint, angle)
    made.keep_alive()
    return made, clock


@pytest.mark.parametrize(
    ("address", "value", "fault", "words"),
    [
        (63, 66, DeviceUnwellError, r"q2 \(id 2\) is at 66 deg C, expected below 65.*Let it cool"),
        (62, 38, DeviceError, r"q2 \(id 2\) has 3\.8 V, expected 4\.0 to 14\.0"),
        (40, 0, DeviceResetError, r"q2 \(id 2\) lost torque"),
    ],
)
def test_a_servo_that_is_unwell_is_named(address, value, fault, words):
    with FakeBus([sts(1), sts(2)]) as fake:
        made, _ = energised(fake)
        fake.servos[1].memory[address] = value
        with pytest.raises(fault, match=words):
            made.keep_alive()


@pytest.mark.parametrize(("protocol", "servo"), KINDS)
def test_an_alarm_is_said_in_words(protocol, servo):
    with FakeBus([servo(1), servo(2)], protocol) as fake:
        made, _ = energised(fake)
        fake.servos[1].alarm = 0x80 if protocol == 2 else 0x24
        if protocol == 2:
            fake.servos[1].memory[70] = 0x24
        with pytest.raises(DeviceError, match=r"q2 \(id 2\) reports overheating and overload.*Let it cool"):
            made.keep_alive()


def test_a_blocked_joint_is_named_after_a_second():
    with FakeBus([sts(1), sts(2)]) as fake:
        made, clock = energised(fake)
        fake.servos[0].memory[60:62] = (0x400 | 980).to_bytes(2, "little")
        made.keep_alive()
        clock.sleep(1.1)
        with pytest.raises(DeviceUnwellError, match=r"q1 \(id 1\) works with 98 % of its torque for 1 s"):
            made.keep_alive()
        made.keep_alive()  # on its way home it is not stopped again


def test_a_goal_for_a_device_that_is_not_open_is_not_sent_afterwards():
    with FakeBus([sts(1), sts(2)]) as fake:
        made, clock = energised(fake)
        made.close()
        for move in (lambda: made.command({"q1": 0.5}), lambda: made.energise("q1", 0.5), made.keep_alive, made.state):
            with pytest.raises(DeviceLostError):
                move()
        made.open(clock)
        made.keep_alive()
        assert made.state().angles == made.standing({"q1": 0.0, "q2": 0.0})
        made.close()


def test_a_goal_that_was_lost_is_sent_again():
    with FakeBus([sts(1), sts(2)]) as fake:
        made, _ = energised(fake)
        write, fake.servos[1].write = fake.servos[1].write, lambda address, data: None
        made.command({"q1": 0.5, "q2": 0.5})
        assert made.state().angles["q2"] == 0.0
        fake.servos[1].write = write
        made.keep_alive()
        assert made.state().angles == made.standing({"q1": 0.5, "q2": 0.5})


def test_another_offset_is_another_device():
    digests = []
    for offset in (0, 100):
        with FakeBus([sts(1, **word(31, offset)), sts(2)]) as fake:
            made = device(fake)
            digests.append(made.open(Bench()).digest)
            made.close()
    assert digests[0] != digests[1]
