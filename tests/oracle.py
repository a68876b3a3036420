"""The LRM arm in plain numpy: an independent implementation that shares no code with armcal.

Everything is vectorised over records: joint angles are (N x 6), deflections (N x 7), points (N x 3), SI units.
Values are a mapping of the names below; the arm is the one described beside the measured data.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

JOINTS = 6
EARTH = np.array([0.0, 0.0, -9.81])

# name: (last joint it is counted on, last joint that moves it, frame, mass, centre)
LINKS = {
    "link1": (1, 0, "mount", 0.1234, (0.0, 0.002, 0.03732)),
    "link2": (2, 2, "upper_arm", 0.177, (0.01246484, -0.00020331, 0.0476142)),
    "link3": (3, 2, "row2", 0.1016, (0.0, 0.0025, 0.0319581)),
    "link4": (4, 4, "forearm", 0.1328, (0.0045466, 0.0, 0.053125)),
    "link5": (5, 4, "row4", 0.106, (0.0, 0.0, 0.029164)),
    "link6": (6, 6, "hand", 0.081, (0.0, 0.0, 0.04512)),
    "target": (6, 6, "tool", 0.0482, (0.02432, 0.0021, 0.00433)),
    "holder": (6, 6, "tool", 0.0092, (0.0, 0.0, 0.015)),
}

OPTION_1 = (
    *(f"alpha{i}" for i in (2, 3, 4, 5)),
    *(f"k{i}" for i in range(7)),
    *(f"a{i}" for i in (3, 4, 5)),
    *(f"theta{i}" for i in range(1, 7)),
    *("d4", "d5", "base_x", "base_y", "base_z", "tool_y", "tool_z", "after2_z"),
)

PUBLISHED = {
    "base_x": 0.0450012607877,
    "base_y": 0.0101881859701,
    "base_z": 0.0791551964557,
    "theta1": 3.15100806544,
    "alpha2": -1.57269305612,
    "theta2": -0.0398087849959,
    "after2_z": 0.106287509465,
    "alpha3": 1.58428596903,
    "a3": 0.000738125016909,
    "theta3": -0.00301362014372,
    "alpha4": -1.57008588873,
    "a4": 0.00193545384747,
    "theta4": 0.00494411395724,
    "d4": -0.0014037165571,
    "alpha5": 1.47774788785,
    "a5": -0.000122159216195,
    "theta5": -0.0265053905913,
    "d5": 0.0415752900921,
    "theta6": -0.0292443951076,
    "tool_y": -0.00559231597072,
    "tool_z": 0.0752407978587,
    "k0": 0.0183197529998,
    "k1": 0.0714898255262,
    "k2": 0.0661690510178,
    "k3": 0.0788748270206,
    "k4": 0.0790182194328,
    "k5": 0.379939165988,
    "k6": 0.0161428678502,
}


def nominal() -> dict[str, float]:
    """All 77 numbers of the arm and its target, at their nominal values."""
    half = np.pi / 2
    values = {"base_x": 0.04598, "base_y": 0.0, "base_z": 0.082012391, "base_rx": 0.0, "base_ry": np.pi / 3}
    alphas, offsets = (half, -half, half, -half, half, 0.0), (0.046905, 0.0, 0.04306953, 0.0, 0.04325, 0.0)
    for i in range(1, JOINTS + 1):
        values |= {f"alpha{i}": alphas[i - 1], f"a{i}": 0.0, f"theta{i}": 0.0, f"d{i}": offsets[i - 1]}
    values |= {"theta1": np.pi, "after2_z": 0.103505, "after4_z": 0.10775}
    values |= {"tool_rx": -half, "tool_ry": 0.0, "tool_y": 0.0, "tool_z": 0.07327}
    values |= {f"k{i}": 0.0 for i in range(JOINTS + 1)}
    values |= {f"target_{axis}": 0.0 for axis in "xyz"}
    for name, (_, _, _, mass, centre) in LINKS.items():
        values |= {f"{name}.mass": mass, **{f"{name}.com_{a}": c for a, c in zip("xyz", centre, strict=True)}}
    return values


def published() -> dict[str, float]:
    """The published fit of 28 parameters."""
    return {**nominal(), **PUBLISHED}


def armcal_name(name: str) -> str:
    """The parameter name that the shipped configuration uses."""
    if name.startswith("target_"):
        return f"tracker.{name}"
    if "." in name:
        return f"arm.links.{name}"
    return f"arm.spring.{name}" if name.startswith("k") else f"arm.mdh.{name}"


@dataclass(frozen=True)
class Loads:
    """Gravity, payload and wrench; each may differ from record to record (N x 3 or N) or not (3 or a number)."""

    gravity: np.ndarray = field(default_factory=lambda: EARTH)
    payload_mass: float | np.ndarray = 0.0
    payload_com: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 0.015]))
    force: np.ndarray = field(default_factory=lambda: np.zeros(3))
    torque: np.ndarray = field(default_factory=lambda: np.zeros(3))
    physical: bool = False


def homogeneous(count: int) -> np.ndarray:
    """Identity matrices (count x 4 x 4)."""
    return np.tile(np.eye(4), (count, 1, 1))


def turn(axis: str, angle: float | np.ndarray, count: int) -> np.ndarray:
    """Rotations about a coordinate axis (count x 4 x 4)."""
    matrix = homogeneous(count)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix[:, i, i] = matrix[:, j, j] = np.cos(angle)
    matrix[:, j, i] = np.sin(angle)
    matrix[:, i, j] = -np.sin(angle)
    return matrix


def shift(x: float, y: float, z: float, count: int) -> np.ndarray:
    """Translations (count x 4 x 4)."""
    matrix = homogeneous(count)
    matrix[:, 0, 3], matrix[:, 1, 3], matrix[:, 2, 3] = x, y, z
    return matrix


def point(pose: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Local coordinates (3 or N x 3) in the frame that the poses map to."""
    return np.einsum("nij,nj->ni", pose[:, :3, :3], np.broadcast_to(local, (len(pose), 3))) + pose[:, :3, 3]


