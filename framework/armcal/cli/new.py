"""``armcal new`` and ``armcal demo``: files to begin with."""

import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from armcal import scaffold
from armcal.base.units import from_unit, parse_quantity
from armcal.cli.common import FILE, Console, command_line, say, speaking, unwritten
from armcal.cli.run import run
from armcal.errors import EXIT_FAULT, EXIT_NOT_CONVERGED, ConfigError, InputError, Location
from armcal.io.plain_files import write_new, writing
from armcal.measure.tables import is_number
from armcal.plugins import PluginRegistry
from armcal.scaffold.plugin_files import KINDS, plugin_name, write_plugin
from armcal.scaffold.robot import (
    MOST,
    NOISE_ALONE_MM,
    RESULTS,
    WIDTHS,
    Convention,
    Robot,
    Unit,
    read_rows,
    robot_name,
    robot_of_rows,
    robot_of_urdf,
    try_out,
    write_robot,
)
from armcal.version import SOURCES

_CONFIG = "demo.yaml"
CONVENTIONS: dict[str, Convention] = {"standard": "standard", "modified": "craig"}
SKELETONS = {path.stem: path for path in sorted(Path(scaffold.__file__).with_name("skeletons").glob("*.csv"))}
"""Rows of arms that many people have, in round numbers, by the name that begins one."""


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
    folder, registry = out or Path(name), console.registry()
    robot = _described(robot_name(name), source, registry)
    up = direction(source["up"]) if source["up"] else robot.up
    robot = replace(robot, up=up, target=place(source["target"]) if source["target"] else robot.target)
    stated = {unit: source[f"prior_{unit}"] for unit in WIDTHS}
    widths: dict[Unit, float] = {unit: WIDTHS[unit] if width is None else width for unit, width in stated.items()}
    for unit, width in widths.items():
        if not 0 < width < math.inf:
            hint = f"Give how far the robot may well be off its file (standard deviation, {unit})."
            raise ConfigError(f"found --prior-{unit} {width:g}, expected more than 0.", hint=hint)
    choice = write_robot(replace(robot, widths=widths), folder, registry)
    with console.progress() as progress:
        trial = try_out(folder, registry, command_line(), progress)
    result = {
        "robot": robot.name,
        "out": str(folder),
        "free": list(choice.kept),
        "redundant": [dropped.name for dropped in choice.redundant],
        "holdout_nominal_mm": trial.nominal_mm,
        "holdout_calibrated_mm": trial.calibrated_mm,
        "noise_alone_mm": NOISE_ALONE_MM,
        "verdict": trial.result.verdict.headline,
        "works": not trial.fault,
    }
    console.result(result)
    for text in trial.result.warnings:
        console.warn(text)
    console.line(f"{robot.name}: {len(robot.joints)} joints, {len(choice.deviations)} free parameters, in {folder}")
    if robot.name in SKELETONS and not (source["dh"] or source["urdf"]):
        console.line(f"{robot.name} is a skeleton of round numbers: correct arm.yaml, or begin with --urdf FILE")
    for note in robot.notes:
        console.line(f"{source['urdf']}: {note}")
    assumed = [joint.name for joint in robot.joints if joint.assumed]
    if assumed:
        console.line(f"limits were assumed for {', '.join(assumed)}: correct them in plan.yaml before the arm moves")
    console.line(
        f"held-out tips of simulated records: nominal {trial.nominal_mm:.3f} mm, calibrated "
        f"{trial.calibrated_mm:.3f} mm (the noise alone: {NOISE_ALONE_MM:.3f} mm)"
    )
    findings = [f for f in trial.result.verdict.findings if f.grade in ("bad", "warning")]
    for finding in findings:
        console.line(f"{finding.grade}: {finding.text}")
    console.line(trial.result.verdict.headline)
    console.line(f"report: {folder / RESULTS / 'report.html'}; next: {folder / 'README.md'}")
    if trial.fault:
        say(f"armcal: {folder}: the calibration of simulated records failed: {trial.fault}.", err=True)
        sys.exit(EXIT_FAULT if trial.result.estimate.verdict.converged else EXIT_NOT_CONVERGED)


def _described(name: str, given: Mapping[str, Any], registry: PluginRegistry) -> Robot:
    dh, urdf, convention = (given[key] for key in ("dh", "urdf", "convention"))
    if dh and urdf:
        raise ConfigError("found both --dh and --urdf, expected one of them.", hint="Leave one out.")
    if given["tip"] and not urdf:
        raise ConfigError("found --tip without --urdf.", hint="Give --urdf FILE, or leave it out.")
    if convention and not dh:
        raise ConfigError("found --convention without --dh.", hint="Give --dh FILE, or leave it out.")
    if urdf:
        return robot_of_urdf(name, urdf, given["tip"], registry)
    if not dh and name in SKELETONS:
        return robot_of_rows(name, "standard", read_rows(SKELETONS[name], registry))
    if not dh:
        raise ConfigError(
            f"found no description of the robot {name}, expected a file of it, or the name of a known skeleton "
            f"({', '.join(SKELETONS)}).",
            hint="Give --dh FILE with --convention, or --urdf FILE.",
        )
    if convention is None:
        raise ConfigError(
            "found --dh without --convention: two go by the same name.",
            hint="Give --convention standard, Rot_z(theta) Trans_z(d) Trans_x(a) Rot_x(alpha), or modified, "
            "Rot_x(alpha) Trans_x(a) Rot_z(theta) Trans_z(d).",
        )
    return robot_of_rows(name, CONVENTIONS[convention], read_rows(dh, registry))


def direction(text: str) -> tuple[float, float, float]:
    """A unit vector from ``z``, ``-y`` or ``0.1,0,0.99``."""
    sign, axis = (-1.0, text[1:]) if text.startswith("-") else (1.0, text)
    if axis in ("x", "y", "z"):
        return sign * (axis == "x"), sign * (axis == "y"), sign * (axis == "z")
    parts = [part.strip() for part in text.split(",")]
    numbers = [float(part) for part in parts if is_number(part)]
    length = math.hypot(*numbers)
    if len(numbers) != len("xyz") or len(parts) != len("xyz") or not 0 < length < math.inf:
        raise ConfigError(
            f"found {text!r} for up, expected x, y, z, -x, -y, -z or three numbers such as 0.02,0,0.9998.",
            hint="Give the direction in the tracker's base frame that points away from the ground.",
        )
    x, y, z = (number / length for number in numbers)
    return x, y, z


def place(text: str) -> tuple[float, float, float]:
    """A point (m) from ``30,0,12.5`` in mm, or with units: ``3 cm, 0, 12.5 mm``."""
    try:
        parts = [part.strip() for part in text.split(",")]
        x, y, z = (from_unit(float(p), "mm") if is_number(p) else parse_quantity(p, "length") for p in parts)
        if not all(abs(value) <= MOST["length"] for value in (x, y, z)):
            raise ValueError(f"{text} is longer than an arm")
    except ValueError as fault:
        raise ConfigError(
            f"found {text!r} for the target, expected three lengths such as 30,0,12.5 (mm) or 3 cm,0,0.",
            hint="Give the target's place in the frame of the last row, or of the URDF's tip.",
        ) from fault
    return x, y, z


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
