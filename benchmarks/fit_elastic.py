"""The elastic fit, 28 parameters, 313 poses: armcal against scipy with finite differences."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from armcal.base.arrays import Array
from armcal.functions.batch_function import EvaluatorChoice
from armcal.problem.problem import Problem
from scipy.optimize import least_squares

from benchmarks import lrm, lrm_numpy
from benchmarks.report import Row
from benchmarks.timing import best_times

NAME = "fit, elastic, 28"
RECORDS = 313
CHOICES: tuple[EvaluatorChoice, ...] = ("compiled", "interpreted")
SAME_COST = 1e-6
"""Relative; finite differences do not come nearer."""


def run() -> Iterator[Row]:
    """Rows of this benchmark."""
    case = lrm.simulated(RECORDS)
    problems = {choice: case.problem(choice) for choice in CHOICES}
    by_hand = _numpy_residuals(case)
    found: dict[str, float] = {}

    def ours(name: EvaluatorChoice) -> None:
        values = case.solve(problems[name]).values
        found[name] = problems[name].of(case.dataset).cost(values)

    def scipys(name: str, residuals: Callable[[Array], Array]) -> None:
        found[name] = _scipy_fit(case, residuals)

    contenders: dict[str, Callable[[], object]] = {"numpy": partial(scipys, "numpy", by_hand)}
    for choice, problem in problems.items():
        contenders[choice] = partial(ours, choice)
        contenders[f"differences, {choice}"] = partial(
            scipys, f"differences, {choice}", _kernel_residuals(case, problem)
        )
    times = best_times(contenders, repeats=3)
    for choice, problem in problems.items():
        lacking = "; no C compiler: apt-get install gcc" if choice == "compiled" != problem.backend else ""
        for peer, label in (
            (f"differences, {choice}", "scipy, differences of armcal's own residuals"),
            ("numpy", "scipy, differences of a numpy model"),
        ):
            note = _agreement(found[choice], found[peer]) + lacking
            yield Row(NAME, f"IPOPT, {problem.backend}", times[choice], label, times[peer], note)


def _kernel_residuals(case: lrm.Case, problem: Problem) -> Callable[[Array], Array]:
    problem = problem.of(case.dataset)
    noise = np.array(problem.kernels[0].factor.noise)[:, None]

    def residuals(increment: Array) -> Array:
        raw = problem.residuals(case.parameters.retract(increment))[0]
        return np.asarray((raw / noise).ravel())

    return residuals


def _numpy_residuals(case: lrm.Case) -> Callable[[Array], Array]:
    column = case.dataset.column
    angles = np.column_stack([column(f"arm.q{i}") for i in range(1, 7)])
    measured = np.column_stack([column(f"tracker.{axis}") for axis in "xyz"])
    names = [name.rpartition(".")[2] for name in case.parameters.coordinate_names]
    deflection = np.zeros((len(angles), 7))
    start = np.array([lrm_numpy.NOMINAL[name] for name in names])

    def residuals(increment: Array) -> Array:
        numbers = {**lrm_numpy.NOMINAL, **dict(zip(names, start + increment, strict=True))}
        return ((measured - lrm_numpy.tip(numbers, angles, deflection)) / 0.5e-3).ravel()

    return residuals


def _scipy_fit(case: lrm.Case, residuals: Callable[[Array], Array]) -> float:
    """The obvious call, with the bounds and the scales that armcal uses; gives the cost."""
    scales = case.parameters.scales()
    bounds = case.parameters.increment_bounds()
    answer = least_squares(residuals, np.zeros(len(scales)), x_scale=scales, bounds=bounds, ftol=1e-12, xtol=1e-12)
    return float(answer.cost)


def _agreement(ours: float, peers: float) -> str:
    apart = abs(ours - peers) / peers
    if apart < SAME_COST:
        return f"same cost (to {apart:.0e})"
    return f"cost {ours:.6g}, the peer's {peers:.6g}"
