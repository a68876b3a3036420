"""Simulated smart servos against the makers' documents: packets, registers, what they do and refuse."""

from __future__ import annotations

import math
import os
import select
from pathlib import Path

import numpy as np
import pytest
from servo_bus_parts import BAUD, BusOnDesk, at_baud, packet

from tests.simulated_lines.bus_packets import crc16
from tests.simulated_lines.serial_line import SerialLine

UNLOCK = ("lock", 0)


@pytest.mark.parametrize(
    ("model", "asked", "answer"),
    [
        # e-Manual, protocol 2: ping of an XM430-W210 (1030, firmware 38); here of an XL330-M288 (1200, firmware 45)
        ("xl330-m288", "FF FF FD 00 01 03 00 01 19 4E", "FF FF FD 00 01 07 00 55 00 B0 04 2D"),
        # e-Manual, protocol 1: the present temperature of an AX-12 with the id 1
        ("ax12", "FF FF 01 04 02 2B 01 CC", "FF FF 01 03 00 19 E2"),
        # Feetech, protocol manual: ping of the servo with the id 1; position 2048 of the same
        ("sts3215", "FF FF 01 02 01 FB", "FF FF 01 02 00 FC"),
        ("sts3215", "FF FF 01 04 02 38 02 BE", "FF FF 01 04 00 00 08 F2"),
    ],
)
def test_published_packets_are_answered_as_documented(model: str, asked: str, answer: str) -> None:
    desk = BusOnDesk(model)
    (given,) = desk.ask(bytes.fromhex(asked))
    assert given.hex(" ").upper().startswith(answer)


def test_a_dynamixel_answers_with_the_crc_of_the_e_manual() -> None:
    body = bytes.fromhex("FF FF FD 00 01 07 00 55 00 06 04 26")
    assert crc16(body).to_bytes(2, "little") == bytes.fromhex("65 5D")


def test_headers_inside_a_packet_of_protocol_2_are_stuffed_both_ways() -> None:
    desk = BusOnDesk("xl330-m288")
    # -131073 is FF FF FD FF; written with the extra FD, and answered so
    stuffed = bytes.fromhex("14 00 FF FF FD FD FF")
    (answer,) = desk.ask(packet("dynamixel2", 1, 3, stuffed))
    assert answer[8] == 0
    assert desk.servos[0].get("homing_offset") == -131073
    (answer,) = desk.ask(packet("dynamixel2", 1, 2, bytes.fromhex("14 00 04 00")))
    assert answer[9:14] == bytes.fromhex("FF FF FD FD FF")


@pytest.mark.parametrize("model", ["sts3215", "xl330-m288", "ax12"])
def test_a_goal_is_reached_at_the_speed_that_was_set(model: str) -> None:
    desk = BusOnDesk(model)
    table, servo = desk.servos[0].table, desk.servos[0]
    desk.write(1, "torque_enable", 1)
    rate = math.radians(30)
    desk.write(1, "goal_speed", round(rate / table.speed_unit))
    begin = desk.read(1, "position")
    desk.write(1, "goal_position", begin + round(math.radians(60) / table.count))
    desk.run(1.0)
    assert servo.motor.shaft == pytest.approx(rate * 1.0, rel=0.05)
    assert desk.read(1, "moving") == 1
    desk.run(1.2)
    assert desk.read(1, "position") == begin + round(math.radians(60) / table.count)
    assert desk.read(1, "moving") == 0


def test_acceleration_makes_a_trapezoid_that_ends_at_the_goal() -> None:
    desk = BusOnDesk("sts3215")
    desk.write(1, "acceleration", 5)  # 500 counts/s^2
    desk.write(1, "goal_speed", 700)
    desk.write(1, "goal_position", 2048 + 1500)
    desk.run(1.0)
    assert (desk.servos[0].exact_position - 2048) == pytest.approx(0.5 * 500 * 1.0**2, rel=0.05)
    places = [desk.servos[0].exact_position]
    for _ in range(500):
        desk.run(0.01)
        places.append(desk.servos[0].exact_position)
    speeds = np.diff(places) / 0.01
    assert speeds.max() == pytest.approx(700, rel=0.02)
    assert places[-1] == pytest.approx(3548)
    assert max(places) <= 3548 + 1e-6


