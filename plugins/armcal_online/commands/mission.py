"""``armcal mission``."""

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import click
from armcal.calibration.calibration import Calibration
from armcal.cli.common import Console, overrides, speaking
from armcal.io.folder import reserved
from armcal.io.lines import StandardOutput
from armcal.plugins import PluginRegistry
from armcal.run.prepare import Stopwatch

from armcal_online.mission.files import SURPRISE, figures, write_files
from armcal_online.mission.mission import (
    BENCH,
    CALIBRATION,
    RECALIBRATION,
    RECORDS,
    MissionSource,
    PowerCutError,
    Session,
    run_mission,
)
from armcal_online.mission.settings import MissionPlan
from armcal_online.running.session import Setup, opened
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import RecalibrateSettings

TRUTH = ("truth.csv", "truth.json")
FIGURES = ("mission.csv", "mission.json", "mission.png")
OURS = (BENCH, RECORDS, CALIBRATION, RECALIBRATION, SURPRISE, *TRUTH, *FIGURES)
"""What a mission leaves; an earlier one's moves to ``earlier/N``."""


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Where the mission goes.")
@click.option(
    "--surprise",
    "seed",
    type=click.IntRange(min=0),
    metavar="SEED",
    help="Plant a random selection of events and disturbances, drawn from SEED, in place of the configured events.",
)
@overrides
@speaking
def mission(console: Console, config: Path, out: Path, seed: int | None, overrides: tuple[str, ...]) -> None:
    """Simulate the mission of CONFIG, recalibrate over all of it, and judge that against the truth."""
    import_module("matplotlib")  # if it is missing, the command ends now
    watch = Stopwatch()
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    registry = console.registry()
    planned = partial(MissionPlan.load, config) if seed is None else partial(MissionPlan.surprised, config, seed)
    plan = planned(overrides, registry)
    kept.place({})
    with console.progress() as progress:
        result = run_mission(plan, out, loop_session(registry), registry, progress, watch)
    content = {**figures(plan.experiment.name, result.mission, result.log, result.judgement), "seconds": watch.seconds}
    write_files(out, plan, result, content)
    console.result({**content, "folder": str(out)})
    _show_errors(console, content, plan.settings.refit.records)
    for line in _lines(content):
        console.line(line)
    for stage, seconds in watch.seconds.items():
        console.detail(f"{stage}: {seconds:.1f} s")
    console.line(f"figure: {out / 'mission.png'}  ({watch.total():.1f} s)")


def _show_errors(console: Console, content: Mapping[str, Any], records: int) -> None:
    names = {
        "frozen": "frozen at launch",
        "refit": "robust refit of all",
        "refit_recent": f"robust refit of the last {records}",
        "recalibrated": "recalibrated",
    }
    columns = {"mean": "mean", "median": "median", "p95": "95 %", "max": "max", "last": "last"}
    within = f"within {content['limit_mm']:g} mm"
    title = f"Mean tip error over {content['days']:g} days, mm"
    rows = []
    for name, summary in content["error_mm"].items():
        share = f"{content['within_limit'][name]:.1%}"
        rows.append((names[name], *(f"{summary[column]:.3f}" for column in columns), share))
    console.table(title, ("calibration", *columns.values(), within), rows)


def _lines(content: Mapping[str, Any]) -> Iterator[str]:
    for event in content["events"]:
        after = event["decided_after_hours"]
        decided = f"{event['named']}" if after is None else f"{event['named']} after {after:.1f} h"
        yield f"day {event['day']:.2f}: {event['label']}: {decided}, {event['aftermath']}"
    for alarm in content["false_alarms"]:
        yield f"day {alarm['day']:.2f}: false alarm: {alarm['sentence']}"
    counts, decisions, worst = content["records"], content["decisions"], content["worst_ratio_to_recent_refit"]
    yield (
        f"decisions: {', '.join(f'{count} {verdict}' for verdict, count in decisions.items())}; "
        f"{len(content['false_alarms'])} false alarms in {content['quiet_days']:.1f} quiet days"
    )
    if worst is not None:
        yield (
            f"worst day against the refit of recent records: {worst['ratio']:.2f} times its error, "
            f"from day {worst['since_day']:.1f}"
        )
    yield f"available {content['availability']:.1%} of the time"
    yield (
        f"{counts['arrived']} records: {counts['accepted']} accepted, {counts['rejected']} rejected "
        f"({counts['good_rejected_apart']} good ones apart from events), {counts['ignored']} ignored; "
        f"{counts['outliers_accepted']} of {counts['outliers']} outliers and "
        f"{counts['exchanged_accepted']} of {counts['exchanged']} exchanged records accepted"
    )


def loop_session(registry: PluginRegistry) -> Session:
    """Sessions through the loop that ``armcal recalibrate`` uses, each resuming from the journal in its folder."""

    def session(
        calibration: Path, settings: RecalibrateSettings, source: MissionSource, folder: Path
    ) -> Sequence[Mapping[str, Any]]:
        recalibrator = Recalibrator(Calibration.load(calibration, registry), settings, registry)
        events = io.BytesIO()
        setup = Setup(folder, calibration, StandardOutput(events))
        try:
            with opened(setup, recalibrator, source) as loop:
                loop.run()
                if not source.ended:
                    raise KeyboardInterrupt
        except PowerCutError:
            pass
        return [json.loads(line) for line in events.getvalue().decode().splitlines()]

    return session
