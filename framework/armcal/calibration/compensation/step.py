"""One step of a search for commands: damped Gauss-Newton on commands, Newton on the elastic equilibrium, together.

At commands q and elastic state d, with pass F, everything follows from one pass and a small solve: what is left of the
equilibrium, d0 = (I - F_d)^-1 (F - d), and how the state follows the commands, D = (I - F_d)^-1 F_q. The tool's
slope is T_q + T_d D. With the error e (position, and turn times a length) and the slope J, the step is

    M r + M J^T (J M J^T + damping I)^-1 (e - J M r),

M the joints that are free to move and r the preferred step beside the target, which only moves the arm where the target
does not care [Nakamura1986]; or the same by the joints where there are fewer of them than equations.

Near a pose in which the arm cannot turn some way, the way to the target is long and bent: errors may grow for a few
steps before they vanish. So steps are not taken back; their damping grows with the squared error [Sugihara2011], and
the best of all steps is kept. A joint that meets its limit is held there until the target pulls it back.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from itertools import accumulate

import casadi as ca

from armcal.base import se3
from armcal.base.se3 import Expression
from armcal.calibration.tool_expression import ToolExpression

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
    """How the tool moves with the commands, in equilibrium to first order."""

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


def twists(own_slopes: Slopes) -> Expression:
    """The tool's slope by the commands (6 x n): metres, then rad about the axes of the base frame.

    Half the sum of r_i x dr_i over the columns of the rotation is the turn.
    """
    here, turns = ca.reshape(own_slopes.corrected[:9], 3, 3), []
    for joint in range(own_slopes.tool.size2()):
        moved = ca.reshape(own_slopes.tool[:9, joint], 3, 3)
        turns.append(sum((ca.cross(here[:, i], moved[:, i]) for i in range(3)), ca.SX(3, 1)) / 2)
    return ca.vertcat(own_slopes.tool[9:, :], ca.horzcat(*turns))


def force_compliance(expression: ToolExpression) -> Expression:
    """How the tool gives way to a force at it (3 x 3; m/N, base frame), in equilibrium."""
    places = [expression.channels.index(f"force_{axis}") for axis in "xyz"]
    by_force = ca.jacobian(expression.next_state, expression.record)[:, places]
    by_state = ca.jacobian(expression.base_T_tool.translation, expression.state)
    return ca.mtimes(by_state, expression.to_equilibrium(by_force)[0])


def tool_error(own_slopes: Slopes, position: Expression, rotation: Expression | None) -> tuple[Expression, Expression]:
    """From where the tool is to a target: metres, then a rotation vector in the base frame; and its slope (m x n)."""
    away, slope = position - own_slopes.corrected[9:], own_slopes.tool[9:, :]
    if rotation is None:
        return away, slope
    here = ca.reshape(own_slopes.corrected[:9], 3, 3)
    return ca.vertcat(away, _rotation_vector(here, rotation)), twists(own_slopes)


def step_function(expression: ToolExpression, own_slopes: Slopes, turns: bool) -> ca.Function:
    """(record, target, preference, free, damping, length, state) -> (step, state left, state moved, error, pull).

    ``target`` is a position (3; m) and, where the tool ``turns`` to one, a rotation (9, column by column);
    ``preference`` (n) moves the arm where the target does not care; ``free`` (n) is one for joints
    that may move; ``damping`` (1; m^2). The error is in m and rad; ``pull`` (n) is where each joint would go if it were
    free: of a joint that is held at a limit its sign says whether target and preference pull it back.
    """
    count = len(expression.joints)
    target = ca.SX.sym("target", 12 if turns else 3)
    preference, free, damping = ca.SX.sym("preference", count), ca.SX.sym("free", count), ca.SX.sym("damping")
    error, slope = tool_error(own_slopes, target[:3], ca.reshape(target[3:], 3, 3) if turns else None)
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


def search_function(expression: ToolExpression, own_slopes: Slopes, turns: bool) -> ca.Function:
    """(settings, record, target, towards, progress) -> progress, one step on.

    ``target`` is a position (3; m) and, where the tool ``turns`` to one, a rotation (9, column by column); ``towards``
    are commands to come near to where that is ``preferred``.
    """
    joints, states = len(expression.joints), expression.state.numel()
    settings, progress = ca.SX.sym("settings", len(SETTINGS) + 2 * joints), progress_places(joints, states)
    target, towards = ca.SX.sym("target", 12 if turns else 3), ca.SX.sym("towards", joints)
    before = ca.SX.sym("progress", progress["end"].stop)
    search = _Search(joints, settings, {name: before[place] for name, place in progress.items()})
    now = search.now
    preference = search.stated["preferred"] * (towards - now["commands"])
    preference *= _shortening(_largest(preference))  # as a whole: joint by joint it would point elsewhere
    record = ca.vertcat(now["commands"], expression.record[joints:])
    one_step, length = step_function(expression, own_slopes, turns), search.stated["length"]
    outputs = one_step(record, target, preference, now["free"], now["damping"], length, now["state"])
    step, left, along, error, pull = outputs
    after = search.judged(step, left, error, pull) | search.moved(step, left, along, pull)
    inputs = [settings, expression.record, target, towards, before]
    names = ["settings", "record", "target", "towards", "progress"]
    output = ca.densify(ca.vertcat(*[after[name] for name in progress]))
    return ca.Function("search", inputs, [output], names, ["after"], {"cse": True})


class _Search:
    """What a step makes of the progress of a search.

    Attributes:
        stated: SETTINGS.
        now: the progress by name.
    """

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
    here = ca.reshape(own_slopes.corrected[:9], 3, 3)
    slope = tool_error(own_slopes, own_slopes.corrected[9:], here if turns else None)[1]
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


def _rotation_vector(here: Expression, there: Expression) -> Expression:
    """The turn (rad, base frame) from one rotation to another; nothing is differentiated through it."""
    sine = sum((ca.cross(here[:, i], there[:, i]) for i in range(3)), ca.SX(3, 1)) / 2
    cosine = (sum((ca.dot(here[:, i], there[:, i]) for i in range(3)), ca.SX(0)) - 1) / 2
    size = ca.sqrt(ca.dot(sine, sine))
    # Where both vanish together, as in a half turn, the direction is lost; elsewhere the ratio tends to one.
    small = size < 1e-9
    return sine * ca.if_else(small, 1, ca.atan2(size, cosine) / ca.if_else(small, 1, size))
