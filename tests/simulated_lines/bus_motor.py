"""What turns inside a smart servo: a motor that follows its own profile, with an encoder at the output shaft.

The position loop is proportional: under a torque the shaft stands off by ``compliance_deg_per_Nm``, which the encoder
sees. Play lies between shaft and joint (spline, screws, bearings), which it does not see.
"""

import math
from typing import Annotated

from armcal.base.settings import Torque
from armcal_simulation.servos import JointServo, Positive, ServoJointSettings
from pydantic import Field
from typing_extensions import override

_NEAR = 1e-9


class BusMotorSettings(ServoJointSettings):
    """What kind of motor it is, beside what all servos have; by default an STS3215 at 7.4 V.

    ``stall_A`` is what it draws at ``stall``; ``rise_K`` how much warmer its sensor is than the air when its winding
    reaches what it bears.
    """

    speed_deg_per_s: Positive = 270.0
    stall: Annotated[Torque, Field(gt=0)] = 1.9
    friction: Annotated[Torque, Field(ge=0)] = 0.25
    continuous: Annotated[Torque, Field(gt=0)] = 1.0
    compliance_deg_per_Nm: Annotated[float, Field(ge=0)] = 0.8
    encoder_noise_counts: Annotated[float, Field(ge=0)] = 0.3
    stall_A: Positive = 2.4
    rise_K: Positive = 65.0


class BusMotor(JointServo):
    """One motor.

    Attributes:
        torque: of its load, as of the last step (N m).
        setpoint: where its profile is now (rad); None while it is let go.
        goal: where the profile ends (rad); ``speed`` (rad/s) and ``acceleration`` (rad/s^2, 0: at once) are its limits.
        torque_share: how much of its torque it may use.
    """

    settings: BusMotorSettings

    def __init__(self, settings: BusMotorSettings, angle: float) -> None:
        super().__init__(settings, angle)
        self.torque, self.torque_share = 0.0, 1.0
        self.setpoint: float | None = None
        self.goal, self.speed, self.acceleration = angle, self._speed, 0.0
        self._profile_speed = 0.0

    @property
    def moving(self) -> bool:
        return self.setpoint is not None and abs(self.goal - self.setpoint) > _NEAR

    @property
    def rate(self) -> float:
        """How fast its profile is (rad/s)."""
        return self._profile_speed if self.moving else 0.0

    @property
    def load(self) -> float:
        """The share of its stall torque that it gives, with the sign of the way it pushes.

        Against a stop it pushes with all that it may.
        """
        if not self.powered:
            return 0.0
        low, high = self.stops
        beyond = (self.setpoint or 0.0) - min(max(self.setpoint or 0.0, low), high)
        if abs(beyond) > self._compliance * self.settings.stall:
            return math.copysign(self.torque_share, beyond)
        share = -self.torque / self.settings.stall
        return min(max(share, -self.torque_share), self.torque_share)

    def energise(self, on: bool) -> None:
        """Hold where it stands, or let go."""
        if on and self.setpoint is None:
            self.goal = self.setpoint = self.shaft
            self._profile_speed = 0.0
        elif not on:
            self.setpoint = None
        self._send()

    @override
    def holds(self, torque: float) -> bool:
        return self.powered and abs(torque) <= self.settings.stall * self.torque_share

    @override
    def rests(self, torque: float) -> bool:
        return not self.moving and super().rests(torque)

    @override
    def gives_way(self, torque: float) -> bool:
        return self.moving or super().gives_way(torque)

    @override
    def advance(self, seconds: float, torque: float) -> bool:
        self.torque, side = torque, self.approach
        if self.setpoint is not None:
            before = self.setpoint
            self._follow(seconds)
            self._send()
            if self.setpoint != before:
                side = 1 if self.setpoint > before else -1
        moved = super().advance(seconds, torque)
        if self.setpoint is not None:
            self.approach = side  # what its load turns it by is no motion of its own
        return moved

    def _send(self) -> None:
        """The shaft is drawn to the set point, less what the load makes it stand off."""
        self.target = self.setpoint

    def _follow(self, seconds: float) -> None:
        """Move the set point on along a trapezoid of speed."""
        left = self.goal - (self.setpoint or 0.0)
        most = min(self.speed, self._speed)
        cruise = math.copysign(most, left)
        if self.acceleration > 0:
            change = self.acceleration * seconds
            braking = math.copysign(min(most, math.sqrt(2 * self.acceleration * abs(left)) + change), left)
            self._profile_speed += min(max(braking - self._profile_speed, -change), change)
        else:
            self._profile_speed = cruise
        step = self._profile_speed * seconds
        if abs(left) <= _NEAR or (step / left >= 1.0):
            self.setpoint, self._profile_speed = self.goal, 0.0
        else:
            self.setpoint = (self.setpoint or 0.0) + step
