"""The framed link and the driver over it, against a simulated board at the end of a real pty."""

from __future__ import annotations

import math
import os

import pytest
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError, DeviceResetError
from armcal.devices.framed import VERSION, Frame, FrameDecoder, Kind, encoded
from armcal.devices.link import GuardedLink
from armcal_pca9685.device import Pca9685Device
from armcal_pca9685.links import FramedLink
from board_bench import JOINTS, PtyBoard, servo_file, written

from tests.simulated_lines.pca9685_model import ADDRESS_ONLY


@pytest.fixture
def board(tmp_path):
    with PtyBoard(tmp_path, board_id="A5069RR4") as made:
        yield made


def link_to(board) -> FramedLink:
    return FramedLink(FramedLink.Settings(port=board.path, start_s=0.3))


def device_on(board, folder, **more) -> Pca9685Device:
    file = written(folder, servo_file(**more))
    return Pca9685Device(Pca9685Device.Settings(servos=file), JOINTS, link_to(board))


def test_identity(board):
    link = link_to(board)
    assert isinstance(link, GuardedLink)
    identity = link.open(board.clock)
    assert (identity.adapter, identity.boots) == ("A5069RR4", 1)
    assert not link.took_over
    link.close()
    link.close()


def test_the_driver_works_over_it(board, tmp_path):
    device = device_on(board, tmp_path, ids=("A5069RR4",))
    identity = device.open(board.clock)
    assert "A5069RR4" in identity.name and identity.boots == 1
    for joint in JOINTS:
        device.energise(joint, 0.0)
    for degrees in range(-90, 91, 20):
        angles = dict.fromkeys(JOINTS, math.radians(degrees))
        device.command(angles)
        assert device.state().angles == device.standing(angles)
        device.keep_alive()
    assert board.chips[0].pulse_s(0) == pytest.approx((1540 + 920 * 0.9) * 1e-6, abs=2.6e-6)
    assert not board.chips[0].violations
    device.release("q1")
    assert board.chips[0].pulse_s(0) is None


@pytest.mark.quick("3-to_board-duplicate", "3-to_board-split", "3-to_host-duplicate", "3-to_host-split")
@pytest.mark.parametrize("fault", ["drop", "duplicate", "reorder", "flip", "split"])
@pytest.mark.parametrize("direction", ["to_board", "to_host"])
@pytest.mark.parametrize("turns", [3, pytest.param(12, marks=pytest.mark.slow)])
def test_no_fault_of_the_line_is_seen(board, tmp_path, fault, direction, turns):
    """Whatever the line does to two messages in a row, every command arrives, once or again."""
    device = device_on(board, tmp_path)
    device.open(board.clock)
    device.energise("q1", 0.0)
    for turn in range(turns):
        with board.paused():
            getattr(board.line, direction).plan(fault, 2, after=turn % 3)
        angle = {"q1": 0.05 * turn}
        device.command(angle)
        assert device.state().angles == device.standing(angle)
        low, high = 1540e-6 - 1e-5, 1540e-6 + 1e-3
        assert all(low <= commit.after <= high for commit in board.chips[0].commits if commit.after)


def test_a_request_that_is_made_again_is_done_once(board):
    """Its answer is lost; the chip sees the write once."""
    link = link_to(board)
    link.open(board.clock)
    link.write(0x40, bytes((0x00, 0x30)))
    done, write = [], board.bus.write
    board.bus.write = lambda address, data: done.append(data) or write(address, data)
    with board.paused():
        board.line.to_host.plan("drop", 2)
    link.write(0x40, bytes((0x01, 0x04)))
    assert done == [bytes((0x01, 0x04))]


def test_an_old_greeting_that_comes_late_is_overcome(board):
    """It sets the board's count back, so that it takes new requests for old ones; they are asked anew."""
    link = link_to(board)
    link.open(board.clock)
    with board.paused():
        late = (link._sequence + 150) % 256
        board.firmware.receive(encoded(Frame(Kind.HELLO, late, bytes((VERSION,)))))
    assert link.read(0x40, 0x00, 1) == b"\x11"


def test_a_reset_is_noticed(board, tmp_path):
    device = device_on(board, tmp_path)
    device.open(board.clock)
    device.energise("q1", 0.1)
    with board.paused():
        board.firmware.boot()
    with pytest.raises(DeviceResetError):
        device.command({"q1": 0.2})
    identity = device.open(board.clock)
    assert identity.boots == 2
    assert device.state().angles  # the chip went on
    device.command({"q1": 0.3})


def test_unplugged_and_plugged_in_under_another_name(board, tmp_path):
    device = device_on(board, tmp_path)
    device.open(board.clock)
    device.energise("q1", 0.1)
    with board.paused():
        board.line.unplug()
    for _ in range(2):
        with pytest.raises(DeviceLostError):
            device.command({"q1": 0.2})
    with pytest.raises(DeviceLostError):
        device.open(board.clock)
    taken = os.openpty()
    with board.paused():
        board.line.plug_in()
    device.open(board.clock)
    device.command({"q1": 0.2})
    assert device.state().angles == device.standing({"q1": 0.2})
    for handle in taken:
        os.close(handle)


@pytest.mark.slow
def test_a_silent_board_is_lost(board):
    link = FramedLink(FramedLink.Settings(port=board.path, start_s=0.05))
    link.open(board.clock)
    board.deaf = True
    with pytest.raises(DeviceLostError, match="does not answer"):
        link.beat()
    with pytest.raises(DeviceLostError, match="framed"):
        link.open(board.clock)


