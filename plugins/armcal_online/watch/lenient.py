"""Reading what others wrote: what is not as expected becomes None, never an error."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

LONGEST_TEXT = 600
"""Longer texts are cut (characters)."""
_MOST_NUMBERS = 64
_HOSTILE = "\ufffd"


def parsed(line: bytes | str) -> Mapping[str, Any] | None:
    """One JSON object; None for anything else."""
    text = line.decode("utf-8", "replace") if isinstance(line, bytes) else line
    try:
        event = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return event if isinstance(event, dict) else None


def number(value: Any) -> float | None:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        known = float(value)
    except OverflowError:
        return None
    return known if math.isfinite(known) else None


def whole(value: Any) -> int | None:
    """A whole number of at most 15 digits, which every reader of JSON holds exactly."""
    known = number(value)
    return int(known) if known is not None and known == int(known) and abs(known) < 1e15 else None


def text(value: Any) -> str | None:
    """A text without characters that a terminal would act on or that turn the direction of writing."""
    if not isinstance(value, str):
        return None
    if value.isprintable() and len(value) <= LONGEST_TEXT:
        return value
    cut = value if len(value) <= LONGEST_TEXT else value[: LONGEST_TEXT - 3] + "..."
    return "".join(c if c.isprintable() else " " if c.isspace() else _HOSTILE for c in cut)


def scalar(value: Any) -> bool | float | str | None:
    """A text, a finite number, or yes or no."""
    if isinstance(value, bool):
        return value
    return number(value) if isinstance(value, (int, float)) else text(value)


def vector(value: Any) -> list[float] | None:
    """A list of three finite numbers."""
    if not isinstance(value, (list, tuple)) or len(value) != 3:
        return None
    known = [finite for item in value if (finite := number(item)) is not None]
    return known if len(known) == 3 else None


def numbers(value: Any) -> dict[str, float]:
    """Finite numbers by name; at most 64 of them."""
    if not isinstance(value, Mapping):
        return {}
    named = ((text(name), number(item)) for name, item in value.items())
    kept = [(name, finite) for name, finite in named if name is not None and finite is not None]
    return dict(kept[:_MOST_NUMBERS])


def rounded(value: float | None, digits: int = 6) -> float | None:
    """To so many significant digits: pages are sent thousands of numbers."""
    return None if value is None else float(f"{value:.{digits}g}")
