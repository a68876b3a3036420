"""``armcal new plugin``: files that work, pass their tests and armcal's checks, and a page done word for word."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

import pytest
from armcal.errors import InputError
from armcal.plugins import discover
from armcal.scaffold.plugin_files import KINDS, LONGEST, plugin_name, write_plugin
from docs_commands import blocks, commands, plain_words
from scaffolds import armcal, files_of, install, need, page, run

NAME = "made_here"
MOST_LINES = {"two_link.py": 40, "gear_wave.py": 30, "soft_joint.py": 30, "total_station.py": 60, "worst_sector.py": 30}
MOST_LINES |= {"warming.py": 16}
"""Of files on the page, that an author writes for a component of their own."""
FEWEST_CHECKS = 8
RULES = (
    "--select",
    "E,F,W,I,UP,B,C4,SIM,RUF,PTH,N,D1",
    "--ignore",
    "D105,D107,N806",
    "--per-file-ignores",
    "test_*.py:D",
)
REGISTRY = discover()


def checked(folder: Path, *plugin: str, site: Path | None = None) -> None:
    """It is listed, keeps the contract, and its tests pass."""
    ran = armcal("plugins", "check", NAME, "--json", *plugin, cwd=folder, site=site)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert json.loads(ran.stdout)["ran"] >= FEWEST_CHECKS
    tested = run(sys.executable, "-m", "pytest", cwd=folder, site=site)
    assert tested.returncode == 0, tested.stdout
    assert int(re.findall(r"(\d+) passed", tested.stdout)[0]) > 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_new_file_works(kind: str, tmp_path: Path) -> None:
    ran = armcal("new", "plugin", "made-here", "--kind", kind, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    folder = tmp_path / "armcal-made-here"
    assert sorted(path.name for path in folder.iterdir()) == [f"{NAME}.py", f"test_{NAME}.py"]
    checked(folder, "--plugin", f"{NAME}.py")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ("effect", "exporter"))
def test_a_new_package_installs_and_works(kind: str, tmp_path: Path) -> None:
    ran = armcal("new", "plugin", "made-here", "--kind", kind, "--package", cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    folder, site = tmp_path / "armcal-made-here", tmp_path / "site"
    install(folder, site)
    assert re.search(rf"{kind} +{NAME} ", armcal("plugins", "list", cwd=tmp_path, site=site).stdout)
    checked(folder, site=site)


@pytest.mark.parametrize("package", [False, True])
@pytest.mark.parametrize("name", ["a", "x" * LONGEST], ids=["shortest", "longest"])
@pytest.mark.slow
def test_it_is_clean_whatever_its_name(name: str, package: bool, tmp_path: Path) -> None:
    need("ruff")
    for kind in KINDS:
        write_plugin(plugin_name(name, REGISTRY), kind, tmp_path / kind, package)
    for command in (("check", *RULES), ("format", "--check")):
        for kind in KINDS:
            ruff = (sys.executable, "-m", "ruff", *command, "--no-cache", "--config", "line-length=120", ".")
            ran = run(*ruff, cwd=tmp_path / kind)
            assert ran.returncode == 0, ran.stdout


@pytest.mark.slow
def test_it_is_fully_typed(tmp_path: Path) -> None:
    need("mypy")
    for kind in KINDS:
        write_plugin(NAME, kind, tmp_path / kind)
        mypy = (sys.executable, "-m", "mypy", "--strict", "--ignore-missing-imports", f"{NAME}.py")
        ran = run(*mypy, "--cache-dir", str(tmp_path / "cache"), cwd=tmp_path / kind)
        assert ran.returncode == 0, ran.stdout


@pytest.mark.parametrize("kind", KINDS)
def test_no_file_is_written_that_is_not_needed(kind: str, tmp_path: Path) -> None:
    assert write_plugin(NAME, kind, tmp_path / "file") == (f"{NAME}.py", f"test_{NAME}.py")
    files = write_plugin(NAME, kind, tmp_path / "package", package=True)
    own = "armcal_made_here"
    assert set(files) == {"pyproject.toml", f"{own}/__init__.py", f"{own}/{kind}.py", f"tests/test_{NAME}.py"}
    for path in tmp_path.rglob("*.*"):
        if path.is_file():
            text = path.read_text(encoding="utf-8")
            assert "://" not in text and "{{" not in text and "{%" not in text, path


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


def test_the_page_shows_components_that_are_short() -> None:
    files = files_of(page("write_a_plugin.md"))
    lines = {name: sum(bool(line.strip()) for line in text.splitlines()) for name, text in files.items()}
    assert {name for name in files if name.endswith(".py")} == set(MOST_LINES)
    assert all(lines[name] < most for name, most in MOST_LINES.items()), lines


@pytest.mark.page
def test_the_page_is_done_word_for_word(tmp_path: Path) -> None:
    """An effect and a measurement, each one file that nobody packaged, from records to C code."""
    text = page("write_a_plugin.md")
    for name, content in files_of(text).items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    told = {}
    for block in (each for each in blocks(text) if each.kind == "console"):
        for command in commands(block):
            words = plain_words(command.text)
            ran = armcal(*words[1:], cwd=tmp_path) if words else run("bash", "-ec", command.text, cwd=tmp_path)
            assert bool(ran.returncode) == bool(command.refusal), f"{command.text}\n{ran.stdout}{ran.stderr}"
            for part in command.refusal.split("..."):
                assert part.strip() in ran.stderr
            told[command.text.split()[1]] = ran.stdout
    errors = json.loads((tmp_path / "runs/experiment/metrics.json").read_text(encoding="utf-8"))["error_mm"]
    assert errors["nominal"]["holdout"]["mean"] > 1, "though the station places the nominal arm, too"
    assert errors["calibrated"]["holdout"]["mean"] < 0.3
    assert "Was the arm at one temperature?" in told["checks"]
    study = json.loads((tmp_path / "runs/study/study.json").read_text(encoding="utf-8"))
    assert study["lowest"] == "with it"
    assert "mdh" in told["plugins"] and "kalman" not in told["plugins"]
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler is here to try the exported arm")
    made = run(compiler, "-std=c99", "arm.c", "arm_test.c", "-lm", "-o", "arm_test", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    tried = run(str(tmp_path / "arm_test"), cwd=tmp_path)  # against poses that armcal predicts, effect and all
    assert tried.returncode == 0, tried.stdout


@pytest.mark.slow
def test_a_changed_file_is_named_by_the_calibration_that_it_made(tmp_path: Path) -> None:
    """With the same predictions it goes on and says so; with others it is refused."""
    files = files_of(page("write_a_plugin.md"))
    for name, content in files.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    plugins = ("--plugin", "gear_wave.py", "--plugin", "total_station.py")
    assert armcal("simulate", "experiment.yaml", "--out", "records.csv", *plugins, cwd=tmp_path).returncode == 0
    assert armcal("run", "experiment.yaml", *plugins, cwd=tmp_path).returncode == 0
    predict = ("predict", "runs/experiment/calibration.yaml", "--poses", "poses.csv", "--out", "p.csv", *plugins)
    effect = files["gear_wave.py"]
    other = effect.replace("ca.cos(angle) - 1", "ca.cos(angle)")
    for change, refused in ((f"{effect}# a remark\n", False), (other, True)):
        (tmp_path / "gear_wave.py").write_text(change, encoding="utf-8")
        ran = armcal(*predict, cwd=tmp_path)
        assert (ran.returncode == 2) == refused, ran.stderr
        assert re.search("made with gear_wave.py sha256 [0-9a-f]{16}, now gear_wave.py sha256 [0-9a-f]{16}", ran.stderr)
