"""A servo as LeRobot's calibration has it, and how its counts become degrees or percent there.

The servo reports ``Present_Position``: its encoder's count minus its homing offset, which is stored as a sign and 11
bits. In degrees LeRobot's zero is the middle of the range, and 4095 counts are 360 degrees; in percent the range is
-100 to 100 (of a gripper 0 to 100).
"""

import math
from dataclasses import dataclass
from typing import Literal

from armcal.arm.horn import TOOTH_DEG, teeth_text

_WITHIN_DEG = 2.0
_FULL_TURN = ("wrist_roll", "forearm_roll", "wrist_rotate", "wheel")
_AT_END = 34
"""Counts, 3 deg: a range that comes so near to the encoder's end does not end there by chance."""
_FARTHEST_DEG = 300.0
"""No joint of an arm that LeRobot drives by these servos goes so far, but those that turn freely."""
_LONGER_DEG, _SAME_DEG = 60.0, 6.0
Units = Literal["degrees", "percent"]

LAST_COUNT = 4095
COUNTS_A_TURN = 4096
LARGEST_OFFSET = 2047
DEGREES_A_COUNT = 360 / LAST_COUNT
"""As LeRobot has it; a count of the encoder itself is 360 / 4096 deg."""


@dataclass(frozen=True)
class Motor:
    """One motor of a calibration file; offset and range in counts, the range as the servo reports it."""

    name: str
    id: int
    drive_mode: int
    homing_offset: int
    range_min: int
    range_max: int

    @property
    def middle(self) -> float:
        """Of the range (counts, as the servo reports it): zero in degrees."""
        return (self.range_min + self.range_max) / 2

    @property
    def zero_count(self) -> float:
        """Where the encoder itself stands at zero degrees (counts)."""
        return self.homing_offset + self.middle

    @property
    def half_range_deg(self) -> float:
        return (self.range_max - self.range_min) / 2 * DEGREES_A_COUNT

    @property
    def turns_freely(self) -> bool:
        return self.range_min == 0 and self.range_max == LAST_COUNT

    def is_beyond(self, own_deg: float | None) -> bool:
        """Whether no joint has this range: one that turns freely has any, by its model or by the name of its motor.

        ``own_deg`` is the joint's by the model; None without one. Models are often narrower than what an arm does.
        """
        if any(name in self.name for name in _FULL_TURN) or (own_deg or 0.0) > _FARTHEST_DEG:
            return False
        is_at_end = min(self.range_min, LAST_COUNT - self.range_max) < _AT_END
        if own_deg is None:
            return is_at_end or 2 * self.half_range_deg > _FARTHEST_DEG
        return 2 * self.half_range_deg > own_deg + (_SAME_DEG if is_at_end else _LONGER_DEG)

    def degrees_in(self, units: Units) -> float:
        if units == "degrees":
            return 1.0
        sign = -1.0 if self.drive_mode else 1.0  # LeRobot inverts percent by the drive mode, and never degrees
        return sign * self.half_range_deg / 100


def is_gripper(motor: str) -> bool:
    """Whether a motor opens a gripper, whose numbers are 0 to 100; of two arms it is ``left_gripper``."""
    return motor.endswith("gripper")


def zero_shift_deg(one: Motor, two: Motor) -> float:
    """How far the joint stands from where ``one`` put it, at the same command in degrees by ``two`` (-180 to 180)."""
    counts = two.zero_count - one.zero_count
    return math.remainder(counts, COUNTS_A_TURN) * 360 / COUNTS_A_TURN


def teeth_of(degrees: float) -> int:
    """By how many teeth of the horn an angle is explained; 0 for none, or where it is no whole number of them."""
    teeth = round(degrees / TOOTH_DEG)
    return teeth if teeth and abs(degrees - teeth * TOOTH_DEG) <= _WITHIN_DEG else 0


def remount(offset: float) -> str:
    """What to do about a homing offset (counts) that the servo cannot store."""
    degrees = offset * 360 / COUNTS_A_TURN
    teeth = max(1, round(abs(degrees) / TOOTH_DEG))
    other = round(offset - math.copysign(COUNTS_A_TURN, offset))
    within = f" (within one turn of the encoder the same angle is {other})" if abs(other) <= LARGEST_OFFSET else ""
    return (
        f"Switch the arm's power off and on, and calibrate again{within}; or remount it by "
        f"{teeth_text(teeth)} towards the middle of the encoder, and then calibrate again."
    )
