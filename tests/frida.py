"""The nominal geometry of one 7-joint arm of the Frida robot, as printed. [Bergstrom2016]"""

from __future__ import annotations

AXES = (
    ((0, 0, 0), (0, 0, 1)),
    ((-0.030, 0, 0.110), (0, 1, 0)),
    ((0, 0, 0.2565), (0, 0, 1)),
    ((0.0405, 0, 0.3565), (0, 1, 0)),
    ((0.180, 0, 0.397), (1, 0, 0)),
    ((0.3055, 0, 0.3835), (0, 1, 0)),
    ((0.3375, 0, 0.4105), (1, 0, 0)),
)
"""A point (m) and the direction of each joint's axis in the arm's base frame, at zero angles."""
TOOL = {"position_m": [0.3375, 0, 0.4105], "rotation": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]}
BASE = {
    "position_m": [0.0393, -0.0645, 0.4035],
    "rotation": [[0.5723, -0.1041, 0.8134], [0.6161, 0.7092, -0.3427], [-0.5412, 0.6973, 0.4700]],
}
"""The right arm's base in the robot's, printed to four digits."""


def model(**more):
    """The arm as a section of a configuration."""
    joints = [{"kind": "revolute", "axis": list(axis), "point_m": list(point)} for point, axis in AXES]
    return {"joints": joints, "tool": TOOL, **more}
