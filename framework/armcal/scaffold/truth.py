"""A truth to try a new robot with: errors of the size that drawings and assemblies have, from a fixed seed."""

import fnmatch
import math
from collections.abc import Mapping

import numpy as np

from armcal.base.arrays import Array
from armcal.base.domains import Rotation
from armcal.base.parameters import Parameters
from armcal.base.units import shown_unit
from armcal.scaffold.rendering import number
from armcal.scaffold.robot import Unit

SEED = 1
LENGTH_SD_M, ANGLE_SD_RAD = 0.001, 0.003
SAG_RAD = 0.002
"""What a joint gives under half the moment that the arm's whole weight has at its full reach."""
UNSTATED_TARGET = {"tracker.target_x": 0.06, "tracker.target_y": -0.04, "tracker.target_z": 0.03}
"""Of the reach: where a target sits whose place was not stated. Most sit beside the last axis, and show more there."""
_MOST_SD = 2.0
_SPRING = (0.5, 1.5)
_UNITS = frozenset({"m", "rad", "rad_per_Nm"})


def candidates(parameters: Parameters) -> tuple[str, ...]:
    """What a first calibration may look for: placement, geometry, springs, the target; no masses, no gravity."""
    return tuple(
        block.name
        for block in parameters.blocks
        if block.unit in _UNITS
        and (block.size == 1 or isinstance(block.domain, Rotation))
        and not fnmatch.fnmatch(block.name, "arm.links.*")
        and not block.name.startswith("statics.")
    )


def made_up(
    parameters: Parameters, load_Nm: float, target: Mapping[str, float], widths: Mapping[Unit, float]
) -> dict[str, float]:
    """True values (SI) of every candidate that is one number; a rotation stays as it was stated.

    Args:
        parameters: of the robot, with their nominal values.
        load_Nm: the moment of its whole weight at its full reach; 0 if its masses are not known.
        target: how far parameters of the target are off beside that (m).
        widths: of the priors, by unit: errors are no larger.
    """
    random = np.random.default_rng(SEED)
    deviations = {"m": min(LENGTH_SD_M, 1e-3 * widths["mm"]), "rad": min(ANGLE_SD_RAD, math.radians(widths["deg"]))}
    names = [name for name in candidates(parameters) if parameters[name].size == 1]
    values = {}
    for name in names:
        block = parameters[name]
        if block.unit == "rad_per_Nm":
            drawn = float(random.uniform(*_SPRING))
            error = drawn * SAG_RAD / (0.5 * load_Nm) if load_Nm > 0 else 0.0
        else:
            error = deviations[block.unit] * float(np.clip(random.normal(), -_MOST_SD, _MOST_SD))
        values[name] = float(block.nominal[0]) + error + target.get(name, 0.0)
    return values


def as_text(parameters: Parameters, values: Mapping[str, float]) -> dict[str, str]:
    lines = {}
    for name, value in values.items():
        factor, unit = shown_unit(parameters[name].unit)
        lines[name] = f"{number(float(f'{factor * value:.6g}'))} {unit}"
    return lines


def reach(tips: Array) -> float:
    """How far a tip comes from the middle of where it goes (3 x N, m)."""
    middle = tips.mean(axis=1, keepdims=True)
    return float(np.linalg.norm(tips - middle, axis=0).max())
