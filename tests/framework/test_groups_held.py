"""Where groups start, which are held, what settles, means and known distances, and mixed data."""

from __future__ import annotations

from dataclasses import replace

import contact_oracle as co
import numpy as np
import pytest
from armcal.errors import InputError
from armcal.estimate.polish import restricted, settled, started, untrained
from armcal.estimate.validation import record_errors
from armcal.problem.variants import with_joint_noise
from armcal_ipopt.estimator import IpoptEstimator
from armcal_tracker.position import TipPosition, TipPositionSettings
from contact_oracle import (
    BALL,
    FREE,
    LEFT,
    NOISE,
    SPOTS,
    TIE_NOISE,
    ball,
    bench,
    known_distance,
    near,
    touches,
)
from scipy.optimize import least_squares


@pytest.fixture(scope="module")
def data():
    return touches()


# ---------------------------------------------------------------- starts


@pytest.mark.parametrize("counts", [(1, 0), (2, 0), (3, 0), (4, 3)])
@pytest.mark.quick("counts0")
def test_where_sockets_start_does_not_depend_on_the_order_of_records(counts):
    data, made = touches(8, counts, scatter=0.05), bench()
    if not counts[1]:
        made = co.Bench({"left": made.arms["left"]}, {"balls": made.measurements["balls"]})
    starts = []
    for seed in range(6):
        order = np.random.default_rng(seed).permutation(len(data)) if seed else np.arange(len(data))
        problem, records = made.problem(data.subset(order))
        starts.append(started(problem.with_records(records)).parameters.nominal())
    assert np.ptp(starts, axis=0).max() == 0.0
    found = co.by_name(problem.parameters, starts[0])
    for key, spot in SPOTS.items():
        assert np.linalg.norm([found[f"balls.{key}.{a}"] for a in "xyz"] - np.array(spot)) < 0.15


@pytest.mark.slow
def test_a_prior_keeps_what_was_stated_and_known_sockets_stay(data):
    stated = {"balls.front/hole_0.x": 0.31}
    made = bench(values=stated, priors={"balls.front/hole_0.x": 0.01})
    made = replace(made, measurements={**made.measurements, "balls": ball(sockets={"back/hole_0": (0.1, 0.2, 0.3)})})
    problem, records = made.problem(data)
    found = co.by_name(problem.parameters, started(problem.with_records(records)).parameters.nominal())
    assert found["balls.front/hole_0.x"] == 0.31
    assert found["balls.front/hole_0.y"] != 0.0, "the others start from the records"
    assert [found[f"balls.back/hole_0.{a}"] for a in "xyz"] == [0.1, 0.2, 0.3]
    assert not problem.parameters["balls.back/hole_0.x"].free


# ---------------------------------------------------------------- what is held


def solved(problem, records):
    """The optimum, which the solver must have reached."""
    begun = started(problem.with_records(records))
    solution = IpoptEstimator(IpoptEstimator.Settings()).solve(begun, begun.parameters.nominal())
    assert solution.verdict.converged, solution.verdict.status
    return begun, solution.values


def part_of(data, *positions):
    return np.flatnonzero(np.isin(data.extra["position"], positions))


@pytest.mark.parametrize("trained", [("front",), ("back", "shelf")], ids=" ".join)
def test_restricted_to_some_groups_the_estimate_is_that_of_a_problem_without_the_others(data, trained):
    chosen = part_of(data, *trained)
    problem, records = bench(free=FREE[1:2]).problem(data)
    problem, train = started(problem.with_records(records)), problem.with_records(records).subset(chosen).records
    held = restricted(problem.with_records(train))
    begun, values = solved(held, train)
    alone, few = bench(free=FREE[1:2]).problem(data.subset(chosen))
    alone, expected = solved(alone, few)
    assert set(held.free_names) == set(alone.free_names)
    assert held.with_records(train).equations() == alone.with_records(few).equations()
    found = co.by_name(begun.parameters, values)
    for name, x in co.by_name(alone.parameters, expected).items():
        assert found[name] == pytest.approx(x, abs=1e-9), name
    assert restricted(held.with_records(train)).compiled is held.compiled


