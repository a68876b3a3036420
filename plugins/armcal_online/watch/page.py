"""The page: one HTML text with its style and script in it, and the policy that lets nothing else be loaded."""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from importlib import resources

SCRIPTS = ("drawing.js", "innovations.js", "parameters.js", "arm.js", "page.js")
"""In this order: each uses what those before it define."""
_STYLE, _SCRIPT = "/* style */", "/* script */"


@dataclass(frozen=True)
class Page:
    """A page as it is sent, and its Content-Security-Policy."""

    html: bytes
    policy: str


def page() -> Page:
    """Put together from the files of this package."""
    style, script = _file("page.css"), "\n".join(_file(name) for name in SCRIPTS)
    html = _file("page.html").replace(_STYLE, style).replace(_SCRIPT, script)
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return Page(html.encode(), policy)


def _file(name: str) -> str:
    return resources.files("armcal_online.watch").joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