def test_a_homing_offset_is_sign_and_magnitude_and_shifts_what_is_read() -> None:
    desk = BusOnDesk("sts3215")
    desk.write(1, *UNLOCK)
    desk.write(1, "homing_offset", -2047)
    assert desk.servos[0].get("homing_offset") == -2047
    assert desk.read(1, "position") == (2048 + 2047) % 4096
    # a magnitude above 2047 runs into the sign: 2100 is read as -52
    desk.ask(packet("feetech", 1, 3, bytes((31, *(2100).to_bytes(2, "little")))))
    assert desk.read(1, "homing_offset") == -52


def test_what_is_written_while_the_eeprom_is_locked_is_gone_after_a_brown_out() -> None:
    desk = BusOnDesk("sts3215")
    desk.write(1, "homing_offset", 100)
    assert desk.read(1, "homing_offset") == 100
    desk.bus.boot()
    assert desk.read(1, "homing_offset") == 0
    desk.write(1, *UNLOCK)
    desk.write(1, "homing_offset", 100)
    desk.bus.boot()
    assert desk.read(1, "homing_offset") == 100
    assert desk.read(1, "torque_enable") == 0


def test_the_torque_value_128_makes_the_present_place_the_middle() -> None:
    desk = BusOnDesk("sts3215")
    desk.write(1, "goal_position", 2500)
    desk.run(2.0)
    desk.write(1, "torque_enable", 128)
    assert desk.read(1, "position") == 2048
    assert desk.read(1, "homing_offset") == 452


def test_a_dynamixel_refuses_what_its_e_manual_says_it_refuses() -> None:
    desk = BusOnDesk("xl430-w250")
    desk.write(1, "torque_enable", 1)
    assert desk.write(1, "homing_offset", 10)[0][8] == 7  # torque is on
    assert desk.write(1, "position", 10)[0][8] == 7  # read only
    assert desk.write(1, "led", 2)[0][8] == 4
    assert desk.write(1, "goal_position", 4096)[0][8] == 6
    assert desk.ask(packet("dynamixel2", 1, 0x77, b""))[0][8] == 2
    damaged = bytearray(packet("dynamixel2", 1, 1, b""))
    damaged[-1] ^= 1
    assert desk.ask(bytes(damaged))[0][8] == 3


def test_a_load_makes_the_shaft_stand_off_and_the_encoder_sees_it() -> None:
    desk = BusOnDesk("sts3215", motor={"compliance_deg_per_Nm": 0.8})
    desk.write(1, "torque_enable", 1)
    desk.torque = -1.0
    desk.run(0.5)
    assert math.degrees(desk.servos[0].motor.shaft) == pytest.approx(-0.8)
    assert desk.read(1, "position") == 2048 - round(0.8 / 360 * 4096)
    assert desk.read(1, "load") == round(1000 / 1.9)


def test_without_torque_a_joint_stays_by_friction_or_falls() -> None:
    desk = BusOnDesk("sts3215", motor={"friction": 0.25})
    desk.torque = 0.2
    desk.run(1.0)
    assert desk.servos[0].motor.shaft == 0
    desk.torque = 0.5
    desk.run(1.0)
    assert desk.servos[0].motor.shaft > 0.5


def test_a_servo_that_is_overloaded_becomes_weak_says_so_and_recovers() -> None:
    desk = BusOnDesk("sts3215", motor={"stall": 2.0})
    desk.write(1, "torque_enable", 1)
    desk.torque = 1.7  # 85 %, above the 80 % of the register
    desk.run(1.9)
    assert desk.read(1, "status") == 0
    desk.run(0.5)
    assert desk.read(1, "status") == 32
    assert desk.ask(packet("feetech", 1, 1, b""))[0][4] == 32
    desk.run(0.5)
    assert desk.servos[0].motor.shaft > 0.1  # 20 % of its torque do not hold
    desk.torque = 0.0
    desk.write(1, "torque_enable", 1)
    assert desk.read(1, "status") == 0


def test_a_dynamixel_that_is_overloaded_lets_go_until_it_is_rebooted() -> None:
    desk = BusOnDesk("xl330-m288", motor={"stall": 0.5})
    desk.write(1, "torque_enable", 1)
    desk.torque = 0.5
    desk.run(1.5)
    assert desk.read(1, "status") == 32
    assert desk.read(1, "torque_enable") == 0
    assert desk.write(1, "torque_enable", 1)[0][8] & 0x80
    assert desk.read(1, "torque_enable") == 0
    desk.torque = 0.0
    desk.ask(packet("dynamixel2", 1, 8, b""))
    desk.write(1, "torque_enable", 1)
    assert desk.read(1, "torque_enable") == 1


