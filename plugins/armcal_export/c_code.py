"""The exporter ``c``: the calibrated arm as C99, compiled and tested before it is handed out.

A function is plain and scalar: one assignment for each operation, no memory, no state. CasADi's own generated C drags a
calling convention of pointers to pointers and work arrays along, and does not pass ``-pedantic -Wextra``. Its
instruction list, written out over local constants, needs neither.
"""

import math
import re
import subprocess
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path, PurePath
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.joints import joint_limits
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array
from armcal.base.config_text import shown
from armcal.base.se3 import Expression
from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest, changed_numbers, random_commands
from armcal.calibration.tool_expression import ToolExpression
from armcal.errors import ConfigError, InputError, Location, NotConvergedError, ProblemError
from armcal.functions.c_source import LIBRARY, operations
from armcal.functions.compiler import find_compiler
from armcal.io.plain_files import writing
from pydantic import field_validator

from armcal_export.description import REPORT, in_equilibrium

CASES = 24
FLAGS = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic")
# Operations: slopes of more are evaluated column by column, so that they compile in seconds and fit small memories
MOST_WHOLE = 12000
_FEW_PASSES, _MANY_PASSES = 2, 30
_TOLERANCE = 1e-12  # m, and entries of rotation matrices
_PAYLOAD_KG, _FORCE_N = 0.05, 0.5
_TOLD = 9
_LIMIT_S = 300
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*\.c")
_PREFIX = re.compile(r"\b(arm|ARM)_")
_OPERATORS = {
    "ADD": "{0} + {1}", "SUB": "{0} - {1}", "MUL": "{0} * {1}", "DIV": "{0} / {1}", "NEG": "-{0}", "SQ": "{0} * {0}",
    "TWICE": "{0} + {0}", "INV": "1.0 / {0}", "ASSIGN": "{0}", "LT": "{0} < {1} ? 1.0 : 0.0",
    "LE": "{0} <= {1} ? 1.0 : 0.0", "EQ": "{0} == {1} ? 1.0 : 0.0", "NE": "{0} != {1} ? 1.0 : 0.0",
    "NOT": "{0} == 0.0 ? 1.0 : 0.0", "AND": "({0} != 0.0) && ({1} != 0.0) ? 1.0 : 0.0",
    "OR": "({0} != 0.0) || ({1} != 0.0) ? 1.0 : 0.0", "IF_ELSE_ZERO": "{0} != 0.0 ? {1} : 0.0",
    "SIGN": "{0} < 0.0 ? -1.0 : ({0} > 0.0 ? 1.0 : {0})",
}  # fmt: skip
_LIBRARY = {**LIBRARY, "SIN": "sin", "COS": "cos"}


class CExportSettings(Settings):
    """How the C code names things, and what it is told."""

    prefix: str = ""  # of every name in the code; the arm's name unless given
    conditions: tuple[str, ...] = ()  # of the surroundings (``temperature``; C); others are as in the calibration

    @field_validator("prefix")
    @classmethod
    def _identifier(cls, value: str) -> str:
        if value and not re.fullmatch(r"[a-z][a-z0-9_]{0,30}", value):
            raise ValueError(f"{value!r} is no prefix; use lower case letters, digits and _, a letter first")
        return value


class CExporter:
    Settings: ClassVar[type[CExportSettings]] = CExportSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"prefix": "left"}
    holds_residual: ClassVar[bool] = True
    holds_couplings: ClassVar[bool] = True

    def __init__(self, settings: CExportSettings) -> None:
        self._settings = settings

    def export(self, request: ExportRequest) -> Exported:
        """The code, compiled without a warning and run against armcal's own poses where there is a compiler."""
        out, conditions = request.out or "arm.c", self._settings.conditions
        if not _NAME.fullmatch(out):
            raise InputError(
                f"found the name {out!r}, expected that of a C file.",
                where=Location(out),
                hint="Write letters, digits, _ and -, and .c at the end: --out arm.c.",
            )
        unknown = [name for name in conditions if name not in request.arm.conditions]
        if unknown:
            known = ", ".join(request.arm.conditions) or "none"
            raise ConfigError(f"nothing of the arm depends on {unknown[0]!r}.", hint=f"It depends on: {known}.")
        stem, e = PurePath(out).stem, request.expression(conditions)
        header, test = f"{stem}.h", f"{stem}_test.c"
        prefix = self._settings.prefix or re.sub(r"[^a-z0-9_]", "_", request.name.lower())
        content = _content(request, e) | {"source": out, "header": header, "test": test}
        content["expressions"], content["first_passes"] = arm_functions(e, prefix)
        content["cases"] = _cases(e)
        sources = {
            name: filled(template, prefix, **content).encode("ascii")
            for name, template in ((out, "arm.c.j2"), (header, "arm.h.j2"), (test, "arm_test.c.j2"))
        }
        remarks = []
        if request.arm.deflection_size and not request.payload_stated:
            remarks.append("the calibration does not say what hangs on the tool: the default payload is 0 kg")
        if untold := [name for name in request.arm.conditions if name not in conditions]:
            ask = f"--option conditions=[{', '.join(request.arm.conditions)}]"
            taken = f"the code takes {', '.join(untold)} as the calibration does where it is not recorded"
            remarks.append(f"{taken}; {ask} asks")
        remarks += _compiled_and_run(sources, out, test)
        return Exported(sources.pop(out), changed_numbers(request), companions=sources, remarks=tuple(remarks))


