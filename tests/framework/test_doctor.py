"""``armcal doctor``: what it says where things work, and where libraries are poisoned, missing or too old."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from email.message import Message
from pathlib import Path
from typing import Any

import pytest
from armcal.cli.main import cli
from armcal.doctor import child, examination, libraries, machine
from armcal.doctor.child import Finding
from armcal.doctor.libraries import EXTRAS, LIBRARIES
from click.testing import CliRunner
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

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
    return done.returncode, {(f["section"], f["subject"]): f for f in told["findings"]}, done.stderr


@pytest.mark.slow
def test_poisoned_libraries_that_armcal_can_do_without_are_warnings(tmp_path: Path) -> None:
    code, found, _ = doctor(poisoned(tmp_path, cvxpy=RAISE, matplotlib=LEAVE), tmp_path)
    assert code == 0
    assert found["main job", "calibrate"]["state"] == "ok"
    assert found["main job", "calibrate"]["off_mm"] < 0.5
    for subject, cause in (("convex", "poisoned, on two lines"), ("figures", "SystemExit")):
        finding = found["extras", subject]
        assert finding["state"] == "warning"
        assert cause in finding["text"] and str(tmp_path) in finding["text"], "it names the file in the way"
        assert finding["hint"]
    assert found["plugins", "cvxpy"]["state"] == "warning"
    assert "estimator cvxpy" in found["plugins", "cvxpy"]["text"]
    assert found["plugins", "mdh"]["state"] == "ok"
    assert found["solvers", "IPOPT (in casadi)"]["state"] == "ok"
    assert found["solvers", "CLARABEL (in cvxpy)"]["state"] == "warning"
    if found["compiler", "C compiler"]["state"] == "ok":
        assert found["compiler", "C compiler"]["times_faster"] > 0


@pytest.mark.slow
def test_a_library_that_crashes_is_named_and_nothing_else_is_lost(tmp_path: Path) -> None:
    code, found, errors = doctor(
        poisoned(tmp_path, casadi=CRASH, cvxpy=RAISE, filterpy=RAISE, matplotlib=RAISE), tmp_path
    )
    assert code == 2
    assert found["libraries", "casadi"]["state"] == found["main job", "calibrate"]["state"] == "fault"
    assert "SIGSEGV" in found["libraries", "casadi"]["text"]
    assert "casadi" in errors and len(errors.strip().splitlines()) == 1
    assert found["libraries", "numpy"]["state"] == "ok"
    assert found["machine", "processors"]["usable"] >= 1


def told_by(**answers: dict[str, Any]) -> libraries.Ask:
    """An ``ask`` that answers at once."""
    usual: dict[str, dict[str, Any]] = {
        "imported": {"import_s": 0.1},
        "components": {
            "plugins": [{"name": "mdh", "distribution": "a 1", "fault": None, "components": 1, "broken": []}]
        },
        "convex": {"solvers": {"CLARABEL": "", "SCS": "singular"}},
        "kernel": {"times_faster": 9.0, "compile_s": 1.0},
        "calibration": {"off_mm": 0.01},
    }
    return lambda probe, *arguments, **more: {**usual, **answers}.get(probe, {})


def test_a_healthy_machine_has_no_faults_and_every_section() -> None:
    found = list(examination.examine(told_by()))
    assert examination.works(found)
    sections = [f.section for f in found]
    order = ["armcal", "libraries", "extras", "plugins", "solvers", "compiler", "bench", "machine", "main job"]
    assert list(dict.fromkeys(sections)) == order


@pytest.mark.parametrize("probe", ["imported", "components", "ipopt", "convex", "kalman", "kernel"])
def test_any_check_may_fail_and_the_others_are_told(probe: str) -> None:
    healthy = {(f.section, f.subject) for f in examination.examine(told_by())}
    found = list(examination.examine(told_by(**{probe: {"fault": "broken"}})))
    missing = healthy - {(f.section, f.subject) for f in found}
    assert {section for section, _ in missing} <= {"plugins", "solvers"}
    assert any("broken" in f.text for f in found)
    assert all(f.hint for f in found if f.state in ("warning", "fault"))


def test_one_solver_that_fails_is_told_and_matters_only_if_armcal_asks_for_it() -> None:
    found = {
        f.subject: f for f in examination.solvers(told_by(convex={"solvers": {"CLARABEL": "", "SCS": "singular"}}))
    }
    assert found["CLARABEL (in cvxpy)"].state == "ok" and found["SCS (in cvxpy)"].state == "note"
    found = {f.subject: f for f in examination.solvers(told_by(convex={"solvers": {"CLARABEL": "off", "SCS": ""}}))}
    assert found["CLARABEL (in cvxpy)"].state == "warning" and found["SCS (in cvxpy)"].state == "ok"


def test_a_calibration_that_fails_is_a_fault() -> None:
    assert not examination.works(examination.examine(told_by(calibration={"fault": "off by 3 mm"})))


def test_no_plugins_at_all_is_a_fault() -> None:
    assert [f.state for f in examination.plugins(told_by(components={"plugins": []}))] == ["fault"]


def test_a_check_that_raises_becomes_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks() -> Finding:
        raise ZeroDivisionError("inside")

    monkeypatch.setattr(machine, "processors", breaks)
    found = [f for f in examination.examine(told_by()) if f.subject == "processors"]
    assert [f.state for f in found] == ["warning"] and "ZeroDivisionError" in found[0].text


def test_requirements_are_read_as_metadata_writes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other names of a distribution, parts of it, ranges in brackets, and markers that leave some out here."""
    texts = [
        "numpy>=1.26",
        "a (>=1,<2)",
        'c>=1; python_version < "3"',
        "dask[distributed]>=2024.5; extra == 'test'",
        'types-PyYAML; extra == "dev"',
        "b>=1 ; python_version >= '3' and extra == 'test'",
        "d>=1 ; python_version < '3' and extra == 'test'",
    ]
    told = Message()
    told["Provides-Extra"], told["Provides-Extra"] = "test", "dev"
    monkeypatch.setattr(libraries.metadata, "requires", lambda name: texts)
    monkeypatch.setattr(libraries.metadata, "metadata", lambda name: told)
    always, extras = libraries.requirements()
    assert [(r.name, str(r.specifier)) for r in always] == [("numpy", ">=1.26"), ("a", "<2,>=1")]
    assert {name: [r.name for r in needed] for name, needed in extras.items()} == {
        "test": ["dask", "b"],
        "dev": ["types-PyYAML"],
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
    monkeypatch.setattr(libraries, "installed", lambda name: version)
    assert (libraries.library(Requirement(f"numpy{range_}"), told_by()).state == "ok") == admitted
    assert (libraries.extra("i2c", (Requirement(f"numpy{range_}"),), told_by()).state == "ok") == admitted


def test_every_library_and_extra_that_is_declared_says_what_it_is_for() -> None:
    always, extras = libraries.requirements()
    assert {canonicalize_name(r.name) for r in always} == set(LIBRARIES)
    assert set(extras) <= set(EXTRAS)


def test_too_old_a_library_is_a_warning_and_a_missing_one_a_fault() -> None:
    old = libraries.library(Requirement("numpy>=999"), told_by())
    assert old.state == "warning" and ">=999" in old.text and "pip install" in old.hint
    gone = libraries.library(Requirement("casadi-that-is-not-there>=1"), told_by(imported={"fault": "no"}))
    assert gone.state == "warning" and "not installed" in gone.text
    needed = libraries.library(Requirement("numpy>=1"), told_by(imported={"fault": "no"}))
    assert needed.state == "fault" and needed.hint


def test_a_missing_extra_says_what_it_is_for_and_how_to_get_it() -> None:
    found = libraries.extra("i2c", (Requirement("smbus2-that-is-not-there>=0.4"),), told_by())
    assert found.state == "note" and "I2C" in found.text and "armcal[i2c]" in found.hint


def test_a_hanging_check_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in poisoned(tmp_path, joblib="import time; time.sleep(60)").items():
        monkeypatch.setenv(name, value)
    assert "did not end" in child.ask("imported", "joblib", longest_s=1.0)["fault"]


def test_ports_are_listed_and_never_opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    port = tmp_path / "ttyUSB0"
    port.write_text("")
    monkeypatch.setattr(machine, "_files", lambda patterns: [str(port)] if "ttyUSB*" in patterns else [])
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [])
    monkeypatch.setattr(os, "open", lambda *given: pytest.fail("it opened something"))
    assert [f.state for f in machine.serial_ports()] == ["ok"]
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    (refused,) = machine.serial_ports()
    assert refused.state == "warning" and refused.hint


