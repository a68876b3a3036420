"""Wrong records, of whatever size, are no change of the arm: the density of an outlier, and what a decision needs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from armcal.estimate.online import log_density
from armcal_online.sources import Incoming
from armcal_online.window_evidence import JointDensity, log_density_of_outlier
from online_arm import AXES, World, begun, told
from scipy.stats import multivariate_normal

SETTLED = 40


def test_outliers_of_30_to_500_mm_cost_about_the_same() -> None:
    """A record of 0.5 mm noise costs 13.5 in log density if it is wrong by 30 mm, and 23 if it is wrong by 500 mm."""
    expected, stated = np.eye(3) * 0.0005**2, np.eye(3) * 0.03**2
    good = multivariate_normal(np.zeros(3), expected).logpdf(np.zeros(3))
    costs = []
    for size in (0.03, 0.1, 0.3, 0.5):
        innovation = np.array([1.0, -1.0, 1.0]) * size / math.sqrt(3)
        costs.append(good - log_density_of_outlier(innovation, expected, stated, math.inf))
    print(f"\ncost in log density by size: {np.round(costs, 1)}")
    assert costs == sorted(costs)
    assert costs[-1] - costs[0] < 11
    narrow = good - multivariate_normal(np.zeros(3), expected + stated).logpdf(innovation)
    assert narrow - costs[0] > 80


@pytest.mark.parametrize("freedom", [math.inf, 40.0])
def test_the_joint_density_of_fewer_and_of_more_records_is_that_of_a_new_factorisation(freedom: float) -> None:
    random = np.random.default_rng(3)
    sizes = (3, 7, 3, 1)
    ends = np.cumsum((0, *sizes))
    rows = [slice(int(a), int(b)) for a, b in pairwise(ends)]
    root = random.normal(size=(14, 20))
    innovation, covariance = random.normal(size=14), root @ root.T
    joint, chosen = JointDensity(innovation, covariance, rows), np.array([True, False, True, True])

    def density(which: np.ndarray) -> float:
        at = np.concatenate([np.arange(r.start, r.stop) for r, one in zip(rows, which, strict=True) if one])
        own = covariance[np.ix_(at, at)]
        nis = float(innovation[at] @ np.linalg.solve(own, innovation[at]))
        return log_density(nis, float(np.linalg.slogdet(own)[1]), len(at), freedom)

    here, _, changed = joint.log_densities(chosen, freedom)
    assert here == pytest.approx(density(chosen), abs=1e-9)
    for i in range(4):
        assert changed[i] == pytest.approx(density(chosen ^ (np.arange(4) == i)), abs=1e-9)


def exchanged(records: list[Incoming], share: float, random: np.random.Generator) -> set[int]:
    """Positions of some records exchanged, two by two."""
    count = int(share * len(records)) // 2 * 2
    places = random.choice(np.arange(SETTLED, len(records)), count, replace=False).tolist()
    for i, k in zip(places[::2], places[1::2], strict=True):
        for axis in AXES:
            one, other = records[i].channels, records[k].channels
            one[axis], other[axis] = other[axis], one[axis]
    return set(places)


def decisions_of(records: list[Incoming]) -> list[Mapping[str, Any]]:
    session = begun()
    events = [event for k, record in enumerate(records, 1) for event in session.take(record, k)]
    return told(events, "decision")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "count"), [(0, 130), *(pytest.param(s, 1000, marks=pytest.mark.slow) for s in range(3))]
)
def test_exchanged_records_are_no_slip(seed: int, count: int) -> None:
    """Two of nine rows exchanged once made a joint slip by +0.00 +- 14.90 deg, which explained none of their misfit."""
    arm = World.drawn(seed)
    records = [arm.record() for _ in range(count)]
    exchanged(records, 0.05, np.random.default_rng(seed))
    assert [event for event in decisions_of(records) if event["kind"] != "unexplained"] == []


@pytest.mark.slow
@pytest.mark.parametrize("size_mm", [500, *(pytest.param(s, marks=pytest.mark.slow) for s in (30, 100, 300))])
def test_outliers_of_any_size_change_nothing(size_mm: int) -> None:
    arm = World.drawn(5, outliers=0.05, outlier=size_mm / 1000)
    assert decisions_of([arm.record() for _ in range(220)]) == []


@pytest.mark.slow
def test_a_stream_with_many_outliers_is_not_alarmed_by_as_many() -> None:
    """A fifth is wrong where 5 % are stated: 5 of 8 records once were called unexplained at the 189th."""
    arm = World.drawn(2, outliers=0.2, outlier=0.1)
    assert decisions_of([arm.record() for _ in range(200)]) == []


@pytest.mark.slow
def test_a_slip_is_named_among_large_outliers() -> None:
    arm = World.drawn(6, outliers=0.1, outlier=0.3)
    records = [arm.record() for _ in range(SETTLED)]
    arm.moved("arm.mdh.theta2", math.radians(6))
    records += [arm.record() for _ in range(6)]
    first = decisions_of(records)[0]
    assert (first["kind"], first["joint"]) == ("joint_slipped", "arm.q2")
    assert first["size_deg"] == pytest.approx(6, abs=0.3)


def test_one_record_is_no_evidence_of_a_change() -> None:
    """However far off it is, whichever way: two have to agree."""
    arm = World.drawn(8)
    records = [arm.record() for _ in range(SETTLED)]
    arm.moved("arm.mdh.theta3", math.radians(14.4))
    records.append(arm.record())
    arm.moved("arm.mdh.theta3", -math.radians(14.4))
    records += [arm.record() for _ in range(10)]
    assert decisions_of(records) == []
