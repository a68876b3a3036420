"""The order of the floors, and of the files on each: imports run one way."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FRAMEWORK = ROOT / "framework" / "armcal"
PLUGINS = ROOT / "plugins"

ORDER = [
    "armcal.version",
    "armcal.errors",
    "armcal.hooks",
    "armcal.hook_trace",
    "armcal.registration",
    "armcal.plugin_files",
    "armcal.plugins",
    "armcal.io.udp",
    "armcal.base.shown",
    "armcal.base.plain_files",
    "armcal.base.units",
    "armcal.base.config_text",
    "armcal.base.quantities",
    "armcal.base.settings",
    "armcal.base.se3",
    "armcal.base.quaternions",
    "armcal.base.twists",
    "armcal.base.domains",
    "armcal.base.process",
    "armcal.base.directions",
    "armcal.base.parameters",
    "armcal.base.pose_blocks",
    "armcal.base.pose_settings",
    "armcal.base.dataset",
    "armcal.arm.model",
    "armcal.arm.effects",
    "armcal.arm.statics",
    "armcal.arm.environment",
    "armcal.arm.elastic",
    "armcal.arm.servo",
    "armcal.arm.assembly",
    "armcal.arm.clearance",
    "armcal.arm.holding",
    "armcal.arm.loading",
    "armcal.measure.measurement",
    "armcal.measure.contact",
    "armcal.measure.instrument",
    "armcal.measure.groups",
    "armcal.measure.partners",
    "armcal.measure.reader",
    "armcal.measure.layout",
    "armcal.measure.poses",
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
    "armcal.solve.library_build",
    "armcal.solve.compiler",
    "armcal.solve.factor",
    "armcal.solve.kernel_trial",
    "armcal.solve.stability",
    "armcal.solve.kernel",
    "armcal.solve.batch_function",
    "armcal.solve.blueprint",
    "armcal.solve.whitening",
    "armcal.solve.correlation",
    "armcal.solve.factor_records",
    "armcal.solve.gather",
    "armcal.solve.one_record",
    "armcal.solve.linearised",
    "armcal.solve.rigid",
    "armcal.solve.normal_equations",
    "armcal.solve.problem",
    "armcal.solve.online",
    "armcal.solve.drift",
    "armcal.solve.joint_noise",
    "armcal.solve.column_mixups",
    "armcal.solve.mixups",
    "armcal.solve.posed",
    "armcal.solve.polish",
    "armcal.solve.nuisance",
    "armcal.solve.observability",
    "armcal.solve.combination",
    "armcal.solve.null_space",
    "armcal.solve.identifiability",
    "armcal.solve.projection",
    "armcal.solve.readings",
    "armcal.solve.structure",
    "armcal.solve.tool_motion",
    "armcal.solve.scale",
    "armcal.solve.minimal",
    "armcal.solve.estimator",
    "armcal.solve.screening",
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
    "armcal.solve.outside",
    "armcal.solve.smooth",
    "armcal.solve.noise_trend",
    "armcal.solve.score_tests",
    "armcal.solve.clustered",
    "armcal.solve.odds",
    "armcal.solve.leftover",
    "armcal.solve.misses",
    "armcal.solve.gross",
    "armcal.solve.majority",
    "armcal.solve.evidence",
    "armcal.solve.noise_findings",
    "armcal.solve.gross_findings",
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
    "armcal.config.options",
    "armcal.config.servo_file",
    "armcal.config.servo_file_edit",
    "armcal.config.system",
    "armcal.config.selection",
    "armcal.use.tool_expression",
    "armcal.use.measured_point",
    "armcal.use.compensation.request",
    "armcal.use.compensation.turning",
    "armcal.use.compensation.step",
    "armcal.use.compensation.equilibrium",
    "armcal.use.compensation.goal",
    "armcal.use.compensation.array_search",
    "armcal.use.compensation.compiled_search",
    "armcal.use.compensation.solver",
    "armcal.use.compensation.seeds",
    "armcal.use.compensation.finder",
    "armcal.use.compensation.sides",
    "armcal.use.compensation.redundancy",
    "armcal.use.compensation.counts",
    "armcal.use.compensation.rounding",
    "armcal.use.compensation.target_kind",
    "armcal.use.compensation.limits",
    "armcal.use.compensation.reach",
    "armcal.use.compensation.reasons",
    "armcal.use.compensation.path",
    "armcal.use.compensation.compensator",
    "armcal.use.compensation.grid",
    "armcal.use.intervals",
    "armcal.use.physics",
    "armcal.use.calibration_file",
    "armcal.use.calibration",
    "armcal.use.rigid_chain",
    "armcal.use.convert_poe",
    "armcal.use.convert_urdf",
    "armcal.use.convert_mdh",
    "armcal.use.convert_check",
    "armcal.use.acceptance",
    "armcal.use.file_set",
    "armcal.use.exporter",
    "armcal.run.plan_settings",
    "armcal.run.settings",
    "armcal.run.experiment",
    "armcal.run.plan_clearance",
    "armcal.run.plan_poses",
    "armcal.run.plan_ground",
    "armcal.run.workspace",
    "armcal.run.target_file",
    "armcal.run.compensate",
    "armcal.run.command_file",
    "armcal.run.correction_table",
    "armcal.run.visit",
    "armcal.run.plan_visit",
    "armcal.run.plan",
    "armcal.run.groups",
    "armcal.run.noise",
    "armcal.run.gravity",
    "armcal.run.intervals",
    "armcal.run.result",
    "armcal.run.judging",
    "armcal.run.swap",
    "armcal.run.folder",
    "armcal.run.provenance",
    "armcal.run.reach",
    "armcal.run.mixup",
    "armcal.run.pipeline",
    "armcal.run.outputs",
    "armcal.run.study_settings",
    "armcal.run.study_result",
    "armcal.run.study",
    "armcal.run.load_transfer",
    "armcal.run.study_outputs",
    "armcal.capability.settings",
    "armcal.capability.sampling",
    "armcal.capability.nimbleness",
    "armcal.capability.mechanics",
    "armcal.capability.quantities",
    "armcal.capability.voxels",
    "armcal.capability.inverse",
    "armcal.capability.areas",
    "armcal.capability.subject",
    "armcal.capability.accuracy",
    "armcal.capability.survey",
    "armcal.capability.designs",
    "armcal.capability.loading",
    "armcal.capability.summary",
    "armcal.capability.tables",
    "armcal.capability.outputs",
    "armcal.online.journal.files",
    "armcal.online.journal.frames",
    "armcal.online.journal.lock",
    "armcal.online.journal.torn_end",
    "armcal.online.journal.segment",
    "armcal.online.journal.reader",
    "armcal.online.journal.writer",
    "armcal.online.journal.room",
    "armcal.online.journal.journal",
    "armcal.online.sources.incoming",
    "armcal.online.sources.row_parser",
    "armcal.online.sources.source",
    "armcal.online.sources.line_cutter",
    "armcal.online.sources.line_parser",
    "armcal.online.sources.reading",
    "armcal.online.sources.csv_file",
    "armcal.online.sources.lines",
    "armcal.online.sources.udp",
    "armcal.online.sources.folder",
    "armcal.online.sources.opening",
    "armcal.online.tracking.settings",
    "armcal.online.tracking.chart",
    "armcal.online.tracking.companions",
    "armcal.online.tracking.process",
    "armcal.online.tracking.observer",
    "armcal.online.tracking.belief",
    "armcal.online.tracking.projection",
    "armcal.online.tracking.start",
    "armcal.online.tracking.directions",
    "armcal.online.tracking.window_evidence",
    "armcal.online.tracking.hypotheses",
    "armcal.online.tracking.what_if",
    "armcal.online.tracking.pose_worth",
    "armcal.online.tracking.health",
    "armcal.online.tracking.clock",
    "armcal.online.tracking.snapshot",
    "armcal.online.tracking.state",
    "armcal.online.tracking.advance",
    "armcal.online.tracking.sentences",
    "armcal.online.tracking.judge",
    "armcal.online.tracking.events",
    "armcal.online.tracking.updated",
    "armcal.online.tracking.evaluator",
    "armcal.online.tracking.recalibrator",
    "armcal.online.running.progress",
    "armcal.online.running.course",
    "armcal.online.running.event_file",
    "armcal.online.running.standard_output",
    "armcal.online.running.outputs",
    "armcal.online.running.signals",
    "armcal.online.running.unix_socket",
    "armcal.online.running.control",
    "armcal.online.running.loop",
    "armcal.online.running.requests",
    "armcal.online.running.session",
    "armcal.online.replaying.salvage",
    "armcal.online.replaying.begin",
    "armcal.online.replaying.state_distance",
    "armcal.online.replaying.walk",
    "armcal.online.replaying.witness",
    "armcal.online.replaying.replay",
    "armcal.online.replaying.courses",
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
    "armcal.online.mission.truth",
    "armcal.online.mission.settings",
    "armcal.online.mission.tips",
    "armcal.online.mission.story",
    "armcal.online.mission.judge",
    "armcal.online.mission.errors",
    "armcal.online.mission.files",
    "armcal.online.mission.source",
    "armcal.online.mission.mission",
    "armcal.bench.clock",
    "armcal.bench.faults",
    "armcal.bench.framed.cobs",
    "armcal.bench.framed.frames",
    "armcal.bench.framed.messages",
    "armcal.bench.serial_port",
    "armcal.bench.terminal",
    "armcal.bench.link",
    "armcal.bench.device",
    "armcal.bench.body_settings",
    "armcal.bench.tracker",
    "armcal.bench.joint_stream",
    "armcal.bench.simulated",
    "armcal.bench.acquisition.settings",
    "armcal.bench.recording.settings",
    "armcal.bench.rotations",
    "armcal.bench.outliers",
    "armcal.bench.bodies",
    "armcal.bench.stillness",
    "armcal.bench.settling",
    "armcal.bench.tracker_health",
    "armcal.bench.settings",
    "armcal.bench.bench",
    "armcal.bench.hazards",
    "armcal.bench.wiring",
    "armcal.bench.waiting",
    "armcal.bench.acquisition.heat",
    "armcal.bench.acquisition.ways",
    "armcal.bench.acquisition.schedule",
    "armcal.bench.acquisition.progress",
    "armcal.bench.acquisition.endings",
    "armcal.bench.acquisition.arrival",
    "armcal.bench.acquisition.watch",
    "armcal.bench.acquisition.drive",
    "armcal.bench.acquisition.recovery",
    "armcal.bench.acquisition.conduct",
    "armcal.bench.acquisition.eyes",
    "armcal.bench.acquisition.preparation",
    "armcal.bench.acquisition.outputs",
    "armcal.bench.acquisition.run_log",
    "armcal.bench.acquisition.session",
    "armcal.bench.acquisition.rehearsal",
    "armcal.bench.recording.line_source",
    "armcal.bench.recording.rest_stream",
    "armcal.bench.recording.posture",
    "armcal.bench.recording.window",
    "armcal.bench.recording.labels",
    "armcal.bench.recording.book",
    "armcal.bench.recording.outputs",
    "armcal.bench.recording.quick_fit",
    "armcal.bench.recording.agreement",
    "armcal.bench.recording.knowledge",
    "armcal.bench.recording.assessor",
    "armcal.bench.recording.told",
    "armcal.bench.recording.recorder",
    "armcal.bench.recording.keys",
    "armcal.bench.recording.session",
    "armcal.bench.servo.known",
    "armcal.bench.servo.unknowns",
    "armcal.bench.servo.residuals",
    "armcal.bench.servo.fit",
    "armcal.bench.servo.turning",
    "armcal.bench.servo.nominal",
    "armcal.bench.servo.settings",
    "armcal.bench.servo.entries",
    "armcal.bench.servo.record",
    "armcal.bench.servo.angles",
    "armcal.bench.servo.alignment",
    "armcal.bench.servo.trial",
    "armcal.bench.servo.mixup",
    "armcal.bench.servo.outcome",
    "armcal.bench.servo.findings",
    "armcal.bench.servo.outputs",
    "armcal.bench.servo.setup",
    "armcal.bench.servo.beginning",
    "armcal.bench.servo.mover",
    "armcal.bench.servo.sweep",
    "armcal.bench.servo.warmth",
    "armcal.bench.servo.automatic",
    "armcal.bench.servo.keys",
    "armcal.bench.servo.guided",
    "armcal.bench.servo.session",
    "armcal.serve.protocol",
    "armcal.serve.reading",
    "armcal.serve.served_arm",
    "armcal.serve.rows",
    "armcal.serve.shares",
    "armcal.serve.answering",
    "armcal.serve.loaded",
    "armcal.serve.frames",
    "armcal.serve.worker",
    "armcal.serve.poller",
    "armcal.serve.conversation",
    "armcal.serve.worker_process",
    "armcal.serve.calibration_watch",
    "armcal.serve.dispatcher",
    "armcal.serve.crew",
    "armcal.serve.transports.stream",
    "armcal.serve.transports.transport",
    "armcal.serve.transports.standard",
    "armcal.serve.transports.unix",
    "armcal.serve.transports.datagrams",
    "armcal.serve.server",
    "armcal.serve.client",
]
"""Lowest first. Above all of these stand the floors of ``UPPER``, in that order."""

UPPER = ("armcal.report", "armcal.api", "armcal.testing", "armcal.doctor", "armcal.scaffold", "armcal.cli")


def _module(path: Path) -> str:
    parts = path.relative_to(FRAMEWORK.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def _imports(path: Path) -> frozenset[str]:
    """Every armcal module that a file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return frozenset(name for name in found if name.startswith("armcal"))


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
    there = {_module(path) for path in FILES}
    assert [name for name in ORDER if name not in there] == []


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
        if floor not in ("armcal", "report", "testing", "doctor", "cli"):
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
