"""Generated C, compiled by whatever compiler is there and cached on disk; never required.

A library's key covers the expression, the generator, the compiler, its flags and the processor, so that a
stale or foreign one is never loaded. Its name ends in a digest of its content, so that a torn one is not loaded
either. Who uses one compares its numbers with the interpreter's. ``ARMCAL_CACHE_DIR`` moves the cache;
``ARMCAL_CC=none`` turns compiling off, any other value names the compiler.

Run as a script, this file builds a library from a folder with ``kernel.c`` and ``job.json``: it needs Python alone.
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

FLAGS = ("-O1", "-march=native", "-ffp-contract=off", "-fPIC", "-shared", "-w")
ENTRY_POINTS = ("armcal_residuals", "armcal_linearise")
KEPT_LIBRARIES = 64
_COMPILE_LIMIT_S = 120
_BUILD = ".build-"
_DIGEST = 32


class UnsupportedExpressionError(Exception):
    """An expression has an operation that has no C form here; the interpreter serves."""


@cache
def find_compiler() -> str | None:
    """The C compiler's path, or None."""
    named = os.environ.get("ARMCAL_CC", "")
    if named == "none":
        return None
    names = [named] if named else [os.environ.get("CC", ""), "cc", "gcc", "clang"]
    return next((path for name in names if name and (path := shutil.which(name))), None)


def cache_directory() -> Path:
    text = os.environ.get("ARMCAL_CACHE_DIR")
    if text:
        return Path(text).absolute()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "armcal"


def library_key(text: str) -> str:
    parts = (text, " ".join(FLAGS), _compiler_identity(), _processor())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:40]


def load_cached(key: str, entry_points: Sequence[str] = ENTRY_POINTS) -> ctypes.CDLL | None:
    """A compiled library from the cache, or None.

    Files that others could have written are not loaded; one that is not whole is removed.
    """
    directory = cache_directory()
    with suppress(OSError):
        for path in sorted(directory.glob(f"{key}-*.so")):
            if not (_is_ours(path) and _is_ours(directory)):
                continue
            if path.name != _library_name(key, path.read_bytes()):
                path.unlink()
                continue
            os.utime(path)
            library = ctypes.CDLL(str(path))
            if all(hasattr(library, name) for name in entry_points):
                return library
    return None


def _library_name(key: str, content: bytes) -> str:
    return f"{key}-{hashlib.sha256(content).hexdigest()[:_DIGEST]}.so"


def _is_ours(path: Path) -> bool:
    seen = path.stat()
    return seen.st_uid == os.getuid() and not seen.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


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
    except (OSError, UnsupportedExpressionError):
        return None
    # -I and -S: nothing but Python's own library is found, whatever lies in the working directory.
    return [sys.executable, "-I", "-S", __file__, str(build)]


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
    real = Path(find_compiler() or "").resolve()
    with suppress(OSError):
        seen = real.stat()
        return f"{real} {seen.st_size} {seen.st_mtime_ns}"
    return str(real)


@cache
def _processor() -> str:
    """What ``-march=native`` depends on."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))}))
    return f"{platform.machine()} {platform.processor()} {platform.node()}"


def _build(folder: Path) -> None:
    """Compile, make durable, and only then put in place under a name that ends in the digest."""
    os.umask(0o077)
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    made, place = folder / "kernel.so", Path(job["place"])
    command = [*job["compile"], "-o", str(made), str(folder / "kernel.c"), "-lm"]
    subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=True, timeout=_COMPILE_LIMIT_S)
    name = _library_name(job["key"], made.read_bytes())
    _sync(made)
    made.replace(place / name)
    _sync(place)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


if __name__ == "__main__":
    try:
        _build(Path(sys.argv[1]))
    except (OSError, subprocess.SubprocessError):
        sys.exit(1)
    finally:
        shutil.rmtree(sys.argv[1], ignore_errors=True)