def test_a_tie_to_a_socket_that_no_training_record_touched_says_nothing(data):
    """Where that socket starts is no knowledge."""
    labels = np.array([f"{p}/{s}" for p, s in zip(data.extra["position"], data.extra["socket"], strict=True)])
    chosen = np.flatnonzero((labels != "front/hole_1") & (labels != "back/hole_0"))
    problem, records = bench().problem(data)
    problem, train = started(problem.with_records(records)), problem.with_records(records).subset(chosen).records
    held = restricted(problem.with_records(train))
    assert held.ties == ()
    alone, few = bench().problem(data.subset(chosen))
    values = near(alone)
    moved = co.vector(held.parameters, co.by_name(alone.parameters, values))
    assert held.with_records(train).cost(moved) == pytest.approx(alone.with_records(few).cost(values), rel=1e-12)


def test_a_tie_to_a_known_socket_counts(data):
    known = ball(sockets={"front/hole_0": SPOTS["front/hole_0"]}, distances=(known_distance(),))
    made = bench()
    problem, records = replace(made, measurements={**made.measurements, "balls": known}).problem(data)
    assert ("front/hole_0", "front/hole_1") in [tie.groups for tie in restricted(problem.with_records(records)).ties]


def test_sockets_that_only_judge_settle_at_the_mean_of_their_balls(data):
    problem, records = bench().problem(data)
    problem = started(problem.with_records(records))
    train, held = (
        problem.with_records(records).subset(part_of(data, *p)).records
        for p in (("front",), ("back", "shelf", "front"))
    )
    inner, values = restricted(problem.with_records(train)), near(problem)
    found = co.by_name(problem.parameters, settled(inner.with_records(held), values))
    before = co.by_name(problem.parameters, values)
    told, seen = problem.with_records(records).nuisance_starts(values), set()
    for key in SPOTS:
        position, socket = key.split("/")
        inside = [
            p == position and s == socket for p, s in zip(data.extra["position"], data.extra["socket"], strict=True)
        ]
        of_left, of_right = (inside & ~np.isnan(data.channels[f"{arm}.q1"]) for arm in ("left", "right"))
        mean = np.mean(np.hstack([told[0][:, of_left], told[1][:, of_right]]), axis=1)
        names = [f"balls.{key}.{axis}" for axis in "xyz"]
        seen |= set(names)
        if position == "front":
            assert [found[n] for n in names] == [before[n] for n in names], "a trained group moved"
        else:
            np.testing.assert_allclose([found[n] for n in names], mean, atol=1e-12)
    assert all(found[n] == before[n] for n in found if n not in seen)
    # With nothing trained all of them settle, and weights of zero do not count.
    every = co.by_name(problem.parameters, settled(untrained(problem).with_records(records), values))
    assert every["balls.front/hole_0.x"] != before["balls.front/hole_0.x"]
    off = [np.ones(len(data)), np.zeros(len(data))]
    left_only = co.by_name(
        problem.parameters,
        settled(untrained(problem).with_records(problem.with_records(records).weighted(off).records), values),
    )
    inside = np.array(data.extra["socket"]) == "hole_0"
    inside &= (np.array(data.extra["position"]) == "shelf") & ~np.isnan(data.channels["left.q1"])
    assert left_only["balls.shelf/hole_0.y"] == pytest.approx(told[0][1, inside].mean(), abs=1e-12)


# ---------------------------------------------------------------- means and known distances


