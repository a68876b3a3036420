"""The test program of generated C: compiled, every warning an error, and run before the code is handed out."""

import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from armcal.calibration.tool_expression import ToolExpression
from armcal.errors import ProblemError
from armcal.functions.compiler import find_compiler
from armcal.io.plain_files import writing

from armcal_export.c_text import c_number, c_row, filled
from armcal_export.reference import Reference

FLAGS = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic")
_LIMIT_S = 300
_REPORT = "Nothing was written. Please report this with the calibration."


@dataclass(frozen=True)
class FileNames:
    """What the files are called."""

    source: str
    header: str
    test: str


def compiled_and_run(sources: Mapping[str, bytes], files: FileNames) -> list[str]:
    """What is to be remarked: nothing, or that no compiler is there.

    Raises:
        ProblemError: the compiler warns, or the program finds differences.
    """
    compiler = find_compiler()
    if compiler is None:
        return ["not compiled and not compared here: no C compiler was found (cc, gcc or clang)"]
    place = writing(Path("the temporary folder"), "Make room in it, or set TMPDIR to one with room.")
    with place, tempfile.TemporaryDirectory(prefix="armcal-c-") as directory:
        for name, content in sources.items():
            Path(directory, name).write_bytes(content)
        program = str(Path(directory, "test-program"))
        _run([compiler, *FLAGS, "-o", program, files.source, files.test, "-lm"], directory, "does not compile")
        _run([program], directory, "differs from the calibrated arm")
    return []


def _run(command: list[str], directory: str, failing: str) -> None:
    try:
        done = subprocess.run(
            command, cwd=directory, capture_output=True, text=True, errors="replace", timeout=_LIMIT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as fault:
        hint = "Set ARMCAL_CC=none to do without."
        raise ProblemError(f"the C code cannot be tested here: {fault}.", hint=hint) from fault
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()
        faults = [line for line in said if "error" in line] or said or [f"exit code {done.returncode}"]
        raise ProblemError(f"the C code {failing}: {' | '.join(faults[:4])[:500]}.", hint=_REPORT)


TOLERANCE = 1e-12
"""m, and entries of rotation matrices."""


def test_source(e: ToolExpression, reference: Reference, prefix: str, places: Mapping[str, str]) -> str:
    cases = zip(reference.records, reference.base_T_tool, reference.efforts, strict=True)
    rows = [
        f"  {{{input_row(e, list(record))},\n   {c_row(pose.ravel())},\n   {c_row(efforts)}}}"
        for record, pose, efforts in cases
    ]
    filling = {"cases": str(len(rows)), "case_rows": ",\n".join(rows), "tolerance": repr(TOLERANCE)}
    return filled("arm_test.c.in", prefix, **{**places, **filling})


def input_row(e: ToolExpression, record: list[float]) -> str:
    n, sizes = len(e.joints), (3, 1, 3, 3, 3)
    rows, start = [c_row(record[:n]), c_row(record[n : 2 * n])], 2 * n
    for size in sizes:
        part = record[start : start + size]
        rows.append(c_row(part) if size > 1 else c_number(part[0]))
        start += size
    if len(record) > start:
        rows.append(c_row(record[start:]))
    return "{" + ", ".join(rows) + "}"
