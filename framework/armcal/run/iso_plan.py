"""The test of ISO 9283 [ISO9283]: a cube in the workspace, its poses, and the table in which they are visited.

Cubes grow about the tools of many postures at once, each size from the commands of the one before, until none fits:
every pose within limits, in one posture, tool turned one way.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armcal.arm.assembly import only_arm
from armcal.arm.joints import joint_limits
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import Options
from armcal.calibration.tool_expression import arm_expression
from armcal.errors import ProblemError
from armcal.run.experiment import Experiment
from armcal.run.plan import approach_channels, values_about
from armcal.run.plan_poses import JointSpace, clearance_of, spread
from armcal.run.settings import PlanSettings

NAMES = ("P1", "P2", "P3", "P4", "P5")
"""P1 is the centre, P2 to P5 go round the plane; P2 and P4 are ends of one diagonal."""
_DIRECTED = ("P1", "P2", "P4")  # Of which the standard takes several directions of approach
_SIZES = (2.5, 1.6, 1.0, 0.63, 0.4, 0.25, 0.16, 0.1, 0.063, 0.04, 0.025)
"""Edges that are tried, a series of preferred numbers (m)."""
_FROM_CORNER = 0.1  # Of a diagonal's length, from its corner to the pose
_PLANE = np.array([[0, 0, 0], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1]]) / 2
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
_CHECKED = 24  # Cubes of a size whose corners are looked at
_NEAR_RAD = 2.1  # A joint that moves farther between poses is in another posture
_JOINTS_OF_A_POSE = 6
_MM = 1000.0
_PATH = "path"  # The direction of poses that are come to one from another
_OF_SIZE, _FARTHEST = 0.1, 0.05  # How far an approach begins: of the cube's edge, and at most (m)
_STILL = 1e-6  # A joint that moves less (rad or m) does not come from a side
_POSTURES = 1024
_NO_CLEARANCE = "no clearance is stated (plan.clearance): nothing here keeps the arm from itself or the table."


@dataclass(frozen=True)
class Cube:
    """A cube along the axes of the base frame, and the commands of its poses."""

    size: float  # of an edge (m)
    centre: Array  # 3 (m)
    rotation: Array | None  # base_R_tool in all poses (3 x 3); None for an arm that cannot keep one
    commands: Array  # 5 x n; rad or m

    @property
    def points(self) -> Array:
        """P1 to P5 (5 x 3; m)."""
        return np.asarray(points_about(self.centre[None], self.size)[0], dtype=float)


def points_about(centres: Array, size: float) -> Array:
    """P1 to P5 of cubes about centres (N x 3; m): on the diagonals of the plane, a tenth of their length from corners.

    The plane holds the lower edge at small x and the upper edge at large x; its diagonals are those of the cube.
    """
    return np.asarray(centres[:, None] + (1 - 2 * _FROM_CORNER) * size * _PLANE)


def corners_about(centres: Array, size: float) -> Array:
    """The corners of cubes about centres (N x 8 x 3; m)."""
    return np.asarray(centres[:, None] + size * _CORNERS, dtype=float)


def _placed(compensator: Compensator, starts: Array, size: float | None) -> Cube:
    """The cube of this size (m), or the largest one that fits, about the tool of one of some postures (M x n).

    The tool keeps its rotation in all poses where a cube is found for which it can.
    """
    sizes = sorted({*(other for other in _SIZES if size is None or other < size), *([size] if size else [])})
    tools, largest = compensator.forward(starts), 0.0
    for turned in (True, False) if starts.shape[1] >= _JOINTS_OF_A_POSE else (False,):
        best = next(_fitting(compensator, starts, tools, sizes, turned), None)
        if best is not None and size in (None, best.size):
            return best
        largest = max(best.size if best else 0.0, largest)
    raise ProblemError(
        f"no cube of {sizes[-1 if largest else 0] * _MM:g} mm{'' if largest else ' or more'} was found within joint "
        "limits and clearance.",
        hint=f"One of {largest * _MM:g} mm fits: give --iso-cube auto, or a size near to that."
        if largest
        else "Widen plan.limits, check plan.clearance; an arm that moves in a plane has no cube.",
    )


def _fitting(
    compensator: Compensator, starts: Array, tools: Array, sizes: Sequence[float], turned: bool
) -> Iterator[Cube]:
    """Cubes that fit, the largest first."""
    count, rows = len(NAMES), np.arange(len(starts))
    commands, steps = np.repeat(starts[:, None], count, axis=1), list[tuple[float, Array, Array]]()
    for size in sizes:
        points = points_about(tools[rows, :3, 3], size).reshape(-1, 3)
        rotations = np.repeat(tools[rows, :3, :3], count, axis=0) if turned else None
        poses = compensator.onward(compensator.targets(points, rotations), commands.reshape(len(points), -1))
        commands = poses.joint_angles.reshape(len(rows), count, -1)
        near = np.ptp(commands, axis=1).max(axis=1) < _NEAR_RAD
        fits = poses.reached.reshape(-1, count).all(axis=1) & near
        rows, commands = rows[fits], commands[fits]
        if not len(rows):
            break
        steps.append((size, rows, commands))
    for size, own, poses_of in reversed(steps):
        order = np.argsort(np.ptp(poses_of, axis=1).max(axis=1), kind="stable")[:_CHECKED]
        # Whether the tool's place comes to all corners, from the commands of the nearest pose.
        centres = tools[own[order], :3, 3]
        corners = corners_about(centres, size)
        apart = np.linalg.norm(corners[:, :, None] - points_about(centres, size)[:, None], axis=3)
        nearest = np.take_along_axis(poses_of[order], apart.argmin(axis=2)[..., None], axis=1)
        begun = nearest.reshape(-1, poses_of.shape[2])
        reached = compensator.onward(compensator.targets(corners.reshape(-1, 3)), begun).reached
        for i in order[reached.reshape(len(centres), -1).all(axis=1)]:
            tool = tools[own[i]]
            yield Cube(size, tool[:3, 3], tool[:3, :3] if turned else None, poses_of[i])


def _table(
    compensator: Compensator, cube: Cube, cycles: int, directions: int, space: JointSpace
) -> tuple[Dataset, tuple[str, ...]]:
    """All visits in order, and warnings of directions that cannot be come from.

    Beside joints and sides the pose, the cycle, the direction, whence joints come, where the tool is.
    """
    order, index = range(1, cycles + 1), {name: i for i, name in enumerate(NAMES)}
    visits = [(name, cycle, _PATH, i, cube.commands[i - 1]) for cycle in order for name, i in index.items()]
    own, far, warnings = [index[name] for name in _DIRECTED], min(_OF_SIZE * cube.size, _FARTHEST), []
    rotations = None if cube.rotation is None else np.repeat(cube.rotation[None], len(own), axis=0)
    for axis, direction in enumerate("xyz"[:directions]):
        begun: dict[str, Array] = {}
        for side in (-1.0, 1.0):  # an approach begins below the pose, else above it
            places = cube.points[own] + side * far * np.eye(3)[axis]
            poses = compensator.onward(compensator.targets(places, rotations), cube.commands[own])
            begun = {name: poses.joint_angles[k] for k, name in enumerate(_DIRECTED) if poses.reached[k]} | begun
        kept = [name for name in _DIRECTED if name in begun]
        if lost := [name for name in _DIRECTED if name not in begun]:
            warnings.append(f"{', '.join(lost)}: no approach along {direction} lies within limits; it is left out.")
        visits += [(name, cycle, direction, index[name], begun[name]) for cycle in order for name in kept]
    commands = np.array([cube.commands[visit[3]] for visit in visits])
    before = np.array([visit[4] for visit in visits])
    moves = (commands - before).T
    sides = np.where(np.abs(moves) > _STILL, np.sign(moves), 0.0)
    channels = dict(zip((*space.channels, *approach_channels(space)), (*commands.T, *sides), strict=True))
    extra = {key: tuple(str(visit[k]) for visit in visits) for k, key in enumerate(("pose", "cycle", "direction"))}
    for name, dimension, row in zip(space.names, space.dimensions, before.T, strict=True):
        unit = display_unit(dimension).name
        extra[f"from_{name}_{unit}"] = _texts(to_unit(row, unit))
    tools = compensator.forward(commands)
    extra |= {f"tool_{axis}_mm": _texts(to_unit(tools[:, i, 3], "mm")) for i, axis in enumerate("xyz")}
    ids = tuple(f"{pose}.{direction}.{cycle}" for pose, cycle, direction, *_ in visits)
    return Dataset(ids, channels, extra, source="plan"), tuple(warnings)


def _texts(values: Array) -> tuple[str, ...]:
    return tuple(f"{value:.6f}" for value in values.tolist())


@dataclass(frozen=True)
class IsoPlan:
    """A cube and its test."""

    cube: Cube
    dataset: Dataset  # the visits, in order
    motion: float  # the largest motion of a joint between poses (rad or m)
    warnings: tuple[str, ...]


def make_iso_plan(
    experiment: Experiment, size: float | None, cycles: int, directions: int, calibration: Path | None = None
) -> IsoPlan:
    """The test in a cube of this size (m), or the largest that fits; for the rigid nominal arm, or a calibrated one.

    Raises:
        ConfigError: there are several arms, or joints without limits.
        ProblemError: no cube fits.
    """
    hint = "Describe the arm that is to be tested alone."
    arm = only_arm(experiment.system.arms, "the test is of a single arm", hint)
    space, settings = JointSpace.of(experiment), experiment.settings.plan or PlanSettings()
    # Of each joint, stated or the model's own; ``spread`` refuses a joint without.
    own, stated, check = joint_limits(arm.nominal_chain), space.limits(settings), clearance_of(experiment)
    model = np.array([own.get(joint) or (-np.inf, np.inf) for joint in arm.commanded], dtype=float)
    limits = np.where(np.isfinite(stated), stated, model)
    parameters = values_about(experiment, calibration)
    plain = replace(arm, effects={}, masses=()) if calibration is None else arm
    compensator = Compensator(
        arm_expression(plain, parameters, experiment.system.environment),
        parameters,
        Options(limits={name: (low, high) for name, (low, high) in zip(space.names, limits.tolist(), strict=True)}),
        check,
    )
    pool = spread(settings.model_copy(update={"count": _POSTURES}), space, limits, check)
    cube = _placed(compensator, pool.dataset.stacked(space.channels).T, size)
    dataset, warnings = _table(compensator, cube, cycles, directions, space)
    motion = float(np.ptp(cube.commands, axis=0).max())
    return IsoPlan(cube, dataset, motion, warnings if check is not None else (*warnings, _NO_CLEARANCE))
