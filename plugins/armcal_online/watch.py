"""``armcal watch``: the status and the newest events of a recalibration, served with one page that shows them.

It is served to this machine alone, to requests that use one of its own names.
"""

import base64
import hashlib
import json
import math
import re
import sys
from collections.abc import Mapping
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import click
from armcal.base.config_text import as_line
from armcal.cli.common import say
from armcal.errors import ArmcalError, InputError, Location

from armcal_online.decisions import EARLIER, EVENTS, present, spoken_time

DEFAULT_PORT = 8642
_HOST = "127.0.0.1"
_TAIL_BYTES = 1 << 20  # of the events; all are in the files
_MOST_LISTED, _MOST_RECORDS = 100, 300
_PATIENCE_S = 10.0  # how long a client may take to send its request, or to take an answer
_RECORD = ("sequence", "id", "at", "verdict", "why", "nis", "limit", "level")
_LISTED = ("event", "sequence", "at", "kind", "to", "sentence", "do", "confirm", "why", "resumed")


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--port", type=click.IntRange(0, 65535), default=DEFAULT_PORT, show_default=True, help="0: any free one.")
@click.option("--once", is_flag=True, help="Print the present state and end.")
def watch(folder: Path, port: int, once: bool) -> None:
    """Show a recalibration live, as a page in the browser. DIR is its folder, which is only read."""
    where, hint = Location(str(folder)), "Give what armcal recalibrate was given as --out."
    if not folder.is_dir():
        wrong = "it is a file, expected the folder of a recalibration" if folder.exists() else "there is no such folder"
        raise InputError(f"{wrong}.", where=where, hint=hint)
    if once:
        for line in first_screen(present(folder)):
            say(line)
        return
    with WatchServer(folder, port) as server:
        say(f"Watching {folder}: {server.address}")
        sys.stdout.flush()
        server.serve_forever()


def first_screen(now: Mapping[str, Any]) -> list[str]:
    screen, life, level = now["situation"], now["life"], now.get("level", "unknown")
    gone = {"killed": "not running", "stopped": "not running", "hangs": "not answering"}.get(life)
    size, before, of = _mm(screen.get("off_mm")), _mm(screen.get("off_before_mm")), screen.get("off_of")
    readings = f"median of the last {of} readings from their predictions" if of != 1 else "the newest reading"
    counts = now.get("counts") or {}
    lines = {
        "level": f"{gone} (it was {level})" if gone else f"{level}, {life}",
        "do now": screen["do"],
        "what": screen.get("what") or ("" if gone else now.get("why")),
        "confirm": screen.get("confirm"),
        "earlier": screen.get("earlier"),
        "off now": size and f"{size} ({readings}){f'; {before} before this was decided' if before else ''}",
        "since": _record(screen.get("since")),
        "last good": _record(screen.get("last_good")),
        "roll back": screen.get("rollback") if level != "nominal" else None,
        "records": ", ".join(f"{count:,} {verdict}" for verdict, count in counts.items()),
        "process": now["over"],
    }
    return [f"{name:<10} {words}" for name, words in lines.items() if words]


def _mm(size: float | None) -> str:
    return "" if size is None else f"{float(f'{size:.2g}'):g} mm"


def _record(record: Mapping[str, Any] | None) -> str:
    if not record:
        return ""
    at = record.get("at")
    return ", ".join(filter(None, (record.get("id"), at and spoken_time(at), f"entry {record['sequence']}")))


def newest_events(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """The end of the events, oldest first: ``records`` with how far off each was, and what else is ``listed``."""
    tail = b""
    for name in (EVENTS, EARLIER):
        try:
            with (folder / name).open("rb") as file:
                room = _TAIL_BYTES - len(tail)
                file.seek(max(file.seek(0, 2) - room, 0))
                tail = file.read(room) + tail
        except FileNotFoundError:
            continue
    records: list[dict[str, Any]] = []
    listed: list[dict[str, Any]] = []
    for line in tail.split(b"\n"):
        try:
            event = json.loads(line)
            kind = event["event"]
            if kind == "record":
                known = {key: event[key] for key in _RECORD if key in event}
                residual = event.get("residual_mm")
                records.append(known | ({"off_mm": round(math.hypot(*residual), 4)} if residual else {}))
            elif kind not in ("estimate", "calibration"):
                listed.append({key: event[key] for key in _LISTED if key in event})
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            continue  # half a line, at either end
    return {"records": records[-_MOST_RECORDS:], "listed": listed[-_MOST_LISTED:]}


@lru_cache
def page() -> tuple[bytes, str]:
    """The page, and the policy that lets no script and style in but its own."""
    html = resources.files("armcal_online").joinpath("watch.html").read_text(encoding="utf-8")
    (style,), (script,) = (re.findall(f"<{tag}>(.*?)</{tag}>", html, re.DOTALL) for tag in ("style", "script"))
    own = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (style, script)]
    policy = f"default-src 'none'; style-src 'sha256-{own[0]}'; script-src 'sha256-{own[1]}'; connect-src 'self'; "
    return html.encode(), policy + "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"


class WatchServer(ThreadingHTTPServer):
    """Serves a folder's state to this machine; from elsewhere SSH leads there."""

    daemon_threads, block_on_close = True, False

    def __init__(self, folder: Path, port: int = 0) -> None:
        self.folder = folder
        try:
            super().__init__((_HOST, port), _Handler)
        except (OSError, OverflowError) as fault:
            raise InputError(
                f"port {port} cannot be listened on ({fault}).",
                where=Location("--port"),
                hint="Give another --port; 0 takes any free one.",
            ) from fault

    @property
    def address(self) -> str:
        return f"http://{_HOST}:{self.server_address[1]}/"

    def allows(self, host_header: str | None) -> bool:
        """A page of another site, whose name was made to point here, is refused; a tunnel may begin at any port."""
        named = re.fullmatch(r"(?:\[([^\]]+)\]|([^:\[]+))(?::[0-9]*)?", (host_header or "").strip().lower())
        return named is not None and (named[1] or named[2]) in ("localhost", _HOST, "::1")

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no fault."""


class _Handler(BaseHTTPRequestHandler):
    server: WatchServer
    server_version, sys_version, timeout = "armcal", "", _PATIENCE_S

    def do_GET(self) -> None:
        address = urlsplit(self.path)
        if not self.server.allows(self.headers.get("Host")):
            self._answer(HTTPStatus.FORBIDDEN, b"Forbidden: wrong name in the address.\n")
        elif address.path == "/":
            self._answer(HTTPStatus.OK, page()[0], "text/html")
        elif address.path == "/state":
            try:
                state = {**present(self.server.folder), **newest_events(self.server.folder), "parameters": None}
            except (ArmcalError, OSError) as fault:
                self._answer(HTTPStatus.INTERNAL_SERVER_ERROR, f"{fault}\n".encode())
            else:
                self._answer(HTTPStatus.OK, as_line(state).encode(), "application/json")
        else:
            self._answer(HTTPStatus.NOT_FOUND, b"Not found.\n")

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the terminal has the address alone."""

    def _answer(self, status: HTTPStatus, body: bytes, kind: str = "text/plain") -> None:
        self.send_response(status)
        headers = {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": page()[1],
            "Cache-Control": "no-store",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)
