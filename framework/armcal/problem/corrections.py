"""Corrections of joints and tools that records carry: what an arm's pose residual has learned of their commands.

They depend on what was commanded alone, so they are made once, in batches, and no expression holds what was learned.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.environment import Environment
from armcal.arm.pose_residual import SURROUNDINGS, Postures, correction_names
from armcal.base.dataset import Dataset
from armcal.base.domains import Array


def correction_channels(arm: Arm) -> tuple[str, ...]:
    """Of an arm's tool and joints (see ``arm/pose_residual.py``)."""
    return tuple(f"{arm.name}.{name}" for name in correction_names(arm.joint_names))


def with_corrections(dataset: Dataset, arms: Mapping[str, Arm], environment: Environment) -> Dataset:
    """The records with corrections of the arms that have a pose residual: zero where it has not learned."""
    channels = dict(dataset.channels)
    for arm in arms.values():
        names = correction_channels(arm)
        if arm.residual is not None and arm.residual.is_learned:
            channels |= zip(names, arm.residual.corrections(postures_of(arm, dataset, environment)), strict=True)
        elif arm.residual is not None:
            channels |= dict.fromkeys(names, np.zeros(len(dataset)))
    return replace(dataset, channels=channels) if len(channels) > len(dataset.channels) else dataset


def postures_of(arm: Arm, dataset: Dataset, environment: Environment) -> Postures:
    """Where all joints were commanded to go, those that follow others too, and from where, and what was around."""
    stated = {"payload": environment.payload_mass}

    def column(channel: str) -> Array:
        default = np.full(len(dataset), stated.get(channel, 0.0))
        return np.nan_to_num(dataset.column(channel)) if dataset.has(channel) else default

    commands = [column(f"{arm.name}.{joint}") for joint in arm.commanded]
    approaches = [column(f"{arm.name}.approach.{joint}") for joint in arm.commanded]
    around = {name: column(name) for name in SURROUNDINGS if name in stated or dataset.has(name)}
    return Postures(np.array(arm.joint_commands(commands)), np.array(arm.joint_approaches(approaches)), around)
