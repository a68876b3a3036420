"""Fixed parameters that the records of an experiment would rather have free, confirmed on records held out."""

from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array
from armcal.diagnose.fit import Prepared
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.identifiability import candidates, freeing
from armcal.estimate.robust import fit
from armcal.estimate.validation import cross_validate, error_unit, folds
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal.run.pipeline import acting

_FOLDS = 5
_MOST_STEPS = 6
_STANDARD_ERRORS, _LEAST_GAIN = 2.6, 0.01
"""What a gain on records held out must be: in its standard errors, and of the error."""


@dataclass(frozen=True)
class FreedStep:
    """A fixed parameter, freed beside those before it; ``error`` is the mean of records held out (None: not judged)."""

    name: str
    unit: str
    change: tuple[float, ...]  # of its coordinates, to first order (SI)
    sd: tuple[float, ...]
    p_value: float
    error: float | None  # in the unit of errors
    recommended: bool


@dataclass(frozen=True)
class FixedParameters:
    """What fixed parameters would gain, as JSON has it."""

    unit: str  # of errors
    error: float | None  # mean error of records held out, as configured
    gaining: tuple[FreedStep, ...]  # parameters that explain residuals, in the order in which they are freed
    recommended: tuple[str, ...]  # to be freed: none if held-out errors do not fall by more than chance, and by 1 %
    determined_and_nothing_gained: tuple[str, ...]


def fixed_parameters(experiment: Experiment, ready: Prepared, progress: Progress = no_progress) -> FixedParameters:
    """Fit with what is configured, look for what it leaves, and cross-validate what is found."""
    parameters = ready.problem.parameters
    # The problem with every candidate free, too: functions for whatever is chosen of them.
    system, own = experiment.system, [block.name for block in parameters.free]
    freer = parameters.with_free([*own, *candidates(parameters)])
    groups, evaluator = ready.problem.blueprint.groups, experiment.settings.evaluator
    built = (system.arms, system.measurements, freer, system.environment, ready.dataset, evaluator, groups)
    wide = Problem.build(*built)
    train = ready.split.train
    wide = acting(wide, ready.dataset).subset(train)
    start = next(iter(ready.start.values(ready.problem)), parameters.nominal())
    fitted = fit(wide.with_parameters(parameters), experiment.estimator, start, progress)
    values = fitted.solution.values
    gaining, others = freeing(wide.with_records(fitted.problem.records), own, values)
    determined = tuple(one.name for one in others)
    unit = error_unit(ready.problem)
    if not gaining:
        return FixedParameters(unit, None, (), (), determined)
    splits = folds(len(train), _FOLDS, 0, experiment.poses(ready.dataset.subset(train)))
    names = [one.name for one in gaining]

    def errors_with(count: int) -> Array:
        problem = wide.with_parameters(parameters.with_free([*own, *names[:count]]))
        return cross_validate(problem, splits, experiment.estimator, values, progress).errors

    counts = sorted({*range(min(len(names), _MOST_STEPS) + 1), len(names)})
    errors, best = {count: errors_with(count) for count in counts}, 0
    for count in counts[1:]:
        gains = errors[best] - errors[count]
        chance = _STANDARD_ERRORS * float(np.std(gains)) / np.sqrt(len(gains))
        if np.mean(gains) > max(chance, _LEAST_GAIN * float(np.mean(errors[best]))):
            best = count
    means = {count: 1000 * float(np.mean(error)) for count, error in errors.items()}
    steps = []
    for i, one in enumerate(gaining, 1):
        numbers = (tuple(one.change.tolist()), tuple(one.sd.tolist()), one.p_value)
        steps.append(FreedStep(one.name, parameters[one.name].unit, *numbers, means.get(i), i <= best))
    return FixedParameters(unit, means[0], tuple(steps), tuple(names[:best]), determined)
