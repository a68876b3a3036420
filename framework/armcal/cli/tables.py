"""Results as tables on a terminal."""

from __future__ import annotations

import math
from pathlib import Path

from rich.table import Table

from armcal.cli.common import Voice
from armcal.run.result import RunResult
from armcal.solve.validation import ErrorSummary

_SETS = {"train": "training", "holdout": "held out", "cross_validated": "cross-validated"}
_STYLES = {"bad": "bold red", "warning": "yellow", "note": "", "good": "green"}


def show_run(voice: Voice, result: RunResult, folder: Path, seconds: float) -> None:
    """The end of a run: errors, compliances, verdict, where the report is."""
    out = voice.out
    out.print(_errors(result))
    compliances = _compliances(result)
    if compliances.row_count:
        out.print(compliances)
    out.print(result.verdict.headline, style="bold", markup=False)
    for finding in result.verdict.findings:
        out.print(f"  {finding.grade}: {finding.text}", style=_STYLES[finding.grade], markup=False)
    out.print(f"report: {folder / 'report.html'}  ({seconds:.1f} s)", markup=False, soft_wrap=True)


def _errors(result: RunResult) -> Table:
    table = Table(title=f"Tip error, mm: {result.name}", title_justify="left")
    for column in ("records", "count", "", "mean", "rms", "95 %", "max"):
        table.add_column(column, justify="left" if column in ("records", "") else "right")
    for key, words in _SETS.items():
        before, after = result.table.nominal[key], result.table.calibrated[key]
        if not after.count:
            continue
        table.add_row(words, str(after.count), "nominal", *_numbers(before))
        table.add_row("", "", "calibrated", *_numbers(after), end_section=True)
    return table


def _numbers(summary: ErrorSummary) -> list[str]:
    return [f"{x:.3f}" if x is not None else "-" for x in (summary.mean, summary.rms, summary.p95, summary.max)]


def _compliances(result: RunResult) -> Table:
    estimate = result.estimate
    table = Table(title="Compliance, rad/(N m)", title_justify="left")
    for column in ("parameter", "value", "sd", "95 % interval", ""):
        table.add_column(column, justify="left" if column in ("parameter", "") else "right")
    for i, name in enumerate(estimate.names):
        if estimate.parameters[name.partition("[")[0]].unit != "rad_per_Nm":
            continue
        value, interval, sd = estimate.values[estimate.free_entries[i]], estimate.intervals[i], estimate.deviations[i]
        digits = _digits(float(sd))
        ends = f"{interval.lower:.{digits}f} to {interval.upper:.{digits}f}"
        span = f"up to {interval.upper:.{digits}f}" if interval.one_sided else ends
        flag = "at its bound" if name in estimate.at_bound else ("" if estimate.determined[i] else "not determined")
        table.add_row(name, f"{value:.{digits}f}", f"{sd:.{digits}f}", span, flag)
    return table


def _digits(deviation: float) -> int:
    """Decimals that show a standard deviation to two significant digits."""
    if not math.isfinite(deviation) or deviation <= 0:
        return 5
    return min(12, max(3, 1 - math.floor(math.log10(deviation))))