@pytest.mark.slow
def test_a_compiler_is_optional_and_its_faults_are_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    false = tmp_path / "cc"
    false.write_text('#!/bin/sh\necho "cc1: no such processor" >&2\nexit 3\n')
    false.chmod(0o755)
    monkeypatch.setenv("ARMCAL_CC", str(false))
    assert "no such processor" in child.ask("kernel")["fault"]
    monkeypatch.setattr(machine, "compiler_path", lambda: None)
    none = examination.compiler(told_by())
    assert none.state == "note" and "none is needed" in none.text


def test_a_cache_that_others_may_write_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ARMCAL_CACHE_DIR", str(tmp_path / "new" / "deep"))
    assert machine.cache().state == "ok"
    assert not (tmp_path / "new").exists()
    tmp_path.chmod(0o777)
    monkeypatch.setenv("ARMCAL_CACHE_DIR", str(tmp_path))
    assert machine.cache().state == "warning"
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ARMCAL_CACHE_DIR", str(tmp_path / "file"))
    assert machine.cache().state == "warning"


def test_it_speaks_to_people_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def said(*options: str, **answers: dict[str, Any]) -> Any:
        monkeypatch.setattr("armcal.cli.doctor.examine", lambda: examination.examine(told_by(**answers)))
        return CliRunner().invoke(cli, ["doctor", *options])

    healthy = said()
    assert healthy.exit_code == 0
    assert "Arms can be calibrated" in healthy.output or "Everything works" in healthy.output
    broken = said("-q", calibration={"fault": "off by 3 mm"}, kalman={"fault": "odd"})
    assert broken.exit_code == 2
    marks = {line.split()[0] for line in broken.stdout.splitlines() if not line.startswith(" ")}
    assert marks == {"FAIL", "warn"}
