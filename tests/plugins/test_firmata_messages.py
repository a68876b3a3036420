"""The Firmata decoder against a naive one, byte by byte: nothing raises, nothing is made up."""

from __future__ import annotations

import numpy as np
import pytest
from armcal_pca9685 import firmata_messages as firmata
from armcal_pca9685.firmata_messages import FirmataDecoder, Message
from hypothesis import given
from hypothesis import strategies as st


def naive_messages(stream: bytes) -> list[Message]:
    """A state machine: a status byte begins a message, another one than was due ends it."""
    found, status, data = [], None, bytearray()
    for byte in stream:
        if byte == 0xF7 and status == 0xF0:
            if 1 <= len(data) <= 1024:
                found.append(Message(data[0], bytes(data[1:])))
            status = None
        elif byte >= 0x80:
            status, data = (byte if byte in (0xF0, 0xF9) or byte < 0xF0 else None), bytearray()
        elif status is not None:
            data.append(byte)
            if status != 0xF0 and len(data) == 2:
                if status == 0xF9:
                    found.append(Message(0xF9, bytes(data)))
                status = None
    return found


def stream_of(messages: int, seed: int) -> bytes:
    random = np.random.default_rng(seed)
    parts: list[bytes] = []
    for _ in range(messages):
        what = random.random()
        data = bytes(random.integers(0, 128, int(random.integers(0, 40)), dtype=np.uint8))
        if what < 0.4:
            part = b"\xf0\x77" + data + b"\xf7"
        elif what < 0.5:
            part = b"\xf9\x02\x05"
        elif what < 0.6:
            part = bytes((int(random.integers(0x80, 0xF0)), *data[:2]))
        elif what < 0.7:
            part = random.bytes(int(random.integers(1, 60)))
        elif what < 0.8:
            part = b"\xf0" + data
        else:
            harmed = bytearray(b"\xf0\x77" + data + b"\xf7")
            harmed[int(random.integers(len(harmed)))] ^= 1 << int(random.integers(8))
            part = bytes(harmed)
        parts.append(part)
    return b"".join(parts)


def agrees_with_the_naive_one(messages: int, seed: int) -> None:
    stream = stream_of(messages, seed)
    random = np.random.default_rng(seed + 1)
    decoder, found, at = FirmataDecoder(), [], 0
    while at < len(stream):
        step = int(random.integers(1, 3000))
        found += decoder.feed(stream[at : at + step])
        at += step
    assert found == naive_messages(stream)
    assert len(found) > 0.4 * messages and decoder.dropped > 0


@pytest.mark.slow
def test_nothing_is_made_up():
    agrees_with_the_naive_one(20_000, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_nothing_is_made_up_of_a_million(seed):
    agrees_with_the_naive_one(100_000, 100 + seed)


@given(st.lists(st.binary(max_size=30)))
def test_any_bytes_in_any_pieces(pieces):
    decoder = FirmataDecoder()
    found = [message for piece in pieces for message in decoder.feed(piece)]
    assert found == naive_messages(b"".join(pieces))


def test_a_message_that_never_ends_takes_no_memory():
    decoder = FirmataDecoder()
    for _ in range(500):
        assert decoder.feed(b"\xf0" + b"x" * 4096) == []
    assert len(decoder._rest) < 2000
    assert decoder.feed(b"\xf9\x02\x05") == [Message(0xF9, b"\x02\x05")]


@given(st.binary(max_size=100))
def test_pairs(data):
    assert firmata.unpaired(firmata.pairs(data)) == data
    assert all(byte < 0x80 for byte in firmata.pairs(data))


@given(st.binary(max_size=20))
def test_pairs_that_are_none(data):
    found = firmata.unpaired(data)
    if found is not None:
        assert firmata.pairs(found) == data or any(byte >= 0x80 for byte in data)
    firmata.i2c_reply(data)
    firmata.text_of(data)


def test_requests_are_those_of_the_protocol():
    """Written out by hand from the protocol's description."""
    assert firmata.i2c_config() == bytes.fromhex("f0 78 00 00 f7")
    assert firmata.i2c_write(0x40, bytes((0x06, 0xFF))) == bytes.fromhex("f0 76 40 00 06 00 7f 01 f7")
    assert firmata.i2c_read(0x40, 0xFE, 1) == bytes.fromhex("f0 76 40 08 7e 01 01 00 f7")
    assert firmata.i2c_reply(bytes.fromhex("40 00 7e 01 79 00")) == (0x40, 0xFE, b"\x79")
    assert firmata.i2c_reply(bytes.fromhex("40 00 7e 02")) is None
