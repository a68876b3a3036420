"""Whether the C compiler makes a kernel with the interpreter's numbers, and how much faster it is."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_RECORDS = 2000
_TIMES = 3


def kernel() -> dict[str, Any]:
    """A small elastic arm, compiled to a place of its own and compared with the interpreter; both timed.

    Raises:
        ArithmeticError: the compiled numbers differ.
        RuntimeError: the compiler fails; its first line.
    """
    with tempfile.TemporaryDirectory(prefix="armcal-doctor-") as place:
        Path(place).chmod(0o700)
        os.environ["ARMCAL_CACHE_DIR"] = place
        interpreted, compiled = _evaluated("interpreted"), _evaluated("compiled")
    if compiled.backend != "compiled":
        _explain()
    ratio = interpreted.seconds / max(compiled.seconds, 1e-9)
    return {"times_faster": round(ratio, 1), "compile_s": round(compiled.building_s - interpreted.building_s, 2)}


@dataclass(frozen=True)
class _Evaluated:
    backend: str
    building_s: float
    seconds: float


def _evaluated(choice: Any) -> _Evaluated:
    """All records linearised by one backend; the shortest of a few times."""
    import numpy as np

    from armcal.arm.assembly import Arm, MassSpec
    from armcal.problem.problem import Problem
    from armcal.testing import planar

    masses = (MassSpec("tip", 0.2, (0.0, 0.01, 0.0), "tool"),)
    arms = {planar.ARM: Arm(planar.ARM, "model", planar.PlanarArm(), {"spring": planar.Springs(2)}, masses)}
    parameters = planar.all_parameters(arms)
    parameters = parameters.with_free(parameters.names)
    channels = planar.commands(arms, _RECORDS, np.random.default_rng(0))
    channels |= {f"{planar.TRACKER}.{axis}": np.zeros(_RECORDS) for axis in "xyz"}
    records = planar.dataset(channels)
    began = time.perf_counter()
    problem = Problem.build(arms, {planar.TRACKER: planar.Tip()}, parameters, planar.GRAVITY, records, choice)
    made, building_s, times = problem.records(records), time.perf_counter() - began, []
    for _ in range(_TIMES):
        began = time.perf_counter()
        problem.normal_equations(parameters.nominal(), made)
        times.append(time.perf_counter() - began)
    return _Evaluated(problem.backend, building_s, min(times))


def _explain() -> None:
    """Compile a file of one line to hear what the compiler says."""
    from armcal.functions import compiler

    with tempfile.TemporaryDirectory(prefix="armcal-doctor-") as place:
        (Path(place) / "one.c").write_text("int armcal_doctor(void) { return 0; }\n", encoding="utf-8")
        command = [str(compiler.find_compiler()), *compiler.FLAGS, "-o", f"{place}/one.so", f"{place}/one.c", "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=60, check=False)
    said = next((line.strip() for line in done.stderr.splitlines() if line.strip()), "")
    if done.returncode:
        raise RuntimeError(f"the compiler ended with {done.returncode}: {said[:160]}")
    raise ArithmeticError("the compiled kernel does not build, or gives other numbers than the interpreter")
