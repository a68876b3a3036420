"""Plugins: light registration, the contract's checks, a third party's arm from pip to result, broken plugins."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import forked
import pytest
import yaml
from armcal.cli.main import cli
from armcal.errors import PluginError
from armcal.hooks import KINDS
from armcal.plugins import Component, PluginRegistry, discover
from armcal.testing.contract import CheckResult, check_component
from click.testing import CliRunner

ROOT = Path(__file__).parents[2]
DATA = ROOT / "tests" / "data"
SCARA = DATA / "scara_plugin"
OURS = (
    *("contact", "cvxpy", "dualarm", "ipopt", "joints", "kalman"),
    *("mdh", "pca9685", "poe", "simulation", "tracker", "urdf"),
)
HEAVY = ("numpy", "casadi", "matplotlib", "pydantic", "scipy", "cvxpy")
Ran = subprocess.CompletedProcess[str]


def python(*arguments: str, path: Path | None = None, cwd: Path | None = None, columns: int = 1000) -> Ran:
    environment = {**os.environ, "PYTHONPATH": str(path or ""), "COLUMNS": str(columns), "ARMCAL_CC": "none"}
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, env=environment, cwd=cwd, check=False
    )


def armcal(*arguments: str, path: Path | None = None, cwd: Path | None = None, columns: int = 1000) -> Ran:
    """One command, in a process of its own where plugins are found on another path."""
    if path is None and cwd is None:
        done = CliRunner().invoke(cli, arguments, env={"COLUMNS": str(columns)})
        return Ran(arguments, done.exit_code, done.stdout, done.stderr)
    environment = {"COLUMNS": str(columns), "ARMCAL_CC": "none"}
    return forked.armcal(*arguments, path=path, cwd=cwd, environment=environment)


# Light registration


@pytest.mark.parametrize("arguments", [("plugins", "list"), ("--help",)])
def test_listing_and_help_import_nothing_heavy(arguments: tuple[str, ...]) -> None:
    code = (
        "import sys\nfrom armcal.cli.main import cli\n"
        f"cli.main(args={list(arguments)!r}, prog_name='armcal', standalone_mode=False)\n"
        f"print('heavy:', [name for name in {HEAVY!r} if name in sys.modules])"
    )
    ran = python("-c", code)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.splitlines()[-1] == "heavy: []"


def test_our_plugins_load() -> None:
    registry = discover()
    assert not [p for p in registry.plugins if p.distribution == "armcal" and p.fault]
    assert set(OURS) <= {p.name for p in registry.plugins}


NOT_RUN = {
    "camera": ("its settings have no path", "no known file was read"),
    "ros2": ("it reads no plain table", "no known file was read"),
    "servobus": ("no such serial port", "could feed it"),
    "tracker": ("it reads no plain table", "no known file was read"),
}
"""Why checks of a plugin are not run: it reads folders, recordings, samples or a bus, and has tests of its own."""


@pytest.mark.slow
def test_our_plugins_keep_the_contract() -> None:
    ran = armcal("plugins", "check", "--json")
    reports = {report["plugin"]: report for report in json.loads(ran.stdout)["plugins"]}
    assert set(OURS) <= set(reports)
    for plugin in reports:
        report = reports[plugin]
        assert [check for check in report["checks"] if check["fault"]] == []
        assert (report["fault"], report["failed"]) == (None, 0)
        assert report["ran"] + report["not_run"] == len(report["checks"])
        components = {check["component"] for check in report["checks"] if check["component"].partition(" ")[0] in KINDS}
        commands = {name for name in components if name.startswith("command ")}
        assert report["ran"] > len(commands) + 5 * (components > commands)
        usual = NOT_RUN.get(plugin, ())
        reasons = {check["not_run"] for check in report["checks"] if check["not_run"]}
        assert not [reason for reason in reasons if not any(words in reason for words in usual)]


def test_a_check_tells_how_many_ran_and_why_one_did_not() -> None:
    ran, told = armcal("plugins", "check", "ros2"), armcal("plugins", "check", "ros2", "-v")
    assert (ran.returncode, told.returncode) == (0, 0), ran.stdout + ran.stderr
    assert re.fullmatch(r"ros2: ([0-9]+) of \1 checks passed, 1 not run \(-v says why\)\.\n", ran.stdout)
    lines = told.stdout.splitlines()
    left = [line for line in lines[:-1] if not line.startswith("ok ")]
    assert len(left) == 1
    assert left[0].startswith("--   reader rosbag2: it reads a known file")
    assert left[0].endswith("(not run: it reads no plain table, and has no EXAMPLE_SOURCE)")
    assert lines[-1] == f"ros2: {len(lines) - 2} of {len(lines) - 2} checks passed, 1 not run."


@pytest.mark.slow
def test_checking_all_names_the_one_that_is_broken(tmp_path: Path) -> None:
    write_plugin(tmp_path, "import", BROKEN["import"][0])
    code = "from importlib.metadata import EntryPoint as E; import armcal.cli.plugins as p; d = p.discover; "
    code += (
        "p.discover = lambda: d([E('import', 'broken_import', 'armcal'), E('mdh', 'armcal_mdh.plugin', 'armcal')]); "
    )
    environment = {"COLUMNS": "1000", "ARMCAL_CC": "none"}
    ran = forked.run_code(f"{code}p.plugins(['check'])", path=tmp_path, environment=environment)
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1
    assert ran.stderr.startswith("armcal: import: ModuleNotFoundError")
    assert "import: 0 of 1 checks passed." in ran.stdout
    assert re.search(r"mdh: ([0-9]+) of \1 checks passed\.", ran.stdout)


# The checks find faults


def checked(monkeypatch: pytest.MonkeyPatch, kind: str, name: str) -> list[CheckResult]:
    monkeypatch.syspath_prepend(str(DATA / "faulty_components"))
    return check_component(Component(kind, name, f"faulty_components:{name}", "", "faulty"))


FAULTS = [
    ("model", "NoSuchClass", "it imports"),
    ("model", "NoSettings", "settings are checked"),
    ("model", "LooseSettings", "unknown key"),
    ("model", "ForgetfulSettings", "to_config"),
    ("model", "NeedsExample", "it has no EXAMPLE"),
    ("model", "WrongExample", "example is accepted"),
    ("model", "ExitsWhenBuilt", "SystemExit: 3"),
    ("model", "OtherJoints", "one joint for each name"),
    ("model", "DottedParameter", "the name 'link.len"),
    ("model", "GlobbedParameter", "the name 'length*'"),
    ("model", "TwinParameter", "two parameters called"),
    ("model", "NoParameter", "expected a sequence of ParameterBlock"),
    ("model", "EndlessParameter", "nominal nan"),
    ("model", "OutsideParameter", "nominal values"),
    ("model", "ShortParameter", "other has 2 entries, its domain has 1"),
    ("model", "UnscaledParameter", "a scale above zero"),
    ("model", "MillimetreParameter", "the unit 'mm'"),
    ("model", "FurlongParameter", "the unit 'furlong'"),
    ("model", "ForeignSymbol", "[elsewhere] are free"),
    ("model", "Branching", "does not branch"),
    ("model", "SlantedAxis", "one joint for each name"),
    ("model", "LostFrame", "one joint for each name"),
    ("model", "Shearing", "rigid motions"),
    ("model", "Mirrored", "rigid motions"),
    ("model", "Stepped", "agree with differences"),
    ("effect", "TwoDisplacements", "returned 2 x 1 numbers"),
    ("effect", "BranchingDisplacement", "which branches on it"),
    ("effect", "SingularDisplacement", "a derivative of it is not finite"),
    ("effect", "FarSite", "a spring at the site 4"),
    ("effect", "AxislessBase", "at the mount without directions"),
    ("effect", "LongDirection", "expected a unit vector"),
    ("effect", "WideLaw", "returned 2 x 1 numbers, expected 1 x 1"),
    ("effect", "SingularLaw", "a derivative of it is not finite at k = 0.0"),
    ("effect", "DeadZoneLaw", "which branches on it"),
    ("measurement", "ManyNoises", "makes a residual"),
    ("measurement", "NoNoise", "it makes a residual"),
    ("measurement", "Biased", "residual is zero"),
    ("measurement", "UnknownOutput", "it makes a residual"),
    ("measurement", "RefusesArms", "no arm suits it"),
    ("measurement", "SingularMeasurement", "a derivative of it is not finite"),
    ("estimator", "Estimator", "converges to the truth"),
    ("estimator", "Unconverged", "expected convergence"),
    ("estimator", "BoundBreaker", "keeps to the bounds"),
    ("estimator", "Raising", "ZeroDivisionError: no step (faulty_components.py:"),
]


@pytest.mark.parametrize(("kind", "name", "check"), FAULTS, ids=[name for _, name, _ in FAULTS])
def test_a_fault_is_found(monkeypatch: pytest.MonkeyPatch, kind: str, name: str, check: str) -> None:
    failed = [result for result in checked(monkeypatch, kind, name) if result.fault]
    assert any(check in f"{result.check}: {result.fault}" for result in failed), failed
    assert all("\n" not in result.fault for result in failed)


SOUND = [
    ("model", "Model"),
    ("effect", "Effect"),
    ("effect", "RecordedDisplacement"),
    ("measurement", "Measurement"),
    ("measurement", "TwoArms"),
    ("reader", "Reader"),
]


@pytest.mark.parametrize(("kind", "name"), SOUND, ids=[name for _, name in SOUND])
def test_what_is_sound_passes(monkeypatch: pytest.MonkeyPatch, kind: str, name: str) -> None:
    results = checked(monkeypatch, kind, name)
    assert [result for result in results if result.fault] == []
    assert len(results) > 3


# A third party's plugin


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example plugin of docs/plugins.md, installed by pip where only PYTHONPATH finds it."""
    for needed in ("pip", "hatchling"):
        if importlib.util.find_spec(needed) is None:
            pytest.skip(f"{needed} is not installed here, and the example plugin is built with it")
    source, target = tmp_path_factory.mktemp("source") / "scara", tmp_path_factory.mktemp("site")
    shutil.copytree(SCARA, source)
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check")
    ran = python("-m", "pip", "install", *options, "--target", str(target), str(source))
    assert ran.returncode == 0, ran.stderr
    return target


