"""Searches in C go the way of those by the interpreter: the same commands, and the same ends."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from armcal.calibration.inverse import NEAREST, PREFERRED, QUICK, Goal, Manner, Solver, slopes, step_function
from armcal.functions.batch_function import EvaluatorChoice
from armcal.functions.compiler import find_compiler
from small_arms import compensator, drawn

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")

LENGTH = 0.1
NEAR = (1e-10, 1e-9)  # m, rad
REST = 1e-11


class Pair:
    """Both searches of one arm and kind of target."""

    def __init__(
        self, name: str, turns: bool, limits: np.ndarray | None = None, near: tuple[float, float] = NEAR
    ) -> None:
        self.near, self.found, self.turns = near, compensator(name), turns
        self.limits = self.found.limits if limits is None else limits
        self.compiled, self.interpreted = self.search("compiled"), self.search("interpreted")
        assert self.compiled.compiled
        assert not self.interpreted.compiled

    def search(self, choice: EvaluatorChoice) -> Solver:
        expression = self.found.expression
        return Solver(expression, self.limits, "pose" if self.turns else "position", LENGTH, self.near, choice)

    def goal(self, count: int, stretch: float = 1.0) -> Goal:
        """Targets of random commands (farther out where they are stretched), from other random commands."""
        joints = len(self.found.joints)
        there, here = drawn(self.found, count, seed=1), drawn(self.found, count, seed=2)
        tools = self.found.forward(there)
        target = stretch * tools[:, :3, 3].T
        if self.turns:
            target = np.concatenate([target, tools[:, :3, :3].transpose(2, 1, 0).reshape(9, count)])
        record = np.repeat(self.found.expression.defaults[:, None], count, axis=1)
        record[:joints] = here.T
        return Goal(record, np.zeros((self.found.expression.state.numel(), count)), target)

    def alike(self, goal: Goal, manner: Manner) -> float:
        """The share of targets that are reached; everything else must agree."""
        one, two = self.compiled.exactly(goal, manner), self.interpreted.exactly(goal, manner)
        # Rounding grows where a search wanders: a few may end elsewhere.
        same = np.abs(one.commands - two.commands).max(axis=0) < 1e-7
        assert same.mean() > 0.97
        assert (one.there == two.there)[same].all()
        for mine, others in ((one.states, two.states), (one.distances, two.distances), (one.turns, two.turns)):
            assert mine[..., same] == pytest.approx(others[..., same], abs=1e-7)
        assert one.there.mean() == pytest.approx(two.there.mean(), abs=0.02)
        return float(one.there.mean())


@pytest.mark.quick("1")
@pytest.mark.parametrize("count", [1, 7, 8, 9, 203])
def test_all_targets_are_answered_at_their_places(count: int) -> None:
    """However they fill the lanes."""
    pair = Pair("three", False)
    pair.alike(pair.goal(count), QUICK)


def test_no_targets_have_no_answers() -> None:
    pair = Pair("three", False)
    assert pair.compiled.exactly(pair.goal(0), QUICK).commands.shape == (3, 0)


@pytest.mark.parametrize(("name", "turns"), [("three", False), ("rigid", False), ("lift", True), ("lrm", True)])
@pytest.mark.quick("three-False")
def test_targets_in_reach(name: str, turns: bool) -> None:
    pair = Pair(name, turns)
    assert pair.alike(pair.goal(400), QUICK) > 0.3


def test_targets_out_of_reach_end_at_the_nearest() -> None:
    pair = Pair("three", False)
    assert pair.alike(pair.goal(200, stretch=5.0), NEAREST) == 0


@pytest.mark.slow
def test_preferred_commands() -> None:
    pair = Pair("five", False)
    goal = pair.goal(200)
    preferred = replace(goal, towards=drawn(pair.found, 200, seed=3).T)
    assert pair.alike(preferred, PREFERRED) > 0.3


def test_numbers_that_are_none_end_a_search_and_touch_no_other() -> None:
    pair = Pair("three", False)
    goal = pair.goal(20)
    sound = pair.compiled.exactly(goal, QUICK)
    target = goal.target.copy()
    target[:, 5] = np.nan
    target[0, 11] = np.inf
    record, state = goal.record.copy(), goal.state.copy()
    record[1, 13], state[0, 14], state[1, 15] = np.nan, np.nan, np.inf
    answer = pair.compiled.exactly(replace(goal, record=record, target=target, state=state), QUICK)
    others = np.delete(np.arange(20), [5, 11, 13, 14, 15])
    assert not answer.there[[5, 11, 13]].any()
    assert (answer.commands[:, others] == sound.commands[:, others]).all()
    assert (answer.there == sound.there)[others].all()


def test_arrays_are_read_however_they_are_stored() -> None:
    pair = Pair("three", False)
    goal = pair.goal(30)
    turned = replace(goal, record=np.asfortranarray(goal.record), target=np.asfortranarray(goal.target))
    assert (pair.compiled.exactly(turned, QUICK).commands == pair.compiled.exactly(goal, QUICK).commands).all()


def test_other_shapes_are_refused() -> None:
    """C would read beyond them."""
    pair = Pair("three", False)
    goal = pair.goal(4)
    for name, wrong in (("record", goal.record[:-1]), ("target", goal.target[:, :3]), ("state", goal.state[:, :1])):
        with pytest.raises(ValueError, match=f"found {name} of the shape"):
            pair.compiled.exactly(replace(goal, **{name: wrong}), QUICK)
    with pytest.raises(ValueError, match=r"found towards of the shape \(3, 1\), expected \(3, 4\)"):
        pair.compiled.exactly(replace(goal, towards=np.zeros((3, 1))), QUICK)


def test_neighbours_do_not_matter() -> None:
    """Alone, in another order, or beside joints that were turned a thousand times: the same to the last bit."""
    pair = Pair("three", False, np.tile([-np.inf, np.inf], (3, 1)))
    goal = pair.goal(61)
    goal = replace(goal, towards=drawn(pair.found, 61, seed=3).T)
    wild = goal.record.copy()
    wild[:3, ::8] = 1e6
    order = np.random.default_rng(0).permutation(61)
    for search in (pair.compiled, pair.interpreted):
        answer = search.exactly(goal, PREFERRED)
        turned = search.exactly(goal.subset(order), PREFERRED)
        beside = search.exactly(replace(goal, record=wild), PREFERRED)
        for name in ("commands", "states", "distances", "there"):
            whole = getattr(answer, name)
            assert (getattr(turned, name) == whole[..., order]).all()
            assert (np.delete(getattr(beside, name) == whole, np.arange(0, 61, 8), axis=-1)).all()
            for i in range(0, 61, 10):
                alone = search.exactly(goal.subset(np.array([i])), PREFERRED)
                assert (getattr(alone, name)[..., 0] == whole[..., i]).all()


def test_several_threads_may_search_at_once() -> None:
    """Nothing in the library is shared between calls, and Python lets threads run meanwhile."""
    pair = Pair("three", False)
    goals = [pair.goal(203, stretch) for stretch in (1.0, 0.9, 1.1, 3.0)] * 4
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(lambda goal: pair.compiled.exactly(goal, QUICK).commands, goals))
    for goal, found in zip(goals, together, strict=True):
        assert (found == pair.compiled.exactly(goal, QUICK).commands).all()


@pytest.mark.parametrize("kind", ["compiled", "interpreted"])
@pytest.mark.slow
def test_what_counts_as_there_is_what_is_given(kind: str) -> None:
    """Not an earlier step that moved less but was not at rest, or was turned too far: a few of 1000 have such steps."""
    near = (1e-9, 1e-8)
    pair = Pair("lrm", True, near=near)
    goal = pair.goal(1000)
    found = getattr(pair, kind).exactly(replace(goal, towards=drawn(pair.found, 1000, seed=3).T), PREFERRED)
    record, free = goal.record.copy(), np.ones((6, 1000))
    record[:6] = found.commands
    expression = pair.found.expression
    step = step_function(expression, slopes(expression), "pose").map(1000)
    answers = step(record, goal.target, 0 * free, free, free[:1], LENGTH * free[:1], found.states)
    _, left, _, error, _ = (each.full()[:, found.there] for each in answers)
    assert np.linalg.norm(error[:3], axis=0).max() <= near[0]
    assert np.linalg.norm(error[3:], axis=0).max() <= near[1]
    assert np.abs(left).max() <= REST


@pytest.mark.slow
def test_with_limits_to_one_side_alone() -> None:
    pair = Pair("lift", False, np.array([[-np.inf, np.inf], [-np.inf, 0.3], [-0.2, np.inf]]))
    goal = pair.goal(100)
    assert pair.alike(goal, QUICK) > 0.3
    pair.alike(replace(goal, towards=drawn(pair.found, 100, seed=3).T), PREFERRED)
