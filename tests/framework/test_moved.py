"""A socket that moved while it was used: found, told with its size, and not seen where nothing moved."""

from __future__ import annotations

import re
from types import SimpleNamespace

import contact_oracle as co
import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.diagnose.gross import worse_than_nominal
from armcal.diagnose.record_checks import FEWEST_IN_GROUP, moved
from armcal.estimate.polish import mislabelled, settled, started, untrained
from armcal_contact.contacts import BallInSocket, BallInSocketSettings
from fits import fit_that_found

NOISE = 2e-4
PLACES = {"hole_0": (0.35, 0.1, 0.25), "hole_1": (0.38, 0.12, 0.27)}


def found(shift_m: float, before: int, count: int = 20, seed: int = 0):
    """What is said of two sockets, the first shifted after so many records."""
    random = np.random.default_rng(seed)
    joints, sockets = [], []
    for name, place in PLACES.items():
        parts = [before, count - before] if name == "hole_0" else [0, count]
        for part, at in zip(parts, (place, np.add(place, [shift_m, 0, 0])), strict=True):
            at = at if name == "hole_0" else place
            if part:
                joints.append(co.touching(co.ELBOW, co.in_socket(at), part, int(random.integers(1 << 30))))
            sockets += [name] * part
    q = np.vstack(joints) + random.normal(0, NOISE / 0.5, (len(sockets), len(co.ELBOW.rows)))
    channels = {f"arm.q{i + 1}": q[:, i] for i in range(q.shape[1])}
    extra = {"position": ("here",) * len(q), "socket": tuple(sockets)}
    data = Dataset(tuple(str(i) for i in range(len(q))), channels, extra)
    ball = BallInSocket(BallInSocketSettings.si(noise=NOISE), ("arm",))
    problem, records = co.Bench({"arm": co.the_arm(co.ELBOW)}, {"balls": ball}).problem(data)
    problem = started(problem.with_records(records))
    values = settled(untrained(problem).with_records(records), problem.parameters.nominal())
    estimate = SimpleNamespace(values=values, verdict=SimpleNamespace(converged=True))
    return moved(fit_that_found(estimate, {}, acting=problem))


@pytest.mark.parametrize("before", [4, 7, 15])
def test_a_socket_that_moved_is_named_with_where_and_how_far(before):
    (finding,) = found(0.006, before)
    told = re.match(r"here/hole_0: its first (\d+) records lie (.+) mm from the other (\d+), ", finding.text)
    assert (int(told[1]), int(told[3])) == (before, 20 - before) and "Did it move" in finding.text
    assert float(told[2]) == pytest.approx(6, rel=0.15)


@pytest.mark.parametrize("exchanged", [(), (4, 15)])
def test_records_that_name_each_others_socket_are_listed(exchanged: tuple[int, ...]) -> None:
    """Two postures of 24 whose labels were exchanged spoiled the fit, and were outliers of unknown cause."""
    names = [*["hole_0"] * 12, *["hole_1"] * 12]
    q = np.vstack([co.touching(co.ELBOW, co.in_socket(place), 12, seed) for seed, place in enumerate(PLACES.values())])
    q += np.random.default_rng(2).normal(0, NOISE / 0.5, q.shape)
    for record in exchanged:
        names[record] = "hole_1" if record < 12 else "hole_0"
    channels = {f"arm.q{i + 1}": q[:, i] for i in range(q.shape[1])}
    data = Dataset(tuple(map(str, range(24))), channels, {"position": ("here",) * 24, "socket": tuple(names)})
    ball = BallInSocket(BallInSocketSettings.si(noise=NOISE), ("arm",))
    problem, records = co.Bench({"arm": co.the_arm(co.ELBOW)}, {"balls": ball}).problem(data)
    listed = mislabelled(problem.with_records(records), data)
    assert len(listed) == (1 if exchanged else 0)
    for text in listed:
        assert "4 (named here/hole_1, at here/hole_0), 15 (named here/hole_0, at here/hole_1)." in text


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.quick("0", "3")
def test_nothing_is_said_where_nothing_moved(seed):
    assert found(0.0, 10, seed=seed) == []


def test_a_move_no_larger_than_the_scatter_is_not_claimed():
    assert found(2 * NOISE, 10) == []


def test_few_records_say_nothing():
    assert found(0.01, 3, count=FEWEST_IN_GROUP - 1) == []


def test_a_calibration_that_is_worse_than_none_is_told_by_the_records_that_judge():
    judged, nominal = np.array([np.nan, 12.0, 9.0, 11.0, 10.0, 10.5]), np.array([90.0, 6.0, 7.0, 6.0, 7.0, 6.5])
    (finding,) = worse_than_nominal(judged, nominal)
    assert finding.grade == "bad" and "10.50 mm" in finding.text and "6.50" in finding.text
    assert worse_than_nominal(nominal / 2, nominal) == []
    assert worse_than_nominal(np.full(6, np.nan), nominal) == []


def test_what_chance_makes_worse_than_nominal_is_a_note() -> None:
    """Paired differences of mean zero: about one set in a hundred is graded bad, and a real loss always is."""
    random, bad, noted = np.random.default_rng(5), 0, 0
    for _ in range(400):
        nominal = np.abs(random.normal(2.0, 0.5, 40))
        for finding in worse_than_nominal(nominal + random.normal(0.0, 0.3, 40), nominal):
            bad, noted = bad + (finding.grade == "bad"), noted + (finding.grade == "note")
    assert bad <= 10 and noted > 120
    (finding,) = worse_than_nominal(nominal + random.normal(0.3, 0.3, 40), nominal)
    assert finding.grade == "bad"
