"""A chain as Denavit-Hartenberg rows: the settings of the model ``mdh``. [Denavit1955] [Craig2005]

From each axis to the next by their common normal. Where two axes are nearly parallel it lies far away, or nowhere:
there the next frame sits in the plane across the axis before, and a further turn about y takes up what is left.
[Hayati1983]
A sliding joint's axis may lie anywhere; it is taken through the joint's frame.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from armcal.base.arrays import Array
from armcal.base.quaternions import rpy_of
from armcal.calibration.rigid_chain import RigidChain, require_independent, require_plain_axes

Convention = Literal["standard", "craig"]
NEARLY_PARALLEL = 0.01
"""Sine of an angle between axes."""
_MEET = 0.005
"""m: axes that pass each other at less have their common normal's sense chosen by its direction."""
_SIDEWAYS = 0.1
_NOWHERE = 1e-13
_NOTHING = 1e-15


@dataclass(frozen=True)
class Link:
    """From one axis to the next (m, rad): ``theta`` and ``d`` on the first, ``a`` and ``alpha`` across.

    A ``turn`` about y comes after ``alpha`` in the standard convention and before it in Craig's.
    """

    theta: float = 0.0
    d: float = 0.0
    a: float = 0.0
    alpha: float = 0.0
    turn: float = 0.0

    def along(self) -> Array:
        """Rot_z(theta) Trans_z(d) as a 4x4 matrix."""
        return _motion("z", self.theta, self.d)

    def across(self, convention: Convention) -> Array:
        """From the common normal on the first axis to the frame on the second (4x4)."""
        shift, turn, twist = _motion("x", 0.0, self.a), _motion("y", self.turn, 0.0), _motion("x", self.alpha, 0.0)
        return shift @ twist @ turn if convention == "standard" else shift @ turn @ twist


def mdh_section(chain: RigidChain, convention: Convention) -> dict[str, Any]:
    """Rows, and steps before and after them.

    Raises:
        ProblemError: a joint follows another, or has pitch or scale.
    """
    require_independent(chain, "mdh")
    require_plain_axes(chain, "mdh")
    frame = _frame_on(chain.joints[0].base_T_joint, chain.joints[0].direction)
    links: list[Link] = []
    base: Array = frame
    for i, beyond in enumerate(chain.joints[1:]):
        link = _link(frame, beyond.point, beyond.direction, convention)
        frame = frame @ link.along()
        if i == 0:
            base, link = frame, Link(0.0, 0.0, link.a, link.alpha, link.turn)
        links.append(link)
        frame = frame @ link.across(convention)
    tool: Array = np.asarray(np.linalg.solve(frame, chain.base_T_tool))
    rows = _standard_rows(links) if convention == "standard" else _craig_rows(links)
    for row, joint in zip(rows, chain.joints, strict=True):
        if joint.slides:
            row["kind"] = "prismatic"
    names = [joint.name for joint in chain.joints]
    return {
        "type": "mdh",
        "convention": convention,
        "joints": names,
        "base": _steps(base),
        "rows": rows,
        "tool": _steps(tool),
    }


def _standard_rows(links: list[Link]) -> list[dict[str, Any]]:
    rows = []
    for link in [*links, Link()]:
        after = {"after": [{"ry_deg": _degrees(link.turn)}]} if link.turn else {}
        rows.append({**_row(link.theta, link.d, link.a, link.alpha), **after})
    return rows


def _craig_rows(links: list[Link]) -> list[dict[str, Any]]:
    rows = []
    for before, here in zip([Link(), *links], [*links, Link()], strict=True):
        if before.turn:
            steps = [{"x_mm": _millimetres(before.a)}, {"ry_deg": _degrees(before.turn)}]
            rows.append({**_row(here.theta, here.d, 0.0, before.alpha), "before": steps})
        else:
            rows.append(_row(here.theta, here.d, before.a, before.alpha))
    return rows


def _row(theta: float, d: float, a: float, alpha: float) -> dict[str, Any]:
    lengths = {"a_mm": _millimetres(a), "d_mm": _millimetres(d)}
    return {"alpha_deg": _degrees(alpha), "theta_deg": _degrees(theta), **lengths}


def _link(frame: Array, point: Array, direction: Array, convention: Convention) -> Link:
    """From a frame with z along an axis to the next axis, given in the base frame by a point and a direction."""
    p, w = frame[:3, :3].T @ (point - frame[:3, 3]), frame[:3, :3].T @ direction
    sine = math.hypot(w[0], w[1])
    if sine < NEARLY_PARALLEL:
        return _nearly_parallel(p - w * (p[2] / w[2]), w, convention)
    normal = np.array([-w[1], w[0]]) / sine
    a = float(normal @ p[:2])
    # Towards the next axis; forwards where the two nearly meet, so that a small correction does not turn the row over.
    across = normal[0] if abs(normal[0]) > _SIDEWAYS else normal[1]
    if a < -_MEET or (a <= _MEET and across < 0):
        normal, a = -normal, -a
    d = float(p[2] - w[2] * (p[:2] @ w[:2]) / sine**2)
    alpha = math.atan2(normal[0] * w[1] - normal[1] * w[0], w[2])
    return Link(math.atan2(normal[1], normal[0]), d, a if abs(a) > _NOTHING else 0.0, -alpha)


def _nearly_parallel(foot: Array, w: Array, convention: Convention) -> Link:
    a = math.hypot(foot[0], foot[1])
    theta = math.atan2(foot[1], foot[0]) if a > _NOWHERE else 0.0
    x, y, z = _motion("z", -theta, 0.0)[:3, :3] @ w
    side = math.copysign(1.0, z)
    if convention == "standard":
        alpha, turn = math.atan2(-y, z), math.asin(x)
    else:
        alpha, turn = math.atan2(-y, side * math.hypot(x, z)), math.atan2(side * x, side * z)
    return Link(theta, 0.0, a if a > _NOWHERE else 0.0, alpha, turn if abs(turn) > _NOTHING else 0.0)


def _frame_on(frame: Array, direction: Array) -> Array:
    x = frame[:3, 0] if abs(frame[:3, 0] @ direction) < 0.9 else frame[:3, 1]
    x = x - direction * (direction @ x)
    x = x / np.linalg.norm(x)
    placed = np.array(frame)
    placed[:3, :3] = np.column_stack([x, np.cross(direction, x), direction])
    return placed


def _steps(pose: Array) -> list[dict[str, float]]:
    """x, y, z, then yaw, pitch, roll; those that are zero too, so that a calibration may find what they really are."""
    roll, pitch, yaw = rpy_of(pose[:3, :3])
    lengths = {f"{axis}_mm": _millimetres(value) for axis, value in zip("xyz", pose[:3, 3], strict=True)}
    angles = {"rz_deg": _degrees(yaw), "ry_deg": _degrees(pitch), "rx_deg": _degrees(roll)}
    return [{key: value} for key, value in {**lengths, **angles}.items()]


def _motion(axis: str, angle: float, distance: float) -> Array:
    """A turn about and a shift along a coordinate axis (4x4)."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    motion = np.eye(4)
    motion[j, j] = motion[k, k] = math.cos(angle)
    motion[k, j], motion[j, k] = math.sin(angle), -math.sin(angle)
    motion[i, 3] = distance
    return motion


def _degrees(angle: float) -> float:
    """Above -180, at most 180."""
    degrees = round(math.degrees(angle), 13) + 0.0
    return 180.0 if degrees == -180.0 else degrees


def _millimetres(length: float) -> float:
    return round(1000 * float(length), 12) + 0.0
