"""``armcal new plugin``: packages that install, pass their tests and armcal's checks, and a page done word for word."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
from armcal.errors import InputError
from armcal.plugins import discover
from armcal.scaffold.naming import LONGEST, plugin_name
from armcal.scaffold.plugin_files import KINDS, write_plugin
from scaffolds import armcal, commands_of, do, files_of, install, need, page, run

NAME = "made_here"
MOST_LINES = 60
"""That a plugin's author writes for a measurement of their own."""
FEWEST_CHECKS = 15
QUICK = ("device",)
"""The page tries a measurement."""
REGISTRY = discover()


def prove(kind: str, folder: Path) -> None:
    """It installs, is listed, keeps the contract, its tests pass, and its example calibrates to the noise."""
    package, site = folder / "armcal-made-here", folder / "site"
    ran = armcal("new", "plugin", "made-here", "--kind", kind, cwd=folder)
    assert ran.returncode == 0, ran.stderr
    install(package, site)
    assert re.search(rf"{kind} +{NAME} ", armcal("plugins", "list", cwd=folder, site=site).stdout)
    checked = armcal("plugins", "check", NAME, "--json", cwd=folder, site=site)
    assert checked.returncode == 0, checked.stdout
    checks = json.loads(checked.stdout)["checks"]
    assert len([each for each in checks if "(not run" not in each["check"]]) >= FEWEST_CHECKS
    tested = run(sys.executable, "-m", "pytest", cwd=package, site=site)
    assert tested.returncode == 0, tested.stdout
    assert int(re.findall(r"(\d+) passed", tested.stdout)[0]) > 1
    if (package / "example" / "experiment.yaml").exists():
        prove_example(package / "example", site)


def prove_example(example: Path, site: Path) -> None:
    if (example / "truth.yaml").exists():
        simulated = armcal("simulate", "experiment.yaml", "--out", "records.csv", cwd=example, site=site)
        assert simulated.returncode == 0, simulated.stderr
    ran = armcal("run", "experiment.yaml", "--json", cwd=example, site=site)
    assert ran.returncode == 0, ran.stderr
    errors = json.loads(ran.stdout)["error_mm"]
    assert errors["calibrated"]["holdout"]["mean"] < 0.2
    assert errors["nominal"]["holdout"]["mean"] > 2


@pytest.mark.parametrize("kind", QUICK)
@pytest.mark.slow
def test_a_new_plugin_works(kind: str, tmp_path: Path) -> None:
    prove(kind, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in (*QUICK, "exporter")])
def test_a_new_plugin_of_any_kind_works(kind: str, tmp_path: Path) -> None:
    prove(kind, tmp_path)


@pytest.mark.slow
def test_a_new_exporter_works_and_its_export_reads_back(tmp_path: Path) -> None:
    prove("exporter", tmp_path)
    example, out = tmp_path / "armcal-made-here" / "example", "arm.txt"
    export = ("export", "runs/experiment/calibration.yaml", "--format", NAME, "--out", out)
    ran = armcal(*export, cwd=example, site=tmp_path / "site")
    assert ran.returncode == 0, ran.stderr
    values = dict(line.split()[:2] for line in (example / out).read_text(encoding="utf-8").splitlines())
    assert float(values["arm.mdh.a2"]) == pytest.approx(0.3012, abs=1e-4)


@pytest.mark.slow
def test_its_tests_fail_where_it_is_not_installed(tmp_path: Path) -> None:
    write_plugin(NAME, "exporter", tmp_path / "package")
    ran = run(sys.executable, "-m", "pytest", "tests/test_contract.py", cwd=tmp_path / "package")
    assert ran.returncode == 1
    assert "install it first" in ran.stdout


@pytest.mark.parametrize("name", ["a", "x" * LONGEST])
def test_it_is_clean_whatever_its_name(name: str, tmp_path: Path) -> None:
    need("ruff")
    for kind in KINDS:
        write_plugin(plugin_name(name, REGISTRY), kind, tmp_path / kind)
    for command in (("check",), ("format", "--check")):
        for kind in KINDS:
            ran = run(sys.executable, "-m", "ruff", *command, "--no-cache", ".", cwd=tmp_path / kind)
            assert ran.returncode == 0, ran.stdout


