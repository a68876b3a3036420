"""The Firmata link and the driver over it, against simulated stock firmware at the end of a real pty."""

from __future__ import annotations

import math
import os

import pytest
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError, DeviceResetError
from armcal.devices.link import GuardedLink
from armcal_pca9685 import firmata_link
from armcal_pca9685.device import Pca9685Device
from armcal_pca9685.firmata_link import FirmataLink
from board_bench import JOINTS, PtyBoard, servo_file, written


@pytest.fixture
def board(tmp_path):
    with PtyBoard(tmp_path, "firmata", (25e6, 26e6)) as made:
        yield made


def link_to(board) -> FirmataLink:
    return FirmataLink(FirmataLink.Settings(port=board.path, start_s=0.3))


def device_on(board, folder) -> Pca9685Device:
    file = written(folder, servo_file((25e6, 26e6)))
    return Pca9685Device(Pca9685Device.Settings(servos=file), JOINTS, link_to(board))


def test_identity(board):
    link = link_to(board)
    assert not isinstance(link, GuardedLink)
    assert link.open(board.clock).firmware == "StandardFirmata.ino 2.5, Firmata 2.5"
    link.close()


def test_the_driver_works_over_it(board, tmp_path):
    device = device_on(board, tmp_path)
    device.open(board.clock)
    for joint in JOINTS:
        device.energise(joint, 0.0)
    for degrees in range(-90, 91, 20):
        angles = dict.fromkeys(JOINTS, math.radians(degrees))
        device.command(angles)
        assert device.state().angles == device.standing(angles)
        device.keep_alive()
    assert board.chips[0].pulse_s(0) == pytest.approx((1540 + 920 * 0.9) * 1e-6, abs=2.6e-6)
    assert board.chips[1].pulse_s(1) == pytest.approx((1550 + 900 * 0.9) * 1e-6, abs=2.6e-6)
    assert not any(chip.violations for chip in board.chips)
    assert not device.guard([{"q1": 0.0}], 0.3, 1.0)


@pytest.mark.slow
def test_a_board_that_starts_when_its_port_is_opened_is_waited_for(board):
    """It hears nothing for a while, then tells its versions unasked."""
    board.deaf = True
    timers = board.clock.passing

    def wakes():
        timers()
        if board.clock.time > 0.15 and board.deaf:
            board.deaf = False
            with board.paused():
                board.firmware.boot()

    board.clock.passing = wakes
    link = link_to(board)
    link.open(board.clock)
    assert link.read(0x40, 0x00, 1) == b"\x11"


@pytest.mark.quick("3-to_host-split")
@pytest.mark.parametrize("fault", ["drop", "duplicate", "split"])
@pytest.mark.parametrize("direction", ["to_board", "to_host"])
@pytest.mark.parametrize("turns", [3, pytest.param(8, marks=pytest.mark.slow)])
def test_messages_that_are_lost_or_doubled_are_not_seen(board, tmp_path, fault, direction, turns):
    device = device_on(board, tmp_path)
    device.open(board.clock)
    device.energise("q1", 0.0)
    for turn in range(turns):
        with board.paused():
            getattr(board.line, direction).plan(fault, 1, after=turn % 3)
        angle = {"q1": 0.05 * turn}
        device.command(angle)
        assert device.state().angles == device.standing(angle)


class Late:
    """A line to the host that keeps back the first message, and lets it go just before the last of some."""

    def __init__(self, last: int) -> None:
        self._last, self._passed, self._held = last, 0, b""

    def through(self, data: bytes) -> list[bytes]:
        self._passed += 1
        if self._passed == 1:
            self._held = data
            return []
        return [self._held, data] if self._passed == self._last else [data]


@pytest.mark.slow
@pytest.mark.parametrize("last", [2, 3])
def test_an_answer_that_comes_late_is_not_taken_for_another(board, monkeypatch, last):
    """Not by the read that is made again, nor by one after a write that made the late answer an old one."""
    monkeypatch.setattr(firmata_link, "_REPLY_S", 0.4)
    link = link_to(board)
    link.open(board.clock)
    link.write(0x40, b"\x00\x30")
    with board.paused():
        board.line.to_host = Late(last)
    assert link.read(0x40, 0x00, 1) == b"\x30"
    link.write(0x40, b"\x00\x20")
    assert link.read(0x40, 0x00, 1) == b"\x20"


def test_no_read_can_be_answered_by_one_of_the_three_before(board):
    """Each of them is of another length; of their bytes only those that were asked for are given."""
    link = link_to(board)
    link.open(board.clock)
    link.write(0x40, b"\x00\x30")
    asked, read = [], board.bus.read
    board.bus.read = lambda address, register, count: asked.append(count) or read(address, register, count)
    assert [link.read(0x40, 0x00, 2) for _ in range(8)] == [b"\x30\x04"] * 8
    assert all(len(set(asked[i : i + 4])) == 4 for i in range(5))


def test_a_reset_is_noticed(board, tmp_path):
    device = device_on(board, tmp_path)
    device.open(board.clock)
    device.energise("q1", 0.1)
    with board.paused():
        board.firmware.boot()
    with pytest.raises(DeviceResetError):
        device.keep_alive()
    device.open(board.clock)
    device.command({"q1": 0.3})
    assert device.state().angles == device.standing({"q1": 0.3})


def test_unplugged_and_plugged_in_under_another_name(board, tmp_path):
    device = device_on(board, tmp_path)
    device.open(board.clock)
    device.energise("q1", 0.1)
    with board.paused():
        board.line.unplug()
    with pytest.raises(DeviceLostError):
        device.command({"q1": 0.2})
    taken = os.openpty()
    with board.paused():
        board.line.plug_in()
        board.firmware.boot()
    device.open(board.clock)
    device.command({"q1": 0.2})
    for handle in taken:
        os.close(handle)


def test_a_chip_that_does_not_answer_is_told_in_the_boards_words(board):
    link = link_to(board)
    link.open(board.clock)
    with pytest.raises(DeviceError, match=r"0x55 does not answer.*Too few bytes"):
        link.read(0x55, 0x00, 1)


def test_a_silent_board_is_lost(board):
    link = link_to(board)
    link.open(board.clock)
    board.deaf = True
    with pytest.raises(DeviceLostError, match="does not answer"):
        link.read(0x40, 0x00, 1)
    with pytest.raises(DeviceLostError, match="StandardFirmata"):
        link.open(board.clock)


def test_another_protocol_is_refused(board, monkeypatch):
    monkeypatch.setattr("armcal_simulation.boards.firmata_board.PROTOCOL", (1, 0))
    with pytest.raises(DeviceRefusedError, match=r"version 1\.0"):
        link_to(board).open(board.clock)
