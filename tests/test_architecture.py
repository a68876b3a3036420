"""The order of the floors, and of the files on each: imports run one way."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FRAMEWORK = ROOT / "framework" / "armcal"
PLUGINS = ROOT / "plugins"

ORDER = [
    "armcal.errors",
    "armcal.hooks",
    "armcal.plugins",
    "armcal.base.units",
    "armcal.base.config_text",
    "armcal.base.quantities",
    "armcal.base.settings",
    "armcal.base.se3",
    "armcal.base.quaternions",
    "armcal.base.twists",
    "armcal.base.domains",
    "armcal.base.directions",
    "armcal.base.parameters",
    "armcal.base.pose_blocks",
    "armcal.base.pose_settings",
    "armcal.base.dataset",
    "armcal.arm.model",
    "armcal.arm.effects",
    "armcal.arm.statics",
    "armcal.arm.elastic",
    "armcal.arm.servo",
    "armcal.arm.assembly",
    "armcal.arm.clearance",
    "armcal.arm.holding",
    "armcal.arm.loading",
    "armcal.measure.measurement",
    "armcal.measure.contact",
    "armcal.measure.groups",
    "armcal.measure.partners",
    "armcal.measure.reader",
    "armcal.measure.layout",
    "armcal.measure.missing",
    "armcal.measure.checks",
    "armcal.measure.cells",
    "armcal.measure.column_match",
    "armcal.measure.csv_writer",
    "armcal.measure.environment",
    "armcal.measure.id_list",
    "armcal.measure.limits",
    "armcal.solve.parallel",
    "armcal.solve.c_source",
    "armcal.solve.compiler",
    "armcal.solve.factor",
    "armcal.solve.kernel",
    "armcal.solve.blueprint",
    "armcal.solve.whitening",
    "armcal.solve.correlation",
    "armcal.solve.factor_records",
    "armcal.solve.gather",
    "armcal.solve.one_record",
    "armcal.solve.linearised",
    "armcal.solve.normal_equations",
    "armcal.solve.problem",
    "armcal.solve.online",
    "armcal.solve.drift",
    "armcal.solve.joint_noise",
    "armcal.solve.posed",
    "armcal.solve.nuisance",
    "armcal.solve.polish",
    "armcal.solve.observability",
    "armcal.solve.combination",
    "armcal.solve.null_space",
    "armcal.solve.identifiability",
    "armcal.solve.projection",
    "armcal.solve.structure",
    "armcal.solve.tool_motion",
    "armcal.solve.scale",
    "armcal.solve.minimal",
    "armcal.solve.estimator",
    "armcal.solve.scatter",
    "armcal.solve.validation",
    "armcal.solve.blocks",
    "armcal.solve.comparison",
    "armcal.solve.bootstrap",
    "armcal.solve.candidates",
    "armcal.solve.criterion",
    "armcal.solve.tally",
    "armcal.solve.relaxation",
    "armcal.solve.bound",
    "armcal.solve.planning",
    "armcal.solve.refinement",
    "armcal.solve.suggestion",
    "armcal.solve.loss",
    "armcal.solve.redundancy",
    "armcal.solve.robust",
    "armcal.solve.likelihood",
    "armcal.solve.variance",
    "armcal.solve.weighing",
    "armcal.solve.motion",
    "armcal.solve.dependences",
    "armcal.solve.fit_rows",
    "armcal.solve.score_tests",
    "armcal.solve.neighbours",
    "armcal.solve.leftover",
    "armcal.solve.misses",
    "armcal.solve.evidence",
    "armcal.solve.noise_findings",
    "armcal.solve.moved",
    "armcal.solve.evidence_findings",
    "armcal.solve.prediction",
    "armcal.solve.coverage",
    "armcal.solve.profile",
    "armcal.solve.verdict",
    "armcal.solve.simulation",
    "armcal.config.yaml_scalars",
    "armcal.config.yaml_nodes",
    "armcal.config.yaml_tree",
    "armcal.config.yaml_source",
    "armcal.config.variants",
    "armcal.config.validate",
    "armcal.config.system",
    "armcal.config.selection",
    "armcal.use.intervals",
    "armcal.use.calibration",
    "armcal.use.rigid_chain",
    "armcal.use.convert_poe",
    "armcal.use.convert_urdf",
    "armcal.use.convert_mdh",
    "armcal.use.convert_check",
    "armcal.use.exporter",
    "armcal.run.plan_settings",
    "armcal.run.settings",
    "armcal.run.experiment",
    "armcal.run.plan_clearance",
    "armcal.run.plan_poses",
    "armcal.run.plan_ground",
    "armcal.run.visit",
    "armcal.run.plan_visit",
    "armcal.run.plan",
    "armcal.run.groups",
    "armcal.run.noise",
    "armcal.run.intervals",
    "armcal.run.result",
    "armcal.run.judging",
    "armcal.run.folder",
    "armcal.run.provenance",
    "armcal.run.reach",
    "armcal.run.pipeline",
    "armcal.run.outputs",
    "armcal.run.study_settings",
    "armcal.run.study_result",
    "armcal.run.study",
    "armcal.run.load_transfer",
    "armcal.run.study_outputs",
    "armcal.online.files",
    "armcal.online.frames",
    "armcal.online.lock",
    "armcal.online.torn_end",
    "armcal.online.journal_segment",
    "armcal.online.journal_reader",
    "armcal.online.journal_writer",
    "armcal.online.journal_room",
    "armcal.online.journal",
    "armcal.online.incoming",
    "armcal.online.row_parser",
    "armcal.online.sources.source",
    "armcal.online.sources.line_cutter",
    "armcal.online.sources.line_parser",
    "armcal.online.sources.reading",
    "armcal.online.sources.csv_file",
    "armcal.online.sources.lines",
    "armcal.online.sources.udp",
    "armcal.online.sources.folder",
    "armcal.online.sources.opening",
    "armcal.online.settings",
    "armcal.online.chart",
    "armcal.online.companions",
    "armcal.online.process",
    "armcal.online.observer",
    "armcal.online.belief",
    "armcal.online.projection",
    "armcal.online.start",
    "armcal.online.directions",
    "armcal.online.window_evidence",
    "armcal.online.hypotheses",
    "armcal.online.what_if",
    "armcal.online.pose_worth",
    "armcal.online.health",
    "armcal.online.clock",
    "armcal.online.snapshot",
    "armcal.online.state",
    "armcal.online.advance",
    "armcal.online.sentences",
    "armcal.online.judge",
    "armcal.online.events",
    "armcal.online.updated",
    "armcal.online.evaluator",
    "armcal.online.recalibrator",
    "armcal.online.progress",
    "armcal.online.course",
    "armcal.online.event_file",
    "armcal.online.standard_output",
    "armcal.online.outputs",
    "armcal.online.signals",
    "armcal.online.control",
    "armcal.online.loop",
    "armcal.online.requests",
    "armcal.online.session",
    "armcal.online.salvage",
    "armcal.online.replay_begin",
    "armcal.online.state_distance",
    "armcal.online.replay_walk",
    "armcal.online.replay_witness",
    "armcal.online.replay",
    "armcal.online.courses",
    "armcal.online.watch.lenient",
    "armcal.online.watch.units",
    "armcal.online.watch.thinned",
    "armcal.online.watch.tail",
    "armcal.online.watch.events",
    "armcal.online.watch.estimates",
    "armcal.online.watch.history",
    "armcal.online.watch.shape",
    "armcal.online.watch.feed",
    "armcal.online.watch.access",
    "armcal.online.watch.page",
    "armcal.online.watch.server",
    "armcal.online.watch.terminal",
    "armcal.online.mission_truth",
    "armcal.online.mission_settings",
    "armcal.online.mission_tips",
    "armcal.online.mission_story",
    "armcal.online.mission_judge",
    "armcal.online.mission_errors",
    "armcal.online.mission_files",
    "armcal.online.mission_source",
    "armcal.online.mission",
]
"""Lowest first. ``report``, ``testing`` and ``cli`` stand above all of these, in that order."""

UPPER = ("armcal.report", "armcal.testing", "armcal.cli")


def _module(path: Path) -> str:
    parts = path.relative_to(FRAMEWORK.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _imports(path: Path) -> set[str]:
    """Every armcal module that a file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return {name for name in found if name.startswith("armcal")}


