"""The framed protocol's codec against a naive one: nothing is accepted that is not whole, and nothing raises."""

from __future__ import annotations

import binascii
import contextlib

import numpy as np
import pytest
from armcal.devices import framed
from armcal.devices.framed import MAX_PAYLOAD, Frame, FrameDecoder, cobs_decoded, cobs_encoded, encoded
from hypothesis import given
from hypothesis import strategies as st

from tests.simulated_lines import framed_messages as board


def naive_encoded(data: bytes) -> bytes:
    """Byte by byte, from the definition."""
    out, block = bytearray(), bytearray()
    full = False
    for byte in data:
        full = False
        if byte:
            block.append(byte)
            if len(block) == 254:
                out += bytes([255]) + block
                block.clear()
                full = True
        else:
            out += bytes([len(block) + 1]) + block
            block.clear()
    return bytes(out) if full else bytes(out + bytes([len(block) + 1]) + block)


def naive_decoded(data: bytes) -> bytes | None:
    out, left, code = bytearray(), 0, 255
    for byte in data:
        if byte == 0:
            return None
        if left == 0:
            if code != 255:
                out.append(0)
            code, left = byte, byte - 1
        else:
            out.append(byte)
            left -= 1
    return bytes(out) if data and left == 0 else None


def naive_frames(stream: bytes) -> list[Frame]:
    """Every frame of a whole stream that is as it should be."""
    found = []
    for piece in stream.split(b"\0")[:-1]:
        body = naive_decoded(piece)
        if body is None or not 6 <= len(body) <= 246:
            continue
        content, check = body[:-4], body[-4:]
        if binascii.crc32(content) == sum(byte << 8 * i for i, byte in enumerate(check)):
            found.append(Frame(content[0], content[1], content[2:]))
    return found


@given(st.binary(max_size=1100))
def test_cobs_is_the_naive_one(data):
    stuffed = cobs_encoded(data)
    assert 0 not in stuffed
    assert stuffed == naive_encoded(data)
    assert cobs_decoded(stuffed) == naive_decoded(stuffed) == data
    assert cobs_decoded(data) == naive_decoded(data)


@pytest.mark.parametrize("length", [0, 1, 253, 254, 255, 507, 508, 509])
@pytest.mark.parametrize("tail", [b"", b"\0", b"\0\0", b"x"])
def test_cobs_at_the_length_of_its_blocks(length, tail):
    data = b"a" * length + tail
    assert cobs_encoded(data) == naive_encoded(data)
    assert cobs_decoded(cobs_encoded(data)) == data


@given(st.integers(0, 255), st.integers(0, 255), st.binary(max_size=MAX_PAYLOAD), st.integers(1, 50))
def test_frames_survive_in_pieces_of_any_size(kind, sequence, payload, size):
    frame = Frame(kind, sequence, payload)
    stream = encoded(frame) * 3
    decoder = FrameDecoder()
    found = [f for i in range(0, len(stream), size) for f in decoder.feed(stream[i : i + size])]
    assert found == [frame] * 3 and decoder.dropped == 0


def test_a_payload_too_long_is_refused():
    with pytest.raises(ValueError, match="241"):
        encoded(Frame(1, 1, bytes(241)))


def hard_stream(frames: int, seed: int) -> bytes:
    """Frames that are whole, frames with a flipped bit, cut frames, doubled ones, and noise between them."""
    random = np.random.default_rng(seed)
    parts: list[bytes] = []
    for _ in range(frames):
        payload = random.bytes(int(random.integers(0, 40)))
        if random.random() < 0.3:
            payload = bytes(len(payload))
        frame = encoded(Frame(int(random.integers(256)), int(random.integers(256)), payload))
        what = random.random()
        if what < 0.3:
            harmed = bytearray(frame)
            harmed[int(random.integers(len(frame)))] ^= 1 << int(random.integers(8))
            frame = bytes(harmed)
        elif what < 0.4:
            frame = frame[: int(random.integers(len(frame)))]
        elif what < 0.5:
            frame = random.bytes(int(random.integers(1, 400)))
        elif what < 0.55:
            frame = frame * 2
        parts.append(frame)
    return b"".join(parts)


