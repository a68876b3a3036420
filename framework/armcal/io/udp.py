"""UDP sockets: how they are named in a command, and whose datagrams are taken."""

import re
import socket
from collections.abc import Callable, Sequence
from ipaddress import IPv4Address, IPv6Address, ip_address

from armcal.errors import InputError, Location

MAX_DATAGRAM_BYTES = 16 * 1024
LOOPBACK = "127.0.0.1"
ANYBODY = "any"
UDP_KINDS = "udp:PORT, udp:HOST:PORT?from=SENDER"
_NAME = re.compile(
    r"udp:(?:(?P<host>[^:\[\]]+|\[[0-9a-fA-F:.]+\]):)?(?P<port>[0-9]{1,5})"
    r"(?:\?from=(?P<senders>[^,\s]+(?:,[^,\s]+)*))?"
)


def parsed(text: str) -> tuple[str, int, tuple[str, ...]] | None:
    """Host, port and senders of ``udp:PORT`` or ``udp:HOST:PORT?from=SENDER``; None if it is neither."""
    match = _NAME.fullmatch(text)
    if match is None or int(match["port"]) > 65535:
        return None
    senders = tuple(match["senders"].split(",")) if match["senders"] else ()
    return (match["host"] or LOOPBACK).strip("[]"), int(match["port"]), senders


def listening(host: str, port: int, senders: Sequence[str]) -> tuple[socket.socket, Callable[[str], bool]]:
    """A bound socket, and whether the datagrams of an address are taken.

    ``senders`` are the addresses whose datagrams are taken, or ``any``; those of this machine by default.

    Raises:
        InputError: the port cannot be opened, or other machines reach it and no sender is named.
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
    ip = ip_address(address.partition("%")[0])
    return getattr(ip, "ipv4_mapped", None) or ip


def _addresses(senders: Sequence[str]) -> frozenset[IPv4Address | IPv6Address]:
    """All addresses of named senders.

    Raises:
        InputError: one has none.
    """
    addresses = set()
    for name in senders:
        try:
            known = socket.getaddrinfo(name.strip("[] "), None, type=socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as fault:
            message = f"the sender {name!r} has no address ({fault})."
            raise InputError(message, where=Location("?from="), hint="Give its IP address.") from fault
        addresses |= {_plain(str(entry[4][0])) for entry in known}
    return frozenset(addresses)


def bound(host: str, port: int) -> socket.socket:
    """A socket that does not block.

    Raises:
        InputError: the port cannot be opened.
    """
    where = Location(f"udp:{host}:{port}")
    try:
        kind, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE)[0]
        bound_socket = socket.socket(kind, socket.SOCK_DGRAM)
        try:
            bound_socket.bind(address)
        except OSError:
            bound_socket.close()
            raise
    except (OSError, UnicodeError) as fault:
        hint = "Give a free port, and an address of this machine."
        raise InputError(f"the socket cannot be opened ({fault}).", where=where, hint=hint) from fault
    bound_socket.setblocking(False)
    return bound_socket
