"""The cube of ISO 9283 and the five poses on its inclined plane. [ISO9283]"""

from dataclasses import dataclass

import numpy as np

from armcal.base.domains import Array

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
