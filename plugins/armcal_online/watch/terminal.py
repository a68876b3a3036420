"""The present state as text for a terminal: a picture that is drawn again and again, or a line an event."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

LEVEL_STYLES = {"nominal": "green", "watch": "blue", "suspect": "yellow", "lost": "red"}
VERDICT_STYLES = {"accepted": "cyan", "rejected": "red", "ignored": "dim"}
_BARS = " ▁▂▃▄▅▆▇█"
_BAND = 1.96
_RECORDS, _PARAMETERS, _EVENTS = 6, 12, 6


def picture(state: Mapping[str, Any], width: int = 80) -> RenderableType:
    """All of the state on one screen of that many characters."""
    parts: list[RenderableType] = [_health(state)]
    if state["waiting"]:
        parts.append(Text(state["waiting"], style="blue"))
    if state["records"]:
        parts += [_strip(state["records"], width), _records(state["records"][-_RECORDS:])]
    if state["estimates"]["rows"]:
        parts.append(_parameters(state["estimates"]))
    if state["told"]:
        events = _table("event", "at", "")
        for event in reversed(state["told"][-_EVENTS:]):
            events.add_row(Text(_kind(event)), Text(_place(event)), Text(event["sentence"]))
        parts.append(events)
    return Group(*parts)


def line(message: Mapping[str, Any]) -> str | None:
    """One message as a line of plain text; None for estimates, drawings and states, which have none."""
    kind = message["event"]
    if kind in ("estimate", "arm", "status"):
        return None
    if kind == "reset":
        return "A new recalibration begins."
    if kind != "record":
        return f"{_place(message)}: {_kind(message)}: {message['sentence']}"
    numbers = [f"NIS {message['nis']:.3g}"] if "nis" in message else []
    numbers += [f"gate {message['limit']:.3g}"] if "limit" in message else []
    judged = message["verdict"] + (f" ({', '.join(numbers)})" if numbers else "")
    return f"{_place(message)}: {judged}" + (f". {message['why']}" if "why" in message else "")


def _health(state: Mapping[str, Any]) -> Panel:
    level, counts = state["level"], state["status"].get("counts", state["counts"])
    sentence = state["level_sentence"] or (state["status"].get("why") if state["status"].get("level") == level else "")
    style = LEVEL_STYLES.get(level, "dim")
    text = Text()
    text.append(level, style=f"bold {style}")
    if sentence:
        text.append(f"  {sentence}")
    text.append("\n" + ", ".join(f"{count:,.0f} {verdict}" for verdict, count in counts.items()))
    if state["status"].get("finished"):
        text.append("\nThe recalibration has finished.")
    if state["last"]:
        text.append(f"\nlast record {_name(state['last'])}, {_when(state['last'])}, heard {state['heard_s']:.0f} s ago")
    return Panel(text, title=Text(str(state["folder"])), title_align="left", border_style=style)


def _strip(records: Sequence[Mapping[str, Any]], width: int) -> Text:
    """NIS against the gate, a character a record; a full block is at the gate or above."""
    text = Text("NIS to gate, logarithmic: ", style="dim")
    for record in records[-max(10, width - 28) :]:
        nis, limit, bar = record.get("nis") or 0.0, record.get("limit") or 0.0, "."
        if nis > 0 and limit > 0:
            part = 1 + math.log10(nis / limit) / 3  # three decades below the gate
            bar = _BARS[min(max(round(part * (len(_BARS) - 1)), 1), len(_BARS) - 1)]
        text.append(bar, style=VERDICT_STYLES[record["verdict"]])
    text.no_wrap = True
    return text


def _records(records: Sequence[Mapping[str, Any]]) -> Table:
    table = _table("record", "verdict", "NIS", "gate", "off by, mm", "why")
    for record in reversed(records):
        residual = record.get("residual_mm")
        table.add_row(
            Text(_name(record)),
            Text(record["verdict"], style=VERDICT_STYLES[record["verdict"]]),
            _number(record.get("nis")),
            _number(record.get("limit")),
            _number(math.hypot(*residual) if residual else None),
            Text(record.get("why", "")),
        )
    return table


def _parameters(estimates: Mapping[str, Any]) -> Table:
    row = estimates["rows"][-1]
    listed = zip(estimates["parameters"], row["change"], row["sd"], strict=False)
    known = [(parameter, change, sd) for parameter, change, sd in listed if change is not None]
    known.sort(key=lambda entry: -abs(entry[1]) / (entry[0]["start_sd"] or math.inf))
    table = _table("parameter, most changed first", "change since the start", "+- (95 %)", "unit")
    for parameter, change, sd in known[:_PARAMETERS]:
        band = None if sd is None else _BAND * sd
        table.add_row(Text(parameter["name"]), f"{change:+.3g}", _number(band), Text(parameter["unit"]))
    if len(known) > _PARAMETERS:
        table.add_row(Text(f"and {len(known) - _PARAMETERS} more", style="dim"))
    return table


def _table(*columns: str) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for column in columns:
        table.add_column(column)
    return table


def _kind(event: Mapping[str, Any]) -> str:
    if event["event"] == "decision":
        return str(event.get("kind", "decision")).replace("_", " ")
    return f"level {event.get('to', '')}" if event["event"] == "level" else str(event["event"])


def _name(record: Mapping[str, Any]) -> str:
    return str(record.get("id", record["sequence"]))


def _place(message: Mapping[str, Any]) -> str:
    name = f"record {message['sequence']}" if "sequence" in message else "no record"
    name += f" ({message['id']})" if "id" in message else ""
    return ", ".join(part for part in (name, _when(message)) if part)


def _when(message: Mapping[str, Any]) -> str:
    try:
        return f"{datetime.fromtimestamp(message['at'], UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (KeyError, ValueError, OverflowError, OSError):
        return ""


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
