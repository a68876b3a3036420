"""What a pose plan stands on: parameter values, and the information there is before; its order."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from armcal.arm.loading import holding_efforts
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.calibration.calibration import Calibration
from armcal.errors import ConfigError, ProblemError
from armcal.estimate.simulation import with_channels
from armcal.measure.groups import grouped_instances
from armcal.planning.candidates import whitened_rows
from armcal.planning.visit import cool_order, heat, path_time, peak, quick_order, travel_times
from armcal.problem.problem import Problem, triangular
from armcal.run.experiment import Experiment
from armcal.run.plan_poses import JointSpace
from armcal.run.settings import PlanSettings

_SPEEDS = {"angle": np.deg2rad(60.0), "length": 0.05}


@dataclass(frozen=True)
class PlanContext:
    """What all steps of one plan stand on."""

    experiment: Experiment
    settings: PlanSettings
    space: JointSpace
    parameters: Parameters
    given: Dataset | None
    priors: Array  # as rows of information by coordinates in typical scales

    @cached_property
    def base(self) -> Array:
        """Priors and given records, as R with R'R their information."""
        if self.given is None:
            return self.priors
        rows = self.rows(self.given)
        return triangular(np.vstack([self.priors, rows.reshape(-1, rows.shape[-1])]))

    def rows(self, dataset: Dataset) -> Array:
        """Whitened Jacobians (n_r x N x n)."""
        records = as_if_measured(self.experiment, dataset)
        problem = problem_of(self.experiment, self.parameters, records)
        return whitened_rows(problem, self.parameters.nominal(), records)


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
            hint="Take postures up by hand, varied as docs/ball_and_sockets.md says; armcal identify names what they "
            "determine, and what is missing.",
        )
    if not parameters.free:
        raise ProblemError("no parameter is free: there is nothing to plan for.", hint="Set parameters.free.")
    return values_about(experiment, calibration)


def values_about(experiment: Experiment, calibration: Path | None) -> Parameters:
    """An experiment's parameters, at the values of a calibration if one is given.

    Raises:
        ConfigError: the calibration is of another arm.
    """
    parameters = experiment.parameters
    if calibration is None:
        return parameters
    calibrated = Calibration.load(calibration, experiment.registry).parameters
    if calibrated.entry_names != parameters.entry_names:
        differing = sorted(set(calibrated.entry_names) ^ set(parameters.entry_names))
        raise ConfigError(
            f"the calibration has other parameters: {', '.join(differing[:3]) or 'their order differs'}.",
            hint="Give a calibration of the same arm.",
        )
    return parameters.with_nominal(calibrated.nominal())


def problem_of(experiment: Experiment, parameters: Parameters, dataset: Dataset) -> Problem:
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
    priors = np.diag(scales * np.sqrt(prior))[prior > 0]
    return PlanContext(experiment, settings, space, parameters, given, priors)


def in_order_of_visit(
    context: PlanContext, chosen: Dataset, *, keeps_approaches: bool = False
) -> tuple[Dataset, float, float | None]:
    """The poses in the order of visit, the time that takes (s), and the peak of the torque's moving average.

    Ids are unique where a pose is repeated; approaches are what this order makes them, unless planned ones are kept.
    """
    settings, space, environment = context.settings, context.space, context.experiment.system.environment
    angles = chosen.stacked(space.channels)
    given = space.by_joint(
        {n: [np.deg2rad(v)] for n, v in settings.speeds_deg_per_s.items()},
        {n: [v / 1000] for n, v in settings.speeds_mm_per_s.items()},
        ("speeds_deg_per_s", "speeds_mm_per_s"),
    )
    speeds = [given.get(n, np.array([_SPEEDS[d]])) for n, d in zip(space.names, space.dimensions, strict=True)]
    load = environment.gravity, environment.payload_mass, environment.payload_com
    efforts = [
        holding_efforts(arm, chosen.stacked([*arm.command_channels]), *load)
        for arm in context.experiment.system.arms.values()
    ]
    times, heats = travel_times(angles, np.concatenate(speeds)), heat(np.concatenate(efforts))
    if settings.order == "travel":
        order = quick_order(times)
    else:
        order = cool_order(heats, times) if settings.order == "torque" else np.arange(len(chosen))
    visited = chosen.subset(order)
    copies: Counter[str] = Counter()
    ids: list[str] = []
    for record in visited.ids:
        copies[record] += 1
        ids.append(record if copies[record] == 1 else f"{record}_{copies[record]}")
    numbers = tuple(str(i) for i in range(1, len(ids) + 1))
    by_order = _approaches(visited, space)
    channels = by_order | dict(visited.channels) if keeps_approaches else dict(visited.channels) | by_order
    visited = replace(visited, ids=tuple(ids), channels=channels, extra={"order": numbers})
    return visited, path_time(times, order), peak(heats, order) if heats.any() else None


def _approaches(visited: Dataset, space: JointSpace) -> dict[str, Array]:
    """The sign of each joint's last motion before each pose (N), 0 before its first."""
    approaches = {}
    for channel in space.channels:
        command, (arm, _, joint) = visited.column(channel), channel.partition(".")
        signs = np.sign(np.diff(command, prepend=command[:1]))
        moved = np.maximum.accumulate(np.where(signs != 0, np.arange(len(signs)), 0))
        approaches[f"{arm}.approach.{joint}"] = signs[moved]
    return approaches
