"""The settings of a measuring run."""

from typing import Annotated, Literal

from armcal.base.settings import Angle, Duration, Length, Settings, Temperature, Torque
from pydantic import Field


class ServoHeatSettings(Settings):
    """How a servo heats: steadily under ``continuous`` torque it comes to its limit in the end.

    ``winding_share`` of that comes within ``winding_time``, the rest with the slow ``case_time``. A servo may be given
    as much of its limit as ``budget``: 0.5 is safe where each of these numbers is wrong by 30 %.
    """

    continuous: Annotated[Torque, Field(gt=0)]
    winding_time: Annotated[Duration, Field(gt=0)] = 60.0
    case_time: Annotated[Duration, Field(gt=0)] = 900.0
    winding_share: Annotated[float, Field(ge=0, le=1)] = 0.3
    budget: Annotated[float, Field(gt=0, le=1)] = 0.5


class SettleSettings(Settings):
    """When the arm stands: the mean of the last ``window`` is taken once positions scatter by less than ``spread``.

    ``spread`` is of the mean's halves: they differ by less. ``wait`` passes first; after ``longest`` the pose is left.
    """

    wait: Duration = 0.5
    window: Duration = 1.0
    spread: Length = 0.0005
    longest: Duration = 15.0
    frames: Annotated[int, Field(ge=2)] = 10


class ArrivalSettings(Settings):
    """How far the arm may be from where it was commanded to be, by distances and turns between measured poses.

    More than ``astray``, or ``astray_turned``, is no error of the model but a servo that failed, stalls or lost a
    tooth, or a body that slipped: such a pose is tried again, then left out. After ``in_a_row`` of them the arm parks
    and the run ends.
    """

    astray: Annotated[Length, Field(gt=0)] = 0.1
    astray_turned: Annotated[Angle, Field(gt=0)] = 0.45
    in_a_row: Annotated[int, Field(ge=1)] = 3


class LostSettings(Settings):
    """A tracker that is silent, frozen or blind for ``hold`` makes the arm hold; for ``park``, park."""

    hold: Duration = 0.5
    park: Duration = 30.0


class AcquisitionSettings(Settings):
    """How the plan is driven.

    ``limits`` of joints are those of ``plan`` where none are given here. ``park`` is where the arm is safe, cool and
    stays when it is left alone; joints that it does not name park at zero. Without ``heat`` no heat is reckoned with.
    The board waits for ``silence`` of the host before it parks the arm by itself, where its link can. At the end the
    arm parks, and its servos are let go one by one, or hold. Joints get their first pulses one by one,
    ``between_joints`` apart. ``temperature`` is that of the room, where it is known; it is written with the data.
    ``angles`` are those that the dataset has: as commanded, or as servos that know where they stand have measured them;
    the others stand beside them.
    """

    rate_deg_per_s: Annotated[float, Field(gt=0, le=180)] = 20.0
    period: Duration = 0.02
    limits: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)
    park: dict[str, Angle] = Field(default_factory=dict)
    path_step: Angle = 0.0175
    settle: SettleSettings = Field(default_factory=SettleSettings)
    arrival: ArrivalSettings = Field(default_factory=ArrivalSettings)
    lost: LostSettings = Field(default_factory=LostSettings)
    heat: dict[str, ServoHeatSettings] = Field(default_factory=dict)
    silence: Duration = 1.0
    at_end: Literal["release", "hold"] = "release"
    between_joints: Duration = 0.5
    temperature: Temperature | None = None
    angles: Literal["commanded", "measured"] = "commanded"
    seed: Annotated[int, Field(ge=0)] = 0
