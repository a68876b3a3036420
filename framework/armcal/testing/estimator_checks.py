"""Checks on estimators: a small problem whose answer is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armcal.base.domains import Array, Interval
from armcal.base.parameters import Parameters
from armcal.estimate.estimator import Estimator, Solution
from armcal.estimate.simulation import SimulationRequest, measured_without_noise
from armcal.problem.problem import FactorRecords, Problem
from armcal.testing.planar import ARM, GRAVITY, NOISE_M, TRACKER, Tip, all_parameters, commands, dataset, planar_arms
from armcal.testing.results import NotRun, Recorder, expect
from armcal.testing.settings_checks import Subject

POSES = 12
TOLERANCE = 1e-6
TRUTH = {"a1": 0.31, "a2": 0.243, "theta1": 0.05, "theta2": -0.08, "side": 0.02}
UPPER_SIDE_M, PRIOR_SD_M = 0.015, 4e-4
_SIDE = f"{ARM}.planar.side"


@dataclass(frozen=True)
class _Case:
    """A problem, its records, and the values that solve it; ``known`` are those known beforehand, None for all."""

    problem: Problem
    records: tuple[FactorRecords, ...]
    answer: Array
    known: tuple[str, ...] | None = None

    @property
    def parameters(self) -> Parameters:
        """Of the problem."""
        return self.problem.parameters


def check_estimator(record: Recorder, subject: Subject) -> None:
    """Truth, bounds, priors, verdict; and an honest verdict when it is cut short."""
    estimator: Any = record.check("it builds", subject.build)
    if estimator is None:
        return
    bounded = _case(Interval(upper=UPPER_SIDE_M), None, UPPER_SIDE_M)
    name = "it gives a value for every entry, and a verdict"
    solution = record.check(name, _solve, estimator, bounded)
    if solution is None:
        return
    record.check("it reports that it converged", _converged, solution)
    record.check("it keeps to the bounds", _inside, bounded, solution)
    record.check("it finds the truth, one bound active", _near, bounded, solution)
    record.check("it does the same twice", _repeats, estimator, bounded, solution)
    data, prior = POSES / NOISE_M**2, 1 / PRIOR_SD_M**2  # information on ``side``, which the prior puts at zero
    case = _case(Interval(), PRIOR_SD_M, TRUTH["side"] * data / (data + prior))
    record.check("it weighs priors", lambda: _near(case, _solve(estimator, case)))
    scattered = _scattered()
    record.check("it weighs records", lambda: _near(scattered, _solve(estimator, scattered), scattered.known))
    record.check("the order of records changes nothing", _any_order, estimator, scattered)
    record.check("a second one of equal settings does the same", lambda: _repeats(subject.build(), bounded, solution))
    record.check("cut short, it reports that it did not converge", _cut_short, subject, bounded)


def _case(side: Interval, prior_sd: float | None, side_answer: float) -> _Case:
    """Exact tip positions; ``side`` moves y alone, so neither its bound nor its prior disturbs the rest."""
    arms, measurements = planar_arms([ARM]), {TRACKER: Tip()}
    parameters = all_parameters(arms)
    true = parameters.with_nominal(np.array([TRUTH[n.rpartition(".")[2]] for n in parameters.names]))
    moved = dataset(commands(arms, POSES, np.random.default_rng(5)))
    exact = measured_without_noise(SimulationRequest(arms, measurements, true, GRAVITY), moved)
    records = dataset({**moved.channels, **exact})
    block = replace(parameters[_SIDE], domain=side, prior_sd=prior_sd)
    parameters = parameters.replaced({_SIDE: block}).with_free(parameters.names)
    problem = Problem.build(arms, measurements, parameters, GRAVITY, records, "interpreted")
    answer = true.nominal()
    answer[parameters.entries_of(_SIDE)] = side_answer
    return _Case(problem, problem.records(records), answer)


def _scattered() -> _Case:
    """Noisy tips whose weights differ; ``side`` is then the weighted mean of y, by which nothing else moves."""
    case = _case(Interval(), None, TRUTH["side"])
    random = np.random.default_rng(6)
    kernel, records = case.problem.kernels[0], case.records[0]
    noisy = records.record.copy()
    noisy[:, :POSES] += random.normal(0.0, 3 * NOISE_M, (len(noisy), POSES))
    weights = random.uniform(0.2, 5.0, POSES)
    weighted = case.problem.weighted((replace(records, record=noisy),), (weights,))
    y = noisy[kernel.factor.channels.index(f"{TRACKER}.y"), :POSES]
    answer = case.answer.copy()
    answer[case.parameters.entries_of(_SIDE)] = weights @ y / weights.sum()
    return replace(case, records=weighted, answer=answer, known=(_SIDE,))


def _any_order(estimator: Estimator, case: _Case) -> None:
    solution = _solve(estimator, case)
    order = np.random.default_rng(7).permutation(POSES)
    shuffled = _solve(estimator, replace(case, records=case.problem.subset(case.records, order)))
    off = float(np.abs(shuffled.values - solution.values).max())
    expect(off <= TOLERANCE, f"found values that differ by {off:.1e} with the records in another order")


def _solve(estimator: Estimator, case: _Case) -> Solution:
    start = case.parameters.nominal()
    solution = estimator.solve(case.problem, case.records, start)
    values = np.asarray(solution.values)
    expect(values.shape == start.shape, f"found {values.size} values, expected {start.size}")
    expect(bool(np.isfinite(values).all()), f"found the values {values}")
    expect(
        isinstance(solution.verdict.converged, bool) and bool(solution.verdict.name),
        f"found the verdict {solution.verdict}, expected a name and converged true or false",
    )
    expect(bool(np.array_equal(start, case.parameters.nominal())), "it changed the start that it was given")
    return solution


def _converged(solution: Solution) -> None:
    expect(solution.verdict.converged, f"found the verdict {solution.verdict.status!r}, expected convergence")


def _inside(case: _Case, solution: Solution) -> None:
    case.parameters.check(solution.values)


def _near(case: _Case, solution: Solution, entries: Sequence[str] | None = None) -> None:
    known = [entries is None or name in entries for name in case.parameters.entry_names]
    off = np.where(known, np.abs(solution.values - case.answer), 0.0)
    worst = int(np.argmax(off))
    expect(
        float(off[worst]) <= TOLERANCE,
        f"{case.parameters.entry_names[worst]}: found {solution.values[worst]:.9g}, "
        f"expected {case.answer[worst]:.9g} within {TOLERANCE:g}",
    )


def _repeats(estimator: Estimator, case: _Case, solution: Solution) -> None:
    again = estimator.solve(case.problem, case.records, case.parameters.nominal())
    off = float(np.abs(again.values - solution.values).max())
    expect(off == 0.0, f"found values that differ by {off:.1e} from the first time")


def _cut_short(subject: Subject, case: _Case) -> None:
    if "max_iterations" not in type(subject.settings).model_fields:
        raise NotRun("its settings have no max_iterations")
    settings = subject.made.Settings.model_validate({**subject.example, "max_iterations": 1})
    solution = _solve(subject.made(settings), case)
    expect(not solution.verdict.converged, "found converged after one iteration, expected not converged")
