"""``armcal acceptance``."""

from importlib import import_module
from pathlib import Path
from typing import Any

import click
import numpy as np
from armcal.base.config_text import as_json
from armcal.cli.common import FILE, Console, accept, command_line, overrides, speaking
from armcal.io.folder import reserved

from armcal_capability.acceptance.assessment import assess
from armcal_capability.acceptance.characteristics import repeatability_of
from armcal_capability.acceptance.comparison import FRAMES, FrameChoice, compare
from armcal_capability.acceptance.content import content_of, csv_rows, sentences, tables
from armcal_capability.acceptance.pictures import pictures
from armcal_capability.acceptance.records import read_visits
from armcal_capability.acceptance.subject import ArmToJudge
from armcal_capability.capability_page import render_page, show_table
from armcal_capability.outputs import table_text

_FIGURES = ("by_pose.png", "visits.png", "drift.png")
OURS = ("acceptance.html", "acceptance.json", "acceptance.csv", *_FIGURES)


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
    import_module("matplotlib")  # if it is missing, the command ends now
    registry = console.registry()
    subject = ArmToJudge.load(source, given["settings"], given["overrides"], records, registry, given["accept"])
    visits = read_visits(subject, registry, records)
    comparisons = compare(subject, visits, frame)
    assessment, noise = assess(visits, comparisons), subject.measurement[1].noise()
    warnings = list(dict.fromkeys((*visits.warnings, *(w for c in comparisons.values() for w in c.warnings))))
    if subject.trained_on and visits.dataset.sha256 == subject.trained_on:
        warnings.append("the calibration was fitted to these very records: measure others to judge it by.")
    content = content_of(assessment, visits, comparisons, repeatability_of(np.array(noise[:3])), warnings)
    texts, shown = sentences(content, subject.name), list(tables(assessment))
    drawn = pictures(assessment, visits, comparisons)
    facts = {"command": command_line(), "files": ", ".join(map(str, (*subject.files, records)))}
    facts |= {"sha256 of the records": visits.dataset.sha256, "poses are": content["poses_named_by"]}
    page = render_page(
        "Acceptance", subject.name, [*texts, *(text[:1].upper() + text[1:] for text in warnings)], shown, drawn, facts
    )
    files: dict[str, str | bytes] = {f"{picture.name}.png": picture.png for picture in drawn}
    files |= {"acceptance.csv": table_text(*csv_rows(assessment)), "acceptance.html": page}
    kept.place({**files, "acceptance.json": as_json({"source": str(source), **content}) + "\n"})
    console.result({**content, "folder": str(out)})
    for table in shown:
        show_table(console, table)
    for text in warnings:
        console.warn(text)
    for text in texts:
        console.line(text)
    console.line(f"page: {out / 'acceptance.html'}")
