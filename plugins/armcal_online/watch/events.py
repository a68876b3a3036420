"""The events of a recalibration, checked and cut to what is shown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from armcal_online.watch.lenient import number, numbers, rounded, text, vector, whole

VERDICTS = ("accepted", "rejected", "ignored")
LEVELS = ("nominal", "watch", "suspect", "lost")
LISTED = ("started", "decision", "level", "calibration", "control", "alarm", "finished")
"""Events that are listed with their sentence."""
_ALONG = ("joint", "measurement", "kind", "from", "to", "path", "why", "command", "calibration", "evaluator")

Message = dict[str, Any]


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
    message["inputs"] = {name: rounded(value, 9) for name, value in numbers(event.get("inputs")).items()}
    return {key: value for key, value in message.items() if value not in (None, {})}


def shortened(record: Message) -> Message:
    """What is kept of a record that is no longer one of the newest."""
    keys = ("event", "sequence", "at", "verdict", "nis", "limit", "id")
    return {key: record[key] for key in keys if key in record}


def message_of(event: Mapping[str, Any]) -> Message | None:
    """An event that is listed, with a sentence in any case; None for other kinds."""
    kind = event.get("event")
    if kind not in LISTED:
        return None
    at = number(event.get("at")) or None  # 0: before the first record
    message: Message = {"event": kind, "sequence": whole(event.get("sequence")), "at": at}
    message |= {key: text(event.get(key)) for key in _ALONG}
    message |= {key: rounded(number(event.get(key))) for key in ("size_deg", "size_mm")}
    message["resumed"] = event.get("resumed") is True or None
    message = {key: value for key, value in message.items() if value is not None}
    message["sentence"] = text(event.get("sentence")) or _sentence(message)
    return message


def _sentence(message: Message) -> str:
    """For an event that brings none."""
    if message["event"] == "started":
        return "The recalibration went on." if "resumed" in message else "The recalibration started."
    if message["event"] == "calibration":
        return f"Wrote {message.get('path', 'a calibration')}."
    if message["event"] == "level":
        return f"From {message.get('from', 'unknown')} to {message.get('to', 'unknown')}."
    parts = [message[key] for key in ("kind", "command", "joint", "measurement", "why") if key in message]
    parts += [f"{message[key]:g} {key[5:]}" for key in ("size_deg", "size_mm") if key in message]
    return ", ".join(parts) or str(message["event"])
