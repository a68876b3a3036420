"""``armcal run``."""

import sys
from functools import partial
from pathlib import Path

import click
import numpy as np
from rich.box import HORIZONTALS
from rich.table import Table
from rich.text import Text

from armcal.base.domains import Semidefinite, symmetric
from armcal.base.units import shown_unit
from armcal.cli.common import FILE, Console, command_line, data, overrides, parallel, speaking
from armcal.cli.console import columned, say
from armcal.errors import EXIT_DO_NOT_USE, EXIT_NOT_CONVERGED
from armcal.estimate.bootstrap import Bootstrap
from armcal.estimate.estimator import CHECK_THE_DATA
from armcal.estimate.validation import ErrorSummary
from armcal.io.parallel import Executor
from armcal.report import plugin_sections, render
from armcal.report.numbers import MINUS, NONE, decimals_for, significant
from armcal.report.tables import parameter_rows, part_of
from armcal.run import outputs
from armcal.run.errors import ErrorTable
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from armcal.run.prepare import Stopwatch
from armcal.run.result import RunResult

_SETS = {"train": "training", "holdout": "held out", "cross_validated": "cross-validated"}
_STYLES = {"bad": "bold red", "warning": "yellow", "note": "", "good": "green"}


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
    for warning in result.warnings:
        console.warn(warning)
    for line in result.odd_records:
        console.detail(line)
    for stage, seconds in result.seconds.items():
        console.detail(f"{stage}: {seconds:.3f} s")
    console.detail(f"evaluated by: {result.backend}")
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


def show_run(console: Console, result: RunResult, folder: Path, seconds: float) -> None:
    """The end of a run: errors, compliances, verdict, where the report is."""
    out = console.out
    out.print(_errors(f"{result.errors.name} error, {result.errors.unit}: {result.name}", result.table))
    if result.table.turns is not None:
        what = "Orientation" if result.errors.name == "Tip" else "Angle"
        out.print(_errors(f"{what} error, deg: {result.name}", result.table.turns))
    if result.groups.errors:
        out.print(_groups(result))
    for compliances in (_compliances(result), _matrices(result)):
        if compliances.row_count:
            out.print(compliances)
    if result.bootstrap:
        out.print(_bootstrap(result, result.bootstrap))
    # A row a finding: how it was tested stands dimmed behind what it says, what to do in a line below it.
    table = Table(title="Verdict", title_justify="left", box=HORIZONTALS, expand=True, show_header=False)
    table.add_column("", no_wrap=True)
    table.add_column("", ratio=1)
    for finding in result.verdict.findings:
        text = Text(finding.text)
        if finding.test:
            text.append(f" ({finding.test})", style="dim")
        if finding.action:
            text.append(f"\nTo do: {finding.action}")
        table.add_row(Text(finding.grade, style=_STYLES[finding.grade]), text)
    out.print(table)
    out.print(result.verdict.headline, style="bold")
    if result.verdict.paragraph:
        out.print(result.verdict.paragraph)
    console.line(f"report: {folder / 'report.html'}  ({seconds:.1f} s)")


def _errors(title: str, errors: ErrorTable) -> Table:
    table = columned(title, ("records", "count", "", "mean", "rms", "95 %", "max"), left=("",))
    for key, words in _SETS.items():
        before, after = errors.nominal[key], errors.calibrated[key]
        if not after.count:
            continue
        table.add_row(words, str(after.count), "nominal", *_numbers(before))
        at_rest = errors.at_rest.get(key)
        table.add_row("", "", "calibrated", *_numbers(after), end_section=at_rest is None)
        if at_rest is not None:
            table.add_row("", "", "drift unknown", *_numbers(at_rest), end_section=True)
    return table


def _groups(result: RunResult) -> Table:
    """A row a group: what its records miss each other by, and what its known distances miss."""
    distances = any(group.distance_error_mm is not None for group in result.groups.errors)
    columns = ("group", "records", "", "error", "", *(("distance error", "") if distances else ()))
    table = columned(f"By group, mean, {result.errors.unit}: before and after", columns, left=("",))
    for group in result.groups.errors:
        numbers = [f"{group.nominal_error_mm:.3f}", f"-> {group.error_mm:.3f}"]
        if distances:
            before, after = group.nominal_distance_error_mm, group.distance_error_mm
            numbers += ["-", ""] if before is None or after is None else [f"{before:.3f}", f"-> {after:.3f}"]
        table.add_row(group.name, str(group.records), part_of(group), *numbers)
    return table


def _numbers(summary: ErrorSummary) -> list[str]:
    return [f"{x:.3f}" if x is not None else "-" for x in (summary.mean, summary.rms, summary.p95, summary.max)]


def _compliances(result: RunResult) -> Table:
    estimate = result.estimate
    title = f"Compliance, {shown_unit('rad_per_Nm')[1]}"
    table = columned(title, ("parameter", "value", "sd", "95 % interval", ""), left=("",))
    for i, row in enumerate(parameter_rows(estimate)):
        if row.si_unit != "rad_per_Nm" or estimate.parameters[row.name.partition("[")[0]].size > 1:
            continue
        flag = ""
        if row.at_bound:
            flag = "at its bound"
        elif not estimate.identified_by_data[i]:
            flag = "held by its prior" if estimate.determined[i] else "not determined"
        table.add_row(row.name, *map(_in_ascii, (row.value, row.sd, row.interval)), flag)
    return table


def _in_ascii(text: str) -> str:
    for sign, word in ((MINUS, "-"), (NONE, "-"), ("≤", "up to"), ("≥", "from")):
        text = text.replace(sign, word)
    return text.strip()


def _matrices(result: RunResult) -> Table:
    estimate = result.estimate
    factor, unit = shown_unit("rad_per_Nm")
    table = columned(f"Principal compliances, {unit}", ("parameter", "stiffest", "", "softest"))
    for block in estimate.parameters.free:
        if isinstance(block.domain, Semidefinite):
            sizes = np.linalg.eigvalsh(symmetric(estimate.values[estimate.parameters.entries_of(block.name)]))
            table.add_row(block.name, *(_in_ascii(significant(factor * max(size, 0.0))) for size in sizes))
    return table


def _bootstrap(result: RunResult, bootstrap: Bootstrap) -> Table:
    """How sure each parameter is, in SI, by curvature and by refits."""
    how = f"blocks of {bootstrap.block}" if bootstrap.method == "blocks" else "parametric"
    failed = f", {bootstrap.failed} more did not converge" if bootstrap.failed else ""
    title = f"Bootstrap, {len(bootstrap.values)} refits{failed}; {how}"
    table = columned(title, ("parameter", "value", "sd", "bootstrap sd", "bootstrap 95 % interval"))
    estimate = result.estimate
    for i, name in enumerate(bootstrap.names):
        sd, low, high = (float(x) for x in (bootstrap.deviations[i], *bootstrap.intervals[i]))
        digits = decimals_for(sd) or 5
        numbers = [estimate.values[estimate.free_entries[i]], estimate.deviations[i], sd]
        table.add_row(name, *(f"{x:.{digits}f}" for x in numbers), f"{low:.{digits}f} to {high:.{digits}f}")
    return table
