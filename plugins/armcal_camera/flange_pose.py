"""An arm of which only flange poses are recorded: hand-eye calibration needs no more.

The pose is that of a chain of three sliding joints and three turning ones, so all that works for arms works for it;
what its controller gets wrong is noise or an effect of these joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from armcal.arm.model import Attachment, Chain, Joint
from armcal.base import se3
from armcal.base.parameters import ParameterBlock
from armcal.base.settings import Settings

_STILL = (0.0, 0.0, 0.0)
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class FlangePoseSettings(Settings):
    """Nothing to set: the flange's pose is recorded."""


class FlangePose:
    """The arm model ``flange_pose``: "joints" x, y, z (m) and rz, ry, rx (rad).

    base_T_flange has the translation (x, y, z) and the rotation Rz(rz) Ry(ry) Rx(rx).
    """

    Settings: ClassVar[type[FlangePoseSettings]] = FlangePoseSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}
    joint_names: tuple[str, ...] = ("x", "y", "z", "rz", "ry", "rx")

    def __init__(self, settings: FlangePoseSettings) -> None:
        self._settings = settings

    def parameters(self) -> Sequence[ParameterBlock]:
        """None: what is recorded is the pose."""
        return ()

    def chain(self, values: Mapping[str, Any]) -> Chain:
        """Three sliding joints along the axes of the base, then turns about z, y and x."""
        slides = [Joint(axis, se3.identity(), _STILL, direction) for axis, direction in _AXES.items()]
        turns = [Joint(f"r{axis}", se3.identity(), _AXES[axis]) for axis in "zyx"]
        return Chain(se3.identity(), (*slides, *turns), Attachment(6, se3.identity()))
