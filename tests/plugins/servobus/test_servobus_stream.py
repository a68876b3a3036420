"""The joint stream ``servobus``: an arm that is guided by hand."""

from __future__ import annotations

import math

import pytest
from armcal.devices.device import DeviceRefusedError
from armcal.errors import ConfigError
from armcal_servobus.device import ServoBusStream

from tests.plugins.servobus.fake_bus import FakeBus, sts
from tests.plugins.servobus.test_servobus_device import Bench

CHANNELS = ("arm.q1", "arm.q2")


def stream(fake: FakeBus, **changes: object) -> ServoBusStream:
    joints = {
        "arm.q1": {"id": 1, "model": "sts3215", "range_deg": [-100, 100], "zero_count": 100},
        "arm.q2": {"id": 2, "model": "sts3215", "range_deg": [-100, 100]},
    }
    settings = {"port": fake.path, "joints": joints, "reply_ms": 20, **changes}
    return ServoBusStream(ServoBusStream.Settings.model_validate(settings))


def turn(fake: FakeBus, servo: int, count: int) -> None:
    fake.servos[servo].memory[56:58] = (count % 4096).to_bytes(2, "little")


def test_angles_go_on_over_the_seam():
    with FakeBus([sts(1, 100), sts(2)]) as fake:
        made, clock = stream(fake), Bench()
        made.open(clock, CHANNELS)
        for moved in range(0, -1000, -100):  # below zero: 4095 and less
            turn(fake, 0, 100 + moved)
            turn(fake, 1, 2048 - moved)
            clock.sleep(0.02)
            (sample,) = made.samples()
            assert sample.angles["arm.q1"] == pytest.approx(moved * math.tau / 4096)
            assert sample.angles["arm.q2"] == pytest.approx(-moved * math.tau / 4096)
        assert made.samples() == [], "nothing is read more often than is set"
        assert not [i for i in fake.instructions if i[1] in (3, 0x83)]
        made.close()
        assert made.ended


def test_servos_that_hold_are_not_dropped_unasked():
    with FakeBus([sts(1, 100, r40=1), sts(2)]) as fake:
        with pytest.raises(DeviceRefusedError, match=r"arm\.q1 hold.*torque: release"):
            stream(fake).open(Bench(), CHANNELS)
        made = stream(fake, torque="release")
        made.open(Bench(), CHANNELS)
        assert fake.servos[0].memory[40] == 0
        made.close()


def test_what_does_not_answer_is_counted_and_comes_back():
    with FakeBus([sts(1, 100), sts(2)]) as fake:
        made, clock = stream(fake), Bench()
        made.open(clock, CHANNELS)
        servo = fake.servos.pop()
        assert made.samples() == []
        assert dict(made.refused) == {"arm.q2 (id 2) does not answer (3 tries).": 1}
        fake.servos.append(servo)
        clock.sleep(1.0)
        assert len(made.samples()) == 1
        made.close()


@pytest.mark.slow
def test_channels_without_a_servo_and_buses_without_anybody():
    with FakeBus([]) as fake:
        with pytest.raises(ConfigError, match=r"found no servo for arm\.q3"):
            stream(fake).open(Bench(), (*CHANNELS, "arm.q3"))
        with pytest.raises(DeviceRefusedError, match="no servo answers"):
            stream(fake).open(Bench(), CHANNELS)