def _content(request: ExportRequest, e: ToolExpression) -> dict[str, Any]:
    origin, units = request.origin, {"angle": "rad", "length": "m"}
    dated = [
        f"Calibrated {origin.created}" if origin.created else "",
        f"by armcal {origin.software['armcal']}" if "armcal" in origin.software else "",
    ]
    limits = [own or (-math.inf, math.inf) for own in joint_limits(e.arm.nominal_chain).values()]
    joints = [(name, units[e.arm.commanded[name]]) for name in e.joints]
    ends = zip(joints, limits, strict=True)
    return {
        "name": request.name,
        "experiment": origin.experiment or "no name",
        "calibrated": " ".join(part for part in dated if part),
        "identity": request.digest,
        "effects": ", ".join(request.arm.effects) or "none",
        "joints": e.joints,
        "commands": [f"{name} ({unit})" for name, unit in joints],
        "limits": limits,
        "limit_texts": [
            f"{name} {low:.6g} to {high:.6g} {unit}" if low > -math.inf else f"{name} none known"
            for (name, unit), (low, high) in ends
        ],
        "chain_joints": len(e.arm.joint_names),
        "states": e.state.numel(),
        "record": len(e.channels),
        "conditions": e.channels[e.channels.index(LOAD_CHANNELS[-1]) + 1 :],
        "defaults": _input_row(e, list(e.defaults)),
        "tolerance": _TOLERANCE,
        **_servos(e),
    }


def _input_row(e: ToolExpression, record: list[float]) -> str:
    n, start = len(e.joints), 2 * len(e.joints)
    rows = [c_row(record[:n]), c_row(record[n:start])]
    for size in (3, 1, 3, 3, 3):  # gravity, payload, its centre, force, torque
        part = record[start : start + size]
        rows.append(c_row(part) if size > 1 else c_number(part[0]))
        start += size
    return "{" + ", ".join([*rows, *([c_row(record[start:])] if len(record) > start else [])]) + "}"


def _servos(e: ToolExpression) -> dict[str, Any]:
    """Pulse tables; and of some angles the joint, the angle, the counts and where these turn it."""
    servos, tested = [], []
    for name, (table, clock) in e.servos.items():
        joint = e.joints.index(name)
        servos.append({"joint": joint, "angles": table.angles, "pulses": table.pulses, "tick": c_number(clock.tick)})
        for angle in np.linspace(min(table.angles), max(table.angles), _TOLD):
            counts = float(ca.evalf(clock.counts(table.pulse(ca.SX(float(angle))))))
            turned = float(ca.evalf(table.angle(ca.SX(counts * clock.tick))))
            tested.append((joint, c_number(float(angle)), int(counts), c_number(turned)))
    return {"servos": servos, "tested": tested}


def _cases(e: ToolExpression) -> list[tuple[str, str, str]]:
    """Random poses within the limits that settle, every other one under a further load: input, tool, efforts."""
    random = np.random.default_rng(2)
    records, joints = e.records(random_commands(e.arm, CASES)).T.copy(), len(e.joints)
    records[:, joints : 2 * joints] = random.integers(-1, 2, (CASES, joints))
    place = e.channels.index
    records[1::2, place("payload")] += random.uniform(0, _PAYLOAD_KG, CASES)[1::2]
    records[1::2, place("force_x")] += random.uniform(-_FORCE_N, _FORCE_N, CASES)[1::2]
    tools, efforts, settled = in_equilibrium(e, records)
    if not settled.any():
        raise NotConvergedError(
            "the arm has no elastic equilibrium in a pose within its limits.",
            hint="Check masses and compliances: springs this soft do not hold the arm.",
        )
    settling = zip(records[settled], tools[settled], efforts[settled], strict=True)
    return [(_input_row(e, list(record)), c_row(pose.ravel()), c_row(own)) for record, pose, own in settling]


