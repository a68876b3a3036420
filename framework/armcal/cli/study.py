"""``armcal study``."""

from pathlib import Path

import click

from armcal.cli.common import FILE, Console, command_line, data, overrides, parallel, speaking
from armcal.io.folder import reserved
from armcal.io.parallel import Executor
from armcal.report.page import page
from armcal.report.study_document import study_document
from armcal.run.pipeline import Stopwatch
from armcal.run.study import FILES, Study, compare, files


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
