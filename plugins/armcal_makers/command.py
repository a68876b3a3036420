"""``armcal maker``: a maker's calibration against the nominal arm, and as a URDF."""

from codecs import BOM_UTF8
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from armcal.base.arrays import Array
from armcal.calibration.convert_poe_urdf import urdf_text
from armcal.calibration.exporter import POSES
from armcal.calibration.rigid_chain import turn_between
from armcal.cli.common import FILE, Console, spare_inputs, speaking
from armcal.errors import ConfigError, InputError
from armcal.io.file_set import write_new, write_over
from armcal.io.plain_files import check_output

from armcal_makers.formats import MakersArm, has_offsets, read_text, text_in
from armcal_makers.frames import differences, rigid, tips
from armcal_makers.nodes import read_section
from armcal_makers.origins import OwnUrdf, Placed

_SEED = 1
_SAME_M = 1e-5
"""Two readings of a file that are nearer than this are not worth a warning."""
_OTHER_ORDER = (
    "roll, pitch and yaw are read as a URDF, and so ROS, reads them. ur_calibration computes them in the other order: "
    "so read, the flange is up to {:.3f} mm elsewhere. calibration.conf has one reading."
)


@click.command()
@click.argument("file", type=FILE)
@click.option("--robot", metavar="NAME", help="Which arm it is: ur5e, xarm6 [default: the nearest].")
@click.option("--urdf", type=FILE, help="The robot's own URDF, to put the calibration in.")
@click.option("--tip", metavar="LINK", help="The URDF's link at the arm's end, where there are several.")
@click.option("--out", type=FILE, help="The URDF to write.")
@click.option("--force", is_flag=True, help="Overwrite a file that is there.")
@speaking
def maker(
    console: Console,
    file: Path,
    robot: str | None,
    urdf: Path | None,
    tip: str | None,
    out: Path | None,
    force: bool,
) -> None:
    """Compare a maker's calibration with the nominal arm, and write it as a URDF for `armcal new robot --urdf`.

    FILE is the kinematics YAML of ur_calibration or xarm_ros2, calibration.conf of a UR's controller, or the offsets
    that robot_calibration found. With --urdf masses, limits and all else of the robot's own URDF stay.
    """
    if out is not None:
        spare_inputs(out, file, urdf)
        check_output(out, InputError)
    if urdf is None and tip is not None:
        raise ConfigError("found --tip without --urdf.", hint="Give --urdf FILE, or leave it out.")
    text = text_in(file)
    own = None if urdf is None else OwnUrdf.read(urdf, tip, console.registry())
    if own is not None and has_offsets(text, file):
        if robot is not None:
            raise ConfigError("found --robot, and offsets of a URDF's own joints.", hint="Leave --robot out.")
        comparison, content = _of_offsets(own.with_offsets(read_section(text, file)), own)
    else:
        arm = read_text(text, file, robot)
        placed = None if own is None else own.with_frames(dict(zip(arm.nominal.joints, arm.frames, strict=True)), file)
        comparison, content = _of_arm(arm), _urdf(arm, placed)
    if out is not None:
        (write_over if force else write_new)({out: content})
    _show(console, comparison, out)


@dataclass(frozen=True)
class Comparison:
    """What is shown: whose calibration, against what, flanges of both (2 x N x 4 x 4), joints' shifts (m, rad)."""

    title: str
    nominal: str
    tools: Array
    joints: Mapping[str, tuple[float, float]]
    facts: Mapping[str, Any]
    warnings: tuple[str, ...] = ()


def _of_arm(arm: MakersArm) -> Comparison:
    nominal = arm.nominal
    commands = np.random.default_rng(_SEED).uniform(-np.pi, np.pi, (POSES, len(arm.frames)))
    tools = np.array([tips(nominal.frames, commands), tips(arm.frames, commands)])
    parts = zip(*differences(arm.frames, nominal.frames), strict=True)
    other = arm.other_order_m(commands)
    warnings = () if other is None or other <= _SAME_M else (_OTHER_ORDER.format(1000 * other),)
    facts = {"robot": nominal.name, "source": arm.source, "hash": arm.hash}
    title = f"{nominal.name} as its maker calibrated it, {arm.source} {arm.hash}".rstrip()
    joints = dict(zip(nominal.joints, parts, strict=True))
    shown_mm = {"other_order_mm": None if other is None else 1000 * other}
    return Comparison(title, f"the nominal {nominal.name}", tools, joints, {**facts, **shown_mm}, warnings)


def _of_offsets(placed: Placed, own: OwnUrdf) -> tuple[Comparison, bytes]:
    unused = f"offsets of what is not between the root and the tip are left out: {', '.join(placed.unused)}."
    facts = {"source": "robot_calibration", "unused": list(placed.unused)}
    title, warnings = f"{own.path.name} with its offsets", (unused,) if placed.unused else ()
    return Comparison(title, own.path.name, placed.tools, placed.joints, facts, warnings), placed.content


def _urdf(arm: MakersArm, placed: Placed | None) -> bytes:
    """The robot's own URDF, or one link a joint; the calibration's hash in a comment, where exporters find it."""
    note = f"<!-- {arm.nominal.name}, from {arm.source}{f', {arm.hash}' if arm.hash else ''} -->\n"
    if placed is None:
        chain = rigid(arm.frames, arm.nominal.joints, arm.nominal.family.limits)
        return (note + urdf_text(chain, arm.nominal.name)).encode()
    in_ascii = (
        placed.content.removeprefix(BOM_UTF8).lstrip().startswith(b"<")
    )  # of other encodings the comment is left out
    return placed.content + note.encode() if in_ascii else placed.content


def _show(console: Console, comparison: Comparison, out: Path | None) -> None:
    before, now = comparison.tools
    apart = 1000 * np.linalg.norm(now[:, :3, 3] - before[:, :3, 3], axis=1)
    turned = np.degrees(np.linalg.norm(turn_between(before[:, :3, :3], now[:, :3, :3]), axis=1))
    sizes = {"median_mm": np.median(apart), "largest_mm": apart.max(), "largest_deg": turned.max()}
    joints = {
        name: {"shift_mm": 1000 * float(shift), "turn_deg": float(np.degrees(turn))}
        for name, (shift, turn) in comparison.joints.items()
    }
    numbers = {name: float(size) for name, size in sizes.items()}
    file = None if out is None else str(out)
    console.result({**comparison.facts, "poses": len(apart), **numbers, "joints": joints, "out": file})
    console.line(comparison.title)
    console.line(
        f"tool against {comparison.nominal} in {len(apart)} random poses: median {numbers['median_mm']:.3f} mm, "
        f"at most {numbers['largest_mm']:.3f} mm and {numbers['largest_deg']:.3f} deg"
    )
    rows = ((name, f"{part['shift_mm']:.3f}", f"{part['turn_deg']:.4f}") for name, part in joints.items())
    console.table("Each joint, on the one before it", ("joint", "shift, mm", "turn, deg"), rows)
    for warning in comparison.warnings:
        console.warn(warning)
    if out is not None:
        console.line(f"written: {out}; next: armcal new robot NAME --urdf {out}")
