"""The simulated bench in the session's own process: its board and watchdog, its faults, and runs that are resumed."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceLostError, DeviceResetError, JointDevice, MeasuringDevice, standing_at, state_of
from armcal.errors import ConfigError
from armcal.run.experiment import Experiment
from armcal_bench.bench import Bench
from click.testing import CliRunner, Result

from tests.bench_runs import CONFIG, ROOT, write_plan

SO101 = ROOT / "configs" / "so101" / "bench.yaml"
PARK = {"q1": 0.0, "q2": math.radians(-50), "q3": 0.0, "q4": math.radians(-10), "q5": 0.0, "q6": 0.0}
RATE = math.radians(20)


class Session:
    """A bench's clock and device, opened, with a folder for the simulated bench."""

    def __init__(self, folder: Path, config: Path, *sets: str) -> None:
        self.folder = folder
        self.bench = Bench.of(Experiment.load(config, (f"bench.simulated={folder}", *sets)))
        self.device: JointDevice = self.bench.device()
        assert self.bench.simulation is not None
        self.clock: Clock = self.bench.simulation.clock
        self.device.open(self.clock)

    def account(self) -> dict[str, Any]:
        with self.bench.clock():
            pass
        content: dict[str, Any] = json.loads((self.folder / "truth.json").read_text())
        return content

    def hold(self, angles: dict[str, float]) -> None:
        for joint, angle in standing_at(self.device, angles).items():
            self.device.energise(joint, angle)
            self.wait(0.5)

    def wait(self, seconds: float) -> None:
        for _ in range(math.ceil(seconds / 0.04)):
            self.clock.sleep(0.04)
            self.device.keep_alive()

    def ramp(self, joint: str, start: float, end: float) -> None:
        for angle in np.linspace(start, end, math.ceil(abs(end - start) / RATE / 0.04) + 1):
            self.device.command(standing_at(self.device, {joint: float(angle)}))
            self.wait(0.04)


def angles(account: dict[str, Any]) -> dict[str, float]:
    return {joint: entry["angle_rad"] for joint, entry in account["joints"].items()}


@pytest.mark.parametrize("link", ["{type: framed, port: nowhere}", "{type: linux_i2c}"])
def test_a_silent_host_is_made_up_for_where_the_link_does_so(tmp_path: Path, link: str) -> None:
    session = Session(tmp_path, CONFIG, f"bench.link={link}")
    session.hold(PARK)
    assert session.device.guard([PARK], RATE, 1.0) is ("framed" in link)
    session.ramp("q3", 0.0, 0.3)
    if "framed" in link:
        session.clock.sleep(6.0)
        with pytest.raises(DeviceLostError, match="drives the arm by itself"):
            session.device.keep_alive()
    account = session.account()
    assert account["offences"] == {}
    assert account["joints"]["q3"]["angle_rad"] == pytest.approx(0.0 if "framed" in link else 0.3, abs=0.02)


def test_a_board_that_is_plugged_in_again_has_gone_on(tmp_path: Path) -> None:
    faults = "bench.simulator.faults=[{kind: unplug, at: 5}, {kind: replug, at: 8}]"
    session = Session(tmp_path, CONFIG, faults)
    session.hold(PARK)
    session.device.guard([PARK], RATE, 1.0)
    with pytest.raises(DeviceLostError):
        session.ramp("q3", 0.0, 1.0)
    with pytest.raises(DeviceLostError, match="unplugged"):
        session.device.open(session.clock)
    session.clock.sleep(4.0)
    session.device.open(session.clock)
    state = state_of(session.device)
    assert state.took_over and state.angles["q3"] == pytest.approx(0.0, abs=0.01)
    assert session.account()["offences"] == {}


@pytest.mark.parametrize(("kind", "held"), [("reset", 6), ("brown_out", 0)])
def test_a_reset_leaves_the_pulses_and_a_brown_out_ends_them(tmp_path: Path, kind: str, held: int) -> None:
    session = Session(tmp_path, CONFIG, f"bench.simulator.faults=[{{kind: {kind}, at: 4}}]")
    session.hold(PARK)
    with pytest.raises(DeviceResetError):
        session.wait(2.0)
    session.device.open(session.clock)
    assert len(state_of(session.device).angles) == held
    assert session.account()["board"]["boots"] == 2


def test_pulses_are_counted_by_the_true_oscillator_and_exchanged_plugs_move_each_other(tmp_path: Path) -> None:
    text = (CONFIG.parent / "bench_servos.yaml").read_text()
    text = (
        text.replace("channel: 4", "channel: 9").replace("channel: 5", "channel: 4").replace("channel: 9", "channel: 5")
    )
    (tmp_path / "true.yaml").write_text(text)
    session = Session(tmp_path / "bench", CONFIG, f"bench.simulator.servos={tmp_path / 'true.yaml'}")
    session.hold({**PARK, "q5": 0.6})
    state = angles(session.account())
    assert state["q6"] == pytest.approx(0.6, abs=0.05) and state["q5"] == pytest.approx(0.0, abs=0.05)
    assert abs(state["q6"] - 0.6) > 1e-4, "its table and oscillator are others than stated"


