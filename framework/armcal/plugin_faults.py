"""Faults in a plugin's code: which file, line and method they come from."""

from __future__ import annotations

import inspect
import re
import sys
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any, NoReturn, ParamSpec, TypeVar

from armcal.errors import ArmcalError, Location, PluginError
from armcal.plugins import PluginInfo, discover
from armcal.registration import said

P = ParamSpec("P")
R = TypeVar("R")

_OWN = "armcal"
_HAS_NO_VALUE = "truth value"
"""What CasADi says where Python asks of an expression whether it is true."""

_CALLED = re.compile(r"([\w.<>]+)\(\) (?:takes|missing|got) ")
"""What Python says of a call whose arguments do not match."""


def plugin_fault(fault: BaseException) -> PluginError | None:
    """What a plugin's code raised, with its file, line and method; None where armcal's own code did.

    The innermost line of a plugin that the exception came through is named; the place where it was raised too, if that
    is code of armcal's.
    """
    plugins = {_package(plugin): plugin for plugin in discover().plugins if plugin.distribution != _OWN}
    frames = list(traceback.walk_tb(fault.__traceback__))
    modules = [str(frame.f_globals.get("__name__", "")) for frame, _ in frames]
    owners = [[p for name, p in plugins.items() if f"{module}.".startswith(f"{name}.")] for module in modules]
    places = [place for place, own in enumerate(owners) if own]
    if not places:
        return _wrong_arguments(fault, tuple(plugins))
    if isinstance(fault, SystemExit) and modules[places[0] - 1].startswith("click."):
        return None  # a plugin's command may end as it likes
    (frame, line), (plugin, *_), text = frames[places[-1]], owners[places[-1]], said(fault).rstrip(".")
    if modules[-1].partition(".")[0] == _OWN and places[-1] < len(frames) - 1 and not isinstance(fault, KeyError):
        text += f" (at line {frames[-1][1]} of {modules[-1]})"
    advice = "Choose by casadi.if_else, on recorded values alone. " if _HAS_NO_VALUE in text else ""
    named = f" --plugin {plugin.distribution}" if plugin.is_file else ""
    return PluginError(
        f"{frame.f_code.co_qualname} raised {text}.",
        where=Location(frame.f_code.co_filename, line=line),
        hint=f"{advice}To check it by itself: armcal plugins check {plugin.name}{named}.",
    )


def _wrong_arguments(fault: BaseException, packages: tuple[str, ...]) -> PluginError | None:
    """A method with other arguments than the contract's: Python raises where it is called, not in the plugin."""
    if not isinstance(fault, TypeError) or not (called := _CALLED.match(str(fault))):
        return None
    root = called[1].partition(".")[0]
    for name, module in list(sys.modules.items()):
        if any(f"{name}.".startswith(f"{own}.") for own in packages) and hasattr(module, root):
            hint = "Take the arguments that the contract names: docs/hooks.md."
            return PluginError(f"{fault}.", where=Location(module.__file__), hint=hint)
    return None


def blaming(work: Callable[P, R]) -> Callable[P, R]:
    """``work`` in which a fault of a plugin's code is placed: a traceback does not reach another process, for one."""
    return partial(_blamed, work)


def _blamed(work: Callable[P, R], *given: P.args, **named: P.kwargs) -> R:
    try:
        return work(*given, **named)
    except ArmcalError:
        raise
    except (Exception, SystemExit) as fault:
        if (placed := plugin_fault(fault)) is not None:
            raise placed from fault
        raise


def refuse(method: Callable[..., Any] | property, returned: Any, expected: str) -> NoReturn:
    """Refuse what a method of a component (or a property, or the class that sets an attribute) returned.

    A text describes it, of anything else the type is named.

    Raises:
        PluginError: with the method, its file and line, what it returned and what was expected.
    """
    getter: Any = getattr(method, "fget", method)  # of a property
    function = inspect.unwrap(getattr(getter, "__func__", getter))
    code = getattr(function, "__code__", None)
    where = Location(code.co_filename, line=code.co_firstlineno) if code else None
    if isinstance(function, type) and (file := getattr(sys.modules.get(function.__module__), "__file__", None)):
        where = Location(file)
    name = getattr(function, "__qualname__", type(method).__qualname__)
    if not isinstance(returned, str):
        returned = "None" if returned is None else f"an object of type {type(returned).__name__}"
    text = f"{name} returned {' '.join(returned.split())}, expected {expected}."
    raise PluginError(text, where=where, hint="Correct that method.")


def _package(plugin: PluginInfo) -> str:
    return plugin.module if plugin.is_file else plugin.module.partition(".")[0]
