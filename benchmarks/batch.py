"""100,000 poses: the elastic tip in equilibrium with its Jacobian, against pinocchio's rigid kinematics. One thread."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.config.system import System
from armcal.problem.kernel import BLOCK_RECORDS
from armcal.problem.problem import Problem

from benchmarks import lrm, lrm_numpy, rigid_arm
from benchmarks.pinocchio_loop import Loop, find_loop
from benchmarks.report import Row
from benchmarks.timing import best_times

NAME = "batch Jacobians"
POSES = 100_000
MORE = ("alpha1", "a1", "a2", "d2", "d3", "base_rx", "base_ry", "tool_rx", "tool_ry", "d6")
"""With option 1's 28: 38 parameters."""
COMPLIANCE_RAD_PER_NM = 1e-4
MOST = 6
"""How many times pinocchio's time armcal may take."""


class Sweep:
    """armcal's compiled kernel over all poses, block by block as the fit does it, the Jacobian written."""

    def __init__(self, system: System, parameters: Parameters, dataset: Dataset, values: Array) -> None:
        self._problem = Problem.build(
            system.arms, system.measurements, parameters, system.environment, dataset, "compiled"
        )
        self.kernel = self._problem.kernels[0]
        (self.records,) = self._problem.of(dataset).records
        self._values = np.ascontiguousarray(values[list(parameters.free_entries)])
        self.parameters = len(self._values)
        size = self.kernel.factor.residual.numel()
        self._jacobian = np.zeros((size * self.parameters, BLOCK_RECORDS))
        self.residual = np.zeros((size, self.records.record.shape[1]))

    def run(self, *, cold: bool) -> None:
        """From zeroed elastic states, or from those that were left."""
        record, state = self.records.record, self.records.state
        if cold:
            state[:] = 0
        for start in range(0, record.shape[1], BLOCK_RECORDS):
            part = slice(start, min(start + BLOCK_RECORDS, record.shape[1]))
            jacobian = self._jacobian[:, : part.stop - part.start]
            self.kernel.backend.linearise(
                self._values, record[:, part], state[:, part], self.residual[:, part], jacobian
            )


def run() -> Iterator[Row]:
    """Rows of this benchmark."""
    loop = find_loop()
    for label, (sweep, placements, angles) in {"LRM": _lrm(), "7 joints": _seven_joints()}.items():
        yield from _compare(label, sweep, placements, angles, loop)


def _compare(label: str, sweep: Sweep, placements: Array, angles: Array, loop: Loop | str) -> Iterator[Row]:
    contenders: dict[str, Callable[[], object]] = {
        "cold": lambda: sweep.run(cold=True),
        "warm": lambda: sweep.run(cold=False),
    }
    if isinstance(loop, Loop):
        # The same number of poses; from Python fewer, and their time scaled up.
        some = np.ascontiguousarray(angles[: loop.most_poses])
        contenders["pinocchio"] = partial(loop.run, placements, some)
        _require_near(loop.run(placements, some)[:1000], rigid_arm.tips(placements, some[:1000]))
    target = f"at most {MOST} x"
    if sweep.kernel.backend.name != "compiled":
        target = "no C compiler: apt-get install gcc"
        del contenders["cold"], contenders["warm"]
    times = best_times(contenders, repeats=7)
    for start in ("cold", "warm"):
        seconds = times.get(start)
        work = f"{label}, elastic, {sweep.parameters} parameters, {start}"
        if isinstance(loop, str):
            yield Row(NAME, work, seconds, "pinocchio, C++ loop", None, f"{target}; {loop}", POSES)
        else:
            peers = times["pinocchio"] * POSES / len(some)
            note = "; ".join(filter(None, [target, loop.note]))
            yield Row(NAME, work, seconds, f"{loop.name}, rigid", peers, note, POSES)


def _lrm() -> tuple[Sweep, Array, Array]:
    """The arm of configs/lrm_arm at its truth, checked against the numpy model."""
    case = lrm.simulated(POSES, [f"arm.mdh.{name}" for name in MORE])
    sweep = Sweep(case.experiment.system, case.parameters, case.dataset, case.truth)
    sweep.run(cold=True)
    angles = np.column_stack([case.dataset.column(f"arm.q{i}") for i in range(1, 7)])
    measured = np.column_stack([case.dataset.column(f"tracker.{axis}") for axis in "xyz"])
    names = (name.rpartition(".")[2] for name in case.parameters.entry_names)
    truth = {n: v for n, v in zip(names, case.truth, strict=True) if n in lrm_numpy.NOMINAL}
    numbers = {**lrm_numpy.NOMINAL, **truth}
    tips = lrm_numpy.tip(numbers, angles[:1000], np.zeros((1000, 7)))
    _require_near(measured[:1000] - tips, sweep.residual[:, :1000].T)
    return sweep, lrm_numpy.placements(numbers), angles


def _seven_joints() -> tuple[Sweep, Array, Array]:
    """A Panda's dimensions with a spring a joint: 31 geometric parameters and 7 compliances."""
    experiment = rigid_arm.experiment([*rigid_arm.RIGID, "arm.spring.k[1-7]"], elastic=True)
    angles = np.random.default_rng(0).uniform(-2, 2, (POSES, len(rigid_arm.ROWS)))
    dataset = rigid_arm.dataset(angles, np.zeros((POSES, 3)))
    values = experiment.parameters.nominal()
    for i in range(1, len(rigid_arm.ROWS) + 1):
        values[experiment.parameters.entries_of(f"arm.spring.k{i}")] = COMPLIANCE_RAD_PER_NM
    sweep = Sweep(experiment.system, experiment.parameters, dataset, values)
    return sweep, rigid_arm.placements(), angles


def _require_near(one: Array, two: Array) -> None:
    if not np.allclose(one, two, rtol=0, atol=1e-9):
        raise AssertionError("two ways to the same tips differ by more than 1e-9 m: do not trust these times")