def test_plugins_are_found_where_another_library_took_the_finder_over() -> None:
    """Some libraries load importlib_metadata, whose entry points are of a class of its own."""
    pytest.importorskip("importlib_metadata", reason="needs importlib_metadata")
    code = "import importlib_metadata; from armcal.plugins import discover; print(len(discover().components))"
    ran = python("-c", code)
    assert ran.returncode == 0 and int(ran.stdout) > 20, ran.stdout + ran.stderr


@pytest.mark.slow
def test_an_installed_plugin_is_listed_and_checked(installed: Path) -> None:
    assert "scara" not in armcal("plugins", "list").stdout
    listed = armcal("plugins", "list", path=installed)
    assert "scara  (armcal-scara 1.0.0, armcal_scara.plugin)" in listed.stdout
    found = armcal("plugins", "check", "scara", "-v", path=installed)
    assert found.returncode == 0, found.stdout + found.stderr
    assert "what it gives is in m and rad as its parameters are" in found.stdout


@pytest.mark.slow
def test_an_installed_arm_is_calibrated_from_yaml(installed: Path, tmp_path: Path) -> None:
    for name in ("experiment.yaml", "truth.yaml"):
        shutil.copy(SCARA / name, tmp_path)
    exact = ("--set", "simulation.noise_mm=0")
    simulated = armcal("simulate", "experiment.yaml", "--out", "measurements.csv", *exact, path=installed, cwd=tmp_path)
    assert simulated.returncode == 0, simulated.stderr
    ran = armcal("run", "experiment.yaml", "--out", "result", path=installed, cwd=tmp_path)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    content = yaml.safe_load((tmp_path / "result" / "calibration.yaml").read_text(encoding="utf-8"))
    found = {entry["name"]: entry["value"] for entry in content["parameters"] if entry["free"]}
    degree = 0.017453292519943295
    assert found == pytest.approx(
        {
            "arm.scara.upper": 0.2513,
            "arm.scara.fore": 0.1992,
            "arm.scara.height": 0.302,
            "arm.scara.shoulder_zero": 1.5 * degree,
            "arm.scara.elbow_zero": -0.8 * degree,
            "arm.spring.k1": 0.004,
            "arm.spring.k2": 0.007,
        },
        abs=1e-8,
    )


