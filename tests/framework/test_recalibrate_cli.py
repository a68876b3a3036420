"""The command ``armcal recalibrate`` as a user meets it: its events, exit codes, kills that change nothing."""

from __future__ import annotations

import json
import random
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
from armcal_online.commands import ask
from click.testing import CliRunner, Result

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "configs" / "lrm_arm" / "demo.yaml"
POSES = DEMO.with_suffix(".csv")


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def calibration(demo_calibration: Path) -> Path:
    """The demonstration's."""
    return demo_calibration


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Without a compiler."""
    path = tmp_path_factory.mktemp("config") / "online.yaml"
    path.write_text("evaluator: interpreted\noutput: {calibration_every_records: 100000}\n")
    return path


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some of the demonstration's poses, with times: what is estimated hangs on nothing else then."""
    path = tmp_path_factory.mktemp("poses") / "poses.csv"
    header, *rows = POSES.read_text().splitlines()[:81]
    path.write_text("\n".join([f"{header},time_s", *(f"{row},{60 * i}" for i, row in enumerate(rows))]) + "\n")
    return path


@pytest.fixture(scope="module")
def whole(calibration: Path, config: Path, poses: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recalibrated without interruption."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    done = armcal("recalibrate", calibration, "--from", poses, "--config", config, "--out", folder)
    assert done.exit_code == 0, done.output
    (folder / "stdout").write_text(done.stdout)
    return folder


def estimate(folder: Path) -> Any:
    return yaml.safe_load((folder / "calibration.yaml").read_text())["parameters"]


@pytest.mark.parametrize(
    ("estimator", "says"),
    [
        (
            "{type: extended, iteratons: 3}",
            "estimator.iteratons: found the unknown key 'iteratons': did you mean",
        ),
        ("{iterations: 3}", "estimator: found no type of an online estimator"),
        ("{type: extendd}", "Did you mean 'extended'?"),
    ],
)
def test_an_estimator_that_is_none_is_refused(calibration: Path, tmp_path: Path, estimator: str, says: str) -> None:
    config = tmp_path / "online.yaml"
    config.write_text(f"estimator: {estimator}\n")
    done = armcal("recalibrate", calibration, "--from", POSES, "--config", config, "--out", tmp_path / "out")
    assert done.exit_code == 2 and says in done.stderr


@pytest.mark.slow
def test_the_stream_is_json_lines_and_the_calibration_can_be_used(whole: Path, tmp_path: Path) -> None:
    told = [json.loads(line) for line in (whole / "stdout").read_text().splitlines()]
    assert told == [json.loads(line) for line in (whole / "events.jsonl").read_text().splitlines()]
    assert told[0]["event"] == "started" and told[-1]["event"] == "finished"
    records = [event for event in told if event["event"] == "record"]
    assert len(records) == 80 and sum(event["verdict"] == "accepted" for event in records) >= 75
    assert json.loads((whole / "status.json").read_text())["counts"]["accepted"] >= 75
    out = tmp_path / "predicted.csv"
    assert armcal("predict", whole / "calibration.yaml", "--poses", POSES, "--out", out).exit_code == 0


@pytest.mark.slow
def test_kills_of_the_whole_command_change_no_bit(
    calibration: Path, config: Path, poses: Path, whole: Path, tmp_path: Path
) -> None:
    random_, folder = random.Random(4), tmp_path / "out"
    arguments = ["recalibrate", calibration, "--from", poses, "--config", config, "--out", folder]
    for _ in range(3):
        command = [sys.executable, "-m", "armcal.cli", *map(str, arguments)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stdout is not None
        for _ in range(random_.randint(2, 30)):
            process.stdout.readline()
        time.sleep(random_.uniform(0, 0.01))
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert armcal(*arguments, "-q").output == ""
    assert estimate(folder) == estimate(whole)
    shutil.copy(folder / "calibration.yaml", tmp_path / "again.yaml")
    again = armcal("recalibrate", tmp_path / "again.yaml", "--from", poses, "--config", config, "--out", folder)
    assert again.exit_code == 2 and "begun with another calibration" in again.output


@pytest.mark.slow
def test_fifty_kills_at_any_moment_of_a_long_run_change_no_bit(calibration: Path, config: Path, tmp_path: Path) -> None:
    """Of 6,000 records, in starting, in reading, in writing: the command takes about as long as all kills together.

    They come through ``tail``, which begins again with the first one each time; in the end the file itself is read.
    """
    header, *rows = POSES.read_text().splitlines()
    many = [f"{turn}x{row},{60 * (200 * turn + i)}" for turn in range(30) for i, row in enumerate(rows)]
    poses = tmp_path / "poses.csv"
    poses.write_text("\n".join([f"{header},time_s", *many]) + "\n")
    arguments = ["recalibrate", calibration, "--from", poses, "--config", config, "-q", "--out"]
    assert armcal(*arguments, tmp_path / "whole").exit_code == 0
    random_, folder = random.Random(7), tmp_path / "killed"
    for _ in range(50):
        tail = subprocess.Popen(["tail", "-n", "+1", "-F", poses], stdout=subprocess.PIPE)
        piped = ["-" if argument is poses else str(argument) for argument in arguments]
        command = [sys.executable, "-m", "armcal.cli", *piped, str(folder)]
        process = subprocess.Popen(command, stdin=tail.stdout)
        time.sleep(random_.uniform(0.5, 2.5))
        assert process.poll() is None
        for part in (process, tail):
            part.send_signal(signal.SIGKILL)
            part.wait()
    assert armcal(*arguments, folder).exit_code == 0
    assert estimate(folder) == estimate(tmp_path / "whole")


@pytest.mark.slow
def test_a_running_command_is_asked_and_told(calibration: Path, config: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    command = ["recalibrate", calibration, "--from", "-", "--config", config, "--out", folder]
    process = subprocess.Popen(
        [sys.executable, "-m", "armcal.cli", *map(str, command)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdin is not None and process.stdout is not None
    assert json.loads(process.stdout.readline())["event"] == "started"
    process.stdin.write(b"\n".join(POSES.read_bytes().splitlines()[:12]) + b"\nnonsense\n")
    process.stdin.flush()
    verdicts = []
    while len(verdicts) < 12:
        event = json.loads(process.stdout.readline())
        verdicts += [event["verdict"]] if event["event"] == "record" else []
    assert verdicts[-1] == "ignored" and verdicts.count("accepted") >= 9
    assert ask(folder, {"command": "status"})["records"] == 12
    assert armcal("control", folder, "finish").exit_code == 0
    _, wrong = process.communicate(timeout=30)
    assert process.returncode == 0 and wrong == b""


def test_bad_input_ends_with_2_and_leaves_nothing(calibration: Path, config: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    (tmp_path / "bad.yaml").write_text("gaet: {}\n")
    (tmp_path / "file").write_text("mine")
    good = {"calibration": calibration, "--from": POSES, "--config": config, "--out": tmp_path / "out"}
    for name, value, expected in (
        ("calibration", tmp_path / "bad.yaml", "schema"),
        ("calibration", tmp_path / "gone.yaml", "gone.yaml"),
        ("--from", tmp_path / "bad.csv", "bad.csv:1"),
        ("--from", tmp_path / "gone.csv", "or a CSV file"),
        ("--from", "udp:70000", "or a CSV file"),
        ("--config", tmp_path / "bad.yaml", "gate"),
        ("--out", tmp_path / "file", "file"),
    ):
        first, *others = {**good, name: value}.items()
        done = armcal("recalibrate", first[1], *(part for pair in others for part in pair))
        assert done.exit_code == 2 and expected in done.stderr and done.stdout == "", (value, done.output)
        assert isinstance(done.exception, SystemExit) and not (tmp_path / "out").exists()
