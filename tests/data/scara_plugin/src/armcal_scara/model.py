"""A SCARA arm: shoulder and elbow turn about parallel axes, the quill slides along them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from armcal.arm.model import Attachment, Chain, Joint
from armcal.base import se3
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.settings import Length, Settings


class ScaraSettings(Settings):
    """Nominal dimensions: both links, and the height of the quill's tip at rest."""

    upper: Length
    fore: Length
    height: Length = 0.0


class ScaraArm:
    """The arm model ``scara``; frames ``upper_arm`` and ``forearm`` stand on their joints."""

    Settings: ClassVar[type[ScaraSettings]] = ScaraSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"upper_mm": 250, "fore_mm": 200, "height_mm": 300}

    def __init__(self, settings: ScaraSettings) -> None:
        self._settings = settings

    @property
    def joint_names(self) -> tuple[str, ...]:
        """From the base to the tip."""
        return ("shoulder", "elbow", "quill")

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """Name, SI unit, nominal value, and the size of an ordinary correction."""
        return (
            scalar("upper", "m", self._settings.upper, 0.01),
            scalar("fore", "m", self._settings.fore, 0.01),
            scalar("height", "m", self._settings.height, 0.01),
            scalar("shoulder_zero", "rad", 0.0, 0.05),
            scalar("elbow_zero", "rad", 0.0, 0.05),
        )

    def chain(self, values: Mapping[str, Any]) -> Chain:
        """The chain as an expression of the parameters."""
        lift = se3.translation_along("z", values["height"])
        upper = se3.translation_along("x", values["upper"])
        fore = se3.translation_along("x", values["fore"])
        joints = (
            Joint("shoulder", lift, offset=values["shoulder_zero"]),
            Joint("elbow", upper, offset=values["elbow_zero"]),
            Joint("quill", fore, angular=(0.0, 0.0, 0.0), linear=(0.0, 0.0, -1.0)),
        )
        on_joint = {"upper_arm": Attachment(1, se3.identity()), "forearm": Attachment(2, se3.identity())}
        return Chain(se3.identity(), joints, Attachment(3, se3.identity()), on_joint)
