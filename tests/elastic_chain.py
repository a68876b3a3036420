"""Elastic chains in plain numpy, with any law at any site: an independent oracle that shares no code with armcal.

Everything is vectorised over N records. A site (0 the mount, i joint i) turns by a rotation vector in its own frame,
after the joint's motion and about the joint's origin; a sliding joint may also give along its axis. The deflection is
repeated until it stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import oracle
from scipy.spatial.transform import Rotation

Law = Callable[[np.ndarray], np.ndarray]
"""Moments in the site's frame (N x 3) to rotation vectors (N x 3)."""


@dataclass(frozen=True)
class Link:
    """A joint: from the moving frame before it to its own (N x 4 x 4), its axis, and whether it slides."""

    parent: np.ndarray
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    slides: bool = False


@dataclass(frozen=True)
class Body:
    """A mass (kg), its centre in a frame that stands on a joint (N x 4 x 4), and the last joint it counts on."""

    joint: int
    frame: np.ndarray
    mass: float
    centre: Sequence[float]
    counted: int


@dataclass(frozen=True)
class Chain:
    """Mount, joints, tool frame on the last joint, masses."""

    mount: np.ndarray
    links: tuple[Link, ...]
    tool: np.ndarray
    bodies: tuple[Body, ...]


def lifted(vectors: np.ndarray) -> np.ndarray:
    """Rotation vectors (N x 3) as homogeneous matrices."""
    matrix = oracle.homogeneous(len(vectors))
    matrix[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
    return matrix


def slid(vectors: np.ndarray) -> np.ndarray:
    """Displacements (N x 3) as homogeneous matrices."""
    matrix = oracle.homogeneous(len(vectors))
    matrix[:, :3, 3] = vectors
    return matrix


def sites_of(chain: Chain, moved: np.ndarray, turned: np.ndarray, given: np.ndarray) -> list[np.ndarray]:
    """Poses of the mount and of every joint after motion (N x joints) and deflections (N x sites x 3, N x joints)."""
    here = chain.mount @ lifted(turned[:, 0])
    sites = [here]
    for i, link in enumerate(chain.links):
        along = np.outer(moved[:, i] + given[:, i], link.axis)
        here = here @ link.parent @ (slid(along) if link.slides else lifted(along)) @ lifted(turned[:, i + 1])
        sites.append(here)
    return sites


def carried(chain: Chain, sites: Sequence[np.ndarray], loads: oracle.Loads) -> tuple[np.ndarray, np.ndarray]:
    """Moments about each site's origin and forces (sites x N x 3), mass by mass, in base axes."""
    count = len(chain.mount)
    gravity, force = (np.broadcast_to(x, (count, 3)) for x in (loads.gravity, loads.force))
    tip = sites[-1] @ chain.tool
    weights = [(len(chain.links), np.broadcast_to(loads.payload_mass, count), oracle.point(tip, loads.payload_com))]
    for body in chain.bodies:
        where = oracle.point(sites[body.joint] @ body.frame, np.array(body.centre))
        weights.append((body.counted, np.full(count, body.mass), where))
    moments, forces = [], []
    for number, site in enumerate(sites):
        moment, total = np.cross(tip[:, :3, 3] - site[:, :3, 3], force) + loads.torque, force.copy()
        for last, mass, where in weights:
            if last >= number:
                moment = moment + np.cross(where - site[:, :3, 3], mass[:, None] * gravity)
                total = total + mass[:, None] * gravity
        moments.append(moment)
        forces.append(total)
    return np.array(moments), np.array(forces)


def tip(
    chain: Chain,
    moved: np.ndarray,
    loads: oracle.Loads,
    laws: Sequence[tuple[int, Law]] = (),
    slides: Sequence[tuple[int, Callable[[np.ndarray], np.ndarray]]] = (),
) -> np.ndarray:
    """The tool frame's origin in equilibrium (N x 3).

    ``laws`` turn a site by the moment it carries; ``slides`` shift a joint by the force (N) along its axis.
    """
    count = len(moved)
    turned, given = np.zeros((count, len(chain.links) + 1, 3)), np.zeros((count, len(chain.links)))
    for _ in range(400):
        sites = sites_of(chain, moved, turned, given)
        moments, forces = carried(chain, sites, loads)
        following, shifted = np.zeros_like(turned), np.zeros_like(given)
        for site, law in laws:
            following[:, site] += law(np.einsum("nji,nj->ni", sites[site][:, :3, :3], moments[site]))
        for joint, law in slides:
            axis = sites[joint][:, :3, :3] @ np.array(chain.links[joint - 1].axis)
            shifted[:, joint - 1] += law(np.einsum("ni,ni->n", axis, forces[joint]))
        change = max(np.abs(following - turned).max(), np.abs(shifted - given).max())
        turned, given = following, shifted
        if change < 1e-14:
            break
    else:
        raise AssertionError(f"the oracle's repetition does not settle: still moving {change:g}")
    return (sites_of(chain, moved, turned, given)[-1] @ chain.tool)[:, :3, 3]


def lrm(v: dict[str, float], count: int, growth: np.ndarray | None = None) -> Chain:
    """The LRM arm by the oracle's names; ``growth`` (7 x N) lengthens the link before each joint, and the tool's."""
    f = np.ones((7, count)) if growth is None else growth
    mount = oracle.shift(v["base_x"], v["base_y"], v["base_z"], count)
    mount = mount @ oracle.turn("x", v["base_rx"], count) @ oracle.turn("y", v["base_ry"], count)
    links, frames, pending = [], {"mount": (0, oracle.homogeneous(count))}, oracle.homogeneous(count)
    for i in range(1, 7):
        links.append(Link(pending))
        pending = oracle.shift(f[i] * v[f"a{i}"], 0, f[i] * v[f"d{i}"], count) @ oracle.turn("x", v[f"alpha{i}"], count)
        if i in (2, 4):
            frames["upper_arm" if i == 2 else "forearm"] = (i, pending)
            pending = pending @ oracle.shift(0, 0, f[i] * v[f"after{i}_z"], count)
        frames[f"row{i}"] = (i, pending)
    hand = pending @ oracle.turn("x", v["tool_rx"], count) @ oracle.turn("y", v["tool_ry"], count)
    hand = hand @ oracle.shift(0, f[6] * v["tool_y"], 0, count)
    frames |= {"hand": (6, hand), "tool": (6, hand @ oracle.shift(0, 0, f[6] * v["tool_z"], count))}
    bodies = [
        Body(*frames[frame], v[f"{name}.mass"], [v[f"{name}.com_{axis}"] for axis in "xyz"], counted)
        for name, (counted, _, frame, _, _) in oracle.LINKS.items()
    ]
    return Chain(mount, tuple(links), frames["tool"][1], tuple(bodies))
