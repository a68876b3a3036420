"""Inverse kinematics: commands with which an arm, elastic or rigid, reaches a position, a position with an axis of the
tool near a direction, or a pose; from any start, and from many.

One step of a search is damped Gauss-Newton on the commands and Newton's method on the elastic equilibrium, together. At
commands q and elastic state d, with pass F, everything follows from one pass and a small solve: what is left of the
equilibrium, d0 = (I - F_d)^-1 (F - d), and how the state follows the commands, D = (I - F_d)^-1 F_q. The tool's
slope is T_q + T_d D. With the error e (position, and turn times a length) and the slope J, the step is

    M r + M J^T (J M J^T + damping I)^-1 (e - J M r),

M the joints that are free to move and r the preferred step beside the target, which only moves the arm where the target
does not care [Nakamura1986]; or the same by the joints where there are fewer of them than equations.

Near a pose in which the arm cannot turn some way, the way to the target is long and bent: errors may grow for a few
steps before they vanish. So steps are not taken back; their damping grows with the squared error [Sugihara2011], and
the best of all steps is kept. A joint that meets its limit is held there until the target pulls it back.

Searches start from many commands spread over joint space, the likeliest first, and from more at once the fewer targets
are left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import reduce
from itertools import accumulate
from types import MappingProxyType
from typing import Literal

import casadi as ca
import numpy as np

from armcal.base import se3
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.se3 import Expression
from armcal.calibration.rigid_chain import FREE_ANGLE, FREE_TRAVEL
from armcal.calibration.tool_expression import Equilibrium, ToolExpression, sample_inputs
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice

Aim = Literal["position", "direction", "pose"]
"""What a target states: a position (3; m); with it a direction of the base frame (3), an axis of the tool (3) and the
angle that may lie between (rad); or a rotation (9, column by column)."""
SIZES: Mapping[Aim, int] = MappingProxyType({"position": 3, "direction": 10, "pose": 12})
"""How many numbers a target has."""
Allowed = Callable[[Array], Mask]  # From commands (n x N) to whether the arm may be there
FARTHEST_M = 1e6  # A target beyond this is a slip of a unit, and its square may be no number

FIRST_DAMPING, _LEAST_DAMPING = 1e-3, 1e-14
_LONGEST = 0.4  # rad or m in one step
_NEAR_PREFERRED = 1e-4  # Preferred commands are reached when they move no joint by more (rad or m)
_WILD = 2.0  # A deflection beyond this (rad or m) is started anew
_FINITE = 1e300
SETTINGS = ("damping", "patience", "steps", "metres", "radians", "rest", "preferred", "length")
"""Of a search (a radian counts as ``length`` metres); then the lowest and the highest command of each joint."""
REACHED = 2.0  # How a search ends that reaches its target; others end with 1, and go on at 0


@dataclass(frozen=True)
class Slopes:
    left: Expression  # what is left of the equilibrium, d0 (n_d)
    state: Expression  # d state / d commands (n_d x n)
    tool: Expression  # d (rotation column by column, then position) / d commands (12 x n)
    corrected: Expression  # rotation and position (12) at the equilibrium


def slopes(expression: ToolExpression, rough: bool = False) -> Slopes:
    """By implicit differentiation at a state near the equilibrium. [Griewank2008]

    ``rough``: as if the state did not follow the commands. A third of the work, and good enough far from a target.
    """
    commands, state = expression.commands, expression.state
    pose = ca.densify(ca.vertcat(ca.vec(expression.base_T_tool.rotation), expression.base_T_tool.translation))
    by_commands = ca.jacobian(pose, expression.record)[:, : commands.numel()]
    if rough or not state.numel():
        return Slopes(expression.next_state - state, ca.SX(state.numel(), commands.numel()), by_commands, pose)
    following = ca.jacobian(expression.next_state, expression.record)[:, : commands.numel()]
    left, moved = expression.to_equilibrium(expression.next_state - state, following)
    by_state = ca.jacobian(pose, state)
    return Slopes(left, moved, by_commands + ca.mtimes(by_state, moved), pose + ca.mtimes(by_state, left))


def _twists(own_slopes: Slopes) -> Expression:
    """The tool's slope by the commands (6 x n): metres, then rad about the axes of the base frame.

    Half the sum of r_i x dr_i over the columns of the rotation is the turn.
    """
    here, turns = ca.reshape(own_slopes.corrected[:9], 3, 3), []
    for joint in range(own_slopes.tool.size2()):
        moved = ca.reshape(own_slopes.tool[:9, joint], 3, 3)
        turns.append(sum((ca.cross(here[:, i], moved[:, i]) for i in range(3)), ca.SX(3, 1)) / 2)
    return ca.vertcat(own_slopes.tool[9:, :], ca.horzcat(*turns))


def tool_error(own_slopes: Slopes, target: Expression, aim: Aim) -> tuple[Expression, Expression]:
    """From where the tool is to a target: metres, then turns in the base frame (rad); and its slope (m x n).

    A pose leaves a rotation vector, a direction the angle by which the tool's axis is too far away from it: one
    equation, and none where it is near enough.
    """
    away, slope = target[:3] - own_slopes.corrected[9:], own_slopes.tool[9:, :]
    if aim == "position":
        return away, slope
    here, moved = ca.reshape(own_slopes.corrected[:9], 3, 3), _twists(own_slopes)
    if aim == "pose":
        # The turn (rad, base frame) as a rotation vector; nothing is differentiated through it.
        there = ca.reshape(target[3:], 3, 3)
        sine = sum((ca.cross(here[:, i], there[:, i]) for i in range(3)), ca.SX(3, 1)) / 2
        cosine = (sum((ca.dot(here[:, i], there[:, i]) for i in range(3)), ca.SX(0)) - 1) / 2
        size = ca.sqrt(ca.dot(sine, sine))
        # Where both vanish together, as in a half turn, the direction is lost; elsewhere the ratio tends to one.
        small = size < 1e-9
        return ca.vertcat(away, sine * ca.if_else(small, 1, ca.atan2(size, cosine) / ca.if_else(small, 1, size))), moved
    axis, along = here @ target[6:9], target[3:6]
    about = ca.cross(axis, along)
    sine = ca.sqrt(ca.sumsqr(about))
    beyond = ca.atan2(sine, ca.dot(axis, along)) - target[9]
    # Where the axis points straight away from the direction, it may turn about any other.
    about = ca.if_else(sine > 1e-9, about / ca.fmax(sine, 1e-9), ca.vertcat(axis[2], axis[0], axis[1]))
    turn = ca.if_else(beyond > 0, ca.mtimes(about.T, moved[3:, :]), 0)
    return ca.vertcat(away, ca.fmax(beyond, 0)), ca.vertcat(slope, turn)


def step_function(expression: ToolExpression, own_slopes: Slopes, aim: Aim) -> ca.Function:
    """(record, target, preference, free, damping, length, state) -> (step, state left, state moved, error, pull).

    ``target`` is what ``aim`` says; ``preference`` (n) moves the arm where the target does not care; ``free`` (n) is
    one for joints that may move; ``damping`` (1; m^2). The error is in m and rad; ``pull`` (n) is where each joint
    would go if it were free: of a joint that is held at a limit its sign says whether target and preference pull it
    back.
    """
    count = len(expression.joints)
    target = ca.SX.sym("target", SIZES[aim])
    preference, free, damping = ca.SX.sym("preference", count), ca.SX.sym("free", count), ca.SX.sym("damping")
    error, slope = tool_error(own_slopes, target, aim)
    length = ca.SX.sym("length")
    weight = ca.vertcat(ca.SX.ones(3), *[length] * (error.numel() - 3))
    weighted = ca.diag(weight) @ slope
    step, pull = _step(weighted, weight * error, preference, free, damping)
    outputs = [step, own_slopes.left, ca.mtimes(own_slopes.state, step), error, pull]
    inputs = [expression.record, target, preference, free, damping, length, expression.state]
    return ca.Function("compensation_step", inputs, [ca.densify(output) for output in outputs], {"cse": True})


def progress_places(joints: int, states: int) -> dict[str, slice]:
    """Where each number of a search stands that changes from step to step; ``best`` is the nearest so far."""
    sizes = {"commands": joints, "state": states, "free": joints, "best_commands": joints, "best_state": states}
    sizes |= dict.fromkeys(("damping", "distance", "turn", "cost", "milestone", "waited", "steps", "end"), 1)
    ends = accumulate(sizes.values())
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def search_function(expression: ToolExpression, own_slopes: Slopes, aim: Aim) -> ca.Function:
    """(settings, record, target, towards, progress) -> progress, one step on.

    ``target`` is what ``aim`` says; ``towards`` are commands to come near to where that is ``preferred``.
    """
    joints, states = len(expression.joints), expression.state.numel()
    settings, progress = ca.SX.sym("settings", len(SETTINGS) + 2 * joints), progress_places(joints, states)
    target, towards = ca.SX.sym("target", SIZES[aim]), ca.SX.sym("towards", joints)
    before = ca.SX.sym("progress", progress["end"].stop)
    search = _Search(joints, settings, {name: before[place] for name, place in progress.items()})
    now = search.now
    preference = search.stated["preferred"] * (towards - now["commands"])
    preference *= _shortening(_largest(preference))  # as a whole: joint by joint it would point elsewhere
    record = ca.vertcat(now["commands"], expression.record[joints:])
    one_step, length = step_function(expression, own_slopes, aim), search.stated["length"]
    outputs = one_step(record, target, preference, now["free"], now["damping"], length, now["state"])
    step, left, along, error, pull = outputs
    after = search.judged(step, left, error, pull) | search.moved(step, left, along, pull)
    inputs = [settings, expression.record, target, towards, before]
    names = ["settings", "record", "target", "towards", "progress"]
    output = ca.densify(ca.vertcat(*[after[name] for name in progress]))
    return ca.Function("search", inputs, [output], names, ["after"], {"cse": True})


class _Search:
    """What a step makes of the progress of a search, by name."""

    def __init__(self, joints: int, settings: Expression, now: Mapping[str, Expression]) -> None:
        self.stated = dict(zip(SETTINGS, ca.vertsplit(settings[: len(SETTINGS)]), strict=True))
        self._low, self._high = ca.vertsplit(settings[len(SETTINGS) :], joints)
        self.now = now

    def judged(self, step: Expression, left: Expression, error: Expression, pull: Expression) -> dict[str, Expression]:
        """The best so far, and whether the search is at an end.

        Where commands are preferred, how far that moves the arm counts. What has reached its target need not be the
        best: an earlier step may have been better by this measure, and turned too far or not at rest.
        """
        now, stated, length = self.now, self.stated, self.stated["length"]
        distance, turn, size = _norm(error[:3]), _norm(error[3:]), _largest(step)
        is_near = ca.logic_and(size <= _NEAR_PREFERRED, ca.logic_not(_any(self._pulled_back(pull, _NEAR_PREFERRED))))
        near = ca.logic_and(distance <= stated["metres"], turn <= stated["radians"])
        at_rest = ca.logic_not(_any(ca.logic_not(ca.fabs(left) <= stated["rest"])))
        reached = ca.logic_and(ca.logic_and(near, at_rest), ca.logic_or(ca.logic_not(stated["preferred"]), is_near))
        error_cost = distance**2 + (length * turn) ** 2
        cost = error_cost + ca.if_else(stated["preferred"], (length * size) ** 2, 0)
        is_least = cost < now["cost"]
        is_best = ca.logic_or(reached, is_least)
        least = ca.if_else(is_least, cost, now["cost"])
        halved = least < 0.25 * now["milestone"]
        waited, steps = ca.if_else(halved, 0, now["waited"] + 1), now["steps"] + 1
        given_up = ca.logic_or(waited >= stated["patience"], steps >= stated["steps"])
        here = {"best_commands": now["commands"], "best_state": now["state"], "distance": distance, "turn": turn}
        return {name: ca.if_else(is_best, value, now[name]) for name, value in here.items()} | {
            "damping": stated["damping"] * ca.if_else(error_cost < 1, error_cost, 1) + _LEAST_DAMPING,
            "cost": least,
            "milestone": ca.if_else(halved, least, now["milestone"]),
            "waited": waited,
            "steps": steps,
            "end": ca.if_else(reached, REACHED, given_up),
        }

    def moved(self, step: Expression, left: Expression, along: Expression, pull: Expression) -> dict[str, Expression]:
        """Commands and state a step on; ``along`` is how the state follows it."""
        commands, size = self.now["commands"], _largest(step)
        finite = size < ca.inf
        aim = commands + ca.if_else(finite, _shortening(size) * step, 0)
        new = ca.if_else(aim < self._low, self._low, ca.if_else(aim > self._high, self._high, aim))
        inside = new == aim
        free = ca.if_else(self._pulled_back(pull, 0.0), 1, self.now["free"])
        unhindered = ca.logic_not(_any(ca.logic_not(inside)))
        ahead = self.now["state"] + left + ca.if_else(unhindered, _shortening(size), 0) * along
        tame = ca.logic_and(finite, ca.fabs(ahead) < _WILD)
        return {"commands": new, "state": ca.if_else(tame, ahead, 0), "free": ca.if_else(inside, free, 0)}

    def _pulled_back(self, pull: Expression, least: float) -> Expression:
        commands = self.now["commands"]
        from_low = ca.logic_and(commands <= self._low, pull > least)
        from_high = ca.logic_and(commands >= self._high, pull < -least)
        return ca.logic_and(self.now["free"] == 0, ca.logic_or(from_low, from_high))


def _any(conditions: Expression) -> Expression:
    return reduce(ca.logic_or, ca.vertsplit(conditions), ca.SX(0))


def _norm(vector: Expression) -> Expression:
    return ca.sqrt(ca.sumsqr(vector))


def _largest(vector: Expression) -> Expression:
    """The largest size; infinite where any is no number."""
    sizes = ca.vertsplit(ca.fabs(vector))
    return ca.if_else(sum(sizes) <= _FINITE, reduce(ca.fmax, sizes), ca.inf)


def _shortening(size: Expression) -> Expression:
    return ca.if_else(size > _LONGEST, _LONGEST / size, 1)


def slope_function(expression: ToolExpression, turns: bool) -> ca.Function:
    """(record, state) -> the tool's slope by the commands (3 x n; m), where it ``turns`` rotation too (6 x n; rad)."""
    own_slopes = slopes(expression)
    slope = _twists(own_slopes) if turns else own_slopes.tool[9:, :]
    inputs = [expression.record, expression.state]
    return ca.Function("tool_slope", inputs, [ca.vec(ca.densify(slope))], {"cse": True})


