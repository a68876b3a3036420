"""``armcal servo`` as a user gives it: on the simulated bench, through its port and real datagrams; refusals."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest
import yaml
from armcal.cli.main import cli
from armcal.errors import DataError
from armcal.plugins import use_plugins
from armcal_bench.servo_setup import Record
from click.testing import CliRunner

from tests.bench_runs import AT_LINE, free_port, simulated_bench
from tests.servo_fakes import config_in

pytestmark = pytest.mark.slow

ARMCAL = [sys.executable, "-m", "armcal.cli"]
JOINTS = ("q3", "q5")


def armcal(*words):
    return CliRunner().invoke(cli, [*map(str, words)])


@contextmanager
def piped(text):
    """A pipe with these lines, and their end, as descriptor 0."""
    read, write = os.pipe()
    os.write(write, text.encode())
    os.close(write)
    before = os.dup(0)
    os.dup2(read, 0)
    os.close(read)
    try:
        yield
    finally:
        os.dup2(before, 0)
        os.close(before)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A running simulated bench and its configuration."""
    folder = tmp_path_factory.mktemp("servo")
    port = free_port()
    config = config_in(
        folder,
        "bench:\n"
        "  simulated: run\n"
        "  link: {type: framed, port: run/board}\n"
        f"  tracker: {{port: {port}}}\n"
        f"  simulator: {{type: servo_bench_at_line, tracker: {{port: {port}}}}}\n"
        f"  servo: {{joints: [{', '.join(JOINTS)}], step: 46 deg, period_s: 0.04}}\n",
    )
    use_plugins(AT_LINE)
    with simulated_bench(config, (), folder / "run"):
        yield config


def ask(config, request):
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(str(config.parent / "run" / "clock"))
        link.sendall(json.dumps(request).encode() + b"\n")
        return json.loads(link.makefile().readline())


@pytest.fixture(scope="module")
def calibrated(bench):
    """One calibration; what it said, and where it wrote."""
    out = bench.parent / "out"
    return armcal("servo", bench, "--out", out, "--yes", "--json"), out


def observed(out):
    try:
        return Record(out).entries
    except DataError:  # it was only just made
        return ()


