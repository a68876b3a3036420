"""What a component must leave alone, whatever its kind: standard output, random numbers, the process, its module."""

import io
import os
import random
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from armcal import plugins
from armcal.testing.results import Recorder, expect

_DEEPEST = 4
_SHOWN_CHARACTERS = 60
_CONTAINERS = (list, tuple, set, frozenset)

_Place = tuple[Any, str, Any]
"""A module or a class, the name of a variable of it, and a picture of its value."""


@contextmanager
def watched(record: Recorder) -> Iterator[Callable[[Any], None]]:
    """Watch what runs inside, and record it at the end; call what is given with the component once it is imported."""
    heard, process, places = io.StringIO(), _process(), dict[str, _Place]()

    def begin(made: Any) -> None:
        places.update(_places(made))

    with redirect_stdout(heard):
        yield begin
    with record.check("it prints nothing to standard output"):
        shown = " ".join(heard.getvalue().split())[:_SHOWN_CHARACTERS]
        rule = "results are armcal's to print; raise errors or return"
        expect(not heard.getvalue(), f"found {shown!r} printed, expected nothing: {rule}")
    with record.check("it leaves the process alone"):
        _expect_same(process, _process(), "armcal's own process")
    if places:
        with record.check("it keeps nothing in its modules"):
            now = {where: (owner, name, _now(owner, name)) for where, (owner, name, _) in places.items()}
            _expect_same(places, now, "its modules")


def _process() -> dict[str, Any]:
    return {
        "numpy.random (use numpy.random.default_rng(seed))": _picture(np.random.get_state(), 0),
        "random (use numpy.random.default_rng(seed))": hash(random.getstate()),
        "numpy.seterr (use numpy.errstate)": repr(np.geterr()),
        "the working folder": str(Path.cwd()),
        "os.environ": dict(os.environ),
    }


def _places(made: Any) -> Iterator[tuple[str, _Place]]:
    """Every variable of the modules of a component's package, and of the classes in them."""
    own = str(getattr(made, "__module__", ""))
    package = own.partition(".")[0]
    if own.startswith(f"{plugins.__name__}."):
        modules = [sys.modules[own]]
    elif package in ("", "builtins", "armcal"):
        modules = []
    else:
        modules = [module for name, module in sorted(sys.modules.items()) if name.partition(".")[0] == package]
    for module in modules:
        classes = [v for v in vars(module).values() if isinstance(v, type) and v.__module__ == module.__name__]
        for owner in (module, *classes):
            where = module.__name__ if owner is module else f"{module.__name__}.{getattr(owner, '__qualname__', '')}"
            for name in list(vars(owner)):
                if not name.startswith("__"):
                    yield f"{where}.{name}", (owner, name, _now(owner, name))


def _now(owner: Any, name: str) -> Any:
    return _picture(vars(owner).get(name), 0)


def _expect_same(before: Mapping[str, Any], after: Mapping[str, Any], what: str) -> None:
    changed = [name for name, value in before.items() if after[name] != value]
    expect(not changed, f"found {', '.join(changed[:3])} changed, expected {what} as before the checks")


def _picture(value: Any, depth: int) -> Any:
    if value is None or isinstance(value, (str, bytes, int, float, complex)):
        return repr(value)
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes() if value.dtype != object else id(value)
    if depth < _DEEPEST and isinstance(value, Mapping):
        return tuple((_picture(k, depth + 1), _picture(v, depth + 1)) for k, v in list(value.items()))
    if depth < _DEEPEST and isinstance(value, _CONTAINERS):
        return type(value).__name__, tuple(_picture(item, depth + 1) for item in value)
    return repr(value) if isinstance(value, bytearray) else id(value)
