"""Checks on estimators: a small problem whose answer is known."""

from dataclasses import dataclass, replace

import numpy as np

from armcal.base.arrays import Array
from armcal.base.domains import Interval
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
        return self.problem.parameters


def check_estimator(record: Recorder, subject: Subject) -> None:
    """Truth, bounds, priors, verdict; and an honest verdict when it is cut short."""
    with record.needed("it builds"):
        estimator: Estimator = subject.build()
    bounded = _case(Interval(upper=UPPER_SIDE_M), None, UPPER_SIDE_M)
    with record.needed("it gives a value for every entry, and a verdict"):
        solution = _solve(estimator, bounded)
    with record.check("it reports that it converged"):
        expect(solution.verdict.converged, f"found the verdict {solution.verdict.status!r}, expected convergence")
    with record.check("it keeps to the bounds"):
        bounded.parameters.check(solution.values)
    with record.check("it finds the truth, one bound active"):
        _expect_near(bounded, solution)
    with record.check("it does the same twice"):
        _expect_same(estimator, bounded, solution)
    with record.check("it weighs priors"):
        data, prior = POSES / NOISE_M**2, 1 / PRIOR_SD_M**2  # information on ``side``, which the prior puts at zero
        case = _case(Interval(), PRIOR_SD_M, TRUTH["side"] * data / (data + prior))
        _expect_near(case, _solve(estimator, case))
    scattered = _scattered()
    with record.check("it weighs records"):
        _expect_near(scattered, _solve(estimator, scattered))
    with record.check("the order of records changes nothing"):
        order = np.random.default_rng(7).permutation(POSES)
        shuffled = replace(scattered, records=scattered.problem.subset(scattered.records, order))
        off = float(np.abs(_solve(estimator, shuffled).values - _solve(estimator, scattered).values).max())
        expect(off <= TOLERANCE, f"found values that differ by {off:.1e} with the records in another order")
    with record.check("a second one of equal settings does the same"):
        _expect_same(subject.build(), bounded, solution)
    with record.check("cut short, it reports that it did not converge"):
        if "max_iterations" not in type(subject.settings).model_fields:
            raise NotRun("its settings have no max_iterations")
        settings = subject.made.Settings.model_validate({**subject.example, "max_iterations": 1})
        short = _solve(subject.made(settings), bounded)
        expect(not short.verdict.converged, "found converged after one iteration, expected not converged")


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


def _expect_near(case: _Case, solution: Solution) -> None:
    known = [case.known is None or name in case.known for name in case.parameters.entry_names]
    off = np.where(known, np.abs(solution.values - case.answer), 0.0)
    worst = int(np.argmax(off))
    expect(
        float(off[worst]) <= TOLERANCE,
        f"{case.parameters.entry_names[worst]}: found {solution.values[worst]:.9g}, "
        f"expected {case.answer[worst]:.9g} within {TOLERANCE:g}",
    )


def _expect_same(estimator: Estimator, case: _Case, solution: Solution) -> None:
    again = estimator.solve(case.problem, case.records, case.parameters.nominal())
    off = float(np.abs(again.values - solution.values).max())
    expect(off == 0.0, f"found values that differ by {off:.1e} from the first time")
