"""Springs as numbers: the compliance of each site of an arm, and which springs are not linear."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from armcal.arm.assembly import scoped
from armcal.arm.effects import MOUNT, JointCommand, Spring
from armcal.arm.model import Chain
from armcal.base.domains import Array
from armcal.calibration.exporter import ExportRequest

_LOADS = (-3.0, -0.5, 0.1, 2.0)
_COMMANDS = ((0.0, 0.0), (0.7, 1.0), (-1.1, -1.0))
"""Commanded displacements (rad or m) and approaches."""
_LINEAR = 1e-12


@dataclass(frozen=True)
class SpringNumbers:
    """One spring.

    Attributes:
        effect: by which it came.
        site: 0 for the mount, i for joint i (from 1).
        axes: unit vectors in the site's frame, columns (3 x n); of a spring on a joint's own axis that axis.
        along: whether it gives along a sliding joint's own axis and not about it.
        compliance: of its coordinates under a small load at zero command (n x n; rad/(N m) or m/N).
        linear: whether that holds for every load and command.
    """

    effect: str
    site: int
    axes: Array
    along: bool
    compliance: Array
    linear: bool


def spring_numbers(request: ExportRequest, chain: Chain) -> tuple[SpringNumbers, ...]:
    """Every spring of an arm at its calibrated values; ``chain`` is the arm's."""
    values = {name: ca.SX(list(map(float, value))) for name, value in request.values.items()}
    numbers = []
    for name, effect in request.arm.effects.items():
        for spring in effect.springs(scoped(values, f"{request.name}.{name}.")):
            numbers.append(_numbers(name, spring, chain))
    return tuple(numbers)


def _numbers(effect: str, spring: Spring, chain: Chain) -> SpringNumbers:
    joint = chain.joints[spring.site - 1] if spring.site else None
    axes = np.array(spring.directions or ((joint.axis,) if joint else ()), dtype=float).T
    load, recorded = ca.SX.sym("load", spring.size), ca.SX.sym("recorded", 2)
    command = JointCommand(spring.site - 1, recorded[0], recorded[1]) if spring.site else MOUNT
    given = ca.densify(ca.SX(spring.law(load, command)))
    law = ca.Function("law", [load, recorded], [given, ca.densify(ca.jacobian(given, load))])
    compliance = np.asarray(law(np.zeros(spring.size), _COMMANDS[0])[1].full())
    linear = all(_follows(law, compliance, size, at) for size in _LOADS for at in _COMMANDS)
    along = not spring.directions and joint is not None and not joint.is_revolute
    return SpringNumbers(effect, spring.site, axes, along, compliance, linear)


def _follows(law: ca.Function, compliance: Array, size: float, command: tuple[float, float]) -> bool:
    load = size * np.arange(1.0, compliance.shape[0] + 1)
    given = np.asarray(law(load, command)[0].full()).ravel()
    return bool(np.allclose(given, compliance @ load, rtol=_LINEAR, atol=_LINEAR * float(np.abs(compliance).max())))
