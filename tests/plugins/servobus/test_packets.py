"""Packets against the makers' published examples, and properties of them."""

from __future__ import annotations

import pytest
from armcal_servobus.bus import FRAMINGS, MAPS, Instruction, Register
from hypothesis import given
from hypothesis import strategies as st

FEETECH, SECOND = FRAMINGS["feetech"], FRAMINGS["dynamixel2"]
PUBLISHED = {
    # Dynamixel protocol 2.0: ping of id 1; ping of all; read of the present position (132, 4 bytes) of id 1;
    # write of the goal position (116) 512 to id 1; sync read of positions of ids 1 and 2.
    "ping": (SECOND.encoded(1, Instruction.PING), "FF FF FD 00 01 03 00 01 19 4E"),
    "ping all": (SECOND.encoded(0xFE, Instruction.PING), "FF FF FD 00 FE 03 00 01 31 42"),
    "read": (SECOND.encoded(1, Instruction.READ, SECOND.numbers(132, 4)), "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    "write": (
        SECOND.encoded(1, Instruction.WRITE, SECOND.numbers(116) + (512).to_bytes(4, "little")),
        "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89",
    ),
    "sync read": (
        SECOND.encoded(0xFE, Instruction.SYNC_READ, SECOND.numbers(132, 4) + bytes((1, 2))),
        "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
    ),
    # Feetech's protocol, whose ping is that of Dynamixel's first: ping of id 1; read of its position (56, 2 bytes).
    "feetech ping": (FEETECH.encoded(1, Instruction.PING), "FF FF 01 02 01 FB"),
    "feetech read": (
        FEETECH.encoded(1, Instruction.READ, FEETECH.numbers(56, 2)),
        "FF FF 01 04 02 38 02 BE",
    ),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_instructions_are_the_published_ones(name):
    packet, published = PUBLISHED[name]
    assert packet == bytes.fromhex(published)


def test_answers_are_read_as_published():
    (ping,) = SECOND.received(bytes.fromhex("FF FF FD 00 01 07 00 55 00 06 04 26 65 5D")).answers
    assert (ping.id, ping.alarm, ping.refusal) == (1, 0, "") and ping.data == bytes((6, 4, 38))
    (read,) = SECOND.received(bytes.fromhex("FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0")).answers
    assert int.from_bytes(read.data, "little") == 166
    (old,) = FEETECH.received(bytes.fromhex("FF FF 01 03 00 20 DB")).answers
    assert old.data == bytes((32,))


def test_what_a_servo_says_is_wrong_with_it_and_with_what_it_was_asked():
    body = b"\xff\xff" + bytes((1, 2, 0x24))
    (old,) = FEETECH.received(body + FEETECH.check(body)).answers
    assert MAPS["feetech"].words(old.alarm) == ("overheating", "overload") and not old.refusal
    packet = b"\xff\xff\xfd\0\x01\x04\0\x55\x87"
    (new,) = SECOND.received(packet + SECOND.check(packet)).answers
    assert new.alarm and "read-only" in new.refusal
    assert MAPS["feetech"].words(0x21) == ("voltage", "overload")
    assert MAPS["feetech"].words(0x40) == ("alarm 0x40",)


def answer(protocol: str, servo: int, data: bytes) -> bytes:
    if protocol == "dynamixel2":
        body = (b"\x55\0" + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        packet = b"\xff\xff\xfd\0" + bytes((servo,)) + (len(body) + 2).to_bytes(2, "little") + body
        return packet + SECOND.check(packet)
    packet = b"\xff\xff" + bytes((servo, len(data) + 2, 0)) + data
    return packet + FEETECH.check(packet)


PROTOCOLS = st.sampled_from(sorted(FRAMINGS))
DATA = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x01, 0x55]), max_size=12).map(bytes) | st.binary(max_size=20)


@given(PROTOCOLS, st.integers(0, 252), DATA, st.integers(0, 40))
def test_an_answer_is_read_in_whatever_pieces_it_comes(protocol, servo, data, cut):
    framing, packet = FRAMINGS[protocol], answer(protocol, servo, data)
    first = framing.received(packet[:cut])
    last = framing.received(first.rest + packet[cut:])
    answers = (*first.answers, *last.answers)
    assert [(a.id, a.data) for a in answers] == [(servo, data)]
    assert first.damaged + last.damaged == 0 and last.rest == b""


@given(PROTOCOLS, st.integers(0, 252), DATA, st.integers(0, 1000), st.integers(0, 7))
def test_an_answer_with_a_wrong_bit_is_not_taken(protocol, servo, data, at, bit):
    packet = bytearray(answer(protocol, servo, data))
    packet[at % len(packet)] ^= 1 << bit
    received = FRAMINGS[protocol].received(bytes(packet))
    assert not [a for a in received.answers if a.data == data and a.id == servo and not a.alarm and not a.refusal]


@given(PROTOCOLS, st.binary(max_size=300))
def test_noise_is_borne(protocol, noise):
    received = FRAMINGS[protocol].received(noise)
    assert len(received.rest) <= len(noise)


def test_good_answers_are_found_between_damaged_ones():
    for protocol, framing in FRAMINGS.items():
        good = answer(protocol, 3, b"\x12\x34")
        bad = bytearray(answer(protocol, 4, b"\x12\x34"))
        bad[-1] ^= 1
        received = framing.received(b"\x00\xff" + bytes(bad) + good)
        assert [a.id for a in received.answers] == [3] and received.damaged == 1


@given(st.integers(-2047, 2047))
def test_sign_and_magnitude(value):
    offset = MAPS["feetech"].registers["offset"]
    packed = offset.pack(value)
    assert offset.unpack(packed) == value
    assert int.from_bytes(packed, "little") == (abs(value) | (0x800 if value < 0 else 0))


@pytest.mark.parametrize(
    ("register", "value"),
    [
        (MAPS["feetech"].registers["offset"], 2048),
        (MAPS["feetech"].registers["offset"], -2048),
        (Register(0), 256),
        (Register(0, 2), -1),
        (MAPS["dynamixel2"].registers["goal"], 1 << 31),
    ],
)
def test_what_does_not_fit_a_register_is_refused(register, value):
    with pytest.raises(ValueError, match="expected"):
        register.pack(value)
