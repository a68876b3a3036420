"""How far an arm's parts keep from each other and from what stands around it, pose by pose.

Parts are capsules (a segment between two points of the arm, and a radius); surroundings are also boxes and half
spaces in the base frame. Distances are exact [Ericson2005] and negative where bodies meet. The arm is taken at its
nominal parameters and rigid: what springs give is to be left in the margins.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Annotated, Literal, Self

import casadi as ca
import numpy as np
from pydantic import Field, model_validator

from armcal.arm.assembly import Arm
from armcal.arm.model import forward
from armcal.arm.statics import BASE_FRAME, MOUNT_FRAME, TOOL_FRAME, frame_names
from armcal.base.arrays import Array, Mask
from armcal.base.settings import Length, Length3, Settings

EVERYTHING = "everything"
_AT_ONCE = 4096
_NO_LENGTH = 1e-18


class Point(Settings):
    """A point ``at`` coordinates of a frame: ``base``, ``mount``, ``tool`` or a named frame of the arm."""

    frame: str = BASE_FRAME
    at: Length3 = (0.0, 0.0, 0.0)


class Capsule(Settings):
    """All that lies within ``radius`` of the segment from ``start`` to ``end``."""

    start: Point
    end: Point
    radius: Annotated[Length, Field(ge=0)]
    type: Literal["capsule"] = "capsule"

    @property
    def frames(self) -> tuple[str, ...]:
        return (self.start.frame, self.end.frame)


class Ball(Settings):
    """All that lies within ``radius`` of ``centre``."""

    centre: Point
    radius: Annotated[Length, Field(ge=0)]
    type: Literal["ball"] = "ball"

    @property
    def frames(self) -> tuple[str, ...]:
        return (self.centre.frame,)

    @property
    def start(self) -> Point:
        return self.centre

    end = start


class Box(Settings):
    """A box along the axes of the base frame, between two corners."""

    type: Literal["box"]
    low: Length3
    high: Length3

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError("low lies beyond high on an axis: give the smaller coordinates as low")
        return self

    @property
    def frames(self) -> tuple[str, ...]:
        return (BASE_FRAME,)


class HalfSpace(Settings):
    """Everything behind a plane of the base frame, such as a table; ``normal`` points out of it."""

    type: Literal["half_space"]
    point: Length3
    normal: tuple[float, float, float]

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if not any(self.normal):
            raise ValueError("normal is zero: give the direction out of the plane, such as [0, 0, 1]")
        return self

    @property
    def frames(self) -> tuple[str, ...]:
        return (BASE_FRAME,)


Shape = Annotated[Capsule | Ball | Box | HalfSpace, Field(discriminator="type")]
_ROUND = (Capsule, Ball)
_TOOL = Point(frame=TOOL_FRAME)
_AT_TOOL = Ball.si(centre=_TOOL, radius=0.0)


class Rule(Settings):
    """Parts that match ``between`` (globs, or ``everything``) keep at least ``at_least`` apart.

    Parts that one joint or none lies between do not count, nor pairs with a part that matches ``besides``.
    """

    between: tuple[str, str]
    at_least: Length
    besides: tuple[str, ...] = ()


class Clearance(Settings):
    """The arm's parts and its surroundings by name, and how far they keep from each other.

    ``forbidden`` are boxes and balls that the tool point stays out of.
    """

    parts: dict[str, tuple[Shape, ...]] = Field(default_factory=dict)
    rules: tuple[Rule, ...] = ()
    forbidden: tuple[Annotated[Box | Ball, Field(discriminator="type")], ...] = ()

    def pairs(self, rule: Rule, moved_by: Mapping[str, int]) -> tuple[tuple[str, str], ...]:
        kept = [name for name in self.parts if not any(fnmatchcase(name, other) for other in rule.besides)]
        joints = {name: [moved_by[frame] for shape in self.parts[name] for frame in shape.frames] for name in kept}
        firsts, seconds = (
            [name for name in kept if glob == EVERYTHING or fnmatchcase(name, glob)] for glob in rule.between
        )
        pairs = {(min(a, b), max(a, b)) for a in firsts for b in seconds if a != b}
        lowest, highest = ({name: end(own) for name, own in joints.items()} for end in (min, max))
        return tuple(sorted((a, b) for a, b in pairs if max(lowest[a], lowest[b]) - min(highest[a], highest[b]) > 1))


@dataclass(frozen=True)
class Checked:
    """How much farther apart parts are than asked."""

    # Of the worst pair of each rule, then of the forbidden regions (rules + 1 x N, m; infinite without any)
    margins: Array

    @property
    def allowed(self) -> Mask:
        return np.asarray(np.all(self.margins >= 0, axis=0))


def joints_of_frames(arm: Arm) -> dict[str, int]:
    return {BASE_FRAME: 0, **frame_names(arm.nominal_chain)}


class ClearanceCheck:
    def __init__(self, arm: Arm, clearance: Clearance) -> None:
        self._clearance = clearance
        moved_by = joints_of_frames(arm)
        self.pairs = [clearance.pairs(rule, moved_by) for rule in clearance.rules]
        capsules = [shape for shapes in clearance.parts.values() for shape in shapes if isinstance(shape, _ROUND)]
        points = {point for capsule in capsules for point in (capsule.start, capsule.end)}
        self._points = [_TOOL, *sorted(points, key=repr)]
        self._function = _point_function(arm, self._points)

    def worst(self, pose: Array) -> str:
        """What is too near in a pose (joints; rad or m), and by how much; empty where nothing is."""
        margins = self(pose[:, None]).margins[:, 0]
        row = int(np.argmin(margins))
        if margins[row] >= 0:
            return ""
        regions = row == len(self.pairs)
        what = "the tool and a forbidden region" if regions else " and ".join(self._clearance.rules[row].between)
        return f"{what} are {-1000 * margins[row]:.0f} mm too near"

    def __call__(self, joint_angles: Array) -> Checked:
        starts = range(0, joint_angles.shape[1], _AT_ONCE)
        parts = [self._margins(joint_angles[:, start : start + _AT_ONCE]) for start in starts]
        return Checked(np.concatenate(parts, axis=1) if parts else np.zeros((len(self.pairs) + 1, 0)))

    def _margins(self, joint_angles: Array) -> Array:
        count = joint_angles.shape[1]
        stacked = np.asarray(self._function.map(count)(joint_angles).full()).T.reshape(count, -1, 3)
        where = {point: stacked[:, i] for i, point in enumerate(self._points)}
        margins = np.full((len(self.pairs) + 1, count), np.inf)
        known: dict[tuple[str, str], Array] = {}
        for row, (rule, pairs) in enumerate(zip(self._clearance.rules, self.pairs, strict=True)):
            for pair in pairs:
                if pair not in known:
                    known[pair] = self._apart(pair, where, count)
                margins[row] = np.minimum(margins[row], known[pair] - rule.at_least)
        tool = where[_TOOL]
        for region in self._clearance.forbidden:
            margins[-1] = np.minimum(margins[-1], distance(_AT_TOOL, region, where))
            if isinstance(region, Box):
                inside = np.all((tool >= region.low) & (tool <= region.high), axis=1)
            else:
                inside = np.linalg.norm(tool - np.array(region.centre.at), axis=1) <= region.radius
            margins[-1, inside] = np.minimum(margins[-1, inside], -_NO_LENGTH)
        return margins

    def _apart(self, pair: tuple[str, str], where: Mapping[Point, Array], count: int) -> Array:
        least = np.full(count, np.inf)
        for first in self._clearance.parts[pair[0]]:
            for second in self._clearance.parts[pair[1]]:
                if isinstance(first, _ROUND) or isinstance(second, _ROUND):
                    least = np.minimum(least, distance(first, second, where))
        return least


def distance(first: Shape, second: Shape, where: Mapping[Point, Array]) -> Array:
    """The distance of two shapes, one a capsule, in every pose (N, m), given their points in the base (N x 3)."""
    if not isinstance(first, _ROUND):
        first, second = second, first
    assert isinstance(first, _ROUND), "two fixed bodies need no check"
    start, end = (where[p] if p in where else np.array([p.at]) for p in (first.start, first.end))
    if isinstance(second, _ROUND):
        others = (where[p] if p in where else np.array([p.at]) for p in (second.start, second.end))
        return segment_to_segment(start, end, *others) - first.radius - second.radius
    if isinstance(second, Box):
        return segment_to_box(start, end, np.array(second.low), np.array(second.high)) - first.radius
    normal = np.array(second.normal) / np.linalg.norm(second.normal)
    heights = [(points - np.array(second.point)) @ normal for points in (start, end)]
    return np.asarray(np.minimum(*heights) - first.radius)


def segment_to_segment(p1: Array, q1: Array, p2: Array, q2: Array) -> Array:
    """The distance of segments p1 q1 and p2 q2 (each N x 3); either may be a point. [Ericson2005]"""
    p1, q1, p2, q2 = np.broadcast_arrays(p1, q1, p2, q2)
    u, v, w = q1 - p1, q2 - p2, p1 - p2
    a, e, b = (np.einsum("ni,ni->n", x, y) for x, y in ((u, u), (v, v), (u, v)))
    c, f = np.einsum("ni,ni->n", u, w), np.einsum("ni,ni->n", v, w)
    cross = a * e - b * b
    slanted = cross > _NO_LENGTH
    s = np.where(slanted, np.clip((b * f - c * e) / np.where(slanted, cross, 1.0), 0.0, 1.0), 0.0)
    t = np.where(e > _NO_LENGTH, np.clip((b * s + f) / np.where(e > _NO_LENGTH, e, 1.0), 0.0, 1.0), 0.0)
    s = np.where(a > _NO_LENGTH, np.clip((b * t - c) / np.where(a > _NO_LENGTH, a, 1.0), 0.0, 1.0), 0.0)
    return np.asarray(np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1))


def segment_to_box(p: Array, q: Array, low: Array, high: Array) -> Array:
    """The distance of segments p q (N x 3) to a box along the axes; 0 where they meet.

    Along the segment the squared distance is convex, and its slope piecewise linear with kinks where the segment
    crosses a side's plane: between the two kinks about its zero, the zero is found exactly.
    """
    direction = q - p
    still = np.abs(direction) < np.sqrt(_NO_LENGTH)
    safe = np.where(still, 1.0, direction)
    crossings = [np.where(still, 0.0, np.clip((side - p) / safe, 0.0, 1.0)) for side in (low, high)]
    ends = np.stack([np.zeros(len(p)), np.ones(len(p))], axis=1)
    kinks = np.sort(np.concatenate([*crossings, ends], axis=1), axis=1)
    slopes = np.einsum("nki,ni->nk", _outside(p[:, None] + kinks[..., None] * direction[:, None], low, high), direction)
    after = np.clip(np.sum(slopes < 0, axis=1), 1, kinks.shape[1] - 1)
    row = np.arange(len(p))
    t0, t1, s0, s1 = kinks[row, after - 1], kinks[row, after], slopes[row, after - 1], slopes[row, after]
    rising = s1 - s0 > 0
    part = np.where(rising, np.clip(-s0 / np.where(rising, s1 - s0, 1.0), 0.0, 1.0), 0.0)
    nearest = p + (t0 + part * (t1 - t0))[:, None] * direction
    return np.asarray(np.linalg.norm(_outside(nearest, low, high), axis=-1))


def _outside(points: Array, low: Array, high: Array) -> Array:
    return np.asarray(points - np.clip(points, low, high))


def _point_function(arm: Arm, points: Sequence[Point]) -> ca.Function:
    chain = arm.nominal_chain
    commands = ca.SX.sym("commands", len(arm.commanded))
    commanded = arm.joint_commands(ca.vertsplit(commands))
    frames = forward(chain, [joint.offset + commanded[i] for i, joint in enumerate(chain.joints)], {})
    mount = frames.sites[0]
    stacked = []
    for point in points:
        at = ca.SX(list(point.at))
        if point.frame == BASE_FRAME:
            stacked.append(at)
        elif point.frame == MOUNT_FRAME:
            stacked.append(ca.mtimes(mount.rotation, at) + mount.origin)
        else:
            pose = frames.base_T_tool if point.frame == TOOL_FRAME else frames.named[point.frame]
            stacked.append(pose.apply(at))
    return ca.Function("points", [commands], [ca.densify(ca.vertcat(*stacked))], {"cse": True})
