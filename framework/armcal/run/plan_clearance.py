"""The clearance that a plan keeps: settings of an arm's parts and its surroundings, made into shapes."""

from collections.abc import Mapping
from fnmatch import filter as matching
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import numpy as np
from pydantic import Field

from armcal.arm.assembly import Arm, only_arm
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
from armcal.base.arrays import Array
from armcal.base.settings import InputPath, Length, Settings
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ConfigError, DataError, Location, PluginError

_AT = ("plan", "clearance")


class CapsuleSettings(Settings):
    """All that lies within ``radius`` of the segment from ``start`` to ``end``."""

    type: Literal["capsule"]
    start: Point
    end: Point
    radius: Length


class BallSettings(Settings):
    """A ball."""

    type: Literal["ball"]
    centre: Point
    radius: Length


class MeshSettings(Settings):
    """A mesh file, taken as the capsule that encloses it; ``unit`` is the length that its numbers count."""

    type: Literal["mesh"]
    path: InputPath
    frame: str
    unit: Length = 0.001


ShapeSettings: TypeAlias = Annotated[
    CapsuleSettings | BallSettings | Box | HalfSpace | MeshSettings, Field(discriminator="type")
]


class ClearanceSettings(Settings):
    """The arm's parts and its surroundings by name, and how far they keep from each other.

    ``forbidden`` are boxes and balls that the tool point stays out of.
    """

    parts: dict[str, tuple[ShapeSettings, ...]] = Field(default_factory=dict)
    rules: tuple[Rule, ...] = ()
    forbidden: tuple[Annotated[Box | BallSettings, Field(discriminator="type")], ...] = ()


def clearance_check(settings: ClearanceSettings, arms: Mapping[str, Arm], source: ConfigSource) -> ClearanceCheck:
    """The check that the settings describe.

    Raises:
        ConfigError: a frame or part is not known, or a rule is about no pair.
        DataError: a mesh cannot be read.
        PluginError: a mesh is asked for and its library is not there.
    """
    arm = only_arm(arms, "clearance is checked for a single arm", "Leave the clearance out.", source.where(_AT))
    frames = joints_of_frames(arm)
    parts = {
        name: tuple(_shape(shape, frames, source, ("parts", name, index)) for index, shape in enumerate(shapes))
        for name, shapes in settings.parts.items()
    }
    for index, region in enumerate(settings.forbidden):
        if isinstance(region, BallSettings) and region.centre.frame != "base":
            raise ConfigError(
                f"found the frame {region.centre.frame!r}, expected base: forbidden regions stand still.",
                where=source.where((*_AT, "forbidden", index, "centre")),
                hint="Give the centre in the base frame.",
            )
    forbidden = tuple(region if isinstance(region, Box) else _ball(region) for region in settings.forbidden)
    check = ClearanceCheck(arm, Clearance(parts, settings.rules, forbidden))
    for index, (rule, pairs) in enumerate(zip(settings.rules, check.pairs, strict=True)):
        where, globs = source.where((*_AT, "rules", index)), (*rule.between, *rule.besides)
        if unknown := [glob for glob in globs if glob != EVERYTHING and not matching(parts, glob)]:
            hint = f"The parts are {', '.join(parts) or 'none'}."
            raise ConfigError(f"no part is called {unknown[0]!r}.", where=where, hint=hint)
        if not pairs:
            raise ConfigError(
                f"the rule between {' and '.join(rule.between)} matches no pair of parts.",
                where=where,
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
    ends = [(float(x), float(y), float(z)) for x, y, z in (middle + low * axis, middle + high * axis)]
    start, end = (Point.si(frame=frame, at=place) for place in ends)
    return Capsule(start, end, radius)


def _shape(
    settings: ShapeSettings, frames: Mapping[str, int], source: ConfigSource, at: tuple[str | int, ...]
) -> Shape:
    """A part's shape, whose frames are known and whose radius is no less than zero."""
    shape: Shape
    if isinstance(settings, MeshSettings):
        shape = enclosing_capsule(_vertices(Path(settings.path)) * settings.unit, settings.frame)
    elif isinstance(settings, CapsuleSettings):
        shape = Capsule(settings.start, settings.end, settings.radius)
    else:
        shape = _ball(settings) if isinstance(settings, BallSettings) else settings
    where = source.where((*_AT, *at))
    for frame in shape.frames:
        if frame not in frames:
            raise ConfigError(
                f"no frame is called {frame!r}.", where=where, hint=f"The frames are {', '.join(frames)}."
            )
    if isinstance(shape, Capsule) and not shape.radius >= 0:
        raise ConfigError("found a radius below zero.", where=where, hint="Give the radius.")
    return shape


def _ball(settings: BallSettings) -> Capsule:
    return Capsule(settings.centre, settings.centre, settings.radius)


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
    except Exception as fault:  # whatever a mesh reader raises, the message names the file
        raise DataError(f"it cannot be read as a mesh ({fault}).", where=Location(str(path))) from fault
    if not len(vertices) or not np.isfinite(vertices).all():
        raise DataError("it has no vertices.", where=Location(str(path)), hint="Give a mesh with faces.")
    return vertices
