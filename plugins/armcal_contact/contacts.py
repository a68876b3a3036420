"""A ball on the tool, seated in a socket: it touches what does not move, and measures nothing else. [Franzese2025]"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

import casadi as ca
import numpy as np
from armcal.arm.assembly import ArmState
from armcal.base import se3
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.poses import (
    PoseSettings,
    point_blocks,
    point_expression,
    pose_blocks,
    pose_transform,
    quaternion_expression,
)
from armcal.base.settings import Angle, Length, Length3, Settings
from armcal.measure.groups import OTHER
from armcal.measure.measurement import Channel, ContactSettings, Instrument, InstrumentSettings, OneArmContact, Tie
from pydantic import Field, field_validator, model_validator


class TipDistanceSettings(InstrumentSettings):
    """How well a distance is known (standard deviation), where the tip sits on the tool, which column names the pair.

    A record that has a ``distance`` names the other record by its id in the text column ``partner``.
    """

    noise: Annotated[Length, Field(gt=0)]
    tip: Length3 = (0.0, 0.0, 0.0)
    partner: str = "partner"


class TipDistance(Instrument):
    """The measurement ``tip_distance``: channel distance; parameters tip_x, tip_y, tip_z in the tool frame."""

    Settings = TipDistanceSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_mm": 0.05, "tip_mm": [0, 0, 60]}

    def __init__(self, settings: TipDistanceSettings, arm_names: Sequence[str]) -> None:
        super().__init__(settings, arm_names)
        self.arms += (self.arms[0] + OTHER,)  # in the other record

    @property
    def partner_label(self) -> str:
        return str(self.settings.partner)

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return point_blocks("tip", self.settings.tip)

    def channels(self) -> tuple[Channel, ...]:
        return (Channel("distance", "length"),)

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        tip = point_expression("tip", values)
        here, there = (arms[name].base_T_tool.apply(tip) for name in self.arms)
        return {"distance": ca.sqrt(ca.dot(here - there, here - there))}

    def noise(self) -> tuple[float, ...]:
        return (self.settings.noise,)


class PlaneContactSettings(ContactSettings):
    """How well the tip touches (standard deviation across the plane), where it sits on the tool, which way planes face.

    ``normal`` is about where the planes' normals point, in the base frame; they are found within a right angle of it.
    A record's plane is named by its text columns ``group_labels``.
    """

    noise: Annotated[Length, Field(gt=0)]
    tip: Length3 = (0.0, 0.0, 0.0)
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    group_labels: tuple[str, ...] = ("plane",)

    @field_validator("normal")
    @classmethod
    def _unit(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        length = float(np.linalg.norm(value))
        if length < 1e-6:
            raise ValueError("found a normal of no length, expected a direction")
        x, y, z = (float(c) / length for c in value)
        return x, y, z


class PlaneContact(OneArmContact):
    """The measurement ``plane_contact``: tip_x to tip_z in the tool frame; of each plane tilt_1, tilt_2, offset."""

    Settings: ClassVar[type[PlaneContactSettings]] = PlaneContactSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_mm": 0.05, "tip_mm": [0, 0, 60]}

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return point_blocks("tip", self.settings.tip)

    def group_parameters(self, group: str) -> tuple[ParameterBlock, ...]:
        # How a plane is tilted from the stated normal (rad), and how far it lies from the origin (m)
        tilts = [scalar(f"tilt_{i}", "rad", 0.0, 0.05) for i in (1, 2)]
        return tuple(replace(block, free=True) for block in (*tilts, scalar("offset", "m", 0.0, 0.01)))

    def group_starts(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        offset = ca.dot(ca.SX(list(self.settings.normal)), self._tip(arms, values))
        return {"tilt_1": ca.SX(0), "tilt_2": ca.SX(0), "offset": offset}

    def residual(self, arms: Mapping[str, ArmState], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """How far the tip is beyond the plane (1x1, m)."""
        normal = np.array(self.settings.normal)
        first = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
        first = first / np.linalg.norm(first)
        second = np.cross(normal, first)
        turn = values["tilt_1"] * ca.SX(list(first)) + values["tilt_2"] * ca.SX(list(second))
        tilted = ca.mtimes(se3.small_rotation(turn), ca.SX(list(normal)))
        return ca.dot(tilted, self._tip(arms, values)) - values["offset"]

    def noise(self) -> tuple[float, ...]:
        return (self.settings.noise,)

    def _tip(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> Any:
        return self.base_T_tool(arms).apply(point_expression("tip", values))


class ClampedToolSettings(ContactSettings):
    """How well the clamp holds the tool (standard deviations), and what is known of the points.

    ``points`` are the poses of the clamped tool that are known, in the fixture, by the point's name: a record's text
    columns ``group_labels`` joined by a slash (``one`` if there are none). A point that is not named here is found.
    ``fixture`` is the fixture's pose in the base frame. It is held; free its parameters (``NAME.fixture_*``) where
    the points are known only to each other.
    """

    noise: Annotated[Length, Field(gt=0)]
    orientation_noise: Annotated[Angle, Field(gt=0)]
    group_labels: tuple[str, ...] = ("point",)
    points: dict[str, PoseSettings] = Field(default_factory=dict)
    fixture: PoseSettings = PoseSettings()


class ClampedTool(OneArmContact):
    """The measurement ``clamped_tool``: fixture_x .. fixture_rotation; of each point point_x .. point_rotation."""

    Settings: ClassVar[type[ClampedToolSettings]] = ClampedToolSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "noise_mm": 0.1,
        "orientation_noise_mrad": 0.5,
        "points": {"bench": {"position_mm": [300, 50, 120], "rpy_deg": [180, 0, 30]}},
    }

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return self.settings.fixture.blocks("fixture")

    def group_parameters(self, group: str) -> tuple[ParameterBlock, ...]:
        known = self.settings.points.get(group)
        blocks = pose_blocks("point") if known is None else known.blocks("point")
        return tuple(replace(block, free=known is None) for block in blocks)

    def named_groups(self) -> tuple[str, ...]:
        return tuple(self.settings.points)

    def group_starts(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        here = pose_transform("fixture", values).inverse() @ self.base_T_tool(arms)
        place = {f"point_{axis}": here.translation[i] for i, axis in enumerate("xyz")}
        return {**place, "point_rotation": quaternion_expression(here.rotation)}

    def residual(self, arms: Mapping[str, ArmState], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """From the clamp to the tool, in the clamp's frame: position (3, m) and rotation vector (3, rad)."""
        base_T_point = pose_transform("fixture", values) @ pose_transform("point", values)
        error = base_T_point.inverse() @ self.base_T_tool(arms)
        return ca.vertcat(error.translation, se3.rotation_vector(error.rotation))

    def noise(self) -> tuple[float, ...]:
        return (self.settings.noise,) * 3 + (self.settings.orientation_noise,) * 3

    def dimensions(self) -> tuple[str, ...]:
        return ("length",) * 3 + ("angle",) * 3


