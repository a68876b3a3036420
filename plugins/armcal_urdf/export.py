"""The exporter ``urdf``: the URDF that an arm was made from, with its calibrated origins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.model import forward
from armcal.base.domains import Array
from armcal.base.settings import Settings
from armcal.errors import ConfigError, ProblemError
from armcal.use.exporter import Exported, ExportRequest, random_commands

from armcal_urdf.edit import Placed, with_origins
from armcal_urdf.encoding import encode
from armcal_urdf.model import RPY, XYZ, UrdfModel, UrdfSettings
from armcal_urdf.numbers import Three

TOLERANCE_M = 1e-9
TOLERANCE_RAD = 1e-9


class UrdfExportSettings(Settings):
    """Nothing to set."""


class UrdfExporter:
    """Changes only the numbers of calibrated joints' origins; all other bytes stay."""

    Settings: ClassVar[type[UrdfExportSettings]] = UrdfExportSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, settings: UrdfExportSettings) -> None:
        self._settings = settings

    def export(self, request: ExportRequest) -> Exported:
        """The URDF, read again and compared.

        Raises:
            ConfigError: the arm's model is not a URDF.
            ProblemError: the URDF with the new numbers is not the calibrated arm.
        """
        model = request.arm.model
        if not isinstance(model, UrdfModel):
            raise ConfigError(
                f"the arm {request.name!r} is a model {request.arm.model_name!r}, and no URDF stands behind it.",
                hint="Use armcal convert to make a URDF of it.",
            )
        scope = f"{request.name}.{request.arm.model_name}."
        values = {n.removeprefix(scope): float(v[0]) for n, v in request.values.items() if n.startswith(scope)}
        placed = [
            Placed(joint.urdf, _three(joint.name, XYZ, values), _three(joint.name, RPY, values))
            for joint in model.urdf_chain.joints
        ]
        old = model.settings
        text = with_origins(old.text, placed)
        _compare(request, model, _read_again(old, text), values)
        changed = sum(
            before != now
            for each in placed
            for before, now in zip((*each.joint.xyz, *each.joint.rpy), (*each.xyz, *each.rpy), strict=True)
        )
        return Exported(encode(text, old.encoding or "utf-8"), changed, _left_out(request))


def _three(joint: str, names: tuple[str, ...], values: Mapping[str, float]) -> Three:
    x, y, z = (values[f"{joint}_{name}"] for name in names)
    return x, y, z


def _read_again(old: UrdfSettings, text: str) -> UrdfModel:
    told = {**old.to_config(), "text": text}
    return UrdfModel(UrdfSettings.model_validate(told))


def _compare(request: ExportRequest, model: UrdfModel, written: UrdfModel, values: Mapping[str, float]) -> None:
    """All frames in random poses within the limits, as calibrated and as written."""
    arm, commands = request.arm, random_commands(request.arm)
    nominal = {block.name: block.nominal[0] for block in written.parameters()}
    calibrated, again = _frames(arm, model, values, commands), _frames(arm, written, nominal, commands)
    shift = float(np.linalg.norm(calibrated[..., :3, 3] - again[..., :3, 3], axis=-1).max())
    apart = np.linalg.norm(calibrated[..., :3, :3] - again[..., :3, :3], axis=(-2, -1)).max()
    turn = float(apart) / np.sqrt(2)
    if not (shift <= TOLERANCE_M and turn <= TOLERANCE_RAD):
        raise ProblemError(
            f"the URDF with the calibrated numbers is {shift:.3g} m and {turn:.3g} rad off the calibrated arm, "
            f"expected {TOLERANCE_M:g} m and {TOLERANCE_RAD:g} rad at most.",
            hint="Nothing was written. Please report this with the calibration.",
        )


def _frames(arm: Arm, model: UrdfModel, values: Mapping[str, float], commands: Array) -> Array:
    """The tool and every link in the base frame (N x frames x 4 x 4), at commands (joints x N)."""
    chain = model.chain({name: ca.SX(value) for name, value in values.items()})
    told = ca.SX.sym("commands", commands.shape[0])
    frames = forward(chain, arm.joint_commands(ca.vertsplit(told)), {})
    poses = [frames.base_T_tool, *frames.named.values()]
    stacked = ca.vertcat(*[ca.vec(ca.densify(pose.matrix())) for pose in poses])
    found = np.asarray(ca.Function("frames", [told], [stacked], {"cse": True}).map(commands.shape[1])(commands).full())
    return found.T.reshape(commands.shape[1], len(poses), 4, 4).swapaxes(-1, -2)


def _left_out(request: ExportRequest) -> tuple[str, ...]:
    """What of the calibrated arm is no origin of a joint."""
    arm, nominal = request.arm, {block.name: block.nominal for block in request.arm.parameters()}
    moved = [name for name, value in request.values.items() if tuple(value) != nominal[name]]
    masses = sorted({name.split(".")[2] for name in moved if name.startswith(f"{request.name}.links.")})
    found = [*arm.effects, *(f"the mass of {link}" for link in masses)]
    return (*found, "the placement of its base") if arm.placement else tuple(found)
