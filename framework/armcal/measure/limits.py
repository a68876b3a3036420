"""Commands beyond the limits that an arm model states: a sign of joints out of order, or of other signs or units."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit

TOLERANCE = {"angle": 1e-3, "length": 1e-4}
"""How far beyond a limit (rad, m) a command may be: limits are often rounded."""


def warn_beyond_limits(dataset: Dataset, arms: Mapping[str, Arm]) -> Dataset:
    """The dataset, with a warning for all joints that were commanded beyond their limits."""
    texts = [text for name, arm in arms.items() for text in _beyond(dataset, name, arm, len(arms) == 1)]
    if not texts:
        return dataset
    text = f"{'; '.join(texts)}: check the joints' order, signs and units."
    return replace(dataset, warnings=(*dataset.warnings, text))


def _beyond(dataset: Dataset, name: str, arm: Arm, alone: bool) -> list[str]:
    channels = [f"{name}.{joint}" for joint in arm.commanded]
    if not len(dataset) or not all(map(dataset.has, channels)):
        return []
    commands = arm.joint_commands([dataset.column(channel) for channel in channels])
    texts = []
    for joint, dimension, angles in zip(arm.nominal_chain.joints, arm.joint_dimensions, commands, strict=True):
        if joint.limits is None:
            continue
        over = np.maximum(joint.limits[0] - angles, angles - joint.limits[1])  # below zero inside
        over = np.nan_to_num(over, nan=-np.inf, neginf=-np.inf)
        count = int(np.sum(over > TOLERANCE[dimension]))
        if count:
            unit = display_unit(dimension).name
            low, high, worst = (to_unit(x, unit) for x in (*joint.limits, float(angles[int(np.argmax(over))])))
            shown = joint.name if alone else f"{name}.{joint.name}"
            limits = f"limits {low:.4g} to {high:.4g} {unit}"
            texts.append(f"{shown} is beyond its {limits} in {count} of {len(dataset)} records, at worst {worst:.4g}")
    return texts
