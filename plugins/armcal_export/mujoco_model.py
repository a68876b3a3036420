"""The exporter ``mujoco``: an MJCF model, loaded by MuJoCo, brought to rest and compared before it is written. [MJCF]

Bodies stand for joints, passive hinges in series with the drives for linear springs, inertials for masses.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.assembly import scoped
from armcal.arm.effects import JointCommand, reshapes
from armcal.base.arrays import Array
from armcal.base.quaternions import quaternion_of
from armcal.base.settings import Settings
from armcal.calibration.exporter import (
    POSES,
    Exported,
    ExportRequest,
    changed_numbers,
    leaves_residual_out,
    random_commands,
    rigid_tools,
)
from armcal.calibration.rigid_chain import RigidChain, require_plain_axes
from armcal.errors import NotConvergedError, ProblemError
from armcal.plugins import library
from pydantic import Field
from scipy.optimize import root

from armcal_export.description import REPORT, ArmContent, ArmMass, ArmSpring, content_of, in_equilibrium

TOLERANCE = 1e-9  # m, and entries of rotation matrices, of the rigid arm
NO_MASS_KG = 1e-9  # What MuJoCo is told of a body without a mass: it refuses none, and this bends nothing
_DAMPING = 0.1  # Of a spring, for the root of its stiffness: so that models come to rest in a few seconds
_RADIUS_M = 0.03
"""Masses are told as small balls: armcal knows their weight and centre, and not how they resist turning."""
_COMMANDS = (-0.31, 0.42)
_NO_SPRING = 1e-12  # rad/(N m) or m/N: what gives less than this is no spring
_AT_REST, _FARTHEST = 1e-12, 1.5  # rad or m


class MujocoSettings(Settings):
    """The drives: what the calibration cannot know."""

    gain: Annotated[float, Field(gt=0)] = 1000.0  # of each position actuator (N m/rad, or N/m)
    damping: Annotated[float, Field(ge=0)] = 20.0  # of each position actuator (N m s/rad, or N s/m)
    armature: Annotated[float, Field(gt=0)] = 0.01  # inertia of each rotor, seen at the joint (kg m^2, or kg)


class MujocoExporter:
    """Linear springs as passive hinges in series with the drives."""

    Settings: ClassVar[type[MujocoSettings]] = MujocoSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"gain": 500.0}

    def __init__(self, settings: MujocoSettings) -> None:
        self._settings = settings

    def export(self, request: ExportRequest) -> Exported:
        arm = content_of(request)
        require_plain_axes(arm.rigid, "mujoco")
        environment = request.environment
        payload = (environment.payload_mass if request.payload_stated else 0.0, environment.payload_com)
        content = mjcf(arm, payload, hinges_of(arm.springs), self._settings)
        loaded = LoadedModel(content, arm.rigid)
        commands = random_commands(request.arm, POSES)
        tools = np.array([loaded.rigid_tool(command) for command in commands.T])
        apart = float(np.abs(tools - rigid_tools(request.arm, request.values, commands)).max())
        if not apart <= TOLERANCE:
            text = f"MuJoCo's arm is {apart:.3g} m or 1 off the calibrated one, expected {TOLERANCE:g} at most."
            raise ProblemError(text, hint=REPORT)
        expression, reach = request.expression(), 0.0
        expected, _, settled = in_equilibrium(expression, expression.records(commands).T)
        for command, tool in zip(commands.T[settled], expected[settled], strict=True):
            with suppress(NotConvergedError):
                reach = max(reach, float(np.linalg.norm(loaded.tool_at_rest(command)[:3, 3] - tool[:, 3])))
        left_out = _left_out(request, arm)
        if not left_out and reach > TOLERANCE and not leaves_residual_out(self, request):
            left_out = ("turns of second order in its springs",)
        return Exported(content, changed_numbers(request), left_out, reach=reach)


def _left_out(request: ExportRequest, arm: ArmContent) -> tuple[str, ...]:
    bent = {spring.effect for spring in arm.springs if not spring.linear}
    effects = [name for name in request.arm.effects if name in bent or _displaces(request, name)]
    masses = [mass.name for mass in arm.masses if mass.loads_up_to != mass.moved_by and mass.mass_kg > 0]
    counted = [f"what {', '.join(masses)} load beyond the joints that carry them"] if masses else []
    acting = np.any(request.environment.force) or np.any(request.environment.torque)
    wrench = ["the force and torque on the tool"] if acting else []
    return (*effects, *counted, *wrench)


def _displaces(request: ExportRequest, name: str) -> bool:
    """Whether an effect moves a joint, or changes the arm's shape, without any load."""
    effect = request.arm.effects[name]
    if reshapes(effect):
        return True
    values = {full: ca.SX(list(map(float, value))) for full, value in request.values.items()}
    local = scoped(values, f"{request.name}.{name}.")
    joints = range(len(request.arm.joint_names))
    commands = [JointCommand(i, ca.SX(command), ca.SX(1.0)) for i in joints for command in _COMMANDS]
    return any(float(ca.evalf(ca.SX(effect.displacement(command, local)))) != 0.0 for command in commands)


