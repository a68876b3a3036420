"""``armcal acquire`` and ``rehearse`` as a user meets them: refusals before anything moves, exit codes, files."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import forked
import numpy as np
import pytest
from armcal.cli.main import cli
from armcal.devices.device import DeviceRefusedError
from armcal.errors import InputError
from armcal_bench.session import Conversation, acquire
from click.testing import CliRunner, Result

from tests.bench_runs import CONFIG, BenchRun, overrides_for, positions, write_plan

NEAR = (0, 50, 0, 100, 0, 0)
"""Bent down to the table."""
ARMCAL = (sys.executable, "-m", "armcal.cli")
SETS = ("bench.acquisition.period_s=0.04",)


def armcal(*arguments: str | Path, sets: tuple[str, ...] = ()) -> Result:
    words = [word for text in sets for word in ("--set", text)]
    return CliRunner().invoke(cli, [*map(str, arguments), *words])


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_plan(tmp_path_factory.mktemp("plan") / "plan.csv")


@pytest.fixture
def run(tmp_path: Path) -> BenchRun:
    return BenchRun(tmp_path, SETS)


QUIET = Conversation(lambda: False, lambda start: True)


def tracker_port(run: BenchRun) -> int:
    return int(run.experiment.settings.bench["tracker"]["port"])  # type: ignore[index]


def there(run: BenchRun) -> tuple[str, ...]:
    """What a command needs to meet the simulated bench."""
    return (*overrides_for(run.bench), f"bench.tracker.port={tracker_port(run)}")


class TestDryRun:
    def test_it_says_time_travel_and_heat_and_opens_nothing(self, plan: Path) -> None:
        result = armcal("acquire", CONFIG, "--plan", plan, "--dry-run")
        assert result.exit_code == 0, result.output
        assert "4 poses in about" in result.output and "deg in all; 0 rests" in result.output
        assert "q4" in result.output

    def test_json_has_the_same_in_numbers(self, plan: Path) -> None:
        told = json.loads(armcal("acquire", CONFIG, "--plan", plan, "--dry-run", "--json").output)
        assert told["poses"] == 4 and told["resting_s"] == 0 and told["left_out"] == []
        slowest = told["travel_deg"] / 20
        assert told["seconds"] == pytest.approx(slowest + 4 * 2.0)

    def test_the_shipped_bench_lets_no_arm_fall_at_its_end(self, plan: Path) -> None:
        """Let go where it parks, joint 2 would fall by 166 deg."""
        told = json.loads(armcal("acquire", CONFIG, "--plan", plan, "--dry-run", "--json", "-q").output)
        assert "drop" not in [hazard["kind"] for hazard in told["hazards"]]


class TestRefusedBeforeAnythingMoves:
    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ("q2=51", "pose p2 has q2 at 51.0 deg, expected -50.0 to 50.0"),
            ("q4=101", "q4 at 101.0 deg"),
        ],
    )
    def test_poses_outside_limits(self, tmp_path: Path, change: str, said: str) -> None:
        joint, value = change.split("=")
        poses = [[0.0] * 6, [0.0] * 6]
        poses[1][int(joint[1]) - 1] = float(value)
        result = armcal(
            "acquire", CONFIG, "--plan", write_plan(tmp_path / "p.csv", tuple(map(tuple, poses))), "--dry-run"
        )
        assert result.exit_code == 2
        assert said in result.output
        assert "Traceback" not in result.output

    def test_a_pose_that_cannot_be_read_is_told_and_the_others_are_driven(self, tmp_path: Path) -> None:
        plan = write_plan(tmp_path / "p.csv", ((0,) * 6, (float("nan"), 0, 0, 0, 0, 0), (10, 0, 0, 0, 0, 0)))
        result = armcal("acquire", CONFIG, "--plan", plan, "--dry-run")
        assert result.exit_code == 0 and "2 poses in about" in result.output
        assert "row 3 of the plan, pose p2, is set aside" in result.output
        told = json.loads(armcal("acquire", CONFIG, "--plan", plan, "--dry-run", "--json", "-q").output)
        assert list(told["set_aside"]) == ["p2"]

    def test_a_pose_that_comes_too_near(self, tmp_path: Path) -> None:
        plan = write_plan(tmp_path / "p.csv", ((0,) * 6, NEAR))
        result = armcal("acquire", CONFIG, "--plan", plan, "--dry-run")
        assert result.exit_code == 2
        assert "pose p2 is too near to something" in result.output and "p.csv, row 3" in result.output

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ("bench=null", "found no bench"),
            ("bench.device=null", "found no device of the bench"),
            ("bench.acquisition.park={q2: 80 deg}", "q2 would park outside its limits"),
            ("bench.acquisition.park={q9: 0 deg}", "no joint is called 'q9'"),
            ("bench.acquisition.heat={q9: {continuous_Nm: 1}}", "no joint is called 'q9'"),
            ("bench.acquisition.limits={q9: [0 deg, 1 deg]}", "no joint is called 'q9'"),
            ("bench.acquisition.rate_deg_per_s=0", "rate_deg_per_s"),
            ("bench.acquisition.settle.spread=5", "unit"),
            ("bench.device.servos=nowhere.yaml", "nowhere.yaml"),
            ("plan.limits.q3=null", "found no limits of the joint q3"),
        ],
    )
    def test_configurations(self, plan: Path, change: str, said: str) -> None:
        result = armcal("acquire", CONFIG, "--plan", plan, "--dry-run", sets=(change,))
        assert result.exit_code == 2, result.output
        assert said in result.output and "Traceback" not in result.output

    def test_a_port_that_is_not_there(self, plan: Path, tmp_path: Path) -> None:
        gone = (f"bench.link.port={tmp_path / 'nothing'}",)
        result = armcal("acquire", CONFIG, "--plan", plan, "--out", tmp_path / "out", "--yes", sets=gone)
        assert result.exit_code == 2
        assert "there is no such serial port" in result.output

    @pytest.mark.slow
    def test_nobody_who_can_say_yes(self, run: BenchRun) -> None:
        with run.simulated() as clock:
            words = [word for text in (*run.sets, *there(run)) for word in ("--set", text)]
            done = armcal("acquire", CONFIG, "--unchecked", "--plan", run.plan, "--out", run.out, *words)
            assert done.exit_code == 2 and "--yes" in done.stderr  # its input is at its end
            assert clock.ask({"state": True})["events"] == {}

    @pytest.mark.slow
    def test_another_board_than_the_servo_file_names(self, tmp_path: Path) -> None:
        run = BenchRun(tmp_path, (*SETS, "bench.simulator.board_id=LRM-2"))
        with run.simulated() as clock, pytest.raises(DeviceRefusedError, match="LRM-2"):
            run.acquire()
            assert clock.ask({"state": True})["events"] == {}

    @pytest.mark.slow
    def test_a_tracker_that_sees_nothing(self, run: BenchRun) -> None:
        with run.simulated() as clock:
            clock.ask({"fault": {"kind": "lost", "body": "tool"}})
            with pytest.raises(DeviceRefusedError, match="tool body"):
                run.acquire()
            assert clock.ask({"state": True})["events"] == {}

    @pytest.mark.slow
    def test_a_folder_with_a_run_unless_it_is_resumed_and_one_without_if_it_is(self, run: BenchRun, plan: Path) -> None:
        prepared = run.prepared()
        with pytest.raises(InputError, match="no run to resume"), run.simulated():
            acquire(prepared, run.plan, run.out, "resume", QUIET, unchecked=True)
        with run.simulated():
            run.acquire(lambda: True)
            with pytest.raises(InputError, match="--resume"):
                acquire(prepared, run.plan, run.out, "anew", QUIET, unchecked=True)
            run.plan.write_text(run.plan.read_text().replace("40,", "41,"))
            with pytest.raises(InputError, match="another plan"):
                run.acquire()

    def test_a_run_that_was_begun_with_another_servo_file(self, tmp_path: Path) -> None:
        run = BenchRun(tmp_path, SETS)
        with run.simulated():
            run.acquire(lambda: True)
            text = (CONFIG.parent / "servos.yaml").read_text().replace("1540.0", "1541.0")
            (tmp_path / "other.yaml").write_text(text)
            other = BenchRun(tmp_path, (*SETS, f"bench.device.servos={tmp_path / 'other.yaml'}"))
            with pytest.raises(InputError, match="another"):
                other.acquire()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, plan: Path) -> Path:
    """A rehearsal's, of a bench whose real adapter is another one."""
    folder = tmp_path_factory.mktemp("rehearsal") / "out"
    link = "bench.link={type: framed, port: /dev/serial/by-id/usb-A5069RR4}"
    result = armcal("rehearse", CONFIG, "--plan", plan, "--out", folder, sets=(*SETS, link))
    assert result.exit_code == 0, result.output
    assert "unsafe was: nothing" in result.output and "armcal run" in result.output
    return folder


