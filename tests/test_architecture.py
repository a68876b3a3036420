"""The order of the rooms: imports run one way."""

from __future__ import annotations

import ast
import graphlib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FRAMEWORK = ROOT / "framework" / "armcal"
PLUGINS = ROOT / "plugins"

ROOMS = (
    ("version", "errors", "hooks", "hook_trace", "plugin_files", "registration", "plugins"),
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
    ("doctor",),
    ("api", "cli"),
)
"""Lowest first: a room imports only rooms above it in this list, at run time, lazily and for types alike."""
APPLICATIONS = ("armcal_bench", "armcal_capability", "armcal_online", "armcal_serve")
"""Plugins with commands of their own: nothing else imports them, and they import the core alone."""


def _module(path: Path) -> str:
    root = FRAMEWORK.parent if path.is_relative_to(FRAMEWORK) else PLUGINS
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def _imports(path: Path) -> frozenset[str]:
    """Every armcal module, or name in one, that a file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(name for name in found if name.startswith("armcal"))


def _height(module: str) -> int:
    """Where a module's room stands in ``ROOMS``."""
    room = module.split(".")[1]
    return next(height for height, names in enumerate(ROOMS) if room in names)


FILES = sorted(path for path in FRAMEWORK.rglob("*.py") if path.name != "__init__.py")


def test_every_room_has_a_place_in_the_order_and_every_place_a_room() -> None:
    named = {name for names in ROOMS for name in names}
    there = {_module(path).split(".")[1] for path in FILES}
    assert there == named


@pytest.mark.parametrize("room", [name for names in ROOMS for name in names])
def test_a_room_imports_only_rooms_below_it(room: str) -> None:
    upward = {
        (_module(path), name)
        for path in FILES
        if _module(path).split(".")[1] == room
        for name in _imports(path)
        if name.startswith("armcal.") and _height(name) > _height(_module(path))
    }
    assert upward == set()


def test_no_file_stands_in_a_circle_of_imports() -> None:
    """Lazy imports and those for types count; ``armcal`` itself only hands names on."""
    files = {_module(path): path for path in (*FILES, *PLUGINS.rglob("*.py"))}
    graph = {}
    for module, path in files.items():
        named = _imports(path)
        above = {name.rpartition(".")[0] for name in named}
        graph[module] = ((named | above) & set(files)) - {module}
    tuple(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError, which names the circle


def test_package_files_import_nothing_from_the_house() -> None:
    for path in FRAMEWORK.rglob("__init__.py"):
        if path.parent.name not in ("armcal", "report", "testing"):
            assert not _imports(path), path


@pytest.mark.parametrize("plugin", sorted(p.name for p in PLUGINS.iterdir() if (p / "plugin.py").exists()))
def test_plugins_import_armcal_and_never_each_other(plugin: str) -> None:
    others = {p.name for p in PLUGINS.iterdir()} - {plugin}
    for path in (PLUGINS / plugin).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in names} & others, path
            if plugin != "armcal" and path.name == "plugin.py":
                heavy = [n for n in names if n.split(".")[0] not in ("armcal", "__future__", "")]
                assert heavy == [], f"{path} is imported to list plugins and must stay light"


def test_applications_are_announced_by_their_commands_alone() -> None:
    for name in APPLICATIONS:
        announced = (PLUGINS / name / "plugin.py").read_text(encoding="utf-8")
        assert "armcal_register_commands" in announced, name


def test_the_framework_names_no_plugin_package() -> None:
    packages = [p.name for p in PLUGINS.iterdir() if p.is_dir() and p.name.startswith("armcal_")]
    for path in FILES:
        modules = _imports(path)
        assert not [m for m in modules if m.split(".")[0] in packages], path


@pytest.mark.parametrize("path", [*FILES, *sorted(PLUGINS.rglob("*.py"))], ids=lambda p: p.stem)
def test_files_and_functions_stay_short(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 400
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            assert (node.end_lineno or 0) - node.lineno < 45, f"{path}: {node.name}"


def test_only_the_command_line_prints_or_exits() -> None:
    for path in FILES:
        if "cli" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("print", "exit", "quit"), path


def test_the_public_interface_is_small_and_light() -> None:
    import armcal

    assert len(armcal.__all__) <= 20
    assert all(getattr(armcal, name) is not None for name in (*armcal.__all__, *armcal._HOMES))
