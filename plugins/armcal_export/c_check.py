"""Generated C compiled with every warning an error, and its test program run, before it is handed out."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from armcal.errors import ProblemError
from armcal.functions.compiler import find_compiler

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
    with tempfile.TemporaryDirectory(prefix="armcal-c-") as directory:
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