def test_a_hot_servo_lets_go() -> None:
    desk = BusOnDesk("sts3215")
    desk.write(1, "torque_enable", 1)
    desk.servos[0].heat = lambda: 0.9
    desk.run(0.2)
    assert desk.read(1, "temperature") > 70
    assert desk.read(1, "status") == 4
    assert desk.read(1, "torque_enable") == 0


def test_the_voltage_sags_under_load() -> None:
    desk = BusOnDesk("sts3215", supply=(7.4, 0.5))
    desk.write(1, "torque_enable", 1)
    light = desk.read(1, "voltage")
    desk.torque = 1.5
    desk.run(0.5)
    assert desk.read(1, "voltage") <= light - 9


def test_two_servos_with_one_id_are_not_understood() -> None:
    desk = BusOnDesk("sts3215")
    desk.write(2, *UNLOCK)
    desk.servos[0].motor.advance(0.0, 0.0)
    desk.write(2, "id", 1)
    desk.servos[1].motor.goal = 0.5
    answers = [desk.ask(packet("feetech", 1, 2, bytes((56, 2)))) for _ in range(20)]
    assert all(len(heard) == 1 for heard in answers)
    whole = packet("feetech", 1, 0, (2048).to_bytes(2, "little"))
    assert sum(heard[0] != whole for heard in answers) > 10


def test_a_servo_at_another_baud_rate_or_unplugged_is_silent() -> None:
    desk = BusOnDesk("sts3215")
    desk.baud = 500_000
    assert desk.ask(packet("feetech", 1, 1, b"")) == []
    desk.baud = BAUD
    desk.bus.absent.add(desk.servos[0])
    assert desk.ask(packet("feetech", 1, 1, b"")) == []
    assert len(desk.ask(packet("feetech", 2, 1, b""))) == 1


def test_sync_read_and_sync_write_reach_all_in_their_order() -> None:
    desk = BusOnDesk("sts3215", count=3)
    goals = b"".join(bytes((number,)) + (2000 + number).to_bytes(2, "little") for number in (3, 1, 2))
    assert desk.ask(packet("feetech", 0xFE, 0x83, bytes((42, 2)) + goals)) == []
    assert [servo.get("goal_position") for servo in desk.servos] == [2001, 2002, 2003]
    answers = desk.ask(packet("feetech", 0xFE, 0x82, bytes((42, 2, 3, 9, 1))))
    assert [answer[2] for answer in answers] == [3, 1]
    assert answers[0][5:7] == (2003).to_bytes(2, "little")


def test_an_echo_comes_before_the_answer() -> None:
    desk = BusOnDesk("sts3215", echo=True)
    asked = packet("feetech", 1, 1, b"")
    assert desk.ask(asked) == [asked, packet("feetech", 1, 0, b"")]


@pytest.mark.parametrize("rubbish", [b"\xff\xff", b"\x00\x12", b"\xff\xff\x01\x01", b"\xff\xff\x01\x04\x02\x38"])
def test_rubbish_before_a_packet_does_not_hide_it(rubbish: bytes) -> None:
    desk = BusOnDesk("sts3215")
    desk.ask(rubbish)
    assert desk.ask(packet("feetech", 1, 1, b"")) == [packet("feetech", 1, 0, b"")]


def test_on_a_pty_packets_are_lost_damaged_and_late_and_the_baud_rate_is_the_hosts(tmp_path: Path) -> None:
    desk = BusOnDesk("sts3215")
    line = SerialLine(tmp_path / "bus", desk.bus.split, np.random.default_rng(1))
    line.plug_in()
    host = os.open(tmp_path / "bus", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    at_baud(host)
    assert line.baud == BAUD

    def heard(number: int) -> bytes:
        os.write(host, packet("feetech", number, 1, b""))
        select.select([line.port[0]], [], [], 1.0)
        for piece in line.receive():
            for answer in desk.ask(piece):
                line.send(answer)
        return os.read(host, 1000) if select.select([host], [], [], 0.0)[0] else b""

    one, two = (packet("feetech", number, 0, b"") for number in (1, 2))
    line.to_host.plan("drop", 1)
    assert [heard(1), heard(1)] == [b"", one]
    line.to_board.plan("flip", 1)
    assert heard(1) != one
    line.to_host.plan("late", 1)
    assert [heard(1), heard(2)] == [b"", one + two]
    os.close(host)
    line.unplug()
