"""An arm as numbers: every joint's frame and axis at zero angles, whatever model it came from."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from armcal.arm.assembly import Arm
from armcal.arm.model import ArmModel, Chain, Mimic, forward
from armcal.base.arrays import Array
from armcal.base.se3 import Transform, evaluated
from armcal.errors import ProblemError

NEGLIGIBLE = 1e-12  # m/rad, rad/m or 1: what rounding leaves of a pitch, of a turn, and of a difference of scale
FREE_ANGLE, FREE_TRAVEL = math.pi, 0.5
_WIDEST = 4 * math.pi


@dataclass(frozen=True)
class RigidJoint:
    name: str  # the joint's name
    base_T_joint: Array  # its frame (4x4)
    axis: Array  # about or along which it moves (unit, in its frame)
    slides: bool  # whether it slides
    pitch: float = 0.0  # how far it slides as it turns (m/rad); of a joint that slides, how far it turns (rad/m)
    scale: float = 1.0  # how far it moves for a command of one
    limits: tuple[float, float] | None = None  # of its command (rad or m), if known
    endless: bool = False  # whether it turns on and on
    mimic: Mimic | None = None  # the joint that it follows

    @property
    def direction(self) -> Array:
        return np.asarray(self.base_T_joint[:3, :3] @ self.axis)

    @property
    def point(self) -> Array:
        """The frame's origin in the base frame (m): a point of the axis."""
        return np.asarray(self.base_T_joint[:3, 3])


@dataclass(frozen=True)
class RigidChain:
    """A chain at zero angles: joints from the base to the tip, the mount and the tool (4x4 each)."""

    joints: tuple[RigidJoint, ...]
    base_T_mount: Array
    base_T_tool: Array


def numeric_chain(model: ArmModel, values: Mapping[str, Array]) -> Chain:
    return model.chain({name: ca.SX(ca.DM(value)) for name, value in values.items()})


def rigid_chain(chain: Chain) -> RigidChain:
    """A chain of constants as numbers at zero commands, offsets taken into the frames."""
    here = _pose(chain.base_T_mount)
    joints = []
    for joint in chain.joints:
        here = here @ _pose(joint.parent_T_joint) @ _pose(joint.motion(joint.offset))
        facts = (joint.limits, joint.endless, joint.mimic)
        if joint.twist is None:
            axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
            joints.append(RigidJoint(joint.name, here, axis, not joint.is_revolute, 0.0, 1.0, *facts))
            continue
        angular, linear = (evaluated(part).ravel() for part in joint.twist)
        if joint.is_revolute:  # the frame is shifted onto an axis that lies beside it
            scale, beside = float(np.linalg.norm(angular)), np.eye(4)
            beside[:3, 3] = np.cross(angular, linear) / scale**2
            pitch, axis, placed = float(angular @ linear) / scale**2, angular / scale, here @ beside
        else:
            scale = float(np.linalg.norm(linear))
            pitch, axis, placed = float(np.linalg.norm(angular)) / scale, linear / scale, here
        joints.append(RigidJoint(joint.name, placed, axis, not joint.is_revolute, pitch, scale, *facts))
    if chain.tool.joint != len(chain.joints):
        raise ProblemError(
            f"the tool hangs on joint {chain.tool.joint} of {len(chain.joints)}.",
            hint="Only chains whose last joint moves the tool are converted.",
        )
    return RigidChain(tuple(joints), _pose(chain.base_T_mount), here @ _pose(chain.tool.joint_T_frame))


def require_plain_axes(chain: RigidChain, target: str) -> None:
    for number, joint in enumerate(chain.joints, start=1):
        bent, stretched = abs(joint.pitch) > NEGLIGIBLE, abs(joint.scale - 1) > NEGLIGIBLE
        if not (bent or stretched):
            continue
        unit = "rad/m" if joint.slides else "m/rad"
        pitch = f"pitch {joint.pitch:.6g} {unit}" if bent else "no pitch"
        raise ProblemError(
            f"joint {number} ({joint.name}) has {pitch} and scale {joint.scale:.9g}; {target} has joints without pitch "
            "and of scale 1.",
            hint="Calibrate with parametrisation: minimal, which keeps axes axes.",
        )


def require_independent(chain: RigidChain, target: str) -> None:
    for joint in chain.joints:
        if joint.mimic is not None:
            raise ProblemError(
                f"joint {joint.name} follows {joint.mimic.master}; {target} has no joints that follow others.",
                hint="Convert to urdf, or take a part of the chain that ends before it.",
            )


def random_commands(chain: RigidChain, count: int, seed: int) -> Array:
    """Commands (count x joints): within limits where they are known, else half a turn or 0.5 m either way."""
    random = np.random.default_rng(seed)
    free = {True: (-FREE_TRAVEL, FREE_TRAVEL), False: (-FREE_ANGLE, FREE_ANGLE)}
    ends = [joint.limits or free[joint.slides] for joint in chain.joints]
    lower, upper = np.clip(np.array(ends, dtype=float), -_WIDEST, _WIDEST).T
    return np.asarray(random.uniform(lower, upper, (count, len(chain.joints))))


def tool_poses(chain: Chain, commands: Array) -> Array:
    """base_T_tool (N x 4 x 4) of a chain of constants at commands (N x joints), without effects."""
    symbols = ca.SX.sym("command", len(chain.joints))
    moved = [joint.offset + symbols[i] for i, joint in enumerate(chain.joints)]
    shown = ca.densify(forward(chain, moved, {}).base_T_tool.matrix())
    function = ca.Function("tool", [symbols], [ca.vec(shown.T)], {"cse": True})
    return np.asarray(function.map(len(commands))(commands.T).full()).T.reshape(-1, 4, 4)


def nominal_tools(arm: Arm, commands: Array) -> Array:
    """base_T_tool (N x 4 x 4) of an arm at nominal parameters, without effects, at commands (N x joints)."""
    return tool_poses(arm.nominal_chain, np.stack(arm.joint_commands([*commands.T]), axis=1))


def largest_difference(one: Array, two: Array) -> tuple[float, float]:
    """The largest distance (m) and the largest angle (rad) between poses (N x 4 x 4), pose by pose."""
    apart = float(np.linalg.norm(one[:, :3, 3] - two[:, :3, 3], axis=1).max())
    return apart, float(np.linalg.norm(turn_between(one[:, :3, :3], two[:, :3, :3]), axis=1).max())


def turn_between(here: Array, there: Array) -> Array:
    """Rotation vectors in the base frame (N x 3; rad) that turn ``here`` into ``there`` (N x 3 x 3 each).

    NaN where a matrix is; of half turns the direction may be either.
    """
    turned = there @ here.transpose(0, 2, 1)
    known = np.isfinite(turned).all(axis=(1, 2))
    vectors = np.full((len(turned), 3), np.nan)
    if known.any():
        vectors[known] = Rotation.from_matrix(turned[known]).as_rotvec()
    return vectors


def _pose(transform: Transform) -> Array:
    return evaluated(transform.matrix())
