"""The order of the rooms: imports run one way."""

from __future__ import annotations

import ast
import graphlib
import inspect
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FRAMEWORK = ROOT / "framework" / "armcal"
PLUGINS = ROOT / "plugins"

ROOMS = (
    ("version", "errors", "hooks", "plugins"),
    ("base",),
    ("io",),
    ("functions",),
    ("arm",),
    ("measure",),
    ("config",),
    ("problem",),
    ("estimate",),
    ("planning",),
    ("diagnose",),
    ("calibration",),
    ("run",),
    ("report",),
    ("devices",),
    ("testing",),
    ("scaffold",),
    ("api", "cli"),
)
"""Lowest first: a room imports only rooms above it in this list, at run time, lazily and for types alike."""
APPLICATIONS = ("armcal_bench", "armcal_capability", "armcal_online", "armcal_serve")
"""Plugins with commands of their own: nothing else imports them, and they import the core alone."""


def _module(path: Path) -> str:
    root = FRAMEWORK.parent if path.is_relative_to(FRAMEWORK) else PLUGINS
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@dataclass(frozen=True)
class Source:
    """What a file says.

    Attributes:
        lines: how many it has.
        imports: every armcal module, or name in one, that it imports, anywhere in it.
        packages: of every import, by its first word; of an import of a package's own files the word is empty.
        functions: each with its lines less one.
        calls: names of what it calls by a plain name.
    """

    lines: int
    imports: frozenset[str]
    packages: frozenset[str]
    functions: tuple[tuple[str, int], ...]
    calls: frozenset[str]


@cache
def _source(path: Path) -> Source:
    text = path.read_text(encoding="utf-8")
    names, packages, functions, calls = set[str](), set[str](), list[tuple[str, int]](), set[str]()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
            packages |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            packages.add((node.module or "").split(".")[0])
            names |= {f"{node.module}.{alias.name}" for alias in node.names if node.module}
        elif isinstance(node, ast.FunctionDef):
            functions.append((node.name, (node.end_lineno or 0) - node.lineno))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            calls.add(node.func.id)
    imports = frozenset(name for name in names if name.startswith("armcal"))
    return Source(len(text.splitlines()), imports, frozenset(packages), tuple(functions), frozenset(calls))


def _height(module: str) -> int:
    """Where a module's room stands in ``ROOMS``."""
    room = module.split(".")[1]
    return next(height for height, names in enumerate(ROOMS) if room in names)


FILES = sorted(path for path in FRAMEWORK.rglob("*.py") if path.name != "__init__.py")


def test_every_room_has_a_place_in_the_order_and_every_place_a_room() -> None:
    named = {name for names in ROOMS for name in names}
    there = {_module(path).split(".")[1] for path in FILES}
    assert there == named


@pytest.mark.quick("arm", "base", "cli", "estimate", "problem")
@pytest.mark.parametrize("room", [name for names in ROOMS for name in names])
def test_a_room_imports_only_rooms_below_it(room: str) -> None:
    upward = {
        (_module(path), name)
        for path in FILES
        if _module(path).split(".")[1] == room
        for name in _source(path).imports
        if name.startswith("armcal.") and _height(name) > _height(_module(path))
    }
    assert upward == set()


