"""Groups of records with unknowns of their own: sums, laws, starts and what is held, against a dense numpy oracle."""

from __future__ import annotations

import pickle
from collections import defaultdict
from dataclasses import replace

import chain_oracle
import contact_oracle as co
import numpy as np
import pytest
from armcal.errors import DataError, InputError, ProblemError
from armcal.estimate.estimator import Solution, SolverVerdict, estimate
from armcal.estimate.identifiability import require_solvable
from armcal.estimate.polish import restricted, started
from armcal.functions import compiler
from armcal_tracker.position import TipPosition, TipPositionSettings
from contact_oracle import (
    BALL,
    DISTANCE,
    FREE,
    LEFT,
    NOISE,
    RIGHT,
    SPOTS,
    TIE_NOISE,
    ball,
    bench,
    known_distance,
    near,
    touches,
)


def oracle_rows(data, mean_weight=1.0, tied=(("back/hole_0", "back/hole_1"), ("front/hole_0", "front/hole_1"))):
    """A function of values by name to all whitened rows: records, means, ties."""
    sides = {"left": (LEFT, mean_weight, "balls"), "right": (RIGHT, 1.0, "others")}

    def rows(v):
        found = []
        for arm, (chain, weight, instance) in sides.items():
            if f"{arm}.q1" not in data.channels:
                continue
            q = np.stack([data.channels[f"{arm}.q{i}"] for i in range(1, 5)], axis=1)
            centre = [v[f"{instance}.centre_{axis}"] for axis in "xyz"]
            at, groups = co.points(chain, q, centre, v, arm), defaultdict(list)
            for i in np.flatnonzero(~np.isnan(q[:, 0])):
                key = f"{data.extra['position'][i]}/{data.extra['socket'][i]}"
                groups[key].append((at[i] - [v[f"balls.{key}.{axis}"] for axis in "xyz"]) / NOISE)
            for own in groups.values():
                found += own
                if weight > 1:
                    found.append(np.sqrt((weight - 1) * len(own)) * np.mean(own, axis=0))
        for one, other in tied:
            apart = np.array([v[f"balls.{other}.{axis}"] - v[f"balls.{one}.{axis}"] for axis in "xyz"])
            found.append([(np.linalg.norm(apart) - DISTANCE) / TIE_NOISE])
        return np.concatenate(found)

    return rows


@pytest.fixture(scope="module")
def data():
    return touches()


def dense(problem, values, rows):
    """The oracle's residual and Jacobian by the problem's free entries."""
    v = co.by_name(problem.parameters, values)
    return rows(v), chain_oracle.jacobian(rows, v, problem.free_names, 1e-6)


# ---------------------------------------------------------------- sums


@pytest.mark.parametrize("mean_weight", [1.0, 30.0], ids=["fitted", "mean"])
def test_cost_gradient_and_hessian_are_those_of_the_dense_formulas(data, mean_weight):
    problem, records = bench(mean_weight=mean_weight).problem(data)
    values = near(problem)
    residual, jacobian = dense(problem, values, oracle_rows(data, mean_weight))
    found, size = problem.with_records(records).normal_equations(values), np.sqrt(np.diag(jacobian.T @ jacobian))
    assert problem.with_records(records).cost(values) == pytest.approx(0.5 * residual @ residual, rel=1e-11)
    assert found.cost == pytest.approx(0.5 * residual @ residual, rel=1e-11)
    np.testing.assert_allclose(
        found.hessian / np.outer(size, size), jacobian.T @ jacobian / np.outer(size, size), atol=1e-7
    )
    np.testing.assert_allclose(
        found.gradient / size, jacobian.T @ residual / size, atol=1e-7 * np.linalg.norm(residual)
    )
    assert np.all(size > 0), "a free parameter that no row sees"
    upper = problem.with_records(records).triangular_factor(values)
    chain = problem.parameters.entries_jacobian(values)
    np.testing.assert_allclose(upper.T @ upper, chain.T @ found.hessian @ chain, rtol=1e-9, atol=1e-9 * size.max() ** 2)
    mean_rows = 0 if mean_weight == 1 else 3 * len(SPOTS)
    assert problem.with_records(records).equations() == len(residual) - mean_rows


