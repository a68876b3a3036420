"""Backlash: where in its play a joint rests, by the direction it came from, or by the torque that pushes it."""

from collections.abc import Mapping
from typing import Annotated, Any

import casadi as ca
from armcal.arm.effects import XYZ, EffectSettings, JointCommand, JointEffect, Spring
from armcal.base.domains import Interval
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.settings import Torque
from pydantic import Field

from armcal_joints.springs import SiteSprings

PLAY_SCALE_RAD = 0.01


class ApproachBacklash(JointEffect):
    """The effect ``approach_backlash``: ``lag1`` to ``lagn`` (rad), half the difference between both directions.

    A joint that came from below (approach +1) stops ``lag`` short of its command; a negative value overshoots. Where
    the approach is not recorded (0) the joint is taken in the middle.
    """

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return tuple(scalar(f"lag{joint}", "rad", 0.0, PLAY_SCALE_RAD) for joint in self.joints)

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        """Against the direction of the last motion (rad)."""
        return -values[f"lag{command.joint}"] * command.approach if command.joint in self.joints else 0


class TorqueBacklashSettings(EffectSettings):
    """Which joints, and the torque at which 71 % of the play is taken up: it keeps the equilibrium smooth."""

    transition: Annotated[Torque, Field(gt=0)] = 0.05


class TorqueBacklash(SiteSprings):
    """The effect ``torque_backlash``: ``play1`` to ``playn`` (rad), half the play that the sign of the torque decides.

    play * torque / sqrt(torque^2 + transition^2): a smooth sign, so that the elastic equilibrium has a derivative.
    """

    letter = "play"
    Settings = TorqueBacklashSettings

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """One half-width a joint; a torque pushes along, never against itself."""
        physical = Interval(lower=0.0)
        return tuple(scalar(f"play{joint}", "rad", 0.0, PLAY_SCALE_RAD, physical) for joint in self.joints)

    def spring(self, site: int, value: Any) -> Spring:
        floor = self.settings.transition**2
        return Spring(site, (), lambda torque, command: value * torque / ca.sqrt(torque * torque + floor))


class BearingPlaySettings(TorqueBacklashSettings):
    """Which joints' bearings, and the base, have play; and the moment at which 71 % of it is taken up."""

    base: bool = True


class BearingPlay(SiteSprings):
    """The effect ``bearing_play``: ``tilt0`` (base) and ``tilt1`` to ``tiltn`` (rad), half a bearing's angular play.

    The part of the arm beyond a bearing tilts with the moment that it carries, whatever its direction, as far as the
    play lets it: tilt * moment / sqrt(|moment|^2 + transition^2).
    """

    letter = "tilt"
    Settings = BearingPlaySettings

    def parameters(self) -> tuple[ParameterBlock, ...]:
        physical = Interval(lower=0.0)
        return tuple(scalar(f"tilt{site}", "rad", 0.0, PLAY_SCALE_RAD, physical) for site in self.sites)

    def spring(self, site: int, value: Any) -> Spring:
        floor = self.settings.transition**2
        return Spring(site, XYZ, lambda moment, command: value * moment / ca.sqrt(ca.dot(moment, moment) + floor))
