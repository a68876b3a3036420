"""Live joint readings of arms that are guided by hand."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from armcal.devices.clock import Clock


@dataclass(frozen=True)
class JointSample:
    """One reading of all joints.

    Attributes:
        arrived: when it came, by the bench's clock (s).
        stamp: when it was taken, by the source's own clock (s), where it says so.
        angles: by channel (``arm.q1``; rad, or m of sliding joints).
        labels: text that came with it (a socket's name).
    """

    arrived: float
    stamp: float | None
    angles: Mapping[str, float]
    labels: Mapping[str, str] = field(default_factory=dict)


class JointStream(Protocol):
    """A live source of joint readings."""

    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        """Begin to listen for these channels.

        Raises:
            DeviceRefusedError: the source is not there or is taken.
            ConfigError: its settings name no such channel, or leave one out.
        """

    def samples(self) -> list[JointSample]:
        """All that came since the last call; it never waits. What cannot be read is counted in ``refused``."""

    @property
    def ended(self) -> bool:
        """Nothing more will come."""

    @property
    def refused(self) -> Mapping[str, int]:
        """How many lines were passed over, by reason."""

    def close(self) -> None:
        """Stop. May be called twice."""


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
