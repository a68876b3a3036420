"""Streams: a record a line from standard input or another pipe, or a JSON object in each datagram."""

import contextlib
import json
import os
import select
import socket
import time
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

from armcal.io.udp import MAX_DATAGRAM_BYTES, listening
from typing_extensions import override

from armcal_online.sources.row_parser import LineParser, LineReading, RowParser, faulty
from armcal_online.sources.source import Incoming, Place, Source

_WAITING = 64  # so many senders are remembered until their records are acknowledged; there is one unless a disk is full


class Lines(Source):
    """JSON or CSV lines from a descriptor, which stays the caller's. A last line without an end is not trusted."""

    keeps_records, ended = False, False

    def __init__(self, descriptor: int, rows: RowParser) -> None:
        self._descriptor = descriptor
        self._reading = LineReading(self._read, LineParser(rows, "either", "standard input"))
        self._is_at_end = False

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        deadline = time.monotonic() + wait_s
        while not self.ended:
            incoming = self._reading.next()
            if incoming is not None:
                return incoming
            if self._is_at_end:
                self.ended = True
                return self._reading.cut_short()
            if not select.select([self._descriptor], [], [], max(deadline - time.monotonic(), 0.0))[0]:
                return None
        return None

    @override
    def close(self) -> None:
        self.ended = True

    def _read(self, count: int) -> bytes | None:
        if not select.select([self._descriptor], [], [], 0.0)[0]:
            return None
        try:
            data = os.read(self._descriptor, count)
        except OSError:
            data = b""
        self._is_at_end = not data
        return data


class Udp(Source):
    """A JSON object in each datagram; a record that was not acknowledged has to be sent again by its sender.

    The reply is ``{"acknowledged": sequence, "id": id}``, with a ``fault`` where the record could not be read.
    ``senders`` are the addresses whose datagrams are records, or ``any``; those of this machine by default. Others get
    no reply; of the first of them there is a fault.

    Raises:
        InputError: the port cannot be opened, or other machines reach it and no sender is named.
    """

    keeps_records, ended = False, False

    def __init__(self, host: str, port: int, rows: RowParser, senders: Sequence[str] = ()) -> None:
        self._rows, self._row = rows, 0
        self._senders: OrderedDict[int, Any] = OrderedDict()
        self._socket, self._is_ours = listening(host, port, senders)
        self._stranger_reported = False

    @property
    def address(self) -> tuple[str, int]:
        host, port, *_ = self._socket.getsockname()
        return str(host), int(port)

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        if self.ended or not select.select([self._socket], [], [], max(wait_s, 0.0))[0]:
            return None
        try:
            data, _, flags, sender = self._socket.recvmsg(MAX_DATAGRAM_BYTES + 1)
        except OSError:
            return None
        if not self._is_ours(sender[0]):
            if self._stranger_reported:
                return None  # one that sends many must not fill the journal
            self._stranger_reported = True
            self._row += 1
            text = f"A datagram came from {sender[0]}, which is not named as a sender. Further ones are passed over."
            return faulty(Place("", self._row), text)
        self._row += 1
        self._senders[self._row] = sender
        while len(self._senders) > _WAITING:
            self._senders.popitem(last=False)
        place = Place("", self._row)
        if flags & socket.MSG_TRUNC or len(data) > MAX_DATAGRAM_BYTES:
            return faulty(place, f"The datagram has more than {MAX_DATAGRAM_BYTES // 1024} KiB.")
        try:
            return self._rows.json_text(data.decode("utf-8-sig"), place)
        except UnicodeDecodeError as fault:
            return faulty(place, f"The datagram holds the byte 0x{data[fault.start]:02x}, which is not UTF-8 text.")

    @override
    def acknowledge(self, incoming: Incoming, sequence: int) -> None:
        sender = self._senders.pop(incoming.source_row, None)
        if sender is None or self.ended:
            return
        reply = {"acknowledged": sequence, "id": incoming.record_id}
        if incoming.fault:
            reply["fault"] = incoming.fault
        with contextlib.suppress(OSError):
            self._socket.sendto(json.dumps(reply).encode(), socket.MSG_DONTWAIT, sender)

    @override
    def close(self) -> None:
        self.ended = True
        self._socket.close()
