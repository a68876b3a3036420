"""``armcal mission``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from armcal.base.config_text import as_json
from armcal.cli.common import Console, overrides, speaking
from armcal.errors import InputError, Location
from armcal.io.folder import reserved
from armcal.io.plain_files import check_output
from armcal.plugins import discover
from armcal.run.pipeline import Stopwatch
from rich.table import Table

from armcal_online.commands.mission_session import loop_session
from armcal_online.mission.files import curve_text, figures, schedule, truth_text
from armcal_online.mission.mission import BENCH, CALIBRATION, RECALIBRATION, RECORDS, MissionResult, run_mission
from armcal_online.mission.settings import MissionPlan
from armcal_online.mission_figure import mission_figure

TRUTH = ("truth.csv", "truth.json")
FIGURES = ("mission.csv", "mission.json", "mission.png")
OURS = (BENCH, RECORDS, CALIBRATION, RECALIBRATION, *TRUTH, *FIGURES)
"""What a mission leaves; an earlier one's moves to ``earlier/N``."""

_NAMED = {"right": "named right", "wrong": "named wrong", "seen": "seen but not named", "missed": "missed"}


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Where the mission goes.")
@overrides
@speaking
def mission(console: Console, config: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Simulate the mission of CONFIG, recalibrate over all of it, and judge that against the truth."""
    watch = Stopwatch()
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    registry = discover()
    console.plugin_faults(registry)
    plan = MissionPlan.load(config, overrides, registry)
    kept.place({})
    with console.progress() as progress:
        result = run_mission(plan, out, loop_session(registry), registry, progress, watch)
    content = {**figures(plan.experiment.name, result.mission, result.log, result.judgement), "seconds": watch.seconds}
    _write(out, plan, result, content)
    console.result({**content, "folder": str(out)})
    _show(console, content)
    for stage, seconds in watch.seconds.items():
        console.detail(f"{stage}: {seconds:.1f} s")
    console.out.print(f"figure: {out / 'mission.png'}  ({watch.total():.1f} s)", markup=False, soft_wrap=True)


def _write(folder: Path, plan: MissionPlan, result: MissionResult, told: dict[str, Any]) -> None:
    curve, truth = result.judgement.curve, result.mission.truth
    texts = {
        "truth.csv": truth_text(result.mission, plan.experiment.parameters),
        "truth.json": json.dumps(schedule(result.mission), indent=2) + "\n",
        "mission.csv": curve_text(curve, truth.temperature_at(curve.times)),
        "mission.json": as_json(told) + "\n",
    }
    try:
        picture = mission_figure(result.mission, result.judgement, plan.experiment.name)
        for name, content in {**{n: text.encode() for n, text in texts.items()}, "mission.png": picture}.items():
            check_output(folder / name, InputError)
            (folder / name).write_bytes(content)
    except OSError as fault:
        raise InputError(
            f"it cannot be written ({fault.strerror or fault}).",
            where=Location(str(folder)),
            hint="Check the room on the disk.",
        ) from fault


def _show(console: Console, content: dict[str, Any]) -> None:
    errors, counts = content["error_mm"], content["records"]
    table = Table(title=f"Mean tip error over {content['days']:g} days, mm", title_justify="left")
    table.add_column("calibration")
    for column in ("mean", "median", "p95", "max", "last"):
        table.add_column(column, justify="right")
    for name, figures_ in errors.items():
        table.add_row(name, *(f"{figures_[column]:.3f}" for column in ("mean", "median", "p95", "max", "last")))
    console.out.print(table)
    for event in content["events"]:
        records = event["recovered_after_records"]
        back = "not recovered" if records is None else f"recovered after {records} records"
        _line(console, f"day {event['day']:.2f}: {event['label']}: {_NAMED[event['named']]}, {back}")
    _line(
        console,
        f"available {content['availability']:.1%} of the time (frozen: within {content['limit_mm']:g} mm "
        f"{content['frozen_within_limit']:.1%}); {len(content['false_alarms'])} false alarms, "
        f"{content['missed']} events missed",
    )
    _line(
        console,
        f"{counts['arrived']} records: {counts['accepted']} accepted, {counts['rejected']} rejected "
        f"({counts['good_rejected_apart']} good ones apart from events), {counts['ignored']} ignored; "
        f"{counts['outliers_accepted']} of {counts['outliers']} outliers accepted",
    )


def _line(console: Console, text: str) -> None:
    console.out.print(text, markup=False, soft_wrap=True)
