"""Which of a tracker's bodies is what, and where the arm's base and the target sit on them."""

from __future__ import annotations

from typing import Annotated, Literal

from armcal.base.pose_settings import PoseSettings
from armcal.base.settings import Settings
from pydantic import Field, model_validator

NONE = "none"
"""In the place of the base body's name: the tracker's world itself stands still with the arm's base."""

Name = Annotated[str, Field(min_length=1, max_length=100)]


class BodySettings(Settings):
    """The bodies by the tracker's own names, and what is known about where they sit.

    Attributes:
        tool: the body on the tool.
        base: the body that stands still with the arm's base; ``none`` where the tracker's world does.
        base_motion: ``moving``: each frame is taken in the base body's own pose of that frame. ``still``: the base body's
            poses of all frames of a capture are averaged first.
        base_T_reference: where the base body (or the tracker's world, without one) is in the arm's base frame.
        tool_body_T_target: where the measured target is on the tool body.
    """  # noqa: E501

    tool: Name = "tool"
    base: Name = NONE
    base_motion: Literal["moving", "still"] = "moving"
    base_T_reference: PoseSettings = Field(default_factory=PoseSettings)
    tool_body_T_target: PoseSettings = Field(default_factory=PoseSettings)

    @model_validator(mode="after")
    def _two_bodies(self) -> BodySettings:
        if self.tool == self.base:
            raise ValueError(
                f"found {self.tool!r} for both tool and base, expected two bodies (base: none for no base)"
            )
        return self

    @property
    def has_base(self) -> bool:
        """Whether a base body is looked for."""
        return self.base != NONE
