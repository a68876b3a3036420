"""The checks that load libraries, each called in a process of its own by ``armcal.doctor.child``.

Each gives facts for JSON, and raises where what it tries does not work.
"""

import math
import os
import subprocess
import tempfile
import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

TRUE_LENGTHS_M = (0.310, 0.243)
_NOMINAL_LENGTHS_M = (0.300, 0.250)
_NOISE_M = 1e-4
_NEAR_M = 5e-4
_POSES = 16
_KERNEL_RECORDS, _KERNEL_TIMES = 2000, 3
_CONFIG = """
name: what armcal doctor calibrates
arms:
  arm:
    model:
      type: mdh
      convention: standard
      rows: [{{a_m: {0}}}, {{a_m: {1}}}]
measurements: {{tracker: {{type: tip_position, noise_mm: 0.1}}}}
statics: {{gravity_m_s2: [0, 0, -9.81]}}
data: {{type: csv, path: poses.csv}}
parameters: {{free: ["arm.mdh.a[12]"]}}
"""


def imported(module: str) -> dict[str, Any]:
    """Import one library; the seconds it takes."""
    began = time.perf_counter()
    import_module(module)
    return {"import_s": round(time.perf_counter() - began, 3)}


def components() -> dict[str, Any]:
    """Every plugin, with what its registration lacks; and every component imported, with what that lacks."""
    from armcal.errors import PluginError
    from armcal.extras import extra_of
    from armcal.plugins import discover

    registry = discover()
    lines = []
    for plugin in registry.plugins:
        own = registry.announced_by(plugin)
        broken = []
        for component in own:
            try:
                component.load()
            except PluginError as fault:
                cause = fault.__cause__ or fault
                text = " ".join(f"{type(cause).__name__}: {cause}".split())[:200]
                absent = isinstance(cause, ModuleNotFoundError) and extra_of(cause.name or "")
                extra = {"extra": absent} if absent else {}
                broken.append({"kind": component.kind, "name": component.name, "fault": text, **extra})
        origin = f"{plugin.distribution} {plugin.version}".strip()
        facts = {"name": plugin.name, "module": plugin.module, "distribution": origin, "fault": plugin.fault or None}
        lines.append({**facts, "components": len(own), "broken": broken})
    return {"plugins": lines}


def ipopt() -> dict[str, Any]:
    """Minimise (x - 1)^2 + (y - x^2)^2, which is zero at (1, 1), with x at most 2."""
    import casadi as ca

    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    options: Any = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
    solver = ca.nlpsol("doctor", "ipopt", {"x": ca.vertcat(x, y), "f": (x - 1) ** 2 + (y - x**2) ** 2}, options)
    solution = [float(v) for v in solver(x0=[0.0, 0.0], lbx=[-2, -2], ubx=[2, 2])["x"].full().ravel()]
    if not solver.stats()["success"] or max(abs(v - 1.0) for v in solution) > 1e-6:
        raise ArithmeticError(f"IPOPT found {solution} ({solver.stats()['return_status']}), expected [1, 1]")
    return {"version": str(ca.CasadiMeta.version())}


def convex() -> dict[str, Any]:
    """A cone problem by the solver that armcal asks for, and a linear one by each other that cvxpy sees.

    Gives each solver's fault, empty where it solves.
    """
    import cvxpy as cp

    def least_sum(name: str) -> str:
        x = cp.Variable(2)
        problem = cp.Problem(cp.Minimize(cp.sum(x)), [x >= [1.0, 2.0]])
        problem.solve(solver=name)
        right = problem.value is not None and abs(float(problem.value) - 3.0) < 1e-3
        return "" if right else f"it found {problem.value}, expected 3"

    states: dict[str, str] = {}
    for name in dict.fromkeys(["CLARABEL", *sorted(cp.installed_solvers())]):
        try:
            states[name] = _nearest_semidefinite() if name == "CLARABEL" else least_sum(name)
        except Exception as fault:  # each solver has its own way of failing
            states[name] = " ".join(f"{type(fault).__name__}: {fault}".split())[:160]
    return {"solvers": states}


