"""A chain as Denavit-Hartenberg rows: the settings of the model ``mdh``. [Denavit1955] [Craig2005]

From each axis to the next by their common normal. Where two axes are nearly parallel it lies far away, or nowhere:
there the next frame sits in the plane across the axis before, and a further turn about y takes up what is left.
[Hayati1983]
A sliding joint's axis may lie anywhere; it is taken through the joint's frame.
"""

import math
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from xml.sax.saxutils import quoteattr

import numpy as np

from armcal.arm.assembly import MassiveModel
from armcal.arm.model import ArmModel, Chain
from armcal.base.arrays import Array
from armcal.base.config_text import shown
from armcal.base.quaternions import quaternion_of, rpy_of
from armcal.calibration.calibration import Calibration, arm_named
from armcal.calibration.rigid_chain import (
    RigidChain,
    largest_difference,
    numeric_chain,
    random_commands,
    require_independent,
    require_plain_axes,
    rigid_chain,
    tool_poses,
)
from armcal.config.system import build_component
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.errors import ConfigError, Location
from armcal.plugins import PluginRegistry

POSES = 10_000
_SEED = 1
_SAME_MOUNT = 1e-9


@dataclass(frozen=True)
class ConvertSource:
    arm: str  # the arm's instance name
    chain: Chain  # of constants: nominal ones of a configuration, calibrated ones of a calibration
    left: tuple[str, ...]  # what of the file belongs to the arm and is not in the chain, in words


@dataclass(frozen=True)
class Difference:
    """Between two chains, the largest over random poses."""

    position_m: float
    angle_rad: float
    poses: int
    same_mount: bool


def load_source(path: str | Path, arm: str | None, registry: PluginRegistry) -> ConvertSource:
    source = load_config(path)
    arms = source.data.get("arms")
    if not isinstance(arms, dict) or not arms:
        hint = "Give a configuration or a calibration.yaml."
        raise ConfigError("found no arms.", where=Location(str(source.path)), hint=hint)
    name = arm_named([str(own) for own in arms], arm, source.where(("arms",)))
    if not isinstance(arms[name], dict) or "model" not in arms[name]:
        source.refuse(("arms", name), f"the arm {name!r} has no model.", "Write model: {type: NAME, ...}.")
    if "armcal_calibration" in source.data:
        loaded = Calibration.load(path, registry)
        source_arm = loaded.system.arms[name]
        scope, values = f"{name}.{source_arm.model_name}.", loaded.parameters.nominal()
        blocks = [block for block in loaded.parameters.blocks if block.name.startswith(scope)]
        own = {b.name.removeprefix(scope): values[loaded.parameters.entries_of(b.name)] for b in blocks}
        return ConvertSource(name, *_described(source, name, source_arm.model, own))
    model = build_component(source, registry, "model", ("arms", name, "model"))[0]
    return ConvertSource(name, *_described(source, name, model, nominal_values(model)))


def nominal_values(model: ArmModel) -> dict[str, Array]:
    return {block.name: np.array(block.nominal) for block in model.parameters()}


def reload(text: str, registry: PluginRegistry) -> Chain:
    content = ("arms:\n  arm:\n" + textwrap.indent(text, "    ")).encode()
    source = load_config("converted.yaml", content=content)
    model = build_component(source, registry, "model", ("arms", "arm", "model"))[0]
    return numeric_chain(model, nominal_values(model))


def difference(one: Chain, two: Chain) -> Difference:
    known = rigid_chain(one)
    commands = random_commands(known, POSES, _SEED)
    same_mount = bool(np.abs(known.base_T_mount - rigid_chain(two).base_T_mount).max() < _SAME_MOUNT)
    return Difference(*largest_difference(tool_poses(one, commands), tool_poses(two, commands)), POSES, same_mount)


def _described(
    source: ConfigSource, name: str, model: ArmModel, values: Mapping[str, Array]
) -> tuple[Chain, tuple[str, ...]]:
    chain = numeric_chain(model, values)
    arm = source.data["arms"][name]
    parts = {key: arm[key] for key in ("effects", "links") if isinstance(arm.get(key), dict) and arm[key]}
    left = [f"{key} ({', '.join(map(str, part))})" for key, part in parts.items()]
    if isinstance(model, MassiveModel) and model.masses():
        left.append(f"masses ({', '.join(mass.name for mass in model.masses())})")
    left += [key for key in arm if str(key).startswith(("placement", "joint_noise", "residual", "couplings"))]
    used = [link.get("frame") for link in parts.get("links", {}).values() if isinstance(link, dict)]
    named = [frame for frame in chain.frames if frame in used]
    left += [f"frames ({', '.join(named)})"] if named else []
    stated = source.data.get("parameters")
    left += ["free parameters, priors and bounds"] if isinstance(stated, dict) else []
    return chain, tuple(left)


_DIGITS = 15
BASE, TIP = "base_link", "tip_link"
UNKNOWN = "0"  # What a URDF has to state and nobody knows: effort, velocity, and the travel of a sliding joint