_MEAN_WEIGHT = 1e6  # The mean of a socket's postures then lies in the socket to a thousandth of one posture's error


class KnownDistance(Settings):
    """The distance of two sockets of the same tool position, and how sure it is (standard deviation)."""

    between: tuple[str, str]
    distance: Annotated[Length, Field(gt=0)]
    noise: Annotated[Length, Field(gt=0)]

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.between[0] == self.between[1]:
            raise ValueError(f"found {self.between[0]} twice, expected two sockets")
        return self


class BallInSocketSettings(ContactSettings):
    """How well the ball seats (standard deviation of each coordinate, m), where it sits on the tool, what is known.

    A record's socket is named by its text columns ``group_labels``. Sockets lie anywhere; those in ``sockets`` lie
    at known places of the base frame, by their key (``front/hole_0``). ``socket: mean`` holds each socket at the
    mean of its postures, whatever is known of distances. ``sockets_of`` names another measurement of this type whose
    sockets these are: both arms touch the same ones.
    """

    noise: Annotated[Length, Field(gt=0)]
    centre: Length3 = (0.0, 0.0, 0.0)
    group_labels: tuple[str, ...] = ("position", "socket")
    distances: tuple[KnownDistance, ...] = ()
    sockets: dict[str, Length3] = Field(default_factory=dict)
    socket: Literal["fitted", "mean"] = "fitted"
    sockets_of: str | None = None


class BallInSocket(OneArmContact):
    """The measurement ``ball_in_socket``: centre_x to centre_z in the tool frame, and each socket's x, y, z."""

    Settings: ClassVar[type[BallInSocketSettings]] = BallInSocketSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "noise_mm": 0.2,
        "centre_mm": [0, 0, 40],
        "distances": [{"between": ["hole_0", "hole_1"], "distance_mm": 50, "noise_mm": 0.05}],
    }

    def __init__(self, settings: BallInSocketSettings, arm_names: Sequence[str]) -> None:
        super().__init__(settings, arm_names)
        self.group_owner = settings.sockets_of
        self.mean_weight = _MEAN_WEIGHT if settings.socket == "mean" else 1.0

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return point_blocks("centre", self.settings.centre)

    def group_parameters(self, group: str) -> tuple[ParameterBlock, ...]:
        known = self.settings.sockets.get(group)
        blocks = [scalar(axis, "m", x, 0.01) for axis, x in zip("xyz", known or (0.0, 0.0, 0.0), strict=True)]
        return tuple(replace(block, free=known is None) for block in blocks)

    def group_starts(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        place = self._ball(arms, values)
        return {axis: place[i] for i, axis in enumerate("xyz")}

    def named_groups(self) -> tuple[str, ...]:
        before = "*/" if len(self.group_labels) > 1 else ""
        apart = [f"{before}{name}" for known in self.settings.distances for name in known.between]
        return (*self.settings.sockets, *apart)

    def ties(self, groups: Sequence[str]) -> tuple[Tie, ...]:
        if self.settings.sockets_of is not None:
            return ()
        ties = []
        for known in self.settings.distances:
            for first in groups:
                position, slash, socket = first.rpartition("/")
                second = f"{position}{slash}{known.between[1]}"
                if socket == known.between[0] and second in groups:
                    ties.append(Tie((first, second), partial(_beyond, known.distance), (known.noise,)))
        return tuple(ties)

    def residual(self, arms: Mapping[str, ArmState], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """From the socket to the ball, in the base frame (3x1, m)."""
        return self._ball(arms, values) - ca.vertcat(*[values[axis] for axis in "xyz"])

    def noise(self) -> tuple[float, ...]:
        return (self.settings.noise,) * 3

    def noise_channels(self) -> tuple[tuple[Channel, ...], ...]:
        return ((Channel("noise", "length"),),) * 3

    def _ball(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> Any:
        return self.base_T_tool(arms).apply(point_expression("centre", values))


def _beyond(distance: float, first: Mapping[str, Any], second: Mapping[str, Any]) -> Any:
    apart = ca.vertcat(*[second[axis] - first[axis] for axis in "xyz"])
    return ca.sqrt(ca.dot(apart, apart)) - distance
