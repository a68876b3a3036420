"""The plugin manager: finds plugins, registers their components by name, imports one when it is asked for, and says
what is wrong with one: which file, line and method, what it returned or raised, what was expected.

A plugin is a module that an entry point of the group ``armcal`` names, or a Python file that ``use_plugins`` names: a
component and its registration without a package. Which files are loaded stands in environment variables, so that every
process that is started knows them too; ``gear.py`` is the module ``armcal.plugins.gear`` there.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib
import inspect
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from importlib import import_module, metadata
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.metadata import Distribution, EntryPoint, entry_points
from importlib.util import spec_from_file_location
from pathlib import Path
from pkgutil import resolve_name
from types import CodeType, ModuleType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import pluggy

from armcal import hooks
from armcal.errors import ArmcalError, BrokenPluginError, Location, PluginError

if TYPE_CHECKING:
    from packaging.requirements import Requirement

R = TypeVar("R")

# The environment variables: paths of files and folders, and names of plugins, both separated as ``PATH`` is.
CHOSEN, DISABLED = "ARMCAL_PLUGINS", "ARMCAL_DISABLED_PLUGINS"
__path__: list[str] = []  # a package, whose modules the finder below finds

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_NO_PLUGINS = ("_", "test_", "conftest")
_CALLED = re.compile(r"([\w.<>]+)\(\) (?:takes|missing|got) ")  # a call whose arguments do not match
_MOST_SHOWN = 100

# --- files ---------------------------------------------------------------------------------------------------------


def use_plugins(*places: str | Path, disabled: Sequence[str] = ()) -> None:
    """Load these files, and all files of these folders, from now on, in this process and those that it starts.

    ``disabled`` are names of plugins that are left out. What a former call named is forgotten.
    """
    os.environ[CHOSEN] = os.pathsep.join(str(Path(place).absolute()) for place in places)
    os.environ[DISABLED] = os.pathsep.join(disabled)


def plugin_files() -> dict[str, Path]:
    """The chosen files by the name of their plugin."""
    paths: dict[str, Path] = {}
    for place in map(Path, _listed(CHOSEN)):
        for file in _files_of(place):
            other = paths.setdefault(file.stem, file)
            if other != file:
                text = f"two plugins are called {file.stem!r}: {other} and {file}."
                raise PluginError(text, hint="Rename one of the files.")
    return paths


def _listed(variable: str) -> tuple[str, ...]:
    return tuple(filter(None, os.environ.get(variable, "").split(os.pathsep)))


def _files_of(place: Path) -> Iterator[Path]:
    """A file itself, or those of a folder that are no tests and do not begin with an underscore."""
    where, hint = Location(str(place)), "as --plugin asks"
    if place.is_dir():
        paths = sorted(file for file in place.glob("*.py") if not file.name.startswith(_NO_PLUGINS))
        if not paths:
            raise PluginError(f"found no plugin in this folder, {hint}.", where=where, hint="Put NAME.py there.")
    elif place.is_file():
        paths = [place]
    else:
        raise PluginError(f"found no such file or folder, {hint}.", where=where, hint="Correct the path.")
    for file in paths:
        if file.suffix != ".py" or not _NAME.fullmatch(file.stem):
            text = "expected the name of a plugin's file, letters, digits, - and _ with .py after them."
            raise PluginError(text, where=Location(str(file)), hint="Rename it.")
        yield file


def _digest(file: Path) -> str:
    return f"sha256 {hashlib.sha256(file.read_bytes()).hexdigest()[:16]}"


class _Loader(SourceFileLoader):
    """Leaves no compiled file beside the source, whose age could not tell two edits of one second apart."""

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = ModuleType(spec.name)  # with its digest before another thread can meet it in sys.modules
        module.armcal_digest = _digest(Path(self.path))  # type: ignore[attr-defined]
        return module

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


class _Finder(MetaPathFinder):
    """Finds the modules of chosen files, in whatever process."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        package, _, name = fullname.rpartition(".")
        file = plugin_files().get(name) if package == __name__ else None
        return spec_from_file_location(fullname, file, loader=_Loader(fullname, str(file))) if file else None


