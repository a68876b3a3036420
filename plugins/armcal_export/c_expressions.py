"""The expressions of one arm as static C functions, slopes whole where they are short, else column by column."""

from dataclasses import dataclass

import casadi as ca
from armcal.base.se3 import Expression
from armcal.calibration.tool_expression import ToolExpression

from armcal_export.c_text import c_function, filled

MOST_WHOLE = 12000
"""Operations: slopes of more are evaluated column by column, so that they compile in seconds and fit small memories."""
_FEW_PASSES, _MANY_PASSES = 2, 30


@dataclass(frozen=True)
class ArmFunctions:
    """C source of ``pass``, ``tool``, ``efforts_at``, ``state_slope`` and ``tool_slope``.

    ``first_passes`` is how many passes are worth while before the first Newton step.
    """

    source: str
    first_passes: int


def arm_functions(e: ToolExpression, prefix: str) -> ArmFunctions:
    """The functions of an arm; ``prefix`` is that of public names."""
    inputs = [e.record, e.state]
    pose = ca.densify(ca.vec(e.base_T_tool.matrix()[:3, :].T))
    written = [
        c_function(_function([*inputs], [e.next_state]), "pass", ["record", "state"], ["next"]),
        c_function(_function([*inputs], [pose]), "tool", ["record", "state"], ["pose"]),
        c_function(_function([*inputs], [e.efforts]), "efforts_at", ["record", "state"], ["efforts"]),
    ]
    twist, direction = _twist(e)
    state_slope = _function(inputs, [e.next_state, _rows(e.slope())])
    slopes = [ca.jacobian(twist, e.commands), ca.jacobian(twist, e.state), ca.jacobian(e.next_state, e.commands)]
    tool_slope = _function(inputs, [_rows(_at_tool(e, slope, direction)) for slope in slopes])
    whole = state_slope.n_instructions() + tool_slope.n_instructions()
    if whole <= MOST_WHOLE:
        written.append(c_function(state_slope, "state_slope", ["record", "state"], ["next", "slope"]))
        outputs = ["jacobian", "by_state", "by_command"]
        written.append(c_function(tool_slope, "tool_slope", ["record", "state"], outputs))
        return ArmFunctions("\n".join(written), _FEW_PASSES)
    # How state and tool follow one direction of commands and state
    expression, along = ca.SX.sym("told", len(e.joints)), ca.SX.sym("along", e.state.numel())
    both, ways = ca.vertcat(e.commands, e.state), ca.vertcat(expression, along)
    moved = [ca.densify(ca.jtimes(term, both, ways)) for term in (e.next_state, twist)]
    function = _function([e.record, e.state, expression, along], [moved[0], _at_tool(e, moved[1], direction)])
    written.append(c_function(function, "tangent", ["record", "state", "told", "along"], ["next", "twist"]))
    written.append(filled("columns.c.in", prefix, whole=str(whole)))
    return ArmFunctions("\n".join(written), _MANY_PASSES)


def _twist(e: ToolExpression) -> tuple[Expression, Expression]:
    """Position and small turns from a rotation that is held, whose derivative is the twist; and that rotation."""
    held = ca.SX.sym("held", 3, 3)
    turned = ca.mtimes(e.base_T_tool.rotation, held.T)
    turns = [turned[2, 1], turned[0, 2], turned[1, 0]]
    return ca.vertcat(e.base_T_tool.translation, *turns), held


def _at_tool(e: ToolExpression, slope: Expression, held: Expression) -> Expression:
    return ca.densify(ca.substitute(ca.densify(slope), held, ca.densify(e.base_T_tool.rotation)))


def _rows(matrix: Expression) -> Expression:
    """Row by row."""
    return ca.vec(ca.densify(matrix).T)


def _function(inputs: list[Expression], outputs: list[Expression]) -> ca.Function:
    return ca.Function("written", inputs, outputs, {"cse": True})
