"""``armcal demo``."""

from pathlib import Path

import click

from armcal.cli.common import FILE, Console, speaking, unwritten
from armcal.errors import InputError, Location
from armcal.io.plain_files import write_new, writing
from armcal.version import SOURCES

_CONFIG = "demo.yaml"


@click.command()
@click.argument("name", default="lrm_arm")
@click.option("--out", type=FILE, help="The folder to make [default: armcal-demo-NAME].")
@speaking
@click.pass_context
def demo(ctx: click.Context, console: Console, name: str, out: Path | None) -> None:
    """Copy a demonstration's files and calibrate its simulated arm.

    NAME is lrm_arm (cheap servos, a tracker), ball (a ball in sockets), camera (a camera and a board), or another
    that `armcal demo list` shows. The files are yours to change.
    """
    demos = {path.parent.name: path.parent for path in sorted(_shipped().glob(f"*/{_CONFIG}"))}
    if name == "list":
        console.result({"demos": list(demos)})
        for known in demos:
            console.line(known)
        return
    if name not in demos:
        hint = f"The demonstrations are {', '.join(demos)}."
        raise InputError(f"found {name!r}, expected a demonstration.", where=Location("NAME"), hint=hint)
    folder = out or Path(f"armcal-demo-{name}")
    source = demos[name]
    files = {folder / path.relative_to(source): path.read_bytes() for path in source.rglob("*") if path.is_file()}
    with writing(folder, "Give --out a place that can be written."):
        missing = unwritten(files)
        if changed := next((path for path in missing if path.exists()), None):
            hint = "Give another --out, or run it with armcal run."
            raise InputError("it is there and was changed.", where=Location(str(changed)), hint=hint)
        folder.mkdir(parents=True, exist_ok=True)
        write_new(missing)
    results = folder / "results"
    console.line(f"the files of {name} are in {folder}; armcal run {folder / _CONFIG} --out {results}")
    from armcal.cli.run import run  # all of the solver

    spoken = {"--json": console.json, "-q": console.quiet, "-v": console.verbose}
    options = [option for option, is_given in spoken.items() if is_given]
    arguments = [str(folder / _CONFIG), "--out", str(results), *options]
    with run.make_context("run", arguments, parent=ctx.parent) as running:
        run.invoke(running)
    for text in (
        f"Open {results / 'report.html'} in a browser. Then:",
        f"  armcal identify {folder / _CONFIG}",
        f"  armcal predict {results / 'calibration.yaml'} --poses {folder / 'demo.csv'} --out predicted.csv",
        "  armcal new robot NAME --urdf FILE      for an arm of your own",
    ):
        console.line(text)


def _shipped() -> Path:
    """Where the demonstrations are: beside the core once it is installed, in a checkout in ``configs``."""
    installed = SOURCES / "demos"
    return installed if installed.is_dir() else SOURCES.parents[1] / "configs"