sys.meta_path.append(_Finder())


def _import_file(module: str, file: Path) -> ModuleType:
    """Import a plugin's file, anew where it is another than before."""
    known = sys.modules.get(module)
    if known is not None and (known.__file__, known.armcal_digest) != (str(file), _digest(file)):
        sys.modules.pop(module, None)  # another thread may have been faster
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit) as fault:  # whatever a user's file does, it is told where
        where = Location(str(file), _line(fault, str(file)))
        raise BrokenPluginError(f"it does not import: {said(fault)}.", where=where) from fault


# --- the registry --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Component:
    kind: str
    name: str
    target: str  # module:attribute
    summary: str
    plugin: str  # the entry point that registered it
    module: str = ""  # what that entry point names

    def load(self) -> Any:
        named = f"the {_SPOKEN.get(self.kind, self.kind)} {self.name!r}"
        try:
            return resolve_name(self.target)
        except (Exception, SystemExit) as fault:  # a plugin may fail in any way; the error names it and the reason
            if isinstance(fault, ModuleNotFoundError) and extra_of(fault.name or ""):
                raise missing_library(fault, named) from fault
            text = f"{named} of the plugin {self.plugin!r} does not load: {said(fault)}."
            raise BrokenPluginError(text, hint="Repair or update that plugin.") from fault


@dataclass(frozen=True)
class PluginInfo:
    name: str
    module: str
    distribution: str  # that it came with; of a file its name; empty if none
    version: str  # of the distribution; of a file its digest
    fault: str = ""  # why it is left out

    @property
    def is_file(self) -> bool:
        return self.module.startswith(f"{__name__}.")


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

    def find(self, kind: str, name: str) -> Component:
        components = [own for own in self.components if (own.kind, own.name) == (kind, name)]
        if len(components) > 1:
            offered = " and ".join(f"{c.plugin} ({c.target})" for c in components)
            hint = "Leave one of them out: --disable-plugin NAME."
            raise PluginError(f"the {kind} {name!r} is offered twice, by {offered}.", hint=hint)
        if components:
            return components[0]
        known = sorted(own.name for own in self.components if own.kind == kind)
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"Did you mean {near[0]!r}?" if near else f"Known: {', '.join(known) or 'none'}."
        if others := list(dict.fromkeys(spoken(own.kind) for own in self.components if own.name == name)):
            hint = f"It is registered as {' and '.join(others)}."
        hint += " A plugin's file is loaded by --plugin FILE."
        if self.faults:
            failed = "; ".join(f"{p.name}: {p.fault}" for p in self.faults)
            hint += f" These plugins failed to load and may have had it: {failed}."
        if disabled := _listed(DISABLED):
            hint += f" Left out as --disable-plugin asks: {', '.join(disabled)}."
        raise PluginError(f"no plugin offers {spoken(kind)} called {name!r}.", hint=hint)

    def notify(self, event: str, **what: Any) -> list[str]:
        faults = []
        for observer in getattr(self.manager.hook, event).get_hookimpls():
            try:
                observer.function(*[what[name] for name in observer.argnames])
            except Exception as fault:  # an observer must not cost anybody a calibration
                faults.append(f"plugin {observer.plugin_name}: {event} raised {type(fault).__name__}: {fault}.")
        return faults


_SPOKEN = {  # names of kinds that are two words
    "online": "online estimator",
    "joints": "joint stream",
    "camera": "live camera",
    "bench": "simulated bench",
    "report_section": "report section",
}


def spoken(kind: str) -> str:
    name = _SPOKEN.get(kind, kind)
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


# --- discovery and registration ------------------------------------------------------------------------------------