@pytest.mark.slow
def test_interrupted_it_holds_and_keeps_what_it_measured(bench, tmp_path):
    words = ["servo", bench, "--out", tmp_path / "out", "--yes", "--keep"]
    first = subprocess.Popen([*ARMCAL, *map(str, words)], stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 60
    while len(observed(tmp_path / "out")) < 8 and time.monotonic() < until:
        time.sleep(0.02)
    first.send_signal(signal.SIGINT)
    said = first.communicate(timeout=60)[1]
    assert first.returncode == 4 and "The arm holds" in said
    kept = observed(tmp_path / "out")
    done = armcal(*words)
    assert done.exit_code == 0, done.stderr
    rows = observed(tmp_path / "out")
    assert rows[: len(kept)] == kept
    keys = [(r["joint"], r["counts"], r["came"]) for r in rows if r["kind"] == "pose"]
    assert len(keys) == len(set(keys)) and {k[0] for k in keys} == set(JOINTS)


@pytest.mark.slow
def test_it_finds_what_the_servos_truly_are(calibrated, bench):
    found = json.loads(calibrated[0].stdout)
    truth = yaml.safe_load((bench.parent / "bench_servos.yaml").read_text())
    longer = truth["boards"]["front"]["oscillator_hz"] / 25e6
    for joint in JOINTS:
        knots = found["servos"][joint]["knots"]
        true = [pulse * longer for pulse in truth["servos"][joint]["pulses_us"]]
        # The zero is kept, so that pulses count from it; two joints alone tell the springs only so well.
        spans = [knots[2]["pulse_us"] - knots[1]["pulse_us"], knots[1]["pulse_us"] - knots[0]["pulse_us"]]
        assert spans == pytest.approx([true[2] - true[1], true[1] - true[0]], abs=8.0)
        assert found["servos"][joint]["backlash_deg"] == pytest.approx(0.1, abs=0.05)


@pytest.mark.slow
def test_the_servo_file_is_written_and_the_one_before_is_kept(calibrated, bench):
    before = yaml.safe_load((bench.parent / "servos.yaml.before-1").read_text())
    after = yaml.safe_load((bench.parent / "servos.yaml").read_text())
    assert after["servos"]["q1"] == before["servos"]["q1"]
    assert after["servos"]["q3"]["pulses_us"] != before["servos"]["q3"]["pulses_us"]
    again = armcal("servo", bench, "--out", calibrated[1], "--yes", "--json")
    assert again.exit_code == 0, again.stderr
    assert json.loads(again.stdout)["before"] is None


def test_the_arm_was_never_unsafe(calibrated, bench):
    events = [json.loads(line) for line in (bench.parent / "run" / "safety.jsonl").read_text().splitlines()]
    assert {event["event"] for event in events} <= {"first_pulse", "drop"}


@pytest.mark.slow
def test_an_unplugged_board_that_comes_back_is_gone_on_with(calibrated, bench, tmp_path):
    now = ask(bench, {"advance": 0.0})["now"]
    for kind, at in (("unplug", now + 20.0), ("replug", now + 23.0)):
        assert "error" not in ask(bench, {"fault": {"kind": kind, "at": at}})
    words = ("--out", tmp_path / "out", "--yes", "--keep", "--set", "bench.servo.step=40 deg", "--json")
    done = armcal("servo", bench, *words)
    assert done.exit_code == 0, done.stderr
    assert ask(bench, {"advance": 0.0})["now"] > now + 23.0
    assert not json.loads(done.stdout)["not_told"]["servos"]


@pytest.mark.slow
def test_check_says_that_all_is_right(calibrated, bench):
    bent = "bench.servo.base={q2: 30 deg, q4: -40 deg}"
    done = armcal("servo", bench, "--check", "--yes", "--json", "--set", bent)
    assert done.exit_code == 0, done.stdout + done.stderr
    assert {v["kind"] for v in json.loads(done.stdout)["joints"]} == {"right"}


@pytest.mark.slow
def test_check_finds_a_planted_swap(calibrated, bench, monkeypatch):
    servos = yaml.safe_load((bench.parent / "servos.yaml").read_text())
    servos["servos"]["q2"]["channel"], servos["servos"]["q4"]["channel"] = 3, 1
    (bench.parent / "swapped.yaml").write_text(yaml.safe_dump(servos))
    options = (
        "bench.servo.base={q2: 30 deg, q4: -40 deg}",
        "bench.servo.joints=[q2, q4]",
        "bench.device.servos=swapped.yaml",
    )
    monkeypatch.chdir(bench.parent)
    done = armcal("servo", bench, "--check", "--yes", *(word for o in options for word in ("--set", o)))
    assert done.exit_code == 1
    assert "q2 and q4 are swapped" in done.stdout


@pytest.mark.slow
def test_guided_by_lines_of_a_pipe(calibrated, bench, tmp_path):
    words = ("--set", "bench.servo.joints=[q6]", "--guided", "--yes", "--out", tmp_path / "out", "--keep", "--json")
    with piped("+10\nok\n-10\nok\nquit\n"):
        done = armcal("servo", bench, *words)
    assert done.exit_code == 4, done.stderr
    with piped("skip\nskip\nok\nok\n"):
        done = armcal("servo", bench, *words)
    assert done.exit_code == 0, done.stderr
    knots = json.loads(done.stdout)["servos"]["q6"]["knots"]
    assert knots[2]["change_us"] == pytest.approx(0.0, abs=6.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("bench:\n  servo: {joints: [q9]}\n", ("own.yaml:3", "bench.servo.joints", "q1, q2")),
        ("bench:\n  servo: {knots_deg: [10, 0]}\n", ("bench.servo", "do not rise")),
        ("bench:\n  servo: {step: 10}\n", ("bench.servo.step", "step_deg")),
        ("bench:\n  servo: {base: {q2: 80 deg}}\n", ("80.0 deg", "-50.0 to 50.0")),
        ("bench:\n  device: {servos: nowhere.yaml}\n", ("nowhere.yaml",)),
    ],
)
def test_what_is_refused_says_where_and_moves_nothing(tmp_path, text, said):
    config = config_in(tmp_path, text)
    done = armcal("servo", config, "--out", tmp_path / "out", "--yes")
    assert done.exit_code == 2, done.stderr
    assert "Traceback" not in done.stderr
    for word in said:
        assert word in done.stderr, done.stderr


def test_without_a_folder_or_a_bench_it_says_what_to_give(tmp_path):
    config = config_in(tmp_path)
    assert "--out" in armcal("servo", config, "--yes").stderr
    done = armcal("servo", tmp_path / "option1.yaml", "--out", tmp_path / "out")
    assert done.exit_code == 2 and "found no bench" in done.stderr


def test_nobody_is_there_to_be_asked(bench, tmp_path):
    done = armcal("servo", bench, "--park", "--release", "--yes")
    assert done.exit_code == 0, done.stderr
    done = armcal("servo", bench, "--out", tmp_path / "out")  # its input is at its end
    assert done.exit_code == 2 and "--yes" in done.stderr and "nothing was moved" in done.stderr
