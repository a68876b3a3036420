"""What a step of a joint, or of an instrument's frame, looks like among the parameters.

Found by trying, so that it holds for any arm model and effect: in some poses, which combination of parameters moves
the prediction as the step does? Where one parameter alone does (a joint's offset), it is that one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.quaternions import quaternion_matrix
from armcal.problem.problem import FactorRecords, Problem

from armcal_online.tracking.observer import Observer

_POSES = 60
_REACH = {"angle": 1.2, "length": 0.1}
_ALONE = 0.999
_LOCAL = 0.98
_EXPLAINED = 0.97
_CUT = 1e-6


@dataclass(frozen=True)
class JointStep:
    """A step of one joint.

    Attributes:
        joint: its channel, ``arm.q3``.
        dimension: ``angle`` or ``length``.
        direction: in scaled coordinates, of a step of 1 rad or m (n).
        local: coordinates that act along this joint's motion alone, the offset left out: what a new servo changes.
        parameter: the one that is the joint's offset; empty if it takes several.
    """

    joint: str
    dimension: str
    direction: Array
    local: tuple[int, ...]
    parameter: str


@dataclass(frozen=True)
class Steps:
    """What can be followed.

    Attributes:
        joints: steps of joints, those that parameters can make.
        unfollowed: joints whose steps no combination of parameters makes.
        sensors: by measurement, scaled coordinates of shifts (m) and turns (rad) of its frame (n x up to 6), and
            which of ``x y z rx ry rz`` they are.
    """

    joints: tuple[JointStep, ...]
    unfollowed: tuple[str, ...]
    sensors: Mapping[str, tuple[Array, tuple[str, ...]]]


def find_steps(observer: Observer, values: Array, predicted: Mapping[str, Array], poses: Dataset) -> Steps:
    """The steps that the free parameters can follow.

    Args:
        observer: of the problem.
        values: of its parameters.
        predicted: what instruments read in the poses, by channel.
        poses: joint angles (see ``probing_poses``).
    """
    problem, space = observer.problem, observer.space
    complete = Dataset(poses.ids, {**_defaulted(problem, len(poses)), **poses.channels, **predicted})
    records = problem.records(complete)
    slopes = -np.concatenate([_rows(jacobian) for jacobian in problem.jacobians(values, records)])
    slopes = space.by_coordinates(values, slopes)
    arms = problem.blueprint.arms.values()
    commanded = {f"{arm.name}.{joint}": dimension for arm in arms for joint, dimension in arm.commanded.items()}
    motions = -_whitened(problem, values, records, list(commanded))
    joints, unfollowed = [], []
    for (channel, dimension), moved in zip(commanded.items(), motions.T, strict=True):
        seen = float(moved @ moved) >= _CUT * len(moved)
        step = _joint_step(channel, dimension, moved, slopes, space.names) if seen else None
        if step is None:
            unfollowed.append(channel)
        else:
            joints.append(step)
    sensors = {
        kernel.factor.name: found
        for kernel in problem.kernels
        if (found := _sensor(problem, values, records, kernel.factor.name, complete, slopes)) is not None
    }
    return Steps(tuple(joints), tuple(unfollowed), sensors)


def probing_poses(arms: Mapping[str, Arm]) -> Dataset:
    """Poses about zero within the joints' limits, approached from either side; always the same ones."""
    random, channels = np.random.default_rng(0), {}
    for arm in arms.values():
        limits = {joint.name: joint.limits for joint in arm.nominal_chain.joints}
        for joint, dimension in arm.commanded.items():
            reach = _REACH[dimension]
            low, high = limits.get(joint) or (-reach, reach)
            channels[f"{arm.name}.{joint}"] = random.uniform(max(low, -reach), max(min(high, reach), low), _POSES)
            channels[f"{arm.name}.approach.{joint}"] = random.choice([-1.0, 1.0], _POSES)
    return Dataset(tuple(str(i) for i in range(_POSES)), channels)


def _defaulted(problem: Problem, count: int) -> dict[str, Array]:
    """Channels of the kernels that poses do not say: those of a record at rest in the stated surroundings."""
    environment = problem.blueprint.environment
    known = {f"gravity_{a}": g for a, g in zip("xyz", environment.gravity, strict=True)}
    known |= {f"payload_{a}": g for a, g in zip("xyz", environment.payload_com, strict=True)}
    known["payload"] = environment.payload_mass
    names = [channel for kernel in problem.kernels for channel in kernel.factor.channels]
    return {name: np.full(count, known.get(name, 0.0)) for name in names}


