"""The exporter ``mujoco``: an MJCF model, loaded by MuJoCo, brought to rest and compared before it is written."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.assembly import scoped
from armcal.arm.effects import JointCommand, reshapes
from armcal.base.arrays import Array
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
from armcal.calibration.rigid_chain import RigidChain, require_plain_axes, rigid_chain
from armcal.errors import InputError, NotConvergedError, ProblemError
from pydantic import Field

from armcal_export.describe import REPORT, chain_of, describe
from armcal_export.description import ArmDescription, SpringEntry
from armcal_export.mjcf import Drive, Hinge, mjcf
from armcal_export.mujoco_rest import LoadedModel
from armcal_export.reference import in_equilibrium

TOLERANCE = 1e-9
"""m, and entries of rotation matrices, of the rigid arm."""
_COMMANDS = (-0.31, 0.42)
_NO_SPRING = 1e-12
"""rad/(N m) or m/N: what gives less than this is no spring."""


class MujocoSettings(Settings):
    """The drives: what the calibration cannot know.

    Attributes:
        gain: of each position actuator (N m/rad, or N/m).
        damping: of each position actuator (N m s/rad, or N s/m).
        armature: inertia of each rotor, seen at the joint (kg m^2, or kg).
    """

    gain: Annotated[float, Field(gt=0)] = 1000.0
    damping: Annotated[float, Field(ge=0)] = 20.0
    armature: Annotated[float, Field(gt=0)] = 0.01


class MujocoExporter:
    """Linear springs as passive hinges in series with the drives."""

    Settings: ClassVar[type[MujocoSettings]] = MujocoSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"gain": 500.0}

    def __init__(self, settings: MujocoSettings) -> None:
        self._settings = settings

    def export(self, request: ExportRequest) -> Exported:
        """The model.

        Raises:
            InputError: MuJoCo is not installed, or the arm has joints that MJCF has not.
            ProblemError: MuJoCo's arm is another one.
        """
        chain = chain_of(request)
        rigid, arm_description = rigid_chain(chain), describe(request)
        require_plain_axes(rigid, "mujoco")
        drive = Drive(self._settings.gain, self._settings.damping, self._settings.armature)
        content = mjcf(arm_description, rigid, _hinges(arm_description.springs), drive)
        loaded = _loaded(content, rigid)
        commands = random_commands(request.arm, POSES)
        tools = np.array([loaded.rigid_tool(command) for command in commands.T])
        apart = float(np.abs(tools - rigid_tools(request.arm, request.values, commands)).max())
        if not apart <= TOLERANCE:
            text = f"MuJoCo's arm is {apart:.3g} m or 1 off the calibrated one, expected {TOLERANCE:g} at most."
            raise ProblemError(text, hint=REPORT)
        reach = _reach(request, loaded, commands)
        left_out = _left_out(request, arm_description)
        if not left_out and reach > TOLERANCE and not leaves_residual_out(self, request):
            left_out = ("turns of second order in its springs",)
        return Exported(content, changed_numbers(request), left_out, reach=reach)


def _loaded(content: bytes, rigid: RigidChain) -> LoadedModel:
    try:
        return LoadedModel(content, rigid)
    except ModuleNotFoundError as fault:
        raise InputError(
            "the format mujoco needs MuJoCo, which is not installed.", hint="Install it: pip install armcal[mujoco]."
        ) from fault
    except ValueError as fault:
        raise ProblemError(f"MuJoCo does not take the model: {str(fault)[:300]}.", hint=REPORT) from fault


def _hinges(springs: Sequence[SpringEntry]) -> Mapping[int, Sequence[Hinge]]:
    """Linear springs as hinges along principal axes, by site."""
    turning: dict[int, Array] = defaultdict(lambda: np.zeros((3, 3)))
    sliding: dict[int, float] = defaultdict(float)
    axes: dict[int, Array] = {}
    for spring in springs:
        if not spring.linear:
            continue
        if spring.along:
            sliding[spring.site] += spring.compliance[0][0]
            axes[spring.site] = np.array(spring.axes[0])
        else:
            about = np.array(spring.axes)
            turning[spring.site] += about.T @ np.array(spring.compliance) @ about
    hinges: dict[int, list[Hinge]] = defaultdict(list)
    for site, compliance in sliding.items():
        hinges[site] += _kept([(axes[site], compliance)], slides=True)
    for site, matrix in turning.items():
        sizes, directions = np.linalg.eigh(0.5 * (matrix + matrix.T))
        # without the rounding of eigenvectors that are coordinate axes
        near = np.round(directions)
        directions = np.where(np.isclose(directions, near, rtol=0, atol=1e-12).all(axis=0), near, directions)
        hinges[site] += _kept(list(zip(directions.T, sizes, strict=True)), slides=False)
    return hinges


def _kept(axes: Sequence[tuple[Array, float]], slides: bool) -> list[Hinge]:
    return [
        Hinge((float(a[0]), float(a[1]), float(a[2])), slides, float(size)) for a, size in axes if size > _NO_SPRING
    ]


def _left_out(request: ExportRequest, arm_description: ArmDescription) -> tuple[str, ...]:
    bent = {spring.effect for spring in arm_description.springs if not spring.linear}
    effects = [name for name in request.arm.effects if name in bent or _displaces(request, name)]
    masses = [mass.name for mass in arm_description.masses if mass.loads_up_to != mass.moved_by and mass.mass_kg > 0]
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
    joint_commands = [
        JointCommand(i, ca.SX(command), ca.SX(1.0))
        for i in range(len(request.arm.joint_names))
        for command in _COMMANDS
    ]
    return any(float(ca.evalf(ca.SX(effect.displacement(command, local)))) != 0.0 for command in joint_commands)


def _reach(request: ExportRequest, loaded: LoadedModel, commands: Array) -> float:
    expression, largest = request.expression(), 0.0
    tools, _, settled = in_equilibrium(expression, expression.records(commands).T)
    for command, tool in zip(commands.T[settled], tools[settled], strict=True):
        with suppress(NotConvergedError):
            largest = max(largest, float(np.linalg.norm(loaded.tool_at_rest(command)[:3, 3] - tool[:, 3])))
    return largest