def _step(
    slope: Expression, error: Expression, preference: Expression, free: Expression, damping: Expression
) -> tuple[Expression, Expression]:
    """Damped least squares over the free joints, in the form that has fewer unknowns; and where all joints are pulled.

    The pull is the slope of half of |e - J x|^2 / damping + |x - r|^2 at the step, by joints that are held too.
    """
    rows, count = slope.shape
    held = slope @ ca.diag(free)
    preferred = free * preference
    left = error - held @ preferred
    if rows <= count:
        lever = se3.solve_near_identity(held @ held.T + damping * ca.SX.eye(rows), left)
        return preferred + held.T @ lever, preference + slope.T @ lever
    step = preferred + se3.solve_near_identity(held.T @ held + damping * ca.SX.eye(count), held.T @ left)
    return step, damping * preference + slope.T @ (error - held @ step)


@dataclass(frozen=True)
class Goal:
    record: Array  # channels x N; with the commands from which the search starts
    state: Array  # n_d x N; where the search starts
    target: Array  # what an aim says of it (SIZES x N)
    towards: Array | None = None  # commands to come near to where the target leaves a choice (n x N)

    def subset(self, rows: Indices) -> Goal:
        towards = None if self.towards is None else chosen_of(self.towards, rows)
        record, state, target = (chosen_of(array, rows) for array in (self.record, self.state, self.target))
        return Goal(record, state, target, towards)


