"""One record at a time: an extended Kalman filter with armcal's model, and with plain CasADi calls."""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.estimate.online import Gaussian
from armcal.functions.batch_function import EvaluatorChoice
from armcal.problem.kernel import NEAR_REST_RAD
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal_kalman.filters import ExtendedFilter, ExtendedSettings
from armcal_online.belief import Belief, GaussMarkovStates, Observer, Reading, StateSpace
from filterpy.kalman import ExtendedKalmanFilter

from benchmarks import lrm
from benchmarks.report import Row
from benchmarks.timing import best_times, once

NAME = "online"
ALSO_FREE = [f"arm.mdh.{name}" for name in ("a1", "a2", "d1", "alpha1", "after4_z", "base_rx", "base_ry")]
NOISE_M = 0.0005
UPDATES = 500
MANY = 100_000
SAME = 1e-8
"""sd; plain CasADi calls stop at the same equilibrium."""
ONCE = ExtendedSettings(iterations=1)
"""Each record is looked at once, as the peer does; by default again from where it led, if that is far."""


@dataclass(frozen=True)
class Case:
    """An arm, what is believed of it, and records of it as they may come."""

    observer: Observer
    belief: Belief
    readings: Sequence[Reading]
    parameters: Parameters
    dataset: Dataset

    def run(self, updates: int = UPDATES, settings: ExtendedSettings = ONCE) -> Belief:
        """Take records one after another; the belief after them."""
        estimator, belief, space = ExtendedFilter(settings), self.belief, self.observer.space
        for i in range(updates):
            reading = self.readings[i % len(self.readings)]
            observation = self.observer.observation(belief, (reading,))
            belief = belief.updated(space, estimator.update(belief.gaussian, observation).posterior)
        return belief


def run() -> Iterator[Row]:
    """Rows of this benchmark."""
    option = lrm.simulated(313, ALSO_FREE)
    parameters = option.parameters.with_nominal(option.truth)
    yield from _compared(option.experiment, parameters, option.dataset, "35 states")
    whole = Experiment.load(lrm.CONFIGS / "best.yaml", data=lrm.CONFIGS / "demo.csv")
    yield from _compared(whole, whole.parameters, whole.read(), "107 states, 3x3 compliances")
    case = case_of(option.experiment, parameters, option.dataset, "compiled")
    seconds, grown = _growth(case)
    yield Row(
        NAME, f"{MANY:,} updates, 35 states", seconds, "", None, f"{grown:.1f} MB more memory than after {UPDATES}"
    )


def _compared(experiment: Experiment, parameters: Parameters, dataset: Dataset, what: str) -> Iterator[Row]:
    choices: tuple[EvaluatorChoice, ...] = ("compiled", "interpreted")
    cases = {choice: case_of(experiment, parameters, dataset, choice) for choice in choices}
    factor = cases["interpreted"].observer.problem.kernels[0].factor
    plain = partial(_plain, cases["interpreted"], factor.pass_function, factor.linearise_function)
    contenders: dict[str, Callable[[], object]] = {name: case.run for name, case in cases.items()}
    contenders |= {f"{name}, again": partial(case.run, settings=ExtendedSettings()) for name, case in cases.items()}
    times = best_times({**contenders, "plain": plain}, repeats=10)
    apart = _apart(cases["compiled"].run(), plain(), cases["compiled"].observer.space)
    agreement = "the same estimate" if apart < SAME else f"bounds and cones kept, which moves it by {apart:.1g} sd"
    peer = "filterpy's ExtendedKalmanFilter fed by casadi.Function calls"
    for choice, case in cases.items():
        backend = case.observer.problem.backend
        for name, how, note in ((choice, "", agreement), (f"{choice}, again", ", looked at again", "")):
            rate = f"{UPDATES / times[name]:,.0f} updates a second"
            work = f"update, {what}, {backend}{how}"
            yield Row(NAME, work, times[name], peer, times["plain"], f"{rate}; {note}".rstrip("; "), UPDATES)


def case_of(experiment: Experiment, parameters: Parameters, dataset: Dataset, evaluator: EvaluatorChoice) -> Case:
    """A belief near the configured values, and a data set's records."""
    system = experiment.system
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, dataset, evaluator)
    state_space = StateSpace(parameters)
    noise = {"tracker": np.eye(3) * NOISE_M**2}
    observer = Observer(problem, state_space, GaussMarkovStates(), GaussMarkovStates(), noise, {"tracker": np.inf}, {})
    size = observer.size
    belief = Belief(parameters.nominal(), Gaussian(np.zeros(size), np.eye(size) * 0.01**2))
    channels = dataset.channels
    found = [observer.readings({n: float(v[i]) for n, v in channels.items()}, {}) for i in range(len(dataset))]
    return Case(observer, belief, [each[0] for each in found], parameters, dataset)


def _plain(case: Case, settle: ca.Function, linearise: ca.Function) -> tuple[Array, Array]:
    """The same updates in the obvious way: the state is the values, and CasADi takes and gives its own matrices."""
    entries, scales = case.observer.space.entries, case.observer.space.scales
    one = ExtendedKalmanFilter(dim_x=len(scales), dim_z=3)
    one.x = case.belief.origin[entries]
    one.P = case.belief.gaussian.covariance * np.outer(scales, scales)
    one.R = np.eye(3) * NOISE_M**2
    for i in range(UPDATES):
        record = case.readings[i % len(case.readings)].record
        state = np.zeros(settle.numel_in(2))
        while len(state):
            following, _ = settle(one.x, record, state)
            moved = np.abs(np.array(following).ravel() - state).max()
            state = np.array(following).ravel()
            if moved <= NEAR_REST_RAD:
                break
        _, residual, transposed = linearise(one.x, record, state)
        slope = -np.array(transposed).T
        one.update(np.array(residual).ravel(), lambda x, slope=slope: slope, lambda x: np.zeros(3))
    return one.x, one.P


def _apart(ours: Belief, plain: tuple[Array, Array], state_space: StateSpace) -> float:
    """The largest difference in standard deviations."""
    values, covariance = plain
    apart = np.abs(ours.values(state_space)[state_space.entries] - values) / np.sqrt(np.diag(covariance))
    return float(apart.max())


def _growth(case: Case) -> tuple[float, float]:
    """How long many updates take (s), and by how many MB the most memory that was ever used grows."""
    case.run()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = once(partial(case.run, MANY))
    return seconds, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
