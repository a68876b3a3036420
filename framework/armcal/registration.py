"""Registration of one plugin: its hooks, and the components that it announces."""

from __future__ import annotations

import difflib
import traceback
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import EntryPoint
from typing import Any, Self

import pluggy

from armcal import hooks
from armcal.errors import ArmcalError


@dataclass(frozen=True)
class Announcement:
    """A component as its plugin announced it."""

    kind: str
    name: str
    target: str
    summary: str


@dataclass(frozen=True)
class Registration:
    """What became of a plugin.

    Attributes:
        fault: why it is left out; empty if it is not.
        line: of its module, which the fault came through; None if it came through none.
        announced: its components.
        works: whether it has any hook.
    """

    fault: str = ""
    announced: tuple[Announcement, ...] = ()
    works: bool = False
    line: int | None = None


def new_manager() -> pluggy.PluginManager:
    manager = pluggy.PluginManager(hooks.PROJECT)
    manager.add_hookspecs(hooks)
    return manager


@dataclass(frozen=True)
class Loaded:
    """What an entry point names, equal to another if it is the very same object under the same name.

    Attributes:
        name: of the plugin, with what its entry point names.
        module: None where ``fault`` says why it does not load.
    """

    name: str
    identity: int
    fault: str
    module: Any = field(compare=False)

    @classmethod
    def of(cls, point: EntryPoint) -> Self:
        name = f"{point.name} ({point.value})"
        try:
            module = point.load()
        except (Exception, SystemExit) as fault:  # whatever a third party's module does, the others must work
            return cls(name, 0, said(fault), None)
        return cls(name, id(module), "", module)


@lru_cache(maxsize=8)  # a command, its experiment and its calibration each look for plugins
def registered(plugins: tuple[Loaded, ...]) -> tuple[pluggy.PluginManager, tuple[Registration, ...]]:
    manager, alone = new_manager(), new_manager()
    return manager, tuple(_registered(manager, alone, plugin) for plugin in plugins)


def _registered(manager: pluggy.PluginManager, alone: pluggy.PluginManager, plugin: Loaded) -> Registration:
    """One is asked ``alone``, in a manager that is empty before and afterwards."""
    if plugin.fault:
        return Registration(plugin.fault)
    try:
        _require_marks(plugin.module)
        alone.register(plugin.module, plugin.name)
        alone.check_pending()
        announced, works = _announced(alone), bool(alone.get_hookcallers(plugin.module))
        manager.register(plugin.module, plugin.name)
    except (Exception, SystemExit) as fault:  # whatever a third party's module does, the others must work
        file = getattr(plugin.module, "__file__", None)
        lines = [frame.lineno for frame in traceback.extract_tb(fault.__traceback__) if frame.filename == file]
        return Registration(said(fault), line=lines[-1] if lines else None)
    finally:
        if alone.has_plugin(plugin.name):
            alone.unregister(name=plugin.name)
    return Registration(announced=announced, works=works)


def said(fault: BaseException) -> str:
    text = str(fault) if isinstance(fault, ArmcalError) else f"{type(fault).__name__}: {fault}"
    return " ".join(text.split())


def _require_marks(module: Any) -> None:
    """Refuse a hook that would be passed over without a word, and one that there is none of."""
    for name, own in vars(module).items():
        if hasattr(own, f"{hooks.PROJECT}_impl") and not hasattr(hooks, name):
            known = [hook for hook in dir(hooks) if hook.startswith(f"{hooks.PROJECT}_")]
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]}" if near else "python -m pydoc armcal.hooks lists them"
            raise ValueError(f"unknown hook {name!r}: {hint}")
    for name in dir(hooks):
        specified = getattr(hooks, name)
        own = getattr(module, name, None) if name.startswith(f"{hooks.PROJECT}_") else None
        if callable(own) and own is not specified and not hasattr(own, f"{hooks.PROJECT}_impl"):
            raise ValueError(f"{name} is not marked: put @hookimpl before it")


def _announced(alone: pluggy.PluginManager) -> tuple[Announcement, ...]:
    announced: list[Announcement] = []
    for kind, hook in hooks.KINDS.items():

        def register(name: str, target: str | type, summary: str = "", kind: str = kind) -> None:
            if isinstance(target, type):
                target = f"{target.__module__}:{target.__qualname__}"
            if not all(isinstance(text, str) for text in (name, target, summary)):
                given = ", ".join(map(repr, (name, target, summary)))
                raise TypeError(f"register() was given {given}; expected text")
            if ":" not in target:
                raise ValueError(f"the target of {name!r} is {target!r}; expected module:attribute")
            announced.append(Announcement(kind, name, target, summary))

        getattr(alone.hook, hook)(register=register)
    return tuple(announced)