def test_what_the_board_refuses_is_told(board):
    link = link_to(board)
    link.open(board.clock)
    with pytest.raises(DeviceError, match=r"WRITE.*no device answers at the I2C address 0x55"):
        link.write(0x55, b"\0\0")
    with pytest.raises(DeviceError, match=r"SET.*no device answers at the I2C address 0x41"):
        link.set_counts({(0x40, 0): (0, 300), (0x41, 0): (0, 300)})
    with board.paused():
        board.bus.plan_nack(1)
    with pytest.raises(DeviceError, match="refuses byte 1"):
        link.write(0x40, b"\0\x20")
    with board.paused():
        board.bus.plan_nack(ADDRESS_ONLY)
    with pytest.raises(DeviceError, match="no device answers"):
        link.write(0x40, b"\0\x20")
    with board.paused():
        board.bus.hold_down(0.5)
    with pytest.raises(DeviceError, match="stuck"):
        link.write(0x40, b"\0\x20")
    board.clock.sleep(1.0)
    link.write(0x40, b"\0\x31")


def test_the_board_looks_after_the_arm_and_gives_it_back(board, tmp_path):
    """After the silence it drives home, no joint faster than told, all at the same time; then the host comes back."""
    device = device_on(board, tmp_path)
    device.open(board.clock)
    for joint in ("q1", "q2", "q3"):
        device.energise(joint, 0.5)
    rate = math.radians(20)
    assert device.guard([dict.fromkeys(JOINTS, 0.2), {"q1": -0.3, "q2": 0.0, "q3": 0.2}], rate, 1.0)
    for _ in range(10):
        board.clock.sleep(0.5)
        device.keep_alive()
    assert device.state().angles == device.standing(dict.fromkeys(("q1", "q2", "q3"), 0.5))
    board.chips[0].commits.clear()
    began = board.clock.time
    board.clock.sleep(10.0)
    pulses = [commit for commit in board.chips[0].commits if commit.channel == 0]
    assert pulses[0].time >= began + 1.0 - 1e-9
    assert pulses[-1].time - pulses[0].time >= 0.8 / rate - 0.3  # from 0.5 to -0.3
    slope = 920e-6 / math.radians(100)
    for earlier in pulses:
        later = [p for p in pulses if 0.25 <= p.time - earlier.time <= 0.3]
        for commit in later[:1]:
            speed = (abs(commit.after - earlier.after) - 5e-6) / slope / (commit.time - earlier.time)
            assert speed <= rate * 1.001
    with pytest.raises(DeviceLostError, match="by itself"):
        device.command({"q1": 0.0})
    device.open(board.clock)
    state = device.state()
    assert state.took_over
    assert state.angles == device.standing({"q1": -0.3, "q2": 0.0, "q3": 0.2})
    assert board.chips[0].pulse_s(3) is None  # q4 had no pulses, and got none
    device.command({"q1": 0.0})


def test_a_joint_that_is_released_is_not_driven(board, tmp_path):
    device = device_on(board, tmp_path)
    device.open(board.clock)
    for joint in ("q1", "q2"):
        device.energise(joint, 0.5)
    device.guard([{"q1": 0.0, "q2": 0.0}], 1.0, 1.0)
    device.release("q1")
    device.energise("q3", 0.0)
    board.clock.sleep(5.0)
    assert board.chips[0].pulse_s(0) is None
    assert board.chips[0].pulse_s(1) == pytest.approx(1550e-6, abs=2.6e-6)
    assert device.state().took_over


def test_a_guard_that_is_taken_back_does_nothing(board, tmp_path):
    device = device_on(board, tmp_path)
    device.open(board.clock)
    device.energise("q1", 0.5)
    device.guard([{"q1": 0.0}], 1.0, 1.0)
    device.guard([], 1.0, 1.0)
    board.clock.sleep(5.0)
    assert device.state().angles == device.standing({"q1": 0.5}) and not device.state().took_over


def test_more_waypoints_than_a_frame_holds_are_refused(board, tmp_path):
    device = device_on(board, tmp_path)
    device.open(board.clock)
    for joint in JOINTS:
        device.energise(joint, 0.0)
    ways = [dict.fromkeys(JOINTS, 0.01 * i) for i in range(14)]
    assert device.guard(ways, 0.3, 1.0)
    with pytest.raises(DeviceRefusedError, match="at most 14"):
        device.guard([*ways, ways[0]], 0.3, 1.0)


def test_a_killed_hosts_half_frame_harms_nobody(board):
    other = os.open(board.path, os.O_RDWR | os.O_NOCTTY)
    os.write(other, encoded(Frame(Kind.WRITE, 9, b"\x40\0\0"))[:5])
    link = link_to(board)
    assert link.open(board.clock).boots == 1
    assert link.read(0x40, 0x00, 1) == b"\x11"
    os.close(other)


def test_another_version_of_the_protocol_is_refused(board, monkeypatch):
    monkeypatch.setattr("tests.simulated_lines.framed_board.VERSION", 2)
    with pytest.raises(DeviceRefusedError, match="version 2"):
        link_to(board).open(board.clock)


def test_answers_that_cannot_be_read_are_errors_and_never_more(board, monkeypatch):
    """Frames with the right sum and wrong content, from firmware that is broken."""
    link = link_to(board)
    link.open(board.clock)
    send = board.line.send

    def broken(data):
        for frame in FrameDecoder().feed(data):
            send(encoded(Frame(frame.kind, frame.sequence, frame.payload[:3])))

    board.firmware._send = broken
    with pytest.raises(DeviceError, match="cannot be read"):
        link.beat()
    board.firmware._send = lambda data: [
        send(encoded(Frame(frame.kind, frame.sequence, frame.payload[:5]))) for frame in FrameDecoder().feed(data)
    ]
    with pytest.raises(DeviceError, match="found 0 bytes"):
        link.read(0x40, 0, 1)
    with pytest.raises(DeviceRefusedError, match="greeting"):
        link.open(board.clock)