class TestRehearsal:
    @pytest.mark.parametrize(
        ("change", "said"),
        [
            ("bench.simulator.joints={q9: {backlash_deg: 1}}", "the joints are q1, q2, q3, q4, q5, q6."),
            ("bench=null", "found no device of the bench"),
        ],
    )
    def test_what_cannot_be_rehearsed(self, plan: Path, tmp_path: Path, change: str, said: str) -> None:
        result = armcal("rehearse", CONFIG, "--plan", plan, "--out", tmp_path / "out", sets=(change,))
        assert result.exit_code == 2, result.output
        assert said in result.output and "Traceback" not in result.output

    @pytest.mark.slow
    def test_data_can_be_read_as_they_are(self, folder: Path) -> None:
        from armcal.run.experiment import Experiment

        data = Experiment.load(CONFIG, data=folder / "dataset.csv").read()
        assert data.ids == ("p1", "p2", "p3", "p4")
        assert data.has("time") and data.has("sequence") and data.has("arm.approach.q1")
        assert np.all(np.abs(data.column("arm.approach.q1")) == 1)
        assert len(positions(data)) == 4

    @pytest.mark.slow
    def test_they_say_which_board_and_which_configuration(self, folder: Path) -> None:
        rows = list(csv.DictReader((folder / "dataset.csv").open()))
        summary = json.loads((folder / "summary.json").read_text())
        assert {row["board"] for row in rows} == {summary["digests"]["board"]}
        assert {row["config"] for row in rows} == {summary["digests"]["config"]}
        assert summary["how"] == "done" and summary["measured"] == 4

    def test_angles_are_those_that_the_board_can_set(self, folder: Path) -> None:
        rows = list(csv.DictReader((folder / "dataset.csv").open()))
        pulses = 1540 + float(rows[1]["q1_deg"]) * 9.2
        tick = 122 / 25
        assert pulses / tick == pytest.approx(round(pulses / tick), abs=1e-6)