def discover(points: Iterable[EntryPoint] | None = None) -> PluginRegistry:
    """Load every registration module.

    A plugin that fails to import, or has a hook that armcal does not know, is listed with its fault and breaks nothing
    else; one that ``use_plugins`` (``--plugin``) names must load.
    """
    if points is None:
        return _registered(_chosen(_installed(tuple(sys.path))))
    return _registered.__wrapped__(_chosen(points))


@lru_cache(maxsize=8)
def _installed(path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=hooks.PROJECT))


@lru_cache(maxsize=64)
def _published(distribution: Distribution | None) -> tuple[str, str]:
    """Its name and version, for each of which it parses its metadata anew: many plugins share a distribution."""
    return (distribution.name, distribution.version) if distribution else ("", "")


def _chosen(installed: Iterable[EntryPoint]) -> tuple[tuple[PluginInfo, EntryPoint | ModuleType], ...]:
    """Installed plugins, and files, which are imported; without those that are to be left out, by name."""
    origins: dict[tuple[str, str], tuple[PluginInfo, EntryPoint | Path]] = {
        (p.name, p.value): (PluginInfo(p.name, p.value, *_published(p.dist)), p) for p in installed
    }
    out = _listed(DISABLED)
    for name, file in plugin_files().items():
        for other in (plugin for plugin, _ in origins.values() if plugin.name == name and name not in out):
            text = " ".join((other.module, other.distribution, other.version)).strip()
            raise PluginError(f"two plugins are called {name!r}: {file} and {text}.", hint="Rename the file.")
        plugin = PluginInfo(name, f"{__name__}.{name}", file.name, _digest(file))
        origins[name, plugin.module] = plugin, file
    names = sorted({name for name, _ in origins})
    for name in out:
        if name not in names:
            raise PluginError(f"no plugin is called {name!r}, to be left out.", hint=f"Installed: {', '.join(names)}.")
    remaining = [origin for (name, _), origin in sorted(origins.items(), key=lambda item: item[0]) if name not in out]
    return tuple((p, _import_file(p.module, own) if isinstance(own, Path) else own) for p, own in remaining)


@lru_cache(maxsize=8)  # a command, its experiment and its calibration each look for plugins
def _registered(chosen: tuple[tuple[PluginInfo, EntryPoint | ModuleType], ...]) -> PluginRegistry:
    manager = pluggy.PluginManager(hooks.PROJECT)
    manager.add_hookspecs(hooks)
    plugins, components = [], list[Component]()
    for plugin, origin in chosen:
        module = None
        try:
            module = origin if isinstance(origin, ModuleType) else origin.load()
            components += _announced(manager, plugin, module)
        except (Exception, SystemExit) as fault:  # whatever a third party's module does, the others must work
            if plugin.is_file:
                file = getattr(module, "__file__", None)
                kind = PluginError if isinstance(fault, PluginError) else BrokenPluginError
                raise kind(said(fault), where=Location(file, line=_line(fault, file))) from fault
            if manager.is_registered(module):
                manager.unregister(module)
            plugin = replace(plugin, fault=said(fault))
        plugins.append(plugin)
    return PluginRegistry(tuple(plugins), tuple(components), manager)


def _announced(manager: pluggy.PluginManager, plugin: PluginInfo, module: Any) -> list[Component]:
    _require_marks(module)
    manager.register(module, f"{plugin.name} ({plugin.module})")
    announced: list[Component] = []
    for kind, hook in hooks.KINDS.items():

        def register(name: str, target: str | type, summary: str = "", kind: str = kind) -> None:
            if isinstance(target, type):
                target = f"{target.__module__}:{target.__qualname__}"
            if not all(isinstance(text, str) for text in (name, target, summary)):
                given = ", ".join(map(repr, (name, target, summary)))
                raise TypeError(f"register() was given {given}; expected text")
            if ":" not in target:
                raise ValueError(f"the target of {name!r} is {target!r}; expected module:attribute")
            announced.append(Component(kind, name, target, summary, plugin.name, plugin.module))

        for own in getattr(manager.hook, hook).get_hookimpls():
            if own.plugin is module:
                own.function(*[register for _ in own.argnames])
    if plugin.is_file and not manager.get_hookcallers(module):
        raise PluginError("it registers nothing: write a function armcal_register_... after @hookimpl.")
    return announced


