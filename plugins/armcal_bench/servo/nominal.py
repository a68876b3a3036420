"""One joint's motion by the model: its axis, the tool, and what the springs add to it.

A joint's angle from the motion of the tool: rotation about one axis, or a circle where only positions are seen.

Rotations R_k = Rot(u, phi_k) C have the axis u and the rest C in common; both are found in turn, the axis as the
direction along which the rotation vectors of R_k C' lie, and C as the chordal mean [Moakher2002] of Rot(u, phi_k)' R_k.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Literal

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm, ArmState, scoped
from armcal.arm.model import forward
from armcal.arm.statics import Environment
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.base.se3 import Expression
from armcal.measure.instrument import ArmsAlone
from armcal.measure.rests import mean_rotation
from armcal.problem.factor import build_factor
from armcal.problem.kernel import AS_IT_STANDS, Interpreter, Kernel
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from typing_extensions import override

_ROUNDS = 20
_LEAST_TURN = math.radians(1.0)


class NoTurnError(ValueError):
    """The tool did not turn about an axis in a way that shows the joint's angle."""


@dataclass(frozen=True)
class Turning:
    """How the tool turned.

    Attributes:
        off_axis: how far rotations are from turning about the axis alone (rad), or positions from the circle (m), root
            mean square.
        off: what of each rotation is not about the axis (N x 3, rad, base frame); empty where only positions were seen.
    """

    axis: Array  # unit, base frame; along the model's
    angles: Array  # of each pose about it (rad), from some pose in their midst
    off_axis: float
    off: Array
    radius: float | None = None  # of the circle (m) where positions alone were seen; None with rotations
    centre: Array | None = None  # of the circle (m)


def turning_of_rotations(rotations: Array, model_axis: Array) -> Turning:
    """From ``base_R_tool`` (N x 3 x 3) of one joint's motion; the sign is by the model's axis (base frame).

    Raises:
        NoTurnError: there was next to no motion.
    """
    seen = Rotation.from_matrix(rotations)
    # From the rotation that is nearest to all others, so that none is half a turn away.
    rest = seen[int(np.argmin([float(np.max((seen * one.inv()).magnitude())) for one in seen]))]
    vectors, axis = (seen * rest.inv()).as_rotvec(), np.zeros(3)
    for _ in range(_ROUNDS):
        before = axis
        axis = np.linalg.svd(vectors, full_matrices=False)[2][0]
        axis = axis * (1.0 if axis @ model_axis >= 0 else -1.0)
        angles = vectors @ axis
        turned_back = Rotation.from_rotvec(-np.outer(angles, axis)) * seen
        rest = Rotation.from_matrix(mean_rotation(turned_back.as_matrix()))
        vectors = (seen * rest.inv()).as_rotvec()
        if np.linalg.norm(axis - before) < 1e-12:
            break
    angles = twist_angles(seen * rest.inv(), axis)
    if np.ptp(angles) < _LEAST_TURN:
        raise NoTurnError(f"the tool turned by {math.degrees(np.ptp(angles)):.2f} deg in all")
    off = (seen * rest.inv() * Rotation.from_rotvec(-np.outer(angles, axis))).as_rotvec()
    return Turning(axis, angles, float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), off)


