"""The computer: serial ports, I2C buses, room on disk, processors, the cache of compiled kernels."""

import grp
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from armcal.doctor.child import Finding

LEAST_ROOM_BYTES = 200_000_000
"""Runs, journals and kernels need far less; a disk this full fills up while an arm is measured."""
_SERIAL_NAMES = ("ttyACM*", "ttyUSB*", "ttyAMA*", "serial0")
_I2C_NAMES = ("i2c-*",)


def compiler_path() -> str | None:
    """The C compiler that armcal would take."""
    from armcal.functions.compiler import find_compiler

    return find_compiler()


def cache() -> Finding:
    """Where compiled kernels are kept."""
    from armcal.functions.compiler import cache_directory

    place = cache_directory()
    there = next(p for p in (place, *place.parents) if p.exists())
    facts = {"path": str(place)}
    if not os.access(there, os.W_OK | os.X_OK) or not there.is_dir():
        text = f"{there} cannot be written: kernels are not compiled, and large data take longer"
        return Finding("compiler", "cache", "warning", text, "Name another place with ARMCAL_CACHE_DIR.", facts)
    if place.exists() and (place.stat().st_uid != os.getuid() or place.stat().st_mode & 0o022):
        text = f"{place} belongs to or can be written by others: what is in it is not loaded"
        return Finding("compiler", "cache", "warning", text, f"chmod 700 {place}, or set ARMCAL_CACHE_DIR.", facts)
    kept = len(list(place.glob("*.so"))) if place.exists() else 0
    return Finding("compiler", "cache", "ok", f"{place}, {kept} kernels", detail={**facts, "kernels": kept})


def serial_ports() -> Iterator[Finding]:
    """Ports that a servo board may hang on. None is opened: opening resets many boards."""
    try:
        from serial.tools import list_ports

        ports = {port.device: port for port in list_ports.comports()}
    except Exception:  # pyserial may be broken in any way; what the files tell is told all the same
        ports = {}
    serial = sorted({*ports, *_files(_SERIAL_NAMES)})
    if not serial:
        text = "none; servo boards are the only thing that needs one"
        yield Finding("bench", "serial ports", "note", text)
    for path in serial:
        number = getattr(ports.get(path), "serial_number", None)
        yield _device(path, "serial port", f"serial number {number}" if number else "")


def i2c_buses() -> Iterator[Finding]:
    """Buses that a servo board may hang on."""
    for path in sorted(_files(_I2C_NAMES)):
        yield _device(path, "I2C bus", "")


def _files(patterns: tuple[str, ...]) -> list[str]:
    return [str(path) for pattern in patterns for path in Path("/dev").glob(pattern)]


def _device(path: str, kind: str, known: str) -> Finding:
    facts = {"path": path, "kind": kind, "allowed": os.access(path, os.R_OK | os.W_OK)}
    about = f"{kind}, {known}" if known else kind
    if facts["allowed"]:
        return Finding("bench", path, "ok", f"{about}, may be opened (it was not)", detail=facts)
    try:
        group = grp.getgrgid(Path(path).stat().st_gid).gr_name
    except (OSError, KeyError):
        group = "root"
    join = f"sudo usermod -aG {group} $USER, then log in anew."
    hint = join if group != "root" else "Ask for the right to open it."
    return Finding("bench", path, "warning", f"{about}, may not be opened by you", hint, facts)


def rooms() -> Iterator[Finding]:
    """Room on disk here, and where temporary files go."""
    for name, place in (("room here", Path.cwd()), ("room for temporary files", Path(tempfile.gettempdir()))):
        free = shutil.disk_usage(place).free
        facts = {"path": str(place), "free_bytes": free, "writable": os.access(place, os.W_OK)}
        text = f"{free / 1e9:.1f} GB in {place}"
        if free < LEAST_ROOM_BYTES:
            hint = "Make room: runs and journals stop on a full disk."
            yield Finding("machine", name, "warning", text, hint, facts)
        elif not facts["writable"]:
            yield Finding("machine", name, "warning", f"{place} cannot be written", "Work in a folder of yours.", facts)
        else:
            yield Finding("machine", name, "ok", text, detail=facts)


def processors() -> Finding:
    """How many processes may work at once, and how many threads BLAS takes in each."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "")
    text = f"{usable} of {os.cpu_count()} may be used; BLAS takes {threads or 'as many threads as it likes'}"
    text += " thread in each process" if threads == "1" else ""
    facts = {"usable": usable, "count": os.cpu_count(), "blas_threads": threads or None}
    if threads not in ("", "1"):
        hint = "unset OPENBLAS_NUM_THREADS: armcal takes one, so that results are the same everywhere."
        return Finding("machine", "processors", "warning", text, hint, facts)
    return Finding("machine", "processors", "ok", text, detail=facts)
