"""Undetermined combinations are exactly those planted, by hand and by a plain numpy model; none is invented."""

from __future__ import annotations

import numpy as np
import pytest
from armcal.estimate.identifiability import determined_by, explain, identify
from planted_arms import PLANTED, SOUND, as_rows, full, oracle_null, same_span


@pytest.mark.quick(
    "a joint that stood at zero",
    "a shoulder that never moved",
    "a turn of the tool about its own point",
    "a twist behind the last joint",
    "two effects of the same meaning",
)
@pytest.mark.parametrize("name", PLANTED)
def test_what_is_planted_is_found_exactly_and_nothing_else(name: str) -> None:
    case = PLANTED[name]
    problem, records, start = case.problem(noise=0.001)
    known = identify(problem.with_records(records), start)
    found = explain(problem.with_records(records), start, known)
    scales = dict(zip(known.names, problem.parameters.scales(), strict=True))
    told = [{n: w * scales[n] for n, w in each.combination.terms} for each in found]
    planted = [{full(n): w for n, w in each.items()} for each, _ in case.planted]
    sizes = np.array([scales[n] for n in known.names])
    assert same_span(as_rows(told, known.names, sizes), as_rows(planted, known.names, sizes))
    by_oracle = oracle_null(case, scales)[:, [case.free.index(n.rpartition(".")[2]) for n in known.names]]
    assert same_span(by_oracle, as_rows(planted, known.names, sizes))
    assert sorted(each.cause for each in found) == sorted(cause for _, cause in case.planted)
    assert known.rank == known.rank_by_qr == len(case.free) - len(case.planted)
    taking_part = {n for each in planted for n in each}
    by = determined_by(known, problem.parameters, np.zeros(len(known)))
    assert {n: own for n, own in zip(known.names, by, strict=True) if own != "data"} == dict.fromkeys(
        taking_part, "nothing"
    )


@pytest.mark.parametrize("name", PLANTED)
def test_what_is_told_has_no_more_names_than_what_was_planted(name: str) -> None:
    case = PLANTED[name]
    problem, records, start = case.problem()
    found = explain(problem.with_records(records), start, identify(problem.with_records(records), start))
    assert sorted(len(each.combination.terms) for each in found) == sorted(len(each) for each, _ in case.planted)


@pytest.mark.quick(
    "a planar arm", "a shoulder that stood, and what it leaves", "a tool's lengths", "an elbow arm", "three links"
)
@pytest.mark.parametrize("name", SOUND)
def test_nothing_is_invented(name: str) -> None:
    case = SOUND[name]
    problem, records, start = case.problem(noise=0.001)
    known = identify(problem.with_records(records), start)
    assert not len(oracle_null(case, dict(zip(known.names, problem.parameters.scales(), strict=True))))
    assert known.rank == known.rank_by_qr == len(case.free)
    assert known.undetermined == () == explain(problem.with_records(records), start, known)
    assert {*determined_by(known, problem.parameters, np.zeros(len(known)))} == {"data"}


@pytest.mark.parametrize("name", ["base yaw and the first zero", "a shoulder that never moved", "tool and target"])
def test_moving_along_a_told_combination_changes_no_measurement(name: str) -> None:
    problem, records, start = PLANTED[name].problem()
    known = identify(problem.with_records(records), start)
    (found,) = explain(problem.with_records(records), start, known)
    moved = start.copy()
    for term, weight in found.combination.terms:
        moved[problem.parameters.entries_of(term)] += weight * 0.5 * problem.parameters[term].scale
    before, after = problem.with_records(records).residuals(start)[0], problem.with_records(records).residuals(moved)[0]
    assert np.abs(after - before).max() < 1e-12
    first = found.combination.terms[0][0]
    alone = start.copy()
    alone[problem.parameters.entries_of(first)] += 0.5 * problem.parameters[first].scale
    assert np.abs(problem.with_records(records).residuals(alone)[0] - before).max() > 1e-3


def test_there_are_twenty_of_each() -> None:
    assert len(PLANTED) >= 20 and len(SOUND) >= 20
