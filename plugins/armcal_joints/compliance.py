"""A 3x3 compliance at the base and at each joint, under the full moment that the site carries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import casadi as ca
from armcal.arm.effects import XYZ, EffectSettings, JointEffect, Spring
from armcal.base.domains import Semidefinite
from armcal.base.parameters import ParameterBlock
from armcal.base.settings import Compliance
from pydantic import field_validator

from armcal_joints.springs import COMPLIANCE_SCALE_RAD_PER_NM


class ComplianceSettings(EffectSettings):
    """Which joints give in all directions, whether the base does, and how much about every axis before any data.

    The compliance must be above zero where a matrix is fitted: a factor of it cannot leave zero.
    """

    base: bool = True
    compliance: Compliance = 0.01

    @field_validator("compliance")
    @classmethod
    def _physical(cls, value: float) -> float:
        if value <= 0:
            raise ValueError(f"a compliance of {value:g} rad/(N m) is not above zero")
        return value


class Compliances(JointEffect):
    """The effect ``compliance``: symmetric positive semidefinite matrices ``C0`` (base) and ``C1`` to ``Cn`` (rad/(N m)).

    The rotation vector of a site is its matrix times the moment of everything beyond about the site's origin, both
    in the site's frame: the mount's, and joint i's after its rotation. (Before its rotation joint 1's frame moves
    with the mount's, and only the sum of their matrices would be determined.)
    """  # noqa: E501

    Settings = ComplianceSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"compliance_rad_per_Nm": 0.02}

    @property
    def sites(self) -> tuple[int, ...]:
        """Where a matrix is: 0 for the base, i for joint i."""
        return (0, *self.joints) if self.settings.base else self.joints

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """One matrix a site."""
        c = self.settings.compliance
        nominal, scale = (c, 0.0, 0.0, c, 0.0, c), COMPLIANCE_SCALE_RAD_PER_NM
        return tuple(ParameterBlock(f"C{site}", "rad_per_Nm", nominal, Semidefinite(), scale) for site in self.sites)

    def springs(self, values: Mapping[str, Any]) -> tuple[Spring, ...]:
        """Three coordinates a site."""
        return tuple(self._spring(site, values[f"C{site}"]) for site in self.sites)

    def _spring(self, site: int, entries: Any) -> Spring:
        xx, xy, xz, yy, yz, zz = (entries[i] for i in range(6))
        matrix = ca.vertcat(ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz))
        return Spring(site, XYZ, lambda moment, command: ca.mtimes(matrix, moment))
