"""The elastic arm of configs/lrm_arm with simulated data, as armcal's own classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.estimate.estimator import Solution
from armcal.estimate.simulation import SimulationRequest
from armcal.functions.batch_function import EvaluatorChoice
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment

CONFIGS = Path(__file__).parents[1] / "configs" / "lrm_arm"


@dataclass(frozen=True)
class Case:
    """A calibration to do, and the truth its data was made from (every canonical entry)."""

    experiment: Experiment
    parameters: Parameters
    dataset: Dataset
    truth: Array

    def problem(self, evaluator: EvaluatorChoice) -> Problem:
        """Its kernels."""
        system = self.experiment.system
        return Problem.build(
            system.arms, system.measurements, self.parameters, system.environment, self.dataset, evaluator
        )

    def solve(self, problem: Problem) -> Solution:
        """The configured fit from nominal values, every equilibrium cold."""
        problem = problem.of(self.dataset)
        return self.experiment.estimator.solve(problem, self.parameters.nominal())


def simulated(records: int, also_free: Sequence[str] = ()) -> Case:
    """Option 1 (28 parameters) on random poses of the simulated arm, 0.5 mm of noise."""
    poses = ["simulation.poses.kind=random", f"simulation.poses.count={records}"]
    experiment = Experiment.load(CONFIGS / "demo.yaml", poses)
    free = [block.name for block in experiment.parameters.free]
    parameters = experiment.parameters.with_free([*free, *also_free])
    system = experiment.system
    request = SimulationRequest(system.arms, system.measurements, parameters, system.environment)
    stated = load_config(CONFIGS / "truth.yaml")
    truth = with_values(parameters, stated.data, stated, ()).nominal()
    return Case(experiment, parameters, experiment.simulator().simulate(request), truth)