def test_the_record_jacobians_are_the_slopes_of_the_whitened_residuals(data):
    problem, records = bench().problem(data)
    values, free = near(problem), list(problem.parameters.free_entries)
    blocks = list(problem.with_records(records).jacobians(values))
    for column, entry in enumerate(free):
        step = np.zeros(len(values))
        step[entry] = 1e-6
        sides = [problem.with_records(records).weighted_residuals(values + sign * step) for sign in (1, -1)]
        for block, (plus, minus) in zip(blocks, zip(*sides, strict=True), strict=True):
            slope = (plus - minus) / 2e-6
            scale = max(1.0, np.abs(slope).max())
            np.testing.assert_allclose(block[:, column, : len(data)] / scale, slope / scale, atol=1e-6)


@pytest.mark.parametrize("mean_weight", [1.0, 30.0], ids=["fitted", "mean"])
def test_the_gradient_is_that_of_the_cost_and_the_exact_hessian_that_of_the_gradient(data, mean_weight):
    """But for the curvature of means, which the Hessian leaves out."""
    problem, records = bench(mean_weight=mean_weight).problem(data)
    plain, _ = bench().problem(data)
    values = near(problem)
    equations, exact = (
        problem.with_records(records).normal_equations(values),
        problem.with_records(records).exact_hessian(values),
    )
    beside = equations.hessian - plain.with_records(records).normal_equations(values).hessian
    size = np.sqrt(np.diag(equations.hessian))
    for column, entry in enumerate(problem.parameters.free_entries):
        step = np.zeros(len(values))
        step[entry] = 1e-2 / size[column]
        sides = [problem.with_records(records).normal_equations(values + sign * step) for sign in (1, -1)]
        slope = (sides[0].cost - sides[1].cost) / 2e-2
        assert slope == pytest.approx(equations.gradient[column] / size[column], rel=1e-5, abs=1e-3)
        up, down = (plain.with_records(records).normal_equations(values + sign * step) for sign in (1, -1))
        bend = (up.gradient - down.gradient) / 2e-2 / size + beside[:, column] / size / size[column]
        np.testing.assert_allclose(exact[:, column] / size / size[column], bend, atol=2e-4, err_msg=str(column))


@pytest.mark.skipif(compiler.find_compiler() is None, reason="no C compiler on this machine")
@pytest.mark.parametrize("counts", [(1, 0), (3, 2)], ids=["one record a group", "several"])
@pytest.mark.slow
def test_compiled_and_interpreted_evaluators_agree(counts):
    data, made = touches(3, counts), bench(mean_weight=30.0)
    if not counts[1]:
        made = co.Bench({"left": made.arms["left"]}, {"balls": made.measurements["balls"]}, FREE[:3])
    problem, records = made.problem(data)
    compiled, own = made.problem(data, "compiled")
    assert compiled.backend == "compiled"
    values = near(problem)
    one, other = (
        problem.with_records(records).normal_equations(values),
        compiled.with_records(own).normal_equations(values),
    )
    assert other.cost == pytest.approx(one.cost, rel=1e-11)
    np.testing.assert_allclose(other.hessian, one.hessian, rtol=1e-9, atol=1e-11 * np.abs(one.hessian).max())
    np.testing.assert_allclose(other.gradient, one.gradient, rtol=1e-9, atol=1e-9 * np.abs(one.gradient).max())
    starts = zip(
        problem.with_records(records).nuisance_starts(values),
        compiled.with_records(own).nuisance_starts(values),
        strict=True,
    )
    for interpreted, of_compiled in starts:
        np.testing.assert_allclose(interpreted, of_compiled, atol=1e-13)


# ---------------------------------------------------------------- laws


def summary(problem, records, values):
    """Cost, and gradient and Hessian by name."""
    found = problem.with_records(records).normal_equations(values)
    order = np.argsort(problem.free_names)
    return found.cost, found.gradient[order], found.hessian[np.ix_(order, order)]


def assert_same(one, other):
    for mine, theirs in zip(one, other, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-10, atol=1e-12 * np.abs(mine).max())


