"""Registration of one plugin: its contract, its hooks, and the components that it announces."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from typing import Any

import pluggy

from armcal import __version__, hooks
from armcal.errors import ArmcalError, PluginError
from armcal.hook_trace import HookTrace

_VERSION = re.compile(r"([0-9]+)\.([0-9]+)")


@dataclass(frozen=True)
class Announcement:
    """A component as its plugin announced it; ``deprecated`` says what to use instead, if it is to go."""

    kind: str
    name: str
    target: str
    summary: str
    deprecated: str


@dataclass(frozen=True)
class Registration:
    """What became of a plugin.

    Attributes:
        fault: why it is left out; empty if it is not.
        announced: its components.
        notices: what it uses of the contract that is to go, one sentence each.
    """

    fault: str = ""
    announced: tuple[Announcement, ...] = ()
    notices: tuple[str, ...] = ()


@dataclass(frozen=True)
class Specifications:
    """A contract: the module (or its like) with the hook specifications, its version, kinds and what is to go.

    Attributes:
        hooks: an object whose attributes are hook specifications.
        version: of the contract.
        kinds: of components, and the hook that registers each.
        deprecated_methods: by kind, methods that are to go, and what to write in their place.
    """

    hooks: Any = hooks
    version: str = hooks.CONTRACT_VERSION
    kinds: Mapping[str, str] = field(default_factory=lambda: hooks.KINDS)
    deprecated_methods: Mapping[str, Mapping[str, str]] = field(default_factory=lambda: hooks.DEPRECATED_METHODS)

    def manager(self) -> pluggy.PluginManager:
        """A plugin manager of this contract."""
        manager = pluggy.PluginManager(hooks.PROJECT)
        manager.add_hookspecs(self.hooks)
        return manager


def registered(
    manager: pluggy.PluginManager, point: EntryPoint, contract: Specifications, trace: HookTrace
) -> Registration:
    """Register one plugin; one that fails in any way is left out, and says why."""
    name = f"{point.name} ({point.value})"
    try:
        module = point.load()
        _require_contract(module, contract)
        alone = contract.manager()
        trace.watch(alone)
        notices = _taken(alone, module, name)
        alone.check_pending()
        _require_marks(module, contract)
        announced = _announced(alone, contract)
        _taken(manager, module, name)
    except (Exception, SystemExit) as fault:  # whatever a third party's module does, the others must work
        return Registration(said(fault))
    return Registration("", announced, notices)


def said(fault: BaseException) -> str:
    """A fault in one line."""
    text = str(fault) if isinstance(fault, ArmcalError) else f"{type(fault).__name__}: {fault}"
    return " ".join(text.split())


def _taken(manager: pluggy.PluginManager, module: Any, name: str) -> tuple[str, ...]:
    """Put a module into a manager; what it uses that is to go."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", DeprecationWarning)
        manager.register(module, name)
    return tuple(dict.fromkeys(" ".join(str(each.message).split()) for each in told))


def _require_contract(module: Any, contract: Specifications) -> None:
    """Refuse a plugin that says it was written for another contract than this one can serve."""
    asked = getattr(module, hooks.WRITTEN_FOR, None)
    if asked is None:
        return
    found = _VERSION.fullmatch(asked) if isinstance(asked, str) else None
    if found is None:
        raise PluginError(f"found {hooks.WRITTEN_FOR} = {asked!r}, expected text such as {contract.version!r}.")
    major, minor = (int(part) for part in found.groups())
    own_major, own_minor = (int(part) for part in contract.version.split("."))
    if (major, minor) == (own_major, own_minor) or (major == own_major and minor < own_minor):
        return
    here = f"armcal {__version__} has contract {contract.version}"
    if (major, minor) > (own_major, own_minor):
        hint = f"It needs an armcal of contract {major}, from {asked} on: update armcal."
    else:
        hint = f"It needs an armcal of contract {major}: update the plugin, or install an older armcal for it."
    raise PluginError(f"it is written for contract {asked}, and {here}.", hint=hint)


def _require_marks(module: Any, contract: Specifications) -> None:
    """Refuse a hook that would be passed over without a word."""
    for name in dir(contract.hooks):
        specified = getattr(contract.hooks, name)
        own = getattr(module, name, None) if name.startswith(f"{hooks.PROJECT}_") else None
        if callable(own) and own is not specified and not hasattr(own, f"{hooks.PROJECT}_impl"):
            raise ValueError(f"{name} is not marked: put @hookimpl before it")


def _announced(alone: pluggy.PluginManager, contract: Specifications) -> tuple[Announcement, ...]:
    announced: list[Announcement] = []
    for kind, hook in contract.kinds.items():

        def register(name: str, target: str, summary: str = "", deprecated: str = "", kind: str = kind) -> None:
            if not all(isinstance(text, str) for text in (name, target, summary, deprecated)):
                given = ", ".join(map(repr, (name, target, summary, deprecated)))
                raise TypeError(f"register() was given {given}; expected text")
            if ":" not in target:
                raise ValueError(f"the target of {name!r} is {target!r}; expected module:attribute")
            announced.append(Announcement(kind, name, target, summary, deprecated))

        getattr(alone.hook, hook)(register=register)
    return tuple(announced)