def poses(v: dict[str, float], q: np.ndarray, deflection: np.ndarray) -> tuple[list[np.ndarray], dict[str, np.ndarray]]:
    """The frame before each joint's row (the base first), and the named frames."""
    n = len(q)
    base = shift(v["base_x"], v["base_y"], v["base_z"], n) @ turn("x", v["base_rx"], n)
    here = base = base @ turn("y", v["base_ry"] + deflection[:, 0], n)
    before, frames = [], {"mount": base}
    for i in range(1, JOINTS + 1):
        before.append(here)
        here = here @ turn("z", q[:, i - 1] + v[f"theta{i}"] + deflection[:, i], n) @ shift(0, 0, v[f"d{i}"], n)
        here = here @ shift(v[f"a{i}"], 0, 0, n) @ turn("x", v[f"alpha{i}"], n)
        if i in (2, 4):
            frames["upper_arm" if i == 2 else "forearm"] = here
            here = here @ shift(0, 0, v[f"after{i}_z"], n)
        frames[f"row{i}"] = here
    hand = here @ turn("x", v["tool_rx"], n) @ turn("y", v["tool_ry"], n) @ shift(0, v["tool_y"], 0, n)
    return before, {**frames, "hand": hand, "tool": hand @ shift(0, 0, v["tool_z"], n)}


def site_moments(
    v: dict[str, float], before: list[np.ndarray], frames: dict[str, np.ndarray], loads: Loads
) -> list[np.ndarray]:
    """Moments (N x 3) that the base and each joint carry, mass by mass."""
    n = len(before[0])
    gravity = np.broadcast_to(loads.gravity, (n, 3))
    tip = frames["tool"][:, :3, 3]
    weights = [(JOINTS, np.broadcast_to(loads.payload_mass, n), point(frames["tool"], loads.payload_com))]
    for name, (counted, moved, frame, _, _) in LINKS.items():
        centre = np.array([v[f"{name}.com_{axis}"] for axis in "xyz"])
        where = point(frames[frame], centre)
        weights.append((moved if loads.physical else counted, np.full(n, v[f"{name}.mass"]), where))
    result = []
    for site in range(JOINTS + 1):
        origin = before[max(site - 1, 0)][:, :3, 3]
        moment = np.cross(tip - origin, np.broadcast_to(loads.force, (n, 3))) + loads.torque
        for last, mass, where in weights:
            if last >= site:
                moment = moment + np.cross(where - origin, mass[:, None] * gravity)
        result.append(moment)
    return result


def elastic_pass(
    v: dict[str, float], q: np.ndarray, deflection: np.ndarray, loads: Loads
) -> tuple[np.ndarray, np.ndarray]:
    """The measured point at a deflection (N x 3), and the deflection that the springs answer with (N x 7)."""
    before, frames = poses(v, q, deflection)
    moments = site_moments(v, before, frames, loads)
    axes = [frames["mount"][:, :3, 1], *(pose[:, :3, 2] for pose in before)]
    answer = [v[f"k{i}"] * np.einsum("ni,ni->n", moments[i], axes[i]) for i in range(JOINTS + 1)]
    target = np.array([v["target_x"], v["target_y"], v["target_z"]])
    return point(frames["tool"], target), np.stack(answer, axis=1)


def settle(
    v: dict[str, float], q: np.ndarray, loads: Loads | None = None, tolerance: float = 2e-16, most: int = 500
) -> tuple[np.ndarray, np.ndarray]:
    """The measured points and deflections in equilibrium, by plain repetition."""
    loads, deflection = loads or Loads(), np.zeros((len(q), JOINTS + 1))
    for _ in range(most):
        where, following = elastic_pass(v, q, deflection, loads)
        moved = np.abs(following - deflection).max(initial=0.0)
        deflection = following
        if moved <= tolerance:
            break
    return where, deflection


def tip(v: dict[str, float], q: np.ndarray, loads: Loads | None = None) -> np.ndarray:
    """The measured points in equilibrium (N x 3)."""
    return settle(v, q, loads)[0]


def random_poses(count: int, seed: int) -> np.ndarray:
    """Joint angles spread over the arm's range (N x 6)."""
    limits = np.radians([100, 50, 100, 100, 100, 50])
    return np.random.default_rng(seed).uniform(-limits, limits, (count, JOINTS))
