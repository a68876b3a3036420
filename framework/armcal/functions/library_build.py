"""Builds one library in a process of its own, from a folder with ``kernel.c`` and ``job.json``; needs Python alone.

The library is compiled, made durable, and only then put in place under a name that ends in its digest.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

_LIMIT_S = 120
_DIGEST = 32


def digest_of(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:_DIGEST]


def library_name(key: str, digest: str) -> str:
    return f"{key}-{digest}.so"


def build(folder: Path) -> None:
    """Compile, put in place.

    Raises:
        OSError, subprocess.SubprocessError: it cannot be compiled or written.
    """
    os.umask(0o077)
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    made = folder / "kernel.so"
    command = [*job["compile"], "-o", str(made), str(folder / "kernel.c"), "-lm"]
    subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=True, timeout=_LIMIT_S)
    content = made.read_bytes()
    _sync(made)
    place = Path(job["place"])
    made.replace(place / library_name(job["key"], digest_of(content)))
    _sync(place)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


if __name__ == "__main__":
    try:
        build(Path(sys.argv[1]))
    except (OSError, subprocess.SubprocessError):
        sys.exit(1)
    finally:
        shutil.rmtree(sys.argv[1], ignore_errors=True)
