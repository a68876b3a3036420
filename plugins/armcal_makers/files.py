"""Makers' kinematics files, of ur_calibration and of xarm_ros2: a fixed transform before each joint, which turns about
its frame's z axis. ``armcal maker`` compares one with the nominal arm and writes it as a URDF; the exporters
``ur_calibration`` and ``xarm_kinematics`` write calibrated arms for their makers' drivers.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import casadi as ca
import click
import numpy as np
import yaml
from armcal.arm.model import Chain, forward
from armcal.base.arrays import Array
from armcal.base.quaternions import rpy_of
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
from armcal.config.yaml_source import Node, Origin, entries_of, read_nodes
from armcal.errors import ConfigError, DataError, Location, ProblemError
from armcal.io.plain_files import check_output, input_bytes, refuse, text_of, write_new, write_over
from scipy.spatial.transform import Rotation

HASH = re.compile(r"calib_\d+")
KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
# Frames of a calibrated arm further off the nominal ones are of another arm, or in other units
FARTHEST_M, FARTHEST_RAD = 0.03, math.radians(5)
_LONGEST_M, _WIDEST = 3.0, 2 * math.pi + 1e-6
_AGAIN = "Extract the file from the robot again."
_UNKNOWN = "Check units (m, rad), or use a URDF of the arm itself."
# A frame as near to its nominal one stays where it is; another is shifted along its axis, and turned about it
_NEAR_M, _NEAR_RAD = 0.02, 0.1
_ALONG = 0.9  # cosine to an axis beyond which a direction says too little of what is across it
_UR_JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", *(f"wrist_{i}_joint" for i in (1, 2, 3)))
_UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


@dataclass(frozen=True)
class Family:
    format: str  # what armcal calls their file
    base: str  # the frame that the first transform starts from, in the maker's own URDF
    flange: str  # the frame of the last joint, there
    limits: tuple[float, float] | None  # of all joints (rad), where they share them


UR = Family("ur_calibration", "base_link_inertia", "wrist_3_link", (-2 * math.pi, 2 * math.pi))
XARM = Family("xarm_kinematics", "link_base", "link_eef", None)


@dataclass(frozen=True)
class Nominal:
    """An arm as its maker draws it."""

    name: str  # ur5e, xarm6
    family: Family
    joints: tuple[str, ...]  # as the maker's URDF names them
    keys: tuple[str, ...]  # as the maker's calibration names them
    frames: Array  # parent_T_joint (n x 4 x 4)


@cache
def nominal_arms() -> Mapping[str, Nominal]:
    tables = yaml.safe_load((Path(__file__).parent / "arms.yaml").read_text(encoding="utf-8"))
    arms = []
    for name, (d1, a2, a3, d4, d5, d6) in tables["ur"].items():
        rows = ((0, 0, d1, 0), (0, 0, 0, 90), (a2, 0, 0, 0), (a3, 0, d4, 0), (0, -d5, 0, 90), (0, d6, 0, -90))
        frames = np.array([pose((x, y, z, math.radians(roll), 0, 0)) for x, y, z, roll in rows])
        arms.append(Nominal(name, UR, _UR_JOINTS, _UR_LINKS, frames))
    for name, rows in tables["xarm"].items():
        joints = tuple(f"joint{i}" for i in range(1, len(rows) + 1))
        frames = np.array([pose((*row[:3], *np.radians(row[3:]))) for row in rows])
        arms.append(Nominal(name, XARM, joints, joints, frames))
    return {arm.name: arm for arm in arms}


def nearest(candidates: Mapping[str, Array], where: Location | None = None) -> Nominal:
    """The nearest of the arms by whose names ``candidates`` has frames (parent_T_joint, n x 4 x 4)."""
    arms, off = nominal_arms(), {}
    for name, frames in candidates.items():
        shifts, turns = differences(at_zero(frames), at_zero(arms[name].frames))
        off[name] = float(shifts.max()), float(turns.max())
    if not off:
        raise DataError("it has other joints than the arms that armcal knows.", where=where, hint=_UNKNOWN)
    best = min(off, key=lambda candidate: off[candidate])
    shift, turn = off[best]
    if shift <= FARTHEST_M and turn <= FARTHEST_RAD:
        return arms[best]
    apart, limits = (
        f"{1000 * m:.3g} mm and {math.degrees(r):.2g} deg" for m, r in ((shift, turn), (FARTHEST_M, FARTHEST_RAD))
    )
    text = f"it is not a calibration of {best}, the nearest arm: {apart} off, expected {limits} at most."
    raise DataError(text, where=where, hint=_UNKNOWN)


def pose(six: Sequence[float]) -> Array:
    """x, y, z (m), roll, pitch, yaw (rad) about the fixed axes as a 4x4 matrix, Rz(yaw) Ry(pitch) Rx(roll) [URDF]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_euler("xyz", six[3:]).as_matrix(), six[:3]
    return matrix


def six_of(matrix: Array) -> list[float]:
    """x, y, z (m), roll, pitch, yaw (rad) of a 4x4 matrix, as a URDF has them."""
    return [round(float(value), 15) + 0.0 for value in (*matrix[:3, 3], *rpy_of(matrix[:3, :3]))]


def at_zero(frames: Array) -> Array:
    """base_T_joint at zero angles (n x 4 x 4) of parent_T_joint."""
    return np.array([np.linalg.multi_dot([np.eye(4), *frames[: i + 1]]) for i in range(len(frames))])


