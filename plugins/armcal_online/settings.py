"""The settings of a recalibration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from armcal.base.settings import Angle, Duration, Length, Mass, Settings
from armcal.config.validate import validate
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, Location
from pydantic import Field, model_validator

SECTION = "recalibrate"  # a file may hold more than a recalibration: the recalibration then stands under this key
DAY = 86400.0
Probability = Annotated[float, Field(gt=0, lt=1)]


class GateSettings(Settings):
    """Which records are accepted: chance makes a larger normalised innovation squared (NIS) in ``1 - probability``.

    An unexplained change is suspected once ``rejected`` of the last ``window`` records are rejected.
    """

    probability: Probability = 0.999
    window: Annotated[int, Field(ge=2, le=64)] = 8
    rejected: Annotated[int, Field(ge=2, le=64)] = 4

    @model_validator(mode="after")
    def _within(self) -> GateSettings:
        if self.rejected > self.window:
            raise ValueError(f"found rejected: {self.rejected} of a window of {self.window}")
        return self


class OutlierSettings(Settings):
    """What is known of wrong records: how many of all, and how large (standard deviation)."""

    fraction: Probability = 0.05
    length: Length = 0.03
    angle: Angle = 0.1


class ChangeSettings(Settings):
    """Sudden changes that are looked for: standard deviations of how large they are, and how likely in one record.

    ``joint`` of a joint's offset (``slide`` of one that slides), as a slipped horn or a replaced servo makes;
    ``sensor_shift`` and ``sensor_turn`` of the frame that an instrument measures in, as a bump makes; ``payload`` of
    what hangs on the tool, its centre ``payload_lever`` from the tool frame; ``gravity_turn`` of gravity's direction
    about the base's x and y axes; ``link_length`` and ``link_angle`` of the numbers of a bent link. What grows is
    stated in a day: ``joint_creep`` and ``slide_creep`` of a joint's zero, ``sensor_creep`` of an instrument's bias.
    ``factor`` multiplies all standard deviations when something else has changed. A change is followed once it is
    ``odds`` times likelier than outliers, and ``naming_odds`` times likelier than any other.
    """

    joint: Angle = 0.26
    slide: Length = 0.02
    sensor_shift: Length = 0.03
    sensor_turn: Angle = 0.05
    payload: Annotated[Mass, Field(gt=0)] = 0.3
    payload_lever: Annotated[Length, Field(gt=0)] = 0.05
    gravity_turn: Annotated[Angle, Field(gt=0)] = 0.1
    link_length: Annotated[Length, Field(gt=0)] = 0.005
    link_angle: Annotated[Angle, Field(gt=0)] = 0.05
    joint_creep: Annotated[Angle, Field(gt=0)] = 0.005
    slide_creep: Annotated[Length, Field(gt=0)] = 0.0005
    sensor_creep: Annotated[Length, Field(gt=0)] = 0.001
    factor: Annotated[float, Field(gt=1, le=1e6)] = 10.0
    probability: Probability = 1e-4
    odds: Annotated[float, Field(gt=1)] = 100.0
    naming_odds: Annotated[float, Field(gt=1)] = 20.0


class LevelSettings(Settings):
    """When the health level changes: after ``calm`` records without trouble it gets better by one.

    Trouble is a mean NIS of the last ``window`` records that chance makes with less than ``probability``, and a
    predicted tip with a standard deviation above ``tip_sd``.
    """

    calm: Annotated[int, Field(ge=1)] = 16
    window: Annotated[int, Field(ge=10, le=1000)] = 50
    probability: Probability = 1e-5
    tip_sd: Length | None = None


class ClockSettings(Settings):
    """How the records' time is read: a step between two of them counts as ``longest_step`` at most.

    A record older than the last by more than ``tolerance`` is passed over. When ``reset_after`` records in a row are,
    the clock is taken to have been set back. ``longest_age`` is the greatest age on arrival; none by default.
    """

    longest_step: Duration = DAY
    tolerance: Duration = 0.0
    reset_after: Annotated[int, Field(ge=2, le=100)] = 3
    longest_age: Duration | None = None


class OutputSettings(Settings):
    """How often results are written: the calibration after so many records or so much time, whichever is first."""

    calibration_every_records: Annotated[int, Field(ge=1)] = 20
    calibration_every: Duration = 600.0
    estimate_every_records: Annotated[int, Field(ge=1)] = 10


class JournalSettings(Settings):
    """Bytes of the journal: the oldest records go where there would be more."""

    total_bytes: Annotated[int, Field(ge=65536)] = 64 * 1024**2


class RecalibrateSettings(Settings):
    """How a calibration is kept true.

    ``process_noise`` is how far a parameter may wander, by glob: ``0.05 deg in 30 d``. ``model_error``: the error of a
    wrong model is alike in neighbouring records (``calibrated``: as much as the calibration's residuals were), or
    independent (``white``). ``free`` opens parameters that the calibration held, with a standard deviation.
    ``columns`` are the source's names for the channels, as in a configuration's data section.
    """

    estimator: dict[str, Any] = Field(default_factory=lambda: {"type": "extended"})
    process_noise: dict[str, str] = Field(default_factory=dict)
    model_error: Literal["calibrated", "white"] = "calibrated"
    free: dict[str, str | float] = Field(default_factory=dict)
    gate: GateSettings = Field(default_factory=GateSettings)
    gating: bool = True
    outliers: OutlierSettings = Field(default_factory=OutlierSettings)
    changes: ChangeSettings = Field(default_factory=ChangeSettings)
    levels: LevelSettings = Field(default_factory=LevelSettings)
    clock: ClockSettings = Field(default_factory=ClockSettings)
    output: OutputSettings = Field(default_factory=OutputSettings)
    journal: JournalSettings = Field(default_factory=JournalSettings)
    columns: dict[str, str] = Field(default_factory=dict)
    evaluator: Literal["auto", "compiled", "interpreted"] = "compiled"


def load_settings(
    path: str | Path | None, overrides: Sequence[str] = (), content: bytes | None = None
) -> RecalibrateSettings:
    if path is None:
        if overrides:
            raise ConfigError(
                f"found --set {overrides[0]} without a file of settings.",
                hint="Give the file with --config; it may be empty but for a comment.",
            )
        return RecalibrateSettings()
    source = load_config(path, overrides, content=content)
    if SECTION not in source.data:
        return validate(RecalibrateSettings, source)
    elsewhere = next((text for text in overrides if not text.strip().startswith((f"{SECTION}.", f"{SECTION}="))), None)
    if elsewhere is not None:
        hint = f"Write --set {SECTION}.{elsewhere.strip()} if it is a setting of the recalibration, else leave it out."
        text = f"found --set {elsewhere}, but only the section {SECTION} of this file is read."
        raise ConfigError(text, where=Location(str(path)), hint=hint)
    return validate(RecalibrateSettings, source, (SECTION,))
