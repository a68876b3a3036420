"""The settings of a simulated DTrack: what it sends how often, how noisy it is and how often it is blind."""

from __future__ import annotations

from typing import Annotated, Literal

from armcal.base.settings import Angle, Duration, Length, Settings
from pydantic import Field, model_validator

Number = Annotated[int, Field(ge=0, le=999)]
Fraction = Annotated[float, Field(ge=0, lt=1)]


class DTrackSenderSettings(Settings):
    """Numbers of a good tracker by default.

    ``noise`` is the standard deviation of each coordinate, ``orientation_noise`` of the turn about each axis of a body.
    ``bodies`` gives each body its number in the datagrams (from 0). A body is ``occluded`` for a fraction of the time,
    for ``occlusion`` on average each time. ``lost_frames`` is the fraction of datagrams that never arrive. A datagram
    arrives ``latency`` after its moment. The tracker's clock is ahead by ``clock_offset``, and gains ``clock_skew_ppm``.
    """  # noqa: E501

    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 60.0
    bodies: Annotated[dict[str, Number], Field(min_length=1, default_factory=lambda: {"base": 1, "tool": 2})]
    lines: Literal["6d", "6di"] = "6d"
    noise: Length = 5e-5
    orientation_noise: Angle = 3e-4
    occluded: dict[str, Fraction] = Field(default_factory=dict)
    occlusion: Duration = 0.2
    lost_frames: Fraction = 0.0
    latency: Duration = 0.0
    clock_offset: Duration = 0.0
    clock_skew_ppm: Annotated[float, Field(ge=-1e5, le=1e5)] = 0.0
    first_frame: Annotated[int, Field(ge=0, lt=2**32)] = 1

    @model_validator(mode="after")
    def _sane(self) -> DTrackSenderSettings:
        for name in ("noise", "orientation_noise", "latency"):
            if getattr(self, name) < 0:
                raise ValueError(f"found a {name} below zero, expected 0 or more")
        if self.occlusion <= 0:
            raise ValueError("found an occlusion that takes no time, expected a time above zero")
        if len(set(self.bodies.values())) != len(self.bodies):
            raise ValueError("found two bodies of one number, expected each to have its own")
        unknown = set(self.occluded) - set(self.bodies)
        if unknown:
            raise ValueError(f"found {min(unknown)!r} occluded, expected one of {', '.join(self.bodies)}")
        return self
