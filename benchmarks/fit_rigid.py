"""The rigid fit of a seven-joint arm, 400 tip positions: armcal against figaroh with its own solver."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator
from importlib.util import find_spec

import numpy as np
from armcal.base.arrays import Array
from armcal.problem.problem import Problem

from benchmarks import rigid_arm
from benchmarks.report import Row
from benchmarks.timing import best_times

NAME = "fit, rigid"
RECORDS, FRESH = 400, 1000
PEER = "figaroh, its own solver"


def run() -> Iterator[Row]:
    """The row of this benchmark."""
    random = np.random.default_rng(0)
    truth = _true_arm(random)
    angles = random.uniform(-2, 2, (RECORDS + FRESH, len(rigid_arm.ROWS)))
    tips = rigid_arm.tips(truth, angles)
    fresh, fresh_tips = angles[RECORDS:], tips[RECORDS:]
    angles, measured = angles[:RECORDS], tips[:RECORDS] + random.normal(0, rigid_arm.NOISE_M, (RECORDS, 3))

    experiment = rigid_arm.experiment(rigid_arm.RIGID)
    parameters, system = experiment.parameters, experiment.system
    data = rigid_arm.dataset(angles, measured)
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, data, "compiled")
    found: dict[str, Array] = {}

    def ours() -> None:
        records = problem.of(data).records
        found["armcal"] = experiment.estimator.solve(problem.with_records(records), parameters.nominal()).values

    def error_mm(values: Array) -> float:
        shown = problem.of(rigid_arm.dataset(fresh, fresh_tips)).predict(values)[0].outputs[:3]
        return _rms_mm(shown.T - fresh_tips)

    work = f"IPOPT, {problem.backend}, {problem.increments} parameters"
    if find_spec("figaroh") is None:
        seconds = best_times({"armcal": ours}, repeats=5)["armcal"]
        note = f"new poses: {error_mm(found['armcal']):.4f} mm; no figaroh: pip install 'armcal[bench]'"
        yield Row(NAME, work, seconds, PEER, None, note)
        return
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        from benchmarks.figaroh_fit import FigarohFit

        peer = FigarohFit(angles, measured)
        times = best_times({"armcal": ours, "figaroh": peer.solve}, repeats=5)
        peers_mm = _rms_mm(peer.predict(fresh) - fresh_tips)
    note = f"new poses, rms: armcal {error_mm(found['armcal']):.4f} mm, figaroh {peers_mm:.4f} mm"
    yield Row(NAME, work, times["armcal"], f"{PEER}, {peer.variables} variables", times["figaroh"], note)


def _true_arm(random: np.random.Generator) -> Array:
    """Every placement wrong by about 2 mm and 0.6 degrees (8 x 4 x 4)."""
    truth = rigid_arm.placements()
    for at in truth[:-1]:
        x, y, z = random.normal(0, 0.01, 3)
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        # A rotation by the Cayley transform.
        at[:3, :3] = at[:3, :3] @ np.linalg.solve(np.eye(3) - skew / 2, np.eye(3) + skew / 2)
        at[:3, 3] += random.normal(0, 0.002, 3)
    return truth


def _rms_mm(apart: Array) -> float:
    return float(1e3 * np.sqrt((apart**2).sum(axis=1).mean()))
