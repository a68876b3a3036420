"""The simulated Firmata board over a real pty, with bytes written by hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from armcal_simulation.boards.firmata_board import FirmataBoard
from servo_bench_parts import ADDRESS, BoardAtPty, board_at_pty, is_raw

CONFIG = bytes([0xF0, 0x78, 0x00, 0x00, 0xF7])
VERSION = bytes([0xF9, 2, 5])
FIRMWARE = bytes([0xF0, 0x79, 2, 5, ord("t"), 0, ord("s"), 0, 0xF7])


def write(*data: int) -> bytes:
    return bytes([0xF0, 0x76, ADDRESS, 0x00, *[p for b in data for p in (b & 0x7F, b >> 7)], 0xF7])


def read(register: int, count: int) -> bytes:
    numbers = [register & 0x7F, register >> 7, count & 0x7F, count >> 7]
    return bytes([0xF0, 0x76, ADDRESS, 0x08, *numbers, 0xF7])


def reply(register: int, *data: int) -> bytes:
    head = [ADDRESS & 0x7F, ADDRESS >> 7, register & 0x7F, register >> 7]
    return bytes([0xF0, 0x77, *head, *[p for b in data for p in (b & 0x7F, b >> 7)], 0xF7])


@pytest.fixture
def at(tmp_path: Path) -> Iterator[BoardAtPty]:
    with board_at_pty(tmp_path / "board", lambda at: FirmataBoard(at.bus, at.send, "ts")) as built:
        yield built


def test_it_reports_version_and_firmware_when_it_boots_and_when_asked(at: BoardAtPty) -> None:
    assert is_raw(at.host)
    assert at.heard() == VERSION + FIRMWARE
    assert at.ask(bytes([0xF9])) == VERSION
    assert at.ask(bytes([0xF0, 0x79, 0xF7])) == FIRMWARE
    at.board.boot()
    assert at.heard() == VERSION + FIRMWARE


def test_i2c_works_once_it_is_configured(at: BoardAtPty) -> None:
    at.heard()
    assert at.ask(read(0x00, 1)) == b""
    assert at.ask(CONFIG + read(0x00, 1)) == reply(0x00, 0x11)
    assert at.ask(write(0xFE, 0xAA) + read(0xFE, 1)) == reply(0xFE, 0xAA)


def test_what_it_does_not_know_is_passed_over(at: BoardAtPty) -> None:
    at.heard()
    unknown = bytes([0xE0, 1, 2, 0x90, 3, 0xF0, 0x6B, 0xF7, 0xF0, 0xF7, 0xC0, 1, 0xFF, 0x12])
    assert at.ask(unknown + CONFIG + unknown + read(0x01, 1)) == reply(0x01, 0x04)


def test_a_message_that_is_too_long_is_not_done(at: BoardAtPty) -> None:
    at.ask(CONFIG + write(0x00, 0x31))
    at.ask(write(0x06, *[1] * 40))
    assert at.chip.read(ADDRESS, 0x06, 2) == b"\0\0"


def test_too_few_bytes_are_told_as_text_and_the_reply_holds_what_was_there_before(at: BoardAtPty) -> None:
    at.ask(CONFIG)
    at.ask(read(0x00, 1))
    at.bus.hold_down(0.05)
    told = at.ask(read(0x00, 1))
    text = told[2 : told.index(0xF7)]
    assert told[:2] == bytes([0xF0, 0x71]) and bytes(text[::2]).decode() == "I2C: Too few bytes received"
    assert told.endswith(reply(0x00, 0x11))


def test_nothing_tells_that_a_damaged_write_was_done(at: BoardAtPty) -> None:
    """There is no checksum: a driver that does not read back does not know."""
    at.ask(CONFIG + write(0x00, 0x31))
    damaged = bytearray(write(0xFE, 121))
    damaged[6] ^= 1
    assert at.ask(bytes(damaged)) == b""
    assert at.chip.read(ADDRESS, 0xFE, 1) == bytes([120])
