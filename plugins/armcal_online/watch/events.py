"""What the events of a recalibration say, checked and cut to what is shown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from armcal_online.watch.lenient import number, numbers, rounded, text, vector, whole

VERDICTS = ("accepted", "rejected", "ignored")
LEVELS = ("nominal", "watch", "suspect", "lost")
TOLD = ("started", "decision", "level", "calibration", "control", "alarm", "finished")
"""Events that are listed with their sentence."""
_ALONG = ("joint", "measurement", "kind", "from", "to", "path", "why", "command", "calibration", "evaluator")

Message = dict[str, Any]


def record_of(event: Mapping[str, Any]) -> Message | None:
    """A judged record; None where the verdict is not one."""
    verdict = event.get("verdict")
    if verdict not in VERDICTS:
        return None
    kept: Message = {"event": "record", "verdict": verdict, "sequence": whole(event.get("sequence"))}
    kept |= {key: number(event.get(key)) for key in ("at", "limit")}
    kept |= {"nis": rounded(number(event.get("nis")), 7), "dof": whole(event.get("dof"))}
    kept |= {key: text(event.get(key)) for key in ("id", "why", "measurement", "level")}
    for key in ("residual_mm", "measured_mm", "predicted_mm"):
        kept[key] = _rounded_all(vector(event.get(key)))
    kept["inputs"] = {name: rounded(value, 9) for name, value in numbers(event.get("inputs")).items()}
    return {key: value for key, value in kept.items() if value not in (None, {})}


def shortened(record: Message) -> Message:
    """What is kept of a record that is no longer one of the newest."""
    keys = ("event", "sequence", "at", "verdict", "nis", "limit", "id")
    return {key: record[key] for key in keys if key in record}


def message_of(event: Mapping[str, Any]) -> Message | None:
    """An event that is listed, with a sentence in any case; None for other kinds."""
    kind = event.get("event")
    if kind not in TOLD:
        return None
    at = number(event.get("at")) or None  # 0: before the first record
    kept: Message = {"event": kind, "sequence": whole(event.get("sequence")), "at": at}
    kept |= {key: text(event.get(key)) for key in _ALONG}
    kept |= {key: rounded(number(event.get(key))) for key in ("size_deg", "size_mm")}
    kept["resumed"] = event.get("resumed") is True or None
    kept = {key: value for key, value in kept.items() if value is not None}
    kept["sentence"] = text(event.get("sentence")) or _sentence(kept)
    return kept


def _sentence(content: Message) -> str:
    if content["event"] == "started":
        return "The recalibration went on." if "resumed" in content else "The recalibration started."
    if content["event"] == "calibration":
        return f"Wrote {content.get('path', 'a calibration')}."
    if content["event"] == "level":
        return f"From {content.get('from', 'unknown')} to {content.get('to', 'unknown')}."
    parts = [content[key] for key in ("kind", "command", "joint", "measurement", "why") if key in content]
    parts += [f"{content[key]:g} {key[5:]}" for key in ("size_deg", "size_mm") if key in content]
    return ", ".join(parts) or str(content["event"])


def _rounded_all(values: list[float] | None) -> list[float | None] | None:
    return None if values is None else [rounded(value) for value in values]
