"""The exporter ``ros2``: a calibrated arm as parameters of a ROS 2 node."""

import re
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from armcal.arm.servo import SteppedEffect
from armcal.base.arrays import Array
from armcal.base.quaternions import rpy_of
from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest, changed_numbers
from armcal.calibration.rigid_chain import NEGLIGIBLE, RigidChain, rigid_chain
from armcal.errors import ConfigError, ProblemError
from pydantic import field_validator
from scipy.spatial.transform import Rotation

from armcal_export.c_text import in_comment
from armcal_export.describe import REPORT, chain_of, describe, motion, require_same_tools
from armcal_export.description import ArmDescription
from armcal_export.ros2_text import Value, read_ros2, ros2_text


class Ros2Settings(Settings):
    """Whose parameters they are.

    Attributes:
        node: the node's full name; ``/**`` is any.
        namespace: before every parameter's name; none unless given.
    """

    node: str = "/**"
    namespace: str = ""

    @field_validator("node")
    @classmethod
    def _a_node(cls, value: str) -> str:
        if not re.fullmatch(r"/?[A-Za-z_*][A-Za-z0-9_*/]*|/\*\*", value):
            raise ValueError(f"{value!r} is no name of a node; write node=/arm_driver, or leave it out for any node")
        return value

    @field_validator("namespace")
    @classmethod
    def _a_namespace(cls, value: str) -> str:
        if value and not re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", value, re.ASCII):
            raise ValueError(f"{value!r} is no namespace; write namespace=arm or namespace=robot.arm")
        return value


class Ros2Exporter:
    """Flat parameters of one type each: kinematics joint by joint, and every effect's numbers."""

    Settings: ClassVar[type[Ros2Settings]] = Ros2Settings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"node": "/arm_driver"}

    def __init__(self, settings: Ros2Settings) -> None:
        self._settings = settings

    def export(self, request: ExportRequest) -> Exported:
        """The parameters, read again by ROS 2's rules and compared.

        Raises:
            ConfigError: two joints or parameters come to the same name.
            ProblemError: a joint is none that an axis describes, or what reads back differs.
        """
        arm_description, rigid = describe(request), rigid_chain(chain_of(request))
        before = f"{self._settings.namespace}." if self._settings.namespace else ""
        parameters = {before + name: value for name, value in _parameters(request, arm_description, rigid).items()}
        comment = in_comment(f"The arm {request.name} as calibrated: {request.origin.experiment}.")
        text = ros2_text(self._settings.node, parameters, comment)
        again = read_ros2(text)
        if again != {self._settings.node: parameters}:
            raise ProblemError("the parameters do not read back as they were written.", hint=REPORT)
        read = {name.removeprefix(before): value for name, value in again[self._settings.node].items()}
        require_same_tools(request, lambda commands: rebuilt_tools(read, commands))
        # settings that ROS 2 has no type for; pulse tables are set joint by joint
        left_out = tuple(
            f"{setting} of {effect.name}"
            for effect in arm_description.effects
            if not isinstance(request.arm.effects[effect.name], SteppedEffect)
            for setting, value in effect.settings.items()
            if value not in (None, [], {}) and not _is_flat(value)
        )
        return Exported(text.encode("utf-8"), changed_numbers(request), left_out)


def _parameters(request: ExportRequest, arm_description: ArmDescription, rigid: RigidChain) -> dict[str, Value]:
    """By dotted name: what is known, then the chain, then the numbers of effects and masses."""
    parameters: dict[str, Value] = {
        "arm": request.name,
        "digest": arm_description.calibration.digest,
        "calibrated": arm_description.calibration.created or "unknown",
        "joint_names": [joint.name for joint in arm_description.joints],
        "commanded_joint_names": [joint.name for joint in arm_description.joints if joint.follows is None],
    }
    here = np.eye(4)
    for number, (joint, placed) in enumerate(zip(arm_description.joints, rigid.joints, strict=True), start=1):
        name = _word(joint.name)
        entries = {"type": joint.kind, **_placed(np.linalg.inv(here) @ placed.base_T_joint), "axis": joint.axis}
        if joint.lower is not None and joint.upper is not None:
            entries |= {"lower": joint.lower, "upper": joint.upper}
        if joint.follows is not None:
            mimic = joint.follows
            entries |= {"mimic.joint": mimic.joint, "mimic.multiplier": mimic.multiplier, "mimic.offset": mimic.offset}
        if abs(joint.pitch) > NEGLIGIBLE or abs(joint.scale - 1) > NEGLIGIBLE:
            entries |= {"pitch": joint.pitch, "scale": joint.scale}
        compliance = 0.0  # what its linear springs give about its own axis (rad/(N m)), or along it (m/N)
        for spring in arm_description.springs:
            if spring.site == number and spring.linear:
                lever = np.array(spring.axes) @ np.array(joint.axis)
                compliance += float(lever @ np.array(spring.compliance) @ lever)
        if compliance:
            entries["compliance"] = compliance
        _add(parameters, f"joints.{name}", entries)
        here = placed.base_T_joint
    _add(parameters, "tool", _placed(np.linalg.inv(here) @ rigid.base_T_tool))
    _add(parameters, "gravity", {"base": arm_description.statics.gravity_m_s2})
    _add_details(parameters, arm_description)
    _add_effects(parameters, request)
    return parameters


