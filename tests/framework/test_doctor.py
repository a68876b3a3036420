"""``armcal doctor``: what it says where things work, and where libraries are poisoned, missing or too old."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from email.message import Message
from pathlib import Path
from typing import Any

import pytest
from armcal import plugins
from armcal.cli import doctor as module
from armcal.cli.doctor import EXTRAS, Finding, components, examine, in_child, look_at
from armcal.cli.main import cli
from click.testing import CliRunner, Result
from packaging.requirements import Requirement

CRASH = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"
LEAVE = "import sys; print('gone'); sys.exit(7)"
RAISE = "raise RuntimeError('poisoned,\\non two lines')"


def poisoned(place: Path, **modules: str) -> dict[str, str]:
    """An environment in which these modules are found before the real ones."""
    for name, text in modules.items():
        (place / f"{name}.py").write_text(text)
    return {**os.environ, "PYTHONPATH": str(place)}


def doctor(environment: dict[str, str], place: Path) -> tuple[int, dict[tuple[str, str], dict[str, Any]], str]:
    """The command in a process of its own: exit code, findings by section and subject, standard error."""
    command = [sys.executable, "-c", "from armcal.cli.main import main; main()", "doctor", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=place, timeout=300, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    told = json.loads(done.stdout)
    assert told["works"] == (done.returncode == 0)
    assert all(set(f) == {"section", "subject", "state", "text", "hint"} for f in told["findings"])
    return done.returncode, {(f["section"], f["subject"]): f for f in told["findings"]}, done.stderr


@pytest.mark.slow
def test_poisoned_libraries_that_armcal_can_do_without_are_warnings(tmp_path: Path) -> None:
    code, found, _ = doctor(poisoned(tmp_path, cvxpy=RAISE, matplotlib=LEAVE), tmp_path)
    assert code == 0
    assert found["main job", "calibrate"]["state"] == "ok"
    for subject, cause in (("convex", "poisoned, on two lines"), ("figures", "ended with 7")):
        finding = found["extras", subject]
        assert finding["state"] == "warning"
        assert cause in finding["text"] and str(tmp_path) in finding["text"], "it names the file in the way"
        assert finding["hint"]
    assert found["plugins", "cvxpy"]["state"] == "warning"
    assert "estimator 'cvxpy'" in found["plugins", "cvxpy"]["text"]
    assert found["plugins", "mdh"]["state"] == "ok"


@pytest.mark.slow
def test_a_library_that_crashes_is_named_and_nothing_else_is_lost(tmp_path: Path) -> None:
    code, found, errors = doctor(poisoned(tmp_path, casadi=CRASH, cvxpy=RAISE), tmp_path)
    assert code == 2
    assert found["main job", "calibrate"]["state"] == "fault" and found["libraries", "casadi"]["state"] == "warning"
    assert "Segmentation fault" in found["libraries", "casadi"]["text"]
    assert "casadi" in errors and len(errors.strip().splitlines()) == 1
    assert found["libraries", "numpy"]["state"] == "ok"


PLUGINS = json.dumps([["plugins", "mdh", "ok", "(a 1) components: 1", ""]])


def told_by(monkeypatch: pytest.MonkeyPatch, **faults: str) -> dict[tuple[str, str], Finding]:
    """What is found where processes answer at once; ``faults`` by a word of what each is to do."""

    def answer(code: str, *arguments: str) -> tuple[str, str]:
        if fault := next((text for word, text in faults.items() if word in code), ""):
            return "", fault
        return PLUGINS, ""

    monkeypatch.setattr(module, "in_child", answer)
    return {(f.section, f.subject): f for f in examine()}


def faults(found: dict[tuple[str, str], Finding]) -> list[str]:
    return [subject for (_, subject), finding in found.items() if finding.state == "fault"]


def test_a_healthy_machine_has_no_faults_and_every_section(monkeypatch: pytest.MonkeyPatch) -> None:
    found = told_by(monkeypatch)
    assert faults(found) == []
    sections = [section for section, _ in found if section != "bench"]
    assert list(dict.fromkeys(sections)) == ["armcal", "libraries", "extras", "plugins", "compiler", "main job"]


@pytest.mark.parametrize("word", ["import numpy", "components", "compiler", "main"])
def test_any_check_may_fail_and_the_others_are_told(word: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = told_by(monkeypatch, **{word: "broken"})
    assert set(told_by(monkeypatch)) - set(found) <= {("plugins", "mdh")}
    assert faults(found) == (["calibrate"] if word == "main" else [])
    assert word != "import numpy" or found["libraries", "numpy"].state == "warning"
    assert word == "compiler" or any("broken" in f.text for f in found.values())
    assert all(f.hint for f in found.values() if f.state in ("warning", "fault"))


def test_armcal_that_is_not_installed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise plugins.metadata.PackageNotFoundError(name)

    for read in ("version", "requires"):
        monkeypatch.setattr(plugins.metadata, read, missing)
    found = told_by(monkeypatch)
    itself = found["libraries", "armcal"]
    assert itself.state == "warning" and "not installed" in itself.text and "pip install -e ." in itself.hint


def test_requirements_are_read_as_metadata_writes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other names of a distribution, parts of it, ranges in brackets, and markers that leave some out here."""
    texts = [
        "numpy>=1.26",
        "a (>=1,<2)",
        'c>=1; python_version < "3"',
        "dask[distributed]>=2024.5; extra == 'x'",
        'types-PyYAML; extra == "y"',
        "b>=1 ; python_version >= '3' and extra == 'x'",
        "d>=1 ; python_version < '3' and extra == 'x'",
    ]
    told = Message()
    told["Provides-Extra"], told["Provides-Extra"], told["Provides-Extra"] = "x", "y", "dev"
    monkeypatch.setattr(plugins.metadata, "requires", lambda name: texts)
    monkeypatch.setattr(plugins.metadata, "metadata", lambda name: told)
    needs = plugins.requirements()
    assert [(r.name, str(r.specifier)) for r in needs.pop("")] == [("numpy", ">=1.26"), ("a", "<2,>=1")]
    assert {name: [r.name for r in needed] for name, needed in needs.items()} == {
        "x": ["dask", "b"],
        "y": ["types-PyYAML"],
    }


