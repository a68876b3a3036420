"""Who may look: on this machine anyone who asks it by a name of its own, from elsewhere who knows the token."""

from __future__ import annotations

import hmac
import ipaddress
from dataclasses import dataclass
from secrets import token_urlsafe

_OWN_NAMES = ("localhost", "127.0.0.1", "::1")


def is_loopback(host: str) -> bool:
    """Whether an address can only be reached from this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True)
class Access:
    """Whether a request is answered.

    Attributes:
        host: what the server listens on.
        token: demanded of every request; None on an address of this machine alone.
    """

    host: str
    token: str | None

    @classmethod
    def of(cls, host: str) -> Access:
        """With a new token where others can reach the address."""
        return cls(host, None if is_loopback(host) else token_urlsafe(24))

    def allows(self, host_header: str | None, token: str | None) -> bool:
        """Judge a request by its Host header and its token.

        Without a token the header must name this machine: a page of another site, whose name was made to point here,
        is refused. The port may be any, since a tunnel may begin at another one.
        """
        if self.token is not None:
            return hmac.compare_digest((token or "").encode(), self.token.encode())
        return _name(host_header or "") in (*_OWN_NAMES, self.host)


def _name(host_header: str) -> str:
    """The name in a Host header, without port and brackets."""
    text = host_header.strip().lower()
    if text.startswith("["):
        name, _, rest = text[1:].partition("]")
        return name if not rest or rest.startswith(":") else ""
    name, _, port = text.partition(":")
    return name if not port or port.isdigit() else ""
