"""The cube of ISO 9283 [ISO9283], and where it stands: every pose within limits, in one posture, tool turned one way.

Cubes grow about the tools of many postures at once, each size from the commands of the one before, until none fits.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array
from armcal.calibration.compensation.compensator import Compensator
from armcal.errors import ProblemError

NAMES = ("P1", "P2", "P3", "P4", "P5")
"""P1 is the centre, P2 to P5 go round the plane; P2 and P4 are ends of one diagonal."""
DIRECTED = ("P1", "P2", "P4")
"""Of which the standard takes several directions of approach."""
SIZES = (2.5, 1.6, 1.0, 0.63, 0.4, 0.25, 0.16, 0.1, 0.063, 0.04, 0.025)
"""Edges that are tried, a series of preferred numbers (m)."""
_FROM_CORNER = 0.1
"""Of a diagonal's length, from its corner to the pose."""
_PLANE = np.array([[0, 0, 0], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1]]) / 2
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
_CHECKED = 24
"""Cubes of a size whose corners are looked at."""
_NEAR_RAD = 2.1
"""A joint that moves farther between poses is in another posture."""
_JOINTS_OF_A_POSE = 6
_MM = 1000.0


@dataclass(frozen=True)
class Cube:
    """A cube along the axes of the base frame.

    Attributes:
        size: of an edge (m).
        centre: 3 (m).
        rotation: base_R_tool in all poses (3 x 3); None for an arm that cannot keep one.
    """

    size: float
    centre: Array
    rotation: Array | None

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
        # Whether the tool's place comes to all corners, from the commands of the nearest pose.
        centres = tools[own[order], :3, 3]
        corners = corners_about(centres, size)
        apart = np.linalg.norm(corners[:, :, None] - points_about(centres, size)[:, None], axis=3)
        nearest = np.take_along_axis(poses_of[order], apart.argmin(axis=2)[..., None], axis=1)
        begun = nearest.reshape(-1, poses_of.shape[2])
        reached = compensator.onward(compensator.targets(corners.reshape(-1, 3)), begun).reached
        for i in order[reached.reshape(len(centres), -1).all(axis=1)]:
            tool = tools[own[i]]
            yield Placed(Cube(size, tool[:3, 3], tool[:3, :3] if turned else None), poses_of[i])
