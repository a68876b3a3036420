"""Makers' kinematics files: ``armcal maker`` reads one, against the nominal arm and as a URDF; the exporters
``ur_calibration`` and ``xarm_kinematics`` write calibrated arms for their makers' drivers.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import casadi as ca
import click
import numpy as np
import yaml
from armcal.arm.model import Chain, forward
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.calibration.convert import urdf_text
from armcal.calibration.exporter import POSES, Exported, ExportRequest, changed_numbers, random_commands
from armcal.calibration.rigid_chain import (
    RigidChain,
    RigidJoint,
    largest_difference,
    numeric_chain,
    require_plain_axes,
    rigid_chain,
    turn_between,
)
from armcal.cli.common import FILE, Console, spare_inputs, speaking
from armcal.errors import ConfigError, ProblemError
from armcal.io.plain_files import check_output, input_bytes, text_of, write_new, write_over

from armcal_makers.arms import (
    FARTHEST_M,
    FARTHEST_RAD,
    HASH,
    KEYS,
    UR,
    XARM,
    Family,
    MakersArm,
    about_z,
    at_zero,
    differences,
    nearest,
    nominal_arms,
    placed,
    read_kinematics,
    six_of,
    tips,
)

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


TOLERANCE = 1e-9  # m and rad
_NOTHING = 1e-7


class UrSettings(Settings):
    """The hash of the robot's own calibration (``calib_...``), which one whose URDF ``armcal maker`` wrote knows."""

    hash: str | None = None


class XarmExporter:
    """``kinematics:``, and six numbers of each joint: the file that ``kinematics_suffix`` names."""

    Settings: ClassVar[type[Settings]] = Settings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}
    family: ClassVar[Family] = XARM

    def __init__(self, settings: Any) -> None:
        self._settings = settings

    def export(self, request: ExportRequest) -> Exported:
        """The YAML, read again and compared in 1,000 poses."""
        scope = f"{request.name}.{request.arm.model_name}."
        values = {n.removeprefix(scope): v for n, v in request.values.items() if n.startswith(scope)}
        chain = numeric_chain(request.arm.model, values)
        axes, flange = _at_zero(chain, self.family)
        candidates = {}  # the arm whose links are nearest
        for name, arm in nominal_arms().items():
            if arm.family is self.family and len(arm.frames) == len(axes):
                drawn = at_zero(arm.frames)
                candidates[name] = _between(placed(axes, drawn[-1], drawn))
        nominal = nearest(candidates)
        drawn = at_zero(nominal.frames)
        shifted, turned = differences(flange[None], drawn[-1:])
        near = shifted[0] <= FARTHEST_M and turned[0] <= FARTHEST_RAD
        zero = placed(axes, flange if near else drawn[-1], drawn)
        sixes = (dict(zip(KEYS, six_of(frame), strict=True)) for frame in _between(zero))
        content = {"kinematics": {**dict(zip(nominal.keys, sixes, strict=True)), **self._more(request)}}
        head = f"# Calibrated by armcal: {nominal.name}; roll, pitch and yaw are about the fixed axes, as in a URDF.\n"
        text = (head + yaml.safe_dump(content, sort_keys=False)).encode()
        left = np.linalg.solve(zero[-1], flange)
        written = read_kinematics(text.decode(), Path(request.out or "kinematics.yaml"))
        commands = random_commands(request.arm).T
        poses = _flange_poses(chain, self.family, commands)[1]
        apart, turned_by = largest_difference(poses, tips(written.frames, commands) @ left)
        if not (apart <= TOLERANCE and turned_by <= 10 * TOLERANCE):
            raise ProblemError(
                f"what would be written is {apart:.3g} m and {turned_by:.3g} rad off the calibrated arm, "
                f"expected {TOLERANCE:g} at most.",
                hint="Nothing was written. Please report this with the calibration.",
            )
        return Exported(text, changed_numbers(request), tuple(request.arm.effects), remarks=_of_tool(left))

    def _more(self, request: ExportRequest) -> Mapping[str, str]:
        return {}