@pytest.mark.parametrize(
    ("version", "range_", "admitted"),
    [
        ("1.9", ">=1.10", False),
        ("1.10", ">=1.9,<2", True),
        ("1.10.0", "==1.10", True),
        ("2.0", "!=2.0", False),
        ("2.0.0rc1", ">=1.9", True),
        ("1.26.4", "~=1.9", True),
        ("2", "~=1.9", False),
        ("0.9", "", True),
    ],
)
def test_versions_are_compared_with_the_range(
    monkeypatch: pytest.MonkeyPatch, version: str, range_: str, admitted: bool
) -> None:
    monkeypatch.setattr(module, "in_child", lambda *given: ("loaded", ""))
    monkeypatch.setattr(module.metadata, "version", lambda name: version)
    state, text, hint = look_at(Requirement(f"numpy{range_}"))
    assert state == ("ok" if admitted else "warning")
    assert admitted or (version in text and "pip install" in hint)


def test_every_extra_that_is_declared_says_what_it_is_for() -> None:
    declared = plugins.requirements()
    assert set(declared) - {"", "all"} == set(EXTRAS)
    assert {"numpy", "casadi"} <= {r.name for r in declared[""]}


def test_a_missing_library_is_a_warning_and_a_missing_extra_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    gone = [Requirement("not-there>=1")]
    monkeypatch.setattr(module, "requirements", lambda: {"": gone, "i2c": gone, "ros2": [Requirement("numpy>=999")]})
    found = told_by(monkeypatch)
    library, extra, old = (found[key] for key in (("libraries", "not-there"), ("extras", "i2c"), ("extras", "ros2")))
    assert library.state == "warning" and "not installed" in library.text and "pip install" in library.hint
    assert extra.state == "note" and "I2C" in extra.text and "armcal[i2c]" in extra.hint
    assert old.state == "warning" and ">=999" in old.text and "pip install" in old.hint


def test_plugins_are_told_by_what_does_not_load(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A broken component is a warning, one whose extra is missing a note."""
    monkeypatch.setitem(sys.modules, "cvxpy", None)  # as if it were not installed
    monkeypatch.delitem(sys.modules, "armcal_cvxpy.estimator", raising=False)
    registry = module.discover()
    few = [c for c in registry.components if c.plugin in ("cvxpy", "mdh", "poe")]
    few = [replace(c, target="nowhere_at_all:Model") if c.plugin == "mdh" else c for c in few]
    monkeypatch.setattr(module, "discover", lambda: replace(registry, components=tuple(few)))
    components()
    found = {name: (state, text, hint) for _, name, state, text, hint in json.loads(capsys.readouterr().out)}
    assert found["cvxpy"][0] == "note" and "armcal[convex]" in found["cvxpy"][1]
    state, text, hint = found["mdh"]
    assert state == "warning" and "nowhere" in text and hint
    assert found["poe"][0] == "ok" and found["poe"][1].endswith("components: 1")


def test_a_hanging_check_is_ended() -> None:
    assert "did not end" in in_child("import time; time.sleep(60)", longest_s=1.0)[1]


@pytest.mark.parametrize(
    ("code", "fault"),
    [(CRASH, "crashed (Segmentation fault)"), (LEAVE, "ended with 7"), ("pass", "no answer"), (RAISE, "poisoned, on")],
)
def test_a_process_that_fails_in_any_way_is_told_in_one_line(code: str, fault: str) -> None:
    out, told = in_child(f"exec({code!r})")
    assert out == "" and fault in told and "\n" not in told


def test_it_speaks_to_people_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def said(**answers: str) -> Result:
        told_by(monkeypatch, **answers)
        return CliRunner().invoke(cli, ["doctor"])

    healthy = said()
    assert healthy.exit_code == 0
    assert "Everything works." in healthy.output
    assert "what does not work: joblib." in said(**{"import joblib": "broken"}).output
    broken = said(main="off by 3 mm", components="odd")
    assert broken.exit_code == 2
    assert "FAIL calibrate" in broken.stdout and "warn all plugins: cannot be loaded: odd" in broken.stdout
    assert "what does not work: all plugins, calibrate" in broken.stderr
