"""``armcal maker``: a maker's calibration against the nominal arm, and as a URDF."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from armcal.base.domains import Array
from armcal.calibration.convert_poe_urdf import urdf_text
from armcal.calibration.exporter import POSES
from armcal.calibration.rigid_chain import turn_between
from armcal.cli.common import FILE, Console, spare_inputs, speaking
from armcal.cli.console import columned
from armcal.errors import InputError
from armcal.io.file_set import write_new, write_over
from armcal.io.plain_files import check_output

from armcal_makers.formats import MakersArm, read_maker
from armcal_makers.frames import differences, rigid, tips

_SEED = 1
_SAME_M = 1e-5
"""Two readings of a file that are nearer than this are not worth a warning."""


@click.command()
@click.argument("file", type=FILE)
@click.option("--robot", metavar="NAME", help="Which arm it is: ur5e, xarm6 [default: the nearest].")
@click.option("--out", type=FILE, help="The URDF to write.")
@click.option("--force", is_flag=True, help="Overwrite a file that is there.")
@speaking
def maker(console: Console, file: Path, robot: str | None, out: Path | None, force: bool) -> None:
    """Compare a maker's calibration with the nominal arm, and write it as a URDF for `armcal new robot --urdf`.

    FILE is the kinematics YAML of ur_calibration or xarm_ros2, or calibration.conf of a UR's controller.
    """
    if out is not None:
        spare_inputs(out, file)
        check_output(out, InputError)
    arm = read_maker(file, robot)
    if out is not None:
        (write_over if force else write_new)({out: _urdf(arm).encode()})
    _show(console, arm, out)


def _urdf(arm: MakersArm) -> str:
    """One link a joint, without masses; the hash of the calibration stands in a comment, where exporters find it."""
    chain = rigid(arm.frames, arm.nominal.joints, arm.nominal.family.limits)
    note = f"<!-- {arm.nominal.name}, from {arm.source}{f', {arm.hash}' if arm.hash else ''} -->\n"
    return note + urdf_text(chain, arm.nominal.name)


def _show(console: Console, arm: MakersArm, out: Path | None) -> None:
    nominal, commands = arm.nominal, _commands(arm)
    there, here = tips(arm.frames, commands), tips(nominal.frames, commands)
    apart = 1000 * np.linalg.norm(there[:, :3, 3] - here[:, :3, 3], axis=1)
    turned = np.degrees(np.linalg.norm(turn_between(here[:, :3, :3], there[:, :3, :3]), axis=1))
    joints = {
        name: {"shift_mm": 1000 * float(shift), "turn_deg": float(np.degrees(turn))}
        for name, shift, turn in zip(nominal.joints, *differences(arm.frames, nominal.frames), strict=True)
    }
    other = arm.other_order_m(commands)
    content = {
        "robot": nominal.name,
        "source": arm.source,
        "hash": arm.hash,
        "poses": POSES,
        "median_mm": float(np.median(apart)),
        "largest_mm": float(apart.max()),
        "largest_deg": float(turned.max()),
        "joints": joints,
        "other_order_mm": None if other is None else 1000 * other,
        "out": None if out is None else str(out),
    }
    console.result(content)
    console.line(f"{nominal.name} as its maker calibrated it, {arm.source} {arm.hash}".rstrip())
    console.line(
        f"flange against the nominal {nominal.name} in {POSES} random poses: median {content['median_mm']:.3f} mm, "
        f"at most {content['largest_mm']:.3f} mm and {content['largest_deg']:.3f} deg"
    )
    table = columned("Each joint against the nominal arm", ["joint", "shift, mm", "turn, deg"])
    for name, part in joints.items():
        table.add_row(name, f"{part['shift_mm']:.3f}", f"{part['turn_deg']:.4f}")
    console.out.print(table)
    if other is not None and other > _SAME_M:
        console.warn(
            "roll, pitch and yaw are read as a URDF, and so ROS, reads them. ur_calibration computes them in the other "
            f"order: so read, the flange is up to {1000 * other:.3f} mm elsewhere. calibration.conf has one reading."
        )
    if out is not None:
        console.line(f"written: {out}; next: armcal new robot NAME --urdf {out}")


def _commands(arm: MakersArm) -> Array:
    """Angles up to half a turn to either side (N x n; rad)."""
    random = np.random.default_rng(_SEED)
    return random.uniform(-np.pi, np.pi, (POSES, len(arm.frames)))
