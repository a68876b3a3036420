"""One step towards a target: damped Gauss-Newton on commands, Newton on the elastic equilibrium, together.

At commands q and elastic state d, with pass F, everything follows from one pass and a small solve: what is left of the
equilibrium, d0 = (I - F_d)^-1 (F - d), and how the state follows the commands, D = (I - F_d)^-1 F_q. The tool's
slope is T_q + T_d D. With the error e (position, and turn times a length) and the slope J, the step is

    M r + M J^T (J M J^T + damping I)^-1 (e - J M r),

M the joints that are free to move and r what is wished beside the target, which only moves the arm where the target
does not care [Nakamura1986]; or the same by the joints where there are fewer of them than equations.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from armcal.base import se3
from armcal.base.domains import Array
from armcal.base.se3 import Expression
from armcal.calibration.tool_expression import ToolExpression


@dataclass(frozen=True)
class Slopes:
    """How the tool moves with the commands, in equilibrium to first order.

    Attributes:
        left: what is left of the equilibrium, d0 (n_d).
        state: d state / d commands (n_d x n).
        tool: d (rotation column by column, then position) / d commands (12 x n).
        corrected: rotation and position (12) at the equilibrium.
    """

    left: Expression
    state: Expression
    tool: Expression
    corrected: Expression


def slopes(expression: ToolExpression) -> Slopes:
    """By implicit differentiation at a state near the equilibrium. [Griewank2008]"""
    commands, state = expression.commands, expression.state
    pose = ca.densify(ca.vertcat(ca.vec(expression.base_T_tool.rotation), expression.base_T_tool.translation))
    by_commands = ca.jacobian(pose, expression.record)[:, : commands.numel()]
    if not state.numel():
        return Slopes(ca.SX(0, 1), ca.SX(0, commands.numel()), by_commands, pose)
    following = ca.jacobian(expression.next_state, expression.record)[:, : commands.numel()]
    left, moved = expression.to_equilibrium(expression.next_state - state, following)
    by_state = ca.jacobian(pose, state)
    return Slopes(left, moved, by_commands + ca.mtimes(by_state, moved), pose + ca.mtimes(by_state, left))


def rough_slopes(expression: ToolExpression) -> Slopes:
    """As if the elastic state did not follow the commands: a third of the work, and good enough far from a target."""
    commands, state = expression.commands, expression.state
    pose = ca.densify(ca.vertcat(ca.vec(expression.base_T_tool.rotation), expression.base_T_tool.translation))
    by_commands = ca.jacobian(pose, expression.record)[:, : commands.numel()]
    return Slopes(expression.next_state - state, ca.SX(state.numel(), commands.numel()), by_commands, pose)


def tool_error(own_slopes: Slopes, position: Expression, rotation: Expression | None) -> tuple[Expression, Expression]:
    """From where the tool is to a target: metres, then a rotation vector in the base frame; and its slope (m x n)."""
    away, slope = position - own_slopes.corrected[9:], own_slopes.tool[9:, :]
    if rotation is None:
        return away, slope
    here = ca.reshape(own_slopes.corrected[:9], 3, 3)
    turns = []
    for joint in range(slope.size2()):
        moved = ca.reshape(own_slopes.tool[:9, joint], 3, 3)
        turns.append(sum((ca.cross(here[:, i], moved[:, i]) for i in range(3)), ca.SX(3, 1)) / 2)
    return ca.vertcat(away, _rotation_vector(here, rotation)), ca.vertcat(slope, ca.horzcat(*turns))


def step_function(expression: ToolExpression, own_slopes: Slopes, turns: bool, length: float) -> ca.Function:
    """(record, target, wish, free, damping, state) -> (step, state left, state moved, error, pull).

    ``target`` is a position (3; m) and, where the tool ``turns`` to one, a rotation (9, column by column);
    ``preference`` (n) moves the arm where the target does not care; ``free`` (n) is one for joints
    that may move; ``damping`` (1; m^2). The error is in m and rad; ``pull`` (n) is where each joint would go if it were
    free: of a joint that is held at a limit its sign says whether target and preference pull it back.
    """
    count = len(expression.joints)
    target = ca.SX.sym("target", 12 if turns else 3)
    preference, free, damping = ca.SX.sym("wish", count), ca.SX.sym("free", count), ca.SX.sym("damping")
    error, slope = tool_error(own_slopes, target[:3], ca.reshape(target[3:], 3, 3) if turns else None)
    weight = ca.SX([1.0] * 3 + [length] * (error.numel() - 3))
    weighted = ca.diag(weight) @ slope
    step, pull = _step(weighted, weight * error, preference, free, damping)
    outputs = [step, own_slopes.left, ca.mtimes(own_slopes.state, step), error, pull]
    inputs = [expression.record, target, preference, free, damping, expression.state]
    return ca.Function("compensation_step", inputs, [ca.densify(output) for output in outputs], {"cse": True})


def slope_function(expression: ToolExpression, turns: bool) -> ca.Function:
    """(record, state) -> the tool's slope by the commands (3 x n; m), where it ``turns`` rotation too (6 x n; rad)."""
    own_slopes = slopes(expression)
    here = ca.reshape(own_slopes.corrected[:9], 3, 3)
    slope = tool_error(own_slopes, own_slopes.corrected[9:], here if turns else None)[1]
    inputs = [expression.record, expression.state]
    return ca.Function("tool_slope", inputs, [ca.vec(ca.densify(slope))], {"cse": True})


def sample_inputs(expression: ToolExpression) -> list[Array]:
    """A made-up record and state (8 columns each), to compare two forms of a function."""
    record = np.repeat(expression.defaults[:, None], 8, axis=1)
    count = len(expression.joints)
    record[:count] = np.random.default_rng(0).uniform(-1, 1, (count, 8))
    return [record, np.zeros((expression.state.numel(), 8))]


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
