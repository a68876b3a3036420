"""``armcal new`` and ``armcal demo``: files to begin with."""

from pathlib import Path
from typing import Any

import click

from armcal.cli.common import FILE, Console, speaking, unwritten
from armcal.errors import InputError, Location
from armcal.io.plain_files import write_new, writing
from armcal.scaffold.plugin_files import KINDS, plugin_name, write_plugin
from armcal.version import SOURCES

_CONFIG = "demo.yaml"


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def new() -> None:
    """Begin a plugin of your own, or the files of a robot."""


@new.command("plugin")
@click.argument("name")
@click.option("--kind", required=True, type=click.Choice(KINDS), help="What it adds to armcal.")
@click.option("--package", is_flag=True, help="To be installed by pip, in place of one file.")
@click.option("--out", type=FILE, help="The folder to make [default: armcal-NAME].")
@speaking
def new_plugin(console: Console, name: str, kind: str, package: bool, out: Path | None) -> None:
    """Write one file that adds a component called NAME, and a test of it: they work, and are yours to change."""
    registry = console.registry()
    chosen = plugin_name(name, registry)
    folder = out or Path(f"armcal-{chosen.replace('_', '-')}")
    files = write_plugin(chosen, kind, folder, package)
    console.result({"plugin": chosen, "kind": kind, "out": str(folder), "files": list(files)})
    for file in files:
        console.detail(str(folder / file))
    check = f"armcal plugins check {chosen} -v"
    after = ("pip install -e '.[test]'", check, "pytest") if package else (f"{check} --plugin {chosen}.py", "pytest")
    texts = (
        f"the {kind} {chosen}: {len(files)} files in {folder}",
        "next, in that folder:",
        *(f"  {c}" for c in after),
    )
    for text in texts:
        console.line(text)


@new.command("robot")
@click.argument("name")
@click.option("--dh", type=FILE, help="A CSV of Denavit-Hartenberg rows, units in its header.")
@click.option("--convention", type=click.Choice(("standard", "modified")), help="Of the rows in --dh.")
@click.option("--urdf", type=FILE, help="A URDF.")
@click.option("--tip", metavar="LINK", help="The URDF's link at the arm's end, where there are several.")
@click.option("--up", metavar="AXIS|X,Y,Z", help="Which way is up in the tracker's frame: z, -y, or three numbers.")
@click.option(
    "--target", metavar="X,Y,Z", help="Where the target sits in the tool's frame, in mm or as 2 cm [default: found]."
)
@click.option("--prior-mm", type=float, help="How far lengths may be off the file (standard deviation) [default: 10].")
@click.option("--prior-deg", type=float, help="The same of angles [default: 2].")
@click.option("--out", type=FILE, help="The folder to make [default: NAME].")
@speaking
def new_robot(console: Console, name: str, out: Path | None, **source: Any) -> None:
    """Write all that the robot NAME needs to be calibrated, and try it on simulated records.

    Give --dh with --convention, or --urdf; a robot called so101 has rows to begin with.
    """
    from armcal.cli.new_robot import begin  # all of the solver, which a plugin's files do without

    begin(console, name, source, out or Path(name))


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
