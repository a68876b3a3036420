"""``armcal run`` and ``armcal study``: they reserve a folder, read a configuration, compute, write and show."""

import sys
from pathlib import Path

import click

from armcal.cli.common import FILE, Console, command_line, data, overrides, parallel, say, speaking
from armcal.errors import EXIT_DO_NOT_USE, EXIT_NOT_CONVERGED
from armcal.estimate.estimator import CHECK_THE_DATA
from armcal.io.parallel import Executor
from armcal.io.plain_files import reserved
from armcal.report.numbers import plural
from armcal.report.page import page
from armcal.report.run_document import plugin_sections, run_document
from armcal.report.study_document import study_document
from armcal.run import result as results
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, calibrate
from armcal.run.result import RunResult
from armcal.run.study import FILES, Study, compare, files


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
    kept = click.get_current_context().with_resource(results.reserved(folder))
    registry = console.registry()
    experiment = Experiment.load(config, overrides, data, registry)
    with console.progress() as progress:
        result = calibrate(experiment, command_line(), progress, watch, parallel, accept)
    for warning in result.warnings:
        console.warn(warning)
    for stage, seconds in result.seconds.items():
        console.detail(f"{stage}: {seconds:.3f} s")
    console.detail(f"evaluated by: {result.backend}")
    result.seconds["total"] = watch.total()
    sections, faults = plugin_sections(result, registry)
    document = run_document(result, sections)
    results.write(kept, result, experiment, page(document), accept)
    converged = result.estimate.verdict.converged
    faults += registry.notify("armcal_run_ended", name=result.name, folder=str(folder), converged=converged)
    for text in faults:
        console.warn(text)
    console.show(document, folder=str(folder))
    grades = [finding.grade for finding in result.verdict.findings]
    counts = f"{plural(grades.count('good'), 'check')} passed, {plural(grades.count('note'), 'note')}: "
    console.line(f"{counts}armcal run -v, or the report" if not console.verbose else "")
    console.line(f"report: {folder / 'report.html'}  ({watch.total():.1f} s)")
    _end(result, folder, accept)


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
        name = results.calibration_name(result, accept)
        say(
            f"armcal: {result.verdict.bad[0].text} The calibration is {folder / name}, which no command loads. "
            "Correct the data or the configuration; or, if you know better, run again with --accept.",
            err=True,
        )
        sys.exit(EXIT_DO_NOT_USE)


@click.command()
@click.argument("config", type=FILE)
@data
@click.option("--out", type=FILE, help="Where the results go [default: runs/NAME of CONFIG].")
@overrides
@parallel
@speaking
def study(
    console: Console, config: Path, data: Path | None, out: Path | None, overrides: tuple[str, ...], parallel: Executor
) -> None:
    """Compare the variants that CONFIG lists by cross-validated error, and trained at one group of records each."""
    watch = Stopwatch()
    folder = out or Path("runs") / config.stem
    kept = click.get_current_context().with_resource(reserved(folder, FILES))
    configured = Study.load(config, overrides, data, console.registry())
    with console.progress() as progress:
        result = compare(configured, parallel, command_line(), progress, watch)
    for text in result.warnings:
        console.warn(text)
    for stage, seconds in result.seconds.items():
        console.detail(f"{stage}: {seconds:.3f} s")
    for v in result.variants:
        console.detail(f"{v.name}: {v.fit_seconds:.2f} s for the fit on all records, {v.seconds:.2f} s for all fits")
    result.seconds["total"] = watch.total()
    sources = {name: experiment.source for name, experiment in configured.experiments.items()}
    document = study_document(result)
    kept.place(files(result, configured.source, sources, page(document)))
    console.show(document, folder=str(folder))
    console.line(f"page: {folder / 'study.html'}  ({watch.total():.1f} s)")
