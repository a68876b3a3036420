"""``armcal run``."""

import sys
from functools import partial
from pathlib import Path

import click

from armcal.cli.common import FILE, Console, command_line, data, overrides, parallel, speaking
from armcal.cli.outlet import say
from armcal.cli.tables import show_run
from armcal.errors import EXIT_DO_NOT_USE, EXIT_NOT_CONVERGED
from armcal.estimate.estimator import CHECK_THE_DATA
from armcal.io.parallel import Executor
from armcal.report import plugin_sections, render
from armcal.run import outputs
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, calibrate
from armcal.run.result import RunResult


@click.command()
@click.argument("config", type=FILE)
@data
@click.option("--out", type=FILE, help="Where the results go [default: runs/NAME of CONFIG].")
@click.option(
    "--accept", is_flag=True, help="Write calibration.yaml although its verdict is bad, or the data look mixed up."
)
@overrides
@parallel
@speaking
def run(
    console: Console,
    config: Path,
    data: Path | None,
    out: Path | None,
    accept: bool,
    overrides: tuple[str, ...],
    parallel: Executor,
) -> None:
    """Calibrate the arm that CONFIG describes: load, check, fit, validate, report."""
    watch = Stopwatch()
    folder = out or Path("runs") / config.stem
    reserved = click.get_current_context().with_resource(outputs.reserved(folder))
    registry = console.registry()
    experiment = Experiment.load(config, overrides, data, registry)
    with console.progress() as progress:
        result = calibrate(experiment, command_line(), progress, watch, parallel, accept)
    _show_details(console, result)
    result.seconds["total"] = watch.total()
    sections = plugin_sections(result, registry)
    for section in sections:
        if section.fault:
            console.warn(section.fault)
    outputs.place(reserved, result, experiment, partial(render, sections=sections), accept)
    converged = result.estimate.verdict.converged
    for text in registry.notify("armcal_run_ended", name=result.name, folder=str(folder), converged=converged):
        console.warn(text)
    console.result({**outputs.metrics(result), "folder": str(folder)})
    show_run(console, result, folder, watch.total())
    _end(result, folder, accept)


def _show_details(console: Console, result: RunResult) -> None:
    """Warnings, and with -v which records took no part and how long each stage took."""
    for text in result.warnings:
        console.warn(text)
    for aside in result.dataset.set_aside:
        console.detail(f"set aside: row {aside.row}, record {aside.record_id}: {aside.reason}")
    for record in result.noise.suspicious:
        console.detail(
            f"suspicious: row {record.row}, record {record.record_id}: {record.deviations:.1f} sd "
            f"(limit {record.limit:.1f}), {record.fate}"
        )
    for stage, seconds in result.seconds.items():
        console.detail(f"{stage}: {seconds:.3f} s")
    console.detail(f"evaluated by: {result.backend}")


def _end(result: RunResult, folder: Path, accept: bool) -> None:
    """Exit with what is to be done, where there is no calibration to be used."""
    solver = result.estimate.verdict
    if not solver.converged:
        say(
            f"armcal: {solver.name} did not converge ({solver.status}). "
            f"Nothing was exported as calibrated. {CHECK_THE_DATA}",
            err=True,
        )
        sys.exit(EXIT_NOT_CONVERGED)
    if result.verdict.bad and not accept:
        name = outputs.calibration_name(result, accept)
        say(
            f"armcal: {result.verdict.bad[0].text} The calibration is {folder / name}, which no command loads. "
            "Correct the data or the configuration; or, if you know better, run again with --accept.",
            err=True,
        )
        sys.exit(EXIT_DO_NOT_USE)
