"""Datagrams: a JSON object in each, acknowledged to its sender once it is safe."""

from __future__ import annotations

import contextlib
import json
import select
import socket
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Any

from armcal.io.udp import MAX_DATAGRAM_BYTES, listening
from typing_extensions import override

from armcal_online.sources.incoming import Incoming, Place
from armcal_online.sources.row_parser import RowParser, faulty
from armcal_online.sources.source import Clock, Source

_WAITING = 64
"""So many senders are remembered until their records are acknowledged; there is one unless a disk is full."""


class Udp(Source):
    """A socket on a port; what it did not take before the record was lost has to be sent again by its sender.

    The reply is ``{"acknowledged": sequence, "id": id}``, with a ``fault`` where the record could not be read.
    ``senders`` are the addresses whose datagrams are records, or ``any``; those of this machine by default. Others get
    no reply; of the first of them there is a fault.

    Raises:
        InputError: the port cannot be opened, or other machines reach it and no sender is named.
    """

    keeps_records = False

    def __init__(
        self, host: str, port: int, rows: RowParser, clock: Clock = time.time, senders: Sequence[str] = ()
    ) -> None:
        self._rows = rows
        self._clock = clock
        self._row = 0
        self._senders: OrderedDict[int, Any] = OrderedDict()
        self._socket, self._is_ours = listening(host, port, senders)
        self._strange, self._open = False, True

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        found = self._socket.getsockname()
        return str(found[0]), int(found[1])

    @property
    @override
    def ended(self) -> bool:
        return not self._open

    @override
    def resume(self, positions: Mapping[str, int]) -> None:
        """Datagrams have no positions."""

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        if not self._open or not select.select([self._socket], [], [], max(wait_s, 0.0))[0]:
            return None
        try:
            data, _, flags, sender = self._socket.recvmsg(MAX_DATAGRAM_BYTES + 1)
        except OSError:
            return None
        if not self._is_ours(sender[0]):
            return self._stranger(sender[0])
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

    def _stranger(self, sender: str) -> Incoming | None:
        """A fault for the first datagram of a sender that is not named; whoever sends many fills no journal."""
        if self._strange:
            return None
        self._strange = True
        self._row += 1
        fault = f"A datagram came from {sender}, which is not named as a sender. Further ones are passed over unseen."
        return faulty(Place(self._clock(), "", self._row), fault)

    @override
    def acknowledge(self, incoming: Incoming, sequence: int) -> None:
        sender = self._senders.pop(incoming.source_row, None)
        if sender is None or not self._open:
            return
        reply = {"acknowledged": sequence, "id": incoming.record_id}
        if incoming.fault:
            reply["fault"] = incoming.fault
        with contextlib.suppress(OSError):
            self._socket.sendto(json.dumps(reply).encode(), socket.MSG_DONTWAIT, sender)

    @override
    def close(self) -> None:
        self._open = False
        self._socket.close()
