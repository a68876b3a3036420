"""``armcal bus home``: homing offsets, after a question."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import click
from armcal.cli.common import FILE, Console
from armcal.cli.console import columned
from armcal.errors import InputError

from armcal_servobus.configured import on_config, opened
from armcal_servobus.homing import Homing, keep, kept_offsets, planned, write_offset
from armcal_servobus.joints import ServoJoint
from armcal_servobus.servos import Servos


@click.command("home")
@click.option("--at", "stated", multiple=True, metavar="JOINT=DEG", help="Where a joint stands now [default: 0].")
@click.option("--joint", "chosen", multiple=True, metavar="NAME", help="Only this joint; may be repeated.")
@click.option("--keep", "kept", type=FILE, help="The new file for the old values [default: beside CONFIG].")
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
    restore: Path | None,
    release: bool,
    yes: bool,
    overrides: tuple[str, ...],
) -> None:
    """Set homing offsets so that the servos report the angles at which you hold the arm.

    The differences are shown first, and the servos' old values are kept in a file.
    """
    with opened(config, overrides) as (wires, all_joints):
        joints = _chosen(all_joints, chosen)
        angles = _angles(joints, stated)
        if release:
            for name in reversed(joints):
                Servos(wires, joints).release(joints[name])
        plans = planned(wires, joints, angles)
        if restore is not None:
            offsets = kept_offsets(restore, joints)
            plans = [replace(plan, after=offsets[plan.joint.name], target=_restored(plan, offsets)) for plan in plans]
        _show_plans(console, config, plans)
        path = kept or config.with_name(f"{config.stem}.servos-{datetime.now():%Y%m%d-%H%M%S}.json")
        if not yes:
            if not sys.stdin.isatty():
                raise InputError("nothing was written: there is no terminal to ask at.", hint="Give --yes.")
            if not click.confirm(f"Write these offsets to the servos? The old ones go to {path}.", err=True):
                raise InputError("nothing was written.", hint="Say yes, or give --yes.")
        keep(path, wires, joints)
        for plan in plans:
            write_offset(wires, plan.joint, plan.after, plan.target)
    content = {
        p.joint.name: {"before": p.before, "after": p.after, "change_deg": math.degrees(p.change)} for p in plans
    }
    console.result({"kept": str(path), "offsets": content})
    console.line(f"written and read back. The old values are in {path}; --restore writes them back.")


def _restored(plan: Homing, offsets: dict[str, int]) -> int:
    """What a servo will report with its old offset (counts)."""
    model = plan.joint.model
    return (plan.position + model.offset_sign * (offsets[plan.joint.name] - plan.before)) % model.counts


def _show_plans(console: Console, config: Path, plans: list[Homing]) -> None:
    table = columned(str(config), ("joint", "id", "count", "offset", "new offset", "change deg"))
    for plan in plans:
        cells = (plan.joint.id, plan.position, plan.before, plan.after, f"{math.degrees(plan.change):+.2f}")
        table.add_row(plan.joint.name, *map(str, cells))
    console.out.print(table)
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
