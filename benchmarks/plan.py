"""Planning 50 poses: exchange by updates against an SVD for each candidate, against random starts, and of 100,000."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.functions.batch_function import EvaluatorChoice
from armcal.planning.candidates import Candidates, Task, efficiency, value_of, whitened_rows
from armcal.planning.exchange import Plan, choose, detmax
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment

from benchmarks import lrm
from benchmarks.large import _peak_mb
from benchmarks.report import Row
from benchmarks.timing import best_times, once

NAME = "plan, 50 poses, 28"
POSES, CANDIDATES, MANY, RANDOM_STARTS = 50, 313, 100_000, 50
LIMITS = np.deg2rad([100, 50, 100, 100, 100, 50])


class SvdTally:
    """The obvious way: the singular values of the whole plan with each candidate, Jacobians cached."""

    def __init__(self, candidates: Candidates) -> None:
        self._rows = np.ascontiguousarray(candidates.rows.transpose(1, 0, 2))
        self._chosen: list[int] = []

    def restart(self, chosen: Indices) -> None:
        self._chosen = [int(i) for i in chosen]

    def add(self, candidate: int) -> None:
        self._chosen.append(candidate)

    def remove(self, candidate: int) -> None:
        self._chosen.remove(candidate)

    def if_added(self) -> Array:
        return np.array([self._value([*self._chosen, i]) for i in range(len(self._rows))]) - self._value(self._chosen)

    def if_removed(self, chosen: Indices) -> Array:
        return np.array([self._value(self._without(int(i))) for i in chosen]) - self._value(self._chosen)

    def if_swapped(self, candidate: int) -> Array:
        kept = self._without(candidate)
        return np.array([self._value([*kept, i]) for i in range(len(self._rows))]) - self._value(self._chosen)

    def _without(self, candidate: int) -> list[int]:
        kept = list(self._chosen)
        kept.remove(candidate)
        return kept

    def _value(self, chosen: list[int]) -> float:
        stacked = self._rows[chosen].reshape(-1, self._rows.shape[2])
        return float(2 * np.sum(np.log(np.maximum(np.linalg.svd(stacked, compute_uv=False), 1e-150))))


def run() -> Iterator[Row]:
    """Rows of this benchmark."""
    task = _task(_grid(CANDIDATES), "interpreted")
    random = np.random.default_rng(7)
    starts = [random.choice(CANDIDATES, POSES, replace=False) for _ in range(RANDOM_STARTS)]
    yield _one_start(task, starts[0])
    yield _many_starts(task, starts)
    many = _in_a_process()
    note = (
        f"peak {many['peak_mb']:.0f} MB ({many['before_mb']:.0f} before); Jacobians {many['jacobians']:.2f} s, "
        f"exchange and bound {many['exchange']:.1f} s; gap {many['gap']:.3f}, "
        f"D-efficiency at least {100 * many['efficiency']:.2f} %"
    )
    yield Row(NAME, "of 100,000 candidates, with its bound", many["seconds"], "no peer", None, note)


def _one_start(task: Task, start: Indices) -> Row:
    """The same start, the same moves."""
    found: dict[str, Indices] = {}

    def ours() -> None:
        found["ours"] = detmax(task, start)

    def obvious() -> None:
        found["svd"] = detmax(task, start, SvdTally(task.candidates))

    times = best_times({"ours": ours, "svd": obvious}, repeats=3)
    ends = [value_of(task.candidates, found[name]) for name in ("ours", "svd")]
    note = f"log det {ends[0]:.4f}, the peer's {ends[1]:.4f}"
    return Row(
        NAME, f"one start, {CANDIDATES} candidates", times["ours"], "an SVD for each candidate", times["svd"], note
    )


def _many_starts(task: Task, starts: list[Indices]) -> Row:
    """The plan as `armcal plan` makes it, against the best of random starts."""
    plans: list[Plan] = []
    values: list[float] = []

    def ours() -> None:
        plans.append(choose(task))

    def others() -> None:
        values.extend(value_of(task.candidates, detmax(task, start)) for start in starts)

    times = best_times({"ours": ours, "others": others}, repeats=2)
    note = f"log det {plans[0].value:.4f}, the best random start's {max(values):.4f}"
    return Row(NAME, "the whole plan", times["ours"], f"{len(starts)} random starts of DETMAX", times["others"], note)


def _grid(count: int) -> Dataset:
    """Some of the poses at three levels a joint."""
    axes = np.meshgrid(*[np.array([-1, 0, 1])] * 6, indexing="ij")
    every = np.array([axis.ravel() for axis in axes]) * LIMITS[:, None]
    return _dataset(every[:, np.sort(np.random.default_rng(0).choice(every.shape[1], count, replace=False))])


def _spread(count: int) -> Dataset:
    return _dataset((np.random.default_rng(0).uniform(-1, 1, (count, 6)) * LIMITS).T)


def _dataset(angles: Array) -> Dataset:
    ids = tuple(map(str, range(angles.shape[1])))
    return Dataset(ids, {f"arm.q{i + 1}": np.ascontiguousarray(row) for i, row in enumerate(angles)})


def _task(dataset: Dataset, evaluator: EvaluatorChoice) -> Task:
    experiment = Experiment.load(lrm.CONFIGS / "option1.yaml")
    system, parameters = experiment.system, experiment.parameters
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, dataset, evaluator)
    rows = whitened_rows(problem, parameters.nominal(), dataset)
    return Task(Candidates(np.zeros((0, rows.shape[2])), rows), POSES)


def _in_a_process() -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.plan"]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=True)
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def _measure() -> dict[str, float]:
    """100,000 candidates, in this process."""
    dataset = _spread(MANY)
    before, made, plans = _peak_mb(), [], []
    jacobians = once(lambda: made.append(_task(dataset, "compiled")))
    task: Task = made[0]
    exchange = once(lambda: plans.append(choose(task)))
    plan: Plan = plans[0]
    bound = plan.relaxation.bound
    return {
        "seconds": jacobians + exchange,
        "jacobians": jacobians,
        "exchange": exchange,
        "before_mb": before,
        "peak_mb": _peak_mb(),
        "gap": bound - plan.value,
        "efficiency": efficiency(plan.value, bound, task.candidates.size),
    }


if __name__ == "__main__":
    print(json.dumps(_measure()))