def arm_functions(e: ToolExpression, prefix: str) -> tuple[str, int]:
    """``pass``, ``tool``, ``efforts_at``, ``state_slope``, ``tool_slope``; passes worth while before a Newton step."""
    inputs, names = [e.record, e.state], ["record", "state"]
    written = [
        c_function(_function(inputs, [e.next_state]), "pass", names, ["next"]),
        c_function(_function(inputs, [_rows(e.base_T_tool.matrix()[:3, :])]), "tool", names, ["pose"]),
        c_function(_function(inputs, [e.efforts]), "efforts_at", names, ["efforts"]),
    ]
    held = ca.SX.sym("held", 3, 3)
    turned = ca.mtimes(e.base_T_tool.rotation, held.T)
    twist = ca.vertcat(e.base_T_tool.translation, turned[2, 1], turned[0, 2], turned[1, 0])

    def at_tool(slope: Expression) -> Expression:
        return ca.densify(ca.substitute(ca.densify(slope), held, ca.densify(e.base_T_tool.rotation)))

    state_slope = _function(inputs, [e.next_state, _rows(e.slope())])
    slopes = [ca.jacobian(twist, e.commands), ca.jacobian(twist, e.state), ca.jacobian(e.next_state, e.commands)]
    tool_slope = _function(inputs, [_rows(at_tool(slope)) for slope in slopes])
    whole = state_slope.n_instructions() + tool_slope.n_instructions()
    if whole <= MOST_WHOLE:
        written.append(c_function(state_slope, "state_slope", names, ["next", "slope"]))
        written.append(c_function(tool_slope, "tool_slope", names, ["jacobian", "by_state", "by_command"]))
        return "\n".join(written), _FEW_PASSES
    # How state and tool follow one direction of commands and state
    expression, along = ca.SX.sym("told", len(e.joints)), ca.SX.sym("along", e.state.numel())
    both, ways = ca.vertcat(e.commands, e.state), ca.vertcat(expression, along)
    moved = [ca.densify(ca.jtimes(term, both, ways)) for term in (e.next_state, twist)]
    function = _function([*inputs, expression, along], [moved[0], at_tool(moved[1])])
    written.append(c_function(function, "tangent", [*names, "told", "along"], ["next", "twist"]))
    written.append(filled("columns.c.j2", prefix, whole=whole))
    return "\n".join(written), _MANY_PASSES


def _rows(matrix: Expression) -> Expression:
    return ca.vec(ca.densify(matrix).T)


def _function(inputs: list[Expression], outputs: list[Expression]) -> ca.Function:
    return ca.Function("written", inputs, outputs, {"cse": True})


def c_function(function: ca.Function, name: str, inputs: Sequence[str], outputs: Sequence[str]) -> str:
    """A function of SX as a static C function ``name(inputs, outputs)``, every argument an array of doubles."""
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
                value = f"{_LIBRARY[operation]}({', '.join(operands)})"
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


def c_number(value: float) -> str:
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


def c_row(numbers: Iterable[float] | Array) -> str:
    return "{" + ", ".join(c_number(number) for number in numbers) + "}"


def in_comment(text: str) -> str:
    """Text of a user's as it can stand in a comment: ASCII, one line, and no end of a comment."""
    line = shown(" ".join(text.split())).encode("ascii", "replace").decode()
    return line.replace("*/", "* /").replace("/*", "/ *").replace("\\", "/").replace("??", "? ?")


def quoted(text: str) -> str:
    """Text as a C string; what is not printable ASCII in octal."""
    plain = {byte: chr(byte) for byte in range(32, 127) if chr(byte) not in '"\\?'}
    return '"' + "".join(plain.get(byte, f"\\{byte:03o}") for byte in text.encode("utf-8")) + '"'


def filled(template: str, prefix: str, **content: Any) -> str:
    """A template filled, and its names that begin with ``arm_`` or ``ARM_`` under another prefix."""
    import jinja2

    text = resources.files("armcal_export").joinpath("templates", template).read_text(encoding="utf-8")
    text = _PREFIX.sub(lambda match: f"{prefix if match[1] == 'arm' else prefix.upper()}_", text)
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.keep_trailing_newline = True
    environment.filters.update(row=c_row, comment=in_comment, quoted=quoted)
    return environment.from_string(text).render(content)


def _compiled_and_run(sources: Mapping[str, bytes], source: str, test: str) -> list[str]:
    """What is to be remarked: nothing, or that no compiler is there."""
    compiler = find_compiler()
    if compiler is None:
        return ["not compiled and not compared here: no C compiler was found (cc, gcc or clang)"]
    place = writing(Path("the temporary folder"), "Make room in it, or set TMPDIR to one with room.")
    with place, tempfile.TemporaryDirectory(prefix="armcal-c-") as directory:
        for name, content in sources.items():
            Path(directory, name).write_bytes(content)
        program = str(Path(directory, "test-program"))
        for command, failing in (
            ([compiler, *FLAGS, "-o", program, source, test, "-lm"], "does not compile"),
            ([program], "differs from the calibrated arm"),
        ):
            try:
                done = subprocess.run(command, cwd=directory, capture_output=True, timeout=_LIMIT_S, check=False)
            except (OSError, subprocess.TimeoutExpired) as fault:
                hint = "Set ARMCAL_CC=none to do without."
                raise ProblemError(f"the C code cannot be tested here: {fault}.", hint=hint) from fault
            if done.returncode:
                said = (done.stderr or done.stdout).decode(errors="replace").strip().splitlines()
                faults = [line for line in said if "error" in line] or said or [f"exit code {done.returncode}"]
                raise ProblemError(f"the C code {failing}: {' | '.join(faults[:4])[:500]}.", hint=REPORT)
    return []
