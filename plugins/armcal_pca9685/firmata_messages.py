"""Messages of the Firmata protocol: those of I2C and of a board's versions. [Firmata]"""

import re
from typing import NamedTuple

SYSEX, END, VERSION = 0xF0, 0xF7, 0xF9
STRING, I2C_REQUEST, I2C_REPLY, I2C_CONFIG, FIRMWARE = 0x71, 0x76, 0x77, 0x78, 0x79
WRITE, READ_ONCE = 0x00, 0x08

# up to 1024 bytes between the first and the last of a sysex: boards send far fewer
_MESSAGE = re.compile(rb"\xf0([\x00-\x7f]{1,1024})\xf7|\xf9([\x00-\x7f]{2})|[\x80-\xef][\x00-\x7f]{2}", re.DOTALL)
_UNFINISHED = re.compile(rb"(?:\xf0[\x00-\x7f]{0,1024}|[\x80-\xef\xf9][\x00-\x7f]?)\Z", re.DOTALL)


class Message(NamedTuple):
    """What a board sent: ``VERSION``, or the first byte of a sysex message, and its data as it came (7 bits each)."""

    kind: int
    data: bytes


class I2cReply(NamedTuple):
    """What was read."""

    address: int
    register: int
    data: bytes


class FirmataDecoder:
    """Cuts a stream of bytes into messages; bytes between them are counted and dropped.

    Attributes:
        dropped: how many bytes were. Readings of pins are well formed, and passed over without being counted.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """The messages that these bytes complete."""
        text = self._rest + data
        messages: list[Message] = []
        end = 0
        for match in _MESSAGE.finditer(text):
            self.dropped += match.start() - end
            end = match.end()
            if match[1] is not None:
                messages.append(Message(match[1][0], match[1][1:]))
            elif match[2] is not None:
                messages.append(Message(VERSION, match[2]))
        tail = _UNFINISHED.search(text, end)
        begin = tail.start() if tail else len(text)
        self.dropped += begin - end
        self._rest = text[begin:]
        return messages

    def forget(self) -> None:
        self._rest = b""


def pairs(data: bytes) -> bytes:
    """Bytes as 7 bits and 1 bit each."""
    return bytes(part for byte in data for part in (byte & 0x7F, byte >> 7))


def unpaired(data: bytes) -> bytes | None:
    """The bytes of such pairs; None if they are none."""
    low, high = data[0::2], data[1::2]
    if len(low) != len(high) or any(byte > 1 for byte in high):
        return None
    return bytes(a | b << 7 for a, b in zip(low, high, strict=True))


def i2c_config() -> bytes:
    """Switch I2C on, without a pause between writing a register's number and reading."""
    return bytes((SYSEX, I2C_CONFIG, 0, 0, END))


def i2c_write(address: int, data: bytes) -> bytes:
    return bytes((SYSEX, I2C_REQUEST, address, WRITE)) + pairs(data) + bytes((END,))


def i2c_read(address: int, register: int, count: int) -> bytes:
    return bytes((SYSEX, I2C_REQUEST, address, READ_ONCE)) + pairs(bytes((register, count))) + bytes((END,))


def i2c_reply(data: bytes) -> I2cReply | None:
    """What an ``I2C_REPLY`` holds; None if it is garbled."""
    reply = unpaired(data)
    return None if reply is None or len(reply) < 2 else I2cReply(reply[0], reply[1], reply[2:])


def text_of(data: bytes) -> str:
    return (unpaired(data) or b"").decode(errors="replace")


QUERY_VERSIONS = bytes((VERSION, SYSEX, FIRMWARE, END))
"""Ask for the protocol's version and the firmware's name."""