@pytest.mark.parametrize("mean_weight", [1.0, 30.0], ids=["fitted", "mean"])
def test_the_order_of_records_means_nothing(data, mean_weight):
    made = bench(mean_weight=mean_weight)
    problem, records = made.problem(data)
    shuffled = data.subset(np.random.default_rng(4).permutation(len(data)))
    again, others = made.problem(shuffled)
    assert again.parameters.names == problem.parameters.names
    values = near(problem)
    assert_same(summary(problem, records, values), summary(again, others, values))


@pytest.mark.slow
def test_names_of_groups_mean_nothing_but_their_order():
    one, names = touches(5), {"back": "zebra", "front": "ant", "shelf": "mouse"}
    renamed = replace(one, extra={**one.extra, "position": tuple(names[p] for p in one.extra["position"])})
    problem, records = bench().problem(one)
    again, others = bench().problem(renamed)
    values = co.by_name(problem.parameters, near(problem))
    moved = {n.replace("back", "zebra").replace("front", "ant").replace("shelf", "mouse"): x for n, x in values.items()}
    first = problem.with_records(records).normal_equations(co.vector(problem.parameters, values))
    second = again.with_records(others).normal_equations(co.vector(again.parameters, moved))
    assert second.cost == pytest.approx(first.cost, rel=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(second.hessian), np.linalg.eigvalsh(first.hessian), rtol=1e-8)


@pytest.mark.slow
def test_the_same_records_in_two_measurements_give_the_same_sums():
    data = touches(6, (4, 0))
    arms = {"left": co.the_arm(LEFT, "left")}
    whole = co.Bench(arms, {"balls": ball(("left",), distances=(known_distance(),))}, FREE[:3])
    problem, records = whole.problem(data)
    values = near(problem)
    halves = {"balls": ball(("left",), distances=(known_distance(),)), "more": ball(("left",), sockets_of="balls")}
    parted, both = co.Bench(arms, halves, FREE[:3]).problem(data)
    mine = (np.arange(len(data)) % 2).astype(float)
    both = parted.with_records(both).weighted([mine, 1 - mine]).records
    moved = co.vector(parted.parameters, co.by_name(problem.parameters, values))
    assert_same(summary(problem, records, values), summary(parted, both, moved))


@pytest.mark.slow
def test_the_unit_of_length_means_nothing():
    """A thousand times larger in everything: the same whitened residuals."""
    data, k = touches(7, (3, 0)), 1000.0
    problems = []
    for factor in (1.0, k):
        settings = {"noise": NOISE * factor, "centre": tuple(factor * x for x in BALL)}
        tie = known_distance(DISTANCE * factor, TIE_NOISE * factor)
        arms = {"left": co.the_arm(co.scaled(LEFT, factor), "left")}
        problems.append(
            co.Bench(arms, {"balls": ball(("left",), distances=(tie,), **settings)}, FREE[:3]).problem(data)
        )
    (problem, records), (large, others) = problems
    values = near(problem)
    lengths = np.array([b.unit == "m" for b in problem.parameters.blocks])
    grown = np.where(lengths, k, 1.0)
    assert large.with_records(others).cost(values * grown) == pytest.approx(
        problem.with_records(records).cost(values), rel=1e-10
    )
    free = list(problem.parameters.free_entries)
    slope = large.with_records(others).normal_equations(values * grown).gradient * grown[free]
    expected = problem.with_records(records).normal_equations(values).gradient
    np.testing.assert_allclose(slope, expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())


def test_a_problem_that_went_through_a_pickle_is_the_same(data):
    problem, records = bench(mean_weight=30.0).problem(data)
    few = problem.with_records(records).subset(np.flatnonzero(np.array(data.extra["position"]) == "front")).records
    held = restricted(problem.with_records(few))
    assert len(held.parameters.free) < len(problem.parameters.free)
    for one in (problem, held):
        other, values = pickle.loads(pickle.dumps(one)), near(one)
        assert other.parameters == one.parameters
        assert [tie.groups for tie in other.ties] == [tie.groups for tie in one.ties]
        assert_same(summary(one, few, values), summary(other, few, values))
        assert_same(
            [one.with_records(few).nuisance_starts(values)[0]], [other.with_records(few).nuisance_starts(values)[0]]
        )


# ---------------------------------------------------------------- bad labels


