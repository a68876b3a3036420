"""``armcal maker``: a maker's calibration against the nominal arm, and as a URDF."""

from pathlib import Path

import click
import numpy as np
from armcal.calibration.convert import urdf_text
from armcal.calibration.exporter import POSES
from armcal.calibration.rigid_chain import RigidChain, RigidJoint, turn_between
from armcal.cli.common import FILE, Console, spare_inputs, speaking
from armcal.io.plain_files import check_output, input_bytes, text_of, write_new, write_over

from armcal_makers.arms import MakersArm, at_zero, differences, read_kinematics, tips

_MAX_BYTES, _SEED = 1 << 18, 1


@click.command()
@click.argument("file", type=FILE)
@click.option("--out", type=FILE, help="The URDF to write.")
@click.option("--force", is_flag=True, help="Overwrite a file that is there.")
@speaking
def maker(console: Console, file: Path, out: Path | None, force: bool) -> None:
    """Compare a maker's calibration with the nominal arm, and write it as a URDF for `armcal new robot --urdf`.

    FILE is the kinematics YAML of ur_calibration or of xarm_ros2.
    """
    if out is not None:
        spare_inputs(out, file)
        check_output(out)
    text = text_of(input_bytes(file, _MAX_BYTES, "a maker's calibration"), file, "Save the file as UTF-8.")
    arm = read_kinematics(text, file)
    if out is not None:
        (write_over if force else write_new)({out: _urdf(arm)})
    nominal = arm.nominal
    commands = np.random.default_rng(_SEED).uniform(-np.pi, np.pi, (POSES, len(arm.frames)))
    before, now = tips(nominal.frames, commands), tips(arm.frames, commands)
    apart = 1000 * np.linalg.norm(now[:, :3, 3] - before[:, :3, 3], axis=1)
    turned = np.degrees(np.linalg.norm(turn_between(before[:, :3, :3], now[:, :3, :3]), axis=1))
    sizes = {"median_mm": np.median(apart), "largest_mm": apart.max(), "largest_deg": turned.max()}
    sizes = {name: float(size) for name, size in sizes.items()}
    joints = {
        name: {"shift_mm": 1000 * float(shift), "turn_deg": float(np.degrees(turn))}
        for name, shift, turn in zip(nominal.joints, *differences(arm.frames, nominal.frames), strict=True)
    }
    facts = {"robot": nominal.name, "source": nominal.family.format, "hash": arm.hash, "poses": POSES}
    console.result({**facts, **sizes, "joints": joints, "out": None if out is None else str(out)})
    console.line(f"{nominal.name} as its maker calibrated it, {nominal.family.format} {arm.hash}".rstrip())
    console.line(
        f"tool against the nominal {nominal.name} in {POSES} random poses: median {sizes['median_mm']:.3f} mm, "
        f"at most {sizes['largest_mm']:.3f} mm and {sizes['largest_deg']:.3f} deg"
    )
    rows = ((name, f"{part['shift_mm']:.3f}", f"{part['turn_deg']:.4f}") for name, part in joints.items())
    console.table("Each joint, on the one before it", ("joint", "shift, mm", "turn, deg"), rows)
    if out is not None:
        console.line(f"written: {out}; next: armcal new robot NAME --urdf {out}")


def _urdf(arm: MakersArm) -> bytes:
    """One link a joint; the calibration's hash in a comment, where the exporter finds it."""
    nominal, zero, z = arm.nominal, at_zero(arm.frames), np.array([0.0, 0.0, 1.0])
    joints = [
        RigidJoint(name, frame, z, False, limits=nominal.family.limits)
        for name, frame in zip(nominal.joints, zero, strict=True)
    ]
    note = f"<!-- {nominal.name}, from {nominal.family.format}{f', {arm.hash}' if arm.hash else ''} -->\n"
    return (note + urdf_text(RigidChain(tuple(joints), np.eye(4), zero[-1]), nominal.name)).encode()
