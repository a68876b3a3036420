"""A configured clearance made into shapes of an arm."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import filter as matching
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.clearance import (
    EVERYTHING,
    Box,
    Capsule,
    Clearance,
    ClearanceCheck,
    HalfSpace,
    Point,
    Rule,
    Shape,
    joints_of_frames,
)
from armcal.arm.model import Vector3
from armcal.base.domains import Array
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ConfigError, DataError, Location, PluginError
from armcal.run.plan_settings import (
    BallSettings,
    BoxSettings,
    CapsuleSettings,
    ClearanceSettings,
    HalfSpaceSettings,
    MeshSettings,
    PointSettings,
)

_AT = ("plan", "clearance")


def clearance_check(settings: ClearanceSettings, arms: Mapping[str, Arm], source: ConfigSource) -> ClearanceCheck:
    """The check that the settings describe.

    Raises:
        ConfigError: a frame or part is not known, or a rule is about no pair.
        DataError: a mesh cannot be read.
        PluginError: a mesh is asked for and its library is not there.
    """
    if len(arms) != 1:
        raise ConfigError(
            f"found {len(arms)} arms, expected one: clearance is checked for a single arm.",
            where=source.where(_AT),
            hint="Leave the clearance out.",
        )
    arm = next(iter(arms.values()))
    frames = joints_of_frames(arm)
    parts: dict[str, tuple[Shape, ...]] = {}
    for name, shapes in settings.parts.items():
        made = tuple(_shape(shape) for shape in shapes)
        for index, shape in enumerate(made):
            _known_frames(shape, frames, source, (*_AT, "parts", name, index))
        parts[name] = made
    rules = tuple(Rule(rule.between, rule.at_least, rule.besides) for rule in settings.rules)
    forbidden = tuple(_region(region, source, index) for index, region in enumerate(settings.forbidden))
    _known_parts(rules, parts, source)
    check = ClearanceCheck(arm, Clearance(parts, rules, forbidden))
    for index, pairs in enumerate(check.pairs):
        if not pairs:
            raise ConfigError(
                f"the rule between {' and '.join(rules[index].between)} is about no pair of parts.",
                where=source.where((*_AT, "rules", index)),
                hint="Parts with at most one joint between them do not count; name others, or remove the rule.",
            )
    return check


def enclosing_capsule(points: Array, frame: str) -> Capsule:
    """A capsule along the longest extent of points (N x 3, m) of a frame that holds all of them."""
    middle = points.mean(axis=0)
    axis = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    along = (points - middle) @ axis
    across = np.linalg.norm(points - middle - np.outer(along, axis), axis=1)
    radius = float(across.max())
    # An end needs to reach no farther than its cap leaves out.
    reach = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    low, high = float(np.min(along + reach)), float(np.max(along - reach))
    if low > high:
        low = high = (low + high) / 2
        radius = float(np.max(np.linalg.norm(points - middle - low * axis, axis=1)))
    start, end = (Point(frame, _three(middle + x * axis)) for x in (low, high))
    return Capsule(start, end, radius)


def _shape(settings: Any) -> Shape:
    if isinstance(settings, CapsuleSettings):
        return Capsule(_point(settings.start), _point(settings.end), settings.radius)
    if isinstance(settings, BallSettings):
        return Capsule(_point(settings.centre), _point(settings.centre), settings.radius)
    if isinstance(settings, BoxSettings):
        return Box(settings.low, settings.high)
    if isinstance(settings, HalfSpaceSettings):
        return HalfSpace(settings.point, settings.normal)
    mesh: MeshSettings = settings
    return enclosing_capsule(_vertices(Path(mesh.path)) * mesh.unit, mesh.frame)


def _point(settings: PointSettings) -> Point:
    return Point(settings.frame, settings.at)


def _region(settings: BoxSettings | BallSettings, source: ConfigSource, index: int) -> Box | Capsule:
    shape = _shape(settings)
    if isinstance(shape, Capsule) and shape.start.frame != "base":
        raise ConfigError(
            f"found the frame {shape.start.frame!r}, expected base: forbidden regions stand still.",
            where=source.where((*_AT, "forbidden", index, "centre")),
            hint="Give the centre in the base frame.",
        )
    if not isinstance(shape, Box | Capsule):
        raise TypeError(type(shape).__name__)
    return shape


def _vertices(path: Path) -> Array:
    try:
        trimesh = import_module("trimesh")
    except ImportError as fault:
        raise PluginError(
            f"a mesh needs the library trimesh ({fault}).",
            where=Location(str(path)),
            hint="Install it with pip install trimesh, or describe the part by capsules.",
        ) from fault
    try:
        vertices = np.asarray(trimesh.load(path, force="mesh").vertices, dtype=float)
    except Exception as fault:  # whatever a mesh reader raises, the user is told which file
        raise DataError(f"it cannot be read as a mesh ({fault}).", where=Location(str(path))) from fault
    if not len(vertices) or not np.isfinite(vertices).all():
        raise DataError("it has no vertices.", where=Location(str(path)), hint="Give a mesh with faces.")
    return vertices


def _known_frames(shape: Shape, frames: Mapping[str, int], source: ConfigSource, at: tuple[str | int, ...]) -> None:
    for frame in shape.frames:
        if frame not in frames:
            raise ConfigError(
                f"no frame is called {frame!r}.",
                where=source.where(at),
                hint=f"The frames are {', '.join(frames)}.",
            )
    if isinstance(shape, Capsule) and not shape.radius >= 0:
        raise ConfigError("found a radius below zero.", where=source.where(at), hint="Give the radius.")


def _known_parts(rules: tuple[Rule, ...], parts: Mapping[str, object], source: ConfigSource) -> None:
    for index, rule in enumerate(rules):
        for glob in (*rule.between, *rule.besides):
            if glob != EVERYTHING and not matching(parts, glob):
                raise ConfigError(
                    f"no part is called {glob!r}.",
                    where=source.where((*_AT, "rules", index)),
                    hint=f"The parts are {', '.join(parts) or 'none'}.",
                )


def _three(vector: Array) -> Vector3:
    return float(vector[0]), float(vector[1]), float(vector[2])
