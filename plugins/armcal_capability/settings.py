"""The settings of capability maps and design studies: the section ``capability`` of a configuration."""

from typing import Annotated, Any, Literal, Self

from armcal.base.settings import Angle, Force3, InputPath, Length, Length3, Mass, Settings, Torque
from pydantic import Field, model_validator


class ToolDirectionSettings(Settings):
    """An axis of the tool points ``along`` a direction of the base frame, up to an angle."""

    axis: Literal["x", "y", "z"] = "z"
    along: tuple[float, float, float]
    within: Annotated[Angle, Field(gt=0, le=3.15)]

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if not any(self.along):
            raise ValueError("along is zero: give a direction, such as [0, 0, -1] for down")
        return self


class AreaSettings(Settings):
    """A box along the axes of the base frame, between two corners, that the tool is to reach."""

    low: Length3
    high: Length3
    tool: ToolDirectionSettings | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError("low lies beyond high on an axis: give the smaller coordinates as low")
        return self


class LoadSettings(Settings):
    """What the arm carries, where it differs from the configured ``statics``: payload and force at the tool."""

    payload: Annotated[Mass, Field(ge=0)] | None = None
    payload_com: Length3 | None = None
    force: Force3 | None = None


class SectionSettings(Settings):
    """Where the figures cut: the x-z section at a ``y``, the x-y section at a ``z`` (through the arm's middle)."""

    y: Length = 0.0
    z: Length | None = None


class CapabilitySettings(Settings):
    """How an arm is surveyed.

    ``samples`` postures are spread over joint space between the limits; those with too little clearance count as not
    reached. ``length`` is how many metres a radian counts for, where turns and distances are taken together.
    ``holding`` is what each servo can hold, by joint; ``servos`` the servo file of an arm whose calibration
    has no tables of them. ``postures`` is how many postures that reach it are sought for each
    cell of an area. ``values`` is a calibration, or a file of values of the arm that the
    configuration ``values_of`` describes: how they differ from what is stated there corrects the arm and its designs.
    ``designs`` are by name the values that each sets: ``{arms.arm.model.rows.1.d_mm: 10}``.
    """

    samples: Annotated[int, Field(ge=8, le=20_000_000)] = 200_000
    seed: Annotated[int, Field(ge=0)] = 0
    voxel: Annotated[Length, Field(gt=0)] = 0.02
    length: Annotated[Length, Field(gt=0)] = 0.1
    loads: LoadSettings = Field(default_factory=LoadSettings)
    holding: dict[str, Annotated[Torque, Field(gt=0)]] = Field(default_factory=dict)
    servos: InputPath | None = None
    areas: dict[str, AreaSettings] = Field(default_factory=dict)
    postures: Annotated[int, Field(ge=1, le=1000)] = 8
    sections: SectionSettings = Field(default_factory=SectionSettings)
    values: InputPath | None = None
    values_of: InputPath | None = None
    designs: dict[str, dict[str, Any] | None] = Field(default_factory=dict)
