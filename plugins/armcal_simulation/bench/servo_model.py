"""A servo: it drives to the angle that it is commanded, as fast as it can, gives way under its load, and heats.

Two nodes carry its heat, in units in which a steady loss of 1 heats the winding by 1 above the air:
``loss = (torque / continuous)^2``. The winding lies inside the case, which the air cools; heat 1 is its limit.
"""

import math
from bisect import bisect_right
from typing import Annotated, Self

from armcal.arm.servo import PulseTable
from armcal.base.settings import Angle, Duration, Settings, Torque
from pydantic import Field, model_validator

Positive = Annotated[float, Field(gt=0)]
_NEAR = 1e-12
_HEAT_STEP = 0.05
"""Of the shorter time constant: an explicit step this short stays within some thousandths of the exact course."""


class ServoJointSettings(Settings):
    """What kind of servo drives a joint.

    ``dead_band``: errors of this size or less do not make it move. ``backlash`` is the whole gap between gear and horn,
    ``travel`` where its stops are. A load above ``stall`` turns it; unpowered it gives way to torques above
    ``friction``, at ``fall_deg_per_s``. Steadily under ``continuous`` torque its winding reaches its limit; beyond
    that it fails. ``winding_share`` of that rise lies between winding and case. ``winding_time`` and ``case_time`` are
    the time constants of each node against what it gives its heat to. Under its load the horn slips on the gear by
    ``creep_deg_per_min`` for each N m, as with a loose screw. Its load turns it by ``compliance_deg_per_Nm`` while it
    holds. An encoder on the gear, where the device reads one, sees that, and has ``encoder_noise``.

    Of servos without a pulse table a device does not know that at the commanded angle zero the joint stands at
    ``zero_off``, and ``horn_teeth`` further; one that is ``reversed`` turns it the other way.
    """

    speed_deg_per_s: Positive = 300.0
    dead_band: Annotated[Angle, Field(ge=0)] = 0.0
    backlash: Annotated[Angle, Field(ge=0)] = 0.0
    travel: tuple[Angle, Angle] = (-2.4, 2.4)
    creep_deg_per_min: Annotated[float, Field(ge=0)] = 0.0
    stall: Annotated[Torque, Field(gt=0)] = 4.0
    friction: Annotated[Torque, Field(ge=0)] = 0.05
    fall_deg_per_s: Positive = 60.0
    continuous: Annotated[Torque, Field(gt=0)] = 1.5
    winding_time: Annotated[Duration, Field(gt=0)] = 60.0
    case_time: Annotated[Duration, Field(gt=0)] = 900.0
    winding_share: Annotated[float, Field(gt=0, lt=1)] = 0.3
    compliance_deg_per_Nm: Annotated[float, Field(ge=0)] = 0.0
    encoder_noise: Annotated[Angle, Field(ge=0)] = 4.6e-4
    zero_off: Angle = 0.0
    horn_teeth: int = 0
    reversed: bool = False

    @model_validator(mode="after")
    def _physical(self) -> Self:
        if not self.travel[0] < self.travel[1]:
            raise ValueError("the ends of travel are not in rising order: give [lowest, highest]")
        return self

    @property
    def heat_capacities(self) -> tuple[float, float]:
        """What winding and case take up for a rise of 1 (s)."""
        return self.winding_time / self.winding_share, self.case_time / (1 - self.winding_share)