@dataclass(frozen=True)
class Hinge:
    """A passive spring: about or along a unit vector of its site's frame (rad/(N m) or m/N)."""

    axis: tuple[float, float, float]
    slides: bool
    compliance: float


def hinges_of(springs: Sequence[ArmSpring]) -> Mapping[int, Sequence[Hinge]]:
    """Linear springs as hinges along principal axes, by site (0: the mount)."""
    turning: dict[int, Array] = defaultdict(lambda: np.zeros((3, 3)))
    sliding: dict[int, float] = defaultdict(float)
    hinges: dict[int, list[Hinge]] = defaultdict(list)
    along: dict[int, Array] = {}
    for spring in springs:
        if spring.linear and spring.along:
            sliding[spring.site] += spring.compliance[0][0]
            along[spring.site] = np.array(spring.axes[0])
        elif spring.linear:
            about = np.array(spring.axes)
            turning[spring.site] += about.T @ np.array(spring.compliance) @ about
    axes = [(site, along[site], compliance, True) for site, compliance in sliding.items()]
    for site, matrix in turning.items():
        sizes, directions = np.linalg.eigh(0.5 * (matrix + matrix.T))
        # without the rounding of eigenvectors that are coordinate axes
        near = np.round(directions)
        directions = np.where(np.isclose(directions, near, rtol=0, atol=1e-12).all(axis=0), near, directions)
        axes += [(site, axis, size, False) for axis, size in zip(directions.T, sizes, strict=True)]
    for site, axis, compliance, slides in axes:
        if compliance > _NO_SPRING:
            hinges[site].append(Hinge((float(axis[0]), float(axis[1]), float(axis[2])), slides, float(compliance)))
    return hinges


def mjcf(
    arm: ArmContent,
    payload: tuple[float, Sequence[float]],
    springs: Mapping[int, Sequence[Hinge]],
    drive: MujocoSettings,
) -> bytes:
    """The model; ``payload`` is its mass (kg) and its centre in the tool frame (m)."""
    import jinja2

    rigid, (carried, com) = arm.rigid, payload
    bodies = [_body(arm, "mount", 0, np.eye(4), rigid.base_T_mount, springs)]
    here = rigid.base_T_mount
    for number, joint in enumerate(rigid.joints, start=1):
        body = _body(arm, joint.name, number, here, joint.base_T_joint, springs)
        kind = "slide" if joint.slides else "hinge"
        body["joint"] = {"name": joint.name, "type": kind, "axis": _row(joint.axis), "range": _row(joint.limits or ())}
        bodies.append(body)
        here = joint.base_T_joint
    at_tool = np.linalg.inv(here) @ rigid.base_T_tool
    hung = {"pos": _row((at_tool @ [*com, 1.0])[:3]), "mass": _row([carried]), "inertia": _row([_ball(carried)] * 3)}
    following = [(joint.name, joint.mimic) for joint in rigid.joints if joint.mimic is not None]
    template = resources.files("armcal_export").joinpath("templates", "arm.xml.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    text = environment.from_string(template).render(
        name=arm.name,
        gravity=_row(arm.gravity),
        no_mass=NO_MASS_KG,
        bodies=bodies,
        tool=_placed(at_tool),
        payload=hung if carried > 0 else None,
        following=[
            {"name": name, "master": mimic.master, "polycoef": _row([mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0])}
            for name, mimic in following
        ],
        commanded=[{"name": j.name, "range": _row(j.limits or ())} for j in rigid.joints if j.mimic is None],
        **drive.model_dump(),
    )
    return text.encode("utf-8")


