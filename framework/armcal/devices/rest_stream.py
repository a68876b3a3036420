"""Streams that give rests: one sample for each time the arms stood still, instead of one for each reading."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from armcal.devices.joint_stream import JointSample


@runtime_checkable
class RestStream(Protocol):
    """What a joint stream may provide beside the rest: each sample is then the mean of a whole rest, once it is over.

    Attributes:
        gives_rests: whether it is set to do so.
    """

    @property
    def gives_rests(self) -> bool:
        """See above."""

    def lasting(self) -> list[JointSample]:
        """The rest that still lasts, if it is one already; for when nobody waits for its end. It is given once."""