def _require_marks(module: Any) -> None:
    """Refuse a hook that would be passed over without a word, and one that there is none of."""
    known, marked = [hook for hook in dir(hooks) if hook.startswith(f"{hooks.PROJECT}_")], f"{hooks.PROJECT}_impl"
    for name, own in vars(module).items():
        if hasattr(own, marked) and name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]}" if near else "python -m pydoc armcal.hooks lists them"
            raise PluginError(f"unknown hook {name!r}: {hint}")
        if name in known and callable(own) and own is not getattr(hooks, name) and not hasattr(own, marked):
            raise PluginError(f"{name} is not marked: put @hookimpl before it")


# --- what is wrong in a plugin's code ------------------------------------------------------------------------------


def said(fault: BaseException) -> str:
    text = str(fault) if isinstance(fault, ArmcalError) else f"{type(fault).__name__}: {fault}"
    return " ".join(text.split())


def _line(fault: BaseException, file: str | None) -> int | None:
    """The last line of the file that an exception came through."""
    if isinstance(fault, SyntaxError) and fault.filename == file:
        return fault.lineno
    lines = [frame.lineno for frame in traceback.extract_tb(fault.__traceback__) if frame.filename == file]
    return lines[-1] if lines else None


def plugin_fault(fault: BaseException) -> BrokenPluginError | None:
    """What a plugin's code raised, with its file, line and method; None where armcal's own code did."""
    plugins = {p.module if p.is_file else p.module.partition(".")[0]: p for p in discover().plugins}
    plugins = {module: plugin for module, plugin in plugins.items() if plugin.distribution != hooks.PROJECT}

    def owner(module: str) -> PluginInfo | None:
        return next((own for name, own in plugins.items() if f"{module}.".startswith(f"{name}.")), None)

    frames = list(traceback.walk_tb(fault.__traceback__))
    modules = [str(frame.f_globals.get("__name__", "")) for frame, _ in frames]
    places = [place for place, module in enumerate(modules) if owner(module)]
    broken: BrokenPluginError | None = None
    if places and not (isinstance(fault, SystemExit) and modules[places[0] - 1].startswith("click.")):
        (frame, line), plugin = frames[places[-1]], owner(modules[places[-1]])
        assert plugin is not None
        advice = "Choose by casadi.if_else, on recorded values alone. " if "truth value" in str(fault) else ""
        named = f" --plugin {plugin.distribution}" if plugin.is_file else ""
        broken = BrokenPluginError(
            f"{frame.f_code.co_qualname} raised {said(fault).rstrip('.')}.",
            where=Location(frame.f_code.co_filename, line=line),
            hint=f"{advice}To check it by itself: armcal plugins check {plugin.name}{named}.",
        )
    elif not places and isinstance(fault, TypeError) and (called := _CALLED.match(str(fault))):
        # A method with other arguments than the contract's: Python raises where it is called, not in the plugin.
        root = called[1].partition(".")[0]
        for name, module in list(sys.modules.items()):
            if owner(name) and hasattr(module, root):
                hint = "Take the arguments that the contract names: docs/hooks.md."
                broken = BrokenPluginError(f"{fault}.", where=Location(module.__file__), hint=hint)
    if broken is not None:
        broken.__cause__ = fault
    return broken


def blaming(work: Callable[..., R]) -> Callable[..., R]:
    """``work`` in which a fault of a plugin's code is placed: a traceback does not reach another process, for one."""
    return partial(_blamed, work)


