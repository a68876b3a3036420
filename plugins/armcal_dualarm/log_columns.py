"""What the columns of a log of several arms' motors are, for logs that are read and logs that are followed."""

from collections import Counter
from typing import Annotated, Literal, Self

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.measure.rests import StillSettings
from pydantic import Field, model_validator

from armcal_dualarm.log_table import Column


class ArmColumns(Settings):
    """The columns of one arm's motors, by name or number (from 1), in the robot's own order.

    ``order`` gives for each joint from the base its number in the robot's own order; ``gear_ratios`` how far the motor
    of each joint from the base turns while the joint turns once, with its sign.
    """

    columns: tuple[Column, ...]
    order: tuple[int, ...] | None = None
    gear_ratios: tuple[float, ...] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        count = len(self.columns)
        if self.order is not None and sorted(self.order) != list(range(1, count + 1)):
            raise ValueError(f"order: found {list(self.order)}, expected each of 1 to {count} once")
        if self.gear_ratios is not None and len(self.gear_ratios) != count:
            raise ValueError(f"gear_ratios: found {len(self.gear_ratios)}, expected one for each of {count} columns")
        if self.gear_ratios is not None and 0 in self.gear_ratios:
            raise ValueError("gear_ratios: found 0, expected how often the motor turns for a turn of the joint")
        return self

    @property
    def from_base(self) -> tuple[Column, ...]:
        return tuple(self.columns[number - 1] for number in self.order or range(1, len(self.columns) + 1))

    @property
    def ratios(self) -> Array:
        return np.ones(len(self.columns)) if self.gear_ratios is None else np.array(self.gear_ratios)


class LogColumns(Settings):
    """Which columns are whose, and whether a continuous log is reduced to its still moments.

    ``time`` is the column of the time, ``labels`` maps names to text columns (``clamp: 16``).
    """

    arms: Annotated[dict[str, ArmColumns], Field(min_length=1)]
    delimiter: Literal["auto", ",", ";", "\t", "|", " "] = "auto"
    time: Column | None = None
    time_unit: Literal["s", "ms", "us"] = "s"
    labels: dict[str, Column] = Field(default_factory=dict)
    still: StillSettings | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        times = [] if self.time is None else [self.time]
        taken = Counter([*(column for arm in self.arms.values() for column in arm.columns), *times])
        twice = [str(column) for column, count in taken.items() if count > 1]
        if twice:
            raise ValueError(f"the column {twice[0]} is given twice; give each its own")
        if self.still is not None and self.still.window is not None and self.time is None:
            raise ValueError("still: window_s needs the column of the time; give time: COLUMN, or samples")
        return self
