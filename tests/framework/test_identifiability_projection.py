"""Rank is judged at zero residual: errors of measurement do not determine what no measurement could."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters, scalar
from armcal.estimate.estimator import Solution, SolverVerdict, estimate
from armcal.estimate.identifiability import analyse, explain, identify, require_solvable
from armcal.measure.measurement import Channel
from armcal.problem.problem import Problem
from armcal.problem.variants import projected
from armcal.testing.planar import GRAVITY, Tip, planar_arms

COUNT = 30


@dataclass(frozen=True)
class Bearing:
    """The angle under which the tip is seen from the base; blind to the size of the arm."""

    arms = ("arm",)

    def parameters(self):
        return ()

    def channels(self):
        return (Channel("bearing", "angle"),)

    def outputs(self, arms: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
        x, _, z = ca.vertsplit(arms["arm"].base_T_tool.translation)
        return {"bearing": ca.atan2(z, x)}

    def residual(self, arms: Mapping[str, Any], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """How far the tip lies beside the measured line of sight (m): no angle has to be unwrapped."""
        x, _, z = ca.vertsplit(arms["arm"].base_T_tool.translation)
        return ca.cos(measured["bearing"]) * z - ca.sin(measured["bearing"]) * x

    def noise(self):
        return (1e-3,)


@dataclass(frozen=True)
class Board:
    """The tip touches a flat board; its three coefficients have no size of their own, and nothing is read."""

    arms = ("arm",)

    def parameters(self):
        return tuple(scalar(n, "1", v, 0.1) for n, v in (("across", 0.2), ("up", 1.0), ("level", -0.1)))

    def channels(self):
        return ()

    def outputs(self, arms: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
        return {}

    def residual(self, arms: Mapping[str, Any], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        x, _, z = ca.vertsplit(arms["arm"].base_T_tool.translation)
        return values["across"] * x + values["up"] * z + values["level"]

    def noise(self):
        return (1e-3,)


def tip(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nominal planar arm in plain numpy: x and z of its tip; a turn about y takes x to -z."""
    one, two = q[:, 0], q[:, 0] + q[:, 1]
    return 0.3 * np.cos(one) + 0.25 * np.cos(two), -0.3 * np.sin(one) - 0.25 * np.sin(two)


def posed(
    measurement: Any, free: tuple[str, ...], q: np.ndarray, channels: Mapping[str, np.ndarray]
) -> tuple[Problem, Any, np.ndarray]:
    arms = planar_arms(["arm"])
    blocks = [*arms["arm"].parameters()]
    blocks += [replace(block, name=f"seen.{block.name}") for block in measurement.parameters()]
    parameters = Parameters(tuple(blocks)).with_free(free)
    dataset = Dataset(tuple(map(str, range(len(q)))), {"arm.q1": q[:, 0], "arm.q2": q[:, 1], **channels})
    problem = Problem.build(arms, {"seen": measurement}, parameters, GRAVITY, dataset, "interpreted")
    return problem, problem.of(dataset).records, parameters.nominal()


def poses(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (COUNT, 2))


def bearings(noise: float) -> tuple[Problem, Any, np.ndarray]:
    q = poses()
    x, z = tip(q)
    seen = np.arctan2(z, x) + noise * np.random.default_rng(7).normal(size=COUNT)
    names = ("arm.planar.a1", "arm.planar.a2", "arm.planar.theta2")
    return posed(Bearing(), names, q, {"seen.bearing": seen})


def touches(noise: float) -> tuple[Problem, Any, np.ndarray]:
    """Poses on the board, found by bisection of q2, and errors of the joint angles."""
    random, found = np.random.default_rng(3), []
    while len(found) < COUNT:
        one, ends = random.uniform(-1.0, 0.5), np.array([0.05, 2.5])

        def gap(two: float, one: float = one) -> float:
            x, z = tip(np.array([[one, two]]))
            return float(0.2 * x[0] + z[0] - 0.1)

        if gap(ends[0]) * gap(ends[1]) > 0:
            continue
        for _ in range(80):
            middle = ends.mean()
            ends = np.where([gap(ends[0]) * gap(middle) > 0] * 2, [middle, ends[1]], [ends[0], middle])
        found.append([one, ends.mean()])
    q = np.array(found) + noise * random.normal(size=(COUNT, 2))
    names = ("seen.across", "seen.up", "seen.level", "arm.planar.theta2")
    return posed(Board(), names, q, {})


