"""The clearance that a plan keeps: settings of an arm's parts and its surroundings, made into shapes."""

from collections.abc import Mapping
from fnmatch import filter as matching
from typing import Annotated, Literal, TypeAlias

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
from armcal.base.settings import Length, Settings
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ConfigError

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


ShapeSettings: TypeAlias = Annotated[CapsuleSettings | BallSettings | Box | HalfSpace, Field(discriminator="type")]


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


def _shape(
    settings: ShapeSettings, frames: Mapping[str, int], source: ConfigSource, at: tuple[str | int, ...]
) -> Shape:
    """A part's shape, whose frames are known and whose radius is no less than zero."""
    shape: Shape
    if isinstance(settings, CapsuleSettings):
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