def test_the_guide_quotes_the_example_in_full() -> None:
    guide = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    for file in sorted(path for path in SCARA.rglob("*") if path.suffix in (".py", ".toml", ".yaml")):
        if file.name != "__init__.py":
            assert file.read_text(encoding="utf-8").strip() in guide, file


def test_the_framework_knows_no_third_party_arm() -> None:
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "framework").rglob("*.py")]
    assert not any("scara" in text.lower() for text in texts)


# Broken plugins

GOOD = """
from armcal.hooks import hookimpl

@hookimpl
def armcal_register_models(register):
    register("NAME", "TARGET")
"""
BROKEN = {
    "import": ("import no_such_module_of_anybody", "ModuleNotFoundError"),
    "syntax": ("def broken(:\n    pass", "SyntaxError"),
    "misspelt": (GOOD.replace("models", "modells"), "unknown hook 'armcal_register_modells'"),
    "unmarked": (GOOD.replace("@hookimpl", ""), "armcal_register_models is not marked"),
    "raises": (GOOD.replace('register("NAME", "TARGET")', "1 / 0"), "ZeroDivisionError"),
    "exits": ("raise SystemExit(4)", "SystemExit"),
    "no_colon": (GOOD.replace("TARGET", "some.module"), "expected module:attribute"),
    "no_text": (GOOD.replace('"TARGET"', "3"), "TypeError: register() was given 'NAME', 3"),
    "lines": ("raise RuntimeError('one\\ntwo')", "one two"),
}


