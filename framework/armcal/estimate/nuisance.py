"""Parameters of single groups: where they start, which of them records determine, and what records not fitted give."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.estimate.polish import descended
from armcal.measure.groups import group_name, owner_of
from armcal.measure.measurement import GroupedMeasurement
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import FactorRecords, Problem

_MOST_STEPS = 50
_PLACE = ("x", "y", "z")
_FAR, _NEAR = 8.0, 3.0
"""Of the typical distance of the nominal arm from the place that a record names: what is another place, and the right
one."""
_MOST_NAMED = 5
_DAMPING = 1e-9


def started(problem: Problem, records: Sequence[FactorRecords]) -> Problem:
    """The problem with the free parameters of each group starting from what a middling record gives for them."""
    if not problem.parameters.nuisances:
        return problem
    nominal, plan, done = problem.parameters.nominal(), problem.blueprint, set[tuple[str, str]]()
    starts = problem.nuisance_starts(nominal, records)
    parts = zip(problem.kernels, plan.measurements.items(), records, starts, strict=True)
    for kernel, (instance, measurement), record, own in parts:
        if not isinstance(measurement, GroupedMeasurement) or record.group is None or not len(own):
            continue
        owner, names = owner_of(instance, measurement), np.array(kernel.factor.nuisance_names)
        group, counted = record.group[: record.count], record.weight[: record.count] > 0
        for number in np.unique(group[(group >= 0) & counted]):
            key = plan.groups[owner][number]
            if (owner, key) in done:  # the first factor wins
                continue
            done.add((owner, key))
            members = np.flatnonzero((group == number) & counted)
            away = np.abs(own[:, members] - np.median(own[:, members], axis=1)[:, None]).sum(axis=0)
            # Of two equally near ones their starts decide, not which stands first.
            middling = members[np.lexsort((*own[:, members], away))[0]]
            for local in dict.fromkeys(kernel.factor.nuisance_names):
                name = group_name(owner, key, local)
                if problem.parameters[name].free and problem.parameters[name].prior_sd is None:
                    nominal[problem.parameters.entries_of(name)] = own[names == local, middling]
    return replace(problem, parameters=problem.parameters.with_nominal(nominal))


def mislabelled(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> list[str]:
    """Warnings of records that the arm, as it starts, has at the place of another group than they name.

    Places are those of the middling record of each group; only groups that are places have them.

    Raises:
        NotConvergedError: a record has no elastic equilibrium at the nominal values.
    """
    warnings, plan = [], problem.blueprint
    starts = problem.nuisance_starts(problem.parameters.nominal(), records) if problem.parameters.nuisances else ()
    parts = zip(problem.kernels, plan.measurements.items(), records, starts, strict=False)
    for kernel, (instance, measurement), record, own in parts:
        if not isinstance(measurement, GroupedMeasurement) or record.group is None:
            continue
        owner, group = owner_of(instance, measurement), record.group[: record.count]
        keys, numbers = plan.groups[owner], np.unique(group[group >= 0])
        if len(numbers) < 2 or tuple(kernel.factor.nuisance_names) != _PLACE:
            continue
        middles = np.array([np.median(own[:, group == number], axis=1) for number in numbers])
        away = np.linalg.norm(own.T[:, None] - middles, axis=2)
        named = away[np.arange(len(group)), np.searchsorted(numbers, group).clip(max=len(numbers) - 1)]
        typical, nearest = np.median(named[group >= 0]), np.argmin(away, axis=1)
        wrong = np.flatnonzero((group >= 0) & (named > _FAR * typical) & (away.min(axis=1) < _NEAR * typical))
        texts = [f"{dataset.ids[i]} (named {keys[group[i]]}, at {keys[numbers[nearest[i]]]})" for i in wrong]
        if texts:
            more = f" and {len(texts) - _MOST_NAMED} more" if len(texts) > _MOST_NAMED else ""
            listed = ", ".join(texts[:_MOST_NAMED]) + more
            text = f"{instance}: records that the nominal arm has at another place than they name: {listed}."
            warnings.append(f"{text} Were they exchanged? Correct their labels.")
    return warnings


def restricted(problem: Problem, records: Sequence[FactorRecords]) -> Problem:
    """The problem with the groups held that no weighted record belongs to; the same object if there are none."""
    present = _present(problem, records)
    free = {block.name for block in problem.parameters.free if not block.nuisance or block.name in present}
    return problem if len(free) == len(problem.parameters.free) else with_free(problem, free)


def with_free(problem: Problem, names: set[str]) -> Problem:
    return replace(problem, parameters=problem.parameters.with_free(names))


def untrained(problem: Problem) -> Problem:
    return with_free(problem, {block.name for block in problem.parameters.free if not block.nuisance})


def settled(problem: Problem, values: Array, records: Sequence[FactorRecords]) -> Array:
    """Values with the groups that a fit did not see fitted to their own records, and all else held.

    A socket that only records touch which judge has to be found from them: what is left is how far they disagree.

    Args:
        problem: as it was fitted; the groups it holds although they were compiled as free are those not seen.
        values: of the fit.
        records: that judge; with weights of zero where they are not to count.
    """
    fitted = {block.name for block in problem.parameters.free}
    open_names = {block.name for block in problem.blueprint.parameters.free if block.nuisance} - fitted
    names = open_names & _present(problem, records)
    if not names:
        return values
    parameters = problem.parameters.with_nominal(values)
    without_priors = {block.name: replace(block, prior_sd=None) for block in parameters.nuisances}
    inner = replace(problem, parameters=parameters.replaced(without_priors).with_free(names), known_ties=())
    posed = PosedProblem(inner, records)
    return posed.values(descended(posed, np.zeros(len(posed.scales)), _MOST_STEPS, _DAMPING))


def _present(problem: Problem, records: Sequence[FactorRecords]) -> set[str]:
    names = set()
    plan = problem.blueprint
    for (instance, measurement), record in zip(plan.measurements.items(), records, strict=True):
        if isinstance(measurement, GroupedMeasurement) and record.group is not None:
            owner = owner_of(instance, measurement)
            for number in np.unique(record.group[record.weight > 0]):
                if number >= 0:
                    key = plan.groups[owner][number]
                    names |= {group_name(owner, key, block.name) for block in measurement.group_parameters(key)}
    return names