def test_a_missing_label_column_is_told():
    data = touches(15, (2, 0))
    lacking = replace(data, extra={"position": data.extra["position"]}, source="touches.csv")
    with pytest.raises(DataError, match="socket") as told:
        co.Bench({"left": co.the_arm(LEFT, "left")}, {"balls": ball(("left",))}).problem(lacking)
    assert "touches.csv" in str(told.value)


@pytest.mark.quick('d"')
@pytest.mark.parametrize("label", ["a*", "b[0]", "c?", 'd"', "e'"])
def test_a_label_that_is_no_name_is_told_with_its_row(label):
    data = touches(15, (2, 0))
    rows = tuple(range(2, len(data) + 2))
    odd = replace(data, extra={**data.extra, "socket": (*data.extra["socket"][:-1], label)}, rows=rows)
    with pytest.raises(DataError) as told:
        co.Bench({"left": co.the_arm(LEFT, "left")}, {"balls": ball(("left",))}).problem(odd)
    assert str(rows[-1]) in str(told.value)


def test_labels_that_make_the_same_key_of_different_groups_are_not_one_group():
    """``a`` and ``b/c`` are not ``a/b`` and ``c``."""
    q = co.joints(co.random_joints(LEFT, 1, 0), "left")
    data = co.dataset([(q, {"position": "a", "socket": "b/c"}), (q, {"position": "a/b", "socket": "c"})])
    try:
        problem, _ = co.Bench({"left": co.the_arm(LEFT, "left")}, {"balls": ball(("left",))}).problem(data)
    except DataError:
        return
    assert len(problem.parameters.nuisances) == 6


@pytest.mark.slow
def test_sockets_of_a_measurement_that_is_not_there_are_refused():
    data = touches(15, (2, 0))
    with pytest.raises(InputError, match="nosuch"):
        co.Bench({"left": co.the_arm(LEFT, "left")}, {"balls": ball(("left",), sockets_of="nosuch")}).problem(data)


# ---------------------------------------------------------------- what is determined

LENGTHS = ("left.mdh.a?", "left.mdh.d?", "left.mdh.tool_z")


def one_arm(free=LENGTHS, chain=LEFT, **settings):
    """The left arm alone; its ball is where the flange is, so that no length of it is known."""
    made = ball(("left",), centre=(0, 0, 0), **settings)
    return co.Bench({"left": co.the_arm(chain, "left")}, {"balls": made}, free)


def seated(chain=LEFT, spots=("back/hole_0", "back/hole_1", "front/hole_0", "front/hole_1"), count=9, arm="left"):
    """Exact postures in sockets."""
    parts = []
    for number, key in enumerate(spots):
        labels = dict(zip(("position", "socket"), key.split("/"), strict=True))
        q = co.touching(chain, co.in_socket(SPOTS[key]), count, 40 + number)
        parts.append((co.joints(q, arm), labels))
    return parts


def refusal(made, data):
    """What is said of a problem that cannot be solved; nothing if it can."""
    problem, records = made.problem(data)
    problem = started(problem.with_records(records))
    try:
        require_solvable(problem.with_records(records), problem.parameters.nominal())
    except ProblemError as fault:
        return f"{fault.message} {fault.hint}"
    return ""


UNSEEN = "scale is not observable"


@pytest.fixture(scope="module")
def in_sockets():
    return co.dataset(seated())


@pytest.mark.slow
def test_an_arm_whose_lengths_are_all_free_does_not_know_its_size(in_sockets):
    said = refusal(one_arm(), in_sockets)
    assert UNSEEN in said
    assert "known distance" in said


@pytest.mark.quick("known sockets")
@pytest.mark.parametrize("way", ["known distance", "held length", "tracker", "known sockets"])
def test_one_length_of_any_kind_tells_the_size(in_sockets, way):
    made, data = one_arm(), in_sockets
    if way == "known distance":
        made = one_arm(distances=(known_distance(),))
    elif way == "held length":
        made = one_arm(("left.mdh.a[134]", *LENGTHS[1:]))
    elif way == "known sockets":
        made = one_arm(sockets={key: SPOTS[key] for key in ("back/hole_0", "front/hole_1")})
    else:
        q = co.random_joints(LEFT, 1, 3)
        at = co.points(LEFT, q)
        seen = {**co.joints(q, "left"), **{f"tracker.{a}": at[:, i] for i, a in enumerate("xyz")}}
        data = co.dataset([*seated(), (seen, {})])
        tracker = TipPosition(TipPositionSettings.si(noise=1e-3), ("left",))
        made = replace(made, measurements={**made.measurements, "tracker": tracker})
    said = refusal(made, data)
    assert UNSEEN not in said
    assert said == "" or "does not determine" in said


