"""What a tracker would see of servos' sweeps, on an arm whose tables, springs and axes are planted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from armcal.arm.effects import JointEffect
from armcal.base.dataset import Dataset
from armcal.measure.measurement import ArmsAlone
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment


class ElasticArm:
    """An experiment's only arm in elastic equilibrium, at its parameters' nominal values or others."""

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        (arm,) = experiment.system.arms.values()
        springs = {n: e for n, e in arm.effects.items() if type(e).springs is not JointEffect.springs}
        self.arm = replace(arm, effects=springs)
        own = [block for block in experiment.parameters.blocks if block.name.startswith(f"{self.arm.name}.")]
        scope = f"{self.arm.name}.{self.arm.model_name}."
        self.angles = [b.name for b in own if b.unit == "rad" and b.size == 1 and b.name.startswith(scope)]
        self.compliances = [b.name for b in own if b.unit == "rad_per_Nm" and b.size == 1]

    def tools(self, poses: Sequence[Mapping[str, float]], changes: Mapping[str, float] | None = None) -> np.ndarray:
        """``base_T_tool`` (N x 4 x 4), with other values of some angles and compliances."""
        parameters, values = self._problem.parameters, self._problem.parameters.nominal()
        for name, value in (changes or {}).items():
            values[parameters.entries_of(name)] = value
        shown = self._problem.of(self._dataset(poses)).predict(values)[0]
        tools = np.tile(np.eye(4), (len(poses), 1, 1))
        tools[:, :3] = shown.tools[0].transpose(2, 1, 0)[: len(poses)]
        return tools

    def compliance(self, name: str) -> float:
        """A spring's (rad/(N m))."""
        return self.experiment.parameters[name].nominal[0]

    def _dataset(self, poses: Sequence[Mapping[str, float]]) -> Dataset:
        joints = list(self.arm.commanded)
        channels = {f"{self.arm.name}.{j}": np.array([float(pose.get(j, 0.0)) for pose in poses]) for j in joints}
        return Dataset(tuple(map(str, range(len(poses)))), channels)

    @cached_property
    def _problem(self) -> Problem:
        arms, system = {self.arm.name: self.arm}, self.experiment.system
        tool = {"tool": ArmsAlone((self.arm.name,))}
        parameters = self.experiment.parameters.with_free((*self.angles, *self.compliances))
        return Problem.build(arms, tool, parameters, system.environment, self._dataset([{}]), "interpreted")


def pose_line(
    joint: str, counts: int, came: int, pose: np.ndarray, told: Mapping[str, float], **more: Any
) -> dict[str, Any]:
    """An entry of a record."""
    rotation = None if np.isnan(pose[0, 0]) else pose[:3, :3].tolist()
    line = {"kind": "pose", "joint": joint, "counts": counts, "came": came, "position": pose[:3, 3].tolist()}
    line |= {"rotation": rotation, "deviations": [1e-4] * 3 + [math.radians(0.01)] * 3, "told": dict(told)}
    return {**line, **more}


def loaded(folder: Path, config: Mapping[str, Any]) -> Experiment:
    """An experiment from content."""
    import yaml

    path = folder / "arm.yaml"
    path.write_text(yaml.safe_dump(dict(config)), encoding="utf-8")
    return Experiment.load(path)
