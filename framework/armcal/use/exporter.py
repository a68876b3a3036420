"""Exporters: calibrated arms in the formats of other programs, and how far what a format leaves out matters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm, ArmState
from armcal.arm.model import forward
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression
from armcal.errors import ConfigError, NotConvergedError
from armcal.measure.measurement import Channel
from armcal.use.calibration import Calibration

POSES = 1000
"""So many random poses, within the joints' limits, are compared."""
_LONGEST_M = 1.0
_FARTHEST = {"angle": math.pi, "length": _LONGEST_M}
_WIDEST = {"angle": 4 * math.pi, "length": 100.0}


@dataclass(frozen=True)
class ExportRequest:
    """What is to be written: an arm, its instance name, and its calibrated parameters by full name."""

    name: str
    arm: Arm
    values: Mapping[str, Array]


@dataclass(frozen=True)
class Exported:
    """A file's content, how many of the arm's numbers changed in it, and what of the arm it cannot hold."""

    content: bytes
    changed: int
    left_out: tuple[str, ...] = ()


class Exporter(Protocol):
    """What a plugin provides to write a calibrated arm in a format of its own."""

    def export(self, request: ExportRequest) -> Exported:
        """The arm in the format, read again and compared before it is handed out.

        Raises:
            InputError: the format cannot hold this arm.
        """


def request_of(calibration: Calibration, arm: str | None) -> ExportRequest:
    """What a calibration says of one arm; of its only one if no name is given.

    Raises:
        ConfigError: no such arm, or several and no name.
    """
    arms = calibration.system.arms
    if arm is None and len(arms) > 1:
        raise ConfigError(f"the calibration has {len(arms)} arms, {', '.join(arms)}.", hint="Choose: --arm NAME.")
    name = next(iter(arms)) if arm is None else arm
    if name not in arms:
        raise ConfigError(f"no arm is called {name!r}.", hint=f"The arms are {', '.join(arms)}.")
    values = {block.name: np.array(block.nominal) for block in calibration.parameters.blocks}
    own = {block.name for block in arms[name].parameters()}
    return ExportRequest(name, arms[name], {key: value for key, value in values.items() if key in own})


def random_commands(arm: Arm, count: int = POSES, seed: int = 1) -> Array:
    """Commands of the commanded joints within their limits (joints x N; rad or m), up to a half turn without any."""
    random = np.random.default_rng(seed)
    rows = []
    for joint in arm.nominal_chain.joints:
        if joint.mimic is None:
            kind = arm.commanded[joint.name]
            low, high = joint.limits or (-_FARTHEST[kind], _FARTHEST[kind])
            widest = _WIDEST[kind]
            rows.append(random.uniform(max(low, -widest), min(high, widest), count))
    return np.array(rows)


def rigid_tools(arm: Arm, values: Mapping[str, Array], commands: Array) -> Array:
    """base_T_tool (N x 4 x 4) without effects, at commands (joints x N) and parameters by full name."""
    chain = arm.chain({name: ca.SX(list(value)) for name, value in values.items()})
    told = ca.SX.sym("commands", commands.shape[0])
    moved = arm.joint_commands(ca.vertsplit(told))
    frames = forward(chain, [joint.offset + moved[i] for i, joint in enumerate(chain.joints)], {})
    function = ca.Function("tool", [told], [ca.vec(ca.densify(frames.base_T_tool.matrix()))], {"cse": True})
    found = np.asarray(function.map(commands.shape[1])(commands).full())
    return found.T.reshape(-1, 4, 4).transpose(0, 2, 1)


def effects_reach(calibration: Calibration, request: ExportRequest) -> float | None:
    """How far the calibrated arm is from the same one without effects, at most over random poses (m).

    Under the configured gravity and load, no load where none is configured. None where an elastic arm does not
    settle in all poses.

    Raises:
        DataError: the arm cannot be predicted.
    """
    commands = random_commands(request.arm)
    statics = calibration.system.statics
    if statics.payload is None:
        statics = statics.model_copy(update={"payload": 0.0})
    alone = replace(calibration.system, measurements={"tool": _ToolOf(request.name)}, statics=statics)
    channels = {f"{request.name}.{joint}": row for joint, row in zip(request.arm.commanded, commands, strict=True)}
    poses = Dataset(tuple(str(i) for i in range(commands.shape[1])), channels)
    try:
        _, tools = replace(calibration, system=alone).predict(poses)
    except NotConvergedError:
        return None
    apart = tools[0][:, :3, 3] - rigid_tools(request.arm, request.values, commands)[:, :3, 3]
    return float(np.linalg.norm(apart, axis=1).max())


@dataclass(frozen=True)
class _ToolOf:
    """A measurement without an instrument, to have an arm's tool."""

    arm: str

    @property
    def arms(self) -> tuple[str, ...]:
        """One."""
        return (self.arm,)

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """None."""
        return ()

    def channels(self) -> tuple[Channel, ...]:
        """None."""
        return ()

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Expression]) -> Mapping[str, Expression]:
        """Nothing."""
        return {}

    def residual(
        self, arms: Mapping[str, ArmState], measured: Mapping[str, Expression], values: Mapping[str, Expression]
    ) -> Expression:
        """The tool's position (m)."""
        return arms[self.arm].base_T_tool.translation

    def noise(self) -> Sequence[float]:
        """One metre."""
        return (1.0, 1.0, 1.0)
