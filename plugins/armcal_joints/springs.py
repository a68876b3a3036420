"""Springs about joint axes: linear, and with a cubic term. [Conenna2024]"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

from armcal.arm.effects import JointCommand, Spring
from armcal.base.domains import Interval
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.settings import Compliance, Settings
from pydantic import field_validator

from armcal_joints.joints import JointChoice, chosen

COMPLIANCE_SCALE_RAD_PER_NM = 0.05
CUBIC_SCALE_RAD_PER_NM3 = 0.05
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


class TorsionalSpringSettings(Settings):
    """Which joints have a spring about their axis, and whether the base has one."""

    joints: JointChoice = "all"
    base_axis: Literal["x", "y", "z"] | None = None
    compliance: Compliance = 0.0

    @field_validator("compliance")
    @classmethod
    def _physical(cls, value: float) -> float:
        if value < 0:
            raise ValueError(f"a compliance of {value:g} rad/(N m) is below zero: no spring pushes with its load")
        return value


class TorsionalSprings:
    """The effect ``torsional_spring``: ``k1`` to ``kn`` about the joints' axes, ``k0`` at the base (rad/(N m)).

    The base's spring turns about an axis of the frame that carries joint 1, under the moment of everything
    about that frame's origin. The physical bound k >= 0 is part of the parameters' domain.
    """

    Settings: ClassVar[type[TorsionalSpringSettings]] = TorsionalSpringSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"base_axis": "y", "compliance_rad_per_Nm": 0.01}

    def __init__(self, settings: TorsionalSpringSettings, joint_names: Sequence[str]) -> None:
        self._settings = settings
        base = (0,) if settings.base_axis else ()
        self._sites = (*base, *chosen(settings.joints, joint_names))

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """One compliance a site."""
        physical = Interval(lower=0.0)
        nominal = self._settings.compliance
        return tuple(
            scalar(f"k{site}", "rad_per_Nm", nominal, COMPLIANCE_SCALE_RAD_PER_NM, physical) for site in self._sites
        )

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        """Nothing: a spring acts through its load alone."""
        return 0

    def springs(self, values: Mapping[str, Any]) -> tuple[Spring, ...]:
        """One coordinate a site."""
        return tuple(self._spring(site, values[f"k{site}"]) for site in self._sites)

    def _spring(self, site: int, compliance: Any) -> Spring:
        directions = (_AXES[str(self._settings.base_axis)],) if site == 0 else ()
        return Spring(site, directions, lambda load: compliance * load)


class CubicSpringSettings(Settings):
    """Which joints' springs soften, or stiffen, under load."""

    joints: JointChoice = "all"


class CubicSprings:
    """The effect ``cubic_spring``: ``c1`` to ``cn`` (rad/(N m)^3) times the third power of the torque about the axis.

    It stands beside a linear spring. A negative value is a spring that stiffens; alone it would push back.
    """

    Settings: ClassVar[type[CubicSpringSettings]] = CubicSpringSettings

    def __init__(self, settings: CubicSpringSettings, joint_names: Sequence[str]) -> None:
        self._joints = chosen(settings.joints, joint_names)

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """One number a joint, zero at first."""
        return tuple(scalar(f"c{joint}", "rad_per_Nm3", 0.0, CUBIC_SCALE_RAD_PER_NM3) for joint in self._joints)

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        """Nothing: a spring acts through its load alone."""
        return 0

    def springs(self, values: Mapping[str, Any]) -> tuple[Spring, ...]:
        """One coordinate a joint."""
        return tuple(self._spring(joint, values[f"c{joint}"]) for joint in self._joints)

    def _spring(self, site: int, cubic: Any) -> Spring:
        return Spring(site, (), lambda load: cubic * load * load * load)