@pytest.mark.slow
def test_a_held_length_that_a_free_one_makes_up_for_tells_nothing(in_sockets):
    """The ball's place along the flange and the last link are one length: together they may grow."""
    made = replace(one_arm(), values={"balls.centre_x": 0.03})
    assert UNSEEN in refusal(made, in_sockets)
    assert UNSEEN not in refusal(replace(made, free=("left.mdh.a[123]", *LENGTHS[1:])), in_sockets)


@pytest.mark.slow
def test_a_length_of_one_arm_tells_the_size_of_another_that_touches_the_same_sockets():
    spots = ("front/hole_0", "front/hole_1", "shelf/hole_0")
    data = co.dataset([*seated(spots=spots), *seated(RIGHT, spots, arm="right")])
    arms = {"left": co.the_arm(LEFT, "left"), "right": co.the_arm(RIGHT, "right")}
    own, other = ball(centre=(0, 0, 0)), ball(arm="right", centre=(0, 0, 0), sockets_of="balls")
    names = [each.replace("left", arm) for arm in arms for each in LENGTHS]
    both = co.Bench(arms, {"balls": own, "others": other}, [*names, "right.mdh.base_?"])
    assert UNSEEN in refusal(both, data)
    held = [n for n in names if n != "right.mdh.a?"]
    assert UNSEEN not in refusal(replace(both, free=[*held, "right.mdh.a[134]", "right.mdh.base_?"]), data)


@pytest.mark.slow
def test_a_base_that_may_move_with_its_sockets_is_named_and_not_claimed():
    """Nothing but the sockets says where the arm stands: all six ways of moving both are told."""
    steps = tuple((kind, 0.1) for kind in ("x", "y", "z", "rx", "ry", "rz"))
    chain = replace(LEFT, base=steps)
    spots = {key: tuple(at) for key, at in SPOTS.items()}
    free = (*(f"left.mdh.base_{kind}" for kind, _ in steps), "left.mdh.a2", "left.mdh.theta3")
    parts = [
        (co.joints(co.touching(chain, co.in_socket(spots[k]), 8, i), "left"), {"position": p, "socket": s})
        for i, (k, (p, s)) in enumerate((k, k.split("/")) for k in ("front/hole_0", "shelf/hole_0", "back/hole_1"))
    ]
    data = co.dataset(parts)
    made = one_arm(free, chain)
    said = refusal(made, data)
    assert "6 combinations" in said
    assert UNSEEN not in said
    problem, records = made.problem(data)
    problem = started(problem.with_records(records))
    verdict = SolverVerdict("none", "", True, 0, 0.0)
    found = estimate(problem.with_records(records), Solution(problem.parameters.nominal(), verdict))
    determined = {n: by != "nothing" for n, by in zip(found.names, found.determined_by, strict=True)}
    assert determined["left.mdh.a2"]
    assert determined["left.mdh.theta3"]
    traded = [name for name in determined if "base_" in name or name.startswith("balls.")]
    assert len(traded) == 6 + 9
    assert not any(determined[name] for name in traded)
    assert np.isnan([sd for name, sd in zip(found.names, found.deviations, strict=True) if name in traded]).all()
    assert "left.mdh.base_" in said
    assert "balls." in said


def test_priors_on_every_length_hold_the_size_and_say_so(in_sockets):
    problem, records = one_arm().problem(in_sockets)
    problem = started(problem.with_records(records))
    every = {b.name: replace(b, prior_sd=0.01) for b in problem.parameters.free}
    problem = problem.with_parameters(problem.parameters.replaced(every))
    warned = " ".join(require_solvable(problem.with_records(records), problem.parameters.nominal()))
    assert UNSEEN in warned
    assert "its priors hold it" in warned
