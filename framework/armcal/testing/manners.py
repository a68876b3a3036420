"""What a component must leave alone, whatever its kind: standard output, random numbers, the process, its module."""

from __future__ import annotations

import io
import os
import random
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from armcal import plugin_files
from armcal.testing.results import Recorder, expect

_DEEPEST = 4
_SHOWN_CHARACTERS = 60
_CONTAINERS = (list, tuple, set, frozenset)


@contextmanager
def watched(record: Recorder) -> Iterator[Callable[[Any], None]]:
    """Watch what runs inside, and record it at the end; call what is given with the component once it is imported."""
    heard, process, modules = io.StringIO(), _process(), dict[str, Any]()

    def begin(made: Any) -> None:
        modules.update(_of_modules(made))

    with redirect_stdout(heard):
        yield begin
    record.check("it prints nothing to standard output", _quiet, heard.getvalue())
    record.check("it leaves the process alone", lambda: _unchanged(process, _process(), "armcal's own process"))
    if modules:
        record.check("it keeps nothing in its modules", _unchanged_modules, modules)


def _quiet(heard: str) -> None:
    shown = " ".join(heard.split())[:_SHOWN_CHARACTERS]
    expect(
        not heard, f"found {shown!r} printed, expected nothing: results are armcal's to print; raise errors or return"
    )


def _process() -> dict[str, Any]:
    """What belongs to everybody in this process."""
    return {
        "numpy.random (use numpy.random.default_rng(seed))": _picture(np.random.get_state(), 0),
        "random (use numpy.random.default_rng(seed))": hash(random.getstate()),
        "numpy.seterr (use numpy.errstate)": repr(np.geterr()),
        "the working folder": str(Path.cwd()),
        "os.environ": dict(os.environ),
    }


@dataclass(frozen=True)
class _Place:
    """A variable of a module, or of a class in it, and a picture of its value."""

    owner: Any
    name: str
    picture: Any

    def again(self) -> _Place:
        """As it is now."""
        return _Place(self.owner, self.name, _picture(vars(self.owner).get(self.name), 0))


def _of_modules(made: Any) -> dict[str, _Place]:
    """Every variable of the modules of a component's package."""
    own = str(getattr(made, "__module__", ""))
    package = own.partition(".")[0]
    if own.startswith(f"{plugin_files.__name__}."):
        modules = [sys.modules[own]]
    elif package in ("", "builtins", "armcal"):
        return {}
    else:
        modules = [module for name, module in sorted(sys.modules.items()) if name.partition(".")[0] == package]
    return {f"{where}.{place.name}": place for module in modules for where, place in _places(module)}


def _places(module: ModuleType) -> Iterator[tuple[str, _Place]]:
    for owner in (module, *(v for v in vars(module).values() if isinstance(v, type))):
        is_own = owner is module or owner.__module__ == module.__name__
        for name in list(vars(owner)) if is_own else ():
            if not name.startswith("__"):
                where = (
                    module.__name__ if owner is module else f"{module.__name__}.{getattr(owner, '__qualname__', '')}"
                )
                yield where, _Place(owner, name, None).again()


def _unchanged_modules(places: Mapping[str, _Place]) -> None:
    _unchanged(places, {where: place.again() for where, place in places.items()}, "its modules")


def _unchanged(before: Mapping[str, Any], after: Mapping[str, Any], what: str) -> None:
    changed = [name for name, value in before.items() if after[name] != value]
    expect(not changed, f"found {', '.join(changed[:3])} changed, expected {what} as before the checks")


def _picture(value: Any, depth: int) -> Any:
    """Something that compares equal as long as a variable holds the same, deep inside too."""
    if value is None or isinstance(value, (str, bytes, int, float, complex)):
        return repr(value)
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes() if value.dtype != object else id(value)
    if depth < _DEEPEST and isinstance(value, Mapping):
        return tuple((_picture(k, depth + 1), _picture(v, depth + 1)) for k, v in list(value.items()))
    if depth < _DEEPEST and isinstance(value, _CONTAINERS):
        return type(value).__name__, tuple(_picture(item, depth + 1) for item in value)
    return repr(value) if isinstance(value, bytearray) else id(value)
