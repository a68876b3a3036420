"""The plugin manager: finds entry points, registers components by name, builds them when asked for."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import import_module
from importlib.metadata import Distribution, EntryPoint, entry_points
from pathlib import Path
from typing import Any

import pluggy

from armcal import plugin_files
from armcal.errors import Location, PluginError
from armcal.extras import extra_of, missing_library
from armcal.registration import Loaded, registered, said


@dataclass(frozen=True)
class Component:
    """Something a configuration can name.

    Attributes:
        target: ``module:attribute``.
        plugin: the entry point that registered it.
        module: what that entry point names.
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
        except ModuleNotFoundError as fault:
            named = f"the {_kind_name(self.kind)} {self.name!r}"
            raise (missing_library(fault, named) if extra_of(fault.name or "") else self._broken(fault)) from fault
        except (Exception, SystemExit) as fault:  # a plugin may fail in any way; the error names it and the reason
            raise self._broken(fault) from fault

    def _broken(self, fault: BaseException) -> PluginError:
        text = f"the {_kind_name(self.kind)} {self.name!r} of the plugin {self.plugin!r} does not load: {said(fault)}."
        return PluginError(text, hint="Repair or update that plugin.")


@dataclass(frozen=True)
class PluginInfo:
    """One entry point.

    Attributes:
        distribution: that it came with, if any, and ``version`` of that; of a file its name and digest.
        fault: why it is left out; empty if it is not.
    """

    name: str
    module: str
    distribution: str
    version: str
    fault: str = ""

    @property
    def is_file(self) -> bool:
        return self.module.startswith(f"{plugin_files.__name__}.")


@dataclass(frozen=True)
class PluginRegistry:
    """Every plugin found, every component they announced, and the hook caller for observers."""

    plugins: tuple[PluginInfo, ...]
    components: tuple[Component, ...]
    manager: pluggy.PluginManager = field(repr=False, compare=False)

    @property
    def faults(self) -> tuple[PluginInfo, ...]:
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
        components = self._by_name.get((kind, name), [])
        if len(components) > 1:
            offered = " and ".join(f"{c.plugin} ({c.target})" for c in components)
            hint = "Leave one of them out: --disable-plugin NAME."
            raise PluginError(f"the {kind} {name!r} is offered twice, by {offered}.", hint=hint)
        if components:
            return components[0]
        known = sorted(n for k, n in self._by_name if k == kind)
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"Did you mean {near[0]!r}?" if near else f"Known: {', '.join(known) or 'none'}."
        if others := [spoken(k) for k, n in self._by_name if n == name]:
            hint = f"It is registered as {' and '.join(others)}."
        hint += " A plugin's file is loaded by --plugin FILE."
        if self.faults:
            failed = "; ".join(f"{p.name}: {p.fault}" for p in self.faults)
            hint += f" These plugins failed to load and may have had it: {failed}."
        if plugin_files.disabled():
            hint += f" Left out as --disable-plugin asks: {', '.join(plugin_files.disabled())}."
        raise PluginError(f"no plugin offers {spoken(kind)} called {name!r}.", hint=hint)

    def notify(self, event: str, **what: Any) -> list[str]:
        faults = []
        for observer in getattr(self.manager.hook, event).get_hookimpls():
            try:
                observer.function(*[what[name] for name in observer.argnames])
            except Exception as fault:  # an observer must not cost anybody a calibration
                faults.append(f"plugin {observer.plugin_name}: {event} raised {type(fault).__name__}: {fault}.")
        return faults


def _kind_name(kind: str) -> str:
    names = {
        "online": "online estimator",
        "joints": "joint stream",
        "camera": "live camera",
        "bench": "simulated bench",
        "report_section": "report section",
    }
    return names.get(kind, kind)


def spoken(kind: str) -> str:
    name = _kind_name(kind)
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


def discover(points: Iterable[EntryPoint] | None = None) -> PluginRegistry:
    """Load every registration module.

    A plugin that fails to import, or has a hook that armcal does not know, is listed with its fault and breaks nothing
    else; one that ``use_plugins`` (``--plugin``) names must load.

    Raises:
        PluginError: a plugin's file is not there, does not load or registers nothing, or has another plugin's name; or
            a plugin that is to be left out is not there.
    """
    chosen = _chosen(_installed(tuple(map(_state, sys.path))) if points is None else points)
    manager, outcomes = registered(tuple(map(Loaded.of, chosen)))
    plugins, components = [], []
    for point, outcome in zip(chosen, outcomes, strict=True):
        if isinstance(point, plugin_files.FilePoint) and (outcome.fault or not outcome.works):
            text = outcome.fault or "it registers nothing: write a function armcal_register_... after @hookimpl."
            place = Location(str(point.file), line=outcome.line)
            raise PluginError(text, where=None if str(point.file) in text else place)
        plugins.append(PluginInfo(point.name, point.value, *_release(point), outcome.fault))
        components += [
            Component(
                announcement.kind, announcement.name, announcement.target, announcement.summary, point.name, point.value
            )
            for announcement in outcome.announced
        ]
    return PluginRegistry(tuple(plugins), tuple(components), manager)


def _state(folder: str) -> tuple[str, int]:
    """A place where modules are found, and when anything was last put into it or taken out (ns)."""
    try:
        return folder, Path(folder).stat().st_mtime_ns
    except OSError:
        return folder, 0


@lru_cache(maxsize=8)
def _installed(path: tuple[tuple[str, int], ...]) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=plugin_files.GROUP))


def _chosen(installed: Iterable[EntryPoint]) -> list[EntryPoint]:
    """Installed plugins and files, without those that are to be left out, by name.

    Raises:
        PluginError: a file takes an installed plugin's name, or one that is to be left out is not there.
    """
    points, out = {(p.name, p.value): p for p in installed}, plugin_files.disabled()
    for name, file in plugin_files.files().items():
        for other in (p for p in points.values() if p.name == name and name not in out):
            text = " ".join((other.value, *_release(other))).strip()
            raise PluginError(f"two plugins are called {name!r}: {file} and {text}.", hint="Rename the file.")
        point = plugin_files.FilePoint.of(name)
        points[point.name, point.value] = point
    names = sorted({name for name, _ in points})
    for name in out:
        if name not in names:
            raise PluginError(f"no plugin is called {name!r}, to be left out.", hint=f"Installed: {', '.join(names)}.")
    return [points[key] for key in sorted(points) if key[0] not in out]


def _release(point: EntryPoint) -> tuple[str, str]:
    """Distribution and version of an entry point; empty where it has none."""
    if isinstance(point, plugin_files.FilePoint):
        return point.file.name, plugin_files.digest(point.file)
    return _published(point.dist) if point.dist else ("", "")


@lru_cache(maxsize=64)
def _published(distribution: Distribution) -> tuple[str, str]:
    """Its name and version, for each of which it parses its metadata anew: many plugins share a distribution."""
    return distribution.name, distribution.version
