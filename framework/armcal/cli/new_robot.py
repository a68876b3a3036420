"""What ``armcal new robot`` does, and what it asks for: the rows of an arm, each number with its unit."""

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click

from armcal.base.units import from_unit, parse_quantity
from armcal.cli.common import Console, command_line
from armcal.cli.outlet import say
from armcal.errors import EXIT_FAULT, EXIT_NOT_CONVERGED, ConfigError
from armcal.io.cells import is_number
from armcal.plugins import PluginRegistry
from armcal.scaffold import dh_table
from armcal.scaffold.dh_table import read_rows
from armcal.scaffold.naming import robot_name
from armcal.scaffold.robot import (
    ASSUMED_TRAVEL,
    ASSUMED_TURN,
    FEWEST_JOINTS,
    MOST,
    MOST_JOINTS,
    WIDTHS,
    Convention,
    Mass,
    Robot,
    RobotJoint,
    Row,
    Unit,
    robot_of_rows,
)
from armcal.scaffold.robot_files import try_out, write_robot
from armcal.scaffold.urdf_source import robot_of_urdf

_UNKNOWN = "unknown"
CONVENTIONS: dict[str, Convention] = {"standard": "standard", "modified": "craig"}
SKELETONS = {path.stem: path for path in sorted(Path(dh_table.__file__).with_name("skeletons").glob("*.csv"))}
"""Rows of arms that many people have, in round numbers, by the name that begins one."""


@dataclass(frozen=True)
class Source:
    """What a robot is made from, as given on the command line; it is asked for if nothing is given."""

    dh: Path | None
    convention: str | None
    urdf: Path | None
    tip: str | None
    up: str | None
    target: str | None
    prior_mm: float | None
    prior_deg: float | None


def begin(console: Console, name: str, source: Source, folder: Path) -> None:
    """Write a robot's folder, calibrate its simulated records, and say how that went."""
    registry = console.registry()
    robot = _robot(robot_name(name), source, registry)
    up, target = source.up, source.target
    if up is None and robot.has_masses and sys.stdin.isatty():  # gravity bends the arm, and somebody is there to ask
        up = ask_up()
    robot = replace(robot, up=direction(up) if up else robot.up, target=place(target) if target else robot.target)
    made = write_robot(replace(robot, widths=_widths(source)), folder, registry)
    with console.progress() as progress:
        trial = try_out(made, registry, command_line(), progress)
    content = {
        "robot": robot.name,
        "out": str(made.folder),
        "free": list(made.choice.kept),
        "redundant": [dropped.name for dropped in made.choice.redundant],
        "holdout_nominal_mm": trial.nominal_mm,
        "holdout_calibrated_mm": trial.calibrated_mm,
        "noise_alone_mm": trial.noise_mm,
        "verdict": trial.result.verdict.headline,
        "works": not trial.fault,
    }
    console.result(content)
    for text in trial.result.warnings:
        console.warn(text)
    console.line(f"{robot.name}: {len(robot.joints)} joints, {len(made.choice.kept)} free parameters, in {made.folder}")
    if robot.name in SKELETONS and not (source.dh or source.urdf):
        console.line(f"{robot.name} is a skeleton of round numbers: correct arm.yaml, or begin with --urdf FILE")
    assumed = [joint.name for joint in robot.joints if joint.assumed]
    if assumed:
        console.line(f"limits were assumed for {', '.join(assumed)}: correct them in plan.yaml before the arm moves")
    console.line(
        f"held-out tips of simulated records: nominal {trial.nominal_mm:.3f} mm, calibrated "
        f"{trial.calibrated_mm:.3f} mm (the noise alone: {trial.noise_mm:.3f} mm)"
    )
    findings = [f for f in trial.result.verdict.findings if f.grade in ("bad", "warning")]
    for finding in findings:
        console.line(f"{finding.grade}: {finding.text}")
    console.line(trial.result.verdict.headline)
    console.line(f"report: {trial.results / 'report.html'}; next: {made.folder / 'README.md'}")
    if trial.fault:
        say(f"armcal: {made.folder}: the calibration of simulated records failed: {trial.fault}.", err=True)
        sys.exit(EXIT_FAULT if trial.result.estimate.verdict.converged else EXIT_NOT_CONVERGED)


def _widths(source: Source) -> dict[Unit, float]:
    """Of the priors."""
    given: dict[Unit, float | None] = {"mm": source.prior_mm, "deg": source.prior_deg}
    widths = {**WIDTHS, **{unit: width for unit, width in given.items() if width is not None}}
    for unit, width in widths.items():
        if not 0 < width < math.inf:
            hint = f"Give how far the robot may well be off its file (standard deviation, {unit})."
            raise ConfigError(f"found --prior-{unit} {width:g}, expected more than 0.", hint=hint)
    return widths