class JointServo:
    """One servo under a load.

    Attributes:
        settings: what kind of servo it is.
        angle: of its horn (rad); ``shaft``: at the encoder, of the gear, ahead of its backlash.
        target: where it is sent (rad), within its stops; None while it is not powered.
        approach: the sign of its last motion; 0 before the first.
        stops: where it can turn no further (rad).
        failed: it has burnt out, and holds nothing.

    Args:
        angle: where it stands.
        table: the angle that it takes at each pulse length, in truth; None: it takes angles.
    """

    def __init__(self, settings: ServoJointSettings, angle: float, table: PulseTable | None = None) -> None:
        self.settings, self.angle, self.approach, self.failed = settings, angle, 0, False
        self.target: float | None = None
        self.stops = settings.travel
        self._horn, self._slipped, self._creep = angle, 0.0, math.radians(settings.creep_deg_per_min) / 60.0
        self.shaft = angle
        self._driving = False
        self._compliance = math.radians(settings.compliance_deg_per_Nm)
        self._speed, self._fall_speed = math.radians(settings.speed_deg_per_s), math.radians(settings.fall_deg_per_s)
        self._pulses: tuple[float, ...] = ()
        if table is not None:
            order = slice(None, None, 1 if table.pulses[0] < table.pulses[-1] else -1)
            self._pulses, self._angles = table.pulses[order], table.angles[order]

    @property
    def powered(self) -> bool:
        return self.target is not None and not self.failed

    def angle_of(self, command: float) -> float:
        """The angle (rad) that a command asks for: itself, or of a pulse (s), linear between knots and beyond them."""
        if not self._pulses:
            return command
        at = min(max(bisect_right(self._pulses, command), 1), len(self._pulses) - 1)
        p0, p1, a0, a1 = self._pulses[at - 1], self._pulses[at], self._angles[at - 1], self._angles[at]
        return a0 + (command - p0) * (a1 - a0) / (p1 - p0)

    def command(self, command: float | None) -> None:
        """Drive to what a command asks for; None: let go."""
        before, (low, high) = self.target, self.stops
        self.target = None if command is None else min(max(self.angle_of(command), low), high)
        if self._compliance and before is not None and self.target not in (None, before):
            self.approach = 1 if self.target > before else -1

    def put(self, angle: float) -> None:
        """Somebody turns it by hand (rad), where it does not hold."""
        if not self.powered:
            self.shaft = self._horn = self.angle = angle

    def rests(self, torque: float) -> bool:
        """Whether it stays where it is under a torque (N m), as it is driven now."""
        if self.holds(torque):
            error = abs(self._aim(torque) - self.shaft)
            return error <= _NEAR or not (self._driving or error > self.settings.dead_band)
        low, high = self.stops
        at_stop = self.shaft >= high - _NEAR if torque > 0 else self.shaft <= low + _NEAR
        return at_stop or abs(torque) <= self.settings.friction

    def gives_way(self, torque: float) -> bool:
        """Whether the torque on it (N m) must be looked up at short intervals: it turns under its load."""
        return not self.holds(torque) and (self.powered or not self.rests(torque))

    def advance(self, seconds: float, torque: float) -> bool:
        """Let time pass under a torque of its load (N m, turning towards larger angles); whether it moved."""
        slips = bool(self._creep and self.powered and torque)
        if slips:  # the horn, on the gear
            self._slipped += self._creep * torque * seconds
            self.angle = self._horn + self._slipped
        if self.rests(torque):
            return slips
        before = self.shaft
        if self.holds(torque):
            error, step = self._aim(torque) - before, self._speed * seconds
            self._driving = abs(error) > step
            self.shaft += math.copysign(step, error) if self._driving else error
        else:
            step = self._fall_speed * seconds
            low, high = self.stops
            self.shaft = min(max(before + (step if torque > 0 else -step), low), high)
        moved = self.shaft - before
        if moved and not (self._compliance and self.powered):  # what its load turns it by is no motion of its own
            self.approach = 1 if moved > 0 else -1
        # the gear pushes the horn at one end of the gap
        half = self.settings.backlash / 2
        self._horn = min(max(self._horn, self.shaft - half), self.shaft + half)
        self.angle = self._horn + self._slipped
        return bool(moved) or slips

    def holds(self, torque: float) -> bool:
        """Whether it is strong enough for a torque (N m), as it is powered now."""
        return self.powered and abs(torque) <= self.settings.stall

    def _aim(self, torque: float) -> float:
        """Where the gear is drawn to: the target, less what the load makes it stand off."""
        low, high = self.stops
        return min(max((self.target or 0.0) + self._compliance * torque, low), high)


class ServoHeat:
    """One servo's temperatures above the air, as fractions of the winding's limit.

    Attributes:
        winding, case: of the two nodes.
    """

    def __init__(self, settings: ServoJointSettings) -> None:
        self.winding, self.case = 0.0, 0.0
        self._settings, self._capacities = settings, settings.heat_capacities
        self._longest = _HEAT_STEP * min(settings.winding_time, settings.case_time)

    def advance(self, seconds: float, torque: float) -> None:
        """Hold a torque (N m; 0 for an unpowered servo) for so long."""
        share, (winding_capacity, case_capacity) = self._settings.winding_share, self._capacities
        loss = (torque / self._settings.continuous) ** 2
        while seconds > 0:
            step = min(seconds, self._longest)
            to_case = (self.winding - self.case) / share
            to_air = self.case / (1 - share)
            self.winding += step * (loss - to_case) / winding_capacity
            self.case += step * (to_case - to_air) / case_capacity
            seconds -= step