PLANTED = {
    # The whole arm larger by a part in a hundred: every bearing stays.
    "bearing": (bearings, {"arm.planar.a1": 0.3, "arm.planar.a2": 0.25}),
    "board": (touches, {"seen.across": 0.2, "seen.up": 1.0, "seen.level": -0.1}),
}


@pytest.mark.parametrize("name", PLANTED)
def test_without_projection_errors_seem_to_determine_what_they_cannot(name: str) -> None:
    make, _ = PLANTED[name]
    problem, records, start = make(0.01)
    scales, names = problem.parameters.scales(), problem.parameters.coordinate_names
    assert analyse(problem.with_records(records).triangular_factor(start), scales, names).rank == len(names)
    problem, records, start = make(0.0)
    assert analyse(problem.with_records(records).triangular_factor(start), scales, names).rank == len(names) - 1


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01, 0.05])
@pytest.mark.parametrize("name", PLANTED)
def test_with_projection_the_planted_combination_is_found_whatever_the_errors(name: str, noise: float) -> None:
    make, planted = PLANTED[name]
    problem, records, start = make(noise)
    known = identify(problem.with_records(records), start)
    (found,) = explain(problem.with_records(records), start, known)
    told = np.array([dict(found.combination.terms).get(n, 0.0) for n in known.names])
    expected = np.array([planted.get(n, 0.0) for n in known.names]) / problem.parameters.scales()
    assert abs(told @ expected) == pytest.approx(np.linalg.norm(told) * np.linalg.norm(expected), rel=1e-9)
    assert found.cause == "gauge"
    assert known.rank == known.rank_by_qr == len(known) - 1


@pytest.mark.parametrize("name", PLANTED)
def test_what_is_judged_before_solving_and_after_it_agree(name: str) -> None:
    make, planted = PLANTED[name]
    problem, records, start = make(0.01)
    with pytest.raises(Exception, match=r"does not determine 1 .*a gauge: no poses determine it") as refused:
        require_solvable(problem.with_records(records), start)
    assert "measure poses" not in str(refused.value)
    found = estimate(problem.with_records(records), Solution(start, SolverVerdict("none", "", True, 0, 0.0)))
    assert found.identifiability.rank == len(planted) - 1 + len(found.names) - len(planted)
    told = {n: by != "nothing" for n, by in zip(found.names, found.determined_by, strict=True)}
    assert not any(told[n] for n in planted) and told["arm.planar.theta2"]


def test_projected_records_have_no_residual_and_others_are_left_alone() -> None:
    for make in (bearings, touches):
        problem, records, start = make(0.02)
        assert np.abs(problem.with_records(records).residuals(start)[0]).max() > 1e-3
        (moved,) = projected(problem.with_records(records), start).records
        assert np.abs(problem.with_records([moved]).residuals(start)[0]).max() < 1e-9
        assert moved.count == records[0].count
        np.testing.assert_array_equal(moved.weight, records[0].weight)


def test_contacts_move_joint_angles_no_farther_than_their_errors() -> None:
    problem, records, start = touches(0.02)
    (moved,) = projected(problem.with_records(records), start).records
    shift = (moved.record - records[0].record)[:, :COUNT]
    assert 0 < np.abs(shift).max() < 0.1


def test_a_contact_that_no_angles_reach_is_left_as_it_is() -> None:
    """A board beyond the arm's reach."""
    q = poses()
    problem, records, start = posed(Board(), ("seen.level", "seen.up"), q, {})
    far = start.copy()
    far[problem.parameters.entries_of("seen.level")] = -5.0
    (moved,) = projected(problem.with_records(records), far).records
    np.testing.assert_array_equal(moved.record, records[0].record)
    assert {
        e.cause for e in explain(problem.with_records(records), far, identify(problem.with_records(records), far))
    } <= {"gauge", "poses"}


def test_a_position_is_not_touched_at_all() -> None:
    """Its Jacobian does not depend on what was measured; the very same records come back."""
    q = poses()
    x, z = tip(q)
    channels = {"seen.x": x + 0.1, "seen.y": 0 * x, "seen.z": z}
    problem, records, start = posed(Tip(), ("arm.planar.a1", "arm.planar.a2"), q, channels)
    assert all(a is b for a, b in zip(projected(problem.with_records(records), start).records, records, strict=True))