def _body(
    arm: ArmContent, site: str, number: int, above: Array, here: Array, springs: Mapping[int, Sequence[Hinge]]
) -> dict[str, Any]:
    """What a joint moves, or the mount: where it is, its springs, and its masses as one."""
    listed = [
        {
            "name": f"{site}_spring{place}",
            "type": "slide" if hinge.slides else "hinge",
            "axis": _row(hinge.axis),
            "stiffness": _row([1.0 / hinge.compliance]),
            "damping": _row([_DAMPING * math.sqrt(1.0 / hinge.compliance)]),
        }
        for place, hinge in enumerate(springs.get(number, ()), start=1)
    ]
    masses = [mass for mass in arm.masses if mass.moved_by == number and mass.mass_kg > 0]
    inertial = _inertial(masses, here) if masses else None
    placed = _placed(np.linalg.inv(above) @ here)
    return {"name": f"{arm.name}_{site}", **placed, "joint": None, "springs": listed, "inertial": inertial}


def _inertial(masses: Sequence[ArmMass], base_T_body: Array) -> dict[str, str]:
    back = np.linalg.inv(base_T_body)
    at = np.array([(back @ [*mass.com_m, 1.0])[:3] for mass in masses])
    weights = np.array([mass.mass_kg for mass in masses])
    centre = weights @ at / weights.sum()
    beside = at - centre
    spread = np.einsum("i,ij,ij->", weights, beside, beside) * np.eye(3) - (beside.T * weights) @ beside
    inertia = spread + _ball(weights.sum()) * np.eye(3)
    full = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    return {"pos": _row(centre), "mass": _row([weights.sum()]), "inertia": _row(full)}


def _ball(mass: float) -> float:
    return 0.4 * mass * _RADIUS_M**2


def _placed(pose: Array) -> dict[str, str]:
    return {"pos": _row(pose[:3, 3]), "quat": _row(quaternion_of(pose[:3, :3]))}


def _row(numbers: Sequence[float] | Array) -> str:
    return " ".join(repr(float(number)) for number in numbers)


class LoadedModel:
    def __init__(self, content: bytes, rigid: RigidChain) -> None:
        self._mujoco = library("mujoco", "the format mujoco")
        try:
            self._model = self._mujoco.MjModel.from_xml_string(content.decode("utf-8"))
        except ValueError as fault:
            raise ProblemError(f"MuJoCo does not take the model: {str(fault)[:300]}.", hint=REPORT) from fault
        self._data = self._mujoco.MjData(self._model)
        self._rigid = rigid
        self._site = self._model.site("tool").id
        self._places = {joint.name: int(self._model.joint(joint.name).qposadr[0]) for joint in rigid.joints}
        driven = set(self._places.values())
        self._springs = np.array([i for i in range(self._model.nq) if i not in driven], dtype=int)

    def rigid_tool(self, command: Array) -> Array:
        """base_T_tool (4 x 4) with no spring bent, at commands of the commanded joints."""
        self._set(command)
        return self._tool()

    def tool_at_rest(self, command: Array) -> Array:
        """base_T_tool (4 x 4) where the springs balance gravity and the joints stand at their commands."""
        self._set(command)
        if len(self._springs):
            rest = root(self._unbalanced, np.zeros(len(self._springs)), tol=_AT_REST)
            if not (rest.success and np.abs(rest.x).max() < _FARTHEST):
                raise NotConvergedError("the model in MuJoCo finds no balance.", hint="Check masses and compliances.")
            self._data.qpos[self._springs] = rest.x
        return self._tool()

    def _set(self, command: Array) -> None:
        content = dict(zip([j.name for j in self._rigid.joints if j.mimic is None], command, strict=True))
        self._data.qpos[:] = 0.0
        for joint in self._rigid.joints:
            q = content[joint.name] if joint.mimic is None else content[joint.mimic.master] * joint.mimic.multiplier
            self._data.qpos[self._places[joint.name]] = q + (joint.mimic.offset if joint.mimic else 0.0)
        self._data.qvel[:] = 0.0

    def _unbalanced(self, deflections: Array) -> Array:
        """What keeps springs that are bent so from rest (N m or N): weight minus spring."""
        self._data.qpos[self._springs] = deflections
        self._mujoco.mj_forward(self._model, self._data)
        both = self._data.qfrc_bias - self._data.qfrc_passive
        return np.asarray(both[self._springs])

    def _tool(self) -> Array:
        self._mujoco.mj_kinematics(self._model, self._data)
        result = np.eye(4)
        result[:3, :3] = self._data.site_xmat[self._site].reshape(3, 3)
        result[:3, 3] = self._data.site_xpos[self._site]
        return result