def _robot(name: str, source: Source, registry: PluginRegistry) -> Robot:
    if source.dh and source.urdf:
        raise ConfigError("found both --dh and --urdf, expected one of them.", hint="Leave one out.")
    if source.tip and not source.urdf:
        raise ConfigError("found --tip without --urdf.", hint="Give --urdf FILE, or leave it out.")
    if source.convention and not source.dh:
        raise ConfigError("found --convention without --dh.", hint="Give --dh FILE, or leave it out.")
    if source.urdf:
        return robot_of_urdf(name, source.urdf, source.tip, registry)
    if not source.dh and name in SKELETONS:
        return robot_of_rows(name, "standard", read_rows(SKELETONS[name]))
    if not source.dh:
        return robot_of_rows(name, *ask_rows(CONVENTIONS))
    if source.convention is None:
        raise ConfigError(
            "found --dh without --convention: two go by the same name.",
            hint="Give --convention standard, Rot_z(theta) Trans_z(d) Trans_x(a) Rot_x(alpha), or modified, "
            "Rot_x(alpha) Trans_x(a) Rot_z(theta) Trans_z(d).",
        )
    return robot_of_rows(name, CONVENTIONS[source.convention], read_rows(source.dh))


def ask_rows(conventions: Mapping[str, Convention]) -> tuple[Convention, tuple[Row, ...]]:
    """The convention and the rows, from the terminal or standard input.

    Raises:
        ConfigError: the answers end early.
    """
    try:
        chosen = click.prompt("Denavit-Hartenberg rows", type=click.Choice(tuple(conventions)), default="standard")
        count = click.prompt("joints", type=click.IntRange(FEWEST_JOINTS, MOST_JOINTS))
        return conventions[chosen], tuple(_row(number) for number in range(1, count + 1))
    except click.Abort as fault:
        raise ConfigError(
            "the answers ended before the last question.", hint="Answer all of them, or give --dh FILE or --urdf FILE."
        ) from fault


def ask_up() -> str:
    """Which way is up, as ``direction`` takes it; empty if not known."""
    words = "up in the tracker's base frame (x, y, z, -x, -y, -z, three numbers, or unknown)"
    answer = click.prompt(
        words, default=_UNKNOWN, value_proc=lambda text: text if text == _UNKNOWN else _checked(direction, text)
    )
    return "" if answer == _UNKNOWN else str(answer)


def direction(text: str) -> tuple[float, float, float]:
    """A unit vector from ``z``, ``-y`` or ``0.1,0,0.99``.

    Raises:
        ConfigError: it is neither.
    """
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


def _checked(read: Callable[[str], object], text: str) -> str:
    """A text that can be read; else click asks again."""
    try:
        read(text)
    except ConfigError as fault:
        raise click.BadParameter(fault.message) from fault
    return text


def place(text: str) -> tuple[float, float, float]:
    """A point (m) from ``30,0,12.5`` in mm, or with units: ``3 cm, 0, 12.5 mm``.

    Raises:
        ConfigError: it is none.
    """
    try:
        x, y, z = (_quantity(part.strip(), "mm", "length") for part in text.split(","))
    except (ValueError, click.BadParameter) as fault:
        raise ConfigError(
            f"found {text!r} for the target, expected three lengths such as 30,0,12.5 (mm) or 3 cm,0,0.",
            hint="Give the target's place in the frame of the last row, or of the URDF's tip.",
        ) from fault
    return x, y, z


def _row(number: int) -> Row:
    name = f"q{number}"
    click.echo(f"joint {number}, {name}:", err=True)
    turns = click.prompt("  it is", type=click.Choice(("revolute", "prismatic")), default="revolute") == "revolute"
    alpha, a = _ask("  alpha", "deg", "angle"), _ask("  a", "mm", "length")
    theta, d = _ask("  theta", "deg", "angle"), _ask("  d", "mm", "length")
    unit, dimension = ("deg", "angle") if turns else ("mm", "length")
    low, high = (round(end / from_unit(1.0, unit)) for end in (ASSUMED_TURN if turns else ASSUMED_TRAVEL))
    lower = _ask("  lower limit", unit, dimension, default=low)
    upper = _ask("  upper limit", unit, dimension, default=high, above=lower)
    mass = _ask("  mass of its link, 0 if not known", "g", "mass", lowest=0.0)
    com = [_ask(f"  its centre, {axis} in the row's frame", "mm", "length") for axis in "xyz"] if mass else []
    known = Mass(mass, (com[0], com[1], com[2])) if mass else None
    return Row(RobotJoint(name, turns, (lower, upper)), alpha, a, theta, d, known)


def _ask(
    words: str, unit: str, dimension: str, default: float = 0, lowest: float = -math.inf, above: float | None = None
) -> float:
    """A number, in SI; asked in ``unit``, and taken in another one that is written behind it."""

    def read(text: Any) -> float:
        quantity = _quantity(str(text), unit, dimension)
        if quantity < lowest or (above is not None and quantity <= above):
            raise click.BadParameter(f"found {text}, expected more.")
        return quantity

    return float(click.prompt(f"{words}, {unit}", default=str(default), value_proc=read))


def _quantity(text: str, unit: str, dimension: str) -> float:
    if is_number(text):
        value = from_unit(float(text), unit)
    else:
        try:
            value = parse_quantity(text, dimension)
        except ValueError as fault:
            raise click.BadParameter(str(fault)) from fault
    if not abs(value) <= MOST[dimension]:
        raise click.BadParameter(f"found {text}, expected an arm's {dimension}.")
    return value
