"""Lines of text as they come, by standard input or in datagrams to a UDP port of this machine.

Datagrams of other machines come by socat or SSH.
A source never waits. Its ``lines`` are all that are complete since the last call, without their ends; None stands for
one that was too long. ``ended`` says whether nothing more will come, and ``close`` may be called twice.
"""

import os
import re
import select
import socket
import sys
from collections.abc import Mapping
from typing import Annotated

from pydantic import BeforeValidator

from armcal.devices.device import DeviceRefusedError
from armcal.errors import Location
from armcal.io.lines import LineCutter

STANDARD_INPUT = "-"
LOOPBACK = "127.0.0.1"
KINDS = "- (standard input) or udp:PORT of this machine"

LONGEST_LINE_BYTES = 64 * 1024
_CHUNK = 1 << 20
_MOST_AT_ONCE = 16  # chunks, or thousands of datagrams, that are taken at once; the rest waits
_BUFFER_BYTES = 4 << 20


def _port_of(text: str) -> int | None:
    match = re.fullmatch("udp:([0-9]{1,5})", text)
    return None if match is None or int(match[1]) > 65535 else int(match[1])


def _named(value: object) -> object:
    if isinstance(value, str) and value != STANDARD_INPUT and _port_of(value) is None:
        raise ValueError(f"found {str(value)!r}, expected {KINDS}: tail -F FILE gives the lines of a file that grows")
    return value


SourceName = Annotated[str, BeforeValidator(_named)]  # ``-`` or ``udp:PORT``


def open_lines(name: str) -> "LineSource":
    port = _port_of(name)
    return InputLines() if port is None else UdpLines(LOOPBACK, port)


def refused_lines_text(refused: Mapping[str, int]) -> str:
    """Why lines were passed over, the commonest reasons in words; empty if none was."""
    if not refused:
        return ""
    common = sorted(refused.items(), key=lambda entry: -entry[1])[:3]
    listed = "; ".join(f"{reason} ({count})" for reason, count in common)
    return f"{sum(refused.values())} lines were passed over: {listed}"


class InputLines:
    """Lines of standard input. A last line without an end is not trusted."""

    def __init__(self) -> None:
        self._cutter, self.ended = LineCutter(LONGEST_LINE_BYTES), False

    def lines(self) -> list[bytes | None]:
        lines: list[bytes | None] = []
        for _ in range(_MOST_AT_ONCE):
            if self.ended or not select.select([sys.stdin.fileno()], [], [], 0)[0]:
                break
            try:
                data = os.read(sys.stdin.fileno(), _CHUNK)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            self.ended = not data
            lines += self._cutter.feed(data)
        return lines

    def close(self) -> None:
        self.ended = True


class UdpLines:
    """Lines of datagrams on a port of this machine; what comes while nobody looks waits in the system's queue."""

    def __init__(self, host: str, port: int) -> None:
        try:
            self._socket = bound(host, port)
        except OSError as fault:
            where, hint = Location(f"udp:{host}:{port}"), "Give a free port, and an address of this machine."
            raise DeviceRefusedError(f"the socket cannot be opened ({fault}).", where=where, hint=hint) from fault
        self.ended = False

    @property
    def port(self) -> int:
        return int(self._socket.getsockname()[1])

    def lines(self) -> list[bytes]:
        lines: list[bytes] = []
        for _ in range(1000 * _MOST_AT_ONCE if not self.ended else 0):
            try:
                data = self._socket.recv(LONGEST_LINE_BYTES)  # more than a datagram holds
            except OSError:  # nothing is left, or the network is gone for now: both are silence
                break
            lines += data.split(b"\n")
        return lines

    def close(self) -> None:
        self.ended = True
        self._socket.close()


LineSource = InputLines | UdpLines


def bound(host: str, port: int) -> socket.socket:
    """A UDP socket that never waits and holds some seconds of datagrams; OSError where there can be none."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.bind((host, port))
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        opened.setblocking(False)
    except OSError:
        opened.close()
        raise
    return opened
