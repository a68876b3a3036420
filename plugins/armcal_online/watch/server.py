"""The page and its server: two addresses that are read, nothing that is written.

On this machine every request is answered that uses one of its own names; from elsewhere it needs the token.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import hmac
import ipaddress
import json
import math
import re
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from secrets import token_urlsafe
from typing import Any
from urllib.parse import parse_qs, urlsplit

from armcal.errors import InputError, Location

from armcal_online.watch.feed import Feed

SCRIPTS = ("drawing.js", "hours.js", "innovations.js", "parameters.js", "arm.js", "page.js")
"""In this order: each uses what those before it define."""
MOST_CONNECTIONS = 64
"""Pages have one each."""
_NEWS_S = 5.0
"""How long a page waits for something new, before it asks again."""
_PATIENCE = 10.0
_OWN_NAMES = ("localhost", "127.0.0.1", "::1")
_HOST_HEADER = re.compile(r"(?:\[(?P<ipv6>[^\]]+)\]|(?P<name>[^:\[]+))(?::[0-9]*)?")
_ALWAYS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


def is_loopback(host: str) -> bool:
    """Whether an address can only be reached from this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True)
class Access:
    """Decides whether a request is answered.

    Attributes:
        host: what the server listens on.
        token: demanded of every request; None on an address of this machine alone.
    """

    host: str
    token: str | None

    @classmethod
    def of(cls, host: str) -> Access:
        return cls(host, None if is_loopback(host) else token_urlsafe(24))

    def allows(self, host_header: str | None, token: str | None) -> bool:
        """Judge a request by its Host header and its token.

        Without a token the header must name this machine: a page of another site, whose name was made to point here,
        is refused. The port may be any, since a tunnel may begin at another one.
        """
        if self.token is not None:
            return hmac.compare_digest((token or "").encode(), self.token.encode())
        named = _HOST_HEADER.fullmatch((host_header or "").strip().lower())
        return named is not None and (named["ipv6"] or named["name"]) in (*_OWN_NAMES, self.host)


def page() -> tuple[bytes, str]:
    style, script = _file("page.css"), "\n".join(_file(name) for name in SCRIPTS)
    html = _file("page.html").replace("/* style */", style).replace("/* script */", script)
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return html.encode(), policy


def _file(name: str) -> str:
    return resources.files("armcal_online.watch").joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


class WatchServer(ThreadingHTTPServer):
    """Serves a feed.

    Args:
        feed: what is shown.
        host: the address to listen on; further than this machine, every request needs ``token``.
        port: 0 for any free one.
        patience: how long a client may take to send the whole of a request, or to take an answer (s).

    Attributes:
        due: by connection, oldest first, until when its request has to be here (monotonic, s); no end once it is.

    Raises:
        InputError: the address cannot be listened on.
    """

    daemon_threads = True
    block_on_close = False
    request_queue_size = 64

    def __init__(self, feed: Feed, host: str = "127.0.0.1", port: int = 0, patience: float = _PATIENCE) -> None:
        self.feed, self.patience = feed, patience
        self.access = Access.of(host)
        self.page, self.policy = page()
        self.due: dict[Any, float] = {}
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError) as fault:
            raise InputError(
                f"{host}, port {port}, cannot be listened on ({fault}).",
                where=Location("--port"),
                hint="Give another --port; 0 takes any free one.",
            ) from fault

    @property
    def address(self) -> str:
        host = socket.gethostname() if self.access.host in ("0.0.0.0", "::") else self.access.host
        host = f"[{host}]" if ":" in host else host
        query = f"?token={self.access.token}" if self.access.token else ""
        return f"http://{host}:{self.server_port}/{query}"

    def server_bind(self) -> None:
        socket.socket.setsockopt(self.socket, socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """One thread a connection; of too many the oldest goes whose request is not here yet."""
        if len(self.due) >= MOST_CONNECTIONS:
            self._drop_unfinished(math.inf, 1)
        if len(self.due) >= MOST_CONNECTIONS:
            self.shutdown_request(request)
            return
        self.due[request] = time.monotonic() + self.patience
        super().process_request(request, client_address)

    def service_actions(self) -> None:
        self._drop_unfinished(time.monotonic(), MOST_CONNECTIONS)

    def _drop_unfinished(self, until: float, most: int) -> None:
        late = [request for request, due in [*self.due.items()] if due < until]
        for request in late[:most]:
            self.due.pop(request, None)
            with suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.due.pop(request, None)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no fault."""


class _Handler(BaseHTTPRequestHandler):
    server: WatchServer
    server_version, sys_version = "armcal", ""

    def setup(self) -> None:
        super().setup()
        self.connection.settimeout(self.server.patience)

    def do_GET(self) -> None:
        """The page, or the state: all of it, or what is new ``after`` the place of an earlier one."""
        self.server.due[self.connection] = math.inf
        address = urlsplit(self.path)
        query = {key: values[-1] for key, values in parse_qs(address.query).items()}
        if not self.server.access.allows(self.headers.get("Host"), query.get("token")):
            self._answer(HTTPStatus.FORBIDDEN, b"Forbidden: wrong name or token in the address.\n")
        elif address.path == "/":
            self._answer(HTTPStatus.OK, self.server.page, "text/html")
        elif address.path == "/state":
            state = self.server.feed.state(query.get("after", ""), _NEWS_S)
            text = json.dumps(state, allow_nan=False, separators=(",", ":"))
            self._answer(HTTPStatus.OK, text.encode(), "application/json")
        else:
            self._answer(HTTPStatus.NOT_FOUND, b"Not found.\n")

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: a token would be in it."""

    def _answer(self, status: HTTPStatus, body: bytes, kind: str = "text/plain") -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Security-Policy", self.server.policy)
        for name, value in _ALWAYS.items():
            self.send_header(name, value)
        if "gzip" in self.headers.get("Accept-Encoding", "") and len(body) > 4096:
            body = gzip.compress(body, 5)
            self.send_header("Content-Encoding", "gzip")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)
