"""Templates of C files, and texts that are safe in C."""

from __future__ import annotations

import re
from importlib import resources

from armcal.base.shown import shown

_PLACE = re.compile(r"\{\{(\w+)\}\}")
_PREFIX = re.compile(r"\b(arm|ARM)_")


def filled(template: str, prefix: str, **values: str) -> str:
    """A template with its places filled, and its names that begin with ``arm_`` or ``ARM_`` under another prefix."""
    text = resources.files("armcal_export").joinpath("templates", template).read_text(encoding="utf-8")
    return _PLACE.sub(lambda match: values[match[1]], with_prefix(text, prefix))


def with_prefix(text: str, prefix: str) -> str:
    """Names under another prefix."""
    return _PREFIX.sub(lambda match: f"{prefix if match[1] == 'arm' else prefix.upper()}_", text)


def in_comment(text: str) -> str:
    """Text of a user's as it can stand in a comment: ASCII, one line, and no end of a comment."""
    line = shown(" ".join(text.split())).encode("ascii", "replace").decode()
    return line.replace("*/", "* /").replace("/*", "/ *").replace("\\", "/").replace("??", "? ?")


def quoted(text: str) -> str:
    """Text as a C string; what is not printable ASCII in octal."""
    return '"' + "".join(_escaped(byte) for byte in text.encode("utf-8")) + '"'


def _escaped(byte: int) -> str:
    plain = 32 <= byte < 127 and chr(byte) not in '"\\?'
    return chr(byte) if plain else f"\\{byte:03o}"
