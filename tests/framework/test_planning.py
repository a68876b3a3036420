"""Exchange against plain numpy: every update against a fresh decomposition, every plan against brute force."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from armcal.errors import ProblemError
from armcal.estimate.identifiability import deviations
from armcal.planning.candidates import AT_ONCE, Candidates, Task, value_of, whitened_rows
from armcal.planning.exchange import Tally, built_up, choose, detmax, in_order


def made(count=30, n_rows=3, size=5, known=2, seed=0) -> Candidates:
    """Random candidates, badly scaled by column, after ``known`` rows of earlier information."""
    random = np.random.default_rng(seed)
    scale = np.logspace(0, 1.5, size)
    return Candidates(random.normal(size=(known, size)), random.normal(size=(n_rows, count, size)) * scale)


def by_hand(candidates: Candidates, chosen) -> float:
    """The log determinant from its definition."""
    stacked = np.vstack([candidates.base, *(candidates.rows[:, i] for i in chosen)])
    return float(2 * np.sum(np.log(np.linalg.svd(stacked, compute_uv=False))))


@pytest.mark.parametrize("n_rows", [1, 2, 3, 6])
def test_updates_agree_with_decompositions_after_many_exchanges(n_rows: int) -> None:
    candidates = made(n_rows=n_rows)
    held = Tally(candidates)
    random = np.random.default_rng(1)
    chosen = [int(i) for i in random.choice(30, 8, replace=False)]
    held.restart(np.array(chosen))
    for step in range(150):  # past the refresh
        if step % 2:
            held.remove(chosen.pop(int(random.integers(len(chosen)))))
        else:
            chosen.append(int(random.integers(30)))
            held.add(chosen[-1])
    now = by_hand(candidates, chosen)
    scale = max(1.0, abs(now))
    others = [*range(0, 30, 7)]
    assert np.allclose(
        held.if_added()[others],
        [by_hand(candidates, [*chosen, i]) - now for i in others],
        rtol=1e-4,
        atol=1e-5 * scale,
    )
    without = [by_hand(candidates, chosen[:i] + chosen[i + 1 :]) - now for i in range(len(chosen))]
    assert np.allclose(held.if_removed(np.array(chosen)), without, rtol=1e-4, atol=1e-5 * scale)
    swapped = [by_hand(candidates, [*chosen[1:], i]) - now for i in others]
    assert np.allclose(held.if_swapped(chosen[0])[others], swapped, rtol=1e-4, atol=1e-5 * scale)


def test_no_single_swap_improves_a_plan() -> None:
    candidates = made(count=25, seed=3)
    plan = choose(Task(candidates, 6), starts=2)
    assert len(set(plan.chosen.tolist())) == 6
    value = by_hand(candidates, plan.chosen)
    assert plan.value == pytest.approx(value, rel=1e-8)
    for leaving in plan.chosen:
        kept = [i for i in plan.chosen if i != leaving]
        for entering in set(range(25)) - set(plan.chosen.tolist()):
            assert by_hand(candidates, [*kept, entering]) <= value + 1e-6 * abs(value), (leaving, entering)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.quick("0", "1")
def test_of_few_candidates_the_very_best_plan_is_found(seed: int) -> None:
    candidates = made(count=12, size=4, seed=seed)
    best = max(by_hand(candidates, chosen) for chosen in combinations(range(12), 4))
    assert choose(Task(candidates, 4)).value == pytest.approx(best, rel=1e-9)


def test_what_is_known_already_changes_the_plan() -> None:
    candidates = made(known=0, seed=5)
    first = choose(Task(candidates, 5)).chosen
    after = Candidates(np.concatenate([candidates.rows[:, i] for i in first]), candidates.rows)
    second = choose(Task(after, 5))
    assert set(second.chosen.tolist()) != set(first.tolist())
    assert second.value == pytest.approx(by_hand(after, second.chosen))


def test_a_pose_stands_once_however_good_it_is() -> None:
    candidates = made(count=8, seed=2)
    candidates.rows[:, 3] *= 50  # so good that it would be taken every time
    chosen = choose(Task(candidates, 6)).chosen.tolist()
    assert 3 in chosen and sorted(set(chosen)) == sorted(chosen)


def test_the_units_of_parameters_do_not_change_a_d_optimal_plan() -> None:
    candidates = made(seed=7)
    other = np.array([3.0, 0.3, 7.0, 1.0, 0.2])
    scaled = Candidates(candidates.base * other, candidates.rows * other)
    plans = [choose(Task(c, 8)) for c in (candidates, scaled)]
    assert plans[0].chosen.tolist() == plans[1].chosen.tolist()
    assert plans[1].value - plans[0].value == pytest.approx(2 * np.sum(np.log(other)))


def test_the_order_of_candidates_does_not_change_the_value() -> None:
    candidates = made(count=40, seed=8)
    shuffled = candidates.subset(np.random.default_rng(0).permutation(40))
    values = [choose(Task(c, 8)).value for c in (candidates, shuffled)]
    assert values[0] == pytest.approx(values[1], rel=1e-9)


def test_poses_are_given_in_the_order_of_what_they_add() -> None:
    candidates = made(seed=9)
    chosen = choose(Task(candidates, 6)).chosen
    task = Task(candidates, 6)
    assert in_order(task, chosen[::-1]).tolist() == chosen.tolist()
    firsts = [by_hand(candidates, [*chosen[:2], i]) for i in chosen[2:]]
    assert int(np.argmax(firsts)) == 0


def test_a_singular_start_is_climbed_out_of() -> None:
    candidates = made(count=40, known=0, size=6, seed=4)
    candidates.rows[:, :20, 3:] = 0  # half of the candidates see half of the parameters
    task = Task(candidates, 8)
    chosen = detmax(task, np.arange(8))
    assert np.isfinite(by_hand(candidates, chosen)) and by_hand(candidates, chosen) > 0
    assert value_of(candidates, np.arange(8)) < -100


def test_a_plan_for_many_candidates_is_a_local_optimum_over_all_of_them() -> None:
    candidates = made(count=2600, size=4, seed=11)
    plan = choose(Task(candidates, 6), starts=1)
    held = Tally(candidates)
    held.restart(plan.chosen)
    for leaving in plan.chosen:
        gains = np.delete(held.if_swapped(int(leaving)), plan.chosen)
        assert gains.max() <= 1e-6 * abs(plan.value)
    assert candidates.count > AT_ONCE


def test_a_plan_built_up_is_a_local_optimum() -> None:
    candidates = made(count=20, seed=12)
    chosen = built_up(Task(candidates, 4))
    value = by_hand(candidates, chosen)
    others = set(range(20)) - set(chosen.tolist())
    assert all(by_hand(candidates, [*set(chosen) - {o}, i]) <= value + 1e-9 for o in chosen for i in others)


def test_information_that_is_not_finite_is_refused_in_a_sentence() -> None:
    whole = made()
    for place in ("base", "rows"):
        spoiled = getattr(whole, place).copy()
        spoiled.flat[7] = np.nan
        with pytest.raises(ProblemError, match="is not finite at the values they are planned for"):
            replace(whole, **{place: spoiled})


def test_deviations_are_those_of_the_inverse_and_infinite_where_nothing_is_known() -> None:
    rows = np.random.default_rng(0).normal(size=(9, 4))
    assert np.allclose(deviations(rows), np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))))
    rows[:, 3] = rows[:, 2]
    assert np.isfinite(deviations(rows)).tolist() == [True, True, False, False]
    assert np.isinf(deviations(np.zeros((0, 4)))).all()


def test_rows_are_the_whitened_jacobian_in_ordinary_sizes(lrm) -> None:
    """Against finite differences of residuals, over more than one block of records."""
    experiment = lrm.experiment()
    q = np.random.default_rng(0).uniform(-0.8, 0.8, (1100, 6))
    dataset = lrm.dataset(q)
    problem = lrm.problem(experiment, dataset)
    nominal, scales = experiment.parameters.nominal(), experiment.parameters.scales()
    rows = whitened_rows(problem, nominal, dataset)
    assert rows.shape == (3, 1100, 28)
    few = [0, 500, 1023, 1024, 1099]
    problem = problem.of(dataset.subset(few))
    for column in (0, 9, 20, 27):
        delta = np.zeros(28)
        delta[column] = 1e-6 * scales[column]
        ends = [problem.residuals(experiment.parameters.retract(s * delta))[0] for s in (1, -1)]
        slope = (ends[0] - ends[1]) / 2e-6 / 0.5e-3
        assert np.allclose(rows[:, few, column], slope, atol=1e-4 * max(1.0, np.abs(slope).max()))


@pytest.mark.slow
@pytest.mark.shared
def test_fifty_of_the_measured_poses_beat_fifty_random_starts(lrm, shared_data) -> None:
    from armcal.run.experiment import Experiment

    experiment = Experiment.load(lrm.configs / "option1.yaml", (), shared_data / "lrm_arm" / "poses.csv")
    dataset = experiment.read()
    rows = whitened_rows(lrm.problem(experiment, dataset), experiment.parameters.nominal(), dataset)
    task = Task(Candidates(np.zeros((0, 28)), rows), 50)
    random = np.random.default_rng(2024)
    starts = [random.choice(313, 50, replace=False) for _ in range(50)]
    others = [value_of(task.candidates, detmax(task, start)) for start in starts]
    assert choose(task).value >= max(others)
