"""Text in C99: CasADi functions, numbers, words of a user's, and templates that are filled.

A function is plain and scalar: one assignment for each operation, no memory, no state. CasADi's own generated C drags a
calling convention of pointers to pointers and work arrays along, and does not pass ``-pedantic -Wextra``. Its
instruction list, written out over local constants, needs neither.
"""

import math
import re
from collections.abc import Iterable, Sequence
from importlib import resources

import casadi as ca
from armcal.base.config_text import shown
from armcal.errors import ConfigError
from armcal.functions.c_source import LIBRARY, TWO_ARGUMENTS, operations

_OPERATORS = {
    "ADD": "{0} + {1}", "SUB": "{0} - {1}", "MUL": "{0} * {1}", "DIV": "{0} / {1}", "NEG": "-{0}", "SQ": "{0} * {0}",
    "TWICE": "{0} + {0}", "INV": "1.0 / {0}", "ASSIGN": "{0}", "LT": "{0} < {1} ? 1.0 : 0.0",
    "LE": "{0} <= {1} ? 1.0 : 0.0", "EQ": "{0} == {1} ? 1.0 : 0.0", "NE": "{0} != {1} ? 1.0 : 0.0",
    "NOT": "{0} == 0.0 ? 1.0 : 0.0", "AND": "({0} != 0.0) && ({1} != 0.0) ? 1.0 : 0.0",
    "OR": "({0} != 0.0) || ({1} != 0.0) ? 1.0 : 0.0", "IF_ELSE_ZERO": "{0} != 0.0 ? {1} : 0.0",
    "SIGN": "{0} < 0.0 ? -1.0 : ({0} > 0.0 ? 1.0 : {0})",
}  # fmt: skip
_PLACE = re.compile(r"\{\{(\w+)\}\}")
_PREFIX = re.compile(r"\b(arm|ARM)_")
_LIBRARY = {**LIBRARY, "SIN": "sin", "COS": "cos"}


def c_number(value: float) -> str:
    """A number as C99 reads it back to the last bit."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


def c_row(numbers: Iterable[float]) -> str:
    return "{" + ", ".join(c_number(number) for number in numbers) + "}"


def c_function(function: ca.Function, name: str, inputs: Sequence[str], outputs: Sequence[str]) -> str:
    """A function of SX as a static C function ``name(inputs, outputs)``, every argument an array of doubles.

    Raises:
        ConfigError: an operation has no form in C99.
    """
    values: dict[int, str] = {}
    lines = [f"(void){text};" for text in (*inputs, *outputs)]
    for k in range(function.n_instructions()):
        operation = operations()[function.instruction_id(k)]
        i, o = function.instruction_input(k), function.instruction_output(k)
        if operation == "OUTPUT":
            lines.append(f"{outputs[o[0]]}[{o[1]}] = {values[i[0]]};")
        elif operation == "INPUT":
            values[o[0]] = f"{inputs[i[0]]}[{i[1]}]"
        elif operation == "CONST":
            constant = function.instruction_constant(k)
            values[o[0]] = c_number(constant) if constant >= 0 else f"({c_number(constant)})"
        else:
            operands = [values[slot] for slot in i]
            if operation in _OPERATORS:
                value = _OPERATORS[operation].format(*operands)
            elif operation in _LIBRARY:
                value = f"{_LIBRARY[operation]}({', '.join(operands if operation in TWO_ARGUMENTS else operands[:1])})"
            else:
                raise ConfigError(
                    f"the arm's expression has the operation {operation}, which has no form in C99.",
                    hint="Leave the effect that brings it out of the calibration.",
                )
            lines.append(f"const double w{k} = {value};")
            values[o[0]] = f"w{k}"
    arguments = [*(f"const double *{text}" for text in inputs), *(f"double *{output}" for output in outputs)]
    body = "\n".join(f"  {line}" for line in lines)
    return f"static void {name}({', '.join(arguments)})\n{{\n{body}\n}}\n"


def filled(template: str, prefix: str, **values: str) -> str:
    """A template with its places filled, and its names that begin with ``arm_`` or ``ARM_`` under another prefix."""
    text = resources.files("armcal_export").joinpath("templates", template).read_text(encoding="utf-8")
    return _PLACE.sub(lambda match: values[match[1]], with_prefix(text, prefix))


def with_prefix(text: str, prefix: str) -> str:
    return _PREFIX.sub(lambda match: f"{prefix if match[1] == 'arm' else prefix.upper()}_", text)


def in_comment(text: str) -> str:
    """Text of a user's as it can stand in a comment: ASCII, one line, and no end of a comment."""
    line = shown(" ".join(text.split())).encode("ascii", "replace").decode()
    return line.replace("*/", "* /").replace("/*", "/ *").replace("\\", "/").replace("??", "? ?")


def quoted(text: str) -> str:
    """Text as a C string; what is not printable ASCII in octal."""
    plain = {byte: chr(byte) for byte in range(32, 127) if chr(byte) not in '"\\?'}
    return '"' + "".join(plain.get(byte, f"\\{byte:03o}") for byte in text.encode("utf-8")) + '"'
