"""The expressions of one arm as static C functions, slopes whole where they are short; its servo boards."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from armcal.base.se3 import Expression
from armcal.calibration.tool_expression import ToolExpression

from armcal_export.c_text import c_function, c_number, c_row, filled, with_prefix

_DECLARATIONS = """
/* The counts that a servo board is told for a command of a joint (from 0), the nearest; -1 of a joint that has no pulse
   table, or where the board has no such pulse. Only whole counts can be set: command what arm_set_angle gives. */
long arm_counts(int joint, double angle);

/* The angle (rad) at which a joint stands that is set by these counts; NAN of a joint that has no pulse table. */
double arm_set_angle(int joint, long counts);
"""
_TEST = """  {{
    static const struct {{ int joint; double angle; long counts; double set; }} told[] = {{
{rows}
    }};
    double turned = 0.0;
    int wrong = 0;
    for (int i = 0; i < {count}; ++i) {{
      wrong += arm_counts(told[i].joint, told[i].angle) != told[i].counts;
      turned = fmax(turned, fabs(arm_set_angle(told[i].joint, told[i].counts) - told[i].set));
    }}
    printf("servos: %d of {count} counts differ, %.3g rad apart at most (allowed: 1e-12)\\n", wrong, turned);
    failed += wrong || !(turned <= 1e-12);
  }}
"""
_TOLD = 9
MOST_WHOLE = 12000
"""Operations: slopes of more are evaluated column by column, so that they compile in seconds and fit small memories."""
_FEW_PASSES, _MANY_PASSES = 2, 30


def servo_parts(e: ToolExpression, prefix: str) -> dict[str, str]:
    """The parts of header, source and test that serve pulse tables; empty without any."""
    if not e.servos:
        return {"servo_declarations": "", "servos": "", "servo_test": ""}
    tables, rows, texts = [], [], []
    for name, (table, clock) in e.servos.items():
        joint = e.joints.index(name)
        for kind, numbers in (("angles", table.angles), ("pulses", table.pulses)):
            tables.append(f"static const double {kind}_{joint}[] = {c_row(numbers)};")
        points, tick = len(table.angles), c_number(clock.tick)
        rows.append(f"  {{{joint}, {points}, {tick}, angles_{joint}, pulses_{joint}}}")
        for angle in np.linspace(min(table.angles), max(table.angles), _TOLD):
            counts = float(ca.evalf(clock.counts(table.pulse(ca.SX(float(angle))))))
            turned = float(ca.evalf(table.angle(ca.SX(counts * clock.tick))))
            texts.append(f"      {{{joint}, {c_number(float(angle))}, {int(counts)}L, {c_number(turned)}}}")
    filling = {"tables": "\n".join(tables), "rows": ",\n".join(rows), "count": str(len(rows))}
    return {
        "servo_declarations": with_prefix(_DECLARATIONS, prefix),
        "servos": filled("servos.c.in", prefix, **filling),
        "servo_test": with_prefix(_TEST.format(rows=",\n".join(texts), count=len(texts)), prefix),
    }


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
    held = ca.SX.sym("held", 3, 3)
    turned = ca.mtimes(e.base_T_tool.rotation, held.T)
    turns = [turned[2, 1], turned[0, 2], turned[1, 0]]
    return ca.vertcat(e.base_T_tool.translation, *turns), held


def _at_tool(e: ToolExpression, slope: Expression, held: Expression) -> Expression:
    return ca.densify(ca.substitute(ca.densify(slope), held, ca.densify(e.base_T_tool.rotation)))


def _rows(matrix: Expression) -> Expression:
    return ca.vec(ca.densify(matrix).T)


def _function(inputs: list[Expression], outputs: list[Expression]) -> ca.Function:
    return ca.Function("written", inputs, outputs, {"cse": True})