def tips(frames: Array, commands: Array) -> Array:
    """base_T_flange (N x 4 x 4) of parent_T_joint (n x 4 x 4) at commands (N x n; rad)."""
    poses = np.broadcast_to(np.eye(4), (len(commands), 4, 4))
    for frame, angles in zip(frames, commands.T, strict=True):
        turns = np.zeros((len(commands), 4, 4))
        turns[:, 3, 3] = 1
        turns[:, :3, :3] = Rotation.from_rotvec(np.outer(angles, (0, 0, 1))).as_matrix()
        poses = poses @ frame @ turns
    return poses


def placed(axes: Array, flange: Array, nominal: Array) -> Array:
    """Frames on the same axes, as near as these let them to nominal ones, all at zero angles (n x 4 x 4 each).

    A frame may lie anywhere on its axis: where rows of parallel axes put it hundreds of metres away, it comes back to
    its link, and the arm stays the same [UrCalibration]. The last one goes to the flange (4x4).
    """
    moved = []
    for axis, drawn in zip(axes, [*nominal[:-1], flange], strict=True):
        apart = np.linalg.norm(axis[:3, 3] - drawn[:3, 3])
        turned = Rotation.from_matrix(drawn[:3, :3].T @ axis[:3, :3]).magnitude()
        frame = axis.copy()
        if apart >= _NEAR_M or turned >= _NEAR_RAD or drawn is flange:
            z, point = axis[:3, 2], axis[:3, 3]
            frame[:3, :3] = about_z(z, drawn[:3, 0] if abs(z @ drawn[:3, 0]) < _ALONG else axis[:3, 0])
            frame[:3, 3] = point + z * (z @ (drawn[:3, 3] - point))
        moved.append(frame)
    return np.array(moved)


def about_z(z: Array, towards: Array) -> Array:
    """The rotation (3x3) with this z axis (unit), and x as near as that lets it to a direction."""
    x = towards - z * (z @ towards)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def differences(frames: Array, others: Array) -> tuple[Array, Array]:
    """Distances (n; m) and angles (n; rad) between frames."""
    turns = Rotation.from_matrix(others[:, :3, :3].transpose(0, 2, 1) @ frames[:, :3, :3]).magnitude()
    return np.linalg.norm(frames[:, :3, 3] - others[:, :3, 3], axis=1), np.asarray(turns)


@dataclass(frozen=True)
class MakersArm:
    """An arm as its maker measured it."""

    nominal: Nominal
    frames: Array  # parent_T_joint (n x 4 x 4)
    hash: str = ""  # by which the maker's driver knows the calibration (calib_...); empty where the file has none


def read_kinematics(text: str, path: Path) -> MakersArm:
    """An arm from the text of a maker's file; ``path`` names it in messages."""
    if text.lstrip().startswith("[") or "\n[mounting]" in text:
        hint = "Extract it from the robot with ur_calibration."
        refuse(path, "found a controller's calibration.conf, expected the kinematics YAML of the robot.", hint)
    arms = nominal_arms()
    root = read_nodes(text, Origin(str(path), path.parent), plain=str)
    if root is None or not (entries := entries_of(root)):
        hint = "Give the kinematics YAML of ur_calibration or xarm_ros2."
        refuse(path, "it holds no keys, expected a maker's calibration.", hint)
    section = entries.get("kinematics")
    if section is None or not (joints := entries_of(section)):
        listed = ", ".join(list(entries)[:12])
        _refuse(root, (), f"found {listed}, expected kinematics: and numbers under it.", "Check which file this is.")
    keys = [key for key, node in joints.items() if entries_of(node)]
    known = [arm for arm in arms.values() if set(arm.keys) == set(keys)]
    if not known:
        expected = f"{', '.join(arms['ur5e'].keys)} (UR), or joint1 to joint5, joint6 or joint7 (xArm)"
        text = f"found the joints {', '.join(keys)[:200] or 'none'}, expected {expected}."
        _refuse(section, ("kinematics",), text)
    rows = [_six(joints[key], ("kinematics", key)) for key in known[0].keys]
    frames = np.array([pose(row) for row in rows])
    nominal = nearest({arm.name: frames for arm in known}, Location(str(path)))
    if nominal.family is not UR:
        return MakersArm(nominal, frames)
    value = joints["hash"].value if "hash" in joints else ""
    if not (isinstance(value, str) and HASH.fullmatch(value)):
        hint = "Without it the driver cannot tell whose calibration it is. Extract the file from the robot again."
        shown = repr(str(value)[:40]) if value else "no hash"
        _refuse(section, ("kinematics",), f"found {shown}, expected hash: calib_ and a number.", hint)
    return MakersArm(nominal, frames, value)


def _six(section: Node, keys: tuple[str, ...]) -> list[float]:
    """The six numbers of a joint; makers' tools write exponents that configurations refuse."""
    entries, numbers = entries_of(section), []
    if set(entries) != set(KEYS):
        _refuse(section, keys, f"found {', '.join(entries) or 'nothing'}, expected {', '.join(KEYS)}.")
    for key in KEYS:
        node, value = entries[key], math.nan
        if isinstance(node.value, str):
            try:
                value = float(node.value)
            except ValueError:
                value = math.nan
        if not math.isfinite(value):
            shown = repr(node.value[:40]) if isinstance(node.value, str) else "a list or keys"
            _refuse(node, (*keys, key), f"found {shown}, expected a number.")
        if key in "xyz" and abs(value) > _LONGEST_M:
            text = f"found {key} {value:g}, expected metres of a link."
            _refuse(section, keys, text, "Divide millimetres by 1000.")
        if abs(value) > _WIDEST:
            text = f"found {key} {value:g}, expected radians: it looks like degrees."
            _refuse(section, keys, text, "Convert it to radians.")
        numbers.append(value)
    return numbers


def _refuse(node: Node, keys: tuple[str, ...], message: str, hint: str = _AGAIN) -> NoReturn:
    raise DataError(message, where=node.origin.at(node.line, keys), hint=hint)


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
