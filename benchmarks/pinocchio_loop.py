"""pinocchio's forward kinematics and geometric Jacobian over many poses: in C++ if it compiles, else from Python."""

from __future__ import annotations

import ctypes
import hashlib
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from armcal.base.arrays import Array
from armcal.functions.compiler import cache_directory

SOURCE, ARM = (Path(__file__).with_name(name) for name in ("pinocchio_loop.cpp", "pinocchio_arm.hpp"))
FLAGS = [
    *("-std=c++17", "-O2", "-march=native", "-DNDEBUG", "-fPIC", "-shared", "-w"),
    *("-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"),
]
PYTHON_POSES = 5000


@dataclass(frozen=True)
class Loop:
    """A way to run pinocchio: its name, how many poses it is given at most, and the call.

    ``run(placements, angles)`` takes (joints + 1) x 4 x 4 and poses x joints; it gives the tips (poses x 3).
    """

    name: str
    most_poses: int
    run: Callable[[Array, Array], Array]
    note: str = ""


def find_loop() -> Loop | str:
    """The fastest way that this machine has, or why there is none and how to get it."""
    library = compiled(SOURCE)
    if isinstance(library, ctypes.CDLL):
        return Loop("pinocchio, C++ loop", sys.maxsize, _through(library))
    if find_spec("pinocchio") is None:
        return f"{library}; and no pinocchio for Python: pip install pin"
    return Loop("pinocchio, from Python", PYTHON_POSES, _from_python, f"not the C++ loop: {library}")


def compiled(source: Path) -> ctypes.CDLL | str:
    """A C++ source that needs pinocchio's headers, compiled and loaded; or why it is not."""
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        return "no C++ compiler: apt-get install g++"
    roots = [Path(entry) for entry in sys.path if entry]
    pinocchio = _first(
        [root / "cmeel.prefix" / "include" for root in roots] + [Path(sys.prefix) / "include"], "pinocchio"
    )
    if pinocchio is None:
        return "no headers of pinocchio: pip install pin"
    bundled = [root / "casadi" / "include" / "eigen3" for root in roots]
    eigen = _first([pinocchio / "eigen3", *bundled, Path("/usr/include/eigen3")], "Eigen")
    if eigen is None:
        return "no headers of Eigen: apt-get install libeigen3-dev"
    command = [compiler, *FLAGS, f"-I{pinocchio}", f"-I{eigen}", str(source)]
    text = "".join(path.read_text(encoding="utf-8") for path in (source, ARM))
    key = hashlib.sha256((" ".join(command) + text).encode()).hexdigest()[:20]
    target = cache_directory() / "benchmarks" / f"{key}.so"
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        building = target.with_suffix(".building")
        done = subprocess.run([*command, "-o", str(building)], capture_output=True, text=True, check=False)
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if "error" in line]
            return f"its headers do not compile here ({lines[0][:120] if lines else 'no reason given'})"
        building.replace(target)
    return ctypes.CDLL(str(target))


def _first(directories: list[Path], holding: str) -> Path | None:
    return next((directory for directory in directories if (directory / holding).is_dir()), None)


def _through(library: ctypes.CDLL) -> Callable[[Array, Array], Array]:
    library.kinematics.argtypes = [ctypes.c_int, ctypes.c_long, *[ctypes.c_void_p] * 3]
    buffers: dict[tuple[int, int], Array] = {}

    def run(placements: Array, angles: Array) -> Array:
        poses, joints = angles.shape
        # Kept from call to call, so that no time goes into fresh memory.
        out = buffers.setdefault((poses, joints), np.zeros((poses, 3 + 6 * joints)))
        flat = np.ascontiguousarray(
            np.concatenate([placements[:, :3, :3].reshape(-1, 9), placements[:, :3, 3]], axis=1)
        )
        library.kinematics(joints, poses, flat.ctypes.data, angles.ctypes.data, out.ctypes.data)
        return out[:, :3]

    return run


def _from_python(placements: Array, angles: Array) -> Array:
    import pinocchio as pin

    model = pin.Model()
    last = 0
    for i, at in enumerate(placements[:-1]):
        last = model.addJoint(last, pin.JointModelRZ(), pin.SE3(at[:3, :3], at[:3, 3]), f"q{i}")
    end = pin.SE3(placements[-1][:3, :3], placements[-1][:3, 3])
    tip = model.addFrame(pin.Frame("tip", last, 0, end, pin.FrameType.OP_FRAME))
    data = model.createData()
    tips = np.zeros((len(angles), 3))
    for i, q in enumerate(angles):
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacement(model, data, tip)
        pin.getFrameJacobian(model, data, tip, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        tips[i] = data.oMf[tip].translation
    return tips
