"""``armcal control DIR rollback`` after the end, however that came: the estimate of then, nothing lost."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml
from armcal.cli.main import cli
from click.testing import CliRunner, Result
from recalibrations import taken

ROOT = Path(__file__).resolve().parents[2]
POSES = ROOT / "configs" / "lrm_arm" / "demo.csv"
GOOD, SLIPPED = 40, 12
SLIP_DEG = 9.0


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def command(demo_calibration: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A recalibration without a compiler, whose third joint slips after 40 records."""
    folder = tmp_path_factory.mktemp("poses")
    header, *rows = POSES.read_text().splitlines()
    names, lines = header.split(","), []
    for i, row in enumerate(rows[: GOOD + SLIPPED]):
        cells = row.split(",")
        if i >= GOOD:
            cells[names.index("q3_deg")] = str(float(cells[names.index("q3_deg")]) - SLIP_DEG)
        lines.append(",".join([*cells, str(1.9e9 + 60 * i)]))
    (folder / "poses.csv").write_text("\n".join([f"{header},time_s", *lines]) + "\n")
    (folder / "online.yaml").write_text("evaluator: interpreted\n")
    given = ("recalibrate", demo_calibration, "--from", folder / "poses.csv", "--config", folder / "online.yaml")
    return [*map(str, given), "--out"]


@pytest.fixture(scope="module")
def ended(command: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its folder after the end."""
    folder = tmp_path_factory.mktemp("ended") / "out"
    done = armcal(*command, folder)
    assert done.exit_code == 0, done.output
    return folder


def events(folder: Path, kind: str) -> list[dict[str, Any]]:
    told = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    return [event for event in told if event["event"] == kind]


def written(path: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load(path.read_text())
    return {key: value for key, value in loaded.items() if key != "created"}


def check_rolled_back(command: list[str], folder: Path, tmp_path: Path) -> dict[str, Any]:
    """Roll back to the last good record: what the records up to there make, apart from it, stands in the folder."""
    before, kept = taken(folder), written(folder / "calibration.yaml")
    done = armcal("control", folder, "rollback", "good")
    assert done.exit_code == 0, done.output
    reply: dict[str, Any] = json.loads(done.stdout)
    names = [e["id"] for e in events(folder, "record") if e["sequence"] <= reply["to"]]
    header, *rows = Path(command[3]).read_text().splitlines()
    (tmp_path / "until.csv").write_text("\n".join([header, *rows[: len(names)]]) + "\n")
    again = armcal(*[tmp_path / "until.csv" if part == command[3] else part for part in command], tmp_path / "until")
    assert again.exit_code == 0, again.output
    back = written(folder / "calibration.yaml")
    assert back == written(tmp_path / "until" / "calibration.yaml") and back["parameters"] != kept["parameters"]
    assert back["recalibrated"]["sequence"] == reply["to"] and back["recalibrated"]["level"] == "nominal"
    assert taken(folder) == before
    return reply


@pytest.mark.slow
def test_after_the_end_the_estimate_goes_back_to_the_last_good_record_and_forth_again(
    command: list[str], ended: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(ended, tmp_path / "out")
    slip = events(folder, "decision")[0]
    assert slip["kind"].startswith("joint") and slip["since_id"] == events(folder, "record")[GOOD]["id"]
    end = written(folder / "calibration.yaml")
    reply = check_rolled_back(command, folder, tmp_path)
    assert reply["to"] == slip["last_good"]["sequence"] and reply["level"] == "nominal"
    assert f"record {slip['last_good']['id']} (2030-03-17" in reply["sentence"]
    back = events(folder, "decision")[-1]
    assert back["kind"] == "rollback" and back["do"] and json.loads((folder / "status.json").read_text())["finished"]
    assert armcal("predict", folder / "calibration.yaml", "--poses", POSES, "--out", tmp_path / "p.csv").exit_code == 0
    assert armcal("control", folder, "rollback", reply["before"]).exit_code == 0
    assert written(folder / "calibration.yaml") == end
    assert (
        json.loads(armcal("control", folder, "rollback", "record", slip["last_good"]["id"]).stdout)["to"] == reply["to"]
    )
    assert armcal("control", folder, "status").exit_code == 0


@pytest.mark.slow
def test_after_a_kill_too(command: list[str], ended: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    tail = subprocess.Popen(["tail", "-n", "+1", "-F", command[3]], stdout=subprocess.PIPE)
    started = [sys.executable, "-m", "armcal.cli", *command[:3], "-", *command[4:], str(folder)]
    process = subprocess.Popen(started, stdin=tail.stdout, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 120
        while not (folder / "journal.sqlite").exists() or len(taken(folder)) < GOOD + SLIPPED:
            assert time.monotonic() < deadline and process.poll() is None
            time.sleep(0.2)
    finally:
        for part in (process, tail):
            part.send_signal(signal.SIGKILL)
            part.wait()
    assert (folder / "control.sock").exists()  # nobody took it away
    reply = check_rolled_back(command, folder, tmp_path)
    assert reply["to"] == events(ended, "decision")[0]["last_good"]["sequence"]


@pytest.mark.slow
def test_what_cannot_be_rolled_back_is_refused_and_nothing_changes(ended: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(ended, tmp_path / "out")
    before, kept = taken(folder), {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    for to, words in (
        ("99999", "99999"),
        ("1.5", "rollback good"),
        ("", "rollback good"),
        ("best", "rollback good"),
        ("record", "rollback good"),
    ):
        refused = armcal("control", folder, "rollback", *filter(None, [to]))
        assert refused.exit_code == 2 and words in refused.stderr and "Traceback" not in refused.output
    assert taken(folder) == before
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == kept
    (tmp_path / "empty").mkdir()
    for nowhere in (tmp_path / "empty", tmp_path / "none"):
        refused = armcal("control", nowhere, "rollback", "good")
        assert refused.exit_code == 2 and "there is no journal" in refused.stderr
