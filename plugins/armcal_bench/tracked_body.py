"""The tracked body on an arm's tool: the rigid arm that should carry it, and what servo fits add to the arm's problem.

One problem of the arm's model serves all of them: pulse tables, backlash and springs of a calibration, and the zeros of
servos that know where they stand.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm, ArmState, prefixed, scoped
from armcal.arm.effects import EffectSettings, JointCommand, JointEffect
from armcal.arm.model import forward
from armcal.arm.servo import piecewise_linear
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import ParameterBlock, Parameters, declared, scalar
from armcal.base.poses import point_blocks, point_expression, pose_blocks, pose_transform, rotation_of
from armcal.base.quaternions import quaternion_of
from armcal.base.se3 import rotation_vector, small_rotation
from armcal.estimate.identifiability import InverseInformation
from armcal.estimate.polish import descended
from armcal.measure.measurement import Channel
from armcal.problem.problem import PosedProblem, Problem
from armcal.run.experiment import Experiment
from scipy.spatial.transform import Rotation
from typing_extensions import override

Pose = Mapping[str, float]  # Joint angles (rad) by joint; those not named are zero


def twist_angles(rotations: Rotation, axis: Array) -> Array:
    """The angle about an axis (unit) of the rotation about it that is nearest to each (rad, within half a turn)."""
    quaternions = rotations.as_quat()
    angles = 2.0 * np.arctan2(quaternions[:, :3] @ axis, quaternions[:, 3])
    return np.asarray((angles + math.pi) % (2 * math.pi) - math.pi)


def turn_of_point(before: Array, after: Array, axis: Array) -> float:
    """The turn (rad) about an axis (unit) through the origin that brings a point nearest to where it is after."""
    flat, turned = (point - (point @ axis) * axis for point in (before, after))
    return math.atan2(float(axis @ np.cross(flat, turned)), float(flat @ turned))


def lever(vectors: Array, axis: Array) -> Array:
    """By which shifts of points at ``vectors`` (N x 3, m) from an axis become turns about it (N x 3, rad/m)."""
    arms = vectors - np.outer(vectors @ axis, axis)
    return np.asarray(np.cross(axis, arms) / np.maximum(np.sum(arms**2, axis=1), 1e-12)[:, None])


@dataclass(frozen=True, eq=False)
class RigidArm:
    """An arm whose joints stand where they are commanded."""

    arm: Arm
    parameters: Parameters  # whose nominal values are taken

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(self.arm.commanded)

    def tool(self, pose: Pose) -> Array:
        return np.asarray(self._function(self._commands(pose))[0].full())

    def axes(self, pose: Pose) -> dict[str, tuple[Array, Array]]:
        """Of each joint in the base frame: the direction of its axis (unit) and a point on it (m)."""
        _, axes, origins = (np.asarray(dm.full()) for dm in self._function(self._commands(pose)))
        return {name: (axes[:, i], origins[:, i]) for i, name in enumerate(self.arm.joint_names)}

    def _commands(self, pose: Pose) -> Array:
        return np.array([float(pose.get(joint, 0.0)) for joint in self.joints])

    @cached_property
    def _function(self) -> ca.Function:
        own = {block.name for block in self.arm.parameters()}
        values = {b.name: ca.SX(list(b.nominal)) for b in self.parameters.blocks if b.name in own}
        chain = self.arm.chain(values)
        commands = ca.SX.sym("commands", len(self.joints))
        displacements = self.arm.joint_commands(ca.vertsplit(commands))
        frames = forward(chain, [joint.offset + displacements[i] for i, joint in enumerate(chain.joints)], {})
        sites = frames.sites[1:]
        axes = [ca.mtimes(s.rotation, ca.SX(list(j.axis))) for s, j in zip(sites, chain.joints, strict=True)]
        out = [frames.base_T_tool.matrix(), ca.horzcat(*axes), ca.horzcat(*[s.origin for s in sites])]
        return ca.Function("rigid", [commands], [ca.densify(x) for x in out], {"cse": True})


By = Literal["rotation", "position", "pose"]  # What of the body is compared
TABLES, BODY = "tables", "body"
_SCALE_RAD = 0.05
_MOST_STEPS, _DAMPING, _AT_REST = 40, 1e-6, 1e-9
_QUATERNION = ("qw", "qx", "qy", "qz")


class Corrections(JointEffect):
    """The effect ``tables``: joints stand off their commands.

    ``at3_0``, ``at3_1``, ... (rad) are what joint 3 stands off at the knots, linear between them; ``zero3`` is the same
    everywhere; it stops ``lag3`` short of its command when it comes from below, and as much beyond from above.
    """

    def __init__(self, knots: Mapping[int, Sequence[float]], zeros: Sequence[int], lags: Sequence[int]) -> None:
        super().__init__(EffectSettings(), ())
        self._knots, self._zeros, self._lags = knots, zeros, lags

    @override
    def parameters(self) -> Sequence[ParameterBlock]:
        names = [f"at{joint}_{k}" for joint, knots in self._knots.items() for k in range(len(knots))]
        names += [*(f"zero{joint}" for joint in self._zeros), *(f"lag{joint}" for joint in self._lags)]
        return [scalar(name, "rad", 0.0, _SCALE_RAD) for name in names]

    @override
    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        joint, moved = command.joint, ca.SX(0)
        if knots := self._knots.get(joint):
            at = [values[f"at{joint}_{k}"] for k in range(len(knots))]
            moved += piecewise_linear(command.commanded, knots, at)
        if joint in self._zeros:
            moved += values[f"zero{joint}"]
        return moved - values[f"lag{joint}"] * command.approach if joint in self._lags else moved


@dataclass(frozen=True)
class Body:
    """A measurement of a body on the tool, in a frame that may be tilted against the model's base.

    Parameters: ``tilt`` and ``shift`` of that frame, ``seat`` of the body on the tool; and of each sweep small turns
    before and behind the joint that moves, for the others stand within their play then.
    """

    arms: tuple[str, ...]
    by: By
    seat: tuple[float, ...]  # its nominal rotation (unit quaternion w, x, y, z)
    target: tuple[float, ...] = (0.0, 0.0, 0.0)  # its nominal place (3, m)
    sweeps: int = 0

    def parameters(self) -> tuple[ParameterBlock, ...]:
        turns = ["tilt", *(f"{side}{i}" for i in range(self.sweeps) for side in ("before", "behind"))]
        angles = tuple(scalar(f"{turn}_{axis}", "rad", 0.0, _SCALE_RAD) for turn in turns for axis in "xyz")
        return (*angles, *point_blocks("shift", (0.0, 0.0, 0.0)), *pose_blocks("seat", self.target, self.seat))

    def channels(self) -> tuple[Channel, ...]:
        return (
            *(Channel(axis, "length") for axis in "xyz"),
            *(Channel(name, "dimensionless") for name in _QUATERNION),
            Channel("sweep", "dimensionless"),
        )

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        return {}

    def residual(self, arms: Mapping[str, ArmState], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """Measured less predicted: a rotation vector in the predicted body's axes (rad), a place in the base's (m)."""

        def turn(name: str) -> Any:
            return small_rotation(ca.vertcat(*[values[f"{name}_{axis}"] for axis in "xyz"]))

        before = behind = ca.SX.zeros(3)
        for i in range(self.sweeps):
            own = measured["sweep"] == i
            before += own * point_expression(f"before{i}", values)
            behind += own * point_expression(f"behind{i}", values)
        tool, seat = arms[self.arms[0]].base_T_tool, pose_transform("seat", values)
        base = ca.mtimes(turn("tilt"), small_rotation(before))
        rows = []
        if self.by != "position":
            read = rotation_of(ca.vertcat(*[measured[name] for name in _QUATERNION]))
            predicted = ca.mtimes([base, tool.rotation, small_rotation(behind), seat.rotation])
            rows.append(rotation_vector(ca.mtimes(predicted.T, read)))
        if self.by != "rotation":
            place = ca.mtimes(base, tool.apply(ca.mtimes(small_rotation(behind), seat.translation)))
            read = ca.vertcat(*[measured[axis] for axis in "xyz"])
            rows.append(read - place - point_expression("shift", values))
        return ca.vertcat(*rows)

    def dimensions(self) -> tuple[str, ...]:
        return {"rotation": ("angle",) * 3, "position": ("length",) * 3}.get(self.by, ("angle",) * 3 + ("length",) * 3)

    def noise(self) -> tuple[float, ...]:
        return (1.0,) * len(self.dimensions())

    def noise_channels(self) -> tuple[tuple[Channel, ...], ...]:
        """Each record has its own, as ``noise_rotation`` and ``noise``."""
        named = {"angle": Channel("noise_rotation", "angle"), "length": Channel("noise", "length")}
        return tuple((named[dimension],) for dimension in self.dimensions())


def body_dataset(
    arm: str,
    angles: Mapping[str, Array],
    poses: Array,
    noise: tuple[Array, Array],
    approaches: Mapping[str, Array] = MappingProxyType({}),
    sweeps: Array | None = None,
) -> Dataset:
    """Records of a body, with the noise of its rotation (rad) and of each coordinate (m) (N each)."""
    count = len(poses)
    channels = {f"{arm}.{joint}": values for joint, values in angles.items()}
    channels |= {f"{arm}.approach.{joint}": approach for joint, approach in approaches.items()}
    rotations = np.where(np.isnan(poses[:, :3, :3]), np.eye(3), poses[:, :3, :3])
    quaternions = np.array([quaternion_of(rotation) for rotation in rotations])
    channels |= {f"{BODY}.{axis}": poses[:, i, 3] for i, axis in enumerate("xyz")}
    channels |= {f"{BODY}.{name}": quaternions[:, i] for i, name in enumerate(_QUATERNION)}
    channels |= {f"{BODY}.sweep": np.zeros(count) if sweeps is None else sweeps}
    channels |= {f"{BODY}.noise_rotation": noise[0], f"{BODY}.noise": noise[1]}
    return Dataset(tuple(str(i) for i in range(count)), channels)


class BodyFit:
    """Corrections of joints fitted to what was seen of a body; ``free`` has the prior deviations of what may move."""

    def __init__(
        self,
        experiment: Experiment,
        arm: Arm,
        corrections: Corrections,
        body: Body,
        free: Mapping[str, float | None],
        dataset: Dataset,
        *,
        springs: bool = True,
    ) -> None:
        environment = experiment.system.environment
        nominal = {block.name: ca.SX(list(block.nominal)) for block in arm.parameters()}
        own = {n: e for n, e in arm.effects.items() if springs and e.springs(scoped(nominal, f"{arm.name}.{n}."))}
        arm = replace(arm, effects={**own, TABLES: corrections}, residual=None)
        blocks = [
            *experiment.parameters.blocks,
            *prefixed(f"{arm.name}.{TABLES}.", declared(corrections)),
            *prefixed(f"{BODY}.", declared(body)),
        ]
        fixed = [replace(b, free=b.name in free, prior_sd=free.get(b.name), drift=None) for b in blocks]
        parameters = Parameters(tuple(block for block in fixed if not block.nuisance))
        arms, measurements = {arm.name: arm}, {BODY: body}
        self.problem = Problem.build(arms, measurements, parameters, environment, dataset, "interpreted")
        self.values = parameters.nominal()

    @property
    def parameters(self) -> Parameters:
        return self.problem.parameters

    def fit(self, dataset: Dataset, weights: Array) -> None:
        self.problem = self.problem.of(dataset, weights)
        posed = PosedProblem(self.problem)
        self.values = posed.values(descended(posed, posed.x(self.values), _MOST_STEPS, _DAMPING, _AT_REST))

    def residuals(self, changes: Mapping[str, Any] | None = None) -> Array:
        """Raw, of each record (rows x N), with other values of some numbers."""
        values = self.values.copy()
        for name, value in (changes or {}).items():
            values[self.parameters.entries_of(name)] = value
        return self.problem.residuals(values)[0]

    @property
    def noise_scale(self) -> float:
        freedom = max(self.problem.equations() - self.problem.increments, 1)
        return max(1.0, float(np.sqrt(2 * self.problem.cost(self.values) / freedom)))

    def value(self, name: str) -> float:
        return float(self.values[self.parameters.entries_of(name)][0])

    def move(self, name: str, value: float) -> None:
        self.values[self.parameters.entries_of(name)] = value

    def deviations(self, names: Sequence[str], rows: Array | None = None) -> Array:
        """Standard deviations of some numbers, or of linear combinations of them (rows of M x names)."""
        root = InverseInformation.of(self.problem.triangular_factor(self.values), self.parameters).root
        chosen = root[[self.parameters.coordinates_of[name].start for name in names]]
        return np.asarray(np.linalg.norm(chosen if rows is None else rows @ chosen, axis=1))
