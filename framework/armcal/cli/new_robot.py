"""What ``armcal new robot`` does with what it was given."""

import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from armcal import scaffold
from armcal.base.units import from_unit, parse_quantity
from armcal.cli.common import Console, command_line
from armcal.cli.console import say
from armcal.errors import EXIT_FAULT, EXIT_NOT_CONVERGED, ConfigError
from armcal.measure.tables import is_number
from armcal.plugins import PluginRegistry
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

CONVENTIONS: dict[str, Convention] = {"standard": "standard", "modified": "craig"}
SKELETONS = {path.stem: path for path in sorted(Path(scaffold.__file__).with_name("skeletons").glob("*.csv"))}
"""Rows of arms that many people have, in round numbers, by the name that begins one."""


def begin(console: Console, name: str, given: Mapping[str, Any], folder: Path) -> None:
    """Write the folder of a robot from what was given, calibrate its simulated records, and say how that went."""
    registry = console.registry()
    robot = _robot(robot_name(name), given, registry)
    up = direction(given["up"]) if given["up"] else robot.up
    robot = replace(robot, up=up, target=place(given["target"]) if given["target"] else robot.target)
    choice = write_robot(replace(robot, widths=_widths(given)), folder, registry)
    with console.progress() as progress:
        trial = try_out(folder, registry, command_line(), progress)
    content = {
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
    console.result(content)
    for text in trial.result.warnings:
        console.warn(text)
    console.line(f"{robot.name}: {len(robot.joints)} joints, {len(choice.deviations)} free parameters, in {folder}")
    if robot.name in SKELETONS and not (given["dh"] or given["urdf"]):
        console.line(f"{robot.name} is a skeleton of round numbers: correct arm.yaml, or begin with --urdf FILE")
    for note in robot.notes:
        console.line(f"{given['urdf']}: {note}")
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


def _widths(given: Mapping[str, Any]) -> dict[Unit, float]:
    stated = {unit: given[f"prior_{unit}"] for unit in WIDTHS}
    widths: dict[Unit, float] = {unit: WIDTHS[unit] if width is None else width for unit, width in stated.items()}
    for unit, width in widths.items():
        if not 0 < width < math.inf:
            hint = f"Give how far the robot may well be off its file (standard deviation, {unit})."
            raise ConfigError(f"found --prior-{unit} {width:g}, expected more than 0.", hint=hint)
    return widths


def _robot(name: str, given: Mapping[str, Any], registry: PluginRegistry) -> Robot:
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


def place(text: str) -> tuple[float, float, float]:
    """A point (m) from ``30,0,12.5`` in mm, or with units: ``3 cm, 0, 12.5 mm``.

    Raises:
        ConfigError: it is none.
    """
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