class UrExporter(XarmExporter):
    """``kinematics:``, six numbers of each link and a hash: the ``kinematics_params_file`` of the UR driver."""

    Settings: ClassVar[type[Settings]] = UrSettings
    family: ClassVar[Family] = UR

    def _more(self, request: ExportRequest) -> Mapping[str, str]:
        text = str(request.description.get("model", {}).get("text", ""))
        known = HASH.search(text)
        own = self._settings.hash or (known.group() if known else "")
        if not HASH.fullmatch(own):
            raise ConfigError(
                f"found {own!r}, expected the hash of the robot's own calibration." if own else "found no hash.",
                hint="Give --option hash=calib_..., as the robot's own kinematics YAML has it.",
            )
        return {"hash": own}


def _between(zero: Array) -> Array:
    """parent_T_joint (n x 4 x 4) of base_T_joint at zero angles."""
    return np.concatenate([zero[:1], np.linalg.solve(zero[:-1], zero[1:])])


def _flange_poses(chain: Chain, family: Family, commands: Array) -> tuple[Array, Array]:
    """The maker's base (4x4), and its flange at commands (N x n; rad) in it (N x 4 x 4).

    They are links of the maker's own URDF; of another model the base of its first row, and its tool.
    """
    symbols = ca.SX.sym("commands", len(chain.joints))
    frames = forward(chain, [joint.offset + symbols[i] for i, joint in enumerate(chain.joints)], {})
    start, end = chain.frames.get(family.base), chain.frames.get(family.flange)
    base = frames.named[family.base] if start is not None and start.joint == 0 else chain.base_T_mount
    at_end = end is not None and end.joint == len(chain.joints)
    flange = frames.named[family.flange] if at_end else frames.base_T_tool
    stacked = ca.horzcat(*[ca.vec(ca.densify(ca.SX(part.matrix()).T)) for part in (base, flange)])
    function = ca.Function("ends", [symbols], [stacked[:, 0], stacked[:, 1]], {"cse": True}).map(len(commands))
    base_T_bases, base_T_flange = (np.asarray(part.full()).T.reshape(-1, 4, 4) for part in function(commands.T))
    return base_T_bases[0], np.linalg.solve(base_T_bases, base_T_flange)


def _at_zero(chain: Chain, family: Family) -> tuple[Array, Array]:
    """Frames with z along the joints' axes (n x 4 x 4), and the flange (4x4), at zero angles in the maker's base."""
    arm = rigid_chain(chain)
    require_plain_axes(arm, family.format)
    wrong = [joint.name for joint in arm.joints if joint.slides or joint.mimic is not None]
    if wrong:
        raise ConfigError(f"{', '.join(wrong)} slides or follows another joint.", hint="Export it as a URDF.")
    base, flange = _flange_poses(chain, family, np.zeros((1, len(chain.joints))))
    frames = [np.array(joint.base_T_joint) for joint in arm.joints]
    for joint, frame in zip(arm.joints, frames, strict=True):
        if np.abs(joint.axis - (0, 0, 1)).max() > 1e-12:
            frame[:3, :3] = about_z(joint.direction, frame[:3, int(np.argmin(np.abs(joint.axis)))])
    return np.asarray(np.linalg.solve(base, np.array(frames))), flange[0]


def _of_tool(left: Array) -> tuple[str, ...]:
    x, y, z, *angles = six_of(left)
    if max(map(abs, (x, y, z, *angles))) <= _NOTHING:
        return ()
    roll, pitch, yaw = np.degrees(angles)
    return (
        f"the arm's tool is not at the flange of the file: give it to the robot as a tool (TCP) of x {1000 * x:.3f}, "
        f"y {1000 * y:.3f}, z {1000 * z:.3f} mm, roll {roll:.4f}, pitch {pitch:.4f}, yaw {yaw:.4f} deg",
    )