def agrees_with_the_naive_one(frames: int, seed: int) -> None:
    stream = hard_stream(frames, seed)
    random = np.random.default_rng(seed + 1)
    decoder, found, at = FrameDecoder(), [], 0
    while at < len(stream):
        step = int(random.integers(1, 3000))
        found += decoder.feed(stream[at : at + step])
        at += step
    assert found == naive_frames(stream)
    assert len(found) > 0.4 * frames and decoder.dropped > 0.2 * frames


@pytest.mark.slow
def test_nothing_harmed_is_accepted():
    agrees_with_the_naive_one(20_000, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_nothing_harmed_is_accepted_of_a_million(seed):
    agrees_with_the_naive_one(100_000, 100 + seed)


def test_a_line_that_never_ends_takes_no_memory():
    decoder = FrameDecoder()
    for _ in range(1000):
        assert decoder.feed(b"x" * 4096) == []
    assert len(decoder._rest) < 1000
    assert decoder.feed(b"\0" + encoded(Frame(1, 2))) == [Frame(1, 2)]
    assert decoder.dropped == 1


# ---------------------------------------------------------------- messages

u8, u16, u32 = st.integers(0, 255), st.integers(0, 0xFFFF), st.integers(0, 0xFFFFFFFF)


@given(st.lists(st.tuples(u8, u8, u16, u16), min_size=1, max_size=40))
def test_targets_arrive_at_a_board(rows):
    targets = tuple(board.ChannelTarget(*row) for row in rows)
    assert board.Set.read(framed.set_payload(targets)).targets == targets


@given(st.data(), u16, st.integers(0, 6))
def test_a_guard_arrives_at_a_board(data, after_ms, n):
    channels = tuple(board.GuardedChannel(*data.draw(st.tuples(u8, u8, u16))) for _ in range(n))
    waypoints = tuple(data.draw(st.lists(st.tuples(*[u16] * n), max_size=5)))
    assert board.Guard.read(framed.guard_payload(after_ms, channels, waypoints)) == board.Guard(
        after_ms, channels, waypoints
    )


@given(u32, st.integers(0, 7), st.tuples(u8, u8, u8), u8, u32, st.text(max_size=20), st.text(max_size=20))
def test_replies_of_a_board_arrive(boots, flags, refused, version, oscillator, board_id, firmware):
    for content in (board.Refusal(*refused).pack(), board.HelloReply(version, oscillator, board_id, firmware).pack()):
        reply = framed.read_reply(board.Head(boots, framed.Flag(flags)).pack() + content)
        assert reply == (boots, framed.Flag(flags), content)
    assert framed.read_refusal(board.Refusal(*refused).pack()) == refused[1:]
    assert framed.read_greeting(content) == (version, oscillator, board_id, firmware)


@given(st.binary(max_size=60))
def test_payloads_that_are_none_are_refused_and_nothing_else(payload):
    requests = (board.Hello.read, board.Take.read, board.Write.read, board.Read.read, board.Set.read, board.Guard.read)
    for read in (*requests, framed.read_refusal, framed.read_reply, framed.read_greeting):
        with contextlib.suppress(ValueError):
            read(payload)


def test_bytes_on_the_wire_are_those_of_the_specification():
    """Written out by hand from docs/link_protocol.md."""
    assert framed.set_payload((board.ChannelTarget(0x40, 3, 0x300, 0x1000),)) == bytes.fromhex("40 03 0003 0010")
    guard = framed.guard_payload(1000, (board.GuardedChannel(0x40, 0, 0x1234),), ((315,), (400,)))
    assert guard == bytes.fromhex("e803 01 40 00 3412 02 3b01 9001")
    assert board.Take.read(bytes.fromhex("02010000")) == board.Take(258)
    body = bytes.fromhex("20 07")
    crc = binascii.crc32(body).to_bytes(4, "little")
    assert encoded(Frame(0x20, 7)) == naive_encoded(body + crc) + b"\0"
