"""Corrections of joints and tools that records carry: what an arm's pose residual has learned of their commands.

They depend on what was commanded alone, so they are made once, in batches, and no expression holds what was learned.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.pose_residual import Postures, correction_names
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.problem.factor import CORRECTION


def correction_channels(arm: Arm) -> tuple[str, ...]:
    """Of an arm's tool and joints (see ``arm/pose_residual.py``)."""
    return tuple(f"{arm.name}.{CORRECTION}{name}" for name in correction_names(arm.joint_names))


def with_corrections(dataset: Dataset, arms: Mapping[str, Arm]) -> Dataset:
    """The records with corrections of the arms that have a pose residual: zero where it has not learned."""
    channels = dict(dataset.channels)
    for arm in arms.values():
        names = correction_channels(arm)
        if arm.residual is not None and arm.residual.is_learned:
            channels |= zip(names, arm.residual.corrections(postures_of(arm, dataset)), strict=True)
        elif arm.residual is not None:
            channels |= dict.fromkeys(names, np.zeros(len(dataset)))
    return replace(dataset, channels=channels) if len(channels) > len(dataset.channels) else dataset


def postures_of(arm: Arm, dataset: Dataset) -> Postures:
    """Where all joints were commanded to go, those that follow others too, and from where they came."""
    nothing = np.zeros(len(dataset))

    def column(channel: str) -> Array:
        return np.nan_to_num(dataset.column(channel)) if dataset.has(channel) else nothing

    commands = [column(f"{arm.name}.{joint}") for joint in arm.commanded]
    approaches = [column(f"{arm.name}.approach.{joint}") for joint in arm.commanded]
    return Postures(np.array(arm.joint_commands(commands)), np.array(arm.joint_approaches(approaches)))
