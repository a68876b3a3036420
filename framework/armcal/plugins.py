"""The plugin manager: finds entry points, registers components by name, builds them when asked for."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import pluggy

from armcal import hooks
from armcal.errors import PluginError

GROUP = "armcal"


@dataclass(frozen=True)
class Component:
    """Something a configuration can name.

    ``target`` is ``module:attribute``; ``plugin`` the entry point that registered it, and ``module`` what that names.
    """

    kind: str
    name: str
    target: str
    summary: str
    plugin: str
    module: str = ""

    def load(self) -> Any:
        """The component's class.

        Raises:
            PluginError: its module does not import, or lacks the attribute.
        """
        module, _, attribute = self.target.partition(":")
        try:
            return getattr(import_module(module), attribute)
        except (Exception, SystemExit) as fault:  # a plugin may fail in any way; the user is told which and how
            raise PluginError(
                f"the {self.kind} {self.name!r} of the plugin {self.plugin!r} does not load: {_said(fault)}.",
                hint="Repair or update that plugin.",
            ) from fault


@dataclass(frozen=True)
class PluginInfo:
    """One entry point: its distribution, and what was wrong with it (empty if nothing)."""

    name: str
    module: str
    distribution: str
    version: str
    fault: str = ""


@dataclass(frozen=True)
class PluginRegistry:
    """Every plugin found, every component they announced, and the hook caller for observers."""

    plugins: tuple[PluginInfo, ...]
    components: tuple[Component, ...]
    manager: pluggy.PluginManager = field(repr=False, compare=False)

    @property
    def faults(self) -> tuple[PluginInfo, ...]:
        """Plugins that failed to load."""
        return tuple(plugin for plugin in self.plugins if plugin.fault)

    def announced_by(self, plugin: PluginInfo) -> tuple[Component, ...]:
        """The components of one plugin, also where two plugins share a name."""
        return tuple(c for c in self.components if (c.plugin, c.module) == (plugin.name, plugin.module))

    @cached_property
    def _by_name(self) -> Mapping[tuple[str, str], list[Component]]:
        index: dict[tuple[str, str], list[Component]] = {}
        for component in self.components:
            index.setdefault((component.kind, component.name), []).append(component)
        return index

    def find(self, kind: str, name: str) -> Component:
        """The component of that kind and name.

        Raises:
            PluginError: there is none (the nearest and the failed plugins are named), or two offer it.
        """
        found = self._by_name.get((kind, name), [])
        if len(found) > 1:
            offered = " and ".join(f"{c.plugin} ({c.target})" for c in found)
            raise PluginError(f"the {kind} {name!r} is offered twice, by {offered}.", hint="Uninstall one of them.")
        if found:
            return found[0]
        known = sorted(n for k, n in self._by_name if k == kind)
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"Did you mean {near[0]!r}?" if near else f"Known: {', '.join(known) or 'none'}."
        if self.faults:
            failed = "; ".join(f"{p.name}: {p.fault}" for p in self.faults)
            hint += f" These plugins failed to load and may have had it: {failed}."
        raise PluginError(f"no plugin offers {_spoken(kind)} called {name!r}.", hint=hint)

    def notify(self, event: str, **what: Any) -> list[str]:
        """Tell every observer of an event; gives what went wrong in those that failed, which stops nothing."""
        faults = []
        for observer in getattr(self.manager.hook, event).get_hookimpls():
            try:
                observer.function(*[what[name] for name in observer.argnames])
            except Exception as fault:  # an observer must not cost anybody a calibration
                faults.append(f"plugin {observer.plugin_name}: {event} raised {type(fault).__name__}: {fault}.")
        return faults


def _spoken(kind: str) -> str:
    """A kind with its article."""
    name = {"online": "online estimator", "joints": "joint stream", "bench": "simulated bench"}.get(kind, kind)
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


def discover(found: Iterable[EntryPoint] | None = None) -> PluginRegistry:
    """Load every registration module.

    A plugin that fails to import, or has a hook that armcal does not know, is listed with its fault and
    breaks nothing else.
    """
    manager = pluggy.PluginManager(hooks.PROJECT)
    manager.add_hookspecs(hooks)
    plugins, components = [], []
    points = entry_points(group=GROUP) if found is None else found
    for point in sorted({(p.name, p.value): p for p in points}.values(), key=lambda p: (p.name, p.value)):
        fault, announced = _load(manager, point)
        distribution = point.dist
        plugins.append(
            PluginInfo(
                point.name,
                point.value,
                distribution.name if distribution else "",
                distribution.version if distribution else "",
                fault,
            )
        )
        components += announced
    return PluginRegistry(tuple(plugins), tuple(components), manager)


def _load(manager: pluggy.PluginManager, point: EntryPoint) -> tuple[str, list[Component]]:
    """Register one plugin; gives its fault (or nothing) and its components."""
    name = f"{point.name} ({point.value})"
    try:
        module = point.load()
        alone = pluggy.PluginManager(hooks.PROJECT)
        alone.add_hookspecs(hooks)
        alone.register(module, name)
        alone.check_pending()
        _require_marks(module)
        announced = _announced(alone, point)
        manager.register(module, name)
    except (Exception, SystemExit) as fault:  # whatever a third party's module does, the others must work
        return _said(fault), []
    return "", announced


def _said(fault: BaseException) -> str:
    """A fault in one line."""
    return " ".join(f"{type(fault).__name__}: {fault}".split())


def _require_marks(module: Any) -> None:
    """Refuse a hook that would be passed over without a word."""
    for name, specified in vars(hooks).items():
        own = getattr(module, name, None) if name.startswith(f"{hooks.PROJECT}_") else None
        if callable(own) and own is not specified and not hasattr(own, f"{hooks.PROJECT}_impl"):
            raise ValueError(f"{name} is not marked: put @hookimpl before it")


def _announced(alone: pluggy.PluginManager, point: EntryPoint) -> list[Component]:
    components: list[Component] = []
    for kind, hook in hooks.KINDS.items():

        def register(name: str, target: str, summary: str = "", kind: str = kind) -> None:
            if ":" not in target:
                raise ValueError(f"the target of {name!r} is {target!r}; expected module:attribute")
            components.append(Component(kind, name, target, summary, point.name, point.value))

        getattr(alone.hook, hook)(register=register)
    return components