def test_no_file_stands_in_a_circle_of_imports() -> None:
    """Lazy imports and those for types count; ``armcal`` itself only hands names on."""
    files = {_module(path): path for path in (*FILES, *PLUGINS.rglob("*.py"))}
    graph = {}
    for module, path in files.items():
        named = _source(path).imports
        above = {name.rpartition(".")[0] for name in named}
        graph[module] = ((named | above) & set(files)) - {module}
    tuple(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError, which names the circle


def test_package_files_import_nothing_from_the_house() -> None:
    for path in FRAMEWORK.rglob("__init__.py"):
        if path.parent.name not in ("armcal", "report", "testing"):
            assert not _source(path).imports, path


@pytest.mark.parametrize("plugin", sorted(p.name for p in PLUGINS.iterdir() if (p / "plugin.py").exists()))
def test_plugins_import_armcal_and_never_each_other(plugin: str) -> None:
    others = {p.name for p in PLUGINS.iterdir()} - {plugin}
    for path in (PLUGINS / plugin).rglob("*.py"):
        packages = _source(path).packages
        assert not packages & others, path
        if path.name == "plugin.py":
            assert packages <= {"armcal", "__future__", ""}, f"{path} is imported to list plugins and must stay light"


def test_plugins_import_the_documented_modules_alone() -> None:
    """The table of docs/plugins.md is the one list: what is not on it is private, what nothing imports leaves it."""
    table = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8").split("## What a plugin may import")[1]
    documented = set()
    for room, modules in re.findall(r"^\| `(armcal[.\w]*)` \| (.+) \|$", table, re.MULTILINE):
        documented |= {f"{room}.{module}" for module in re.findall(r"`([.\w]+)`", modules)}
    there = {_module(path) for path in FRAMEWORK.rglob("*.py")} - {"armcal"}
    imported = {name for path in PLUGINS.rglob("*.py") for name in _source(path).imports if name.startswith("armcal.")}
    assert {name if name in there else name.rpartition(".")[0] for name in imported} - {"armcal"} == documented


def test_applications_are_announced_by_their_commands_alone() -> None:
    for name in APPLICATIONS:
        announced = (PLUGINS / name / "plugin.py").read_text(encoding="utf-8")
        assert "armcal_register_commands" in announced, name


def test_the_framework_names_no_plugin_package() -> None:
    packages = [p.name for p in PLUGINS.iterdir() if p.is_dir() and p.name.startswith("armcal_")]
    for path in FILES:
        modules = _source(path).imports
        assert not [m for m in modules if m.split(".")[0] in packages], path


@pytest.mark.parametrize("path", [*FILES, *sorted(PLUGINS.rglob("*.py"))], ids=lambda p: p.stem)
def test_modules_and_functions_can_be_held_in_mind(path: Path) -> None:
    source = _source(path)
    assert source.lines <= 900
    for name, length in source.functions:
        assert length < 60, f"{path}: {name}"


def test_a_problem_carries_its_records() -> None:
    """Only the room of problems takes them apart: elsewhere no function takes both."""
    for path in (*FRAMEWORK.rglob("*.py"), *PLUGINS.rglob("*.py")):
        if path.parent == FRAMEWORK / "problem":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                given = [a.annotation for a in (*node.args.args, *node.args.kwonlyargs) if a.annotation is not None]
                taken = {name.id for one in given for name in ast.walk(one) if isinstance(name, ast.Name)}
                assert not taken >= {"Problem", "FactorRecords"}, f"{path.name}: {node.name}"


def test_only_the_command_line_prints_or_exits() -> None:
    for path in FILES:
        if "cli" not in path.parts:
            assert not _source(path).calls & {"print", "exit", "quit"}, path


def test_the_public_interface_is_small_and_light() -> None:
    import armcal

    assert len(armcal.__all__) <= 20
    assert all(getattr(armcal, name) is not None for name in (*armcal.__all__, *armcal._HOMES))


def test_documented_names_have_docstrings() -> None:
    """What users and authors of plugins read: the names of ``armcal`` with their public methods, and the hooks."""
    import armcal
    from armcal import hooks

    things = [getattr(armcal, name) for name in (*armcal.__all__, *armcal._HOMES)]
    documented = [thing for thing in things if inspect.isclass(thing) or inspect.isfunction(thing)]
    for thing in (
        *documented,
        *(
            kind
            for kind in vars(hooks).values()
            if getattr(kind, "__module__", "") == hooks.__name__ and inspect.isclass(kind)
        ),
    ):
        assert inspect.getdoc(thing), thing
        for name, member in vars(thing).items() if inspect.isclass(thing) else ():
            if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, (property, classmethod))):
                assert inspect.getdoc(getattr(thing, name)), f"{thing.__name__}.{name}"
