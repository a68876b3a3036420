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

LANES = 8
_PART = 1600
"""Statements a function: a kernel of 7600 compiles in 3.8 s, not 6.5 s, and takes a quarter more time a record."""
_VALUE = re.compile(r"\b(?:w|sin_|cos_)\d+\b")

_BINARY = {"ADD": "{} + {}", "SUB": "{} - {}", "MUL": "{} * {}", "DIV": "{} / {}"}
_UNARY = {"NEG": "-{}", "SQ": "{0} * {0}", "TWICE": "{0} + {0}", "INV": "1.0 / {}", "ASSIGN": "{}"}
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
TWO_ARGUMENTS = {
    "ATAN2", "POW", "CONSTPOW", "FMIN", "FMAX", "COPYSIGN", "LT", "LE", "EQ", "NE", "AND", "OR", "IF_ELSE_ZERO",
}  # fmt: skip


@cache
def operations() -> Mapping[int, str]:
    return {getattr(ca, name): name[3:] for name in dir(ca) if name.startswith("OP_")}


@dataclass(frozen=True)
class CFunction:
    """One function in C: its source and how many hoisted numbers it reads."""

    source: str
    hoisted: int


class UnsupportedExpressionError(Exception):
    """An expression has an operation that the C writer does not know; the interpreter serves."""


@dataclass(frozen=True)
class _Term:
    """A C expression; ``uniform`` when it is the same for all records."""

    text: str
    uniform: bool


class _Writer:
    """Walks an instruction list once and keeps two texts: what is hoisted, and what runs for each vector of records."""

    def __init__(self, function: ca.Function, uniform_inputs: int) -> None:
        self._function = function
        self._uniform_inputs = uniform_inputs
        self._slots: dict[int, _Term] = {}
        self._sincos: dict[str, int] = {}
        self.hoisted: list[str] = []
        self.hoisted_names: dict[str, int] = {}
        self.body: list[str] = []
        self._count = 0

    def run(self) -> None:
        f = self._function
        for k in range(f.n_instructions()):
            self._instruction(operations()[f.instruction_id(k)], f.instruction_input(k), f.instruction_output(k), k)

    def _instruction(self, operation: str, i: list[int], o: list[int], k: int) -> None:
        if operation == "INPUT":
            uniform = i[0] < self._uniform_inputs
            self._slots[o[0]] = _Term(f"in{i[0]}[{i[1]}]", uniform)
            if not uniform:
                self._slots[o[0]] = self._assign(f"in{i[0]}[{i[1]}]", False)
        elif operation == "CONST":
            self._slots[o[0]] = _Term(_number(self._function.instruction_constant(k)), True)
        elif operation == "OUTPUT":
            self.body.append(f"out{o[0]}[{o[1]}] = {self._read(self._slots[i[0]], vector=True)};")
        else:
            self._slots[o[0]] = self._operate(operation, [self._slots[s] for s in i])

    def _operate(self, operation: str, arguments: list[_Term]) -> _Term:
        if operation in ("MUL", "ADD", "SUB", "DIV"):
            pass
        elif operation in _UNARY or (operation in _FUNCTIONS and operation not in TWO_ARGUMENTS):
            arguments = arguments[:1]
        elif operation not in TWO_ARGUMENTS:
            raise UnsupportedExpressionError(operation)
        uniform = all(a.uniform for a in arguments)
        if operation in ("SIN", "COS") and not uniform:
            return self._sine_and_cosine(operation, arguments[0])
        pattern = _BINARY.get(operation) or _UNARY.get(operation)
        if pattern:
            texts = [a.text if uniform else self._read(a, vector=False) for a in arguments]
            return self._assign(pattern.format(*texts), uniform)
        prefix = "s_" if uniform else "v_"
        texts = [a.text if uniform else self._read(a, vector=True) for a in arguments]
        return self._assign(f"{prefix}{_FUNCTIONS[operation]}({', '.join(texts)})", uniform)

    def _sine_and_cosine(self, operation: str, argument: _Term) -> _Term:
        text = argument.text
        if text not in self._sincos:
            self._sincos[text] = number = len(self._sincos)
            self.body.append(f"V sin_{number}, cos_{number}; v_sincos({text}, &sin_{number}, &cos_{number});")
        return _Term(f"{'sin' if operation == 'SIN' else 'cos'}_{self._sincos[text]}", False)

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
        if term.uniform and not _is_number(text):
            text = f"c[{self.hoisted_names.setdefault(text, len(self.hoisted_names))}]"
        return f"broadcast({text})" if vector and term.uniform else text


def write_function(function: ca.Function, name: str, uniform_inputs: int) -> CFunction:
    """A CasADi SX function as C.

    The first ``uniform_inputs`` inputs are the same for all records (``double``), the others are vectors.
    Gives ``NAME_hoist(in0.., c)`` and ``NAME(c, in.., out..)``.

    Raises:
        UnsupportedExpressionError: an operation has no C form here.
    """
    writer = _Writer(function, uniform_inputs)
    writer.run()
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
    made = {value: k for k, part in enumerate(parts) for line in part for value in _made_by(line)}
    used = [{value for line in part for value in _VALUE.findall(line)} for part in parts]
    later = sorted({value for k, values in enumerate(used) for value in values if made[value] < k})
    place = {value: f"kept[{i}]" for i, value in enumerate(later)}
    calls = ", ".join(argument.rpartition(" ")[2].lstrip("*") for argument in arguments)
    text, main = "", [f"V kept[{max(1, len(later))}];"]
    for k, part in enumerate(parts):
        own = {value: value if made[value] == k else place[value] for value in used[k]}
        body = [_renamed(line, own) for line in part]
        body += [f"{place[value]} = {value};" for value in later if made[value] == k]
        text += "__attribute__((noinline)) "
        text += _definition(f"{name}_{k}", [*arguments, "V *restrict kept"], body)
        main.append(f"{name}_{k}({calls}, kept);")
    return text + _definition(name, arguments, main)


def _renamed(line: str, names: Mapping[str, str]) -> str:
    return _VALUE.sub(lambda value: names[value[0]], line)


def _made_by(line: str) -> list[str]:
    declared = line.partition(";")[0].partition("=")[0]
    return _VALUE.findall(declared) if line.startswith("V ") else []


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


def _is_number(text: str) -> bool:
    return text.startswith(("0x", "(-0x", "NAN", "INFINITY", "(-INFINITY"))
