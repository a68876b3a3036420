"""100,000 poses, the elastic fit of 28 parameters: seconds and peak memory, each in a process of its own."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from armcal.base.arrays import Array
from armcal.problem.problem import Problem
from scipy.optimize import least_squares

from benchmarks import lrm
from benchmarks.report import Row
from benchmarks.timing import once

NAME = "fit, 100,000 poses"
POSES = 100_000
PEER = "scipy, armcal's compiled Jacobian stacked"
JointPath = Literal["compiled", "interpreted", "scipy"]


def run(*, long: bool = False) -> Iterator[Row]:
    """Rows of this benchmark; ``long`` adds the interpreter."""
    scipy = _in_a_process("scipy")
    for way in ("compiled", "interpreted") if long else ("compiled",):
        ours = _in_a_process(way)
        note = (
            f"peak {ours['peak_mb']:.0f} MB ({ours['before_mb']:.0f} before the fit), "
            f"scipy {scipy['peak_mb']:.0f} MB; cost {ours['cost']:.6f}, scipy {scipy['cost']:.6f}"
        )
        yield Row(NAME, f"IPOPT, {ours['backend']}", ours["seconds"], PEER, scipy["seconds"], note)


def _in_a_process(way: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.large", way]
    root = Path(__file__).parents[1]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def _measure(way: JointPath) -> dict[str, Any]:
    """One fit, in this process."""
    case = lrm.simulated(POSES)
    problem = case.problem("interpreted" if way == "interpreted" else "compiled")
    before = _peak_mb()
    values: list[Array] = []

    def fit() -> None:
        values.append(_scipy_fit(case, problem) if way == "scipy" else case.solve(problem).values)

    seconds = once(fit)
    peak = _peak_mb()
    cost = problem.of(case.dataset).cost(values[0])
    return {"seconds": seconds, "before_mb": before, "peak_mb": peak, "cost": cost, "backend": problem.backend}


def _scipy_fit(case: lrm.Case, problem: Problem) -> Array:
    """least_squares with armcal's residuals and Jacobian of all records at once: the obvious way."""
    (kernel,), (records,) = problem.kernels, problem.of(case.dataset).records
    noise = np.array(kernel.factor.noise)[:, None]
    free = list(case.parameters.free_entries)
    shape = (len(noise), len(free), records.record.shape[1])

    def residuals(increment: Array) -> Array:
        raw = problem.with_records((records,)).residuals(case.parameters.retract(increment))[0]
        return np.asarray((raw / noise).ravel())

    def jacobian(increment: Array) -> Array:
        values = np.ascontiguousarray(case.parameters.retract(increment)[free])
        residual, result = np.empty((shape[0], shape[2])), np.empty((shape[0] * shape[1], shape[2]))
        kernel.backend.linearise(values, records.record, records.state, residual, result)
        stacked = result.reshape(shape)[:, :, : records.count] / noise[:, :, None]
        return np.asarray(stacked.transpose(0, 2, 1).reshape(-1, len(free)))

    scales, bounds = case.parameters.scales(), case.parameters.increment_bounds()
    answer = least_squares(residuals, np.zeros(len(free)), jacobian, x_scale=scales, bounds=bounds, ftol=1e-12)
    return np.asarray(case.parameters.retract(answer.x))


def _peak_mb() -> float:
    """The most memory that this process has held; Linux' ru_maxrss would count the parent's as well."""
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text(encoding="utf-8").splitlines())
        return int(lines["VmHWM"].split()[0]) / 2**10
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


if __name__ == "__main__":
    print(json.dumps(_measure(sys.argv[1])))  # type: ignore[arg-type]