@pytest.mark.slow
def test_ctrl_c_parks_the_arm_and_resume_measures_the_rest(run: BenchRun) -> None:
    sets = [word for text in (*run.sets, *there(run)) for word in ("--set", text)]
    sets += ["--set", "bench.acquisition.at_end=release"]
    command = ["acquire", str(CONFIG), "--unchecked", "--plan", str(run.plan), "--out", str(run.out), "--yes", *sets]
    with run.simulated() as clock:
        process = subprocess.Popen([*ARMCAL, *command], stdout=subprocess.PIPE, text=True)
        until = time.monotonic() + 60
        while clock.ask({"state": True})["now"] < 6 and time.monotonic() < until:
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[0]
        assert process.returncode == 4, said
        assert "parked: it was asked to stop" in said and "--resume" in said
        state = clock.ask({"state": True})
        assert all(pulse is None for pulse in state["pulses_s"].values()) and state["offences"] == {}
        before = len(run.progress().measured)
        done = armcal(*command, "--resume")
        assert done.exit_code == 0 and "4 of 4 poses measured" in done.stdout
    assert 0 <= before < 4
    assert sorted(run.progress().measured) == ["p1", "p2", "p3", "p4"]


@pytest.mark.slow
def test_a_missing_library_is_named(tmp_path: Path, plan: Path) -> None:
    (tmp_path / "serial.py").write_text("raise ModuleNotFoundError(\"No module named 'serial'\", name='serial')\n")
    command = ("acquire", str(CONFIG), "--plan", str(plan), "--out", str(tmp_path / "o"), "--yes")
    done = forked.armcal(*command, path=tmp_path)
    assert done.returncode in (1, 2) and "serial" in done.stderr and "Traceback" not in done.stderr


def test_heat_of_an_arm_that_weighs_nothing_is_refused(plan: Path) -> None:
    weightless = tuple(f"arms.arm.links.{n}=null" for n in (*(f"link{i}" for i in range(1, 7)), "target", "holder"))
    result = armcal("acquire", CONFIG, "--plan", plan, "--dry-run", sets=weightless)
    assert result.exit_code == 2 and "no part of the arm has a mass" in result.output