def turning_of_positions(positions: Array, model_axis: Array, least_radius: float) -> Turning:
    """From positions (N x 3, m, base frame) of one joint's motion: a circle in the plane that they lie in.

    Raises:
        NoTurnError: too few or too near positions, or a circle smaller than ``least_radius`` (m).
    """
    if len(positions) < 4:
        raise NoTurnError(f"found {len(positions)} positions, a circle needs four")
    middle = positions.mean(axis=0)
    _, spread, directions = np.linalg.svd(positions - middle, full_matrices=False)
    if spread[1] < 0.05 * least_radius:
        raise NoTurnError("the positions lie on a line or a point, not on a circle")
    axis = directions[2] * (1.0 if directions[2] @ model_axis >= 0 else -1.0)
    e1 = directions[0]
    e2 = np.cross(axis, e1)
    flat = np.stack([(positions - middle) @ e1, (positions - middle) @ e2], axis=1)
    # Least squares of the distances, from the algebraic circle.
    rows = np.column_stack([2 * flat, np.ones(len(flat))])
    a, b, c = np.linalg.lstsq(rows, np.sum(flat**2, axis=1), rcond=None)[0]
    start = np.array([a, b, math.sqrt(max(c + a * a + b * b, 0.0))])

    def off_circle(circle: Array) -> Array:
        return np.asarray(np.linalg.norm(flat - circle[:2], axis=1) - circle[2])

    circle = least_squares(off_circle, start).x
    centre, radius = circle[:2], float(abs(circle[2]))
    if radius < least_radius:
        raise NoTurnError(f"the target moves on a circle of {1000 * radius:.1f} mm about this joint's axis")
    angles = np.unwrap(np.arctan2(flat[:, 1] - centre[1], flat[:, 0] - centre[0]))
    angles = angles - angles[np.argsort(angles)[len(angles) // 2]]
    off = np.hypot(np.linalg.norm(flat - centre, axis=1) - radius, (positions - middle) @ axis)
    at = middle + centre[0] * e1 + centre[1] * e2
    return Turning(axis, angles, float(np.sqrt(np.mean(off**2))), np.zeros((0, 3)), radius, at)


def twist_angles(rotations: Rotation, axis: Array) -> Array:
    """The angle about an axis (unit) of the rotation about it that is nearest to each (rad, within half a turn)."""
    quaternions = rotations.as_quat()
    angles = 2.0 * np.arctan2(quaternions[:, :3] @ axis, quaternions[:, 3])
    return np.asarray((angles + math.pi) % (2 * math.pi) - math.pi)


def turn_of_point(before: Array, after: Array, axis: Array) -> float:
    """The turn (rad) about an axis (unit) through the origin that brings a point nearest to where it is after."""
    flat, turned = (point - (point @ axis) * axis for point in (before, after))
    return math.atan2(float(axis @ np.cross(flat, turned)), float(flat @ turned))


def mean_angle(angles: Array) -> float:
    """Of angles that may differ by whole turns (rad)."""
    return float(np.angle(np.mean(np.exp(1j * angles))))


By = Literal["rotation", "position"]  # What shows a turn about an axis
Pose = Mapping[str, float]  # Joint angles (rad) by joint; those not named are zero
_COMPLIANCE_UNIT = "rad_per_Nm"
_ENTRIES = 12


class _ToolFrame(ArmsAlone):
    """``base_T_tool`` without its last row, column by column, as a residual that nothing is taken from."""

    @override
    def residual(
        self, arms: Mapping[str, ArmState], measured: Mapping[str, Expression], values: Mapping[str, Expression]
    ) -> Expression:
        return ca.vec(arms[self.arms[0]].base_T_tool.matrix()[:3, :])

    @override
    def noise(self) -> tuple[float, ...]:
        return (1.0,) * _ENTRIES


@dataclass(frozen=True)
class NominalArm:
    """An arm at the parameters' nominal values."""

    arm: Arm  # the arm
    parameters: Parameters  # whose nominal values are taken; the arm's own are free
    kernel: Kernel  # evaluates the tool in elastic equilibrium, from the free parameters and the joints' commands
    zeros: Mapping[str, float] = field(default_factory=dict)  # what the joints' angles are to be enlarged by (rad)

    @classmethod
    def of(cls, arm: Arm, parameters: Parameters, environment: Environment) -> NominalArm:
        """An arm whose joints stand where they are commanded: of its effects, it has the springs alone."""
        nominal = {block.name: ca.SX(list(block.nominal)) for block in arm.parameters()}
        springy = {n: e for n, e in arm.effects.items() if e.springs(scoped(nominal, f"{arm.name}.{n}."))}
        arm = replace(arm, effects=springy, residual=None)
        parameters = parameters.with_free(block.name for block in arm.parameters())
        conditions = frozenset(arm.conditions)
        factor = build_factor("tool", _ToolFrame((arm.name,)), {arm.name: arm}, parameters, environment, conditions)
        return cls(arm, parameters, Kernel(factor, Interpreter(factor)))

    def with_values(self, values: Mapping[str, tuple[float, ...]], zeros: Mapping[str, float]) -> NominalArm:
        """The same arm with other values of parameters, and other zeros of its joints (rad)."""
        changed = {name: replace(self.parameters[name], nominal=value) for name, value in values.items()}
        return NominalArm(self.arm, self.parameters.replaced(changed), self.kernel, zeros)

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(self.arm.commanded)

    @cached_property
    def compliances(self) -> tuple[str, ...]:
        return tuple(b.name for b in self.parameters.free if b.unit == _COMPLIANCE_UNIT and b.size == 1)

    def compliance(self, name: str) -> float:
        """A spring's, by parameter (rad/(N m))."""
        return self.parameters[name].nominal[0]

    @cached_property
    def angles(self) -> tuple[str, ...]:
        scope = f"{self.arm.name}.{self.arm.model_name}."
        return tuple(b.name for b in self.parameters.free if b.unit == "rad" and b.name.startswith(scope))

    def tool(self, pose: Pose) -> Array:
        """The rigid ``base_T_tool`` (4x4)."""
        return np.asarray(self._rigid(self._commands(pose))[0].full())

    def axis(self, joint: str, pose: Pose) -> tuple[Array, Array]:
        """A joint's axis in the base frame: its direction (unit) and a point on it (m)."""
        return self.axes(pose)[joint]

    def axes(self, pose: Pose) -> dict[str, tuple[Array, Array]]:
        _, axes, origins = (np.asarray(dm.full()) for dm in self._rigid(self._commands(pose)))
        return {name: (axes[:, i], origins[:, i]) for i, name in enumerate(self.arm.joint_names)}

    def angle_of_rotation(self, joint: str, pose: Pose, rotation: Array) -> float:
        """The angle (rad) of a joint at which the rigid model's tool turns nearest to a rotation (3x3)."""
        at_zero = {**pose, joint: 0.0}
        turned = Rotation.from_matrix(np.array([rotation @ self.tool(at_zero)[:3, :3].T]))
        return float(twist_angles(turned, self.axis(joint, at_zero)[0])[0])

    def angle_of_position(self, joint: str, pose: Pose, position: Array) -> float:
        """The same by where the tool is (3, m)."""
        at_zero = {**pose, joint: 0.0}
        axis, origin = self.axis(joint, at_zero)
        return turn_of_point(self.tool(at_zero)[:3, 3] - origin, position - origin, axis)

    def tools(self, poses: Sequence[Pose], springs: Literal["giving", "stiff"] = "giving") -> Array:
        """``base_T_tool`` (N x 4 x 4) in elastic equilibrium, or with springs that do not give.

        Raises:
            NotConvergedError: a pose has no equilibrium.
        """
        state, entries = np.zeros((self.arm.deflection_size, len(poses))), np.empty((_ENTRIES, len(poses)))
        stiff = partial(self.kernel.backend.residuals, rest=AS_IT_STANDS)
        (stiff if springs == "stiff" else self.kernel.residuals)(self._values, self._records(poses), state, entries)
        tools = np.tile(np.eye(4), (len(poses), 1, 1))
        tools[:, :3] = entries.reshape(4, 3, -1).transpose(2, 1, 0)
        return tools

    def give(self, poses: Sequence[Pose]) -> Array:
        """What the springs put between the tool of the stiff arm and of the real one (N x 4 x 4).

        The rotation is in the tool's axes, the translation in the base's (m).
        """
        stiff, given = self.tools(poses, "stiff"), self.tools(poses)
        given[:, :3, :3] = np.swapaxes(stiff[:, :3, :3], 1, 2) @ given[:, :3, :3]
        given[:, :3, 3] -= stiff[:, :3, 3]
        return given

    def sag(self, joint: str, poses: Sequence[Pose], by: By = "rotation") -> Array:
        """How far the springs turn the tool about a joint's axis (N, rad), by its rotation or by its position."""
        sag = []
        for pose, stiff, bent in zip(poses, self.tools(poses, "stiff"), self.tools(poses), strict=True):
            axis, origin = self.axis(joint, pose)
            if by == "rotation":
                sag.append(twist_angles(Rotation.from_matrix(bent[None, :3, :3] @ stiff[:3, :3].T), axis)[0])
            else:
                sag.append(_lever(stiff[:3, 3] - origin, axis) @ (bent[:3, 3] - stiff[:3, 3]))
        return np.array(sag)

    def slopes(self, joint: str, poses: Sequence[Pose], by: By = "rotation") -> Array:
        """How much more that would be for each of the compliances (N x compliances, rad per rad/(N m))."""
        tools, by_values, _ = self._motions(poses)
        motions = by_values[:, :, self._entries(self.compliances)]
        slopes = []
        for pose, tool, motion in zip(poses, tools, motions, strict=True):
            axis, origin = self.axis(joint, pose)
            slopes.append(axis @ motion[:3] if by == "rotation" else _lever(tool[:, 3] - origin, axis) @ motion[3:])
        return np.array(slopes)

    def turns(self, poses: Sequence[Pose]) -> tuple[Array, Array, Array, Array]:
        """How the tool turns with each number of ``angles``, with each joint, and with each compliance.

        The tool's rotation (N x 3 x 3), and the turns in the base's axes: N x 3 x numbers and N x 3 x joints (rad per
        rad), and N x 3 x compliances (rad per rad/(N m)).
        """
        tools, by_values, by_joints = self._motions(poses)
        by_angles, by_springs = (by_values[:, :3, self._entries(names)] for names in (self.angles, self.compliances))
        return tools[:, :, :3], by_angles, by_joints[:, :3], by_springs

    def _motions(self, poses: Sequence[Pose]) -> tuple[Array, Array, Array]:
        """Tools in equilibrium (N x 3 x 4), and how they turn and shift (N x 6) with each value and each joint."""
        values, record, count = self._values, self._records(poses), len(poses)
        state, tools = np.zeros((self.arm.deflection_size, count)), np.empty((_ENTRIES, count))
        by_values, by_joints = (np.empty((_ENTRIES * size, count)) for size in (len(values), len(self.joints)))
        self.kernel.linearise(values, record, state, tools, by_values)
        self.kernel.channel_slopes(values, record, state, by_joints, self._channels)
        rotations = tools[:9].reshape(3, 3, count)
        motions = []
        for slopes in (by_values, by_joints):
            columns = slopes.reshape(4, 3, -1, count)
            turning = np.einsum("cikn,cjn->nijk", columns[:3], rotations)
            turns = np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=1)
            motions.append(np.concatenate([turns, columns[3].transpose(2, 0, 1)], axis=1))
        return tools.reshape(4, 3, count).transpose(2, 1, 0), motions[0], motions[1]

    @property
    def _values(self) -> Array:
        return self.parameters.nominal()[list(self.parameters.free_entries)]

    def _entries(self, names: Sequence[str]) -> list[int]:
        owners = [block.name for block in self.parameters.free for _ in range(block.size)]
        return [i for name in names for i, owner in enumerate(owners) if owner == name]

    @property
    def _channels(self) -> list[str]:
        return [f"{self.arm.name}.{joint}" for joint in self.joints]

    def _commands(self, pose: Pose) -> Array:
        return np.array([float(pose.get(joint, 0.0)) + self.zeros.get(joint, 0.0) for joint in self.joints])

    def _records(self, poses: Sequence[Pose]) -> Array:
        """Channels of the kernel (n_c x N); of the surroundings nothing is known."""
        commands = np.array([self._commands(pose) for pose in poses]).reshape(len(poses), -1)
        rows = dict(zip(self._channels, commands.T, strict=True))
        return np.array([rows.get(channel, np.zeros(len(poses))) for channel in self.kernel.factor.channels])

    @cached_property
    def _rigid(self) -> ca.Function:
        """Commands to the tool, and each joint's axis and origin, at the nominal values and without effects."""
        chain = self.arm.chain({block.name: ca.SX(list(block.nominal)) for block in self.parameters.free})
        commands = ca.SX.sym("commands", len(self.joints))
        displacements = self.arm.joint_commands(ca.vertsplit(commands))
        frames = forward(chain, [joint.offset + displacements[i] for i, joint in enumerate(chain.joints)], {})
        sites = frames.sites[1:]
        axes = [ca.mtimes(s.rotation, ca.SX(list(j.axis))) for s, j in zip(sites, chain.joints, strict=True)]
        out = [frames.base_T_tool.matrix(), ca.horzcat(*axes), ca.horzcat(*[s.origin for s in sites])]
        return ca.Function("rigid", [commands], [ca.densify(x) for x in out], {"cse": True})


def _lever(vector: Array, axis: Array) -> Array:
    """By which a shift of a point at ``vector`` from the axis becomes a turn about the axis (3, rad/m)."""
    arm = vector - (vector @ axis) * axis
    return np.asarray(np.cross(axis, arm) / max(float(arm @ arm), 1e-12))
