"""The exporter ``c``: the calibrated arm as C99, compiled and tested before it is handed out."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any, ClassVar

from armcal.arm.joints import joint_limits
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest, changed_numbers
from armcal.calibration.tool_expression import ToolExpression
from armcal.errors import ConfigError, InputError, Location
from pydantic import field_validator

from armcal_export.c_check import FileNames, compiled_and_run, input_row, test_source
from armcal_export.c_expressions import arm_functions, servo_parts
from armcal_export.c_text import c_row, filled, in_comment, quoted
from armcal_export.reference import reference_of

CASES = 24
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*\.c")


class CExportSettings(Settings):
    """How the C code names things, and what it is told.

    Attributes:
        prefix: of every name in the code; the arm's name unless given.
        conditions: of the surroundings that the code is told (``temperature``; C); others are as in the calibration.
    """

    prefix: str = ""
    conditions: tuple[str, ...] = ()

    @field_validator("prefix")
    @classmethod
    def _identifier(cls, value: str) -> str:
        if value and not re.fullmatch(r"[a-z][a-z0-9_]{0,30}", value):
            raise ValueError(f"{value!r} is no prefix; use lower case letters, digits and _, a letter first")
        return value


class CExporter:
    """Source, header and test program."""

    Settings: ClassVar[type[CExportSettings]] = CExportSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"prefix": "left"}
    holds_residual: ClassVar[bool] = True
    holds_couplings: ClassVar[bool] = True

    def __init__(self, settings: CExportSettings) -> None:
        self._settings = settings

    def export(self, request: ExportRequest) -> Exported:
        """The code, compiled without a warning and run against armcal's own poses where there is a compiler.

        Raises:
            InputError: the file's name is no C file's, or a condition is not the arm's.
            NotConvergedError: the arm settles in no pose.
            ProblemError: the compiler warns, or the compiled code differs.
        """
        out = request.out or "arm.c"
        if not _NAME.fullmatch(out):
            raise InputError(
                f"found the name {out!r}, expected that of a C file.",
                where=Location(out),
                hint="Write letters, digits, _ and -, and .c at the end: --out arm.c.",
            )
        stem = PurePath(out).stem
        files = FileNames(out, f"{stem}.h", f"{stem}_test.c")
        unknown = [name for name in self._settings.conditions if name not in request.arm.conditions]
        if unknown:
            known = ", ".join(request.arm.conditions) or "none"
            raise ConfigError(f"nothing of the arm depends on {unknown[0]!r}.", hint=f"It depends on: {known}.")
        expression = request.expression(self._settings.conditions)
        prefix = self._settings.prefix or re.sub(r"[^a-z0-9_]", "_", request.name.lower())
        places = {**_places(request, expression, files, prefix), **servo_parts(expression, prefix)}
        sources = {
            files.source: filled("arm.c.in", prefix, **places),
            files.header: filled("arm.h.in", prefix, **places),
            files.test: test_source(expression, reference_of(expression, CASES), prefix, places),
        }
        named = {name: text.encode("ascii") for name, text in sources.items()}
        remarks = (*_remarks(request, self._settings.conditions), *compiled_and_run(named, files))
        content = named.pop(files.source)
        return Exported(content, changed_numbers(request), companions=named, remarks=remarks)


def _remarks(request: ExportRequest, conditions: Sequence[str]) -> list[str]:
    texts = []
    if request.arm.deflection_size and not request.payload_stated:
        texts.append("the calibration does not say what hangs on the tool: the default payload is 0 kg")
    untold = [name for name in request.arm.conditions if name not in conditions]
    if untold:
        ask = f"--option conditions=[{', '.join(request.arm.conditions)}]"
        texts.append(f"the code takes {', '.join(untold)} as the calibration does where it is not recorded; {ask} asks")
    return texts


def _places(request: ExportRequest, e: ToolExpression, files: FileNames, prefix: str) -> dict[str, str]:
    """What stands in the places of the templates."""
    functions = arm_functions(e, prefix)
    conditions = e.channels[e.channels.index(LOAD_CHANNELS[-1]) + 1 :]
    size, listed = f"{prefix.upper()}_CONDITIONS", in_comment(", ".join(conditions))
    limits = [own or (-math.inf, math.inf) for own in joint_limits(e.arm.nominal_chain).values()]
    return {
        "title": in_comment(f"The arm {request.name}, as calibrated: {request.origin.experiment or 'no name'}."),
        "about": _about(request, e, limits),
        "source": files.source,
        "header": files.header,
        "test": files.test,
        "joints": str(len(e.joints)),
        "chain_joints": str(len(e.arm.joint_names)),
        "states": str(e.state.numel()),
        "state_size": str(max(1, e.state.numel())),
        "record": str(len(e.channels)),
        "commands": in_comment(", ".join(f"{name} ({_unit(e, name)})" for name in e.joints)),
        "conditions_define": f"#define {size} {len(conditions)}\n" if conditions else "",
        "conditions_field": f"  double conditions[{size}]; /* {listed} */\n" if conditions else "",
        "conditions_copy": f"  copy(record + 13, input->conditions, {size});\n" if conditions else "",
        "first_passes": str(functions.first_passes),
        "expressions": functions.source,
        "defaults": input_row(e, list(e.defaults)),
        "lower": c_row([low for low, _ in limits]),
        "upper": c_row([high for _, high in limits]),
        "names": "{" + ", ".join(quoted(name) for name in e.joints) + "}",
        "identity": request.digest,
    }


def _unit(e: ToolExpression, joint: str) -> str:
    return "rad" if e.arm.commanded[joint] == "angle" else "m"


def _about(request: ExportRequest, e: ToolExpression, limits: list[tuple[float, float]]) -> str:
    origin = request.origin
    known = [
        f"Calibrated {origin.created}" if origin.created else "",
        f"by armcal {origin.software['armcal']}" if "armcal" in origin.software else "",
    ]
    ends = [
        f"{name} {low:.6g} to {high:.6g} {_unit(e, name)}" if low > -math.inf else f"{name} none known"
        for name, (low, high) in zip(e.joints, limits, strict=True)
    ]
    springs = f"{e.state.numel()} elastic coordinates" if e.state.numel() else "rigid"
    effects = ", ".join(request.arm.effects) or "none"
    lines = [
        f"{' '.join(sentence for sentence in known if sentence)}." if any(known) else "",
        f"Identity {request.digest}.",
        f"Effects: {effects}; {springs}.",
        f"Limits: {'; '.join(ends)}.",
    ]
    return "\n".join(f"   {in_comment(line)}" for line in lines if line)
