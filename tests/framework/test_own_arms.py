"""Danger to hardware, on two arms of nobody's, on simulated benches at real ptys: what is refused, sent and named."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from armcal_bench.servo_setup import Record
from armcal_bench.tracker_monitor import Waits

from tests.own_arms import POST, POST_SERVOS, TOWER, TOWER_SERVOS, OwnArm, said_by
from tests.simulated_lines.socket_clock import SimulatedClock

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
    return [dict(entry) for entry in Record(out).entries]


class TestARefusedRunLeavesNothing:
    @pytest.mark.slow
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

    def test_measurements_of_another_base_pose_are_never_gone_on_with(self, post: Bench) -> None:
        """Guided ones neither: what is measured later is judged by the base pose that the record names."""
        arm = post.arm
        stopped = arm.armcal("servo", "--guided", "--out", arm.out, "--yes", sets=FEW)  # by the end of its input
        assert stopped.exit_code == 4, stopped.output
        said = {"joint": "c", "target": 0.0, "came": 1, "at": 1.9e9, "counts": 307, "angle": 0.0, "sd": 0.01}
        with Record(arm.out) as record:
            record.append("angle", said)
        before = lines(arm.out)
        refused = arm.armcal("servo", "--out", arm.out, "--yes", sets=(*FEW, "bench.servo.base={b: -20 deg}"))
        assert refused.exit_code == 2 and "begun with another base pose" in refused.output
        assert lines(arm.out) == before and len(before) == 2


class TestPulsesThatNoServoBears:
    @pytest.mark.slow
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

    @pytest.mark.slow
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
        assert "the servo's pulse_range is 480 to 2520 us" in said
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


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> OwnArm:
    """An arm that was checked, and of which one servo was calibrated then."""
    arm = OwnArm(tmp_path_factory.mktemp("calibrated"), POST)
    with arm.run.simulated():
        assert arm.armcal("servo", "--check", "--yes").exit_code == 0
        assert arm.armcal("servo", "--out", arm.out, "--yes", sets=FEW).exit_code == 0
    return arm


@pytest.fixture(params=[pytest.param(TOWER, marks=pytest.mark.slow), POST], ids=["tower", "post"])
def either(request: pytest.FixtureRequest, tmp_path: Path) -> OwnArm:
    """One of the two arms; its bench does not run yet."""
    return OwnArm(tmp_path, request.param)


def dangers(arm: OwnArm, plan: Path, *sets: str) -> dict[str, Any]:
    """What a dry run says to programs."""
    return dict(json.loads(arm.armcal("acquire", "--plan", plan, "--dry-run", "--json", "-q", sets=sets).output))


class TestUncheckedWiring:
    @pytest.mark.slow
    def test_exchanged_plugs_are_not_driven_until_they_are_put_right_and_seen(self, tmp_path: Path) -> None:
        """The plan keeps within the limits of b and c; exchanged, b is driven 25 degrees beyond its own."""
        arm = OwnArm(tmp_path, POST)
        arm.swap("b", "c")
        plan = arm.plan((0, 30, 85))
        drive = ("acquire", "--plan", plan, "--out", arm.out, "--yes")
        with arm.run.simulated() as clock:
            bench = Bench(arm, clock)
            refused = arm.armcal(*drive)
            assert refused.exit_code == 2 and "(a, b, c: never checked); nothing was moved" in said_by(refused)
            assert bench.first_pulses() == 0
            assert arm.armcal("servo", "--check", "--yes").exit_code == 1
            refused = arm.armcal(*drive)
            assert refused.exit_code == 2 and "(b, c: the last check did not find it right)" in said_by(refused)
            assert "limits" not in bench.offences()
            text = arm.servos.read_text().replace("channel: 1", "channel: 9").replace("channel: 2", "channel: 1")
            arm.servos.write_text(text.replace("channel: 9", "channel: 2"))
            assert arm.armcal(*drive).exit_code == 2  # put right, but not seen
            assert arm.armcal("servo", "--check", "--yes").exit_code == 0
            assert arm.armcal(*drive).exit_code == 0
            assert bench.offences() == {}

    def test_what_was_seen_is_said_where_it_cannot_be_written_down(self, post: Bench) -> None:
        (post.arm.folder / "servos.yaml.checked").mkdir()
        seen = post.arm.armcal("servo", "--check", "--yes")
        assert seen.exit_code == 2 and "servos.yaml.checked: it cannot be written" in said_by(seen)
        assert "b turned by +" in said_by(seen) and "make the folder" in said_by(seen).lower()

    @pytest.mark.slow
    def test_what_it_is_refused_for_is_real(self, tmp_path: Path) -> None:
        arm = OwnArm(tmp_path, POST)
        arm.swap("b", "c")
        plan = arm.plan((0, 30, 85))
        with arm.run.simulated() as clock:
            arm.armcal("acquire", "--plan", plan, "--out", arm.out, "--yes", "--unchecked")
            worst = clock.ask({"state": True})["worst"]["limits"]
        assert worst["joint"] == "b" and math.degrees(worst["value"]) == pytest.approx(85, abs=1)

    @pytest.mark.slow
    def test_a_check_outlasts_armcals_own_changes_and_no_others(self, calibrated: OwnArm) -> None:
        plan, servos = calibrated.plan((0, 0, 0)), calibrated.servos.read_text()
        record = calibrated.folder / "servos.yaml.checked"
        assert servos != POST_SERVOS and dangers(calibrated, plan)["unchecked"] == ""
        calibrated.servos.write_text(servos.replace("channel: 0", "channel: 5"))
        assert "(a: changed since it was checked)" in dangers(calibrated, plan)["unchecked"]
        calibrated.servos.write_text(servos)
        seen = record.read_text()
        record.write_text("{torn")
        assert "(a, b, c: never checked)" in dangers(calibrated, plan)["unchecked"]
        record.write_text(seen)


class TestFirstAndLastMotion:
    @pytest.mark.slow
    def test_jump_and_fall_are_foretold_as_the_simulated_arm_then_bears_them(self, either: OwnArm) -> None:
        plan = either.plan((0,) * len(either.kind["joints"]))
        forecast = {each["kind"]: each for each in dangers(either, plan)["hazards"]}
        done = either.armcal("rehearse", "--plan", plan, "--out", either.out)
        said = said_by(done)
        assert done.exit_code == 0, done.output
        fell = re.search(r"the deepest fall when let go: (\w+) (-?[\d.]+) deg", said)
        jumped = re.search(r"the largest jump at a first pulse: (\w+) (-?[\d.]+) deg", said)
        assert fell and jumped
        assert fell[1] == forecast["drop"]["joint"]
        assert abs(float(fell[2])) == pytest.approx(forecast["drop"]["amount_deg"], abs=2)
        assert abs(float(jumped[2])) <= forecast["first_pulse"]["amount_deg"]
        for kind in ("drop", "first_pulse"):
            amount = f"{forecast[kind]['amount_deg']:.1f} deg"
            assert forecast[kind]["joint"] in forecast[kind]["what"] and amount in forecast[kind]["what"]
            assert " ".join(forecast[kind]["what"].split()) in said

    def test_servos_that_hold_are_not_let_go_and_so_nothing_falls(self, tmp_path: Path) -> None:
        arm = OwnArm(tmp_path, POST)
        kinds = [each["kind"] for each in dangers(arm, arm.plan((0, 0, 0)), "bench.acquisition.at_end=hold")["hazards"]]
        assert kinds == ["first_pulse"]

    def test_a_park_pose_in_which_a_servo_would_not_cool_is_refused(self, tmp_path: Path) -> None:
        arm = OwnArm(tmp_path, POST)
        for words in (("acquire", "--dry-run"), ("rehearse", "--out", arm.out)):
            refused = arm.armcal(*words, "--plan", arm.plan((0, 0, 0)), sets=(TOO_HOT,))
            assert refused.exit_code == 2 and "the servo of b would not cool where the arm parks" in said_by(refused)
            assert "at 30.2 deg" in said_by(refused)

    def test_a_powered_arm_is_not_moved_unasked_and_where_it_stands_is_judged(self, post: Bench) -> None:
        arm, clock = post.arm, post.clock
        sets = ("bench.acquisition.at_end=hold", "bench.acquisition.lost={hold_s: 0.3, park_s: 2}")
        run = ("acquire", "--plan", arm.plan((0, 50, 0), (10, 20, 10)), "--out", arm.out)
        first = arm.armcal("servo", "--check", "--yes", sets=("bench.servo.base={b: 50 deg}",))
        assert first.exit_code == 0 and re.search(r"its first pulse turns b by 12\d\.\d deg", said_by(first))
        clock.ask({"fault": {"kind": "lost", "at": clock.ask({"advance": 0})["now"] + 4}})
        parked = arm.armcal(*run, "--yes", sets=sets)
        assert parked.exit_code == 4, parked.output
        clock.ask({"fault": {"kind": "seen"}})
        pulses = clock.ask({"state": True})["pulses_s"]
        unasked = arm.armcal(*run, "--resume", sets=sets)
        assert unasked.exit_code == 2 and "have pulses, and there is no terminal to ask" in said_by(unasked)
        assert clock.ask({"state": True})["pulses_s"] == pulses and all(pulses.values())
        narrow = ("plan.limits.b=[-20 deg, 20 deg]", "bench.acquisition.park={}", *sets)
        other = ("acquire", "--plan", arm.plan((0, 10, 0)), "--out", arm.folder / "other")
        moved = arm.armcal(*other, "--yes", sets=narrow)
        assert moved.exit_code == 0 and "b stands at 30.2 deg, 10.2 deg beyond its limits" in said_by(moved)


class TestWhatIsMissingIsNoSuccess:
    @pytest.mark.slow
    def test_a_plan_of_which_some_poses_could_not_be_measured(self, post: Bench) -> None:
        """None comes to stand as still as is asked for."""
        arm, clock = post.arm, post.clock
        plan = arm.plan((0, 30, 20), (80, 0, 60))
        sets = ("bench.acquisition.settle.longest_s=3", "bench.acquisition.settle.spread_mm=0.0001")
        done = arm.armcal("acquire", "--plan", plan, "--out", arm.out, "--yes", "--unchecked", sets=sets)
        said = said_by(done)
        assert done.exit_code == 1, done.output
        assert "failed: most poses are missing" in said and "2 of 2 poses are missing" in said
        assert "pose p2 is tried again later" in said
        again = arm.armcal("acquire", "--plan", plan, "--out", arm.out, "--yes", "--unchecked", "--resume", sets=sets)
        assert again.exit_code == 1  # nor is it one when it is asked again
        assert clock.ask({"state": True})["offences"] == {}

    @pytest.mark.slow
    def test_a_calibration_of_which_some_tables_could_not_be_told(self, calibrated: OwnArm) -> None:
        """One joint was measured; what there is is fitted for all three."""
        done = calibrated.armcal("servo", "--out", calibrated.out, "--evaluate")
        assert done.exit_code == 3, done.output
        assert "1 of 3 tables were found; those of a, b are left as they were" in said_by(done)
        pulses = calibrated.pulses()
        assert pulses["a"] == [600, 1500, 2400] and pulses["c"] != [600, 1500, 2400]

    @pytest.mark.slow
    def test_a_rehearsal_in_which_something_was_unsafe(self, tmp_path: Path) -> None:
        """The true servo of b turns a tenth farther than its table says."""
        arm = OwnArm(tmp_path, POST)
        truth = yaml.safe_load(POST_SERVOS)
        truth["servos"]["b"]["angles_deg"] = [-110, 0, 110]
        (tmp_path / "true.yaml").write_text(yaml.safe_dump(truth))
        done = arm.armcal("rehearse", "--plan", arm.plan((0, 59, 0)), "--out", arm.out)
        assert done.exit_code == 3, done.output
        assert re.search(r"limits \d+ times \(worst: b 64\.[5-9] deg, where 62\.0 deg is the limit\)", said_by(done))


class TestWhatIsWaitedFor:
    def test_a_lost_tracker_and_a_lost_board_are_named_at_once_with_the_time_that_is_left(self, post: Bench) -> None:
        arm, clock = post.arm, post.clock
        for kind, at in (("lost", 6), ("seen", 8), ("unplug", 14), ("replug", 17)):
            clock.ask({"fault": {"kind": kind, "at": at}})
        plan = arm.plan((60, 30, 20), (-60, -30, 60), (60, 0, 0))
        done = arm.armcal("acquire", "--plan", plan, "--out", arm.out, "--yes", "--unchecked")
        said = said_by(done)
        assert done.exit_code == 0, done.output
        assert re.search(r"the arm holds: .*tool body .*; waiting for up to (29|30) s\. going on after [12] s\.", said)
        assert re.search(r"the device is looked for: .*; waiting for up to 30 s\. going on after [1-4] s\.", said)

    def test_a_long_one_is_named_again_each_minute(self) -> None:
        said: list[str] = []
        waits = Waits(said.append)
        for second in range(200):
            waits.goes_on("rest", "the servos rest", 200.0 - second, float(second))
        waits.over("rest", 200.0)
        waits.over("rest", 201.0)
        assert [line.split("; ")[-1] for line in said] == [
            "waiting for up to 3 min.",
            "waiting for 60 s now, for up to 2 min more.",
            "waiting for 2 min now, for up to 80 s more.",
            "waiting for 3 min now, for up to 20 s more.",
            "going on after 3 min.",
        ]
