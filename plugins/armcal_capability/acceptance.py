"""``armcal acceptance``: how accurate and repeatable an arm is, by the terms of ISO 9283 [ISO9283]."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
from armcal.base.config_text import as_json
from armcal.cli.common import FILE, Console, accept, command_line, overrides, speaking
from armcal.io.cells import csv_text
from armcal.io.folder import reserved
from armcal.report.numbers import decimals_for
from armcal.report.tables import TextTable

from armcal_capability.frames import FRAMES, Comparison, FrameChoice, compare
from armcal_capability.iso9283 import MM, Figure, Row, assess, repeatability_of
from armcal_capability.page import render_page
from armcal_capability.visits import COMMANDED, ArmToJudge, Visits, read_visits

OURS = ("acceptance.html", "acceptance.json", "acceptance.csv")
ISO_CYCLES = 30
"""Visits to a pose that the standard asks for."""
_SECTIONS = {
    "poses": ("Poses: accuracy AP and repeatability RP, position (mm) and orientation (deg)", ("Pose", "Direction")),
    "distances": ("Pairs of poses: distance accuracy AD and repeatability RD (mm)", ("From", "To")),
    "directions": ("Several directions of approach: variation of accuracy vAP (mm)", ("Pose", "Directions")),
}
_BY_AXIS = ("AP_x_mm", "AP_y_mm", "AP_z_mm")
"""In the files, not in tables."""
_LARGEST, _MUCH = 1e4, 0.3
_MOST_ROWS = 40
"""Of a table on the screen and the page; the CSV has all."""


@click.command()
@click.argument("source", metavar="CALIBRATION|CONFIG", type=FILE)
@click.argument("records", type=FILE)
@click.option("--out", required=True, type=FILE, help="Where the results go.")
@click.option("--settings", type=FILE, help="A configuration whose section data says how RECORDS are read.")
@click.option(
    "--frame",
    type=click.Choice(FRAMES),
    default="auto",
    show_default=True,
    help="Where the instrument and the target are: as stated, found from RECORDS, or found where they are free.",
)
@accept
@overrides
@speaking
def acceptance(console: Console, source: Path, records: Path, out: Path, frame: FrameChoice, **given: Any) -> None:
    """Judge an arm by the terms of ISO 9283 from RECORDS of poses that were visited again and again.

    A calibration is set beside its nominal arm; a configuration is judged as its nominal arm.
    """
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    registry = console.registry()
    subject = ArmToJudge.load(source, given["settings"], given["overrides"], records, registry, given["accept"])
    visits = read_visits(subject, registry, records)
    comparisons = {model: compare(subject, model, visits, frame) for model in subject.models}
    rows = assess(visits, comparisons)
    warnings = [*visits.warnings, *(f"{model}: {text}" for model, c in comparisons.items() for text in c.warnings)]
    if subject.trained_on and visits.dataset.sha256 == subject.trained_on:
        warnings.append("the calibration was fitted to these very records: measure others to judge it by.")
    noise = next(iter(subject.system.measurements.values())).noise()
    content = _content(rows, visits, comparisons, repeatability_of(np.array(noise[:3])) * MM, warnings)
    texts, tables = _sentences(content, source.name), list(_tables(rows))
    facts = {"command": command_line(), "files": f"{source}, {records}", "sha256 of the records": visits.dataset.sha256}
    shown = [*texts, *(text[:1].upper() + text[1:] for text in warnings)]
    page = render_page("Acceptance", source.name, shown, tables, facts)
    lines = [
        (r.section, *r.names, r.cycles, r.model, r.name, r.figure.value, r.figure.low, r.figure.high) for r in rows
    ]
    headings = ("section", "of", "with", "cycles", "model", "figure", "value", "low_95", "high_95")
    kept.place(
        {
            "acceptance.csv": csv_text([headings, *lines], ".6g"),
            "acceptance.json": as_json(
                {
                    "source": str(source),
                    **content,
                    "figures": [dict(zip(headings, line, strict=True)) for line in lines],
                }
            )
            + "\n",
            "acceptance.html": page,
        }
    )
    console.result({**content, "folder": str(out)})
    for table in tables:
        console.table(table.caption, [words for words, _ in table.headings], table.rows, left=("To", "Direction"))
    for text in warnings:
        console.warn(text)
    for text in texts:
        console.line(text)
    console.line(f"page: {out / 'acceptance.html'}")


def _content(
    rows: Sequence[Row], visits: Visits, comparisons: Mapping[str, Comparison], noise: float, warnings: Sequence[str]
) -> dict[str, Any]:
    """What the figures come to, in mm and deg; ``noise`` is the RP (mm) that the declared noise makes alone."""

    def ends(model: str, name: str) -> dict[str, float] | None:
        values = np.abs([row.figure.value for row in rows if (row.model, row.name) == (model, name)])
        return {"mean": float(np.mean(values)), "most": float(np.max(values))} if len(values) else None

    names = [row.name for row in rows if row.model != "measured" and row.name not in _BY_AXIS]
    sizes, stated = [len(group.members) for group in visits.groups], visits.dataset.has(COMMANDED[0])
    how = "columns of the records" if stated else "the nominal arm at the commanded joint positions"
    return {
        "records": len(visits.dataset),
        "poses": len(visits.poses),
        "cycles": {"least": min(sizes), "most": max(sizes)},
        "commanded": {m: how if m == "nominal" else "the calibrated arm at the same positions" for m in comparisons},
        "frames": {m: {"words": c.words, "numbers_found": c.fitted} for m, c in comparisons.items()},
        "summary": {m: {name: ends(m, name) for name in dict.fromkeys(names)} for m in comparisons},
        "repeatability_mm": ends("measured", "RP_mm"),
        "of_instrument_mm": noise,
        "warnings": list(warnings),
    }


def _sentences(content: Mapping[str, Any], name: str) -> list[str]:
    """The result in sentences, what it rests on, and what is to be known of it."""
    rp, ends = content["repeatability_mm"], "{mean:.3g} mm ({most:.3g} mm at the worst pose)"
    accuracy = "; ".join(f"{model} {ends.format(**own['AP_mm'])}" for model, own in content["summary"].items())
    texts = [f"{name}: mean pose accuracy AP {accuracy}; mean repeatability RP {ends.format(**rp)}."]
    for model, frame in content["frames"].items():
        texts.append(f"AP, {model}: commanded is {content['commanded'][model]}; the frame is {frame['words']}.")
    if content["of_instrument_mm"] > _MUCH * rp["mean"]:
        texts.append(
            f"RP holds the instrument's noise, which as declared makes {content['of_instrument_mm']:.2g} mm alone."
        )
    cycles = content["cycles"]
    if cycles["least"] < ISO_CYCLES:
        times = " to ".join(map(str, sorted({*cycles.values()})))
        texts.append(
            f"Poses were visited {times} times; ISO 9283 asks for {ISO_CYCLES} cycles. These are its formulas, "
            "not its test: read the intervals."
        )
    return texts


def _tables(rows: Sequence[Row]) -> Iterator[TextTable]:
    """A table a section: a row a pose or pair, a column a figure."""
    for section, (caption, names) in _SECTIONS.items():
        members: dict[tuple[str, str], list[Row]] = {}
        for row in rows:
            if row.section == section and row.name not in _BY_AXIS:
                members.setdefault(row.names, []).append(row)
        if not members:
            continue
        more = f"; the first {_MOST_ROWS} of {len(members)}" if len(members) > _MOST_ROWS else ""
        shown = [i for i in range(2) if any(own[i] for own in members)]
        headings = [(names[i], False) for i in shown] + [("Cycles", True)]
        for row in next(iter(members.values())):
            words, _, unit = row.name.rpartition("_")
            headings.append((f"{words.replace('_', ' ')} {row.model}".removesuffix(" measured") + f", {unit}", True))
        cells = [
            (*(own[i] for i in shown), str(figures[0].cycles), *(_text(row.figure) for row in figures))
            for own, figures in list(members.items())[:_MOST_ROWS]
        ]
        yield TextTable(f"{caption}, 95 % intervals{more}", tuple(headings), tuple(cells))


def _text(figure: Figure) -> str:
    decimals = min(decimals_for(max(figure.value - figure.low, abs(figure.value) / 100)), 4)
    high = f"{figure.high:.{decimals}f}" if figure.high < _LARGEST else "?"
    return f"{figure.value:.{decimals}f} ({figure.low:.{decimals}f} to {high})"
