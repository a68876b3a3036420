"""UDP sockets: how one is named in a command, and how it is opened. Other machines' datagrams come by socat or SSH."""

import re
import socket

from armcal.errors import InputError, Location

LOOPBACK = "127.0.0.1"
_NAME = re.compile("udp:([0-9]{1,5})")


def port_of(text: str) -> int | None:
    """The port of ``udp:PORT``, which this machine alone reaches; None if it is none."""
    match = _NAME.fullmatch(text)
    return None if match is None or int(match[1]) > 65535 else int(match[1])


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
