"""Datagrams: a JSON object in each, acknowledged to its sender once it is safe."""

from __future__ import annotations

import contextlib
import json
import select
import socket
import time
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

from armcal.errors import InputError, Location
from armcal.online.sources.incoming import Incoming, Place
from armcal.online.sources.row_parser import RowParser, faulty
from armcal.online.sources.source import Clock

MAX_DATAGRAM_BYTES = 16 * 1024
LOOPBACK = "127.0.0.1"

_WAITING = 64
"""So many senders are remembered until their records are acknowledged; there is one unless a disk is full."""


class Udp:
    """A socket on a port; what it did not take before the record was lost has to be sent again by its sender.

    The reply is ``{"acknowledged": sequence, "id": id}``, with a ``fault`` where the record could not be read.

    Raises:
        InputError: the port cannot be had.
    """

    keeps_records = False

    def __init__(self, host: str, port: int, rows: RowParser, clock: Clock = time.time) -> None:
        self._rows = rows
        self._clock = clock
        self._row = 0
        self._senders: OrderedDict[int, Any] = OrderedDict()
        self._socket = bound(host, port)
        self._open = True

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        found = self._socket.getsockname()
        return str(found[0]), int(found[1])

    @property
    def ended(self) -> bool:
        """See ``Source``."""
        return not self._open

    def resume(self, positions: Mapping[str, int]) -> None:
        """See ``Source``: datagrams have no positions."""

    def incoming(self, wait_s: float) -> Incoming | None:
        """See ``Source``."""
        if not self._open or not select.select([self._socket], [], [], max(wait_s, 0.0))[0]:
            return None
        try:
            data, _, flags, sender = self._socket.recvmsg(MAX_DATAGRAM_BYTES + 1)
        except OSError:
            return None
        self._row += 1
        self._senders[self._row] = sender
        while len(self._senders) > _WAITING:
            self._senders.popitem(last=False)
        place = Place(self._clock(), "", self._row)
        if flags & socket.MSG_TRUNC or len(data) > MAX_DATAGRAM_BYTES:
            return faulty(place, f"The datagram has more than {MAX_DATAGRAM_BYTES // 1024} KiB.")
        try:
            return self._rows.json_text(data.decode("utf-8-sig"), place)
        except UnicodeDecodeError as fault:
            return faulty(place, f"The datagram holds the byte 0x{data[fault.start]:02x}, which is not UTF-8 text.")

    def acknowledge(self, incoming: Incoming, sequence: int) -> None:
        """See ``Source``."""
        sender = self._senders.pop(incoming.source_row, None)
        if sender is None or not self._open:
            return
        reply = {"acknowledged": sequence, "id": incoming.record_id}
        if incoming.fault:
            reply["fault"] = incoming.fault
        with contextlib.suppress(OSError):
            self._socket.sendto(json.dumps(reply).encode(), socket.MSG_DONTWAIT, sender)

    def close(self) -> None:
        """See ``Source``."""
        self._open = False
        self._socket.close()


def bound(host: str, port: int) -> socket.socket:
    """A socket that does not block.

    Raises:
        InputError: the port cannot be had.
    """
    where = Location(f"udp:{host}:{port}")
    try:
        kind, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE)[0]
        found = socket.socket(kind, socket.SOCK_DGRAM)
        try:
            found.bind(address)
        except OSError:
            found.close()
            raise
    except (OSError, UnicodeError) as fault:
        hint = "Give a free port, and an address of this machine."
        raise InputError(f"the socket cannot be had ({fault}).", where=where, hint=hint) from fault
    found.setblocking(False)
    return found
