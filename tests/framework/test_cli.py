"""The command line as a user meets it: exit codes, JSON, what a run leaves behind, interrupted runs."""

from __future__ import annotations

import csv
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from io import StringIO
from pathlib import Path

import forked
import numpy as np
import pytest
import yaml
from armcal.cli.common import Screen
from armcal.cli.main import cli
from click.testing import CliRunner, Result
from rich.table import Table

ROOT = Path(__file__).resolve().parents[2]
DEMO = str(ROOT / "configs" / "lrm_arm" / "demo.yaml")
FAST = ["--set", "validation.folds=0", "--set", "evaluator=interpreted"]
FEW = ["--set", "validation.folds=2"]


def armcal(*arguments: str) -> Result:
    """One command in this process."""
    return CliRunner().invoke(cli, list(arguments))


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """What a run of the shipped demonstration says, at length."""
    result = armcal("run", DEMO, "--out", str(tmp_path_factory.mktemp("demo") / "run"), "--json", "-v", *FEW)
    assert result.exit_code == 0, result.output
    return result


@pytest.fixture(scope="module")
def demo(said: Result) -> Path:
    """A finished run of the shipped demonstration."""
    return Path(json.loads(said.stdout)["folder"])


@pytest.mark.slow
def test_a_run_leaves_every_file_and_says_the_same_in_json(demo: Path) -> None:
    names = {path.name for path in demo.iterdir()}
    assert names == {
        "calibration.yaml",
        "experiment.yaml",
        "metrics.json",
        "report.html",
        "residuals.csv",
    }
    metrics = json.loads((demo / "metrics.json").read_text())
    for model in ("nominal", "calibrated"):
        for records in ("train", "holdout", "cross_validated"):
            assert set(metrics["error_mm"][model][records]) == {"mean", "rms", "p95", "max", "count"}
    assert metrics["parameters"]["free"] == metrics["parameters"]["rank"] == 28
    assert {"name", "status", "iterations", "seconds"} <= set(metrics["solver"])
    assert metrics["seconds"]["total"] > 0


def test_the_demonstration_finds_its_truth_within_its_intervals(demo: Path) -> None:
    """Judged by the shipped truth, which the fit never sees; 28 intervals of 95 %."""
    truth = yaml.safe_load((ROOT / "configs" / "lrm_arm" / "truth.yaml").read_text())
    found = {p["name"]: p for p in yaml.safe_load((demo / "calibration.yaml").read_text())["parameters"] if p["free"]}
    assert set(found) == set(truth)
    inside = [found[n]["lower"] <= float(text.split()[0]) <= found[n]["upper"] for n, text in truth.items()]
    assert sum(inside) >= 24
    assert all(p["sd"] > 0 for p in found.values())


def test_residuals_csv_agrees_with_the_metrics(demo: Path) -> None:
    rows = list(csv.DictReader((demo / "residuals.csv").open()))
    metrics = json.loads((demo / "metrics.json").read_text())["error_mm"]["calibrated"]
    for name in ("train", "holdout"):
        errors = [float(r["calibrated_mm"]) for r in rows if r["set"] == name]
        assert len(errors) == metrics[name]["count"]
        assert np.mean(errors) == pytest.approx(metrics[name]["mean"], abs=1e-5)
    lengths = [np.hypot(np.hypot(float(r["dx_mm"]), float(r["dy_mm"])), float(r["dz_mm"])) for r in rows]
    assert np.allclose(lengths, [float(r["calibrated_mm"]) for r in rows], atol=2e-6)


