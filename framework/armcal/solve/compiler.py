"""Generated C, compiled by whatever compiler is there and cached on disk; never required.

A library's key covers the expression, the generator, the compiler, its flags and the processor, so that a
stale or foreign one is never loaded. ``ARMCAL_CACHE_DIR`` moves the cache; ``ARMCAL_CC=none`` turns
compiling off, any other value names the compiler.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import stat
import subprocess
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

FLAGS = ("-O1", "-march=native", "-ffp-contract=off", "-fPIC", "-shared", "-w")
ENTRY_POINTS = ("armcal_residuals", "armcal_linearise")
KEPT_LIBRARIES = 64
_COMPILE_LIMIT_S = 120


@cache
def find_compiler() -> str | None:
    """The C compiler's path, or None."""
    asked = os.environ.get("ARMCAL_CC", "")
    if asked == "none":
        return None
    for name in [asked] if asked else [os.environ.get("CC", ""), "cc", "gcc", "clang"]:
        found = shutil.which(name) if name else None
        if found:
            return found
    return None


def cache_directory() -> Path:
    """Where compiled kernels are kept."""
    asked = os.environ.get("ARMCAL_CACHE_DIR")
    if asked:
        return Path(asked).absolute()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "armcal"


def library_key(text: str) -> str:
    """A key for an expression's serialised text on this machine with this compiler."""
    parts = (text, " ".join(FLAGS), _compiler_identity(), processor())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:40]


def load_cached(key: str, entry_points: Sequence[str] = ENTRY_POINTS) -> ctypes.CDLL | None:
    """A compiled library from the cache, or None. Files that others could have written are not loaded."""
    path = cache_directory() / f"{key}.so"
    try:
        for place in (path, path.parent):
            seen = place.stat()
            if hasattr(os, "getuid") and (seen.st_uid != os.getuid() or seen.st_mode & (stat.S_IWGRP | stat.S_IWOTH)):
                return None
        os.utime(path)
        library = ctypes.CDLL(str(path))
    except OSError:
        return None
    return library if all(hasattr(library, name) for name in entry_points) else None


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
    """Write the source and give the command that compiles it and renames the result into place."""
    compiler = find_compiler()
    if compiler is None:
        return None
    directory = cache_directory()
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        _forget_old(directory)
        text = source()
        build = Path(tempfile.mkdtemp(prefix=".build-", dir=directory))
        (build / "kernel.c").write_text(text, encoding="utf-8")
    except OSError:
        return None
    compile_it = shlex.join([compiler, *FLAGS, "-o", str(build / "kernel.so"), str(build / "kernel.c"), "-lm"])
    into_place = shlex.join(["mv", "-f", str(build / "kernel.so"), str(directory / f"{key}.so")])
    remove = shlex.join(["rm", "-rf", str(build)])
    private = "umask 077"
    return ["/bin/sh", "-c", f"{private}; {compile_it} && {into_place}; done=$?; {remove}; exit $done"]


def _forget_old(directory: Path) -> None:
    """Keep the libraries that were used last."""
    libraries = sorted(directory.glob("*.so"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in libraries[KEPT_LIBRARIES:]:
        with suppress(OSError):
            path.unlink()


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