@pytest.mark.slow
def test_it_is_fully_typed(tmp_path: Path) -> None:
    need("mypy")
    for kind in KINDS:
        write_plugin(NAME, kind, tmp_path / kind)
        ran = run(sys.executable, "-m", "mypy", "--cache-dir", str(tmp_path / "cache"), cwd=tmp_path / kind)
        assert ran.returncode == 0, ran.stdout
        assert "no issues found in 3 source files" in ran.stdout


def test_every_file_that_is_promised_is_there_and_names_no_host(tmp_path: Path) -> None:
    for kind in KINDS:
        files = write_plugin(NAME, kind, tmp_path / kind)
        assert {"README.md", "pyproject.toml", ".github/workflows/ci.yml", "armcal_made_here/py.typed"} <= set(files)
        assert {f"armcal_made_here/{kind}.py", f"tests/test_{kind}.py", "tests/test_contract.py"} <= set(files)
        assert any(name.startswith("example/") and name.endswith(".yaml") for name in files)
        for name in files:
            text = (tmp_path / kind / name).read_text(encoding="utf-8")
            assert "://" not in text, name
            assert "{{ name" not in text and "{%" not in text, name


# Names, places


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("1st", "expected a Python name"),
        ("class", "expected a Python name"),
        ("Wire", "expected a Python name"),
        ("a.b", "expected a Python name"),
        ("../x", "expected a Python name"),
        ("\u00e9tat", "expected a Python name"),
        ("", "expected a Python name"),
        ("armcal_wire", "Leave armcal_ out"),
        ("x" * (LONGEST + 1), f"at most {LONGEST}"),
        ("mdh", "offers the model 'mdh' already"),
        ("tip-pose", "offers the measurement 'tip_pose' already"),
        ("tracker", "a plugin is called 'tracker' already"),
    ],
)
def test_a_name_that_cannot_be_is_refused(name: str, told: str) -> None:
    with pytest.raises(InputError, match=re.escape(told)) as refused:
        plugin_name(name, REGISTRY)
    assert refused.value.exit_code == 2
    assert refused.value.hint


def test_a_folder_that_is_there_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "kept").write_text("kept", encoding="utf-8")
    ran = armcal("new", "plugin", "wire", "--kind", "reader", "--out", "mine", cwd=tmp_path)
    assert ran.returncode == 2
    assert ran.stderr.splitlines() == ["armcal: mine: it is there already. Give another --out, or move it away."]
    assert [path.name for path in tmp_path.rglob("*")] == ["mine", "kept"]


def test_a_fault_on_the_way_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: object, **more: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(InputError, match="No space left"):
        write_plugin(NAME, "reader", tmp_path / "mine")
    assert list(tmp_path.iterdir()) == []


# The page


def test_the_page_makes_a_measurement_word_for_word(tmp_path: Path) -> None:
    """A total station in fewer lines than were asked for, from an empty folder to a calibrated arm."""
    need("pip", "hatchling")
    text, here, site = page("write_a_plugin.md"), tmp_path, tmp_path / "site"
    files = files_of(text)
    code = [line for name, content in files.items() if name.endswith(".py") for line in content.splitlines()]
    lines = len([line for line in code if line.strip()])
    assert lines < MOST_LINES
    assert f"in {lines} lines of Python" in text
    for command in commands_of(text, "text"):
        here = do(command, here, site)
        if here.name == "armcal-total-station" and files:
            for name, content in files.items():
                assert (here / name).exists(), f"{name} takes the place of a file that is not there"
                (here / name).write_text(content, encoding="utf-8")
            files = {}
    assert files == {}
    need_clean(here.parent)
    errors = json.loads((here / "runs" / "experiment" / "metrics.json").read_text(encoding="utf-8"))["error_mm"]
    assert errors["nominal"]["holdout"]["mean"] > 10
    assert errors["calibrated"]["holdout"]["mean"] < 0.5


def need_clean(package: Path) -> None:
    """What the page shows keeps the linter's rules that the package sets."""
    need("ruff")
    for command in (("check",), ("format", "--check")):
        ran = run(sys.executable, "-m", "ruff", *command, "--no-cache", ".", cwd=package)
        assert ran.returncode == 0, ran.stdout
