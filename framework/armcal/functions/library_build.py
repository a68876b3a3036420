"""Builds one library in a process of its own, from a folder with ``kernel.c`` and ``job.json``; needs Python alone.

The library is compiled, called in a process that may crash, made durable, and only then put in place under a name
that ends in its digest. What crashes, or gives other numbers than those expected, never gets there.
"""

import ctypes
import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_LIMIT_S = 120
_DIGEST = 32


def digest_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:_DIGEST]


def library_name(key: str, digest: str) -> str:
    return f"{key}-{digest}.so"


def build(folder: Path) -> None:
    """Compile, try, put in place.

    Raises:
        OSError, subprocess.SubprocessError: it cannot be compiled or written, or does not pass.
    """
    os.umask(0o077)
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    made = folder / "kernel.so"
    quiet: dict[str, Any] = {"stdin": subprocess.DEVNULL, "capture_output": True, "check": True, "timeout": _LIMIT_S}
    subprocess.run([*job["compile"], "-o", str(made), str(folder / "kernel.c"), "-lm"], **quiet)
    if job["trial"] is not None:
        subprocess.run([*job["python"], __file__, "try", str(folder)], **quiet)
    content = made.read_bytes()
    _sync(made)
    place = Path(job["place"])
    made.replace(place / library_name(job["key"], digest_of(content)))
    _sync(place)


def passes(folder: Path) -> bool:
    trial = json.loads((folder / "job.json").read_text(encoding="utf-8"))["trial"]
    entry = getattr(ctypes.CDLL(str(folder / "kernel.so")), trial["entry"])
    arguments = [_argument(argument) for argument in trial["arguments"]]
    entry(*arguments)
    return all(_agree(arguments[int(at)], numbers, trial) for at, numbers in trial["expected"].items())


def _argument(given: int | float | list[float]) -> Any:
    if isinstance(given, list):
        return (ctypes.c_double * max(1, len(given)))(*given)
    return ctypes.c_double(given) if isinstance(given, float) else ctypes.c_long(given)


def _agree(result: Any, expected: list[float], trial: Mapping[str, Any]) -> bool:
    """Within a share of the largest number, or exactly where one is not finite."""
    finite = all(math.isfinite(x) or math.isnan(x) for x in expected)
    scale = max([1.0, *(abs(x) for x in expected if not math.isnan(x))])
    limit = trial["tolerance"] * scale if finite else 0.0
    pairs = zip(result, expected, strict=False)
    return all(a == b or (math.isnan(a) and math.isnan(b)) or abs(a - b) <= limit for a, b in pairs)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def main(what: str, folder: str) -> int:
    """``build`` or ``try``; the exit code says whether that went well."""
    if what == "try":
        return 0 if passes(Path(folder)) else 1
    try:
        build(Path(folder))
    except (OSError, subprocess.SubprocessError):
        return 1
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