def poe_section(chain: RigidChain) -> dict[str, Any]:
    require_independent(chain, "poe")
    require_plain_axes(chain, "poe")
    joints = [
        {
            "name": joint.name,
            "kind": "prismatic" if joint.slides else "revolute",
            "axis": numbers(joint.direction),
            "point_m": numbers(joint.point),
        }
        for joint in chain.joints
    ]
    section: dict[str, Any] = {"type": "poe", "joints": joints, "tool": _pose(chain.base_T_tool)}
    if np.abs(chain.base_T_mount - np.eye(4)).max() > 0:
        section["mount"] = _pose(chain.base_T_mount)
    return section


def numbers(values: Array) -> list[float]:
    return [round(float(value), _DIGITS) + 0.0 for value in values]


def _pose(pose: Array) -> dict[str, Any]:
    return {"position_m": numbers(pose[:3, 3]), "quaternion": numbers(np.array(quaternion_of(pose[:3, :3])))}


def urdf_text(chain: RigidChain, name: str) -> str:
    """A URDF without shapes and masses, one link a joint. Lengths in m, angles in rad.

    Links are ``base_link``, ``link1``, ..., ``tip_link``; joints have their names.
    """
    require_plain_axes(chain, "a URDF")
    lines, parent, here = [f"<robot name={_attribute(name)}>", f'  <link name="{BASE}"/>'], BASE, np.eye(4)
    for number, joint in enumerate(chain.joints, start=1):
        child = f"link{number}"
        # A turning joint without known limits is written as one that has none.
        turning = "revolute" if joint.limits and not joint.endless else "continuous"
        lines.append(f'  <joint name={_attribute(joint.name)} type="{"prismatic" if joint.slides else turning}">')
        lines += _placed(here, joint.base_T_joint, parent, child)
        lines.append(f'    <axis xyz="{_words(numbers(joint.axis))}"/>')
        if joint.limits and not joint.endless:
            lower, upper = (repr(float(end)) for end in joint.limits)
            lines.append(f'    <limit lower="{lower}" upper="{upper}" effort="{UNKNOWN}" velocity="{UNKNOWN}"/>')
        elif joint.slides:
            lines.append(f'    <limit effort="{UNKNOWN}" velocity="{UNKNOWN}"/>')
        if joint.mimic is not None:
            ratio = f'multiplier="{joint.mimic.multiplier!r}" offset="{joint.mimic.offset!r}"'
            lines.append(f"    <mimic joint={_attribute(joint.mimic.master)} {ratio}/>")
        lines += ["  </joint>", f'  <link name="{child}"/>']
        parent, here = child, joint.base_T_joint
    tip, taken = "tip", {joint.name for joint in chain.joints}
    while tip in taken:
        tip += "_"
    lines += [f'  <joint name={_attribute(tip)} type="fixed">', *_placed(here, chain.base_T_tool, parent, TIP)]
    return "\n".join([*lines, "  </joint>", f'  <link name="{TIP}"/>', "</robot>", ""])


def _placed(base_T_parent: Array, base_T_child: Array, parent: str, child: str) -> Iterator[str]:
    rotation = base_T_parent[:3, :3].T
    xyz = numbers(rotation @ (base_T_child[:3, 3] - base_T_parent[:3, 3]))
    rpy = numbers(np.array(rpy_of(rotation @ base_T_child[:3, :3])))
    yield f'    <origin xyz="{_words(xyz)}" rpy="{_words(rpy)}"/>'
    yield f'    <parent link="{parent}"/>'
    yield f'    <child link="{child}"/>'


def _words(values: list[float]) -> str:
    return " ".join(map(repr, values))


def _attribute(text: str) -> str:
    """A text as the value of an XML attribute, in quotes; XML has no control characters. [URDF]"""
    return quoteattr(shown(text, keep=""))


Convention = Literal["standard", "craig"]
NEARLY_PARALLEL = 0.01  # Sine of an angle between axes
_MEET = 0.005  # m: axes that pass each other at less have their common normal's sense chosen by its direction
_SIDEWAYS = 0.1
_NOWHERE = 1e-13
_NOTHING = 1e-15


@dataclass(frozen=True)
class Link:
    """From one axis to the next (m, rad): ``theta`` and ``d`` on the first, ``a`` and ``alpha`` across.

    A ``turn`` about y comes after ``alpha`` in the standard convention and before it in Craig's.
    """

    theta: float = 0.0
    d: float = 0.0
    a: float = 0.0
    alpha: float = 0.0
    turn: float = 0.0

    def along(self) -> Array:  # Rot_z(theta) Trans_z(d)
        return _motion("z", self.theta, self.d)

    def across(self, convention: Convention) -> Array:
        """From the common normal on the first axis to the frame on the second (4x4)."""
        shift, turn, twist = _motion("x", 0.0, self.a), _motion("y", self.turn, 0.0), _motion("x", self.alpha, 0.0)
        return shift @ twist @ turn if convention == "standard" else shift @ turn @ twist


