"""Nominal arms, as their makers publish them [UrDh, XarmKinematics]."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import DataError, Location

from armcal_makers.frames import at_zero, dh_frames, differences, pose

_UR_ALPHA = np.array([math.pi / 2, 0, 0, math.pi / 2, -math.pi / 2, 0])
_UR_M: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {
        "ur3": (0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
        "ur5": (0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
        "ur10": (0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
        "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
        "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
        "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
        "ur16e": (0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655),
        "ur20": (0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543),
        "ur30": (0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543),
    }
)
"""d1, a2, a3, d4, d5, d6 (m)."""
_R = math.pi / 2
_XARM: Mapping[str, tuple[tuple[float, ...], ...]] = MappingProxyType(
    {
        "xarm5": (
            (0, 0, 0.267, 0, 0, 0),
            (0, 0, 0, -_R, 0, 0),
            (0.0535, -0.2845, 0, 0, 0, 0),
            (0.0775, 0.3425, 0, 0, 0, 0),
            (0.076, 0.097, 0, -_R, 0, 0),
        ),
        "xarm6": (
            (0, 0, 0.267, 0, 0, 0),
            (0, 0, 0, -_R, 0, 0),
            (0.0535, -0.2845, 0, 0, 0, 0),
            (0.0775, 0.3425, 0, -_R, 0, 0),
            (0, 0, 0, _R, 0, 0),
            (0.076, 0.097, 0, -_R, 0, 0),
        ),
        "xarm7": (
            (0, 0, 0.267, 0, 0, 0),
            (0, 0, 0, -_R, 0, 0),
            (0, -0.293, 0, _R, 0, 0),
            (0.0525, 0, 0, _R, 0, 0),
            (0.0775, -0.3425, 0, _R, 0, 0),
            (0, 0, 0, _R, 0, 0),
            (0.076, 0.097, 0, -_R, 0, 0),
        ),
        "lite6": (
            (0, 0, 0.2435, 0, 0, 0),
            (0, 0, 0, _R, -_R, math.pi),
            (0.2002, 0, 0, -math.pi, 0, _R),
            (0.087, -0.22761, 0, _R, 0, 0),
            (0, 0, 0, _R, 0, 0),
            (0, 0.0625, 0, -_R, 0, 0),
        ),
        "uf850": (
            (0, 0, 0.364, 0, 0, 0),
            (0, 0, 0, _R, -_R, 0),
            (0.39, 0, 0, -math.pi, 0, -_R),
            (0.15, 0.426, 0, -_R, 0, 0),
            (0, 0, 0, -_R, 0, 0),
            (0, -0.09, 0, _R, 0, 0),
        ),
    }
)
FARTHEST_M, FARTHEST_RAD = 0.03, math.radians(5)
"""Frames of a calibrated arm further off the nominal ones are of another arm, or in other units."""
_UR_JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", *(f"wrist_{i}_joint" for i in (1, 2, 3)))
_UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


@dataclass(frozen=True)
class Family:
    """Arms whose calibrations are written alike.

    Attributes:
        format: what armcal calls their file.
        base: the frame that the first transform starts from, in the maker's own URDF.
        flange: the frame of the last joint, there.
        limits: of all joints (rad), where they share them.
    """

    format: str
    base: str
    flange: str
    limits: tuple[float, float] | None


UR = Family("ur_calibration", "base_link_inertia", "wrist_3_link", (-2 * math.pi, 2 * math.pi))
XARM = Family("xarm_kinematics", "link_base", "link_eef", None)


@dataclass(frozen=True)
class Nominal:
    """An arm as its maker draws it.

    Attributes:
        name: ``ur5e``, ``xarm6``.
        family: how calibrations of it are written.
        joints: as the maker's URDF names them.
        keys: as the maker's calibration names them.
        frames: parent_T_joint (n x 4 x 4).
    """

    name: str
    family: Family
    joints: tuple[str, ...]
    keys: tuple[str, ...]
    frames: Array

    def off(self, frames: Array) -> tuple[float, float]:
        """How far frames (parent_T_joint) are off these at zero angles, at most: m, rad; infinite for other counts."""
        if len(frames) != len(self.frames):
            return math.inf, math.inf
        shifts, turns = differences(at_zero(frames), at_zero(self.frames))
        return float(shifts.max()), float(turns.max())


def nominal_arms() -> dict[str, Nominal]:
    arms = [Nominal(name, UR, _UR_JOINTS, _UR_LINKS, dh_frames(*ur_rows(name))) for name in _UR_M]
    for name, rows in _XARM.items():
        joints = tuple(f"joint{i}" for i in range(1, len(rows) + 1))
        arms.append(Nominal(name, XARM, joints, joints, np.array([pose(row) for row in rows])))
    return {arm.name: arm for arm in arms}


def nearest(candidates: Mapping[str, Array], robot: str | None, where: Location | None = None) -> Nominal:
    """The stated arm, or the nearest of those that frames may be of.

    Args:
        candidates: parent_T_joint (n x 4 x 4) of each arm that it may be, by name.
        robot: the stated arm.
        where: the frames were read.

    Raises:
        DataError: the arm is not known, or the frames are not near to it.
    """
    arms = nominal_arms()
    if robot is not None and robot not in arms:
        raise DataError(f"the arm {robot!r} is not known.", where=where, hint=f"The arms are {', '.join(arms)}.")
    off = {name: arms[name].off(frames) for name, frames in candidates.items()}
    best = min(off, key=lambda candidate: off[candidate], default="any arm that is known")
    name, none = robot or best, (math.inf, math.inf)
    shift, turn = off.get(name, none)
    if shift <= FARTHEST_M and turn <= FARTHEST_RAD:
        return arms[name]
    hint = "It fits no arm that armcal knows: check units (m, rad), or use a URDF of the arm itself."
    if best in off and off[best][0] <= FARTHEST_M and off[best][1] <= FARTHEST_RAD:
        hint = f"It fits {best}, {1000 * off[best][0]:.2g} mm off: name that one, or check whose calibration it is."
    apart = f"{1000 * shift:.3g} mm and {math.degrees(turn):.2g} deg off" if shift < math.inf else "it has other joints"
    limits = f"{1000 * FARTHEST_M:g} mm and {math.degrees(FARTHEST_RAD):g} deg"
    raise DataError(f"it is not a calibration of {name}: {apart}, expected {limits} at most.", where=where, hint=hint)


def ur_rows(name: str) -> tuple[Array, Array, Array, Array]:
    """theta, a, d, alpha (6 each; rad, m) of a UR arm."""
    d1, a2, a3, d4, d5, d6 = _UR_M[name]
    return np.zeros(6), np.array([0, a2, a3, 0, 0, 0]), np.array([d1, 0, 0, d4, d5, d6]), _UR_ALPHA