def write_plugin(site: Path, name: str, text: str) -> EntryPoint:
    """A plugin as an installed distribution: a module and its metadata."""
    module = f"broken_{name}"
    (site / f"{module}.py").write_text(text, encoding="utf-8")
    folder = site / f"{module}-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n", encoding="utf-8")
    (folder / "entry_points.txt").write_text(f"[armcal]\n{name} = {module}\n", encoding="utf-8")
    return EntryPoint(name, module, "armcal")


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    """A configuration of our own components that simulates."""
    folder = tmp_path / "experiment"
    folder.mkdir()
    content: dict[str, Any] = yaml.safe_load((SCARA / "experiment.yaml").read_text(encoding="utf-8"))
    rows = [{"a_mm": 200, "alpha_deg": 90}, {"a_mm": 100}]
    content["arms"] = {"arm": {"model": {"type": "mdh", "convention": "standard", "rows": rows}}}
    content["simulation"]["poses"] = {"count": 4, "levels_deg": {"q1": [0, 10], "q2": [0, 20]}}
    content["parameters"] = {}
    (folder / "experiment.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    (folder / "truth.yaml").write_text("arm.mdh.a1: 201 mm\n", encoding="utf-8")
    return folder


QUICKLY_BROKEN = ("import", "exits")
"""The others break in the same place."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [n if n in QUICKLY_BROKEN else pytest.param(n, marks=pytest.mark.slow) for n in BROKEN]
)
def test_a_broken_plugin_warns_once_and_breaks_nothing(name: str, tmp_path: Path, experiment: Path) -> None:
    text, fault = BROKEN[name]
    write_plugin(tmp_path, name, text)
    listed = armcal("plugins", "list", path=tmp_path)
    assert listed.returncode == 0, listed.stderr
    assert f"does not load: {fault.partition(' ')[0]}" in listed.stdout or fault in listed.stdout
    assert "mdh" in listed.stdout
    ran = armcal("simulate", "experiment.yaml", "--out", "data.csv", path=tmp_path, cwd=experiment)
    assert ran.returncode == 0, ran.stderr
    assert len(ran.stderr.splitlines()) == 1, ran.stderr
    assert ran.stderr.startswith(f"warning: plugin {name} (broken_{name}) is left out: ")
    assert fault in ran.stderr
    assert armcal("plugins", "check", name, path=tmp_path).returncode == 2


def test_a_warning_is_one_line_on_a_narrow_terminal(tmp_path: Path, experiment: Path) -> None:
    write_plugin(tmp_path, "import", BROKEN["import"][0])
    simulate = ("simulate", "experiment.yaml", "--out", "data.csv")
    ran = armcal(*simulate, path=tmp_path, cwd=experiment, columns=80)
    assert ran.returncode == 0, ran.stderr
    assert len(ran.stderr.splitlines()) == 1, ran.stderr


def test_asking_for_a_broken_plugins_component_is_refused(tmp_path: Path, experiment: Path) -> None:
    write_plugin(tmp_path, "import", BROKEN["import"][0])
    asked = ("--set", "arms.arm.model.type=lost")
    ran = armcal("simulate", "experiment.yaml", "--out", "data.csv", *asked, path=tmp_path, cwd=experiment)
    assert ran.returncode == 2
    refusal = ran.stderr[ran.stderr.index("armcal: ") :]
    assert "no plugin offers a model called 'lost'" in refusal
    assert "import: ModuleNotFoundError: No module named 'no_such_module_of_anybody'" in refusal
    assert "Traceback" not in ran.stderr


@pytest.mark.slow
def test_a_component_that_does_not_import_is_refused(tmp_path: Path, experiment: Path) -> None:
    text = GOOD.replace("NAME", "lost").replace("TARGET", "no_such_module_of_anybody:Model")
    write_plugin(tmp_path, "late", text)
    asked = ("--set", "arms.arm.model.type=lost")
    ran = armcal("simulate", "experiment.yaml", "--out", "data.csv", *asked, path=tmp_path, cwd=experiment)
    assert ran.returncode == 2
    assert "the model 'lost' of the plugin 'late' does not load: ModuleNotFoundError" in ran.stderr
    assert armcal("plugins", "check", "late", path=tmp_path).returncode == 2


def registry_of(monkeypatch: pytest.MonkeyPatch, site: Path, **texts: str) -> PluginRegistry:
    monkeypatch.syspath_prepend(str(site))
    return discover([write_plugin(site, name, text) for name, text in texts.items()])


def test_two_plugins_of_one_name_are_both_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    one, two = (GOOD.replace("NAME", "arm").replace("TARGET", f"{n}_module:Arm") for n in ("one", "two"))
    registry = registry_of(monkeypatch, tmp_path, one=one, two=two)
    with pytest.raises(PluginError, match=r"one \(one_module:Arm\) and two \(two_module:Arm\)"):
        registry.find("model", "arm")


@pytest.mark.slow
def test_plugins_that_share_a_name_keep_their_components_apart(tmp_path: Path) -> None:
    write_plugin(tmp_path, "twin", GOOD.replace("NAME", "arm").replace("TARGET", "twin_module:Arm"))
    (tmp_path / "broken_twin-1.0.dist-info" / "entry_points.txt").write_text("[armcal]\nmdh = broken_twin\n")
    listed = armcal("plugins", "list", path=tmp_path).stdout
    assert listed.count("Denavit-Hartenberg") == 1
    checked_both = armcal("plugins", "check", "mdh", "-v", path=tmp_path)
    assert checked_both.returncode == 2
    assert "FAIL model arm: it imports" in checked_both.stdout
    assert "ok   model mdh: it builds" in checked_both.stdout


def test_a_hook_specification_that_is_only_imported_is_no_fault(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    text = "from armcal.hooks import armcal_register_models\n"
    assert registry_of(monkeypatch, tmp_path, importer=text).faults == ()


def test_an_unknown_type_gives_the_nearest_name() -> None:
    with pytest.raises(PluginError, match="Did you mean 'mdh'"):
        discover().find("model", "mhd")
    with pytest.raises(PluginError, match="Known: flange_pose, mdh"):
        discover().find("model", "zzzzzz")


def test_an_unknown_plugin_lists_the_installed_ones() -> None:
    ran = armcal("plugins", "check", "nothing")
    assert ran.returncode == 2
    assert "no plugin is called 'nothing'" in ran.stderr
    assert "mdh" in ran.stderr
