"""Checks on online estimators: a small linear problem whose answer is a sum of information."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from armcal.base.arrays import Array
from armcal.errors import ProblemError
from armcal.estimate.online import Gaussian, Linearised, Observation, OnlineEstimator, Update
from armcal.testing.results import ContractError, Recorder, expect
from armcal.testing.settings_checks import Subject

RECORDS, STATES, ROWS = 12, 4, 2
TOLERANCE = 1e-7
"""Of a number in its standard deviation."""


@dataclass(frozen=True)
class _Line(Observation):
    """A record whose prediction is linear in the state, so that it looks alike from anywhere."""

    measured: Array
    slope: Array
    noise: Array

    @override
    def at(self, point: Array) -> Linearised:
        return Linearised(self.measured - self.slope @ point, self.slope, self.noise)


def check_online(record: Recorder, subject: Subject) -> None:
    """The information of prior and records, once each; nothing that it was given is changed, nothing is kept."""
    with record.needed("it builds"):
        estimator: OnlineEstimator = subject.build()
    with record.needed("it says how many records it wants to see again"):
        window = estimator.window
        whole = isinstance(window, int) and window >= 1
        expect(whole, f"found window = {window!r}, expected a number of records from 1")
    prior, lines = _case()
    with record.needed("it takes a record"):
        updates = _taken(estimator, prior, lines)
    _check_updates(record, updates, prior, lines)
    with record.check("it changes nothing that it is given"):
        mean, covariance = prior.mean.copy(), prior.covariance.copy()
        estimator.update(prior, lines[:1])
        kept = bool(np.array_equal(mean, prior.mean) and np.array_equal(covariance, prior.covariance))
        expect(kept, "it changed the prior that it was given")
    with record.check("it keeps nothing from one update to the next"):
        for before, update in zip(updates, _taken(estimator, *_case()), strict=True):
            first, again = before.posterior, update.posterior
            same = np.array_equal(first.mean, again.mean) and np.array_equal(first.covariance, again.covariance)
            expect(same, "the same records gave other beliefs the second time")
    with record.check("a variance below zero is an error"):
        _expect_refusal(estimator, prior, lines[0])


def _check_updates(record: Recorder, updates: Sequence[Update], prior: Gaussian, lines: Sequence[_Line]) -> None:
    """After each record, against what prior and records say together; innovations against the first record's."""
    with record.check("its covariance is exactly symmetric and positive"):
        for place, update in enumerate(updates, start=1):
            covariance = update.posterior.covariance
            expect(bool((covariance == covariance.T).all()), f"found a covariance that is not symmetric after {place}")
            lowest = float(np.linalg.eigvalsh(covariance)[0])
            expect(lowest > 0, f"found the eigenvalue {lowest:.2g} after record {place}, expected all above zero")
    with record.check("it finds what prior and records say together"):
        for place, update in enumerate(updates, start=1):
            known = _known(prior, lines[:place])
            sd = np.sqrt(np.diag(known.covariance))
            off = float(np.abs((update.posterior.mean - known.mean) / sd).max())
            expect(off < TOLERANCE, f"found a mean {off:.1e} standard deviations off after record {place}")
            wide = float(np.abs((update.posterior.covariance - known.covariance) / np.outer(sd, sd)).max())
            expect(wide < TOLERANCE, f"found a covariance {wide:.1e} off after record {place}, in units of variances")
    with record.check("it reports the NIS of the last record"):  # of the first: the prior is known, whatever the window
        update, first = updates[0], lines[0]
        innovation = update.innovation - (first.measured - first.slope @ prior.mean)
        covariance = update.covariance - (first.slope @ prior.covariance @ first.slope.T + first.noise)
        off = max(float(np.abs(innovation).max()), float(np.abs(covariance).max()))
        expect(off < TOLERANCE, f"found an innovation or its covariance {off:.1e} off for the first record")


def _case() -> tuple[Gaussian, tuple[_Line, ...]]:
    random = np.random.default_rng(3)
    root = random.normal(size=(STATES, STATES))
    prior = Gaussian(random.normal(size=STATES), root @ root.T + np.eye(STATES))
    noise = np.array([[0.2, 0.05], [0.05, 0.1]])
    truth = prior.mean + root @ random.normal(size=STATES)
    slopes = random.normal(size=(RECORDS, ROWS, STATES))
    return prior, tuple(_Line(s @ truth + 0.3 * random.normal(size=ROWS), s, noise) for s in slopes)


def _taken(estimator: OnlineEstimator, prior: Gaussian, lines: Sequence[_Line]) -> list[Update]:
    """Each record in turn: a filter goes on from its posterior, a window from the prior of its first record."""
    window, updates, known, belief = estimator.window, [], prior, prior
    held: list[_Line] = []
    for line in lines:
        held.append(line)
        update = estimator.update(belief if window == 1 else known, held if window > 1 else [line])
        belief = update.posterior
        shapes = belief.mean.shape, belief.covariance.shape, update.innovation.shape, update.covariance.shape
        expected = (STATES,), (STATES, STATES), (ROWS,), (ROWS, ROWS)
        expect(shapes == expected, f"found arrays of the shapes {shapes}, expected {expected}")
        updates.append(update)
        if len(held) == window > 1:
            known = _known(known, held[:1])
            held = held[1:]
    return updates


def _known(prior: Gaussian, lines: Sequence[_Line]) -> Gaussian:
    """By information: what prior and records say."""
    information = np.linalg.inv(prior.covariance)
    projected = information @ prior.mean
    for line in lines:
        weighted = line.slope.T @ np.linalg.inv(line.noise)
        information, projected = information + weighted @ line.slope, projected + weighted @ line.measured
    covariance = np.linalg.inv(information)
    return Gaussian(covariance @ projected, covariance)


def _expect_refusal(estimator: OnlineEstimator, prior: Gaussian, line: _Line) -> None:
    covariance = np.diag([1.0, 1.0, 1.0, -0.5])
    blind = _Line(line.measured, line.slope * [1, 1, 1, 0], line.noise)
    try:
        with np.errstate(invalid="ignore"):
            estimator.update(Gaussian(prior.mean, covariance), [blind])
    except (ProblemError, np.linalg.LinAlgError):
        return
    raise ContractError("found a belief made of a variance of -0.5, expected armcal.errors.ProblemError")
