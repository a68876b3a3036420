"""Danger to hardware, on two arms of nobody's, on simulated benches at real ptys: what is refused, sent and named."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from armcal.bench.clock import SimulatedClock

from tests.own_arms import POST, POST_SERVOS, TOWER, TOWER_SERVOS, OwnArm

FEW = ("bench.servo.joints=[c]", "bench.servo.step_deg=80")
"""A calibration of a few poses."""
TOO_HOT = "bench.acquisition.heat={b: {continuous_Nm: 0.02}}"


class Bench:
    """An arm and its bench, for some tests in turn."""

    def __init__(self, arm: OwnArm, clock: SimulatedClock) -> None:
        self.arm, self.clock = arm, clock

    def first_pulses(self) -> int:
        return int(self.clock.ask({"state": True})["events"].get("first_pulse", 0))

    def offences(self) -> dict[str, int]:
        return dict(self.clock.ask({"state": True})["offences"])


@pytest.fixture
def post(tmp_path: Path) -> Iterator[Bench]:
    arm = OwnArm(tmp_path, POST)
    with arm.run.simulated() as clock:
        yield Bench(arm, clock)


def lines(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "observations.jsonl").read_text().splitlines()]


class TestARefusedRunLeavesNothing:
    def test_the_next_run_with_another_base_is_measured_and_judged_by_its_own(self, post: Bench) -> None:
        arm = post.arm
        refused = arm.armcal("servo", "--out", arm.out, "--yes", sets=(*FEW, TOO_HOT))
        assert refused.exit_code == 2 and "b would not cool in the base pose" in refused.output.replace("\n", " ")
        assert "nothing was moved" in refused.output and post.first_pulses() == 0
        done = arm.armcal("servo", "--out", arm.out, "--yes", sets=(*FEW, "bench.servo.base={b: -20 deg}"))
        assert done.exit_code == 0, done.output
        begun, *measured = lines(arm.out)
        assert math.degrees(begun["base"]["b"]) == pytest.approx(-20) and begun["base"]["c"] == 0
        assert {round(math.degrees(line["told"]["b"])) for line in measured} == {-20}
        truth = yaml.safe_load(POST_SERVOS)["servos"]["c"]["pulses_us"]
        assert arm.pulses()["c"] == pytest.approx(truth, abs=3)

    def test_a_beginning_without_measurements_is_kept_aside_and_that_is_said(self, post: Bench) -> None:
        """As an earlier version, or one that was killed, left it."""
        arm = post.arm
        arm.out.mkdir()
        servo = {"board": "only", "channel": 2, "oscillator_hz": 25e6, "prescale": 121}
        servo |= {"angles": [-1.7, 0.0, 1.7], "pulses": [6e-4, 1.5e-3, 2.4e-3]}
        begun = {"kind": "begun", "servos": {"c": servo}, "base": {"a": 0.5, "b": 0.2, "c": -0.4}}
        (arm.out / "observations.jsonl").write_text(json.dumps(begun) + "\n")
        again = arm.armcal("servo", "--out", arm.out, "--yes", "--keep", sets=FEW)
        assert again.exit_code == 0, again.output
        assert "kept as observations.jsonl.before-1" in again.output and "begins anew" in again.output
        assert math.degrees(lines(arm.out)[0]["base"]["b"]) == pytest.approx(30)
        assert json.loads((arm.out / "observations.jsonl.before-1").read_text())["base"]["a"] == 0.5

    def test_measurements_of_another_base_pose_are_never_gone_on_with(self, post: Bench) -> None:
        """Guided ones neither: what is measured later is judged by the base pose that the record names."""
        arm = post.arm
        stopped = arm.armcal("servo", "--guided", "--out", arm.out, "--yes", sets=FEW)  # by the end of its input
        assert stopped.exit_code == 4, stopped.output
        said = {"joint": "c", "target": 0.0, "came": 1, "at": 1.9e9, "counts": 307, "angle": 0.0, "sd": 0.01}
        with (arm.out / "observations.jsonl").open("a") as record:
            record.write(json.dumps({"kind": "angle", **said}) + "\n")
        before = lines(arm.out)
        refused = arm.armcal("servo", "--out", arm.out, "--yes", sets=(*FEW, "bench.servo.base={b: -20 deg}"))
        assert refused.exit_code == 2 and "begun with another base pose" in refused.output
        assert lines(arm.out) == before and len(before) == 2


class TestPulsesThatNoServoBears:
    def test_tables_keep_the_travel_of_their_servos_and_comments_stay(self, tmp_path: Path) -> None:
        """One of 270 degrees is measured over its limits and keeps its ends; knots are not those of another joint."""
        arm = OwnArm(tmp_path, TOWER)
        truth = TOWER_SERVOS.replace("[500.0, 1500.0, 2500.0]", "[510.0, 1500.0, 2492.0]")
        (tmp_path / "true.yaml").write_text(truth)
        with arm.run.simulated() as clock:
            done = arm.armcal("servo", "--out", arm.out, "--yes", sets=("bench.servo.joints=[turn]",))
            assert done.exit_code == 0, done.output
            assert clock.ask({"state": True})["offences"] == {}
        servos = yaml.safe_load(arm.servos.read_text())["servos"]
        assert servos["turn"]["angles_deg"] == [-135, 0, 135]
        assert servos["turn"]["pulses_us"] == pytest.approx([510, 1500, 2492], abs=4)
        assert {**servos, "turn": None} == {**yaml.safe_load(TOWER_SERVOS)["servos"], "turn": None}
        comments = [line.split("#")[1] for line in TOWER_SERVOS.splitlines() if "#" in line]
        assert [line.split("#")[1] for line in arm.servos.read_text().splitlines() if "#" in line] == comments

    def test_nothing_outside_a_servos_range_is_sent_or_written(self, tmp_path: Path) -> None:
        """The true servo needs longer pulses than it bears for its last degrees: its table ends there, and says so."""
        arm = OwnArm(tmp_path, TOWER)
        truth = yaml.safe_load(TOWER_SERVOS)
        truth["servos"]["turn"].update(angles_deg=[-120, 0, 120], pulses_us=[548.9, 1500, 2451.1])
        (tmp_path / "true.yaml").write_text(yaml.safe_dump(truth))
        with arm.run.simulated() as clock:
            done = arm.armcal("servo", "--out", arm.out, "--yes", sets=("bench.servo.joints=[turn]",))
            assert clock.ask({"state": True})["offences"] == {}
        said = " ".join(done.output.split())
        assert "turn: its table reaches from -128.7 to 128.7 deg, not from -135.0 to 135.0 deg" in said
        assert "the servo bears 480 to 2520 us" in said
        servo = yaml.safe_load(arm.servos.read_text())["servos"]["turn"]
        assert servo["pulses_us"][0] == 480 and servo["pulses_us"][-1] == 2520
        assert np.polyfit(servo["angles_deg"], servo["pulses_us"], 1)[0] == pytest.approx(1070 / 135, rel=0.01)

    def test_a_file_with_such_a_pulse_is_refused_by_every_command(self, tmp_path: Path) -> None:
        arm = OwnArm(tmp_path, POST)
        arm.servos.write_text(
            POST_SERVOS.replace("[600.0, 1500.0, 2400.0]}   # new", "[172.7, 1500.0, 2400.0]}   # new")
        )
        plan = arm.plan((0, 0, 0), (10, 10, 10))
        for words in (
            ("acquire", "--plan", plan, "--dry-run"),
            ("rehearse", "--plan", plan, "--out", tmp_path / "rehearsed"),
            ("servo", "--check", "--yes"),
            ("servo", "--out", arm.out, "--yes"),
        ):
            refused = arm.armcal(*words)
            assert refused.exit_code == 2, refused.output
            said = " ".join(refused.output.split())
            assert "servos.yaml:5, servos.b.pulses" in said and "172.7 us" in said and "300 to 2800 us" in said
        assert not arm.out.exists()

    def test_a_base_pose_that_needs_one_is_refused_before_anything_moves(self, post: Bench) -> None:
        narrow = POST_SERVOS.replace("2400.0]}   # new", "2400.0], pulse_range_us: [600.0, 2400.0]}   # new")
        post.arm.servos.write_text(
            narrow.replace(
                "angles_deg: [-100.0, 0.0, 100.0], pulses_us: [600.0, 1500.0, 2400.0], pu",
                "angles_deg: [-40.0, 0.0, 40.0], pulses_us: [600.0, 1500.0, 2400.0], pu",
            )
        )
        refused = post.arm.armcal("servo", "--out", post.arm.out, "--yes", sets=("bench.servo.base={b: 50 deg}",))
        said = " ".join(refused.output.split())
        assert refused.exit_code == 2 and "b, at 50.0 deg, needs a pulse of 2625 us" in said, refused.output
        assert post.first_pulses() == 0
