"""Where in the workspace the cube stands: every pose within limits, in one posture, with the tool turned one way.

Cubes grow about the tools of many postures at once, each size from the commands of the one before, until none fits.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.domains import Array
from armcal.calibration.compensation.compensator import Compensator
from armcal.errors import ProblemError
from armcal.run.iso_cube.cube import NAMES, SIZES, Cube, corners_about, points_about

_CHECKED = 24
"""Cubes of a size whose corners are looked at."""
_NEAR_RAD = 2.1
"""A joint that moves farther between poses is in another posture."""
_JOINTS_OF_A_POSE = 6
_MM = 1000.0


@dataclass(frozen=True)
class Placed:
    """A cube, and the commands of its poses (5 x n; rad or m)."""

    cube: Cube
    commands: Array


def placed(compensator: Compensator, postures: Array, size: float | None) -> Placed:
    """The cube of this size (m), or the largest one that fits, about the tool of one of some postures (n x M).

    The tool keeps its rotation in all poses where a cube is found for which it can.

    Raises:
        ProblemError: none fits.
    """
    sizes = sorted({*(other for other in SIZES if size is None or other < size), *([size] if size else [])})
    tools, largest = compensator.forward(postures.T), None
    for turned in (True, False) if len(postures) >= _JOINTS_OF_A_POSE else (False,):
        best = next(_fitting(compensator, postures.T, tools, sizes, turned), None)
        if best is None:
            continue
        if size is None or best.cube.size == size:
            return best
        largest = max(best.cube.size, largest or 0.0)
    if largest is None:
        raise ProblemError(
            f"no cube of {sizes[0] * _MM:g} mm or more was found within joint limits and clearance.",
            hint="Widen plan.limits, check plan.clearance; an arm that moves in a plane has no cube.",
        )
    raise ProblemError(
        f"no cube of {sizes[-1] * _MM:g} mm was found within joint limits and clearance.",
        hint=f"One of {largest * _MM:g} mm fits: give --iso-cube auto, or a size near to that.",
    )


def _fitting(
    compensator: Compensator, starts: Array, tools: Array, sizes: Sequence[float], turned: bool
) -> Iterator[Placed]:
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
        for i in order[_corners_reached(compensator, tools[own[order], :3, 3], size, poses_of[order])]:
            tool = tools[own[i]]
            yield Placed(Cube(size, tool[:3, 3], tool[:3, :3] if turned else None), poses_of[i])


def _corners_reached(compensator: Compensator, centres: Array, size: float, commands: Array) -> Array:
    """Whether the tool's place comes to all corners of each cube (N), from its poses' commands (N x 5 x n)."""
    corners, points = corners_about(centres, size), points_about(centres, size)
    apart = np.linalg.norm(corners[:, :, None] - points[:, None], axis=3)
    nearest = np.take_along_axis(commands, apart.argmin(axis=2)[..., None], axis=1)
    begun = nearest.reshape(-1, commands.shape[2])
    reached = compensator.onward(compensator.targets(corners.reshape(-1, 3)), begun).reached
    return np.asarray(reached.reshape(len(centres), -1).all(axis=1))
