"""Framed boards over a pty, simulated and an Arduino's sketch: frame by frame, their watchdog, faults of the line."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from servo_bench_parts import ADDRESS, BoardAtPty, board_at_pty

from tests.arduino_sketch import SketchBoard, compiled
from tests.simulated_lines.framed_board import BoardIdentity, FramedBoard

HELLO, TAKE, WRITE, READ, SET, BEAT, GUARD, REFUSED = 0x01, 0x02, 0x10, 0x11, 0x12, 0x20, 0x21, 0xFF
TOOK_OVER, GUARDED, STUCK = 1, 2, 4


def stuffed(data: bytes) -> bytes:
    """COBS as its paper has it, byte by byte."""
    out, block = bytearray(), bytearray()
    for byte in data:
        if byte:
            block.append(byte)
        if not byte or len(block) == 254:
            out += bytes([len(block) + 1]) + block
            block.clear()
    return bytes(out + bytes([len(block) + 1]) + block)


def unstuffed(data: bytes) -> bytes:
    out, place = bytearray(), 0
    while place < len(data):
        code = data[place]
        out += data[place + 1 : place + code]
        place += code
        if code < 255 and place < len(data):
            out.append(0)
    return bytes(out)


def frame(kind: int, sequence: int, payload: bytes = b"") -> bytes:
    body = bytes([kind, sequence]) + payload
    return stuffed(body + struct.pack("<I", zlib.crc32(body))) + b"\0"


def frames(data: bytes) -> list[tuple[int, int, int, int, bytes]]:
    """Kind, sequence, boots, flags and what follows, of each reply."""
    found = []
    for piece in data.split(b"\0")[:-1]:
        body = unstuffed(piece)
        assert zlib.crc32(body[:-4]) == struct.unpack("<I", body[-4:])[0]
        boots, flags = struct.unpack("<IB", body[2:7])
        found.append((body[0], body[1], boots, flags, body[7:-4]))
    return found


def target(channel: int, on: int, off: int) -> bytes:
    return struct.pack("<BBHH", ADDRESS, channel, on, off)


def guard(after_ms: int, rates: dict[int, float], waypoints: list[list[int]]) -> bytes:
    channels = b"".join(struct.pack("<BBH", ADDRESS, c, round(16 * rate)) for c, rate in rates.items())
    counts = b"".join(struct.pack("<H", count) for waypoint in waypoints for count in waypoint)
    return struct.pack("<HB", after_ms, len(rates)) + channels + bytes([len(waypoints)]) + counts


@pytest.fixture(scope="module")
def sketch(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    return compiled(tmp_path_factory.mktemp("sketch"))


@pytest.fixture(params=["simulated", "sketch"])
def at(tmp_path: Path, request: pytest.FixtureRequest, sketch: Path | None) -> Iterator[BoardAtPty]:
    if request.param == "sketch" and sketch is None:
        pytest.skip("no g++ compiles the sketch")

    def arduino(at: BoardAtPty) -> SketchBoard:
        assert sketch is not None
        return SketchBoard(sketch, at.clock, at.bus, at.send, boots=6)

    with board_at_pty(tmp_path / "board", framed if request.param == "simulated" else arduino) as built:
        yield built


def framed(at: BoardAtPty) -> FramedBoard:
    return FramedBoard(at.clock, at.bus, at.send, BoardIdentity("LRM-1", 25_000_000, "test"), boots=6)


def one(at: BoardAtPty, kind: int, sequence: int, payload: bytes = b"") -> tuple[int, int, int, int, bytes]:
    (reply,) = frames(at.ask(frame(kind, sequence, payload)))
    return reply


def woken(at: BoardAtPty) -> int:
    """The chip runs at 50 Hz; gives the next sequence."""
    for sequence, data in enumerate(([0, 0x31], [0xFE, 121], [0, 0x21]), start=1):
        one(at, WRITE, sequence, bytes([ADDRESS, *data]))
    at.now += 0.001
    return 4


def counts(at: BoardAtPty, channel: int) -> int:
    on, off = struct.unpack("<HH", at.chip.read(ADDRESS, 6 + 4 * channel, 4) or b"")
    return int(off - on) % 4096


def test_it_says_nothing_until_it_is_asked_and_then_who_it_is(at: BoardAtPty) -> None:
    assert at.heard() == b""
    kind, sequence, boots, flags, content = one(at, HELLO, 9, b"\x01")
    assert (kind, sequence, boots, flags) == (0x81, 9, 7, 0)
    assert content == b"\x01" + struct.pack("<I", 25_000_000) + b"\x05LRM-1test"


def test_read_write_and_set(at: BoardAtPty) -> None:
    assert one(at, READ, 1, bytes([ADDRESS, 0, 1]))[4] == b"\x11"
    one(at, WRITE, 2, bytes([ADDRESS, 0, 0x31]))
    assert one(at, SET, 3, target(0, 10, 320) + target(1, 4000, 214))[:2] == (0x92, 3)
    assert (counts(at, 0), counts(at, 1)) == (310, 310)


def test_the_same_sequence_gets_the_same_reply_and_is_not_done_again(at: BoardAtPty) -> None:
    first = at.ask(frame(WRITE, 1, bytes([ADDRESS, 0xFE, 50])))
    at.chip.transaction(ADDRESS, bytes([0xFE, 60]))
    assert at.ask(frame(WRITE, 1, bytes([ADDRESS, 0xFE, 50]))) == first
    assert at.chip.read(ADDRESS, 0xFE, 1) == bytes([60])


@pytest.mark.parametrize("last", [1, 100, 200, 255])
def test_old_frames_that_come_late_are_dropped_and_new_ones_done(at: BoardAtPty, last: int) -> None:
    one(at, BEAT, last)
    for behind in (1, 2, 128):
        assert at.ask(frame(WRITE, (last - behind) % 256, bytes([ADDRESS, 0xFE, 99]))) == b""
    assert at.chip.read(ADDRESS, 0xFE, 1) == b"\x1e"
    assert one(at, WRITE, (last + 127) % 256, bytes([ADDRESS, 0xFE, 99]))[0] == 0x90


def test_hello_is_taken_with_any_sequence_and_sets_it(at: BoardAtPty) -> None:
    one(at, BEAT, 100)
    assert one(at, HELLO, 50, b"\x01")[:2] == (0x81, 50)
    assert one(at, BEAT, 51)[0] == 0xA0


def test_damaged_frames_are_dropped_without_a_word(at: BoardAtPty) -> None:
    whole = frame(WRITE, 1, bytes([ADDRESS, 0xFE, 99]))
    for place in range(len(whole) - 1):
        damaged = bytearray(whole)
        damaged[place] ^= 0x40
        assert at.ask(bytes(damaged)) == b""
    assert at.chip.read(ADDRESS, 0xFE, 1) == b"\x1e"
    assert one(at, WRITE, 1, bytes([ADDRESS, 0xFE, 99]))[0] == 0x90


@pytest.mark.parametrize(
    ("kind", "payload", "code", "detail"),
    [
        (0x55, b"", 1, 0),
        (READ, b"\x40", 2, 0),
        (READ, bytes([ADDRESS, 0, 240]), 2, 0),
        (SET, target(16, 0, 1), 2, 0),
        (HELLO, b"", 2, 0),
        (GUARD, b"\x00\x00\x01", 2, 0),
        (GUARD, guard(100, {0: 0.0}, [[300]]), 2, 0),
        (BEAT, b"\x00", 2, 0),
        (WRITE, b"\x41\x00\x00", 3, 0),
        (READ, b"\x41\x00\x01", 3, 0),
        (WRITE, bytes([ADDRESS, 0x80, 0]), 4, 0),
        (TAKE, struct.pack("<I", 6), 6, 0),
    ],
)
def test_what_cannot_be_done_is_refused(at: BoardAtPty, kind: int, payload: bytes, code: int, detail: int) -> None:
    found = one(at, kind, 1, payload)
    assert found[0] == REFUSED and found[4] == bytes([kind, code, detail])


def test_what_is_not_acknowledged_is_told_with_its_index(at: BoardAtPty) -> None:
    at.bus.plan_nack(2)
    index = 2 if isinstance(at.board, FramedBoard) else 0  # Arduino's Wire does not say at which byte it ended
    assert one(at, WRITE, 1, bytes([ADDRESS, 0xFE, 121, 0]))[4] == bytes([WRITE, 4, index])
    at.bus.plan_nack(3)
    assert one(at, SET, 2, target(0, 0, 300))[4] == bytes([SET, 4, 0])


def test_a_set_that_fails_in_the_middle_has_done_what_came_before(at: BoardAtPty) -> None:
    sequence = woken(at)
    one(at, SET, sequence, target(0, 0, 300) + target(1, 0, 300))
    absent = bytes([ADDRESS + 1]) + target(0, 0, 350)[1:]
    refused = one(at, SET, sequence + 1, target(0, 0, 310) + absent + target(1, 0, 310))
    assert refused[0] == REFUSED and refused[4] == bytes([SET, 3, 1])
    assert (counts(at, 0), counts(at, 1)) == (310, 300)


def test_a_stuck_bus_is_told_and_flagged(at: BoardAtPty) -> None:
    at.bus.hold_down(0.05)
    found = one(at, READ, 1, bytes([ADDRESS, 0, 1]))
    assert found[3] == STUCK and found[4] == bytes([READ, 7, 0])
    at.now += 0.06
    assert one(at, READ, 2, bytes([ADDRESS, 0, 1]))[3] == 0


def test_a_reset_raises_the_counter_and_leaves_the_pulses(at: BoardAtPty) -> None:
    sequence = woken(at)
    one(at, SET, sequence, target(0, 0, 300))
    one(at, GUARD, sequence + 1, guard(100, {0: 50.0}, [[250]]))
    at.board.boot()
    assert one(at, BEAT, 200)[2:4] == (8, 0)
    at.run(10.0)
    assert counts(at, 0) == 300


def test_the_vectors_of_the_specification(at: BoardAtPty, repository: Path) -> None:
    """Its table, request by request: what goes over the wire both ways; every message is among them."""
    text = (repository / "docs" / "link_protocol.md").read_text(encoding="utf-8").partition("## Test vectors")[2]
    rows = re.findall(r"^\| ([^|]*) \| `([0-9a-f ]+)` \| `([0-9a-f ]+)` \|$", text, flags=re.MULTILINE)
    kinds = set()
    for words, request, reply in rows:
        at.run(2.0 if "2 s of silence" in words else 0.0)
        assert at.ask(bytes.fromhex(request)).hex(" ") == reply, words
        kinds.add(unstuffed(bytes.fromhex(request)[:-1])[0])
    assert kinds >= {HELLO, TAKE, WRITE, READ, SET, BEAT, GUARD}
    codes = {body[8] for _, _, r in rows if (body := unstuffed(bytes.fromhex(r)[:-1]))[0] == REFUSED}
    assert codes == {1, 2, 3, 5, 6}


class TestGuard:
    def guarded(self, at: BoardAtPty) -> int:
        sequence = woken(at)
        one(at, SET, sequence, target(0, 100, 400) + target(1, 4000, 304))
        assert counts(at, 1) == 400
        found = one(at, GUARD, sequence + 1, guard(500, {0: 50.0, 1: 40.0, 2: 50.0}, [[350, 300, 9], [340, 300, 9]]))
        assert found[0] == 0xA1 and found[3] == GUARDED
        return sequence + 2

    def test_beats_keep_it_quiet(self, at: BoardAtPty) -> None:
        sequence = self.guarded(at)
        for step in range(20):
            at.run(0.4)
            assert one(at, BEAT, (sequence + step) % 256)[3] == GUARDED
        assert counts(at, 0) == 300

    def test_any_whole_frame_is_a_beat_and_a_damaged_one_is_none(self, at: BoardAtPty) -> None:
        sequence = self.guarded(at)
        at.run(0.4)
        at.ask(frame(BEAT, (sequence - 5) % 256))  # late, and so without an answer
        at.run(0.4)
        assert counts(at, 0) == 300
        at.ask(frame(BEAT, sequence)[:-2] + b"\x01\0")
        at.run(0.2)
        assert one(at, BEAT, sequence)[3] & TOOK_OVER

    def test_it_drives_in_proportion_no_faster_than_told_and_keeps_on(self, at: BoardAtPty) -> None:
        self.guarded(at)
        at.run(0.499)
        assert counts(at, 0) == 300
        seen = []
        for _ in range(400):
            at.run(0.01)
            seen.append((at.now, counts(at, 0), counts(at, 1)))
        _, first, second = np.array(seen).T
        # 100 counts at 40 a second take 2.5 s; the 50 of the other arrive with them.
        leg = slice(0, int(np.argmax(first == 350)))
        assert np.abs((first - 300) / 50 - (second - 400) / -100)[leg].max() < 0.03
        for values, rate in ((first, 50), (second, 40)):
            assert np.abs(values[25:] - values[:-25]).max() <= rate * 0.25 + 1
        assert first.max() == 350 and (first[-1], second[-1]) == (340, 300)
        assert at.chip.read(ADDRESS, 6, 2) == struct.pack("<H", 100)
        assert at.chip.read(ADDRESS, 10, 2) == struct.pack("<H", 4000)

    def test_a_channel_without_pulses_stays_without(self, at: BoardAtPty) -> None:
        self.guarded(at)
        at.run(10.0)
        assert at.chip.pulse_s(2) is None

    def test_while_it_drives_writes_are_refused_until_the_host_takes_over(self, at: BoardAtPty) -> None:
        sequence = self.guarded(at)
        at.run(1.5)
        assert one(at, SET, sequence, target(0, 0, 300))[4] == bytes([SET, 5, 0])
        assert one(at, WRITE, sequence + 1, bytes([ADDRESS, 0, 0x21]))[4] == bytes([WRITE, 5, 0])
        assert one(at, READ, sequence + 2, bytes([ADDRESS, 0, 1]))[3] & TOOK_OVER
        stood = counts(at, 0)
        assert one(at, TAKE, sequence + 3, struct.pack("<I", 7))[3] == GUARDED
        at.run(0.4)
        assert counts(at, 0) == stood, "it stops where it stands"
        assert one(at, SET, sequence + 4, target(0, 0, 300))[0] == 0x92
        at.run(5.0)
        assert one(at, BEAT, sequence + 5)[3] == GUARDED | TOOK_OVER, "it watches on"

    def test_no_channels_clear_it(self, at: BoardAtPty) -> None:
        sequence = self.guarded(at)
        assert one(at, GUARD, sequence, guard(500, {}, []))[3] == 0
        at.run(5.0)
        assert counts(at, 0) == 300

    def test_a_guard_that_comes_while_it_drives_is_for_the_next_time(self, at: BoardAtPty) -> None:
        sequence = self.guarded(at)
        at.run(1.0)
        assert one(at, GUARD, sequence, guard(500, {0: 50.0}, [[100]]))[3] == GUARDED | TOOK_OVER
        at.run(10.0)
        assert (counts(at, 0), counts(at, 1)) == (340, 300), "it ends the drive that it began"
        one(at, TAKE, sequence + 1, struct.pack("<I", 7))
        at.run(10.0)
        assert (counts(at, 0), counts(at, 1)) == (100, 300)

    def test_a_guard_that_is_cleared_while_it_drives_ends_no_drive(self, at: BoardAtPty) -> None:
        sequence = self.guarded(at)
        at.run(1.0)
        assert one(at, GUARD, sequence, guard(500, {}, []))[3] == TOOK_OVER
        at.run(10.0)
        assert (counts(at, 0), counts(at, 1)) == (340, 300)
        one(at, TAKE, sequence + 1, struct.pack("<I", 7))
        at.run(10.0)
        assert one(at, BEAT, sequence + 2)[3] == 0

    def test_after_a_takeover_the_next_drive_begins_at_the_first_waypoint(self, at: BoardAtPty) -> None:
        sequence = self.guarded(at)
        at.run(10.0)
        assert counts(at, 0) == 340
        one(at, TAKE, sequence, struct.pack("<I", 7))
        seen = []
        for _ in range(100):
            at.run(0.02)
            seen.append(counts(at, 0))
        assert max(seen) == 350 and seen[-1] == 340

    def test_a_bus_that_is_stuck_on_the_way_makes_the_drive_no_faster(self, at: BoardAtPty) -> None:
        self.guarded(at)
        at.run(1.0)
        at.bus.hold_down(1.0)
        seen = []
        for _ in range(400):
            at.run(0.01)
            if not at.bus.stuck:
                seen.append(counts(at, 1))
        assert max(abs(b - a) for a, b in pairwise(seen)) <= 2, "40 counts a second at most"
        assert seen[-1] == 300

    def test_a_stuck_bus_delays_the_drive_and_does_not_end_it(self, at: BoardAtPty) -> None:
        self.guarded(at)
        at.now += 0.4
        at.bus.hold_down(0.6)
        at.run(20.0)
        assert counts(at, 0) == 340


class TestLine:
    def test_a_dropped_request_is_not_done_and_one_retried_is_done_once(self, at: BoardAtPty) -> None:
        at.line.to_board.plan("drop", 1)
        assert at.ask(frame(WRITE, 1, bytes([ADDRESS, 0xFE, 99]))) == b""
        assert len(frames(at.ask(frame(WRITE, 1, bytes([ADDRESS, 0xFE, 99]))))) == 1

    def test_a_doubled_request_is_done_once_and_answered_twice(self, at: BoardAtPty) -> None:
        at.line.to_board.plan("duplicate", 1)
        assert len(frames(at.ask(frame(BEAT, 1)))) == 2

    def test_swapped_requests_arrive_the_other_way_round_and_the_old_one_is_dropped(self, at: BoardAtPty) -> None:
        at.ask(frame(BEAT, 1))
        at.line.to_board.plan("reorder", 1)
        found = at.ask(frame(WRITE, 2, bytes([ADDRESS, 0xFE, 99])) + frame(BEAT, 3))
        assert [reply[1] for reply in frames(found)] == [3]
        assert at.chip.read(ADDRESS, 0xFE, 1) == b"\x1e"

    def test_a_flipped_bit_makes_no_frame(self, at: BoardAtPty) -> None:
        for sequence in range(1, 60):
            at.line.to_board.plan("flip", 1)
            at.ask(frame(WRITE, sequence, bytes([ADDRESS, 0xFE, 99])))
            at.ask(b"\0")  # ends what a flipped delimiter left open
        assert at.chip.read(ADDRESS, 0xFE, 1) == b"\x1e"

    def test_split_frames_arrive_whole_and_later_ones_are_left_alone(self, at: BoardAtPty) -> None:
        at.line.to_board.plan("split", 2, after=1)
        at.line.to_host.plan("split", 1)
        assert [reply[1] for reply in frames(at.ask(b"".join(frame(BEAT, s) for s in range(1, 6))))] == [1, 2, 3, 4, 5]

    def test_bytes_can_be_lost_on_the_way_to_the_host(self, at: BoardAtPty) -> None:
        whole = at.ask(frame(BEAT, 1))
        at.line.to_host.plan("drop", 3, after=2, frames=False)
        assert at.ask(frame(BEAT, 1)) == whole[:2] + whole[5:]

    def test_an_unplugged_port_hangs_up_and_comes_back_under_another_name(self, at: BoardAtPty) -> None:
        before = at.path.readlink()
        at.line.unplug()
        with pytest.raises(OSError):
            at.ask(frame(BEAT, 1))
        assert not at.path.exists()
        at.line.plug_in()
        assert at.path.exists() and at.path.readlink() != before


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=400))
def test_no_bytes_upset_it(data: bytes) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder, board_at_pty(Path(folder) / "board", framed) as at:
        at.ask(data)
        assert frames(at.ask(b"\0" + frame(HELLO, 3, b"\x01")))[-1][:2] == (0x81, 3)