def test_sockets_held_at_their_means_with_known_distances_against_scipy():
    """sum |x_i - mean|^2 / s^2 + (|m1 - m0| - d)^2 / s_d^2 + priors, over the arm's parameters alone."""
    data = touches(9, (6, 0), ("front/hole_0", "front/hole_1", "shelf/hole_0"), scatter=1e-3)
    free, arms = ("left.mdh.a2", "left.mdh.theta2", "left.mdh.theta3"), {"left": co.the_arm(LEFT, "left")}
    priors = dict.fromkeys(free, 2e-3)
    mean = ball(("left",), socket="mean", distances=(known_distance(0.0512),))
    problem, records = co.Bench(arms, {"balls": mean}, free, priors=priors).problem(data)
    begun, values = solved(problem, records)
    found = co.by_name(begun.parameters, values)
    q = np.stack([data.channels[f"left.q{i}"] for i in range(1, 5)], axis=1)
    keys = np.array([f"{p}/{s}" for p, s in zip(data.extra["position"], data.extra["socket"], strict=True)])
    nominal = co.named(LEFT, "left")

    def means(v):
        at = co.points(LEFT, q, BALL, v, "left")
        return at, {key: at[keys == key].mean(axis=0) for key in np.unique(keys)}

    def rows(x):
        v = {**nominal, **dict(zip(free, x, strict=True))}
        at, of = means(v)
        apart = np.linalg.norm(of["front/hole_1"] - of["front/hole_0"]) - 0.0512
        held = [(v[name] - nominal[name]) / sd for name, sd in priors.items()]
        return np.concatenate(
            [*((at[keys == k] - m).ravel() / NOISE for k, m in of.items()), [apart / TIE_NOISE], held]
        )

    direct = least_squares(rows, [nominal[n] for n in free], x_scale=1e-2, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    scales = [begun.parameters[name].scale for name in free]
    off = np.abs([found[name] - x for name, x in zip(free, direct.x, strict=True)]) / scales
    # A mean is held by a large weight, not by an infinite one.
    assert off.max() < 5e-6, dict(zip(free, off, strict=True))
    assert np.abs(direct.x - [nominal[n] for n in free]).max() > 1e-4, "nothing was found"
    for key, m in means({**nominal, **found})[1].items():
        assert np.abs([found[f"balls.{key}.{a}"] for a in "xyz"] - m).max() < 1e-4 * NOISE


def test_fitted_sockets_give_way_to_a_known_distance_and_means_do_not():
    data = touches(9, (6, 0), ("front/hole_0", "front/hole_1"), scatter=1e-3)
    apart = {}
    for socket in ("fitted", "mean"):
        made = ball(("left",), socket=socket, distances=(known_distance(0.06, 1e-6),))
        begun, values = solved(*co.Bench({"left": co.the_arm(LEFT, "left")}, {"balls": made}).problem(data))
        v = co.by_name(begun.parameters, values)
        places = [np.array([v[f"balls.front/hole_{i}.{a}"] for a in "xyz"]) for i in (0, 1)]
        apart[socket] = np.linalg.norm(places[1] - places[0])
    assert apart["fitted"] == pytest.approx(0.06, abs=1e-6)
    assert apart["mean"] == pytest.approx(0.05, abs=2e-3)


@pytest.mark.parametrize("how", ["joint noise", "weights", "noise by record"])
def test_a_mean_is_that_of_the_postures_whatever_is_known_of_their_noise(how):
    """By their weights, where they have some; and all sums speak of the same rows."""
    data = touches(9, (6, 0), ("front/hole_0", "front/hole_1"), scatter=1e-3)
    weights = np.ones(len(data))
    if how == "noise by record":
        data = replace(data, channels={**data.channels, "balls.noise": NOISE * np.linspace(0.5, 2, len(data))})
    arm = co.the_arm(LEFT, "left", 1e-3 if how == "joint noise" else 0.0)
    made = co.Bench({"left": arm}, {"balls": ball(("left",), socket="mean")}, FREE[1:2], priors={FREE[1]: 1e-3})
    problem, records = made.problem(data)
    problem = started(problem.with_records(records))
    if how == "joint noise":
        records = with_joint_noise(problem.with_records(records), problem.parameters.nominal()).records
    if how == "weights":
        weights = np.random.default_rng(1).uniform(0.0, 1.0, len(data)) * (np.arange(len(data)) % 4 > 0)
        records = problem.with_records(records).weighted([weights]).records
    problem, values = solved(problem, records)
    found, told = co.by_name(problem.parameters, values), problem.with_records(records).nuisance_starts(values)[0]
    for socket in ("hole_0", "hole_1"):
        own = weights * (np.array(data.extra["socket"]) == socket)
        mean = told @ own / own.sum()
        assert np.abs([found[f"balls.front/{socket}.{a}"] for a in "xyz"] - mean).max() < 1e-4 * NOISE
    away = near(problem)
    equations = problem.with_records(records).normal_equations(away)
    assert equations.cost == pytest.approx(problem.with_records(records).cost(away), rel=1e-11)
    upper = problem.with_records(records).triangular_factor(away)
    size = np.sqrt(np.diag(equations.hessian))
    np.testing.assert_allclose(
        upper.T @ upper / np.outer(size, size), equations.hessian / np.outer(size, size), atol=1e-9
    )


# ---------------------------------------------------------------- mixed data


def mixed(counts=(6, 5), noise=None):
    """Tracker rows without labels and socket rows without a reading, one below the other."""
    random, chain = np.random.default_rng(11), LEFT
    free_q = co.random_joints(chain, counts[0], 12)
    seen = co.points(chain, free_q, (0, 0, 0)) + random.normal(0, 1e-4, (counts[0], 3))
    socket_q = co.touching(chain, co.in_socket(SPOTS["shelf/hole_0"], BALL), counts[1], 13) + random.normal(
        0, 1e-3, (counts[1], 4)
    )
    columns = {**co.joints(free_q, "left"), **{f"tracker.{a}": seen[:, i] for i, a in enumerate("xyz")}}
    touched = co.joints(socket_q, "left")
    if noise:
        columns["tracker.noise"] = np.full(counts[0], noise)
    tracker = TipPosition(TipPositionSettings.si(noise=1e-3), ("left",))
    made = co.Bench({"left": co.the_arm(LEFT, "left")}, {"tracker": tracker, "balls": ball(("left",))}, FREE[:2])
    return made, co.dataset([(columns, {}), (touched, {"position": "shelf", "socket": "hole_0"})])


@pytest.mark.parametrize("noise", [None, 2e-3], ids=["declared", "by record"])
def test_tracker_and_socket_rows_in_one_dataset_each_count_once(noise):
    made, data = mixed(noise=noise)
    problem, records = made.problem(data)
    tracked = np.arange(len(data)) < 6
    assert np.array_equal(records[0].weight[: len(data)] > 0, tracked)
    assert np.array_equal(records[1].weight[: len(data)] > 0, ~tracked)
    assert problem.with_records(records).equations() == 3 * len(data)
    values = near(problem)
    v = co.by_name(problem.parameters, values)
    q = np.stack([data.channels[f"left.q{i}"] for i in range(1, 5)], axis=1)
    told = np.stack([data.channels[f"tracker.{a}"] for a in "xyz"], axis=1)[tracked]
    off = told - co.points(LEFT, q[tracked], (0, 0, 0), v, "left")
    spot = [v[f"balls.shelf/hole_0.{a}"] for a in "xyz"]
    left = co.points(LEFT, q[~tracked], BALL, v, "left") - spot
    expected = 0.5 * np.sum((off / (noise or 1e-3)) ** 2) + 0.5 * np.sum((left / NOISE) ** 2)
    assert problem.with_records(records).cost(values) == pytest.approx(expected, rel=1e-10)
    found = problem.with_records(records).normal_equations(values)
    assert found.cost == pytest.approx(expected, rel=1e-10)
    assert np.isfinite(found.hessian).all()
    assert np.isfinite(problem.with_records(records).exact_hessian(values)).all()
    errors = record_errors(problem.with_records(records), values)
    np.testing.assert_allclose(errors, np.linalg.norm(np.vstack([off, left]), axis=1), rtol=1e-9)


def test_tracker_rows_alone_touch_no_socket():
    """A part of the records, read by the problem of all of them."""
    made, data = mixed()
    problem, _ = made.problem(data)
    values = near(problem)
    few = problem.of(data.subset(range(6))).records
    assert not few[1].weight.any()
    assert problem.with_records(few).equations() == 18
    whole = problem.of(data).records
    part = problem.with_records(whole).subset(np.arange(6)).records
    assert problem.with_records(few).cost(values) == pytest.approx(problem.with_records(part).cost(values), rel=1e-12)


def test_a_record_that_no_measurement_applies_to_is_not_counted_for_a_socket_it_never_touched():
    """Neither a label nor a reading: refused, or of no weight; never counted for the first socket."""
    data = touches(14, (3, 0))
    blank = {**data.extra, "socket": ("", *data.extra["socket"][1:])}
    made = bench()
    made = co.Bench({"left": made.arms["left"]}, {"balls": made.measurements["balls"]}, FREE[:2])
    problem, records = made.problem(data)
    values = near(problem)
    try:
        problem = problem.of(replace(data, extra=blank))
        cost = problem.cost(values)
    except InputError:
        return
    part = problem.with_records(records).subset(np.arange(1, len(data))).records
    assert cost == pytest.approx(problem.with_records(part).cost(values), rel=1e-9)
