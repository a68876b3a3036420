"""A calibrated arm as MJCF: bodies for joints, passive hinges for springs, inertials for masses. [MJCF]"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from armcal.base.arrays import Array
from armcal.base.quaternions import quaternion_of
from armcal.calibration.rigid_chain import RigidChain

from armcal_export.description import ArmDescription

NO_MASS_KG = 1e-9
"""What MuJoCo is told of a body without a mass: it refuses none, and this bends nothing."""
_DAMPING = 0.1
"""Of a spring, for the root of its stiffness: so that models come to rest in a few seconds."""
_RADIUS_M = 0.03
"""Masses are told as small balls: armcal knows their weight and centre, and not how they resist turning."""


@dataclass(frozen=True)
class Hinge:
    """A passive spring: about or along a unit vector of its site's frame (rad/(N m) or m/N)."""

    axis: tuple[float, float, float]
    slides: bool
    compliance: float


@dataclass(frozen=True)
class Drive:
    """Of every joint: gain (N m/rad or N/m) and damping of its position actuator, and its rotor's inertia (kg m^2)."""

    gain: float
    damping: float
    armature: float


def mjcf(
    arm_description: ArmDescription, rigid: RigidChain, springs: Mapping[int, Sequence[Hinge]], drive: Drive
) -> bytes:
    """The model; ``springs`` by site (0: the mount)."""
    root = ElementTree.Element("mujoco", model=arm_description.arm)
    ElementTree.SubElement(
        root, "compiler", angle="radian", autolimits="true", boundmass=_n(NO_MASS_KG), boundinertia=_n(NO_MASS_KG)
    )
    gravity = arm_description.statics.gravity_m_s2
    ElementTree.SubElement(root, "option", gravity=_row(gravity), integrator="implicitfast", timestep="0.001")
    world = ElementTree.SubElement(root, "worldbody")
    body = _body(world, f"{arm_description.arm}_mount", rigid.base_T_mount)
    _add_springs(body, "mount", springs.get(0, ()))
    _inertial(body, arm_description, 0, rigid.base_T_mount)
    here = rigid.base_T_mount
    for number, joint in enumerate(rigid.joints, start=1):
        body = _body(body, f"{arm_description.arm}_{joint.name}", np.linalg.inv(here) @ joint.base_T_joint)
        limits = {} if joint.limits is None else {"range": _row(joint.limits)}
        kind, axis, rotor = "slide" if joint.slides else "hinge", _row(joint.axis), _n(drive.armature)
        ElementTree.SubElement(body, "joint", name=joint.name, type=kind, axis=axis, armature=rotor, **limits)
        _add_springs(body, joint.name, springs.get(number, ()))
        _inertial(body, arm_description, number, joint.base_T_joint)
        here = joint.base_T_joint
    at_tool = np.linalg.inv(here) @ rigid.base_T_tool
    ElementTree.SubElement(body, "site", name="tool", size="0.005", **_placed(at_tool))
    payload = arm_description.statics.payload_kg or 0.0
    if payload > 0:
        at = (at_tool @ [*arm_description.statics.payload_com_m, 1.0])[:3]
        carried = ElementTree.SubElement(body, "body", name="payload", pos=_row(at))
        ball = _row([0.4 * payload * _RADIUS_M**2] * 3)
        ElementTree.SubElement(carried, "inertial", pos="0 0 0", mass=_n(payload), diaginertia=ball)
    _drive(root, rigid, drive)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def spring_name(site: str, number: int) -> str:
    return f"{site}_spring{number}"


def _body(above: ElementTree.Element, name: str, pose: Array) -> ElementTree.Element:
    return ElementTree.SubElement(above, "body", name=name, **_placed(pose))


def _placed(pose: Array) -> dict[str, str]:
    return {"pos": _row(pose[:3, 3]), "quat": _row(quaternion_of(pose[:3, :3]))}


def _add_springs(body: ElementTree.Element, site: str, hinges: Sequence[Hinge]) -> None:
    for number, hinge in enumerate(hinges, start=1):
        stiffness = 1.0 / hinge.compliance
        ElementTree.SubElement(
            body,
            "joint",
            name=spring_name(site, number),
            type="slide" if hinge.slides else "hinge",
            axis=_row(hinge.axis),
            stiffness=_n(stiffness),
            damping=_n(_DAMPING * math.sqrt(stiffness)),
            armature="0.0001",
        )


def _inertial(body: ElementTree.Element, arm_description: ArmDescription, number: int, base_T_body: Array) -> None:
    """All masses that a joint moves as one."""
    masses = [mass for mass in arm_description.masses if mass.moved_by == number and mass.mass_kg > 0]
    if not masses:
        return
    back = np.linalg.inv(base_T_body)
    at = np.array([(back @ [*mass.com_m, 1.0])[:3] for mass in masses])
    weights = np.array([mass.mass_kg for mass in masses])
    centre = weights @ at / weights.sum()
    beside = at - centre
    spread = np.einsum("i,ij,ij->", weights, beside, beside) * np.eye(3) - (beside.T * weights) @ beside
    inertia = spread + 0.4 * weights.sum() * _RADIUS_M**2 * np.eye(3)
    full = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    place = 0 if body.find("joint") is None else list(body).index(body.findall("joint")[-1]) + 1
    element = ElementTree.Element("inertial", pos=_row(centre), mass=_n(float(weights.sum())), fullinertia=_row(full))
    body.insert(place, element)


def _drive(root: ElementTree.Element, rigid: RigidChain, drive: Drive) -> None:
    """A position actuator for each joint; one that follows another is coupled to it."""
    following = [(joint.name, joint.mimic) for joint in rigid.joints if joint.mimic is not None]
    if following:
        equality = ElementTree.SubElement(root, "equality")
        for name, mimic in following:
            law = _row([mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0])
            ElementTree.SubElement(equality, "joint", joint1=name, joint2=mimic.master, polycoef=law)
    actuators = ElementTree.SubElement(root, "actuator")
    for joint in rigid.joints:
        if joint.mimic is None:
            ends = {} if joint.limits is None else {"ctrlrange": _row(joint.limits)}
            gains = {"kp": _n(drive.gain), "kv": _n(drive.damping)}
            ElementTree.SubElement(actuators, "position", name=joint.name, joint=joint.name, **gains, **ends)


def _row(numbers: Sequence[float] | Array) -> str:
    return " ".join(_n(float(number)) for number in numbers)


def _n(number: float) -> str:
    return repr(float(number))