def _rows(jacobian: Array) -> Array:
    """Slopes (n_r x n x N) as rows, record by record."""
    return np.ascontiguousarray(np.moveaxis(jacobian, 2, 0)).reshape(-1, jacobian.shape[1])


def _whitened(problem: Problem, values: Array, records: Sequence[FactorRecords], channels: Sequence[str]) -> Array:
    """d residual / d channels in units of the noise, rows as those of the Jacobians."""
    parts = []
    for kernel, slope in zip(problem.kernels, problem.channel_slopes(values, records, channels), strict=True):
        parts.append(_rows(slope / np.array(kernel.factor.noise)[:, None, None]))
    return np.concatenate(parts)


def _joint_step(channel: str, dimension: str, moved: Array, slopes: Array, names: Sequence[str]) -> JointStep | None:
    size = np.sum(slopes**2, axis=0)
    along = slopes.T @ moved
    alike = np.where(size > 0, along**2 / np.where(size > 0, size, 1.0), 0.0) / float(moved @ moved)
    best = int(np.argmax(alike))
    local = _local(moved, slopes, size)
    if alike[best] > _ALONE:
        direction = np.zeros(len(names))
        direction[best] = along[best] / size[best]
        return JointStep(channel, dimension, direction, tuple(i for i in local if i != best), names[best])
    several = np.asarray(np.linalg.lstsq(slopes, moved, rcond=_CUT)[0])
    left = moved - slopes @ several
    if float(left @ left) > (1 - _EXPLAINED) * float(moved @ moved):
        return None
    return JointStep(channel, dimension, several, tuple(local), "")


def _local(moved: Array, slopes: Array, size: Array) -> list[int]:
    """Coordinates that move every pose's prediction along the joint's own motion."""
    blocks = slopes.reshape(-1, 3, slopes.shape[1]) if len(slopes) % 3 == 0 else slopes[:, None]
    directions = moved.reshape(blocks.shape[:2])
    norms = np.linalg.norm(directions, axis=1, keepdims=True)
    unit = np.where(norms > 1e-9, directions / np.where(norms > 1e-9, norms, 1.0), 0.0)
    if blocks.shape[1] < 2:
        return []
    along = np.sum(np.einsum("kr,krn->kn", unit, blocks) ** 2, axis=0)
    return [i for i in range(slopes.shape[1]) if size[i] > _CUT and along[i] > _LOCAL * size[i]]


def _sensor(
    problem: Problem, values: Array, records: Sequence[FactorRecords], instance: str, poses: Dataset, slopes: Array
) -> tuple[Array, tuple[str, ...]] | None:
    """How the free parameters make a rigid motion of what an instrument reads; None for one that reads no position."""
    position = [f"{instance}.{axis}" for axis in "xyz"]
    if not all(poses.has(channel) for channel in position):
        return None
    turned = [f"{instance}.q{axis}" for axis in "wxyz"]
    channels = position + (turned if all(poses.has(channel) for channel in turned) else [])
    by_channel = _whitened(problem, values, records, channels)
    rows = len(by_channel) // max(len(poses), 1)
    motion = np.zeros((len(by_channel), 6))
    for k in range(len(poses)):
        at = slice(rows * k, rows * (k + 1))
        motion[at] = by_channel[at] @ _rigid(np.array([poses.column(c)[k] for c in channels]))
    names, columns = ("x", "y", "z", "rx", "ry", "rz"), []
    kept = []
    for i, name in enumerate(names):
        found = np.linalg.lstsq(slopes, motion[:, i], rcond=_CUT)[0]
        left = motion[:, i] - slopes @ found
        if float(left @ left) <= (1 - _EXPLAINED) * float(motion[:, i] @ motion[:, i]):
            columns.append(found)
            kept.append(name)
    return (np.array(columns).T, tuple(kept)) if columns else None


def _rigid(read: Array) -> Array:
    """How a reading (3, or 7 with a unit quaternion) changes with a shift and a turn of what it is read in (by 6)."""
    x, y, z = read[:3]
    change = np.zeros((len(read), 6))
    change[:3, :3] = np.eye(3)
    change[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    if len(read) > 3:
        for axis in range(3):
            turn = np.zeros(4)
            turn[1 + axis] = 0.5
            change[3:, 3 + axis] = quaternion_matrix(turn) @ read[3:]
    return change
