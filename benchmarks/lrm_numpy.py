"""The same arm in plain numpy, as one would write it by hand; it shares nothing with armcal's expressions.

Parameters go by the last part of armcal's names (``theta3``, ``base_x``, ``k2``); SI units.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = Mapping[str, float]

GRAVITY = np.array([0.0, 0.0, -9.81])
NOMINAL = {
    **{f"{name}{i}": 0.0 for name in ("alpha", "a", "theta", "d") for i in range(1, 7)},
    **{f"k{i}": 0.0 for i in range(7)},
    "alpha1": np.pi / 2, "alpha2": -np.pi / 2, "alpha3": np.pi / 2, "alpha4": -np.pi / 2, "alpha5": np.pi / 2,
    "theta1": np.pi, "d1": 0.046905, "d3": 0.04306953, "d5": 0.04325, "after2_z": 0.103505, "after4_z": 0.10775,
    "base_x": 0.04598, "base_y": 0.0, "base_z": 0.082012391, "base_rx": 0.0, "base_ry": np.pi / 3,
    "tool_rx": -np.pi / 2, "tool_ry": 0.0, "tool_y": 0.0, "tool_z": 0.07327,
}  # fmt: skip
LENGTHS = {2: ("upper_arm", "after2_z"), 4: ("forearm", "after4_z")}
MASSES: dict[
    str, list[tuple[float, tuple[float, float, float], int]]
] = {  # kg, centre (m) in the frame of that name, last joint that it loads
    "base": [(0.1234, (0, 0.002, 0.03732), 1)],
    "upper_arm": [(0.177, (0.01246484, -0.00020331, 0.0476142), 2)],
    "row2": [(0.1016, (0, 0.0025, 0.0319581), 3)],
    "forearm": [(0.1328, (0.0045466, 0, 0.053125), 4)],
    "row4": [(0.106, (0, 0, 0.029164), 5)],
    "hand": [(0.081, (0, 0, 0.04512), 6)],
    "tool": [(0.0482, (0.02432, 0.0021, 0.00433), 6), (0.0092, (0, 0, 0.015), 6)],
}


def turn(axis: str, angle: float | Array) -> Array:
    """Homogeneous rotation about a coordinate axis, one for each angle."""
    cosine, sine = np.cos(angle), np.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    result = np.zeros((*np.shape(angle), 4, 4)) + np.eye(4)
    result[..., i, i] = result[..., j, j] = cosine
    result[..., j, i], result[..., i, j] = sine, -sine
    return result


def shift(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Array:
    """Homogeneous translation."""
    result = np.eye(4)
    result[:3, 3] = x, y, z
    return result


def link(p: Numbers, i: int) -> Array:
    """What follows joint i, up to the next one (its length, if it has one, apart)."""
    return shift(z=p[f"d{i}"]) @ shift(x=p[f"a{i}"]) @ turn("x", p[f"alpha{i}"])


def base(p: Numbers) -> Array:
    """Up to the spring of the base."""
    return shift(p["base_x"], p["base_y"], p["base_z"]) @ turn("x", p["base_rx"])


def wrist(p: Numbers) -> Array:
    """From the last row to the hand."""
    return turn("x", p["tool_rx"]) @ turn("y", p["tool_ry"]) @ shift(y=p["tool_y"])


def elastic_pass(p: Numbers, angles: Array, deflection: Array) -> tuple[Array, Array]:
    """Tip (N x 3) and the deflections (N x 7) that gravity causes there."""
    here = base(p) @ turn("y", p["base_ry"] + deflection[:, 0])
    frames = {"base": here}
    axes = [(here[:, :3, 3], here[:, :3, 1])]
    for i in range(1, 7):
        axes.append((here[:, :3, 3], here[:, :3, 2]))
        here = here @ turn("z", angles[:, i - 1] + p[f"theta{i}"] + deflection[:, i]) @ link(p, i)
        if i in LENGTHS:
            name, length = LENGTHS[i]
            frames[name] = here
            here = here @ shift(z=p[length])
        frames[f"row{i}"] = here
    frames["hand"] = here @ wrist(p)
    frames["tool"] = frames["hand"] @ shift(z=p["tool_z"])
    loads = [
        (mass, mass * (frames[name] @ np.array([*centre, 1.0]))[:, :3], last)
        for name, masses in MASSES.items()
        for mass, centre, last in masses
    ]
    bent = np.empty_like(deflection)
    for i, (origin, axis) in enumerate(axes):
        carried = [(mass, moment) for mass, moment, last in loads if last >= i]
        lever = sum(moment for _, moment in carried) - sum(mass for mass, _ in carried) * origin
        bent[:, i] = p[f"k{i}"] * (lever * np.cross(GRAVITY, axis)).sum(axis=1)
    return frames["tool"][:, :3, 3], bent


def tip(p: Numbers, angles: Array, deflection: Array, rest: float = 1e-11) -> Array:
    """The tip in elastic equilibrium (N x 3); ``deflection`` is where to start, and is left in equilibrium."""
    for _ in range(100):
        position, bent = elastic_pass(p, angles, deflection)
        moved = np.abs(bent - deflection).max()
        deflection[:] = bent
        if moved < rest:
            break
    return position


def placements(p: Numbers) -> Array:
    """The rigid arm as each joint's placement in its parent, and the tip's (7 x 4 x 4)."""
    lengths = {i: shift(z=p[length]) for i, (_, length) in LENGTHS.items()}
    before = [base(p) @ turn("y", p["base_ry"])]
    before += [link(p, i) @ lengths.get(i, np.eye(4)) for i in range(1, 6)]
    joints = [b @ turn("z", p[f"theta{i}"]) for i, b in enumerate(before, start=1)]
    return np.array([*joints, link(p, 6) @ wrist(p) @ shift(z=p["tool_z"])])
