"""The simulated bench with smart servos: what they carry, what counts as unsafe, and what the driver makes of it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from armcal.cli.main import cli
from armcal.config.system import build_component
from armcal.errors import ArmcalError
from armcal.run.experiment import Experiment
from click.testing import CliRunner
from servo_bench_parts import read_all
from servo_bus_parts import at_baud, packet

from tests.bench_runs import bus_ids, free_port, overrides_for, serve
from tests.simulated_lines.bus_bench import BusBenchAtLine, BusWorld
from tests.simulated_lines.line_world import LineWorld

CONFIG = Path(__file__).resolve().parents[3] / "configs" / "so101" / "bench.yaml"
PAN, LIFT, ELBOW = 1, 2, 3
GOAL, SPEED = 42, 46


class Host:
    """A host of a bench in this process, which speaks to servos by their ids."""

    def __init__(self, world: LineWorld, folder: Path) -> None:
        self.world, self.folder = world, folder
        self.port = os.open(folder / "board", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        at_baud(self.port)

    def write(self, number: int, address: int, value: int, size: int = 2) -> bytes:
        return self.ask(packet("feetech", number, 3, bytes((address,)) + value.to_bytes(size, "little")))

    def position(self, number: int) -> int:
        return int.from_bytes(self.ask(packet("feetech", number, 2, bytes((56, 2))))[5:7], "little")

    def ask(self, data: bytes) -> bytes:
        os.write(self.port, data)
        self.world.attend_line()
        return read_all(self.port)

    def drive(self, number: int, degrees: float, degrees_per_s: float) -> None:
        self.write(number, SPEED, round(degrees_per_s / 360 * 4096))
        self.write(number, GOAL, 2048 + round(degrees / 360 * 4096))

    def hold(self) -> None:
        for number in range(1, 6):
            self.write(number, GOAL, self.position(number))
            self.run(0.2)

    def run(self, seconds: float) -> dict[str, Any]:
        return self.world.answer({"advance": seconds, "state": True})

    def fail(self, **fault: Any) -> None:
        self.world.answer({"fault": fault})


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    port = free_port()
    ports = (f"bench.tracker.port={port}", f"bench.simulator.tracker.port={port}")
    return Experiment.load(CONFIG, (*bus_ids(), *ports, *overrides_for(Path(), "device")))


def settings(experiment: Experiment, **joints: dict[str, Any]) -> Any:
    bench, _ = build_component(experiment.source, experiment.registry, "bench", ("bench", "simulator"))
    assert isinstance(bench, BusBenchAtLine)
    own = {name: bench.settings.joints[name].model_copy(update=more) for name, more in joints.items()}
    return bench.settings.model_copy(update={"joints": {**bench.settings.joints, **own}})


@pytest.fixture
def host(experiment: Experiment, tmp_path: Path) -> Iterator[Host]:
    world = BusWorld(settings(experiment), experiment, tmp_path)
    world.start(tmp_path / "board")
    host = Host(world, tmp_path)
    yield host
    os.close(host.port)
    world.close()


def test_the_arm_hangs_where_friction_holds_it_and_goes_where_it_is_sent(host: Host) -> None:
    assert host.run(1.0)["joints"]["shoulder_lift"]["powered"] is False
    host.hold()
    host.drive(PAN, 30, 20)
    state = host.run(2.5)
    shaft = state["bus"]["shoulder_pan"]["shaft_rad"]
    assert math.degrees(shaft) == pytest.approx(30, abs=0.1)
    play = shaft - state["joints"]["shoulder_pan"]["angle_rad"]
    assert math.degrees(play) == pytest.approx(0.45, abs=1e-6)
    assert state["offences"] == {}


def test_a_goal_far_away_without_a_speed_limit_is_an_offence(host: Host) -> None:
    host.hold()
    host.drive(PAN, 40, 0)
    assert host.run(1.0)["offences"]["speed"] > 0


def test_servos_that_are_switched_on_together_stay_where_they_stand(host: Host) -> None:
    before = host.run(0.1)["joints"]
    for number in range(1, 6):
        host.write(number, GOAL, host.position(number))
    state = host.run(0.5)
    assert state["offences"] == {}
    for joint, entry in state["joints"].items():
        assert abs(entry["angle_rad"] - before[joint]["angle_rad"]) < math.radians(0.3)


def test_beyond_a_limit_and_too_near_are_offences(host: Host) -> None:
    host.hold()
    host.drive(PAN, 96, 20)
    host.drive(ELBOW, 60, 20)
    host.drive(LIFT, 55, 20)
    offences = host.run(6.0)["offences"]
    assert offences["limits"] > 0
    assert offences["clearance"] > 0
    kinds = [json.loads(line).get("offence") for line in (host.folder / "safety.jsonl").read_text().splitlines()]
    assert {"limits", "clearance"} <= set(kinds)


def test_a_joint_that_was_found_beyond_its_limit_may_come_back_but_go_no_further(
    experiment: Experiment, tmp_path: Path
) -> None:
    away = settings(experiment).model_copy(update={"start": {"shoulder_lift": math.radians(-70)}})
    world = BusWorld(away, experiment, tmp_path)
    world.start(tmp_path / "board")
    host = Host(world, tmp_path)
    host.hold()
    assert "limits" not in host.run(0.5)["offences"]
    host.drive(LIFT, -75, 20)
    assert host.run(1.0)["offences"]["limits"] > 0
    os.close(host.port)
    world.close()


def test_a_brown_out_lets_go_of_the_arm_and_says_nothing(host: Host) -> None:
    host.hold()
    host.drive(ELBOW, 40, 20)
    host.run(4.0)
    host.fail(kind="brown_out")
    state = host.run(2.0)
    assert state["joints"]["elbow_flex"]["powered"] is False
    assert state["events"]["drop"] >= 1
    assert state["joints"]["elbow_flex"]["angle_rad"] > math.radians(60)


def test_a_servo_that_is_blocked_is_overloaded_and_says_so(host: Host) -> None:
    host.hold()
    host.fail(kind="jam", joint="shoulder_pan")
    host.drive(PAN, 40, 20)
    state = host.run(5.0)
    assert state["bus"]["shoulder_pan"]["status"] == 32
    assert host.ask(packet("feetech", PAN, 1, b""))[4] == 32
    assert state["offences"] == {}


def test_a_hot_servo_a_plug_that_is_out_and_one_servos_brown_out(host: Host) -> None:
    host.hold()
    host.fail(kind="heat", joint="elbow_flex")
    host.fail(kind="disconnect", joint="shoulder_pan")
    assert host.run(0.3)["bus"]["elbow_flex"]["status"] == 4
    assert host.ask(packet("feetech", PAN, 1, b"")) == b""
    host.fail(kind="connect", joint="shoulder_pan")
    assert host.ask(packet("feetech", PAN, 1, b"")) != b""
    host.fail(kind="brown_out", joint="shoulder_lift")
    powered = {joint: entry["powered"] for joint, entry in host.run(0.1)["joints"].items()}
    assert powered == {
        "shoulder_pan": True,
        "shoulder_lift": False,
        "elbow_flex": False,
        "wrist_flex": True,
        "wrist_roll": True,
    }


@pytest.mark.parametrize(
    ("joint", "reads"),
    [
        ({"horn_teeth": 1}, 2048 + 4096 / 25),
        ({"homing_offset": 2047}, 2048),
        ({"homing_offset": -2047}, 2048),
        ({"zero_count": 1500.0}, 1500),
    ],
)
def test_what_a_servo_reads_at_its_joints_zero(
    experiment: Experiment, tmp_path: Path, joint: dict[str, Any], reads: float
) -> None:
    world = BusWorld(settings(experiment, shoulder_pan=joint), experiment, tmp_path)
    world.start(tmp_path / "board")
    host = Host(world, tmp_path)
    assert abs(host.position(PAN) - reads) < 2
    os.close(host.port)
    world.close()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("bench.simulator.joints.elbow_flex=null", "no servo for elbow_flex"),
        ("bench.simulator.joints.elbow_flex={id: 3, model: mg996r}", "expected one of sts3215"),
        ("bench.simulator.joints.elbow_flex={id: 3, model: ax12}", "it is one bus"),
        ("bench.simulator.joints.knee={id: 7}", "knee"),
        ("bench.simulator.baud=123", "baud"),
    ],
)
def test_settings_that_do_not_fit_are_refused(change: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(ArmcalError, match=says):
        serve(Experiment.load(CONFIG, (*bus_ids(), *overrides_for(tmp_path, "device"), change)), tmp_path)


@pytest.mark.slow
def test_a_rehearsal_measures_its_poses_and_is_safe(tmp_path: Path) -> None:
    plan = tmp_path / "plan.csv"
    head = "pose_id," + ",".join(
        f"{joint}_deg" for joint in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    )
    plan.write_text(f"{head}\na,10,-40,-20,10,30\nb,-10,-30,0,0,-30\nc,5,-35,-10,-20,0\n")
    words = ["rehearse", str(CONFIG), "--plan", str(plan), "--out", str(tmp_path / "r")]
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 0, done.output
    assert "3 of 3 poses measured" in done.output
    assert "unsafe was: nothing" in " ".join(done.output.split())
