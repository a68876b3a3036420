"""``armcal study``."""

from pathlib import Path

import click

from armcal.cli.common import FILE, Console, command_line, data, overrides, parallel, speaking
from armcal.io.folder import reserved
from armcal.io.parallel import Executor
from armcal.report.study_page import PAGE_ONLY, conclusions, render_study, study_tables
from armcal.run import study_result
from armcal.run.prepare import Stopwatch
from armcal.run.study import Study, compare


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
    kept = click.get_current_context().with_resource(reserved(folder, study_result.FILES))
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
    kept.place(study_result.files(result, configured.source, sources, render_study(result)))
    console.result({**result.as_dict(), "folder": str(folder)})
    for table in study_tables(result):
        places = [i for i, (name, _) in enumerate(table.headings) if name not in PAGE_ONLY]
        names, rows = [table.headings[i] for i in places], [[row[i] for i in places] for row in table.rows]
        words = [name for name, is_number in names if not is_number]
        console.table(f"{result.name}: {table.caption}", [name for name, _ in names], rows, left=words)
    for sentence in conclusions(result):
        console.line(sentence)
    console.line(f"page: {folder / 'study.html'}  ({watch.total():.1f} s)")