def _nearest_semidefinite() -> str:
    """The positive semidefinite matrix nearest to diag(1, -1) is diag(1, 0)."""
    import cvxpy as cp
    import numpy as np

    x = cp.Variable((2, 2), PSD=True)
    cp.Problem(cp.Minimize(cp.sum_squares(x - np.diag([1.0, -1.0])))).solve(solver=cp.CLARABEL)
    off = float(np.abs(np.asarray(x.value) - np.diag([1.0, 0.0])).max())
    return "" if off < 1e-4 else f"it is off by {off:.2g}"


def kalman() -> dict[str, Any]:
    """One update of one state: prior 0 with variance 1, measured 1 with variance 1; half is believed."""
    import numpy as np
    from filterpy.kalman import ExtendedKalmanFilter

    filtered = ExtendedKalmanFilter(dim_x=1, dim_z=1)
    filtered.update(np.ones((1, 1)), lambda x: np.ones((1, 1)), lambda x: x)
    mean = float(filtered.x[0, 0])
    if not abs(mean - 0.5) < 1e-12:
        raise ArithmeticError(f"filterpy found {mean}, expected 0.5")
    return {}


def calibration() -> dict[str, Any]:
    """Calibrate a simulated arm of two links as ``armcal run`` does, and compare with its truth.

    The measured positions come from the cosine rule written here, not from armcal's kinematics.
    """
    from armcal.calibration.calibration import Calibration
    from armcal.plugins import discover
    from armcal.report import render
    from armcal.run import outputs
    from armcal.run.experiment import Experiment
    from armcal.run.pipeline import calibrate

    with tempfile.TemporaryDirectory(prefix="armcal-doctor-") as text:
        place = Path(text)
        (place / "arm.yaml").write_text(_CONFIG.format(*_NOMINAL_LENGTHS_M), encoding="utf-8")
        # A planar arm of two links, with a scatter that comes out the same each time.
        lines = ["pose_id,q1_rad,q2_rad,x_m,y_m,z_m"]
        one, two = TRUE_LENGTHS_M
        for n in range(_POSES):
            q1, q2 = 2.0 * math.sin(1.7 * n), 1.5 * math.cos(2.3 * n)
            x = one * math.cos(q1) + two * math.cos(q1 + q2) + _NOISE_M * math.sin(12.9 * n)
            y = one * math.sin(q1) + two * math.sin(q1 + q2) + _NOISE_M * math.sin(78.2 * n + 1)
            lines.append(f"{n},{q1:.9f},{q2:.9f},{x:.9f},{y:.9f},{_NOISE_M * math.sin(37.7 * n + 2):.9f}")
        (place / "poses.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        experiment = Experiment.load(place / "arm.yaml", (), None, discover())
        result = calibrate(experiment, "armcal doctor")
        outputs.write(result, experiment, place / "run", render)
        record = Calibration.load(place / "run" / "calibration.yaml").record
        values = [p.value for p in record.parameters if p.free]
    off = max(abs(a - b) for a, b in zip(values, TRUE_LENGTHS_M, strict=True))
    if not result.estimate.verdict.converged or not off < _NEAR_M:
        raise ArithmeticError(f"the lengths found are off by {off * 1000:.3g} mm")
    return {"off_mm": round(off * 1000, 4)}


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

    from armcal.arm.assembly import Arm
    from armcal.arm.statics import MassSpec
    from armcal.problem.problem import Problem
    from armcal.testing import planar

    masses = (MassSpec("tip", 0.2, (0.0, 0.01, 0.0), "tool"),)
    arms = {planar.ARM: Arm(planar.ARM, "model", planar.PlanarArm(), {"spring": planar.Springs(2)}, masses)}
    parameters = planar.all_parameters(arms)
    parameters = parameters.with_free(parameters.names)
    channels = planar.commands(arms, _KERNEL_RECORDS, np.random.default_rng(0))
    channels |= {f"{planar.TRACKER}.{axis}": np.zeros(_KERNEL_RECORDS) for axis in "xyz"}
    records = planar.dataset(channels)
    began = time.perf_counter()
    problem = Problem.build(arms, {planar.TRACKER: planar.Tip()}, parameters, planar.GRAVITY, records, choice)
    made, building_s, times = problem.records(records), time.perf_counter() - began, []
    for _ in range(_KERNEL_TIMES):
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
