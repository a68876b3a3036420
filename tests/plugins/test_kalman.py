"""The online estimator against a textbook Kalman filter, and where curvature matters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from armcal.errors import ProblemError
from armcal.estimate.online import Gaussian, Linearised, OnlineEstimator, Update, checked
from armcal.plugins import Component, discover
from armcal.testing.contract import check_component, check_plugin
from armcal_kalman.filters import ExtendedFilter, ExtendedSettings

MADE: dict[str, Callable[[], OnlineEstimator]] = {
    "extended": lambda: ExtendedFilter(ExtendedSettings()),
    "one pass": lambda: ExtendedFilter(ExtendedSettings(iterations=1)),
}
each = pytest.mark.parametrize("name", MADE)


@dataclass
class Curved:
    """A record of any function of the state; counts how often it is looked at."""

    measured: np.ndarray
    function: Callable[[np.ndarray], np.ndarray]
    slope: Callable[[np.ndarray], np.ndarray]
    noise: np.ndarray
    looks: list[np.ndarray] = field(default_factory=list)

    def at(self, place: np.ndarray) -> Linearised:
        self.looks.append(place.copy())
        return Linearised(self.measured - self.function(place), self.slope(place), self.noise)


def line(measured: np.ndarray, slope: np.ndarray, noise: np.ndarray) -> Curved:
    return Curved(measured, lambda x: slope @ x, lambda x: slope, noise)


def textbook(mean: np.ndarray, covariance: np.ndarray, record: Curved) -> tuple[np.ndarray, np.ndarray]:
    """Kalman's update as it stands in any book."""
    slope = record.slope(mean)
    gain = covariance @ slope.T @ np.linalg.inv(slope @ covariance @ slope.T + record.noise)
    return mean + gain @ (record.measured - record.function(mean)), covariance - gain @ slope @ covariance


def taken(estimator: OnlineEstimator, prior: Gaussian, records: list[Curved]) -> Update:
    """All records one by one."""
    update = estimator.update(prior, records[0])
    for record in records[1:]:
        update = estimator.update(update.posterior, record)
    return update


@each
@pytest.mark.parametrize(("states", "rows"), [(1, 1), (3, 2), (35, 3), (6, 7)])
def test_a_linear_problem_is_solved_as_kalman_does(name: str, states: int, rows: int) -> None:
    random = np.random.default_rng(states)
    root = random.normal(size=(states, states)) / np.sqrt(states)
    prior = Gaussian(random.normal(size=states), root @ root.T + 0.1 * np.eye(states))
    noise = np.diag(random.uniform(0.01, 0.5, rows)) + 0.02
    truth = prior.mean + root @ random.normal(size=states)
    slopes = random.normal(size=(17, rows, states))
    records = [line(s @ truth + 0.2 * random.normal(size=rows), s, noise) for s in slopes]
    mean, covariance = prior.mean, prior.covariance
    for record in records:
        mean, covariance = textbook(mean, covariance, record)
    posterior = taken(MADE[name](), prior, records).posterior
    sd = np.sqrt(np.diag(covariance))
    assert np.abs((posterior.mean - mean) / sd).max() < 1e-8
    assert np.abs((posterior.covariance - covariance) / np.outer(sd, sd)).max() < 1e-8
    assert (posterior.covariance == posterior.covariance.T).all()


@each
def test_the_innovation_is_that_of_the_last_record(name: str) -> None:
    prior = Gaussian(np.array([1.0, -2.0]), np.diag([4.0, 1.0]))
    record = line(np.array([0.7]), np.array([[1.0, 0.5]]), np.array([[0.25]]))
    update = MADE[name]().update(prior, record)
    assert update.innovation == pytest.approx([0.7])
    assert update.covariance == pytest.approx(np.array([[4.0 + 0.25 + 0.25]]))


@each
def test_what_no_record_sees_keeps_its_variance(name: str) -> None:
    prior = Gaussian(np.zeros(3), np.diag([1.0, 2.0, 3.0]))
    records = [line(np.array([0.1]), np.array([[1.0, 0.0, 0.0]]), np.array([[0.01]])) for _ in range(100)]
    covariance = taken(MADE[name](), prior, records).posterior.covariance
    assert np.diag(covariance)[1:] == pytest.approx([2.0, 3.0], rel=1e-9)
    assert covariance[0, 0] == pytest.approx(1 / (1 + 100 / 0.01), rel=1e-6)


