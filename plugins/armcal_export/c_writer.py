"""CasADi functions as plain scalar C99: one assignment for each operation, no memory, no state.

CasADi's own generated C drags a calling convention of pointers to pointers and work arrays along, and does not pass
``-pedantic -Wextra``. Its instruction list, written out over local constants, needs neither.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache

import casadi as ca
from armcal.errors import ConfigError

_OPERATORS = {
    "ADD": "{0} + {1}", "SUB": "{0} - {1}", "MUL": "{0} * {1}", "DIV": "{0} / {1}", "NEG": "-{0}", "SQ": "{0} * {0}",
    "TWICE": "{0} + {0}", "INV": "1.0 / {0}", "ASSIGN": "{0}", "LT": "{0} < {1} ? 1.0 : 0.0",
    "LE": "{0} <= {1} ? 1.0 : 0.0", "EQ": "{0} == {1} ? 1.0 : 0.0", "NE": "{0} != {1} ? 1.0 : 0.0",
    "NOT": "{0} == 0.0 ? 1.0 : 0.0", "AND": "({0} != 0.0) && ({1} != 0.0) ? 1.0 : 0.0",
    "OR": "({0} != 0.0) || ({1} != 0.0) ? 1.0 : 0.0", "IF_ELSE_ZERO": "{0} != 0.0 ? {1} : 0.0",
    "SIGN": "{0} < 0.0 ? -1.0 : ({0} > 0.0 ? 1.0 : {0})",
}  # fmt: skip
_LIBRARY = {
    "SIN": "sin", "COS": "cos", "TAN": "tan", "ASIN": "asin", "ACOS": "acos", "ATAN": "atan", "SQRT": "sqrt",
    "EXP": "exp", "LOG": "log", "SINH": "sinh", "COSH": "cosh", "TANH": "tanh", "FABS": "fabs", "ERF": "erf",
    "FLOOR": "floor", "CEIL": "ceil", "ATAN2": "atan2", "POW": "pow", "CONSTPOW": "pow", "FMIN": "fmin",
    "FMAX": "fmax", "COPYSIGN": "copysign",
}  # fmt: skip
_OF_TWO = {"ADD", "SUB", "MUL", "DIV", "LT", "LE", "EQ", "NE", "AND", "OR", "IF_ELSE_ZERO"} | {
    "ATAN2", "POW", "CONSTPOW", "FMIN", "FMAX", "COPYSIGN",
}  # fmt: skip


@cache
def _operations() -> Mapping[int, str]:
    return {getattr(ca, name): name[3:] for name in dir(ca) if name.startswith("OP_")}


def c_number(value: float) -> str:
    """A number as C99 reads it back to the last bit."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


def c_function(function: ca.Function, name: str, inputs: Sequence[str], outputs: Sequence[str]) -> str:
    """A function of SX as a static C function ``name(inputs, outputs)``, every argument an array of doubles.

    Raises:
        ConfigError: an operation has no form in C99.
    """
    values: dict[int, str] = {}
    lines = [f"(void){text};" for text in (*inputs, *outputs)]
    for k in range(function.n_instructions()):
        operation = _operations()[function.instruction_id(k)]
        i, o = function.instruction_input(k), function.instruction_output(k)
        if operation == "OUTPUT":
            lines.append(f"{outputs[o[0]]}[{o[1]}] = {values[i[0]]};")
        elif operation == "INPUT":
            values[o[0]] = f"{inputs[i[0]]}[{i[1]}]"
        elif operation == "CONST":
            value = function.instruction_constant(k)
            values[o[0]] = c_number(value) if value >= 0 else f"({c_number(value)})"
        else:
            lines.append(f"const double w{k} = {_written(operation, [values[slot] for slot in i])};")
            values[o[0]] = f"w{k}"
    arguments = [*(f"const double *{text}" for text in inputs), *(f"double *{output}" for output in outputs)]
    body = "\n".join(f"  {line}" for line in lines)
    return f"static void {name}({', '.join(arguments)})\n{{\n{body}\n}}\n"


def _written(operation: str, arguments: list[str]) -> str:
    used = arguments if operation in _OF_TWO else arguments[:1]
    if operation in _OPERATORS:
        return _OPERATORS[operation].format(*used)
    if operation in _LIBRARY:
        return f"{_LIBRARY[operation]}({', '.join(used)})"
    raise ConfigError(
        f"the arm's expression has the operation {operation}, which has no form in C99.",
        hint="Leave the effect that brings it out of the calibration.",
    )
