"""``armcal study``."""

from pathlib import Path

import click

from armcal.cli.common import FILE, Console, command_line, data, overrides, parallel, speaking
from armcal.io.folder import reserved
from armcal.io.parallel import Executor
from armcal.report.study_page import conclusions, render_study, transfer_conclusions, transfer_table
from armcal.run import study_result
from armcal.run.load_transfer import transfer
from armcal.run.model_study import compare
from armcal.run.prepare import Stopwatch
from armcal.run.study import LoadTransferSettings, Study
from armcal.run.study_result import StudyResult, TransferResult


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
    """Compare the variants that CONFIG lists by cross-validated error, or by load transfer."""
    watch = Stopwatch()
    folder = out or Path("runs") / config.stem
    kept = click.get_current_context().with_resource(reserved(folder, study_result.FILES))
    registry = console.registry()
    configured = Study.load(config, overrides, data, registry)
    result: StudyResult | TransferResult
    with console.progress() as progress:
        if isinstance(configured.settings, LoadTransferSettings):
            result = transfer(configured, parallel, command_line(), progress, watch)
        else:
            result = compare(configured, parallel, command_line(), progress, watch)
    for text in result.warnings:
        console.warn(text)
    for stage, seconds in result.seconds.items():
        console.detail(f"{stage}: {seconds:.3f} s")
    result.seconds["total"] = watch.total()
    kept.place(study_result.files(result, configured, render_study(result)))
    console.result({**result.as_dict(), "folder": str(folder)})
    if isinstance(result, StudyResult):
        _show_study(console, result)
    else:
        shown = transfer_table(result)
        words = [name for name, is_number in shown.headings if not is_number]
        console.table(f"{result.name}: {shown.caption}", [name for name, _ in shown.headings], shown.rows, left=words)
        for sentence in transfer_conclusions(result):
            console.line(sentence)
    console.line(f"page: {folder / 'study.html'}  ({watch.total():.1f} s)")


def _show_study(console: Console, result: StudyResult) -> None:
    records = f"{len(result.dataset)} records, {result.folds} folds"
    records += f" drawn {result.repeats} times" if result.repeats > 1 else ""
    title = f"{result.name}: mean error, {result.unit}; cross-validated (cv): {records}"
    turned = any(v.turns for v in result.variants)
    columns = ("variant", "free", "train", "cv", "cv 95 %", "change", "± se", "helps", *(["cv, deg"] if turned else []))
    rows: list[tuple[object, ...]] = []
    for v in result.variants:
        moved = ["", "", ""]
        if v.change:
            moved = [f"{v.change.mean:+.3f}", f"{v.change.standard_error:.3f}", f"{v.change.helped:.0%}"]
        figures = ["-" if x is None else f"{x:.3f}" for x in (v.train.mean, v.crossed.mean, v.crossed.p95)]
        if v.failed_folds:  # over fewer records than the others
            figures[1:] = [f"({x})" for x in figures[1:]]
        turns = [f"{v.turns.crossed.mean:.3f}" if v.turns.crossed.mean is not None else "-"] if v.turns else []
        rows.append((v.name, v.free, *figures, *moved, *turns))
        console.detail(f"{v.name}: {v.fit_seconds:.2f} s for the fit on all records, {v.seconds:.2f} s for all fits")
    console.table(title, columns, rows)
    for text in conclusions(result):
        console.line(text)