def _add(parameters: dict[str, Value], where: str, entries: Mapping[str, Any]) -> None:
    for name, value in entries.items():
        full = f"{where}.{name}"
        if full in parameters:
            raise ConfigError(f"two joints or parameters would be called {full!r}.", hint="Rename one of them.")
        parameters[full] = value


def _placed(matrix: Array) -> dict[str, list[float]]:
    return {"xyz": [float(x) for x in matrix[:3, 3]], "rpy": [float(angle) for angle in rpy_of(matrix[:3, :3])]}


def _add_details(parameters: dict[str, Value], arm_description: ArmDescription) -> None:
    """Servos (``joints.q2.servo.angles`` in rad, pulses and tick in s), masses, and settings that ROS 2 has a type for.

    Of a mass ``links.hand.base_com`` is its centre in the base frame at zero commands.
    """
    for servo in arm_description.servos:
        table = {"angles": servo.angles_rad, "pulses": servo.pulses_s, "tick": servo.tick_s}
        _add(parameters, f"joints.{_word(servo.joint)}.servo", table)
    for mass in arm_description.masses:
        moved_by = arm_description.joints[mass.moved_by - 1].name if mass.moved_by else "mount"
        entries = {"mass": mass.mass_kg, "base_com": mass.com_m, "moved_by": moved_by}
        _add(parameters, f"links.{_word(mass.name)}", entries)
    for effect in arm_description.effects:
        where = f"effects.{_word(effect.name)}"
        _add(parameters, where, {"type": effect.type or "unknown"})
        flat = {_word(name): value for name, value in effect.settings.items() if _is_flat(value)}
        _add(parameters, f"{where}.settings", flat)


def _is_flat(value: Any) -> bool:
    entries = value if isinstance(value, list) else [value]
    return len({type(entry) for entry in entries}) == 1 and isinstance(entries[0], (bool, int, float, str))


def _add_effects(parameters: dict[str, Value], request: ExportRequest) -> None:
    """Every number of the effects: ``effects.servo.gain1``, ``effects.flex.C0_xx``."""
    blocks = {block.name: block for block in request.arm.parameters()}
    for effect in request.arm.effects:
        before = f"{request.name}.{effect}."
        for full in [name for name in request.values if name.startswith(before)]:
            local = full.removeprefix(before)
            for suffix, number in zip(blocks[full].domain.entries, request.values[full], strict=True):
                name = _word(f"{local}_{suffix}" if suffix else local)
                _add(parameters, f"effects.{_word(effect)}", {name: float(number)})


def _word(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_]", "_", name)


def rebuilt_tools(parameters: Mapping[str, Any], commands: Array) -> Array:
    """base_T_tool (N x 4 x 4) of the rigid arm that the parameters specify, at commands (commanded joints x N)."""
    given = dict(zip(parameters["commanded_joint_names"], commands, strict=True))
    tools = np.tile(np.eye(4), (commands.shape[1], 1, 1))
    for name in parameters["joint_names"]:
        at = f"joints.{_word(name)}"
        if name in given:
            q = given[name]
        else:
            q = parameters[f"{at}.mimic.multiplier"] * given[parameters[f"{at}.mimic.joint"]]
            q = q + parameters[f"{at}.mimic.offset"]
        moved = parameters.get(f"{at}.scale", 1.0) * q
        beside = parameters.get(f"{at}.pitch", 0.0) * moved
        turns, slides = (moved, beside) if parameters[f"{at}.type"] == "revolute" else (beside, moved)
        tools = tools @ _pose(parameters, at) @ motion(np.array(parameters[f"{at}.axis"]), turns, slides)
    return np.asarray(tools @ _pose(parameters, "tool"))


def _pose(parameters: Mapping[str, Any], at: str) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll) after the shift, as URDF has it. [URDF]"""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_euler("xyz", parameters[f"{at}.rpy"]).as_matrix()
    result[:3, 3] = parameters[f"{at}.xyz"]
    return result
