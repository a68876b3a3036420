"""Generated C, compiled by whatever compiler is there and cached on disk; never required.

A library's key covers the expression, the generator, the compiler, its flags and the processor, so that a
stale or foreign one is never loaded. Its name ends in a digest of its content, so that a torn one is not loaded
either. Who uses one compares its numbers with the interpreter's. ``ARMCAL_CACHE_DIR`` moves the cache;
``ARMCAL_CC=none`` turns compiling off, any other value names the compiler.
"""

import ctypes
import hashlib
import json
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np

from armcal.base.arrays import Array
from armcal.functions import library_build
from armcal.functions.c_source import UnsupportedExpressionError

FLAGS = ("-O1", "-march=native", "-ffp-contract=off", "-fPIC", "-shared", "-w")
ENTRY_POINTS = ("armcal_residuals", "armcal_linearise")
KEPT_LIBRARIES = 64
_COMPILE_LIMIT_S = 120
_BUILD = ".build-"


@cache
def find_compiler() -> str | None:
    """The C compiler's path, or None."""
    named = os.environ.get("ARMCAL_CC", "")
    if named == "none":
        return None
    for name in [named] if named else [os.environ.get("CC", ""), "cc", "gcc", "clang"]:
        text = shutil.which(name) if name else None
        if text:
            return text
    return None


def cache_directory() -> Path:
    text = os.environ.get("ARMCAL_CACHE_DIR")
    if text:
        return Path(text).absolute()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "armcal"


def library_key(text: str) -> str:
    parts = (text, " ".join(FLAGS), _compiler_identity(), processor())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:40]


def agree(expected: Array, given: Array, tolerance: float) -> bool:
    """Whether numbers differ by no more than a share of the largest, or of 1; exactly where one is not finite."""
    scale = max(1.0, float(np.nanmax(np.abs(expected), initial=0.0)))
    if not np.isfinite(scale):
        return np.array_equal(expected, given, equal_nan=True)
    return np.allclose(expected, given, rtol=0.0, atol=tolerance * scale, equal_nan=True)


def load_cached(key: str, entry_points: Sequence[str] = ENTRY_POINTS) -> ctypes.CDLL | None:
    """A compiled library from the cache, or None.

    Files that others could have written are not loaded; one that is not whole is removed.
    """
    directory = cache_directory()
    with suppress(OSError):
        for path in sorted(directory.glob(library_build.library_name(key, "*"))):
            if not (_is_ours(path) and _is_ours(directory)):
                continue
            if path.name != library_build.library_name(key, library_build.digest_of(path.read_bytes())):
                path.unlink()
                continue
            os.utime(path)
            library = ctypes.CDLL(str(path))
            if all(hasattr(library, name) for name in entry_points):
                return library
    return None


def _is_ours(path: Path) -> bool:
    seen = path.stat()
    return not hasattr(os, "getuid") or (
        seen.st_uid == os.getuid() and not seen.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    )


def compile_now(key: str, source: Callable[[], str], entry_points: Sequence[str] = ENTRY_POINTS) -> ctypes.CDLL | None:
    """Compile, cache and load; None when that fails."""
    command = _prepare(key, source)
    if command is None:
        return None
    with suppress(OSError, subprocess.SubprocessError):
        subprocess.run(command, check=True, capture_output=True, timeout=_COMPILE_LIMIT_S)
    return load_cached(key, entry_points)


def compile_in_background(key: str, source: Callable[[], str]) -> None:
    """Start compiling for the next run; this one goes on, and may end first without stopping the compiler."""
    command = _prepare(key, source)
    if command is None:
        return

    def wait() -> None:
        with suppress(OSError, subprocess.SubprocessError):
            silent = subprocess.DEVNULL
            subprocess.run(command, start_new_session=True, stdin=silent, stdout=silent, stderr=silent, check=False)

    threading.Thread(target=wait, name="armcal-compile", daemon=True).start()


def _prepare(key: str, source: Callable[[], str]) -> list[str] | None:
    """Write the source and give the command that compiles it and puts the result in place."""
    compiler = find_compiler()
    if compiler is None:
        return None
    directory = cache_directory()
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        _forget_old(directory)
        text, job = source(), {"compile": [compiler, *FLAGS], "place": str(directory), "key": key}
        build = Path(tempfile.mkdtemp(prefix=_BUILD, dir=directory))
        (build / "kernel.c").write_text(text, encoding="utf-8")
        (build / "job.json").write_text(json.dumps(job), encoding="utf-8")
    except (OSError, UnsupportedExpressionError):  # an expression without a C form is no fault: the interpreter serves
        return None
    # -I and -S: nothing but Python's own library is found, whatever lies in the working directory.
    return [sys.executable, "-I", "-S", library_build.__file__, str(build)]


def _forget_old(directory: Path) -> None:
    libraries = sorted(directory.glob("*.so"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in libraries[KEPT_LIBRARIES:]:
        with suppress(OSError):
            path.unlink()
    for build in directory.glob(f"{_BUILD}*"):
        with suppress(OSError):
            if time.time() - build.stat().st_mtime > 10 * _COMPILE_LIMIT_S:
                shutil.rmtree(build)


@cache
def _compiler_identity() -> str:
    compiler = find_compiler()
    if compiler is None:
        return ""
    real = Path(compiler).resolve()
    with suppress(OSError):
        seen = real.stat()
        return f"{real} {seen.st_size} {seen.st_mtime_ns}"
    return str(real)


@cache
def processor() -> str:
    """What ``-march=native`` depends on."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))}))
    return f"{platform.machine()} {platform.processor()} {platform.node()}"
