"""The settings of a simulated servo bench."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from armcal.base.pose_settings import PoseSettings
from armcal.base.settings import Angle, Duration, InputPath, Length, Settings, Torque
from pydantic import Field, model_validator

from armcal_simulation.dtrack_sender_settings import DTrackSenderSettings

Positive = Annotated[float, Field(gt=0)]
ALL = "all"
"""In the place of a joint's name: what holds for all joints that do not say otherwise."""


class ServoJointSettings(Settings):
    """What kind of servo drives a joint.

    ``backlash`` is the whole gap between gear and horn. A load above ``stall`` turns it; unpowered it gives way to
    torques above ``friction``, at ``fall_deg_per_s``. Steadily under ``continuous`` torque its winding comes to what it
    bears; beyond that it fails. ``winding_share`` of that rise lies between winding and case.
    """

    speed_deg_per_s: Positive = 300.0
    dead_band: Angle = 0.0
    backlash: Angle = 0.0
    travel: tuple[Angle, Angle] = (-2.4, 2.4)
    stall: Torque = 4.0
    friction: Torque = 0.05
    fall_deg_per_s: Positive = 60.0
    continuous: Torque = 1.5
    winding_time: Duration = 60.0
    case_time: Duration = 900.0
    winding_share: Annotated[float, Field(gt=0, lt=1)] = 0.3

    @model_validator(mode="after")
    def _physical(self) -> ServoJointSettings:
        for name in ("stall", "continuous", "winding_time", "case_time"):
            if getattr(self, name) <= 0:
                raise ValueError(f"found a {name} that is not above zero")
        for name in ("dead_band", "backlash", "friction"):
            if getattr(self, name) < 0:
                raise ValueError(f"found a {name} below zero, expected 0 or more")
        if not self.travel[0] < self.travel[1]:
            raise ValueError("the ends of travel are not in rising order: give [lowest, highest]")
        return self


class SafetySettings(Settings):
    """What the arm must not be made to do, judged by the true pulse tables.

    The commanded speed over ``window`` may be above ``rate_deg_per_s`` by a twentieth and one count. Joint limits and
    clearances are the plan's, less what a host cannot know of the true tables. Pulses are those that the true servo
    file's servos bear, less what a host cannot know of the true oscillator. Two joints whose pulses begin within
    ``together`` were not energised one at a time.
    """

    rate_deg_per_s: Positive = 20.0
    window: Duration = 0.25
    limits_slack: Angle = 0.035
    clearance_slack: Length = 0.005
    pulse_slack: Duration = 2e-5
    together: Duration = 0.1


class BenchTrackerSettings(DTrackSenderSettings):
    """Where its datagrams go, and which of its bodies sit on the tool and at the arm's base (none: nobody sees it)."""

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 5000
    tool: str = "tool"
    base: str | None = "base"

    @model_validator(mode="after")
    def _known(self) -> BenchTrackerSettings:
        for name in (self.tool, self.base):
            if name is not None and name not in self.bodies:
                raise ValueError(f"found the body {name!r}, expected one of {', '.join(self.bodies)}")
        return self


class ServoBenchSettings(Settings):
    """The truth of a bench: boards, servos, arm, tracker, and what counts as unsafe.

    ``servos`` is a servo file with the true oscillators and pulse tables; ``truth`` has the arm's true parameters by
    name, and ``without_effects`` what the servos here do themselves. ``joints`` says what kind of servos they are, by
    joint or for ``all``. Before the first pulse the arm hangs as it falls from ``start``. ``measurement`` is the one
    whose body the tracker sees, the only one by default. ``board_id`` and ``states_oscillator_hz`` are what a framed
    board says of itself (0: nothing).
    """

    firmware: Literal["firmata", "framed"] = "framed"
    board_id: str = "SIMULATED"
    states_oscillator_hz: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0
    servos: InputPath
    truth: InputPath | None = None
    without_effects: tuple[str, ...] = ()
    measurement: str | None = None
    joints: dict[str, ServoJointSettings] = Field(default_factory=dict)
    start: dict[str, Angle] = Field(default_factory=dict)
    world_T_base: PoseSettings = Field(default_factory=PoseSettings)
    tracker: BenchTrackerSettings = Field(default_factory=BenchTrackerSettings.si)
    safety: SafetySettings = Field(default_factory=SafetySettings)
    seed: Annotated[int, Field(ge=0)] = 0

    def servo_of(self, joint: str) -> ServoJointSettings:
        """What kind of servo drives a joint: its own settings above those of all."""
        stated: Mapping[str, ServoJointSettings] = self.joints
        given = [stated[name] for name in (ALL, joint) if name in stated]
        merged = {key: getattr(one, key) for one in given for key in one.model_fields_set}
        return ServoJointSettings.si(**merged)
