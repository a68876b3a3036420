"""The events of a recalibration, checked and cut to what is shown: what is not as expected becomes None."""

import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

LONGEST_TEXT = 600
"""Longer texts are cut (characters)."""
_MOST_NUMBERS = 64
_HOSTILE = "\ufffd"

VERDICTS = ("accepted", "rejected", "ignored")
LISTED = ("started", "decision", "level", "calibration", "control", "alarm", "finished")
"""Events that are listed with their sentence."""
_TEXTS = (
    *("joint", "measurement", "kind", "from", "to", "path", "why", "command", "calibration", "evaluator"),
    *("level", "what", "do", "confirm", "since_id", "tip_error_is"),
)
_NUMBERS = ("size_deg", "size_mm", "sure_percent", "tip_error_mm", "tip_error_mrad")
Message = dict[str, Any]


def parsed(line: bytes | str) -> Mapping[str, Any] | None:
    """One JSON object; None for anything else."""
    text = line.decode("utf-8", "replace") if isinstance(line, bytes) else line
    try:
        event = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return event if isinstance(event, dict) else None


def number(value: Any) -> float | None:
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


def when(at: float) -> str:
    """A time in words: UTC where it may be one since 1970."""
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%d %H:%M:%S} UTC" if 1e8 < at < 1e11 else f"{at:g} s"


def scalar(value: Any) -> bool | float | str | None:
    """A text, a finite number, or yes or no."""
    if isinstance(value, bool):
        return value
    return number(value) if isinstance(value, (int, float)) else text(value)


def vector(value: Any) -> list[float] | None:
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


def record_of(event: Mapping[str, Any]) -> Message | None:
    """A judged record; None where the verdict is not one."""
    verdict = event.get("verdict")
    if verdict not in VERDICTS:
        return None
    message: Message = {"event": "record", "verdict": verdict, "sequence": whole(event.get("sequence"))}
    message |= {key: number(event.get(key)) for key in ("at", "limit")}
    message |= {"nis": rounded(number(event.get("nis")), 7), "dof": whole(event.get("dof"))}
    message |= {key: text(event.get(key)) for key in ("id", "why", "measurement", "level")}
    for key in ("residual_mm", "measured_mm", "predicted_mm"):
        values = vector(event.get(key))
        message[key] = values and [rounded(value) for value in values]
    message["off_mm"] = message["residual_mm"] and rounded(math.hypot(*message["residual_mm"]), 4)
    message["inputs"] = {name: rounded(value, 9) for name, value in numbers(event.get("inputs")).items()}
    return {key: value for key, value in message.items() if value not in (None, {})}


def named_record(value: Any) -> Message | None:
    """A record by number, its own name and time, as far as they are given; None without a number."""
    if not isinstance(value, Mapping) or whole(value.get("sequence")) is None:
        return None
    record = {"sequence": whole(value["sequence"]), "id": text(value.get("id")), "at": number(value.get("at"))}
    return {key: known for key, known in record.items() if known is not None}


def shortened(record: Message) -> Message:
    keys = ("event", "step", "sequence", "at", "verdict", "nis", "limit", "id", "level", "off_mm")
    return {key: record[key] for key in keys if key in record}


def message_of(event: Mapping[str, Any]) -> Message | None:
    """An event that is listed, with a sentence in any case; None for other kinds."""
    kind = event.get("event")
    if kind not in LISTED:
        return None
    at = number(event.get("at")) or None  # 0: before the first record
    message: Message = {"event": kind, "sequence": whole(event.get("sequence")), "at": at}
    message |= {key: text(event.get(key)) for key in _TEXTS}
    message |= {key: rounded(number(event.get(key))) for key in _NUMBERS}
    message |= {"since": whole(event.get("since")), "since_at": number(event.get("since_at"))}
    message["last_good"] = named_record(event.get("last_good"))
    message["resumed"] = event.get("resumed") is True or None
    message = {key: value for key, value in message.items() if value is not None}
    message["sentence"] = text(event.get("sentence")) or _sentence(message)
    return message


def _sentence(message: Message) -> str:
    if message["event"] == "started":
        return "The recalibration went on." if "resumed" in message else "The recalibration started."
    if message["event"] == "calibration":
        return f"Wrote {message.get('path', 'a calibration')}."
    if message["event"] == "level":
        return f"From {message.get('from', 'unknown')} to {message.get('to', 'unknown')}."
    parts = [message[key] for key in ("kind", "command", "joint", "measurement", "why") if key in message]
    parts += [f"{message[key]:g} {key[5:]}" for key in ("size_deg", "size_mm") if key in message]
    return ", ".join(parts) or str(message["event"])
