"""What acts on all arms of a cell: gravity, payload and wrench, and how the real gravity is turned."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import casadi as ca

from armcal.arm.model import Vector3
from armcal.arm.statics import Load
from armcal.base import se3
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.se3 import Expression

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
    def acting(self) -> tuple[float, ...]:
        return (*self.gravity, self.payload_mass, *self.payload_com, *self.force, *self.torque)

    @property
    def load(self) -> Load:
        return Load.of([ca.SX(number) for number in self.acting])


def gravity_tilt() -> tuple[ParameterBlock, ...]:
    """How the real gravity is turned from the stated one, about the base frame's x and y axes (rad)."""
    return tuple(scalar(f"{STATICS}.gravity_{axis}", "rad", 0.0, 0.02) for axis in ("rx", "ry"))


def unstated_payload() -> tuple[ParameterBlock, ...]:
    """What hangs on the tool beyond what is stated: its mass (kg), its first moments in the tool frame (kg m)."""
    moments = (scalar(f"{STATICS}.payload_moment_{axis}", "kg_m", 0.0, 0.005) for axis in "xyz")
    return scalar(f"{STATICS}.payload", "kg", 0.0, 0.1), *moments


def tilted(load: Load, values: Mapping[str, Expression]) -> Load:
    """A load under the real gravity.

    ``values`` are those of ``gravity_tilt``, and those of ``unstated_payload`` where it is followed, by local
    name; or nothing.
    """
    if not values:
        return load
    about_x, about_y = (se3.rotation_about(axis, values[f"gravity_r{axis}"]).rotation for axis in "xy")
    real = replace(load, gravity=ca.mtimes(about_y, ca.mtimes(about_x, load.gravity)))
    if "payload" not in values:
        return real
    return replace(real, beyond=(values["payload"], ca.vertcat(*(values[f"payload_moment_{axis}"] for axis in "xyz"))))
