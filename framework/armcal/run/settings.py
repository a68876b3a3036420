"""The settings of a run, beyond what the arm is: data, parameters, estimator, validation, simulation, pose plan."""

from typing import Annotated, Any, Literal, Self, TypeAlias

from pydantic import Field, field_validator, model_validator

from armcal.base.settings import Angle, InputPath, Length, Settings
from armcal.config.selection import ParameterSettings
from armcal.config.system import StaticsSettings
from armcal.estimate.robust import NoiseSettings
from armcal.estimate.uncertainty import BootstrapSettings
from armcal.run.plan_clearance import ClearanceSettings

Levels: TypeAlias = dict[str, Annotated[tuple[Angle, ...], Field(min_length=1)]]
Travel: TypeAlias = dict[str, Annotated[tuple[Length, ...], Field(min_length=1)]]
Speed: TypeAlias = Annotated[float, Field(gt=0)]


class ValidationSettings(Settings):
    """Which records judge.

    ``holdout`` is a fraction chosen by ``seed``; ``train_ids`` a CSV of record ids to train on (the rest judge);
    ``train_groups`` are the values of the text column ``group_by`` to train on (by default the first label of a
    measurement's groups); ``folds`` cross-validates over the training records. Judged records whose error is above
    ``limit`` are listed and explained; without one, those beyond what noise allows.
    """

    holdout: float = 0.0
    folds: Annotated[int, Field(ge=0)] = 0
    seed: Annotated[int, Field(ge=0)] = 0
    train_ids: InputPath | None = None
    train_groups: tuple[str, ...] | None = None
    group_by: str | None = None
    limit: Length | None = None

    @field_validator("holdout")
    @classmethod
    def _share(cls, value: float) -> float:
        if not 0 <= value < 1:
            raise ValueError(f"found {value:g}, expected a share from 0 to below 1: write 0.25 for a quarter")
        return value

    @model_validator(mode="after")
    def _one_split(self) -> Self:
        given = {"holdout": self.holdout > 0, "train_ids": self.train_ids, "train_groups": self.train_groups}
        several = [name for name, value in given.items() if value]
        if len(several) > 1:
            raise ValueError(f"found both {several[0]} and {several[1]}, expected one of them: set holdout: 0")
        if self.folds == 1:
            raise ValueError("found folds: 1, expected 0 (none) or at least 2")
        if self.limit is not None and self.limit <= 0:
            raise ValueError(f"found a limit of {1000 * self.limit:g} mm, expected one above zero")
        return self


class UncertaintySettings(BootstrapSettings):
    """How intervals are made beside the curvature at the estimate; ``profile`` are globs over free numbers."""

    profile: tuple[str, ...] = ()


class PlanSettings(Settings):
    """How poses are planned.

    ``candidates``: ``recorded`` (the data's), ``grid`` (all combinations of ``levels``), or ``continuous``
    (``count`` poses spread over ``limits``, and the chosen ones moved from there to where they determine most). Sliding
    joints have their levels under ``travel`` and their limits under ``travel_limits``. Any candidate outside the
    limits is left out. ``speeds_deg_per_s`` and ``speeds_mm_per_s`` are by joint; 60 deg/s and 50 mm/s by default.
    """

    candidates: Literal["recorded", "grid", "continuous"] | None = None
    count: Annotated[int, Field(ge=1, le=1_000_000)] = 4096
    limits: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)
    travel_limits: dict[str, tuple[Length, Length]] = Field(default_factory=dict)
    levels: Levels = Field(default_factory=dict)
    travel: Travel = Field(default_factory=dict)
    starts: Annotated[int, Field(ge=0)] = 10
    seed: Annotated[int, Field(ge=0)] = 0
    sweeps: Annotated[int, Field(ge=0, le=100)] = 8
    clearance: ClearanceSettings | None = None
    order: Literal["travel", "none"] = "travel"
    speeds_deg_per_s: dict[str, Speed] = Field(default_factory=dict)
    speeds_mm_per_s: dict[str, Speed] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for joint, (low, high) in {**self.limits, **self.travel_limits}.items():
            if not low < high:
                raise ValueError(f"the limits of {joint} are not in rising order: give [lowest, highest]")
        return self


class ExperimentSettings(Settings):
    """A whole configuration; components keep their own settings under ``type``."""

    name: str = ""
    arms: dict[str, Any]
    measurements: dict[str, Any]
    statics: StaticsSettings = Field(default_factory=StaticsSettings)
    data: dict[str, Any] | None = None
    simulation: dict[str, Any] | None = None
    parameters: ParameterSettings = Field(default_factory=ParameterSettings)
    estimator: dict[str, Any] = Field(default_factory=lambda: {"type": "ipopt"})
    evaluator: Literal["auto", "compiled", "interpreted"] = "auto"
    validation: ValidationSettings = Field(default_factory=ValidationSettings)
    noise: NoiseSettings = Field(default_factory=NoiseSettings)
    uncertainty: UncertaintySettings = Field(default_factory=UncertaintySettings)
    plan: PlanSettings | None = None
    bench: dict[str, Any] | None = None