@dataclass(frozen=True)
class Solutions:
    commands: Array  # n x N (rad or m); of those that are not reached, the nearest
    states: Array  # n_d x N
    distances: Array  # what is left (m)
    turns: Array  # what is left (rad)
    there: Mask  # whether it is reached
    forbidden: Mask  # of those that are not reached, whether only clearance forbids it

    @classmethod
    def nothing(cls, joints: int, state: int, count: int) -> Solutions:
        far = np.full((2, count), np.inf)
        no = np.zeros((2, count), dtype=bool)
        return cls(np.zeros((joints, count)), np.zeros((state, count)), far[0], far[1], no[0], no[1])

    def put(self, at: Indices, attempt: Solutions, chosen: Indices) -> None:
        """Some of an attempt's commands at their targets' places; whether they are reached is the caller's to say."""
        self.commands[:, at], self.states[:, at] = attempt.commands[:, chosen], attempt.states[:, chosen]
        self.distances[at], self.turns[at] = attempt.distances[chosen], attempt.turns[chosen]

    @classmethod
    def joined(cls, parts: Sequence[Solutions]) -> Solutions:
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts], axis=-1) for f in fields(cls)))

    def subset(self, chosen: Mask | Indices | slice) -> Solutions:
        return Solutions(*(getattr(self, part.name)[..., chosen] for part in fields(self)))

    def replace(self, at: Indices, other: Solutions) -> None:
        for part in fields(self):
            getattr(self, part.name)[..., at] = getattr(other, part.name)


