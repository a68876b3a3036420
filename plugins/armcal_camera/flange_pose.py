"""Arms of which only poses were recorded: the pose alone as a model, or joint angles by a nominal model.

Hand-eye calibration needs no more than the flange's pose. It is that of a chain of three sliding joints and three
turning ones, so all that works for arms works for it; what its controller gets wrong is noise or an effect of these.

A controller computes the pose that it shows from the joints by its own nominal model, so the same model gives them
back. Of several postures for a pose the sequence decides: the one that moves the joints least from pose to pose.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.model import Attachment, Chain, Joint
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.parameters import ParameterBlock
from armcal.base.settings import Settings
from armcal.calibration.exporter import rigid_tools
from scipy.spatial.transform import Rotation

_STILL = (0.0, 0.0, 0.0)
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_STARTS, _STEPS, _SEED = 96, 40, 1
_REACHED, _STEP, _LONGEST = 1e-7, 1e-6, 0.5
_SAME = 1e-3
_LENGTH_M = 0.3
"""A turn of 1 rad counts as much as this distance."""
_AT_ONCE = 40


class FlangePoseSettings(Settings):
    """Nothing to set: the flange's pose is recorded."""


class FlangePose:
    """The arm model ``flange_pose``: "joints" x, y, z (m) and rz, ry, rx (rad).

    base_T_flange has the translation (x, y, z) and the rotation Rz(rz) Ry(ry) Rx(rx).
    """

    Settings: ClassVar[type[FlangePoseSettings]] = FlangePoseSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}
    joint_names: tuple[str, ...] = ("x", "y", "z", "rz", "ry", "rx")

    def __init__(self, settings: FlangePoseSettings) -> None:
        self._settings = settings

    def parameters(self) -> Sequence[ParameterBlock]:
        """None: what is recorded is the pose."""
        return ()

    def chain(self, values: Mapping[str, Any]) -> Chain:
        slides = [Joint(axis, se3.identity(), _STILL, direction) for axis, direction in _AXES.items()]
        turns = [Joint(f"r{axis}", se3.identity(), _AXES[axis]) for axis in "zyx"]
        return Chain(se3.identity(), (*slides, *turns), Attachment(6, se3.identity()))


def recovered_joints(arm: Arm, poses: Array, near: Array) -> tuple[Array, Array]:
    """Commands (n x N; rad or m) at which the nominal arm is in these poses, and how many postures each has (N).

    Args:
        arm: whose nominal model it is, effects and springs left out.
        poses: base_T_tool (N x 4 x 4, m).
        near: about where the joints are in the first pose (n; rad or m).

    Returns:
        Commands, NaN where no posture within the joints' limits reaches a pose; and the numbers of postures.
    """
    random, count = np.random.default_rng(_SEED), len(arm.commanded)
    limits = [joint.limits or (-np.pi, np.pi) for joint in arm.nominal_chain.joints if joint.mimic is None]
    low, high = np.array(limits).T
    starts = random.uniform(np.maximum(low, -np.pi), np.minimum(high, np.pi), (_STARTS, count)).T
    options: list[Array] = []
    for first in range(0, len(poses), _AT_ONCE):
        some = poses[first : first + _AT_ONCE]
        reached = _led(arm, np.tile(starts, len(some)), np.repeat(some, _STARTS, axis=0), (low, high))
        options += [_different(part.T) for part in np.split(reached, len(some), axis=1)]
    return _shortest(options, near), np.array([len(own) for own in options])


def _led(arm: Arm, commands: Array, targets: Array, limits: tuple[Array, Array]) -> Array:
    """Commands (n x M) led to their targets by damped steps; NaN where they did not get there, or beyond limits."""
    values = {block.name: np.array(block.nominal) for block in arm.parameters()}
    turning = np.array([kind == "angle" for kind in arm.commanded.values()])
    for _ in range(_STEPS):
        off = _off(rigid_tools(arm, values, commands), targets)
        columns = []
        for joint in range(len(commands)):
            moved = commands.copy()
            moved[joint] += _STEP
            columns.append((_off(rigid_tools(arm, values, moved), targets) - off) / _STEP)
        slopes = np.stack(columns, axis=2)
        normal = slopes.transpose(0, 2, 1) @ slopes + 1e-9 * np.eye(len(commands))
        step = -np.linalg.solve(normal, slopes.transpose(0, 2, 1) @ off[:, :, None])[:, :, 0].T
        commands = commands + step * np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=0), 1e-12))
    there = np.linalg.norm(_off(rigid_tools(arm, values, commands), targets), axis=1) < _REACHED
    wrapped = (commands + np.pi) % (2 * np.pi) - np.pi
    commands = np.where(turning[:, None], wrapped, commands)
    inside = np.all((commands >= limits[0][:, None] - _SAME) & (commands <= limits[1][:, None] + _SAME), axis=0)
    return np.where(there & inside, commands, np.nan)


def _off(tools: Array, targets: Array) -> Array:
    """How far tools are from targets: distance (m), and turn at a length (M x 6)."""
    turns = Rotation.from_matrix(np.swapaxes(targets[:, :3, :3], 1, 2) @ tools[:, :3, :3]).as_rotvec()
    return np.concatenate([tools[:, :3, 3] - targets[:, :3, 3], _LENGTH_M * turns], axis=1)


def _different(commands: Array) -> Array:
    kept: list[Array] = []
    for row in commands[np.isfinite(commands).all(axis=1)]:
        if all(np.abs(row - other).max() > _SAME for other in kept):
            kept.append(row)
    return np.array(kept).reshape(-1, commands.shape[1])


def _shortest(options: list[Array], near: Array) -> Array:
    """One option a pose (n x N), so that joints move least in all; poses without one are passed over (NaN)."""
    commands = np.full((len(near), len(options)), np.nan)
    places = [i for i, own in enumerate(options) if len(own)]
    if not places:
        return commands
    cost, back = np.abs(options[places[0]] - near).sum(axis=1), []
    for before, here in pairwise(places):
        ways = cost[:, None] + np.abs(options[before][:, None] - options[here][None]).sum(axis=2)
        back.append(np.argmin(ways, axis=0))
        cost = ways.min(axis=0)
    chosen = int(np.argmin(cost))
    for number in reversed(range(len(places))):
        commands[:, places[number]] = options[places[number]][chosen]
        chosen = int(back[number - 1][chosen]) if number else chosen
    return commands
