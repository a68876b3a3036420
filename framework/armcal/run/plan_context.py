"""What a pose plan stands on: parameter values or draws of them, and the information that is there before."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.calibration.calibration import Calibration
from armcal.errors import ConfigError, ProblemError
from armcal.estimate.simulation import with_channels
from armcal.measure.groups import grouped_instances
from armcal.planning.candidates import over_draws, parameter_draws
from armcal.problem.problem import Problem, triangular
from armcal.run.experiment import Experiment
from armcal.run.plan_poses import JointSpace
from armcal.run.plan_settings import PlanSettings, RobustSettings


@dataclass(frozen=True)
class PlanContext:
    """What all steps of one plan stand on.

    Attributes:
        priors: as rows of information by coordinates in typical scales.
        draws: the value vectors at which information is taken.
        base: priors and given records at each draw, as R with R'R their information.
    """

    experiment: Experiment
    settings: PlanSettings
    space: JointSpace
    parameters: Parameters
    given: Dataset | None
    priors: Array
    draws: tuple[Array, ...] = ()
    base: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def about(self, draws: tuple[Array, ...]) -> PlanContext:
        """The same at these value vectors."""
        here = replace(self, draws=draws)
        if self.given is None:
            return replace(here, base=np.array([self.priors] * len(draws)))
        seen = [
            triangular(np.vstack([self.priors, part.reshape(-1, part.shape[-1])])) for part in here.rows(self.given)
        ]
        return replace(here, base=np.array(seen))

    def rows(self, dataset: Dataset) -> Array:
        """Whitened Jacobians at every draw (draws x n_r x N x n)."""
        records = as_if_measured(self.experiment, dataset)
        return over_draws(problem_of(self.experiment, self.parameters, records), self.draws, records)


def parameters_of(experiment: Experiment, calibration: Path | None) -> Parameters:
    """Those of the experiment, about the values of a calibration if one is given.

    Raises:
        ProblemError: nothing is free, or what is measured is a contact, which only few postures can be in.
        ConfigError: the calibration is of another arm.
    """
    parameters = experiment.parameters
    if touching := grouped_instances(experiment.system.measurements):
        raise ProblemError(
            f"{touching[0]} is a contact: poses that touch cannot be chosen from free space.",
            hint="Take postures up by hand, varied as docs/ball_and_sockets.md says; armcal identify tells what they "
            "determine, and what is missing.",
        )
    if not parameters.free:
        raise ProblemError("no parameter is free: there is nothing to plan for.", hint="Set parameters.free.")
    if calibration is None:
        return parameters
    found = Calibration.load(calibration, experiment.registry).parameters
    if found.entry_names != parameters.entry_names:
        differing = sorted(set(found.entry_names) ^ set(parameters.entry_names))
        raise ConfigError(
            f"the calibration has other parameters: {', '.join(differing[:3]) or 'their order differs'}.",
            hint="Give a calibration of the same arm.",
        )
    return parameters.with_nominal(found.nominal())


def problem_of(experiment: Experiment, parameters: Parameters, dataset: Dataset) -> Problem:
    """Compiled for a dataset's channels."""
    system, evaluator = experiment.system, experiment.settings.evaluator
    return Problem.build(system.arms, system.measurements, parameters, system.environment, dataset, evaluator)


def as_if_measured(experiment: Experiment, dataset: Dataset) -> Dataset:
    """Poses with the channels of all that would be measured there; which numbers they hold does not matter."""
    measured = [f"{name}.{c.name}" for name, m in experiment.system.measurements.items() for c in m.channels()]
    missing = [channel for channel in measured if channel not in dataset.channels]
    return with_channels(dataset, {channel: np.zeros(len(dataset)) for channel in missing})


def plan_context(
    experiment: Experiment, settings: PlanSettings, space: JointSpace, parameters: Parameters, given: Dataset | None
) -> PlanContext:
    """Priors and given records as information, at the nominal values."""
    scales, prior = parameters.scales(), parameters.prior_information()
    held = np.diag(scales * np.sqrt(prior))[prior > 0]
    return PlanContext(experiment, settings, space, parameters, given, held).about((parameters.nominal(),))


def draws_of(experiment: Experiment, robust: RobustSettings, parameters: Parameters) -> tuple[Array, ...]:
    """Value vectors from the priors."""
    if not parameters.prior_information().any():
        raise ConfigError(
            "found plan.robust and no prior on a free parameter: there is nothing to be robust against.",
            where=experiment.source.where(("plan", "robust")),
            hint="Give parameters.priors, or leave plan.robust out.",
        )
    return tuple(parameter_draws(parameters, robust.draws, robust.seed))
