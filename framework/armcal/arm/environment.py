"""What acts on all arms of a cell: gravity, payload and wrench, and how the real gravity is turned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca

from armcal.arm.statics import Load
from armcal.base import se3
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.se3 import Expression

Vector3 = tuple[float, float, float]
_ZERO: Vector3 = (0.0, 0.0, 0.0)
STATICS = "statics"
"""The instance name of what acts on all arms."""


@dataclass(frozen=True)
class Environment:
    """What acts on the arms where a record does not say: gravity (m/s^2), payload (kg, m), wrench (N, N m)."""

    gravity: Vector3
    payload_mass: float = 0.0
    payload_com: Vector3 = _ZERO
    force: Vector3 = _ZERO
    torque: Vector3 = _ZERO

    @property
    def load(self) -> Load:
        """As constant expressions."""
        gravity, com, force, torque = (
            ca.SX(list(vector)) for vector in (self.gravity, self.payload_com, self.force, self.torque)
        )
        return Load(gravity, ca.SX(self.payload_mass), com, force, torque)


def gravity_tilt() -> tuple[ParameterBlock, ...]:
    """How the real gravity is turned from the stated one, about the base frame's x and y axes (rad)."""
    return tuple(scalar(f"{STATICS}.gravity_{axis}", "rad", 0.0, 0.02) for axis in ("rx", "ry"))


def tilted(load: Load, tilt: Mapping[str, Expression]) -> Load:
    """A load under the real gravity; ``tilt`` has the values of ``gravity_tilt`` by local name, or nothing."""
    if not tilt:
        return load
    about_x, about_y = (se3.rotation_about(axis, tilt[f"gravity_r{axis}"]).rotation for axis in "xy")
    return replace(load, gravity=ca.mtimes(about_y, ca.mtimes(about_x, load.gravity)))
