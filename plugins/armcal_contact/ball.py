"""A ball on the tool, seated in a socket: it touches what does not move, and measures nothing else. [Franzese2025]"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

import casadi as ca
from armcal.arm.assembly import ArmState
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.poses import point_blocks, point_expression
from armcal.base.settings import Length, Length3, Settings
from armcal.measure.contact import ContactSettings, OneArmContact
from armcal.measure.measurement import Channel, Tie
from pydantic import Field, model_validator

_MEAN_WEIGHT = 1e6
"""The mean of a socket's postures then lies in the socket to a thousandth of one posture's error."""


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
    """The measurement ``ball_in_socket``: parameters centre_x, centre_y, centre_z in the tool frame, and each socket's x, y, z."""  # noqa: E501

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
        """A socket's place in the base frame (m); fixed if it is known."""
        known = self.settings.sockets.get(group)
        blocks = [scalar(axis, "m", x, 0.01) for axis, x in zip("xyz", known or (0.0, 0.0, 0.0), strict=True)]
        return tuple(replace(block, free=known is None) for block in blocks)

    def group_starts(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        """The socket is where the ball is."""
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
