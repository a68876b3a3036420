"""The settings of a run, beyond what the arm is: data, parameters, estimator, validation, simulation."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from armcal.base.settings import InputPath, Length, Settings
from armcal.config.selection import ParameterSettings
from armcal.config.system import StaticsSettings
from armcal.estimate.bootstrap import BootstrapSettings
from armcal.estimate.weighing import NoiseSettings
from armcal.run.plan_settings import PlanSettings


class ValidationSettings(Settings):
    """Which records judge.

    ``holdout`` is a fraction chosen by ``seed``; ``train_ids`` a CSV of record ids to train on (the rest judge);
    ``train_groups`` are the values of the text column ``group_by`` to train on (by default the first label of a
    measurement's groups); ``folds`` cross-validates over the training records. Judged records whose error is above
    ``limit`` are listed and explained; without one, those above three times the median error.
    """

    holdout: Annotated[float, Field(ge=0, lt=1)] = 0.0
    folds: Annotated[int, Field(ge=0)] = 0
    seed: Annotated[int, Field(ge=0)] = 0
    train_ids: InputPath | None = None
    train_groups: tuple[str, ...] | None = None
    group_by: str | None = None
    limit: Length | None = None

    @model_validator(mode="after")
    def _one_split(self) -> ValidationSettings:
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