def _rank(module: str) -> int | None:
    """Where a module (or a name in one) stands; None for packages themselves."""
    for height, upper in enumerate(UPPER):
        if module == upper or module.startswith(upper + "."):
            return len(ORDER) + height
    known = [i for i, name in enumerate(ORDER) if module == name or module.startswith(name + ".")]
    return known[0] if known else None


FILES = sorted(path for path in FRAMEWORK.rglob("*.py") if path.name != "__init__.py")


def test_every_file_of_the_framework_has_a_place_in_the_order() -> None:
    assert [_module(path) for path in FILES if _rank(_module(path)) is None] == []


def test_the_order_names_no_file_that_is_gone() -> None:
    assert [name for name in ORDER if name not in {_module(path) for path in FILES}] == []


@pytest.mark.parametrize("path", FILES, ids=_module)
def test_a_file_imports_only_from_below(path: Path) -> None:
    own = _rank(_module(path))
    upward = {}
    for name in _imports(path):
        rank = _rank(name)
        if rank is None or own is None:
            continue
        if rank > own or (rank == own < len(ORDER) and name != _module(path)):
            upward[name] = rank
    assert upward == {}


def test_package_files_of_lower_floors_import_nothing() -> None:
    for path in FRAMEWORK.rglob("__init__.py"):
        floor = path.parent.name
        if floor not in ("armcal", "report", "testing", "cli"):
            assert _imports(path) == set(), path


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
    assert all(getattr(armcal, name) is not None for name in armcal.__all__)