@dataclass(frozen=True)
class Manner:
    damping: float  # times the squared error
    patience: int  # steps in which an error must halve, or the search ends
    steps: int  # at most


QUICK = Manner(damping=1e-2, patience=5, steps=40)  # To a target that can be reached
NEAREST = Manner(damping=1.0, patience=25, steps=100)
"""To the nearest where it cannot: what is left must not throw the arm about."""
PREFERRED = Manner(damping=1e-2, patience=20, steps=100)  # Along targets towards preferred commands


_REST = 1e-11
_ROUGH = (1e-3, 5e-3, 1e-2)  # Where rough steps end


class Solver:
    """Searches for one arm and one kind of target: with rough steps until one is near, exactly from there."""

    def __init__(
        self,
        expression: ToolExpression,
        limits: Array,  # n x 2 (rad or m)
        aim: Aim,
        length: float,  # how many metres a radian counts for
        tolerance: tuple[float, float],  # within which targets are reached (m, rad)
        choice: EvaluatorChoice = "auto",
    ) -> None:
        self.length, self.aim, self.limits, self.states = length, aim, limits, expression.state.numel()
        self._near, self._places = (*tolerance, _REST), progress_places(len(limits), self.states)

        def steps(rough: bool) -> BatchFunction:
            def made() -> BatchFunction:
                function = search_function(expression, slopes(expression, rough), aim)
                random, record = np.random.default_rng(0), sample_inputs(expression)[0]
                sample = [random.uniform(0.1, 0.3, (function.numel_in(i), 8)) for i in range(function.n_in())]
                sample[1] = record
                return BatchFunction(function, sample, choice, iterated=True)

            return expression.made(("search", aim, rough, choice), made)

        self._exact = steps(rough=False)
        self._rough = steps(rough=True) if self.states else None

    @property
    def compiled(self) -> bool:
        return self._exact.compiled

    def __call__(self, goal: Goal, manner: Manner = QUICK) -> Solutions:
        if self._rough is None:
            return self.exactly(goal, manner)
        first = self._search(self._rough, replace(goal, towards=None), manner, _ROUGH)
        near = np.flatnonzero(first.there) if manner is QUICK else np.arange(len(first.there))
        begun = replace(goal, record=with_commands(goal.record, first.commands), state=first.states)
        second = self.exactly(begun.subset(near), manner)
        first.there[:] = False
        first.replace(near, second)
        return first

    def exactly(self, goal: Goal, manner: Manner) -> Solutions:
        """Search by exact steps alone until it is near, or no longer comes nearer."""
        return self._search(self._exact, goal, manner, self._near)

    def _search(self, steps: BatchFunction, goal: Goal, manner: Manner, near: tuple[float, float, float]) -> Solutions:
        """``near`` is what counts as being there: m and rad from the target, and what is left of the equilibrium."""
        joints, count, places = len(self.limits), goal.record.shape[1], self._places
        towards = np.zeros((joints, count)) if goal.towards is None else goal.towards
        given = {"record": goal.record, "target": goal.target, "towards": towards, "state": goal.state}
        sizes = [*(steps.function.numel_in(i) for i in (1, 2, 3)), self.states]
        for (name, array), size in zip(given.items(), sizes, strict=True):
            if array.shape != (size, count):
                raise ValueError(f"found {name} of the shape {array.shape}, expected {(size, count)}")
        settings = [manner.damping, manner.patience, manner.steps, *near, goal.towards is not None, self.length]
        progress = np.zeros((places["end"].stop, count))
        begun = np.minimum(np.maximum(goal.record[:joints], self.limits[:, :1]), self.limits[:, 1:])
        progress[places["commands"]] = progress[places["best_commands"]] = begun
        progress[places["state"]] = progress[places["best_state"]] = goal.state
        progress[places["free"]], progress[places["damping"]] = 1.0, FIRST_DAMPING
        progress[places["distance"].start : places["milestone"].stop] = np.inf
        steps.iterate(progress, np.concatenate([settings, *self.limits.T]), goal.record, goal.target, towards)
        best, (distances, turns) = progress[places["best_commands"]], progress[places["distance"].start :][:2]
        there, forbidden = progress[-1] == REACHED, np.zeros(count, dtype=bool)
        return Solutions(best, progress[places["best_state"]], distances, turns, there, forbidden)


