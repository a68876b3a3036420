"""Whatever happens to the arm: the online calibration beside a robust refit of the last 40 records."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from armcal.errors import NotConvergedError
from armcal.estimate.robust import median_norm, tuned
from armcal_online.belief import Reading
from armcal_online.state import FilterSetup
from online_arm import AXES, JOINTS, NOISE_M, PROBES, STATES, World, begun, predicted

pytestmark = pytest.mark.slow
BEFORE, AFTER, EVERY = 60, 100, 4
RUNNING = 5
"""Errors are averaged over so many of the records that are looked at."""
_WEAK = {"m": 0.01, "rad": 0.1, "rad_per_Nm": 0.08}


class Loaded(World):
    """An arm that carries what nobody states (kg)."""

    payload = 0.0

    def tip(self, q: np.ndarray) -> np.ndarray:
        if not self.payload:
            return predicted(self.setup, self.values, q)
        channels = dict(zip(JOINTS, q.tolist(), strict=True)) | dict.fromkeys(AXES, 0.0) | {"payload": self.payload}
        (reading,) = self.setup.observer.readings(channels, {})
        return -self.setup.observer.linearise(self.values, reading)[0]


class Reference:
    """Reweighted least squares over the last 40 records, with priors of 10 mm, 6 deg and more than any compliance.

    It starts where it ended, and where least squares end: the nearer half of the records decides.
    """

    def __init__(self, setup: FilterSetup) -> None:
        self._setup, self._point, self.readings = setup, np.zeros(STATES), list[Reading]()
        self._known = (setup.space.scales / [_WEAK[block.unit] for block in setup.space.parameters.free]) ** 2

    def values(self, point: np.ndarray) -> np.ndarray:
        return self._setup.space.inside(self._setup.space.moved(self._setup.belief.origin, point))

    def refitted(self) -> np.ndarray:
        ends = [self._ended(self._point, True), self._ended(self._ended(self._point, False)[0], True)]
        self._point = min(ends, key=lambda end: end[1])[0]
        return self.values(self._point)

    def _ended(self, point: np.ndarray, robust: bool) -> tuple[np.ndarray, float]:
        start, typical = point, np.inf
        for _ in range(12):
            try:
                values = self.values(point)
                pairs = [self._setup.observer.linearise(values, reading) for reading in self.readings[-40:]]
            except NotConvergedError:
                return start, np.inf
            innovation, slope = (np.array(part) / NOISE_M for part in zip(*pairs, strict=True))
            norms = np.linalg.norm(innovation, axis=1)
            typical = float(np.median(norms)) / median_norm(3)
            weight = tuned("cauchy", 3).weight(norms / max(typical, 1.0)) if robust else np.ones(len(norms))
            weight = weight / max(typical, 1.0) ** 2
            information = np.einsum("i,ikn,ikm->nm", weight, slope, slope) + np.diag(self._known)
            gradient = np.einsum("i,ikn,ik->n", weight, slope, innovation) - self._known * point
            step = np.linalg.solve(information, gradient)
            point = point + step
            if step @ information @ step < 0.01 * STATES:
                break
        return point, typical


def _two_slips(arm: Loaded, since: int) -> None:
    if since == 0:
        for joint in arm.random.choice(np.arange(1, 7), 2, replace=False):
            arm.moved(f"arm.mdh.theta{joint}", np.radians(14.4) * arm.random.choice([-1, 1]))


def _outliers(arm: Loaded, since: int) -> None:
    arm.outliers, arm.outlier = 0.15, float(np.exp(arm.random.uniform(np.log(0.03), np.log(0.5))))


def _growing_bias(arm: Loaded, since: int) -> None:
    arm.bias = arm.bias + np.array([1.0, -0.5, 0.3]) * 5e-5


def _creeping_joint(arm: Loaded, since: int) -> None:
    arm.moved("arm.mdh.theta3", np.radians(0.03))


def _payload(arm: Loaded, since: int) -> None:
    arm.payload = 0.15


def _errors(seed: int, happens: Callable[[Loaded, int], None]) -> np.ndarray:
    """Tip errors (mm) of the online calibration and of the reference."""
    recalibrator, arm = begun(), Loaded.drawn(9000 + seed, outliers=0.05)
    reference, errors = Reference(arm.setup), []
    for k in range(BEFORE + AFTER):
        if k >= BEFORE:
            happens(arm, k - BEFORE)
        record = arm.record()
        reference.readings += arm.setup.observer.readings(record.channels, {})
        recalibrator.take(record, k + 1)
        if k >= BEFORE and k % EVERY == 0:
            true = np.array([arm.turn @ arm.tip(q) + arm.bias for q in PROBES])
            both = [(recalibrator.setup, recalibrator.values), (arm.setup, reference.refitted())]
            tips = np.array([[predicted(of, of.space.inside(values), q) for q in PROBES] for of, values in both])
            errors.append(1000 * np.linalg.norm(tips - true, axis=2).mean(axis=1))
    return np.array(errors)


@pytest.mark.parametrize("happens", [_two_slips, _outliers, _growing_bias, _creeping_joint, _payload])
def test_it_is_never_much_worse_than_a_refit_of_the_last_40_records(happens: Callable, seeds: int = 3) -> None:
    worst = []
    for seed in range(seeds):
        errors = _errors(seed, happens)
        smooth = np.array([np.convolve(e, np.full(RUNNING, 1 / RUNNING), "valid") for e in errors.T])
        worst.append(float((smooth[0] / smooth[1]).max()))
        print(
            f"{happens.__name__[1:]}, seed {seed}: {errors[:, 0].mean():.3f} mm in the mean, the refit "
            f"{errors[:, 1].mean():.3f}; at worst {worst[-1]:.2f} times it"
        )
    assert max(worst) <= 1.2
