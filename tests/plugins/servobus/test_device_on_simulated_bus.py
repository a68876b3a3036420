"""The device on simulated servos, which were written from the makers' documents without sight of the driver."""

from __future__ import annotations

import math
import os
import pty
import select
import threading
import tty

import pytest
from armcal.devices.device import DeviceError
from armcal_servobus.bus import Bus, BusSettings
from armcal_servobus.device import ServoBusDevice
from servo_bus_parts import BusOnDesk

JOINTS = ("q1", "q2")
MODELS = ("sts3215", "xl430-w250", "xl330-m288")


class PtyDesk(BusOnDesk):
    """The same at the far end of a pty, and a clock whose sleeps make time pass there."""

    def __init__(self, model: str, count: int = 2, **options: object) -> None:
        super().__init__(model, count, **options)
        self.lock = threading.Lock()
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)
        self.bus._send = lambda data: os.write(self.master, data)
        self.stop, self.wake = os.pipe()
        self.harm = lambda data: data
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while self.stop not in (ready := select.select([self.master, self.stop], [], [])[0]) and ready:
            data = os.read(self.master, 4096)
            with self.lock:
                self.bus.receive(self.harm(data))

    def sleep(self, seconds: float) -> None:
        with self.lock:
            self.run(seconds)

    def close(self) -> None:
        os.write(self.wake, b"x")


class DeskClock:
    def __init__(self, desk: PtyDesk) -> None:
        self.desk = desk

    def now(self) -> float:
        return self.desk.now

    def wall(self) -> float:
        return self.desk.now

    def sleep(self, seconds: float) -> None:
        self.desk.sleep(seconds)


def device(desk: PtyDesk) -> ServoBusDevice:
    table = desk.servos[0].table
    servo = {"model": table.name, "zero_count": table.counts // 2, "range_deg": [-100, 100]}
    joints = {f"arm.q{i}": {"id": i, **servo} for i in (1, 2)}
    settings = {"port": desk.path, "baud": desk.baud, "protocol": table.protocol, "joints": joints}
    return ServoBusDevice(ServoBusDevice.Settings.model_validate(settings), JOINTS, None)


@pytest.fixture(params=MODELS)
def desk(request):
    made = PtyDesk(request.param)
    yield made
    made.close()


def test_it_drives_them(desk):
    made, clock = device(desk), DeskClock(desk)
    made.open(clock)
    assert made.state().angles == {} and not any(servo.get("torque_enable") for servo in desk.servos)
    desk.servos[0].motor.shaft = 0.3
    measured = made.measured()
    assert measured["q1"] == pytest.approx(0.3, abs=0.004)
    for joint in JOINTS:
        made.energise(joint, measured[joint])
        assert desk.servos[0].motor.shaft == pytest.approx(0.3, abs=0.006)
    for _ in range(50):
        angles = made.standing(dict.fromkeys(JOINTS, math.radians(-40)))
        made.command(angles)
        clock.sleep(0.02)
        made.keep_alive()
    assert made.state().angles == angles
    clock.sleep(2.0)
    assert made.measured() == pytest.approx(angles, abs=0.004)
    assert [servo.motor.shaft for servo in desk.servos] == pytest.approx([-math.radians(40)] * 2, abs=0.006)
    made.release("q1")
    assert set(made.state().angles) == {"q2"} and desk.servos[0].motor.setpoint is None
    made.close()


def test_a_joint_turns_no_faster_than_is_set(desk):
    made, clock = device(desk), DeskClock(desk)
    made.open(clock)
    made.energise("q1", 0.0)
    made.command(made.standing({"q1": math.radians(90)}))
    made.state()
    before, fastest = desk.servos[0].motor.shaft, 0.0
    for _ in range(30):
        clock.sleep(0.05)
        fastest = max(fastest, (desk.servos[0].motor.shaft - before) / 0.05)
        before = desk.servos[0].motor.shaft
    assert math.radians(50) < fastest <= math.radians(61)
    made.close()


@pytest.mark.quick("sts3215")
def test_they_are_found(desk):
    protocol = desk.servos[0].table.protocol
    bus = Bus(BusSettings.model_validate({"port": desk.path, "baud": desk.baud, "protocol": protocol, "reply_ms": 60}))
    bus.open()
    there = [bus.looked_at(servo) for servo in bus.present(range(4))]
    assert [(servo.id, servo.model) for servo in there] == [
        (1, desk.servos[0].table.name),
        (2, desk.servos[1].table.name),
    ]
    assert not any(servo.doubled or servo.alarms for servo in there)
    desk.servos[1]._put("id", 1)
    (both,) = (bus.looked_at(servo) for servo in bus.present(range(4)))
    assert both.id == 1 and both.doubled
    bus.close()


def test_a_hot_servo_is_named(desk):
    made, clock = device(desk), DeskClock(desk)
    made.open(clock)
    made.energise("q1", 0.0)
    desk.servos[1].heat = lambda: 1.0
    with pytest.raises(DeviceError, match=r"q2 \(id 2\).*(overheating|deg C)"):
        for _ in range(3):
            clock.sleep(0.2)
            made.keep_alive()
    made.close()


def test_overload_is_named(desk):
    made, clock = device(desk), DeskClock(desk)
    made.open(clock)
    for joint in JOINTS:
        made.energise(joint, 0.0)
    desk.torque = 0.96 * desk.servos[0].motor.settings.stall
    with pytest.raises(DeviceError, match=r"q[12] \(id [12]\).*(overload|torque)"):
        for _ in range(60):
            clock.sleep(0.1)
            made.keep_alive()
    made.close()


def test_a_brown_out_is_a_reset(desk):
    made, clock = device(desk), DeskClock(desk)
    made.open(clock)
    made.energise("q1", 0.0)
    made.keep_alive()
    desk.bus.boot()
    with pytest.raises(DeviceError, match="lost torque"):
        made.keep_alive()
    made.open(clock)
    assert made.state().angles == {}
    made.close()
