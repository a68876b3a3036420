"""Servo boards in C: from commanded angles to counts and back, where the calibration has pulse tables."""

import casadi as ca
import numpy as np
from armcal.calibration.tool_expression import ToolExpression

from armcal_export.c_text import c_number, c_row, filled, with_prefix

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
