"""The settings of a pose plan: goal, candidates, joint limits, clearance, order of visit."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field, model_validator

from armcal.base.settings import Angle, InputPath, Length, Length3, Settings
from armcal.planning.bound import BoundSolver
from armcal.planning.criterion import Goal

Levels: TypeAlias = dict[str, Annotated[tuple[Angle, ...], Field(min_length=1)]]
Travel: TypeAlias = dict[str, Annotated[tuple[Length, ...], Field(min_length=1)]]
Speed: TypeAlias = Annotated[float, Field(gt=0)]


class PointSettings(Settings):
    """A point ``at`` coordinates of a frame: ``base``, ``mount``, ``tool`` or a named frame of the arm."""

    frame: str = "base"
    at: Length3 = (0.0, 0.0, 0.0)


class CapsuleSettings(Settings):
    """All that lies within ``radius`` of the segment from ``start`` to ``end``."""

    type: Literal["capsule"]
    start: PointSettings
    end: PointSettings
    radius: Length


class BallSettings(Settings):
    """A ball."""

    type: Literal["ball"]
    centre: PointSettings
    radius: Length


class BoxSettings(Settings):
    """A box along the axes of the base frame, between two corners."""

    type: Literal["box"]
    low: Length3
    high: Length3

    @model_validator(mode="after")
    def _ordered(self) -> BoxSettings:
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError("low lies beyond high on an axis: give the smaller coordinates as low")
        return self


class HalfSpaceSettings(Settings):
    """Everything behind a plane of the base frame, such as a table; ``normal`` points out of it."""

    type: Literal["half_space"]
    point: Length3
    normal: tuple[float, float, float]

    @model_validator(mode="after")
    def _has_direction(self) -> HalfSpaceSettings:
        if not any(self.normal):
            raise ValueError("normal is zero: give the direction out of the plane, such as [0, 0, 1]")
        return self


class MeshSettings(Settings):
    """A mesh file, taken as the capsule that encloses it; ``unit`` is the length that its numbers count."""

    type: Literal["mesh"]
    path: InputPath
    frame: str
    unit: Length = 0.001


ShapeSettings: TypeAlias = Annotated[
    CapsuleSettings | BallSettings | BoxSettings | HalfSpaceSettings | MeshSettings, Field(discriminator="type")
]


class RuleSettings(Settings):
    """Parts that match the two globs (or ``everything``) keep ``at_least`` apart; ``besides`` names exceptions."""

    between: tuple[str, str]
    at_least: Length
    besides: tuple[str, ...] = ()


class ClearanceSettings(Settings):
    """The arm's parts and its surroundings by name, and how far they keep from each other.

    ``forbidden`` are boxes and balls that the tool point stays out of.
    """

    parts: dict[str, tuple[ShapeSettings, ...]] = Field(default_factory=dict)
    rules: tuple[RuleSettings, ...] = ()
    forbidden: tuple[Annotated[BoxSettings | BallSettings, Field(discriminator="type")], ...] = ()


class RobustSettings(Settings):
    """The criterion is averaged over so many draws of the parameters from their priors."""

    draws: Annotated[int, Field(ge=1, le=100)] = 8
    seed: Annotated[int, Field(ge=0)] = 0


class PlanSettings(Settings):
    """How poses are planned.

    ``candidates``: ``recorded`` (the data's), ``grid`` (all combinations of ``levels``), or ``continuous``
    (``count`` poses spread over ``limits``, and the chosen ones moved from there to where they tell most). Sliding
    joints have their levels under ``travel`` and their limits under ``travel_limits``. Any candidate outside the
    limits is left out. ``speeds_deg_per_s`` and ``speeds_mm_per_s`` are by joint; 60 deg/s and 50 mm/s by default.
    """

    goal: Goal = "D"
    candidates: Literal["recorded", "grid", "continuous"] | None = None
    count: Annotated[int, Field(ge=1, le=1_000_000)] = 4096
    limits: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)
    travel_limits: dict[str, tuple[Length, Length]] = Field(default_factory=dict)
    levels: Levels = Field(default_factory=dict)
    travel: Travel = Field(default_factory=dict)
    repeats: Annotated[int, Field(ge=1)] = 1
    starts: Annotated[int, Field(ge=0)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    sweeps: Annotated[int, Field(ge=0, le=100)] = 8
    bound: BoundSolver = "auto"
    robust: RobustSettings | None = None
    clearance: ClearanceSettings | None = None
    order: Literal["travel", "torque", "none"] = "travel"
    speeds_deg_per_s: dict[str, Speed] = Field(default_factory=dict)
    speeds_mm_per_s: dict[str, Speed] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _ordered(self) -> PlanSettings:
        for joint, (low, high) in {**self.limits, **self.travel_limits}.items():
            if not low < high:
                raise ValueError(f"the limits of {joint} are not in rising order: give [lowest, highest]")
        return self
