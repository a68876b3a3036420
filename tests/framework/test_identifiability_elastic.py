"""Undetermined combinations of masses and springs are exactly those planted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import oracle
import pytest
from armcal.arm.assembly import Arm, prefixed
from armcal.arm.statics import Environment, MassSpec
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.estimate.identifiability import explain, identify
from armcal.problem.problem import Problem
from armcal_joints.effects import TorsionalSprings
from armcal_mdh.model import MdhModel
from armcal_tracker.position import TipPosition, TipPositionSettings
from chain_oracle import jacobian
from planted_arms import HALF, POSES, TWO, as_rows, same_span


def elastic(lrm: Any, names: Sequence[str], count: int = 60) -> tuple[Any, Any, np.ndarray, np.ndarray]:
    """The LRM arm at its published values, with these of the oracle's names free."""
    q = oracle.random_poses(count, 5)
    experiment = lrm.experiment()
    parameters = experiment.parameters.with_nominal(lrm.vector(experiment.parameters, oracle.PUBLISHED))
    parameters = parameters.with_free([oracle.armcal_name(n) for n in names])
    dataset = lrm.dataset(q, oracle.tip(oracle.published(), q))
    problem = lrm.problem(experiment, dataset, "interpreted", parameters)
    return problem, problem.of(dataset).records, parameters.nominal(), q


def two_masses_in_one_frame() -> dict[str, float]:
    """A gram from the holder to the target, whose centre moves so that the first moment stays."""
    v = oracle.nominal()
    shift = {f"target.com_{a}": (v[f"holder.com_{a}"] - v[f"target.com_{a}"]) / v["target.mass"] for a in "xyz"}
    return {"target.mass": 1.0, "holder.mass": -1.0, **shift}


def heavier_and_stiffer() -> dict[str, float]:
    """All masses in proportion, all compliances against it: every moment times compliance stays."""
    v = oracle.published()
    return {**{f"{n}.mass": v[f"{n}.mass"] for n in oracle.LINKS}, **{f"k{i}": -v[f"k{i}"] for i in range(7)}}


ELASTIC = {
    "two masses in one frame": (two_masses_in_one_frame(), ("k4", "theta3")),
    "all masses and all compliances": (heavier_and_stiffer(), ("theta2", "theta3")),
}


@pytest.mark.parametrize("name", ELASTIC)
@pytest.mark.slow
def test_planted_elastic_combinations_are_found_exactly(lrm: Any, name: str) -> None:
    planted, company = ELASTIC[name]
    problem, records, start, q = elastic(lrm, (*planted, *company))
    known = identify(problem.with_records(records), start)
    found = explain(problem.with_records(records), start, known)
    assert [each.cause for each in found] == ["gauge"]
    locals_ = {oracle.armcal_name(n): n for n in (*planted, *company)}
    sizes = problem.parameters.scales()
    told = [{locals_[n]: w * problem.parameters[n].scale for n, w in each.combination.terms} for each in found]
    names = [locals_[n] for n in known.names]
    assert same_span(as_rows(told, names, sizes), as_rows([planted], names, sizes))
    slopes = jacobian(lambda v: oracle.tip(v, q), oracle.published(), names) * sizes
    values = np.linalg.svd(slopes, compute_uv=False)
    assert int(np.sum(values > 1e-8 * values[0])) == known.rank
    direction = as_rows([planted], names, sizes)[0]
    assert np.linalg.norm(slopes @ direction) < 1e-8 * values[0] * np.linalg.norm(direction)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        tuple(f"k{i}" for i in range(7)),
        ("link4.mass", "link4.com_x", "link4.com_y", "link4.com_z", "k4"),
        ("link2.mass", "link4.mass", "link6.mass", "k0", "k1", "k2", "k3"),
        oracle.OPTION_1,
    ],
    ids=len,
)
def test_nothing_elastic_is_invented(lrm: Any, names: tuple[str, ...]) -> None:
    problem, records, start, q = elastic(lrm, names)
    known = identify(problem.with_records(records), start)
    order = [n.removeprefix("arm.links.").rpartition(".spring.")[2].rpartition(".mdh.")[2] for n in known.names]
    slopes = jacobian(lambda v: oracle.tip(v, q), oracle.published(), order) * problem.parameters.scales()
    assert np.linalg.svd(slopes, compute_uv=False)[-1] > 1e-7
    assert known.rank == len(names) and known.undetermined == ()


def upright(springs: Mapping[str, Any], axis: str) -> tuple[Problem, Any, np.ndarray]:
    """Two links about level axes, or (``axis`` z) about upright ones, with springs and a mass on each link."""
    chain = replace(TWO, base=(("rx", HALF if axis == "y" else 0.0),))
    model = MdhModel(MdhModel.Settings.si(**chain.settings()))
    effect = TorsionalSprings(TorsionalSprings.Settings.si(**springs), model.joint_names)
    masses = (MassSpec("upper", 1.0, (-0.1, 0.0, 0.0), "row1"), MassSpec("fore", 0.5, (-0.1, 0.02, 0.0), "row2"))
    arm = Arm("arm", "mdh", model, {"spring": effect}, masses)
    tracker = TipPosition(TipPositionSettings.si(noise=0.001), ("arm",))
    blocks = Parameters((*arm.parameters(), *prefixed("tracker.", tracker.parameters())))
    parameters = blocks.with_free([*blocks.select(["arm.spring.*"]), "arm.mdh.a1", "arm.mdh.theta2"])
    random = np.random.default_rng(3)
    channels = {f"arm.q{i}": random.uniform(-1.5, 1.5, POSES) for i in (1, 2)}
    channels |= {f"tracker.{a}": np.zeros(POSES) for a in "xyz"}
    dataset = Dataset(tuple(str(i) for i in range(POSES)), channels)
    environment = Environment((0.0, 0.0, -9.81))
    problem = Problem.build({"arm": arm}, {"tracker": tracker}, parameters, environment, dataset, "interpreted")
    return problem, problem.of(dataset).records, parameters.nominal()


def test_springs_that_gravity_never_loads_are_named_alone() -> None:
    problem, records, start = upright({"compliance": 0.01}, "z")
    found = explain(problem.with_records(records), start, identify(problem.with_records(records), start))
    assert {str(each.combination) for each in found} == {"arm.spring.k1 alone", "arm.spring.k2 alone"}
    assert {each.cause for each in found} == {"gauge"}


def test_the_base_spring_and_the_first_joints_about_one_axis_trade() -> None:
    problem, records, start = upright({"compliance": 0.01, "base_axis": "z"}, "y")
    (found,) = explain(problem.with_records(records), start, identify(problem.with_records(records), start))
    assert dict(found.combination.terms) == pytest.approx({"arm.spring.k0": 1.0, "arm.spring.k1": -1.0})
    assert found.cause == "gauge"