def mdh_section(chain: RigidChain, convention: Convention) -> dict[str, Any]:
    require_independent(chain, "mdh")
    require_plain_axes(chain, "mdh")
    direction, frame = chain.joints[0].direction, np.array(chain.joints[0].base_T_joint)
    x = frame[:3, 0] if abs(frame[:3, 0] @ direction) < 0.9 else frame[:3, 1]
    x = x - direction * (direction @ x)
    x = x / np.linalg.norm(x)
    frame[:3, :3] = np.column_stack([x, np.cross(direction, x), direction])  # z along the first axis
    links: list[Link] = []
    base: Array = frame
    for i, beyond in enumerate(chain.joints[1:]):
        link = _link(frame, beyond.point, beyond.direction, convention)
        frame = frame @ link.along()
        if i == 0:
            base, link = frame, Link(0.0, 0.0, link.a, link.alpha, link.turn)
        links.append(link)
        frame = frame @ link.across(convention)
    tool: Array = np.asarray(np.linalg.solve(frame, chain.base_T_tool))
    rows: list[dict[str, Any]] = []
    for before, here in zip([Link(), *links], [*links, Link()], strict=True):
        across = here if convention == "standard" else before
        turn = {"ry_deg": _degrees(across.turn)}
        row: dict[str, Any] = {"alpha_deg": _degrees(across.alpha), "theta_deg": _degrees(here.theta)}
        row |= {"a_mm": _millimetres(across.a), "d_mm": _millimetres(here.d)}
        if across.turn and convention == "standard":
            row["after"] = [turn]
        elif across.turn:
            row |= {"a_mm": 0.0, "before": [{"x_mm": _millimetres(across.a)}, turn]}
        rows.append(row)
    for row, joint in zip(rows, chain.joints, strict=True):
        if joint.slides:
            row["kind"] = "prismatic"
    head = {"type": "mdh", "convention": convention, "joints": [joint.name for joint in chain.joints]}
    return {**head, "base": _steps(base), "rows": rows, "tool": _steps(tool)}


def _link(frame: Array, point: Array, direction: Array, convention: Convention) -> Link:
    """From a frame with z along an axis to the next axis, given in the base frame by a point and a direction."""
    p, w = frame[:3, :3].T @ (point - frame[:3, 3]), frame[:3, :3].T @ direction
    sine = math.hypot(w[0], w[1])
    if sine < NEARLY_PARALLEL:
        foot = p - w * (p[2] / w[2])
        a = math.hypot(foot[0], foot[1])
        theta = math.atan2(foot[1], foot[0]) if a > _NOWHERE else 0.0
        x, y, z = _motion("z", -theta, 0.0)[:3, :3] @ w
        side = math.copysign(1.0, z)
        if convention == "standard":
            alpha, turn = math.atan2(-y, z), math.asin(x)
        else:
            alpha, turn = math.atan2(-y, side * math.hypot(x, z)), math.atan2(side * x, side * z)
        return Link(theta, 0.0, a if a > _NOWHERE else 0.0, alpha, turn if abs(turn) > _NOTHING else 0.0)
    normal = np.array([-w[1], w[0]]) / sine
    a = float(normal @ p[:2])
    # Towards the next axis; forwards where the two nearly meet, so that a small correction does not turn the row over.
    across = normal[0] if abs(normal[0]) > _SIDEWAYS else normal[1]
    if a < -_MEET or (a <= _MEET and across < 0):
        normal, a = -normal, -a
    d = float(p[2] - w[2] * (p[:2] @ w[:2]) / sine**2)
    alpha = math.atan2(normal[0] * w[1] - normal[1] * w[0], w[2])
    return Link(math.atan2(normal[1], normal[0]), d, a if abs(a) > _NOTHING else 0.0, -alpha)


def _steps(pose: Array) -> list[dict[str, float]]:
    """x, y, z, then yaw, pitch, roll; those that are zero too, so that a calibration may find what they really are."""
    roll, pitch, yaw = rpy_of(pose[:3, :3])
    lengths = {f"{axis}_mm": _millimetres(value) for axis, value in zip("xyz", pose[:3, 3], strict=True)}
    angles = {"rz_deg": _degrees(yaw), "ry_deg": _degrees(pitch), "rx_deg": _degrees(roll)}
    return [{key: value} for key, value in {**lengths, **angles}.items()]


def _motion(axis: str, angle: float, distance: float) -> Array:
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    motion = np.eye(4)
    motion[j, j] = motion[k, k] = math.cos(angle)
    motion[k, j], motion[j, k] = math.sin(angle), -math.sin(angle)
    motion[i, 3] = distance
    return motion


def _degrees(angle: float) -> float:
    """Above -180, at most 180."""
    degrees = round(math.degrees(angle), 13) + 0.0
    return 180.0 if degrees == -180.0 else degrees


def _millimetres(length: float) -> float:
    return round(1000 * float(length), 12) + 0.0
