"""What evaluates a recalibration: where all of it is the same, the same records give the same bits."""

from __future__ import annotations

import hashlib
import inspect
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from armcal.functions import compiler
from armcal.problem.problem import Problem
from armcal.version import SOURCES, __version__

_LIBRARIES = ("numpy", "scipy", "casadi", "filterpy", "cvxpy", "clarabel")
"""What adds numbers up, here or in the estimators that come with armcal."""
_THREADS = "OPENBLAS_NUM_THREADS"


def identity(problem: Problem, estimator: object) -> dict[str, Any]:
    """Of a problem's functions, the code and libraries beside them and the machine, as JSON.

    A kernel's key covers its expression, the generator, the compiler and its flags, and the processor.
    """
    return {
        "armcal": __version__,
        "sources": _sources(SOURCES, Path(inspect.getfile(type(estimator))).parent),
        "python": platform.python_version(),
        "libraries": {name: _version(name) for name in _LIBRARIES},
        "backend": problem.backend,
        "kernels": {kernel.factor.name: kernel.identity for kernel in problem.kernels},
        "flags": " ".join(compiler.FLAGS) if problem.backend == "compiled" else "",
        "processor": hashlib.sha256(compiler.processor().encode()).hexdigest()[:12],
        "threads": os.environ.get(_THREADS, "as many as there are"),
    }


def differences(one: object, other: object, name: str = "") -> tuple[str, ...]:
    """In what two identities differ, as texts: ``libraries.numpy 2.1.0 here, 1.26.4 there``."""
    if isinstance(one, dict) and isinstance(other, dict):
        keys = dict.fromkeys([*one, *other])
        return tuple(t for k in keys for t in differences(one.get(k), other.get(k), f"{name}.{k}" if name else str(k)))
    return () if one == other else (f"{name} {one or 'none'} here, {other or 'none'} there",)


def _sources(*folders: Path) -> str:
    """A hash of all code that may have a part in it: a change of any of it may change the last bits."""
    hashed = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            hashed.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return hashed.hexdigest()[:12]


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return ""
