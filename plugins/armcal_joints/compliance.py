"""A 3x3 compliance at the base and at each joint, under the full moment that the site carries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import casadi as ca
from armcal.arm.effects import JointCommand, Spring
from armcal.base.domains import Semidefinite
from armcal.base.parameters import ParameterBlock
from armcal.base.settings import Compliance, Settings
from pydantic import field_validator

from armcal_joints.joints import JointChoice, chosen
from armcal_joints.springs import COMPLIANCE_SCALE_RAD_PER_NM

_XYZ = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class ComplianceSettings(Settings):
    """Which joints give in all directions, whether the base does, and how much about every axis before any data.

    The compliance must be above zero where a matrix is fitted: a factor of it cannot leave zero.
    """

    joints: JointChoice = "all"
    base: bool = True
    compliance: Compliance = 0.01

    @field_validator("compliance")
    @classmethod
    def _physical(cls, value: float) -> float:
        if value <= 0:
            raise ValueError(f"a compliance of {value:g} rad/(N m) is not above zero")
        return value


class Compliances:
    """The effect ``compliance``: symmetric positive semidefinite matrices ``C0`` (base) and ``C1`` to ``Cn`` (rad/(N m)).

    The rotation vector of a site is its matrix times the moment of everything beyond about the site's origin, both
    in the site's frame: the mount's, and joint i's after its rotation. (Before its rotation joint 1's frame moves
    with the mount's, and only the sum of their matrices would be determined.)
    """  # noqa: E501

    Settings: ClassVar[type[ComplianceSettings]] = ComplianceSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"compliance_rad_per_Nm": 0.02}

    def __init__(self, settings: ComplianceSettings, joint_names: Sequence[str]) -> None:
        self._settings = settings
        base = (0,) if settings.base else ()
        self._sites = (*base, *chosen(settings.joints, joint_names))

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """One matrix a site."""
        c = self._settings.compliance
        nominal, scale = (c, 0.0, 0.0, c, 0.0, c), COMPLIANCE_SCALE_RAD_PER_NM
        return tuple(ParameterBlock(f"C{site}", "rad_per_Nm", nominal, Semidefinite(), scale) for site in self._sites)

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        """Nothing: a spring acts through its load alone."""
        return 0

    def springs(self, values: Mapping[str, Any]) -> tuple[Spring, ...]:
        """Three coordinates a site."""
        return tuple(self._spring(site, values[f"C{site}"]) for site in self._sites)

    def _spring(self, site: int, entries: Any) -> Spring:
        xx, xy, xz, yy, yz, zz = (entries[i] for i in range(6))
        matrix = ca.vertcat(ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz))
        return Spring(site, _XYZ, lambda moment: ca.mtimes(matrix, moment))
