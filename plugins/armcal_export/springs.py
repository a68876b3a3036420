"""Springs as numbers: the compliance of each site of an arm, and which springs are not linear."""

import casadi as ca
import numpy as np
from armcal.arm.assembly import scoped
from armcal.arm.effects import MOUNT, JointCommand, Spring
from armcal.arm.model import Chain
from armcal.base.domains import Array
from armcal.calibration.exporter import ExportRequest

from armcal_export.description import SpringEntry

_LOADS = (-3.0, -0.5, 0.1, 2.0)
_COMMANDS = ((0.0, 0.0), (0.7, 1.0), (-1.1, -1.0))
"""Commanded displacements (rad or m) and approaches."""
_LINEAR = 1e-12


def spring_entries(request: ExportRequest, chain: Chain) -> list[SpringEntry]:
    """Every spring of an arm at its calibrated values; ``chain`` is the arm's."""
    values = {name: ca.SX(list(map(float, value))) for name, value in request.values.items()}
    return [
        _entry(name, spring, chain)
        for name, effect in request.arm.effects.items()
        for spring in effect.springs(scoped(values, f"{request.name}.{name}."))
    ]


def _entry(effect: str, spring: Spring, chain: Chain) -> SpringEntry:
    """A spring; one without directions gives about or along its joint's own axis."""
    joint = chain.joints[spring.site - 1] if spring.site else None
    axes = np.array(spring.directions or ((joint.axis,) if joint else ()), dtype=float)
    load, recorded = ca.SX.sym("load", spring.size), ca.SX.sym("recorded", 2)
    command = JointCommand(spring.site - 1, recorded[0], recorded[1]) if spring.site else MOUNT
    given = ca.densify(ca.SX(spring.law(load, command)))
    law = ca.Function("law", [load, recorded], [given, ca.densify(ca.jacobian(given, load))])
    compliance = np.asarray(law(np.zeros(spring.size), _COMMANDS[0])[1].full())
    return SpringEntry(
        effect=effect,
        site=spring.site,
        axes=axes.tolist(),
        along=not spring.directions and joint is not None and not joint.is_revolute,
        compliance=compliance.tolist(),
        linear=all(_follows(law, compliance, size, at) for size in _LOADS for at in _COMMANDS),
    )


def _follows(law: ca.Function, compliance: Array, size: float, command: tuple[float, float]) -> bool:
    load = size * np.arange(1.0, compliance.shape[0] + 1)
    given = np.asarray(law(load, command)[0].full()).ravel()
    return bool(np.allclose(given, compliance @ load, rtol=_LINEAR, atol=_LINEAR * float(np.abs(compliance).max())))