def with_commands(record: Array, commands: Array) -> Array:
    moved = record.copy()
    moved[: len(commands)] = commands
    return moved


def chosen_of(array: Array, rows: Indices) -> Array:
    """Some columns, channel by channel in one piece: plain indexing would turn the storage round."""
    return np.asarray(np.take(array, rows, axis=1))


_ROUNDS = (1, 1, 2, 4, 8, 16, 32, 64)
_AT_ONCE = 4096
_BESIDE = 0.6
"""Commands that moved no joint farther (rad or m) are taken for the nearest without a look at other postures."""
_POSTURES, _MOVED = 24, 0.2
"""Starts from which the nearest of all commands is sought; what their distance from where the arm is counts beside
that of their tool from the target."""
_NEAREST_STARTS = 4
_SAME = 1e-3  # Commands nearer than this (rad or m) are the same posture
_WIDEST = 2 * np.pi  # To either side; a joint that goes farther is tried about where it is nearest to zero


class Finder:
    """Commands for targets (SIZES x N) under records (channels x N, whose commands are not used), from many starts."""

    def __init__(self, solver: Solver, seeds: Seeds, allowed: Allowed | None) -> None:
        self.solver, self._seeds, self._allowed = solver, seeds, allowed

    def first(self, record: Array, target: Array) -> Solutions:
        """The first commands that are found; of targets that are not reached, the nearest."""
        solutions, used = self._nothing(record.shape[1]), 0
        lost: Indices = np.arange(record.shape[1])
        for wide in _ROUNDS:
            if not lost.size or used >= self._seeds.commands.shape[1]:
                break
            wide = min(wide, self._seeds.commands.shape[1] - used)
            for todo in _chunks(lost, wide):
                self._round(record, target, todo, self._picked(target[:, todo], used, wide), solutions)
            lost = lost[~solutions.there[lost]]
            used += wide
        # Of targets that were not reached, the commands that come nearest; a longer search reaches some after all.
        wide = min(_NEAREST_STARTS, self._seeds.commands.shape[1] - 1)
        for todo in _chunks(lost, wide + 1):
            commands, states = self._seeds.at(self._picked(target[:, todo], 0, wide))
            commands = np.concatenate([solutions.commands[:, todo, None], commands], axis=2)
            states = np.concatenate([solutions.states[:, todo, None], states], axis=2)
            attempt, _ = self._searched(record, target, todo, commands, states, NEAREST)
            left = attempt.distances + self.solver.length * attempt.turns
            left = np.where(self._may(attempt.commands), left, np.inf)
            best = left.reshape(-1, wide + 1).argmin(axis=1) + np.arange(len(todo)) * (wide + 1)
            solutions.put(todo, attempt, best)
            solutions.there[todo] = attempt.there[best] & np.isfinite(left[best])
        return solutions

    def postures(self, record: Array, target: Array, count: int) -> list[Array]:
        """All commands that are found of each target from so many starts (n x k each), the likeliest first."""
        wide, kept = min(count, self._seeds.commands.shape[1]), list[Array]()
        for todo in _chunks(np.arange(record.shape[1]), wide):
            picks = self._picked(target[:, todo], 0, wide)
            attempt, good = self._searched(record, target, todo, *self._seeds.at(picks))
            for own in np.split(np.arange(picks.size), len(todo)):
                kept.append(different(attempt.commands[:, own[good[own]]]))
        return kept

    def straight(self, record: Array, target: Array, at: Array) -> Solutions:
        """Commands from others (n x N) straight on: no other posture is looked for."""
        solutions = self._direct(record, target, at)
        solutions.commands[:, ~solutions.there] = at[:, ~solutions.there]
        return solutions

    def onward(self, record: Array, target: Array, at: Array) -> Solutions:
        """The commands nearest to others (n x N): beside them, else in whatever posture is nearest of many."""
        beside = self._direct(record, target, at, at)
        lost = np.flatnonzero(~beside.there)  # preferred: to stay
        if lost.size:
            beside.replace(lost, self.straight(record[:, lost], target[:, lost], at[:, lost]))
        far = np.flatnonzero(~beside.there | (np.abs(beside.commands - at).max(axis=0) > _BESIDE))
        if not far.size:
            return beside
        other = self._of_many(record[:, far], target[:, far], at[:, far])
        nearer = _apart(other.commands, at[:, far]) < _apart(beside.commands[:, far], at[:, far])
        better = ~beside.there[far] | (other.there & nearer)
        beside.replace(far[better], other.subset(better))
        return beside

    def _of_many(self, record: Array, target: Array, at: Array) -> Solutions:
        """From many starts, each brought as near to commands (n x N) as its target allows: the nearest of them."""
        solutions = self._nothing(record.shape[1])
        wide = min(_POSTURES, self._seeds.commands.shape[1])
        for todo in _chunks(np.arange(record.shape[1]), wide):
            rows, first = np.repeat(todo, wide), np.arange(len(todo)) * wide
            attempts = self._nothing(len(rows))
            # Seeds near to targets, and near to commands too.
            moved = _apart(self._seeds.commands[:, None, :], at[:, todo, None])
            cost = self._seeds.apart(target[:, todo], self.solver.length) + _MOVED * self.solver.length**2 * moved
            picks = np.argpartition(cost, wide - 1, axis=1)[:, :wide].reshape(-1, 1)
            records, targets, preferred = (chosen_of(array, rows) for array in (record, target, at))
            self._round(records, targets, np.arange(len(rows)), picks, attempts)
            self._towards(records, targets, preferred, attempts)
            apart = np.where(attempts.there, _apart(attempts.commands, preferred), np.inf)
            solutions.replace(todo, attempts.subset(apart.reshape(-1, wide).argmin(axis=1) + first))
        lost = np.flatnonzero(~solutions.there)
        if lost.size:
            more = self.first(record[:, lost], target[:, lost])
            self._towards(record[:, lost], target[:, lost], at[:, lost], more)
            solutions.replace(lost, more)
        return solutions

    def _towards(self, record: Array, target: Array, preferred: Array, solutions: Solutions) -> None:
        """As near to preferred commands (n x N) as the targets allow, in place; only those that are reached."""
        at = np.flatnonzero(solutions.there)
        goal = Goal(with_commands(record, solutions.commands), solutions.states, target, preferred)
        attempt = self.solver(goal.subset(at), PREFERRED)
        nearer = _apart(attempt.commands, preferred[:, at]) < _apart(solutions.commands[:, at], preferred[:, at])
        good = np.flatnonzero(attempt.there & nearer & self._may(attempt.commands))
        solutions.put(at[good], attempt, good)

    def _direct(self, record: Array, target: Array, at: Array, towards: Array | None = None) -> Solutions:
        """One search from commands (n x N), near to preferred ones where there are any: what it reaches."""
        solutions = self._nothing(record.shape[1])
        goal = Goal(with_commands(record, at), np.zeros_like(solutions.states), target, towards)
        attempt = self.solver(goal, QUICK if towards is None else PREFERRED)
        good = np.flatnonzero(attempt.there & self._may(attempt.commands))
        solutions.replace(good, attempt.subset(good))
        return solutions

    def _picked(self, target: Array, used: int, wide: int) -> Indices:  # N x wide
        apart = self._seeds.apart(target, self.solver.length)
        if used == 0 and wide == 1:
            return np.asarray(apart.argmin(axis=1)[:, None])
        last = min(used + wide, apart.shape[1] - 1)
        near = np.argpartition(apart, last, axis=1)[:, : used + wide]
        order = np.argsort(np.take_along_axis(apart, near, axis=1), axis=1)
        return np.asarray(np.take_along_axis(near, order, axis=1)[:, used:])

    def _round(self, record: Array, target: Array, todo: Indices, picks: Indices, solutions: Solutions) -> None:
        wide = picks.shape[1]
        attempt, good = self._searched(record, target, todo, *self._seeds.at(picks))
        left = attempt.distances + self.solver.length * attempt.turns
        best = np.where(good, left, np.inf).reshape(-1, wide).argmin(axis=1) + np.arange(len(todo)) * wide
        had = good[best]
        solutions.put(todo[had], attempt, best[had])
        solutions.there[todo[had]] = True
        solutions.forbidden[todo] |= (attempt.there & ~good).reshape(-1, wide).any(axis=1)
        near = np.where(attempt.there, np.inf, left).reshape(-1, wide).argmin(axis=1) + np.arange(len(todo)) * wide
        closer = ~had & (left[near] < solutions.distances[todo] + self.solver.length * solutions.turns[todo])
        solutions.put(todo[closer], attempt, near[closer])

    def _searched(
        self, record: Array, target: Array, todo: Indices, commands: Array, states: Array, manner: Manner = QUICK
    ) -> tuple[Solutions, Mask]:
        rows = np.repeat(todo, commands.shape[2])
        starts = with_commands(chosen_of(record, rows), commands.reshape(len(commands), len(rows)))
        attempt = self.solver(Goal(starts, states.reshape(len(states), len(rows)), chosen_of(target, rows)), manner)
        return attempt, attempt.there & self._may(attempt.commands)

    def _nothing(self, count: int) -> Solutions:
        return Solutions.nothing(len(self.solver.limits), len(self._seeds.states), count)

    def _may(self, commands: Array) -> Mask:
        if self._allowed is None or not commands.shape[1]:
            return np.ones(commands.shape[1], dtype=bool)
        return self._allowed(commands)