def _blamed(work: Callable[..., R], *given: Any) -> R:
    try:
        return work(*given)
    except ArmcalError:
        raise
    except (Exception, SystemExit) as fault:
        if (placed := plugin_fault(fault)) is not None:
            raise placed from fault
        raise


@contextmanager
def expecting(method: Callable[..., Any] | property, returned: Any, expected: str) -> Iterator[None]:
    """Refuse what a method returned, if the block cannot work with it: it is of another type than the contract says."""
    try:
        yield
    except ArmcalError:
        raise
    except Exception as fault:  # whatever another type makes of it
        text = " ".join(f"{returned!r}".split())
        refuse(method, text if len(text) < _MOST_SHOWN else f"{type(returned).__name__} ({fault})", expected)


def refuse(method: Callable[..., Any] | property, returned: str, expected: str) -> NoReturn:
    """Refuse what a method of a component (or a property, or the class that sets an attribute) returned."""
    getter: Any = getattr(method, "fget", method)  # of a property
    function = inspect.unwrap(getattr(getter, "__func__", getter))
    code = getattr(function, "__code__", None)
    where = Location(code.co_filename, line=code.co_firstlineno) if code else None
    if isinstance(function, type) and (file := getattr(sys.modules.get(function.__module__), "__file__", None)):
        where = Location(file)
    name = getattr(function, "__qualname__", type(method).__qualname__)
    text = f"{name} returned {' '.join(returned.split())}, expected {expected}."
    raise PluginError(text, where=where, hint="Correct that method.") from None


# --- libraries that only parts of armcal need ----------------------------------------------------------------------

# Of modules that are called otherwise than the distribution that they come with.
DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow", "serial": "pyserial", "yaml": "pyyaml"}


def library(module: str, needed_by: str) -> Any:
    """A library that only ``needed_by`` needs ("reading images")."""
    try:
        return import_module(module)
    except ImportError as fault:
        raise missing_library(fault, needed_by) from fault


def missing_library(fault: ImportError, needed_by: str = "this") -> ArmcalError:
    """What to say of a library that is not installed, or does not load."""
    absent = isinstance(fault, ModuleNotFoundError)
    module = (fault.name or ("armcal" if absent else "")).partition(".")[0]
    if module == "armcal":
        raise fault  # of ours, not of the installation
    if absent and (extra := extra_of(module)):
        text = f"{needed_by} needs the library {module}, which is not installed."
        return PluginError(text, hint=f"Run pip install 'armcal[{extra}]'.")
    text = f"the library {fault.name} is missing." if absent else f"a library cannot be loaded ({fault})."
    hint = "Install armcal anew with all it needs: pip install armcal. `armcal doctor` names what is broken."
    return ArmcalError(text, hint=hint)


def extra_of(module: str) -> str | None:
    """The smallest extra that brings a module; None where none does."""
    name = DISTRIBUTIONS.get(module, module)
    members = {extra: [r.name for r in needed] for extra, needed in requirements().items() if extra}
    bringing = [extra for extra, names in members.items() if name in names]
    return min(bringing, key=lambda extra: len(members[extra]), default=None)


def requirements() -> dict[str, list[Requirement]]:
    """What armcal needs in any case, under the empty name, and what each extra adds; none of what its makers need."""
    from packaging.requirements import Requirement

    try:
        needed = [Requirement(text) for text in metadata.requires("armcal") or []]
        extras = metadata.metadata("armcal").get_all("Provides-Extra") or []
    except metadata.PackageNotFoundError:
        return {}
    always = [r for r in needed if r.marker is None or r.marker.evaluate({"extra": ""})]
    others = [r for r in needed if r.marker and r not in always]
    users = [extra for extra in extras if extra not in ("test", "dev", "docs", "bench")]
    return {"": always} | {e: [r for r in others if r.marker and r.marker.evaluate({"extra": e})] for e in users}
