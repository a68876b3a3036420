"""Parameters of single groups: where they start, which of them records can tell, and what records not fitted say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.estimate.polish import descended
from armcal.measure.groups import group_name, owner_of
from armcal.measure.measurement import GroupedMeasurement
from armcal.problem.posed import PosedProblem
from armcal.problem.problem import FactorRecords, Problem

_MOST_STEPS = 50
_DAMPING = 1e-9


def started(problem: Problem, records: Sequence[FactorRecords]) -> Problem:
    """The problem with the free parameters of each group starting from what a middling record says of them.

    Raises:
        NotConvergedError: a record has no elastic equilibrium at the nominal values.
    """
    if not problem.parameters.nuisances:
        return problem
    nominal = problem.parameters.nominal()
    for owner, key, factor, said in _sayings(problem, problem.told(nominal, records), records):
        for local in dict.fromkeys(problem.kernels[factor].factor.nuisance_names):
            name = group_name(owner, key, local)
            if problem.parameters[name].free and problem.parameters[name].prior_sd is None:
                rows = [
                    i
                    for i, nuisance_name in enumerate(problem.kernels[factor].factor.nuisance_names)
                    if nuisance_name == local
                ]
                nominal[problem.parameters.entries_of(name)] = said[rows]
    return replace(problem, parameters=problem.parameters.with_nominal(nominal))


def restricted(problem: Problem, records: Sequence[FactorRecords]) -> Problem:
    """The problem with the groups held that no weighted record belongs to; the same object if there are none."""
    present = _present(problem, records)
    free = {block.name for block in problem.parameters.free if not block.nuisance or block.name in present}
    return problem if len(free) == len(problem.parameters.free) else with_free(problem, free)


def with_free(problem: Problem, names: set[str]) -> Problem:
    """The same functions with fewer parameters free."""
    return replace(problem, parameters=problem.parameters.with_free(names))


def untrained(problem: Problem) -> Problem:
    """The problem as nothing had been fitted: every group held."""
    return with_free(problem, {block.name for block in problem.parameters.free if not block.nuisance})


def settled(problem: Problem, values: Array, records: Sequence[FactorRecords]) -> Array:
    """Values with the groups that a fit did not see fitted to their own records, and all else held.

    A socket that only records touch which judge has to be found from them: what is left is how far they disagree.

    Args:
        problem: as it was fitted; the groups it holds although they were compiled as free are those not seen.
        values: of the fit.
        records: that judge; with weights of zero where they are not to count.

    Raises:
        NotConvergedError: a record has no elastic equilibrium.
    """
    fitted = {block.name for block in problem.parameters.free}
    open_names = {block.name for block in problem.blueprint.parameters.free if block.nuisance} - fitted
    names = open_names & _present(problem, records)
    if not names:
        return values
    parameters = _without_priors(problem.parameters.with_nominal(values)).with_free(names)
    inner = replace(problem, parameters=parameters, known_ties=())
    posed = PosedProblem(inner, records)
    return posed.values(descended(posed, np.zeros(len(posed.scales)), _MOST_STEPS, _DAMPING))


def _without_priors(parameters: Parameters) -> Parameters:
    return parameters.replaced({b.name: replace(b, prior_sd=None) for b in parameters.nuisances})


def _present(problem: Problem, records: Sequence[FactorRecords]) -> set[str]:
    """Full names of the parameters of all groups with a weighted record."""
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


def _sayings(
    problem: Problem, told: Sequence[Array], records: Sequence[FactorRecords]
) -> list[tuple[str, str, int, Array]]:
    """Owner, key, factor and what the record nearest the median says, of each group; the first factor wins."""
    found: dict[tuple[str, str], tuple[str, str, int, Array]] = {}
    plan = problem.blueprint
    for factor, ((instance, measurement), factor_records) in enumerate(
        zip(plan.measurements.items(), records, strict=True)
    ):
        if not isinstance(measurement, GroupedMeasurement) or factor_records.group is None or not len(told[factor]):
            continue
        owner = owner_of(instance, measurement)
        group, weight = factor_records.group[: factor_records.count], factor_records.weight[: factor_records.count]
        for number in np.unique(group[(group >= 0) & (weight > 0)]):
            members = np.flatnonzero((group == number) & (weight > 0))
            said = np.median(told[factor][:, members], axis=1)
            away = np.abs(told[factor][:, members] - said[:, None]).sum(axis=0)
            # Of two equally near ones what they say decides: not which stands first.
            one = members[np.lexsort((*told[factor][:, members], away))[0]]
            key = plan.groups[owner][number]
            found.setdefault((owner, key), (owner, key, factor, told[factor][:, one]))
    return list(found.values())