def angle_record(truth: np.ndarray, noise: float) -> Curved:
    """A point at a length and an angle: what a joint that slipped by much looks like."""

    def place(x: np.ndarray) -> np.ndarray:
        return np.array([x[0] * np.cos(x[1]), x[0] * np.sin(x[1])])

    def slope(x: np.ndarray) -> np.ndarray:
        return np.array([[np.cos(x[1]), -x[0] * np.sin(x[1])], [np.sin(x[1]), x[0] * np.cos(x[1])]])

    return Curved(place(truth), place, slope, np.eye(2) * noise**2)


def test_iterating_helps_where_curvature_matters() -> None:
    prior = Gaussian(np.array([1.0, 0.0]), np.diag([0.05, 0.5]) ** 2)
    truth, noise = np.array([1.02, 0.6]), 1e-3
    wrong = {}
    for name in MADE:
        update = MADE[name]().update(prior, angle_record(truth, noise))
        off = update.posterior.mean - truth
        sd = np.sqrt(np.diag(update.posterior.covariance))
        wrong[name] = float(np.abs(off / sd).max())
    print(f"\noff after one record, in claimed standard deviations: {wrong}")
    assert wrong["extended"] < 1
    assert wrong["one pass"] > 20


@each
def test_a_negative_variance_is_an_error(name: str) -> None:
    prior = Gaussian(np.zeros(2), np.diag([1.0, -1e-3]))
    record = line(np.array([0.1]), np.array([[1.0, 0.0]]), np.array([[0.01]]))
    with np.errstate(invalid="ignore"), pytest.raises((ProblemError, np.linalg.LinAlgError)):
        MADE[name]().update(prior, record)


@each
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_number_that_is_not_finite_never_gets_into_a_belief(name: str, value: float) -> None:
    prior = Gaussian(np.zeros(2), np.eye(2))
    record = line(np.array([value]), np.array([[1.0, 0.0]]), np.array([[0.01]]))
    with np.errstate(invalid="ignore"), pytest.raises((ProblemError, np.linalg.LinAlgError)):
        MADE[name]().update(prior, record)


def test_a_belief_is_made_symmetric_and_nothing_else() -> None:
    belief = checked(Gaussian(np.zeros(2), np.array([[1.0, 0.3], [0.1, 2.0]])))
    assert (belief.covariance == [[1.0, 0.2], [0.2, 2.0]]).all()
    with pytest.raises(ProblemError, match="variance"):
        checked(Gaussian(np.zeros(2), np.diag([1.0, -1e-300])))


def test_the_plugin_keeps_to_its_contract() -> None:
    registry = discover()
    plugin = next(p for p in registry.plugins if p.name == "kalman")
    results = check_plugin(plugin, registry)
    assert [r for r in results if r.fault] == []
    assert sum("prior and record say together" in r.check for r in results) == 1


class _Faulty(ExtendedFilter):
    """Does something that the contract forbids."""

    fault = ""

    def update(self, prior, observation):
        update = super().update(prior, observation)
        mean, covariance = update.posterior.mean, update.posterior.covariance
        if self.fault == "wide":
            return Update(Gaussian(mean, 1.001 * covariance), update.innovation, update.covariance)
        if self.fault == "skew":
            covariance = covariance.copy()
            covariance[0, 1] += 1e-15
            return Update(Gaussian(mean, covariance), update.innovation, update.covariance)
        if self.fault == "changes":
            prior.mean[0] += 1e-3
        if self.fault == "keeps":
            self.count = getattr(self, "count", 0) + 1
            return Update(Gaussian(mean * (1 + 1e-13 * self.count), covariance), update.innovation, update.covariance)
        return update


class Wide(_Faulty):
    fault = "wide"


class Skew(_Faulty):
    fault = "skew"


class Changes(_Faulty):
    fault = "changes"


class Keeps(_Faulty):
    fault = "keeps"


@pytest.mark.quick("Keeps-other results")
@pytest.mark.parametrize(
    ("name", "said"),
    [("Wide", "covariance"), ("Skew", "symmetric"), ("Changes", "changed the prior"), ("Keeps", "other results")],
)
def test_the_contract_finds_what_breaks_it(name: str, said: str) -> None:
    results = check_component(Component("online", name, f"{__name__}:{name}", "", "faulty"))
    assert any(said in r.fault for r in results), [r for r in results if r.fault]
