"""``armcal bus home``: homing offsets, after a question."""

import math
import sys
from datetime import datetime
from pathlib import Path

import click
from armcal.cli.common import FILE, Console
from armcal.errors import InputError

from armcal_servobus.configured import on_config, opened
from armcal_servobus.homing import Homing, corrected, held_at, keep, kept_offsets, planned, restored, write_offset
from armcal_servobus.joints import ServoJoint
from armcal_servobus.servos import Servos


@click.command("home")
@click.option("--at", "stated", multiple=True, metavar="JOINT=DEG", help="Where a joint stands now [default: 0].")
@click.option("--joint", "chosen", multiple=True, metavar="NAME", help="Only this joint; may be repeated.")
@click.option("--keep", "kept", type=FILE, help="The new file for the old values [default: beside CONFIG].")
@click.option("--calibration", type=FILE, help="Write the zeros that this calibration.yaml found: nothing is held.")
@click.option("--arm-name", metavar="NAME", help="Which arm of that calibration, where there are several.")
@click.option("--restore", type=FILE, help="Write the offsets of such a file back, in place of new ones.")
@click.option("--release", is_flag=True, help="Let servos go that hold; hold the arm.")
@click.option("--yes", is_flag=True, help="Write without asking.")
@on_config
def home_command(
    console: Console,
    config: Path,
    stated: tuple[str, ...],
    chosen: tuple[str, ...],
    kept: Path | None,
    calibration: Path | None,
    arm_name: str | None,
    restore: Path | None,
    release: bool,
    yes: bool,
    overrides: tuple[str, ...],
) -> None:
    """Set homing offsets, after a question.

    Afterwards the servos report the angles at which you hold the arm, or those that a calibration found. The
    differences are shown first, and what the servos hold is kept in a file.
    """
    with opened(config, overrides) as (wires, all_joints, checks, _):
        joints = _chosen(all_joints, chosen)
        targets = held_at(_angles(joints, stated))
        if calibration is not None:
            zeros = _zeros(console, calibration, arm_name, joints)
            joints, targets = {name: joints[name] for name in zeros}, corrected(zeros)
        elif restore is not None:
            targets = restored(kept_offsets(restore, joints))
        if release:
            for name in reversed(joints):
                Servos(wires, joints).release(joints[name])
        plans = planned(wires, joints, targets)
        _show_plans(console, config, plans)
        path = kept or config.with_name(f"{config.stem}.servos-{datetime.now():%Y%m%d-%H%M%S}.json")
        if not yes and not sys.stdin.isatty():
            raise InputError("nothing was written: there is no terminal to ask at.", hint="Give --yes.")
        if not yes and not click.confirm(f"Write these offsets to the servos? The old ones go to {path}.", err=True):
            raise InputError("nothing was written.", hint="Say yes, or give --yes.")
        keep(path, wires, joints)
        console.line(f"what the servos hold is kept in {path}; --restore writes it back.")
        checks.forget(joints)
        for plan in plans:
            write_offset(wires, plan)
    console.result({"kept": str(path), "offsets": {plan.joint.name: plan.content for plan in plans}})
    console.line("the offsets are written and read back.")
    if calibration is not None:
        console.line("Now the zeros of the configuration are those of before: set them to 0, and measure anew.")


def _zeros(console: Console, calibration: Path, arm: str | None, joints: dict[str, ServoJoint]) -> dict[str, float]:
    """The zeros (rad) that a calibration found, by joint; the joints without one are named."""
    from armcal.calibration.joint_zeros import zeros_of

    known, reasons = zeros_of(calibration, arm, console.registry())
    for name, reason in reasons.items():
        console.warn(f"{name} keeps its zero: {reason}.")
    by_local = {name: name.rpartition(".")[2] for name in joints}
    return {name: math.radians(known[local].degrees) for name, local in by_local.items() if local in known}


def _show_plans(console: Console, config: Path, plans: list[Homing]) -> None:
    rows = ((p.joint.name, p.joint.id, p.position, p.before, p.after, f"{math.degrees(p.change):+.2f}") for p in plans)
    console.table(str(config), ("joint", "id", "count", "offset", "new offset", "change deg"), rows)
    for plan in plans:
        if plan.finding:
            console.warn(f"{plan.joint.name}: the change is {plan.finding}")


def _chosen(joints: dict[str, ServoJoint], chosen: tuple[str, ...]) -> dict[str, ServoJoint]:
    if unknown := [name for name in chosen if name not in joints]:
        raise InputError(f"found no joint {unknown[0]}, expected one of {', '.join(joints)}.", hint="Correct --joint.")
    return {name: joint for name, joint in joints.items() if not chosen or name in chosen}


def _angles(joints: dict[str, ServoJoint], stated: tuple[str, ...]) -> dict[str, float]:
    """Angles (rad) from ``JOINT=DEG``."""
    angles = {}
    for text in stated:
        name, _, degrees = text.partition("=")
        try:
            angles[_chosen(joints, (name,))[name].name] = math.radians(float(degrees))
        except ValueError as fault:
            raise InputError(f"found --at {text}, expected JOINT=DEG.", hint="Write --at q2=90.") from fault
        if not math.isfinite(angles[name]):
            raise InputError(f"found --at {text}, expected a number of degrees.", hint="Write --at q2=90.")
    return angles
