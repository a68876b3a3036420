"""Cells of a text file: what is a number in it, and what says that there is none."""

from __future__ import annotations

MISSING = frozenset({"", "na", "n/a", "nan", "null", "none"})
"""In small letters."""


def is_number(text: str) -> bool:
    """Whether Python reads a number, in ASCII: it would read 1_000, and digits of other scripts, too."""
    if not text.isascii() or "_" in text:
        return False
    try:
        float(text)
    except ValueError:
        return False
    return True


def is_missing(text: str) -> bool:
    """Whether a cell says that its value is not known."""
    return text.strip().lower() in MISSING
