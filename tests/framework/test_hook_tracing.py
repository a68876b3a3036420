"""ARMCAL_TRACE_HOOKS: each hook call on a line of its own, and never among the results."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import forked
import pytest
import yaml
from armcal.errors import ConfigError
from armcal.hook_trace import VARIABLE
from armcal.plugins import PluginRegistry, discover

LINE = re.compile(r"armcal hook (\w+)\((.*)\): (no listener|.* [0-9.]+ ms(, raised \w+)?(; all [0-9.]+ ms)?)")
OBSERVER = """
from armcal.hooks import hookimpl

@hookimpl
def armcal_run_started(name):
    {body}

@hookimpl
def armcal_run_ended(folder, converged):
    pass
"""


def observers(monkeypatch: pytest.MonkeyPatch, site: Path, asked: str, **bodies: str) -> PluginRegistry:
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv(VARIABLE, asked)
    for name, body in bodies.items():
        (site / f"traced_{name}.py").write_text(OBSERVER.format(body=body), encoding="utf-8")
        monkeypatch.delitem(sys.modules, f"traced_{name}", raising=False)
    return discover([EntryPoint(name, f"traced_{name}", "armcal") for name in bodies])


def test_answers_are_listed_in_the_order_in_which_they_came(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bodies = {name: f"import builtins; builtins.traced_order.append({name!r})" for name in ("b", "c", "a")}
    order: list[str] = []
    monkeypatch.setattr("builtins.traced_order", order, raising=False)
    registry = observers(monkeypatch, tmp_path, "1", **bodies)
    registry.notify("armcal_run_started", name="one", records=3)
    told = capsys.readouterr()
    assert told.out == ""
    (line,) = told.err.splitlines()
    assert LINE.fullmatch(line)
    assert line.startswith("armcal hook armcal_run_started(name='one', records=3): ")
    assert sorted(order) == ["a", "b", "c"]
    assert re.findall(r"(\w) \(traced_\w\) [0-9.]+ ms", line) == order


def test_what_raised_is_told_and_stops_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    registry = observers(monkeypatch, tmp_path, "1", bad="raise ValueError('no')", good="pass")
    faults = registry.notify("armcal_run_started", name="one", records=3)
    assert faults == ["plugin bad (traced_bad): armcal_run_started raised ValueError: no."]
    line = capsys.readouterr().err
    assert "bad (traced_bad)" in line
    assert "raised ValueError" in line
    assert "good (traced_good)" in line


def test_a_file_is_appended_to_and_standard_error_stays_empty(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "hooks.log"
    path.write_text("what was there\n", encoding="utf-8")
    registry = observers(monkeypatch, tmp_path, str(path), one="pass")
    registry.notify("armcal_run_ended", name="n", folder="x" * 200, converged=True)
    registry.notify("armcal_record_rejected", row=1, record_id="r", reason="torn")
    first, ended, rejected = path.read_text(encoding="utf-8").splitlines()
    assert first == "what was there"
    assert LINE.fullmatch(ended)
    assert "..." in ended, "a long argument is told in short"
    assert len(ended) < 250
    assert rejected == "armcal hook armcal_record_rejected(row=1, record_id='r', reason='torn'): no listener"
    assert capsys.readouterr().err == ""


def test_a_large_argument_is_told_by_its_type(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Large:
        def __repr__(self) -> str:
            raise AssertionError("it is not to be written out")

    registry = observers(monkeypatch, tmp_path, "1", one="pass")
    registry.notify("armcal_estimate_changed", estimate=Large())
    assert "armcal_estimate_changed(estimate=<Large>): no listener" in capsys.readouterr().err


@pytest.mark.parametrize("asked", ["", "0", None])
def test_nothing_is_traced_unless_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str], asked: str | None
) -> None:
    registry = observers(monkeypatch, tmp_path, asked or "", one="pass")
    if asked is None:
        monkeypatch.delenv(VARIABLE)
        registry = discover([])
    registry.notify("armcal_run_started", name="one", records=3)
    assert capsys.readouterr().err == ""


def test_the_variable_is_read_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    registry = observers(monkeypatch, tmp_path, "1", one="pass")
    monkeypatch.setenv(VARIABLE, "0")
    registry.notify("armcal_run_started", name="one", records=3)
    assert "armcal_run_started" in capsys.readouterr().err


@pytest.mark.parametrize("asked", ["/no/such/folder/hooks.log", ".", "a\0b"])
def test_a_file_that_cannot_be_written_is_refused(monkeypatch: pytest.MonkeyPatch, asked: str) -> None:
    monkeypatch.setattr(os, "environ", {**os.environ, VARIABLE: asked})
    with pytest.raises(ConfigError, match=r"ARMCAL_TRACE_HOOKS: found .* cannot be written"):
        discover([])


def armcal(*arguments: str, cwd: Path, trace: str) -> subprocess.CompletedProcess[str]:
    return forked.armcal(*arguments, cwd=cwd, environment={VARIABLE: trace, "ARMCAL_CC": "none", "COLUMNS": "1000"})


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small experiment with its measurements."""
    folder = tmp_path_factory.mktemp("traced")
    rows = [{"a_mm": 200, "alpha_deg": 90}, {"a_mm": 100}]
    levels = {"q1": [-50, -10, 30, 60], "q2": [-40, 0, 20, 70]}
    content = {
        "name": "traced",
        "arms": {"arm": {"model": {"type": "mdh", "convention": "standard", "rows": rows}}},
        "statics": {"gravity_m_s2": [0, 0, -9.81], "payload_g": 0},
        "measurements": {"tracker": {"type": "tip_position", "noise_mm": 0.1}},
        "data": {"type": "csv", "path": "data.csv"},
        "simulation": {"type": "elastic_arm", "truth": "truth.yaml", "poses": {"count": 12, "levels_deg": levels}},
        "parameters": {"free": ["arm.mdh.a?"]},
    }
    (folder / "experiment.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    (folder / "truth.yaml").write_text("arm.mdh.a1: 201 mm\n", encoding="utf-8")
    made = armcal("simulate", "experiment.yaml", "--out", "data.csv", cwd=folder, trace="")
    assert made.returncode == 0, made.stderr
    return folder


@pytest.mark.slow
def test_json_on_standard_output_is_not_spoilt(measured: Path) -> None:
    command = ("run", "experiment.yaml", "--out", "result", "--json", "--set", "validation.folds=0")
    ran = armcal(*command, cwd=measured, trace="1")
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout)
    assert "armcal hook" not in ran.stdout
    lines = [line for line in ran.stderr.splitlines() if line.startswith("armcal hook")]
    assert all(LINE.fullmatch(line) for line in lines)
    called = [LINE.fullmatch(line)[1] for line in lines]  # type: ignore[index]
    assert {"armcal_register_models", "armcal_run_started", "armcal_estimate_changed"} <= set(called)
    assert called[-1] == "armcal_run_ended"
    assert any("mdh (armcal_mdh.plugin)" in line for line in lines)


def test_a_run_without_tracing_says_the_same_on_standard_output(measured: Path) -> None:
    plain, traced = (
        armcal("plugins", "list", "--json", cwd=measured, trace=trace) for trace in ("", str(measured / "hooks.log"))
    )
    assert plain.stdout == traced.stdout
    assert traced.stderr == ""
    written = (measured / "hooks.log").read_text(encoding="utf-8").splitlines()
    assert len(written) > 12
    assert all(LINE.fullmatch(line) for line in written)


def test_the_command_line_refuses_a_file_that_cannot_be_written(measured: Path) -> None:
    ran = armcal("plugins", "list", cwd=measured, trace=str(measured))
    assert ran.returncode == 2
    assert ran.stderr.startswith("armcal: ARMCAL_TRACE_HOOKS: found ")
    assert "Traceback" not in ran.stderr
    assert ran.stdout == ""
