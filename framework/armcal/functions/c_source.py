"""CasADi expressions as C that evaluates several records at once.

CasADi's own generated C is scalar. Here its instruction list is written out over short vectors
(GNU C vector extensions, understood by gcc and clang on every processor), with what depends on
parameters alone hoisted out of the loop over records. The interpreter stays the reference.

A long list is written as several functions in a row: the time that a compiler takes to find registers grows with the
square of a function's length.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

import casadi as ca

from armcal.functions.compiler import UnsupportedExpressionError

LANES = 8
_PART = 1600
"""Statements a function: a kernel of 7600 compiles in 3.8 s, not 6.5 s, and takes a quarter more time a record."""
_NUMBERS = ("0x", "(-0x", "NAN", "INFINITY", "(-INFINITY")  # How ``_number`` writes them
_VALUE = re.compile(r"\b(?:w|sin_|cos_)\d+\b")

_OPERATORS = {
    "ADD": "{} + {}", "SUB": "{} - {}", "MUL": "{} * {}", "DIV": "{} / {}",
    "NEG": "-{}", "SQ": "{0} * {0}", "TWICE": "{0} + {0}", "INV": "1.0 / {}", "ASSIGN": "{}",
}  # fmt: skip
LIBRARY = {
    "SQRT": "sqrt", "TAN": "tan", "ASIN": "asin", "ACOS": "acos", "ATAN": "atan", "EXP": "exp", "LOG": "log",
    "SINH": "sinh", "COSH": "cosh", "TANH": "tanh", "FABS": "fabs", "ERF": "erf", "FLOOR": "floor",
    "CEIL": "ceil", "ATAN2": "atan2", "POW": "pow", "CONSTPOW": "pow", "FMIN": "fmin", "FMAX": "fmax",
    "COPYSIGN": "copysign",
}  # fmt: skip
"""Operations of CasADi that are functions of the C library."""
_OWN = {
    "SIGN": "sign_of", "LT": "less", "LE": "less_equal", "EQ": "equal", "NE": "unequal", "NOT": "negation",
    "AND": "both", "OR": "either", "IF_ELSE_ZERO": "if_else_zero", "SIN": "sine", "COS": "cosine",
}  # fmt: skip
_FUNCTIONS = LIBRARY | _OWN


@cache
def operations() -> Mapping[int, str]:
    return {getattr(ca, name): name[3:] for name in dir(ca) if name.startswith("OP_")}


@dataclass(frozen=True)
class CFunction:
    source: str
    hoisted: int  # how many hoisted numbers it reads


@dataclass(frozen=True)
class _Term:
    text: str  # in C
    uniform: bool  # the same for all records


class _Writer:
    """Walks an instruction list once and keeps two texts: what is hoisted, and what runs for each vector of records."""

    def __init__(self, function: ca.Function, uniform_inputs: int) -> None:
        self._sincos: dict[str, int] = {}
        self.hoisted: list[str] = []
        self.hoisted_names: dict[str, int] = {}
        self.body: list[str] = []
        self._count = 0
        slots: dict[int, _Term] = {}
        for k in range(function.n_instructions()):
            operation = operations()[function.instruction_id(k)]
            i, o = function.instruction_input(k), function.instruction_output(k)
            if operation == "INPUT":
                entry, uniform = f"in{i[0]}[{i[1]}]", i[0] < uniform_inputs
                slots[o[0]] = _Term(entry, True) if uniform else self._assign(entry, False)
            elif operation == "CONST":
                slots[o[0]] = _Term(_number(function.instruction_constant(k)), True)
            elif operation == "OUTPUT":
                self.body.append(f"out{o[0]}[{o[1]}] = {self._read(slots[i[0]], vector=True)};")
            else:
                slots[o[0]] = self._operate(operation, [slots[s] for s in i])

    def _operate(self, operation: str, arguments: list[_Term]) -> _Term:
        uniform = all(a.uniform for a in arguments)
        if operation in ("SIN", "COS") and not uniform:
            number = self._sincos.get(text := arguments[0].text)
            if number is None:
                self._sincos[text] = number = len(self._sincos)
                self.body.append(f"V sin_{number}, cos_{number}; v_sincos({text}, &sin_{number}, &cos_{number});")
            return _Term(f"{operation.lower()}_{number}", False)
        pattern = _OPERATORS.get(operation)
        if pattern is None and operation not in _FUNCTIONS:
            raise UnsupportedExpressionError(operation)
        texts = [a.text if uniform else self._read(a, vector=pattern is None) for a in arguments]
        if pattern is None:
            pattern = f"{'s' if uniform else 'v'}_{_FUNCTIONS[operation]}({', '.join('{}' for _ in texts)})"
        return self._assign(pattern.format(*texts), uniform)

    def _assign(self, text: str, uniform: bool) -> _Term:
        name = f"{'h' if uniform else 'w'}{self._count}"
        self._count += 1
        if uniform:
            self.hoisted.append(f"double {name} = {text};")
        else:
            self.body.append(f"V {name} = {text};")
        return _Term(name, uniform)

    def _read(self, term: _Term, *, vector: bool) -> str:
        """A term as the per-record body sees it: hoisted numbers come from the table ``c``."""
        text = term.text
        if term.uniform and not text.startswith(_NUMBERS):
            text = f"c[{self.hoisted_names.setdefault(text, len(self.hoisted_names))}]"
        return f"broadcast({text})" if vector and term.uniform else text


def write_function(function: ca.Function, name: str, uniform_inputs: int) -> CFunction:
    """A CasADi SX function as C: ``NAME_hoist(in0.., c)`` and ``NAME(c, in.., out..)``.

    The first ``uniform_inputs`` inputs are the same for all records (``double``), the others are vectors.
    """
    writer = _Writer(function, uniform_inputs)
    scalars = [f"const double *in{i}" for i in range(uniform_inputs)]
    vectors = [f"const V *restrict in{i}" for i in range(uniform_inputs, function.n_in())]
    outputs = [f"V *restrict out{i}" for i in range(function.n_out())]
    table = [f"c[{number}] = {text};" for text, number in writer.hoisted_names.items()]
    hoist = _definition(f"{name}_hoist", [*scalars, "double *c"], writer.hoisted + table)
    body = _in_parts(name, ["const double *c", *vectors, *outputs], writer.body)
    return CFunction(hoist + body, max(1, len(writer.hoisted_names)))


def _in_parts(name: str, arguments: list[str], lines: Sequence[str]) -> str:
    """One function, or several that hand on what later ones read in an array ``kept``, called in order by the last."""
    if len(lines) <= _PART:
        return _definition(name, arguments, lines)
    parts = [lines[start : start + _PART] for start in range(0, len(lines), _PART)]
    # a line ``V NAME, NAME; ...`` or ``V NAME = ...;`` makes these values
    made = {
        value: k
        for k, part in enumerate(parts)
        for line in part
        if line.startswith("V ")
        for value in _VALUE.findall(line.partition(";")[0].partition("=")[0])
    }
    used = [{value for line in part for value in _VALUE.findall(line)} for part in parts]
    later = sorted({value for k, values in enumerate(used) for value in values if made[value] < k})
    place = {value: f"kept[{i}]" for i, value in enumerate(later)}
    calls = ", ".join(argument.rpartition(" ")[2].lstrip("*") for argument in arguments)
    text, main = "", [f"V kept[{max(1, len(later))}];"]
    for k, part in enumerate(parts):
        own = {value: value if made[value] == k else place[value] for value in used[k]}
        body = [_VALUE.sub(lambda value, own=own: own[value[0]], line) for line in part]  # type: ignore[misc]
        body += [f"{place[value]} = {value};" for value in later if made[value] == k]
        text += "__attribute__((noinline)) "
        text += _definition(f"{name}_{k}", [*arguments, "V *restrict kept"], body)
        main.append(f"{name}_{k}({calls}, kept);")
    return text + _definition(name, arguments, main)


def support_source() -> str:
    return resources.files("armcal.functions").joinpath("kernel_support.h").read_text(encoding="utf-8")


def generator_source() -> str:
    """This module's own text: part of what a compiled library depends on."""
    return resources.files("armcal.functions").joinpath("c_source.py").read_text(encoding="utf-8")


def _definition(name: str, arguments: list[str], lines: Sequence[str]) -> str:
    body = "\n".join("  " + line for line in lines)
    return f"static void {name}({', '.join(arguments)}) {{\n{body}\n}}\n"


def _number(value: float) -> str:
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    text = float(value).hex()
    return f"({text})" if value < 0 else text