def different(commands: Array) -> Array:
    """Commands (n x k) without those that are the same posture as one before."""
    kept = list[int]()
    for i in range(commands.shape[1]):
        if all(np.abs(commands[:, i] - commands[:, other]).max() > _SAME for other in kept):
            kept.append(i)
    return commands[:, kept]


def _apart(commands: Array, others: Array) -> Array:
    """The squared distance of commands (n x N each) from others (N)."""
    return np.asarray(((commands - others) ** 2).sum(axis=0))


def _chunks(rows: Indices, wide: int) -> Iterator[Indices]:
    size = max(1, _AT_ONCE // wide)
    for start in range(0, len(rows), size):
        yield rows[start : start + size]


class Seeds:
    """Commands (n x M; rad or m) spread evenly over what the joints allow, with states (n_d x M) and tools there.

    Commands at which the springs do not hold are left out.
    """

    def __init__(
        self, expression: ToolExpression, equilibrium: Equilibrium, limits: Array, count: int, seed: int
    ) -> None:
        kinds = [expression.arm.commanded[joint] for joint in expression.joints]
        reach = np.array([FREE_ANGLE if kind == "angle" else FREE_TRAVEL for kind in kinds])
        low = np.where(np.isfinite(limits[:, 0]), limits[:, 0], np.minimum(-reach, limits[:, 1] - 2 * reach))
        high = np.where(np.isfinite(limits[:, 1]), limits[:, 1], np.maximum(reach, limits[:, 0] + 2 * reach))
        wide = high - low > 2 * _WIDEST
        middle = np.minimum(np.maximum(0.0, low + _WIDEST), high - _WIDEST)
        low, high = np.where(wide, middle - _WIDEST, low), np.where(wide, middle + _WIDEST, high)
        commands = low[:, None] + _spread_evenly(len(limits), count, seed) * (high - low)[:, None]
        standing = equilibrium(expression.records(commands))
        kept = standing.settled
        self.commands, self.states = commands[:, kept], standing.states[:, kept]
        self._tools = standing.base_T_tool[kept]

    @property
    def spread(self) -> float:
        places = self._tools[:, :3, 3]
        return float(np.median(np.linalg.norm(places - places.mean(axis=0), axis=1)))

    def at(self, picks: Indices) -> tuple[Array, Array]:  # n x and n_d x the shape of ``picks``
        return np.take(self.commands, picks, axis=1), np.take(self.states, picks, axis=1)

    def apart(self, targets: Array, length: float) -> Array:
        """How far each seed is from targets (3 or 12 x N), but for what is the same for all seeds (N x M; m^2)."""
        scales = np.array([1.0] * 3 + [length / np.sqrt(2)] * (len(targets) - 3))[:, None]
        mine = np.concatenate([self._tools[:, :3, 3].T, self._tools[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9).T])
        mine = (mine[: len(targets)] * scales).astype(np.float32)
        theirs = (-2.0 * np.clip(targets, -FARTHEST_M, FARTHEST_M) * scales).astype(np.float32)
        return np.asarray(theirs.T @ mine + np.einsum("km,km->m", mine, mine))


def _spread_evenly(dimensions: int, count: int, seed: int) -> Array:
    """Points of the unit cube (dimensions x count): multiples of irrational numbers, without their whole part.

    The numbers are powers of the inverse of the root of x^(d+1) = x + 1. [Roberts2018]
    """
    root = 2.0
    for _ in range(60):
        root = (1 + root) ** (1 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1)
    shift = np.random.default_rng(seed).random(dimensions)
    return np.asarray((shift[:, None] + steps[:, None] * np.arange(count)) % 1.0)
