"""Where an arm may go: joint limits and clearance, as the ``plan`` section of a configuration states them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from armcal.calibration.compensation.finder import Allowed
from armcal.errors import ConfigError, Location
from armcal.plugins import PluginRegistry
from armcal.run.experiment import Experiment
from armcal.run.plan_clearance import clearance_check
from armcal.run.plan_poses import JointSpace


@dataclass(frozen=True)
class Workspace:
    """Limits by joint (rad or m), and from commands (n x N) to whether nothing is too near (N); None: all may be."""

    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    allowed: Allowed | None = None


def workspace_of(path: Path, joints: Sequence[str], registry: PluginRegistry) -> Workspace:
    """What a configuration's ``plan`` says of an arm with these joints.

    Raises:
        ConfigError: it has no plan, or plans for another arm.
    """
    experiment = Experiment.load(path, registry=registry)
    plan = experiment.settings.plan
    if plan is None:
        raise ConfigError(
            "found no plan, expected its limits and clearance.",
            where=Location(str(path)),
            hint="Add plan: {limits: {q1: [-100 deg, 100 deg], ...}}.",
        )
    space = JointSpace.of(experiment)
    if space.names != tuple(joints):
        raise ConfigError(
            f"its joints are {', '.join(space.names)}, those of the calibration {', '.join(joints)}.",
            where=Location(str(path)),
            hint="Give the configuration of the same arm.",
        )
    stated = zip(space.names, space.limits(plan), strict=True)
    limits = {name: (float(low), float(high)) for name, (low, high) in stated if np.isfinite([low, high]).any()}
    if plan.clearance is None:
        return Workspace(limits)
    check = clearance_check(plan.clearance, experiment.system.arms, experiment.source)
    return Workspace(limits, lambda commands: check(commands).allowed)
