"""The test of ISO 9283 [ISO9283]: a cube in the workspace, its poses, and the table in which they are visited.

Cubes grow about the tools of many postures at once, each size from the commands of the one before, until none fits:
every pose within limits, in one posture, tool turned one way.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armcal.arm.assembly import only_arm
from armcal.arm.joints import by_dimension, joint_limits
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit
from armcal.calibration.compensation import Compensator, Options
from armcal.calibration.tool_expression import arm_expression
from armcal.errors import ProblemError
from armcal.run.experiment import Experiment, PlanSettings
from armcal.run.plan import approach_channels, values_about
from armcal.run.plan_poses import JointSpace, clearance_of, spread

NAMES = ("P1", "P2", "P3", "P4", "P5")
"""P1 is the centre, P2 to P5 go round the plane; P2 and P4 are ends of one diagonal."""
_DIRECTED = ("P1", "P2", "P4")  # Of which the standard takes several directions of approach
_SIZES = (2.5, 1.6, 1.0, 0.63, 0.4, 0.25, 0.16, 0.1, 0.063, 0.04, 0.025)
"""Edges that are tried, a series of preferred numbers (m)."""
POINTS = 0.8 * np.array([[0, 0, 0], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1]]) / 2
"""P1 to P5 about the centre, of an edge: on the diagonals of the plane, a tenth of their length from the corners.

The plane holds the lower edge at small x and the upper edge at large x; its diagonals are those of the cube.
"""
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
_NEAR_RAD = 2.1  # A joint that moves farther between poses is in another posture
_MM = 1000.0
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


def _placed(compensator: Compensator, starts: Array, size: float | None) -> Cube:
    """The cube of this size (m), or the largest one that fits, about the tool of one of some postures (M x n).

    The tool of an arm that can keeps its rotation. Of cubes that fit, that whose poses are nearest in the joints.
    """
    sizes = sorted({*(other for other in _SIZES if size is None or other < size), *([size] if size else [])})
    tools, best, turned = compensator.forward(starts), None, starts.shape[1] >= 6
    commands, at_corners = (np.repeat(starts[:, None], len(about), axis=1) for about in (POINTS, CORNERS))
    for edge in sizes:
        rotations = np.repeat(tools[:, :3, :3], len(POINTS), axis=0) if turned else None
        reached, commands = _reached(compensator, tools, edge * POINTS, rotations, commands)
        fits = reached & (np.ptp(commands, axis=1).max(axis=1) < _NEAR_RAD)
        tools, commands, at_corners = tools[fits], commands[fits], at_corners[fits]
        if len(tools):
            fits, at_corners = _reached(compensator, tools, edge * CORNERS, None, at_corners)
            tools, commands, at_corners = tools[fits], commands[fits], at_corners[fits]
        if not len(tools):
            break
        i = int(np.argmin(np.ptp(commands, axis=1).max(axis=1)))
        best = Cube(edge, tools[i, :3, 3], tools[i, :3, :3] if turned else None, commands[i])
    if best is not None and size in (None, best.size):
        return best
    kept = ", the tool turned one way" if turned else ""
    raise ProblemError(
        f"no cube of {sizes[-1 if best else 0] * _MM:g} mm{'' if best else ' or more'} was found within joint limits "
        f"and clearance{kept}.",
        hint=f"One of {best.size * _MM:g} mm fits: give --iso-cube auto, or a size near to that."
        if best
        else "Widen plan.limits, check plan.clearance; an arm that moves in a plane has no cube.",
    )


def _reached(
    compensator: Compensator, tools: Array, about: Array, rotations: Array | None, commands: Array
) -> tuple[Mask, Array]:
    """Whether all points about tools (M x 4 x 4; k x 3, m) are reached from commands (M x k x n), and by which."""
    targets = compensator.targets((tools[:, None, :3, 3] + about).reshape(-1, 3), rotations)
    poses = compensator.onward(targets, commands.reshape(-1, commands.shape[2]))
    return np.all(poses.reached.reshape(-1, len(about)), axis=1), poses.joint_angles.reshape(commands.shape)


def _table(
    compensator: Compensator, cube: Cube, cycles: int, directions: int, space: JointSpace
) -> tuple[Dataset, tuple[str, ...]]:
    """All visits in order, and warnings of directions that cannot be come from.

    Beside joints and sides the pose, the cycle, the direction, whence joints come, where the tool is.
    """
    order, index = range(1, cycles + 1), {name: i for i, name in enumerate(NAMES)}
    visits = [(name, cycle, "path", i, cube.commands[i - 1]) for cycle in order for name, i in index.items()]
    own, far, warnings = [index[name] for name in _DIRECTED], min(_OF_SIZE * cube.size, _FARTHEST), []
    rotations = None if cube.rotation is None else np.repeat(cube.rotation[None], len(own), axis=0)
    for axis, direction in enumerate("xyz"[:directions]):
        begun: dict[str, Array] = {}
        for side in (-1.0, 1.0):  # an approach begins below the pose, else above it
            places = cube.centre + cube.size * POINTS[own] + side * far * np.eye(3)[axis]
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
        extra[f"from_{name}_{unit}"] = tuple(f"{value:.6f}" for value in to_unit(row, unit).tolist())
    tools = compensator.forward(commands)
    extra |= {
        f"tool_{axis}_mm": tuple(f"{place:.6f}" for place in (_MM * tools[:, i, 3]).tolist())
        for i, axis in enumerate("xyz")
    }
    ids = tuple(f"{pose}.{direction}.{cycle}" for pose, cycle, direction, *_ in visits)
    return Dataset(ids, channels, extra, source="plan"), tuple(warnings)


def make_iso_plan(
    experiment: Experiment, size: float | None, cycles: int, directions: int, calibration: Path | None = None
) -> tuple[Cube, Dataset, tuple[str, ...]]:
    """The test in a cube of this size (m), or the largest that fits; for the rigid nominal arm, or a calibrated one.

    Gives the cube, the visits in order, and warnings.

    Raises:
        ConfigError: there are several arms, or joints without limits.
        ProblemError: no cube fits.
    """
    arm = only_arm(
        experiment.system.arms, "the test is of a single arm", "Describe the arm that is to be tested alone."
    )
    space, settings, check = (
        JointSpace.of(experiment),
        experiment.settings.plan or PlanSettings(),
        clearance_of(experiment),
    )
    # Of each joint, stated or the model's own; ``spread`` refuses a joint without.
    known = joint_limits(arm.nominal_chain, by_dimension(arm.commanded, settings.limits, settings.travel_limits))
    limits = np.array([known.get(joint) or (-np.inf, np.inf) for joint in arm.commanded], dtype=float)
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
    return cube, dataset, warnings if check is not None else (*warnings, _NO_CLEARANCE)
