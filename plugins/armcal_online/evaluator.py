"""What evaluates a recalibration: where all of it is the same, the same records give the same bits."""

import hashlib
import inspect
import os
import platform
from functools import lru_cache
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
    """Of a problem's functions, of the code and libraries beside them, and of the machine, as JSON.

    A kernel's key covers its expression, the generator, the compiler and its flags, and the processor.
    """
    sources = _sources(SOURCES, Path(__file__).parent, Path(inspect.getfile(type(estimator))).parent)
    return {
        "armcal": __version__,
        "sources": sources[:12],
        "python": platform.python_version(),
        "libraries": {name: _version(name) for name in _LIBRARIES},
        "backend": problem.backend,
        "kernels": {kernel.factor.name: kernel.identity for kernel in problem.kernels},
        "flags": " ".join(compiler.FLAGS) if problem.backend == "compiled" else "",
        "processor": hashlib.sha256(compiler.processor().encode()).hexdigest()[:12],
        "threads": os.environ.get(_THREADS, "as many as there are"),
    }


@lru_cache(maxsize=16)
def _sources(*folders: Path) -> str:
    """A digest of the code in these folders, any of which may change the last bits.

    Of hundreds of files, which are read once: a process goes on with the code that it began with.
    """
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*.py")):
            digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


@lru_cache(maxsize=16)
def _version(library: str) -> str:
    """Of an installed library; empty if it is not."""
    try:
        return version(library)
    except PackageNotFoundError:
        return ""


def differences(one: object, other: object, name: str = "") -> tuple[str, ...]:
    """In what two identities differ, as texts: ``libraries.numpy 2.1.0 here, 1.26.4 there``."""
    if isinstance(one, dict) and isinstance(other, dict):
        keys = dict.fromkeys([*one, *other])
        return tuple(t for k in keys for t in differences(one.get(k), other.get(k), f"{name}.{k}" if name else str(k)))
    return () if one == other else (f"{name} {one or 'none'} here, {other or 'none'} there",)
