"""What ``armcal new robot`` does."""

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from armcal.cli.common import Console, command_line
from armcal.cli.outlet import say
from armcal.cli.robot_questions import ask_rows, ask_up, direction, place
from armcal.errors import EXIT_FAULT, EXIT_NOT_CONVERGED, ConfigError
from armcal.plugins import PluginRegistry
from armcal.scaffold import dh_table
from armcal.scaffold.dh_table import read_rows
from armcal.scaffold.naming import robot_name
from armcal.scaffold.robot import WIDTHS, Convention, Robot, Unit, robot_of_rows
from armcal.scaffold.robot_files import try_out, write_robot
from armcal.scaffold.urdf_source import robot_of_urdf

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
        f"{trial.calibrated_mm:.3f} mm (the noise alone: {trial.noise_mm:.3f} mm)",
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