@pytest.fixture(scope="module")
def again(demo: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    """What a run of the experiment that was written down says."""
    out, data = tmp_path_factory.mktemp("again") / "run", ROOT / "configs" / "lrm_arm" / "demo.csv"
    result = armcal("run", str(demo / "experiment.yaml"), "--data", str(data), "--out", str(out), "--json")
    assert result.exit_code == 0, result.output
    return result


@pytest.mark.slow
def test_the_experiment_that_was_run_can_be_run_again(demo: Path, again: Result) -> None:
    first = json.loads((demo / "metrics.json").read_text())["error_mm"]
    second = json.loads(again.stdout)["error_mm"]
    for model in first:
        for records in first[model]:
            assert second[model][records] == pytest.approx(first[model][records], rel=1e-9)


def test_predictions_are_what_the_residuals_were_taken_from(demo: Path, tmp_path: Path) -> None:
    poses, out = ROOT / "configs" / "lrm_arm" / "demo.csv", tmp_path / "predicted.csv"
    result = armcal("predict", str(demo / "calibration.yaml"), "--poses", str(poses), "--out", str(out))
    assert result.exit_code == 0, result.output
    predicted = {r["pose_id"]: r for r in csv.DictReader(out.open())}
    measured = {r["pose_id"]: r for r in csv.DictReader(poses.open())}
    assert list(predicted) == list(measured)
    for row in csv.DictReader((demo / "residuals.csv").open()):
        for axis in "xyz":
            left = float(measured[row["pose_id"]][f"{axis}_mm"]) - float(predicted[row["pose_id"]][f"{axis}_mm"])
            assert left == pytest.approx(float(row[f"d{axis}_mm"]), abs=1e-6)


def test_the_shipped_measurements_are_what_the_shipped_simulation_makes(tmp_path: Path) -> None:
    out = tmp_path / "made.csv"
    assert armcal("simulate", DEMO, "--out", str(out)).exit_code == 0
    made = np.genfromtxt(out, delimiter=",", names=True)
    shipped = np.genfromtxt(ROOT / "configs" / "lrm_arm" / "demo.csv", delimiter=",", names=True)
    assert made.dtype.names == shipped.dtype.names
    for name in made.dtype.names:
        assert np.allclose(made[name], shipped[name], rtol=0, atol=1e-9), name


def test_check_solves_nothing_and_tells_rank_and_excitation() -> None:
    result = armcal("check", DEMO, "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["parameters"]["rank"] == 28 and told["equations"] == 450
    assert told["excitation_rad_or_m"]["arm.q2"]["levels"] == 3


@pytest.mark.slow
def test_an_earlier_run_is_kept_and_foreign_files_are_not_touched(demo: Path, tmp_path: Path) -> None:
    """And quiet says nothing."""
    folder = Path(shutil.copytree(demo, tmp_path / "run"))
    quiet = armcal("run", DEMO, "--out", str(folder), "-q", *FAST)
    assert (quiet.exit_code, quiet.stdout) == (0, "")
    assert (folder / "earlier" / "1" / "calibration.yaml").is_file()
    (folder / "measured_in_march.csv").write_text("mine")
    refused = armcal("run", DEMO, "--out", str(folder), *FAST)
    assert refused.exit_code == 2 and "measured_in_march.csv" in refused.output
    assert (folder / "measured_in_march.csv").read_text() == "mine"


@pytest.mark.slow
def test_a_fit_that_does_not_converge_ends_with_3_and_leaves_no_calibration(tmp_path: Path) -> None:
    for solver in ("ipopt", "cvxpy"):
        folder = tmp_path / solver
        few = ["--set", f"estimator.type={solver}", "--set", "estimator.max_iterations=1"]
        result = armcal("run", DEMO, "--out", str(folder), *FAST, *few)
        assert result.exit_code == 3, result.output
        assert "did not converge" in result.output
        assert not (folder / "calibration.yaml").exists()
        assert (folder / "calibration.yaml.not-converged").is_file()


def test_what_did_not_converge_cannot_be_used(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    armcal("run", DEMO, "--out", str(folder), *FAST, "--set", "estimator.max_iterations=1")
    poses, out = ROOT / "configs" / "lrm_arm" / "demo.csv", tmp_path / "p.csv"
    kept = str(folder / "calibration.yaml.not-converged")
    result = armcal("predict", kept, "--poses", str(poses), "--out", str(out))
    assert result.exit_code == 2 and not out.exists()
    assert "converge" in result.output


def test_a_calibration_that_was_edited_or_is_of_another_schema_is_refused_and_kept(demo: Path, tmp_path: Path) -> None:
    text = (demo / "calibration.yaml").read_text()
    poses, out = str(ROOT / "configs" / "lrm_arm" / "demo.csv"), str(tmp_path / "p.csv")
    broken = {
        "edited": text.replace("mass_kg: 0.1234", "mass_kg: 0.2234", 1),
        "schema": text.replace("armcal_calibration: 1", "armcal_calibration: 99", 1),
        "cut": text[: len(text) // 2],
        "other": "name: not a calibration\n",
    }
    for name, content in broken.items():
        path = tmp_path / f"{name}.yaml"
        assert content != text
        path.write_text(content)
        result = armcal("predict", str(path), "--poses", poses, "--out", out)
        assert result.exit_code == 2, (name, result.output)
        assert path.name in result.output and path.read_text() == content


def test_json_is_one_document(said: Result) -> None:
    assert json.loads(said.stdout)["folder"].endswith("run")


@pytest.mark.slow
def test_verbose_says_how_long_each_stage_took_and_plain_does_not(said: Result, again: Result) -> None:
    for word in ("fit: ", "build: ", "evaluated by: "):
        assert word in said.stderr and word not in again.stderr


def test_errors_are_json_too_where_json_was_asked_for() -> None:
    done = forked.armcal("check", "nowhere.yaml", "--json")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "nowhere.yaml" in json.loads(done.stdout)["error"]["message"]


@pytest.mark.parametrize(
    "moment", [1.1, *(pytest.param(moment, marks=pytest.mark.slow) for moment in (0.3, 0.7, 0.9, 1.3))]
)
def test_a_killed_run_leaves_the_earlier_calibration_whole(demo: Path, tmp_path: Path, moment: float) -> None:
    folder = Path(shutil.copytree(demo, tmp_path / "run"))
    before = (folder / "calibration.yaml").read_bytes()
    process = subprocess.Popen([sys.executable, "-m", "armcal.cli", "run", DEMO, "--out", str(folder), "-q"])
    time.sleep(moment)
    process.send_signal(signal.SIGKILL)
    process.wait()
    present = [p for p in (folder / "calibration.yaml", folder / "earlier" / "1" / "calibration.yaml") if p.exists()]
    assert any(p.read_bytes() == before for p in present)
    for path in present:
        assert yaml.safe_load(path.read_text())["armcal_calibration"] == 1
    assert armcal("run", DEMO, "--out", str(folder), "-q", *FAST).exit_code == 0


def test_ctrl_c_ends_a_long_fit_and_leaves_nothing_half_done(tmp_path: Path) -> None:
    """The solver's own library must not swallow the interrupt and let the next start go on."""
    long = ["run", DEMO, "--out", str(tmp_path / "run"), "--set", "estimator.starts=2000", *FAST]
    process = subprocess.Popen(
        [sys.executable, "-m", "armcal.cli", *long],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    _wait_for_fit(process)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130 and "stopped by Ctrl-C" in told and "Traceback" not in told
    assert not (tmp_path / "run" / "calibration.yaml").exists()


def _wait_for_fit(process: subprocess.Popen[str]) -> None:
    """Until IPOPT is loaded, which is when a fit begins, and a moment more."""
    ends, maps = time.monotonic() + 60, Path(f"/proc/{process.pid}/maps")
    while "ipopt" not in maps.read_text():
        assert process.poll() is None and time.monotonic() < ends, "no fit was begun"
        time.sleep(0.05)
    time.sleep(0.3)


@pytest.mark.slow
def test_a_missing_library_is_named_and_only_hurts_who_asks_for_it(tmp_path: Path) -> None:
    (tmp_path / "cvxpy.py").write_text("raise ModuleNotFoundError('No module named cvxpy', name='cvxpy')\n")
    runs = [["run", DEMO, "--out", str(tmp_path / name), *FAST] for name in ("cvxpy", "ipopt")]
    runs[0] += ["--set", "estimator.type=cvxpy"]
    script = (
        "from armcal.cli.main import cli\n"
        "from click.testing import CliRunner\n"
        f"for run in {runs!r}:\n"
        "    done = CliRunner().invoke(cli, run)\n"
        "    print(done.exit_code, 'needs the library cvxpy' in done.stderr, 'Traceback' in done.stderr)\n"
    )
    done = forked.run_code(script, path=tmp_path)
    assert done.stdout.splitlines() == ["2 True False", "0 False False"], done.stdout + done.stderr


def test_a_library_that_is_not_installed_is_named_with_the_extra_that_brings_it(tmp_path: Path) -> None:
    for name in ("cvxpy", "filterpy"):
        (tmp_path / f"{name}.py").write_text(f"raise ModuleNotFoundError('gone', name={name!r})\n")
    script = (
        "from armcal.cli.main import cli\n"
        "from armcal.plugins import discover\n"
        "from click.testing import CliRunner\n"
        f"done = CliRunner().invoke(cli, ['run', {DEMO!r}, '--out', 'x', '--set', 'estimator.type=cvxpy'])\n"
        "print(done.exit_code, done.stderr)\n"
        "try:\n    discover().find('online', 'extended').load()\n"
        "except Exception as fault:\n    print(fault)\n"
    )
    told = forked.run_code(script, path=tmp_path).stdout
    assert "2 armcal: the estimator 'cvxpy' needs the library cvxpy, which is not installed." in told
    assert "pip install 'armcal[convex]'" in told and "pip install 'armcal[online]'" in told and "Traceback" not in told


def test_a_demonstration_is_copied_out_and_calibrated_and_no_change_to_it_is_lost(tmp_path: Path) -> None:
    place = tmp_path / "here"
    done = CliRunner().invoke(cli, ["demo", "--out", str(place)])
    assert done.exit_code == 0 and "armcal predict" in done.output, done.output
    assert (place / "results" / "calibration.yaml").exists() and (place / "demo.csv").exists()
    assert CliRunner().invoke(cli, ["demo", "--out", str(place), "-q"]).exit_code == 0, "again"
    (place / "demo.yaml").write_text("name: mine\n")
    again = CliRunner().invoke(cli, ["demo", "--out", str(place)])
    assert again.exit_code == 2 and "was changed" in again.stderr
    assert (place / "demo.yaml").read_text() == "name: mine\n"
    wrong = CliRunner().invoke(cli, ["demo", "kuka"])
    assert wrong.exit_code == 2 and "lrm_arm" in wrong.stderr
    shown = CliRunner().invoke(cli, ["demo", "list", "--json"])
    assert json.loads(shown.stdout)["schema_version"] == 1 and "camera" in json.loads(shown.stdout)["demos"]


def test_a_misspelt_command_is_answered_with_the_nearest() -> None:
    ran = armcal("rnu")
    assert ran.exit_code == 2 and "No such command 'rnu'. Did you mean 'run'?" in ran.output
    ran = armcal("xyzzy")
    assert ran.exit_code == 2 and "Did you mean" not in ran.output


@pytest.mark.slow
def test_the_judging_of_a_run_shows_progress(tmp_path: Path) -> None:
    from armcal.run.experiment import Experiment
    from armcal.run.pipeline import calibrate

    seen: list[tuple[str, float]] = []
    config = Path(__file__).resolve().parents[2] / "configs" / "ball" / "demo.yaml"
    calibrate(Experiment.load(config), progress=lambda what, fraction: seen.append((what, fraction)))
    assert seen.index(("judging", 0.0)) < seen.index(("judging", 1.0))


def test_the_shell_completes_commands_without_importing_them() -> None:
    """A key press is answered at once: the names come from a table, and nothing heavy is imported."""
    script = (
        "import os, sys; os.environ.update(COMP_WORDS='armcal c', COMP_CWORD='1', _ARMCAL_COMPLETE='bash_complete')\n"
        "from armcal.cli.main import cli\n"
        "try: cli.main(prog_name='armcal')\n"
        "finally: print('heavy:', [name for name in ('numpy', 'casadi', 'pydantic') if name in sys.modules])\n"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    *offered, heavy = ran.stdout.splitlines()
    commands = ("check", "checks", "compensate", "calibration", "convert", "capability", "control")
    assert offered == [f"plain,{command}" for command in commands], ran.stderr
    assert heavy == "heavy: []"


def numbers_of(text: str) -> set[str]:
    return set(re.findall(r"\d+(?:\.\d+)?", re.sub(r"\(\d+\.\d s\)", "", text)))


@pytest.mark.parametrize("columns", [24, 40, 80])
@pytest.mark.parametrize("command", ["check", "run", "plan"])
@pytest.mark.slow
def test_a_narrow_terminal_gets_every_number_of_the_tables(command: str, columns: int, tmp_path: Path) -> None:
    more = {"plan": ["--poses", "12", "--set", "plan.starts=1"]}.get(command, [])
    out = [] if command == "check" else ["--out", str(tmp_path / "out.csv")]
    shown = []
    for width in (300, columns):
        arguments = [command, DEMO, *FAST, *more, *out]
        result = CliRunner().invoke(cli, arguments, env={"COLUMNS": str(width)})
        assert result.exit_code == 0, result.output
        shown.append(result.stdout)
    wide, narrow = shown
    assert "…" not in narrow
    assert numbers_of(wide) <= numbers_of(narrow)


def test_a_table_that_is_too_wide_is_a_list_of_its_rows() -> None:
    table = Table("servo", "deg", "backlash, deg", title="Pulses")
    table.add_row("q1", "-100", "0.12 +- 0.03")
    table.add_row("", "0", "")
    screen = Screen(width=14, file=StringIO())
    screen.print(table)
    expected = ["Pulses", "q1", "  deg: -100", "  backlash,", "  deg: 0.12 +-", "  0.03", "q1", "  deg: 0"]
    assert [line.rstrip() for line in screen.file.getvalue().splitlines()] == expected
    wide = Screen(width=60, file=StringIO())
    wide.print(table)
    assert any(
        all(cell in line for cell in ("q1", "-100", "0.12 +- 0.03")) for line in wide.file.getvalue().splitlines()
    )
