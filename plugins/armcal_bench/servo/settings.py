"""The section ``bench.servo``: how servos are calibrated."""

import math
from itertools import pairwise
from typing import Annotated, Literal, Self

from armcal.base.quantities import UnitOf
from armcal.base.settings import Angle, Compliance, Duration, InputPath, Length, Settings
from pydantic import Field, model_validator

PositiveAngle = Annotated[Angle, Field(gt=0)]
PositiveDuration = Annotated[Duration, Field(gt=0)]
Angles = Annotated[tuple[float, ...], UnitOf("angle")]
PulseRange = Annotated[tuple[float, float], UnitOf("time")]


class MeasuredPulseSettings(Settings):
    """A pulse measured at a pin of a board, by an oscilloscope for example."""

    board: str
    counts: Annotated[int, Field(ge=1, le=4095)]
    microseconds: Annotated[float, Field(gt=0)]
    sd_microseconds: Annotated[float, Field(gt=0)] = 0.1


class ServoCalibrationSettings(Settings):
    """What ``armcal servo`` measures, and how. When the arm stands is as in ``acquisition.settle``.

    Attributes:
        servos: the servo file to improve; the device's own where it is not given.
        joints: those to calibrate; all of the servo file.
        knots: the angles that all tables are to be given at; without them each table keeps its own, and its ends reach
            as far as the joint is measured.
        base: where the other joints stand while one is measured; joints that are not named stand at zero.
        ranges: over which joints are moved; the limits of ``acquisition`` or ``plan`` where none are given here.
        step: between the angles of a sweep, or of a guided calibration.
        approach: how far a joint comes from below or above before it is measured, so that its play is taken up.
        pulses: no pulse outside this range is ever set, nor one outside the servo's own ``pulse_range``.
        rate_deg_per_s: the fastest that a joint is moved, by its stated table.
        period: between two steps of a motion.
        zero: ``kept``: each servo's pulse at zero stays; ``model``: angles are absolute, by the model and the tracker.
        sag: what springs give is taken from the model's compliances, fitted with the tables, or not reckoned with.
        sag_sd: how far compliances may well be from the model's, where they are fitted.
        rotation_sd: of a settled rotation about an axis.
        least_radius: of a circle that shows an angle, where a tracker sees positions only.
        guided_sd: how well a joint is put at an angle by eye.
        measured_pulses: pulses measured at boards' pins: they determine the oscillators.
        trusted: joints whose stated tables are believed, by how well: they determine the oscillators too.
        check: how far ``--check`` moves a joint.
        silence: after this silence of the host a board that can brings the arm back to the base pose.
    """

    servos: InputPath | None = None
    joints: tuple[str, ...] = ()
    knots: Angles = ()
    base: dict[str, Angle] = Field(default_factory=dict)
    ranges: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)
    step: PositiveAngle = math.radians(10)
    approach: PositiveAngle = math.radians(4)
    pulses: PulseRange = (500e-6, 2600e-6)
    rate_deg_per_s: Annotated[float, Field(gt=0, le=60)] = 20.0
    period: PositiveDuration = 0.02
    zero: Literal["kept", "model"] = "kept"
    sag: Literal["none", "model", "fitted"] = "fitted"
    sag_sd: Annotated[Compliance, Field(gt=0)] = 0.2
    rotation_sd: PositiveAngle = math.radians(0.03)
    least_radius: Length = 0.03
    guided_sd: PositiveAngle = math.radians(0.5)
    measured_pulses: tuple[MeasuredPulseSettings, ...] = ()
    trusted: dict[str, PositiveDuration] = Field(default_factory=dict)
    check: PositiveAngle = math.radians(10)
    silence: PositiveDuration = 1.0

    @model_validator(mode="after")
    def _usable(self) -> Self:
        if len(self.knots) == 1 or not all(a < b for a, b in pairwise(self.knots)):
            raise ValueError("the knots do not rise, or are fewer than two")
        if not 0 < self.pulses[0] < self.pulses[1]:
            raise ValueError("the range of pulses does not rise from above zero: give [shortest, longest]")
        for joint, (low, high) in self.ranges.items():
            if not low < high:
                raise ValueError(f"the range of {joint} does not rise: give [lowest, highest]")
        return self
