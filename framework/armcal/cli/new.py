"""``armcal new``."""

from pathlib import Path
from typing import Any

import click

from armcal.cli.common import FILE, Console, speaking
from armcal.scaffold.plugin_files import KINDS, plugin_name, write_plugin


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
    from armcal.cli.new_robot import Source, begin  # all of the solver, which a plugin's files do without

    begin(console, name, Source(**source), out or Path(name))
