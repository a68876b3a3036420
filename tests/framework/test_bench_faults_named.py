"""What armcal names of what is wrong at a bench, on arms of nobody's, by the commands that a user gives."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest
import yaml

from tests.own_arms import POST, TOWER, OwnArm, said_by

TOWER_POSES = ((0, 30, -40, 0), (60, -20, 50, 40), (-70, 60, -60, -50), (30, -60, 20, 70), (90, 10, -30, -20))
POST_POSES = ((0, 30, -40), (50, -20, 50), (-60, 50, -60), (30, -50, 20), (80, 10, -30))


def acquired(arm: OwnArm, *more: str) -> tuple[int, str]:
    """The exit code and what was said."""
    plan = arm.plan(*(TOWER_POSES if arm.kind is TOWER else POST_POSES))
    done = arm.armcal("acquire", "--plan", plan, "--out", arm.out, "--yes", "--unchecked", *more)
    return done.exit_code, said_by(done)


class TestAFrameThatIsNotTheArms:
    def test_a_left_handed_tracker_ends_the_run_at_the_third_pose_and_it_is_not_resumed(self, tmp_path: Path) -> None:
        arm = OwnArm(tmp_path, TOWER, **{"bench.simulator.tracker.mirrored": "z"})
        with arm.run.simulated() as clock:
            code, said = acquired(arm)
            assert code == 2 and "the frame is left-handed" in said and "(by 3 poses)" in said
            assert "3 of 5 poses measured" in said
            assert len((arm.out / "dataset.csv").read_text().splitlines()) == 4  # nothing measured is lost
            moves = clock.ask({"state": True})["events"]
            code, said = acquired(arm, "--resume")
            assert code == 2 and "nothing was moved" in said and "another --out" in said
            assert clock.ask({"state": True})["events"] == moves

    @pytest.mark.slow
    def test_poses_that_noise_never_lets_settle_show_the_unit_too(self, tmp_path: Path) -> None:
        arm = OwnArm(tmp_path, POST, **{"bench.simulator.tracker.length_gain": 1000})
        with arm.run.simulated():
            code, said = acquired(arm, "--set", "bench.acquisition.settle.longest_s=3")
        assert code == 2 and "as if mm came where m are expected (by 3 poses)" in said

    @pytest.mark.slow
    def test_metres_for_millimetres_are_named_with_their_gain(self, tmp_path: Path) -> None:
        arm = OwnArm(tmp_path, POST, **{"bench.simulator.tracker.length_gain": 0.001})
        with arm.run.simulated():
            code, said = acquired(arm)
        assert code == 2 and "as if m came where mm are expected" in said and "3 of 5 poses measured" in said
        assert json.loads((arm.out / "summary.json").read_text())["how"] == "refused"

    @pytest.mark.parametrize(
        ("setting", "value", "named"), [("length_gain", 1000, "mm came"), ("mirrored", "x", "left-")]
    )
    def test_the_check_of_servos_names_them_and_checks_nothing_off(
        self, tmp_path: Path, setting: str, value: object, named: str
    ) -> None:
        arm = OwnArm(tmp_path, POST, **{f"bench.simulator.tracker.{setting}": value})
        with arm.run.simulated():
            done = arm.armcal("servo", "--check", "--yes", sets=("bench.acquisition.settle.longest_s=3",))
        assert done.exit_code == 2 and named in said_by(done)
        assert not (tmp_path / "servos.yaml.checked").exists()

    @pytest.mark.parametrize(
        ("gain", "named"), [(1000, "as if mm came where m are"), (0.001, "as if m came where mm are")]
    )
    def test_sweeps_of_servos_are_refused_in_other_units_and_leave_no_table(
        self, tmp_path: Path, gain: float, named: str
    ) -> None:
        arm = OwnArm(tmp_path, POST, **{"bench.simulator.tracker.length_gain": gain})
        with arm.run.simulated() as clock:
            sets = ("bench.acquisition.settle.longest_s=3",)
            done = arm.armcal("servo", "--out", arm.out, "--yes", sets=sets)
            assert done.exit_code == 2 and f"{named} expected (by 3 poses)" in said_by(done)
            targets = {joint: state["target_rad"] for joint, state in clock.ask({"state": True})["joints"].items()}
        assert targets == pytest.approx({"a": 0.0, "b": math.radians(30), "c": math.radians(20)}, abs=0.01)
        assert arm.servos.read_text() == arm.kind["servos"]
        assert {file.name for file in arm.out.iterdir()} == {"journal.sqlite.before-1"}

    @pytest.mark.slow
    @pytest.mark.parametrize("joint", ["turn", "lift"])
    def test_sweeps_of_a_servo_that_turns_the_other_way_are_in_the_right_units(
        self, tmp_path: Path, joint: str
    ) -> None:
        arm = OwnArm(tmp_path, TOWER)
        truth = yaml.safe_load(arm.kind["servos"])
        truth["servos"][joint]["pulses_us"].reverse()
        (tmp_path / "true.yaml").write_text(yaml.safe_dump(truth), encoding="utf-8")
        with arm.run.simulated():
            said = said_by(arm.armcal("servo", "--out", arm.out, "--yes"))
        assert f"{joint}: the servo turns the other way than its table said" in said
        assert "times those of the model" not in said


class TestAJointThatGivesWay:
    def test_it_is_said_where_no_pose_settles_with_it_and_the_run_failed(self, tmp_path: Path) -> None:
        arm = OwnArm(tmp_path, TOWER, **{"bench.simulator.joints.lift.creep_deg_per_min": 100})
        with arm.run.simulated():
            code, said = acquired(arm, "--set", "bench.acquisition.settle.longest_s=4")
        assert code == 1 and re.search(r"failed: the target moves by \d+ mm/min while the arm should stand", said)
        assert "Look at the screws of the horns" in said and "done" not in said

    @pytest.mark.slow
    def test_it_is_said_at_the_end_where_it_is_too_slow_to_keep_poses_from_settling(self, tmp_path: Path) -> None:
        arm = OwnArm(tmp_path, TOWER, **{"bench.simulator.joints.lift.creep_deg_per_min": 40})
        with arm.run.simulated():
            code, said = acquired(arm)
        assert code == 3 and re.search(r"done: .*warning: the target moves by \d+ mm/min while", said)
        gives_way = json.loads((arm.out / "summary.json").read_text())["gives_way"]
        assert gives_way["poses"] >= 3 and 20 < gives_way["mm_per_min"] < 120

    @pytest.mark.slow
    def test_nothing_is_said_where_none_does(self, tmp_path: Path) -> None:
        arm = OwnArm(tmp_path, TOWER)
        with arm.run.simulated():
            code, said = acquired(arm)
        assert code == 0 and "should stand" not in said
