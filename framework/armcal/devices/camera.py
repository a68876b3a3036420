"""A camera that looks at an arm, or from it, while the arm stands."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from armcal.devices.clock import Clock
from armcal.measure.measurement import Measurement


@dataclass(frozen=True)
class Shot:
    """One image and what it says.

    Attributes:
        content: of the image file that is to be kept.
        suffix: of its name, ``.png``.
        seen: what it shows, for people; without a full stop.
        values: what was read, by channel (``camera.u_3``, SI); what was not seen is left out.
        fault: why it says nothing, a sentence; empty if it does.
    """

    content: bytes
    suffix: str
    seen: str
    values: Mapping[str, float] = field(default_factory=dict)
    fault: str = ""


class LiveCamera(Protocol):
    """A live source of images.

    Attributes:
        measurement: the instance whose channels it gives; known once it is open.
        gives_shots: whether images come by themselves, one for each posture; else they are asked for.
    """

    measurement: str
    gives_shots: bool

    def open(self, clock: Clock, measurements: Mapping[str, Measurement]) -> None:
        """Begin.

        Args:
            clock: the bench's.
            measurements: by instance; one of them is this camera's.

        Raises:
            DeviceRefusedError: there is no such camera, or it is taken.
            ConfigError: none of the measurements is a camera's, or several are and none is named.
            PluginError: a library is not there.
        """

    def shots(self) -> list[Shot]:
        """All that came by themselves since the last call; it never waits for one."""

    def shoot(self) -> Shot:
        """An image taken now; one with a fault where the camera gives none."""

    def close(self) -> None:
        """Stop. May be called twice."""