def test_smart_servos_see_what_their_load_turns_them_by_and_not_their_play(tmp_path: Path) -> None:
    settings = "bench.simulator.joints.shoulder_pan={backlash_deg: 0.9, zero_off_deg: 3, reversed: true}"
    session = Session(tmp_path, SO101, settings)
    device = session.device
    assert isinstance(device, MeasuringDevice)
    session.hold(device.measured())
    session.ramp("shoulder_lift", math.radians(-45), 0.0)
    session.ramp("shoulder_pan", state_of(device).angles["shoulder_pan"], 0.3)
    session.wait(1.0)
    measured, commanded = device.measured(), state_of(device).angles
    assert commanded["shoulder_pan"] == pytest.approx(0.3, abs=2e-3)
    assert measured["shoulder_pan"] == pytest.approx(0.3, abs=2e-3)
    assert math.degrees(abs(measured["shoulder_lift"] - commanded["shoulder_lift"])) > 0.1
    joints = session.account()["joints"]
    assert math.degrees(joints["shoulder_pan"]["shaft_rad"]) == pytest.approx(math.degrees(-0.3) + 3, abs=0.2)
    assert math.degrees(abs(joints["shoulder_pan"]["angle_rad"] - joints["shoulder_pan"]["shaft_rad"])) < 0.46


def test_it_goes_on_from_where_it_was_left(tmp_path: Path) -> None:
    first = Session(tmp_path, CONFIG)
    first.hold(PARK)
    first.ramp("q3", 0.0, 0.4)
    before = first.account()
    second = Session(tmp_path, CONFIG)
    assert second.clock.now() == before["now"] and len(state_of(second.device).angles) == 6
    after = second.account()
    assert angles(after) == pytest.approx(angles(before), abs=1e-3)
    assert after["joints"]["q2"]["winding"] > 0 and after["events"] == before["events"]


@pytest.mark.parametrize("fault", ["{kind: lst}", "{kind: lost, body: tol}", "{kind: jam, joint: q9}"])
def test_a_fault_that_the_bench_does_not_have_is_refused(tmp_path: Path, fault: str) -> None:
    with pytest.raises(ConfigError, match=r"bench\.simulator\.faults.*(did you mean|no joint is called 'q9')"):
        Session(tmp_path, CONFIG, f"bench.simulator.faults=[{fault}]")


def test_a_recording_reads_an_arm_that_is_guided_by_hand(tmp_path: Path) -> None:
    faults = "bench.simulator.faults=[{kind: put, joint: shoulder_pan, angle: 0.5, at: 1}]"
    bench = Bench.of(
        Experiment.load(
            SO101, (f"bench.simulated={tmp_path}", faults, "bench.joints={type: json_lines, source: udp:5000}")
        )
    )
    stream = bench.joints()
    with bench.clock() as clock:
        stream.open(clock, ("arm.shoulder_pan", "arm.elbow_flex"))
        clock.sleep(2.0)
        (sample,) = stream.samples()
        stream.close()
    assert sample.angles["arm.shoulder_pan"] == pytest.approx(0.5, abs=0.005)


def rehearse(*words: str | Path, **more: Any) -> Result:
    return CliRunner().invoke(cli, ["rehearse", str(CONFIG), *map(str, words)], **more)


class TestCommand:
    def test_a_run_is_stopped_by_a_lost_tracker_and_goes_on(self, tmp_path: Path) -> None:
        plan, out = write_plan(tmp_path / "plan.csv"), tmp_path / "out"
        sets = ["bench.acquisition.lost.park_s=4", "bench.acquisition.period_s=0.04"]
        words = [word for text in sets for word in ("--set", text)]
        lost = ("--set", "bench.simulator.faults=[{kind: lost, at: 8}]")
        stopped = rehearse("--plan", plan, "--out", out, *words, *lost)
        assert stopped.exit_code == 4 and "Go on with --resume" in stopped.output, stopped.output
        refused = rehearse("--plan", plan, "--out", out, *words)
        assert refused.exit_code == 2 and "--resume" in refused.output
        done = rehearse("--plan", plan, "--out", out, "--resume", *words, *lost)
        assert done.exit_code == 0 and "4 of 4 poses measured" in done.output, done.output
        assert "unsafe was: nothing" in done.output

    @pytest.mark.slow
    def test_one_that_is_killed_loses_nothing(self, tmp_path: Path) -> None:
        plan, out = write_plan(tmp_path / "plan.csv"), tmp_path / "out"
        child = os.fork()
        if child == 0:
            rehearse("--plan", plan, "--out", out)
            os._exit(0)
        until = time.monotonic() + 300
        while not (out / "bench" / "truth.json").exists() and time.monotonic() < until:
            time.sleep(0.01)
        os.kill(child, signal.SIGKILL)
        assert os.WIFSIGNALED(os.waitpid(child, 0)[1])
        done = rehearse("--plan", plan, "--out", out, "--resume", "--json")
        assert done.exit_code == 0, done.output
        summary = json.loads(done.stdout)
        assert summary["measured"] == 4 and summary["truth"]["offences"] == {} and summary["times"] == "written"

    def test_servos_by_eye(self, tmp_path: Path) -> None:
        sets = ("--set", "bench.servo.joints=[q3]")
        done = rehearse("--servo", "guided", "--out", tmp_path / "out", *sets)
        assert done.exit_code == 4, done.output  # its input is at its end
        assert "put q3 at" in done.output
        assert "unsafe was: nothing" in done.output

    @pytest.mark.parametrize("words", [(), ("--plan", "p.csv", "--servo", "tracked")])
    def test_what_is_rehearsed_is_said_once(self, tmp_path: Path, words: tuple[str, ...]) -> None:
        done = rehearse("--out", tmp_path / "out", *words)
        assert done.exit_code == 2 and "of --plan and --servo" in done.output
