"""A UDP port that is listened to without waiting."""

from __future__ import annotations

import socket
from collections.abc import Iterator

from armcal.devices.faults import DeviceRefusedError
from armcal.errors import Location

MAX_DATAGRAM_BYTES = 65536
_MOST_AT_ONCE = 10_000
_BUFFER_BYTES = 4 * 1024**2


class UdpPort:
    """Bound until it is closed. A queue of the system holds what came since it was last drained, some 0.2 MB or more.

    Args:
        host: an address of this machine; 0.0.0.0 for all.
        port: the number; 0: any, see ``address``.
        group: the multicast group to join, if any.
        sender: the only address from which datagrams count, if any.

    Raises:
        DeviceRefusedError: it cannot be opened.
    """

    def __init__(self, host: str, port: int, group: str | None = None, sender: str | None = None) -> None:
        self._sender = sender
        where = Location(f"udp:{host}:{port}")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            self._socket.bind((host, port))
            if group is not None:
                member = socket.inet_aton(group) + socket.inet_aton("0.0.0.0" if host == group else host)
                self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        except OSError as fault:
            self._socket.close()
            hint = "Is another program listening there? Give a free port, and an address of this machine."
            raise DeviceRefusedError(
                f"the port cannot be opened ({fault.strerror or fault}).", where=where, hint=hint
            ) from fault

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        found = self._socket.getsockname()
        return str(found[0]), int(found[1])

    def datagrams(self) -> Iterator[bytes | None]:
        """What came since the last time, at most ten thousand; None for one from a sender that does not count."""
        for _ in range(_MOST_AT_ONCE):
            try:
                data, sender = self._socket.recvfrom(MAX_DATAGRAM_BYTES)
            except OSError:  # nothing is left, or the network is gone for now: both are silence
                return
            yield data if self._sender in (None, sender[0]) else None

    def close(self) -> None:
        """Let go of it; may be called twice."""
        self._socket.close()
