"""``armcal compensate``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.units import parse_quantity
from armcal.calibration.calibration import Calibration
from armcal.calibration.compensation import Compensator, sent
from armcal.calibration.recorded_range import beyond_records
from armcal.cli.common import FILE, Console, accept, arm, point, spare_inputs, speaking, within
from armcal.errors import InputError, Location
from armcal.report.document import Document
from armcal.run.compensate import Assessed, Bench, assess, check_units, commanded, summary, write_commands

_SHOWN = 5
_SAME_POINT_M = 1e-5
_AT_THE_TARGET_MM = 1e-3  # A command so near was found, and something else keeps the arm from it
_ARRIVES = {"tool": "by the tool frame's origin", "target": "by the measured target"}


@click.command()
@click.argument("calibration", type=FILE)
@click.option("--targets", required=True, type=FILE, help="A CSV of positions or poses.")
@click.option("--out", required=True, type=FILE, help="The CSV to write.")
@arm
@within
@click.option("--path", "kind", flag_value="path", help="The targets are a path: one after another, without jumps.")
@click.option("--start", multiple=True, metavar="JOINT=ANGLE", help="Where the arm comes from: --start 'q1=10 deg'.")
@point
@click.option(
    "--for",
    "controller",
    type=click.Choice(["nominal"]),
    help="Write poses for a controller that computes the nominal arm's inverse kinematics, in place of commands.",
)
@click.option("--angles", type=click.Choice(["deg", "rad"]), default="deg", show_default=True, help="Unit of commands.")
@accept
@speaking
def compensate(console: Console, calibration: Path, targets: Path, out: Path, angles: str, **options: Any) -> None:
    """Find what to command so that the arm in CALIBRATION, as it really is, arrives at targets."""
    spare_inputs(out, calibration, targets, options["within"])
    registry = console.registry()
    loaded = Calibration.load(calibration, registry, options["accept"])
    bench = Bench.of(loaded, options["arm"], options["within"], registry, options["point"] or "tool")
    goals, given = bench.read(targets, registry)
    for text in given.warnings:
        console.warn(text)
    compensator = bench.compensator(goals)
    check_units(targets, goals, compensator.reach)
    limits = zip(compensator.joints, compensator.limits, strict=True)
    free = [joint for joint, ends in limits if not np.isfinite(ends).all()]
    if free:
        console.warn(f"no limits are known of {', '.join(free)}: commands may lie beyond them. Give --within CONFIG.")
    target = bench.target
    if options["point"] is None and target is not None and target.distance > _SAME_POINT_M:
        x, y, z = 1000 * target.tool_T_target[:3, 3]
        console.warn(
            "these commands bring the tool frame's origin to the targets. The target that "
            f"{target.measurement} measured sits at ({x:.3f}, {y:.3f}, {z:.3f}) mm on the tool and arrives "
            f"{1000 * target.distance:.3g} mm away from them. "
            "To bring that one there, give --point target; otherwise --point tool."
        )
    start = _start(options["start"], compensator)
    reach = compensator.follow if options["kind"] == "path" else compensator.solve
    commands = reach(goals, start)
    assessed = assess(bench, compensator, goals, commands)
    poses = sent(bench.nominal(), goals, commands) if options["controller"] else None
    write_commands(out, compensator, goals, given, assessed, angles, poses)
    if kept := bench.calibration.record.prediction:
        reached = commanded(compensator, goals, commands).subset(np.flatnonzero(commands.reached))
        if text := beyond_records(kept.ranges, reached, {bench.arm: compensator.expression.arm})[1]:
            console.warn(text)
    _show(console, given, assessed, bench, out)


def _start(stated: Sequence[str], compensator: Compensator) -> Array | None:
    """Commands (n; rad or m); joints that are not named stand at zero."""
    if not stated:
        return None
    kinds = compensator.expression.arm.commanded
    at = dict.fromkeys(compensator.joints, 0.0)
    for text in stated:
        joint, equals, quantity = (part.strip() for part in text.partition("="))
        hint = "For example --start 'q1=10 deg'."
        if not equals or joint not in at:
            known = ", ".join(compensator.joints)
            raise InputError(
                f"found {text!r}, expected JOINT=ANGLE with a joint of {known}.", where=Location("--start"), hint=hint
            )
        try:
            at[joint] = parse_quantity(quantity, kinds[joint])
        except ValueError as fault:
            raise InputError(f"{joint}: {fault}", where=Location("--start"), hint=hint) from fault
    return np.array(list(at.values()))


def _show(console: Console, given: Dataset, assessed: Assessed, bench: Bench, out: Path) -> None:
    figures, commands = summary(assessed), assessed.commands
    missed = [
        {"id": name, "reason": reason, "nearest_mm": 1000 * float(distance) if np.isfinite(distance) else None}
        for name, reason, distance in zip(given.ids, commands.reasons, commands.distances, strict=True)
        if reason
    ]
    set_aside = [{"row": target.row, "reason": target.reason} for target in given.set_aside]
    offset = None if bench.target is None else [1000 * float(x) for x in bench.target.tool_T_target[:3, 3]]
    data = {**figures, "point": bench.point, "target_mm": offset, "missed": missed, "set_aside": set_aside}
    for target in missed[:_SHOWN]:
        away = target["nearest_mm"]
        console.warn(
            f"{target['id']}: {target['reason']}"
            + (f"; the nearest is {away:.3f} mm away" if isinstance(away, float) and away > _AT_THE_TARGET_MM else "")
        )
    if len(missed) > _SHOWN:
        console.warn(f"{len(missed) - _SHOWN} more targets cannot be reached; the file says why")
    for cell in set_aside[:_SHOWN]:
        console.warn(f"row {cell['row']} is set aside: {cell['reason']}")
    headline = f"{figures['reached']} of {figures['targets']} targets are reached, {_ARRIVES[bench.point]}."
    summary_texts = list[str]()
    if figures["reached"]:
        text = f"error {figures['error_mm']:.3g} mm by the calibration's model "
        text += f"(at most {figures['largest_error_mm']:.3g} mm)"
        if figures["nominal_error_mm"] is not None:
            text += f"; nominal commands: {figures['nominal_error_mm']:.3g} mm"
        if figures["radius_95_mm"] is not None:
            text += f"; measured places lie within {figures['radius_95_mm']:.3g} mm (95 %, median)"
        elif not bench.is_judged:
            text += "; how far the tool frame's origin is off is not known: only the target was measured, and where it "
            text += "sits on the tool was fitted (--point target)"
        summary_texts.append(text)
    console.show(Document("Commands", headline, [], summary=summary_texts, data=data), out=str(out))
    console.line(f"commands: {out}")
