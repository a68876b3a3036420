"""Springs: linear and cubic ones about joint axes [Conenna2024], and 3x3 compliances under a site's full moment."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import casadi as ca
from armcal.arm.effects import XYZ, EffectSettings, JointEffect, Spring
from armcal.base.domains import Interval, Semidefinite
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.settings import Compliance
from pydantic import Field, field_validator

COMPLIANCE_SCALE_RAD_PER_NM = 0.05
CUBIC_SCALE_RAD_PER_NM3 = 0.05
_AXES = dict(zip("xyz", XYZ, strict=True))


class SiteSprings(JointEffect):
    """Springs of one law: at joints, and at the base where the settings say so.

    Attributes:
        letter: of the sites' parameters, before the number: 0 for the base, i for joint i.
    """

    letter: ClassVar[str]

    @property
    def sites(self) -> tuple[int, ...]:
        return (0, *self.joints) if getattr(self.settings, "base", False) else self.joints

    def springs(self, values: Mapping[str, Any]) -> tuple[Spring, ...]:
        return tuple(self.spring(site, values[f"{self.letter}{site}"]) for site in self.sites)

    def spring(self, site: int, value: Any) -> Spring:
        raise NotImplementedError


class TorsionalSpringSettings(EffectSettings):
    """Which joints have a spring about their axis, and whether the base has one."""

    base_axis: Literal["x", "y", "z"] | None = None
    compliance: Compliance = 0.0

    @field_validator("compliance")
    @classmethod
    def _physical(cls, value: float) -> float:
        if value < 0:
            raise ValueError(f"a compliance of {value:g} rad/(N m) is below zero: no spring pushes with its load")
        return value


class TorsionalSprings(SiteSprings):
    """The effect ``torsional_spring``: ``k1`` to ``kn`` about the joints' axes, ``k0`` at the base (rad/(N m)).

    The base's spring turns about an axis of the frame that carries joint 1, under the moment of everything
    about that frame's origin. The physical bound k >= 0 is part of the parameters' domain.
    """

    letter = "k"
    Settings = TorsionalSpringSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"base_axis": "y", "compliance_rad_per_Nm": 0.01}

    @property
    def sites(self) -> tuple[int, ...]:
        """Where a spring is: 0 for the base, i for joint i."""
        return (0, *self.joints) if self.settings.base_axis else self.joints

    def parameters(self) -> tuple[ParameterBlock, ...]:
        physical = Interval(lower=0.0)
        nominal = self.settings.compliance
        return tuple(
            scalar(f"k{site}", "rad_per_Nm", nominal, COMPLIANCE_SCALE_RAD_PER_NM, physical) for site in self.sites
        )

    def spring(self, site: int, value: Any) -> Spring:
        directions = () if site else (_AXES[self.settings.base_axis],)
        return Spring(site, directions, lambda load, command: value * load)


class CubicSprings(SiteSprings):
    """The effect ``cubic_spring``: ``c1`` to ``cn`` (rad/(N m)^3) times the third power of the torque about the axis.

    It stands beside a linear spring. A negative value is a spring that stiffens; alone it would push back.
    """

    letter = "c"

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return tuple(scalar(f"c{joint}", "rad_per_Nm3", 0.0, CUBIC_SCALE_RAD_PER_NM3) for joint in self.joints)

    def spring(self, site: int, value: Any) -> Spring:
        return Spring(site, (), lambda load, command: value * load * load * load)


class ComplianceSettings(EffectSettings):
    """Which joints give in all directions, whether the base does, and how much about every axis before any data.

    The compliance must be above zero where a matrix is fitted: a factor of it cannot leave zero.
    """

    base: bool = True
    compliance: Annotated[Compliance, Field(gt=0)] = 0.01


class Compliances(SiteSprings):
    """The effect ``compliance``: symmetric positive semidefinite matrices ``C0`` (base) and ``C1`` to ``Cn`` (rad/(N m)).

    The rotation vector of a site is its matrix times the moment of everything beyond about the site's origin, both
    in the site's frame: the mount's, and joint i's after its rotation. (Before its rotation joint 1's frame moves
    with the mount's, and only the sum of their matrices would be determined.)
    """  # noqa: E501

    letter = "C"
    Settings = ComplianceSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"compliance_rad_per_Nm": 0.02}

    def parameters(self) -> tuple[ParameterBlock, ...]:
        c = self.settings.compliance
        nominal, scale = (c, 0.0, 0.0, c, 0.0, c), COMPLIANCE_SCALE_RAD_PER_NM
        return tuple(ParameterBlock(f"C{site}", "rad_per_Nm", nominal, Semidefinite(), scale) for site in self.sites)

    def spring(self, site: int, value: Any) -> Spring:
        xx, xy, xz, yy, yz, zz = (value[i] for i in range(6))
        matrix = ca.vertcat(ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz))
        return Spring(site, XYZ, lambda moment, command: ca.mtimes(matrix, moment))
