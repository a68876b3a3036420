"""Datagrams: a JSON object in each, acknowledged to its sender once it is safe."""

from __future__ import annotations

import contextlib
import json
import re
import select
import socket
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any

from armcal.errors import InputError, Location
from armcal.online.sources.incoming import Incoming, Place
from armcal.online.sources.row_parser import RowParser, faulty
from armcal.online.sources.source import Clock

MAX_DATAGRAM_BYTES = 16 * 1024
LOOPBACK = "127.0.0.1"
ANYBODY = "any"
UDP_KINDS = "udp:PORT, udp:HOST:PORT?from=SENDER"
_NAME = re.compile(
    r"udp:(?:(?P<host>[^:\[\]]+|\[[0-9a-fA-F:.]+\]):)?(?P<port>[0-9]{1,5})"
    r"(?:\?from=(?P<senders>[^,\s]+(?:,[^,\s]+)*))?"
)

_WAITING = 64
"""So many senders are remembered until their records are acknowledged; there is one unless a disk is full."""


class Udp:
    """A socket on a port; what it did not take before the record was lost has to be sent again by its sender.

    The reply is ``{"acknowledged": sequence, "id": id}``, with a ``fault`` where the record could not be read.
    ``senders`` are the addresses whose datagrams are records, or ``any``; those of this machine by default. Others get
    no reply; of the first of them there is a fault.

    Raises:
        InputError: the port cannot be had, or other machines reach it and no sender is named.
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


def parsed(text: str) -> tuple[str, int, tuple[str, ...]] | None:
    """Host, port and senders of ``udp:PORT`` or ``udp:HOST:PORT?from=SENDER``; None if it is neither."""
    found = _NAME.fullmatch(text)
    if found is None or int(found["port"]) > 65535:
        return None
    senders = tuple(found["senders"].split(",")) if found["senders"] else ()
    return (found["host"] or LOOPBACK).strip("[]"), int(found["port"]), senders


def listening(host: str, port: int, senders: Sequence[str]) -> tuple[socket.socket, Callable[[str], bool]]:
    """A bound socket, and whether the datagrams of an address are taken.

    ``senders`` are the addresses whose datagrams are taken, or ``any``; those of this machine by default.

    Raises:
        InputError: the port cannot be had, or other machines reach it and no sender is named.
    """
    known = None if tuple(senders) == (ANYBODY,) else _addresses(senders)
    opened = bound(host, port)
    if not senders and not _plain(str(opened.getsockname()[0])).is_loopback:
        opened.close()
        raise InputError(
            "other machines reach this address, and no sender is named: anybody could send records.",
            where=Location(f"udp:{host}:{port}"),
            hint=f"Name who sends them: udp:{host}:{port}?from=ADDRESS, several with commas between them "
            f"(?from={ANYBODY} takes those of everybody), or take udp:{port}, which this machine alone reaches.",
        )
    return opened, lambda sender: known is None or (_plain(sender) in known if known else _plain(sender).is_loopback)


def _plain(address: str) -> IPv4Address | IPv6Address:
    """An address, without a zone; one of IPv4 as that even where it came by IPv6."""
    found = ip_address(address.partition("%")[0])
    return getattr(found, "ipv4_mapped", None) or found


def _addresses(senders: Sequence[str]) -> frozenset[IPv4Address | IPv6Address]:
    """All addresses of named senders.

    Raises:
        InputError: one has none.
    """
    found = set()
    for name in senders:
        try:
            known = socket.getaddrinfo(name.strip("[] "), None, type=socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as fault:
            message = f"the sender {name!r} has no address ({fault})."
            raise InputError(message, where=Location("?from="), hint="Give its IP address.") from fault
        found |= {_plain(str(each[4][0])) for each in known}
    return frozenset(found)


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
