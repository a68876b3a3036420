"""The present state as text for a terminal: a picture that is drawn again and again, or a line an event."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from armcal_online.watch.events import when

LEVEL_STYLES = {"nominal": "green", "watch": "blue", "suspect": "yellow", "lost": "red"}
VERDICT_STYLES = {"accepted": "cyan", "rejected": "red", "ignored": "dim"}
_BARS = " ▁▂▃▄▅▆▇█"
_BAND = 1.96
_RECORDS, _PARAMETERS, _EVENTS = 6, 6, 6


def picture(state: Mapping[str, Any], width: int = 80) -> RenderableType:
    """All of the state on one screen of that many characters."""
    parts: list[RenderableType] = [_health(state)]
    if state["waiting"]:
        parts.append(Text(state["waiting"], style="blue"))
    if state["records"]:
        parts += [_strip(state["records"], width), _records(state["records"][-_RECORDS:])]
    if state["estimates"]["rows"]:
        parts.append(_parameters(state["estimates"]))
    if state["events"]:
        events = _table("event", "at", "")
        for event in reversed(state["events"][-_EVENTS:]):
            events.add_row(Text(_kind(event)), Text(_place(event)), Text(event["sentence"]))
        parts.append(events)
    return Group(*parts)


def line(message: Mapping[str, Any]) -> str | None:
    """One message as a line of plain text; None for estimates, which have none."""
    kind = message["event"]
    if kind == "estimate":
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
    level, counts, now = state["level"], state["status"].get("counts", state["counts"]), state["situation"]
    sentence = state["level_sentence"] or (state["status"].get("why") if state["status"].get("level") == level else "")
    style = LEVEL_STYLES.get(level, "dim")
    if now["over"]:
        style = "dim" if level == "nominal" else style  # no green for what nothing follows
    if now["life"] in ("stopped", "silent"):
        style, level, sentence = "red", f"not running (it was {level})", ""
    shown = Table.grid(padding=(0, 2))
    shown.add_column(style="dim")
    shown.add_column(overflow="fold")
    shown.add_row("level", Text.assemble((level, f"bold {style}"), f"  {now['over'] or ''}"))
    for name, words in (
        ("do now", now["do"]),
        ("what", now.get("what") or sentence),
        ("confirm", now.get("confirm")),
        ("earlier", now.get("earlier")),
        ("off now", _off(now)),
        ("since", _known(now.get("since"))),
        ("last good", _known(now.get("last_good"))),
        ("roll back", now.get("rollback") if state["level"] != "nominal" else None),
        ("newest", state["last"] and f"{_known(state['last'])}, heard {_span(state['heard_s'])} ago"),
        ("records", ", ".join(f"{count:,.0f} {verdict}" for verdict, count in counts.items())),
        ("at nominal", _off_at_nominal(state["over_time"])),
    ):
        if words:
            shown.add_row(name, Text(str(words), style="bold" if name == "do now" else ""))
    return Panel(shown, title=Text(str(state["folder"])), title_align="left", border_style=style)


def _off(now: Mapping[str, Any]) -> str:
    if now["off_mm"] is None:
        return ""
    before = f"; {now['off_before_mm']:.2g} mm before this was decided" if now.get("off_before_mm") else ""
    return f"{now['off_mm']:.2g} mm (median of the last {now['off_of']} readings from their predictions{before})"


def _off_at_nominal(known: Mapping[str, Any]) -> str:
    spans = known["off"]
    if not spans:
        return ""
    hours = round(sum(span["to"] - span["from"] for span in spans) / 3600)
    newest = f"{_when({'at': spans[-1]['from']})}, {spans[-1]['mm']:.2g} mm"
    return f"the {known['by']} show{'s' if known['by'] == 'truth' else ''} it off in {hours} h, the newest {newest}"


def _known(record: Mapping[str, Any] | None) -> str:
    if not record:
        return ""
    own = [str(record["id"])] if "id" in record else []
    return ", ".join(part for part in (*own, _when(record), f"entry {record.get('sequence')}") if part)


def _span(seconds: float) -> str:
    return (
        f"{seconds:.0f} s"
        if seconds < 120
        else f"{seconds / 60:.0f} min"
        if seconds < 7200
        else f"{seconds / 3600:.0f} h"
    )


def _strip(records: Sequence[Mapping[str, Any]], width: int) -> Text:
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
            Text(str(record.get("id", record["sequence"]))),
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


def _place(message: Mapping[str, Any]) -> str:
    name = f"record {message['sequence']}" if "sequence" in message else "no record"
    name += f" ({message['id']})" if "id" in message else ""
    return ", ".join(part for part in (name, _when(message)) if part)


def _when(message: Mapping[str, Any]) -> str:
    at = message.get("at")
    return "" if at is None else when(at)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
