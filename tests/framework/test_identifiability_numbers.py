"""What a rank decision rests on: weights, units, priors, both decompositions; covariances and correlations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from armcal.base.parameters import Parameters
from armcal.estimate.identifiability import (
    analyse,
    correlated_pairs,
    determined_by,
    expected_covariance,
    explain,
    identify,
    unheld,
)
from planted_arms import PLANTED, POSES, SOUND, full


def test_the_order_of_records_and_the_unit_of_a_parameter_do_not_matter() -> None:
    problem, records, start = PLANTED["a shoulder that never moved"].problem()
    known = identify(problem.with_records(records), start)
    shuffled = problem.with_records(records).subset(np.random.default_rng(2).permutation(POSES)).records
    again = identify(problem.with_records(shuffled), start)
    assert [str(c) for c in again.undetermined] == [str(c) for c in known.undetermined]
    np.testing.assert_allclose(again.singular_values, known.singular_values, atol=1e-9 * known.singular_values[0])
    triangle = problem.with_records(records).triangular_factor(start)
    for factor in (1e-3, 1e3):
        # Parameters in mm instead of m: columns and typical scales change against each other.
        other = analyse(triangle * factor, problem.parameters.scales() / factor, known.names)
        assert other.rank == known.rank
        np.testing.assert_allclose(other.singular_values, known.singular_values, atol=1e-9 * known.singular_values[0])


def test_records_without_weight_are_no_evidence() -> None:
    case = SOUND["an elbow that stood, and what it leaves"]
    problem, records, start = replace(case, free=("a1", "a2", "theta1"), held={}).problem()
    assert identify(problem.with_records(records), start).rank == 3
    one = (replace(records[0], weight=np.where(np.arange(len(records[0].weight)) == 0, 1.0, 0.0)),)
    assert identify(problem.with_records(one), start).rank == 2
    assert {
        each.cause for each in explain(problem.with_records(one), start, identify(problem.with_records(one), start))
    } == {"poses"}


def test_no_equations_at_all_determine_nothing_and_say_so() -> None:
    problem, records, start = SOUND["a planar arm"].problem()
    none = problem.with_records(records).subset(np.zeros(0, dtype=np.intp)).records
    known = identify(problem.with_records(none), start)
    assert known.rank == 0 and len(known.undetermined) == 4
    assert {each.cause for each in explain(problem.with_records(none), start, known)} == {"unknown"}


def test_priors_hold_what_they_touch_and_no_more() -> None:
    problem, records, start = PLANTED["three heights of parallel axes"].problem()
    known = identify(problem.with_records(records), start)

    def with_priors(*names: str) -> Parameters:
        blocks = {full(n): replace(problem.parameters[full(n)], prior_sd=0.001) for n in names}
        return problem.parameters.replaced(blocks)

    def by(which: str, *priors: str) -> set[str]:
        sources = determined_by(known, with_priors(*priors), np.zeros(len(known)))
        return {name for name, own in zip(known.names, sources, strict=True) if own == which}

    heights = {full("d1"), full("d2"), full("d3")}
    assert len(unheld(with_priors(), known)) == 2 and by("nothing") == heights
    # One prior can hold one of two: the other two heights still trade.
    assert len(unheld(with_priors("d1"), known)) == 1
    assert by("nothing", "d1") == {full("d2"), full("d3")} and by("prior", "d1") == {full("d1")}
    assert len(unheld(with_priors("d1", "d3"), known)) == 0 and by("prior", "d1", "d3") == heights
    assert len(unheld(with_priors("a1"), known)) == 2


def test_a_hardly_determined_direction_is_named_with_its_uncertainty() -> None:
    triangle = np.diag([1e3, 1e2, 0.05])
    known = analyse(triangle, np.ones(3), ("a", "b", "c"))
    ((told, deviation),) = known.hardly
    assert str(told) == "c alone" and deviation == pytest.approx(20.0)
    assert known.undetermined == () and known.rank == 3
    assert analyse(np.diag([1e3, 1e2, 50.0]), np.ones(3), ("a", "b", "c")).hardly == ()


def test_where_the_two_rank_decisions_differ_nothing_is_called_undetermined() -> None:
    """Kahan's matrix: every pivot of its QR decomposition is far above its smallest singular value [Golub2013]."""
    n, c = 120, 0.2
    s = np.sqrt(1 - c * c)
    kahan = np.diag(s ** np.arange(n)) @ (np.eye(n) - c * np.triu(np.ones((n, n)), 1))
    kahan *= 1 - 1e-7 * np.arange(n)
    names = tuple(f"p{i}" for i in range(n))
    known = analyse(kahan, np.ones(n), names)
    by_svd = int(np.sum(known.singular_values > 1e-9 * known.singular_values[0]))
    assert known.rank == known.rank_by_qr > by_svd and known.undetermined == ()
    assert known.hardly


def test_correlations_above_the_limit_are_those_of_the_inverse_information() -> None:
    problem, records, start = SOUND["axes parallel but for half a degree"].problem()
    triangle = problem.with_records(records).triangular_factor(start)
    covariance = expected_covariance(triangle, problem.parameters)
    expected = np.linalg.inv(triangle.T @ triangle)
    np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-9 * expected.max())
    (pair,) = correlated_pairs(covariance, problem.parameters.coordinate_names)
    assert set(pair[:2]) == {"arm.mdh.d1", "arm.mdh.d2"} and pair[2] < -0.99


def test_undetermined_parameters_have_no_expected_deviation_unless_a_prior_gives_one() -> None:
    problem, records, start = PLANTED["heights of parallel axes"].problem()
    triangle = problem.with_records(records).triangular_factor(start)
    names = problem.parameters.coordinate_names
    variance = dict(zip(names, np.diag(expected_covariance(triangle, problem.parameters)), strict=True))
    assert variance["arm.mdh.d1"] == variance["arm.mdh.d2"] == 0 < variance["arm.mdh.a1"]
    held = problem.parameters.replaced({"arm.mdh.d1": replace(problem.parameters["arm.mdh.d1"], prior_sd=0.002)})
    variance = dict(zip(names, np.diag(expected_covariance(triangle, held)), strict=True))
    assert np.sqrt(variance["arm.mdh.d1"]) == pytest.approx(0.002, rel=1e-6)
    assert np.sqrt(variance["arm.mdh.d2"]) == pytest.approx(np.hypot(0.002, 0.001 / np.sqrt(POSES)), rel=1e-6)
