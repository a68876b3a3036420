"""Measuring runs at their worst: stalls, full disks, blocked joints, faults at the very moment that hurts most."""

from __future__ import annotations

import errno
import json
import math
import resource
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.arm.clearance import Checked
from armcal.cli.main import cli
from armcal.config.servo_file import load_servo_file
from armcal.devices.device import DeviceError, DeviceRefusedError
from armcal.errors import ArmcalError, InputError
from armcal.io.journal import Journal, JournalFailedError, JournalFullError
from armcal.io.json_server import JsonServer
from armcal.run.experiment import Experiment
from armcal_bench.bench import AcquisitionSettings, ArrivalSettings, Bench, ServoHeatSettings
from armcal_bench.drive import Drive, PathPlanner
from armcal_bench.hazards import FirstMotion
from armcal_bench.preparation import Rest
from armcal_bench.session import Conversation, acquire
from armcal_bench.tracker_monitor import Arrival, TrackerMonitor
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from tests.bench_fakes import COUNT_RAD
from tests.bench_runs import CONFIG, POSES, BenchRun, positions, write_plan
from tests.framework.test_acquisition import Run, torques
from tests.simulated_lines.socket_clock import SimulatedClock

SETS = ("bench.acquisition.lost.park_s=6", "bench.acquisition.period_s=0.04")
AGREE_M = 0.0015
SLOW = pytest.mark.slow
Asked = Callable[[], bool]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    run = BenchRun(tmp_path_factory.mktemp("undisturbed"), SETS)
    with run.simulated():
        run.acquire()
    return positions(run.measured())


@pytest.fixture
def run(tmp_path: Path) -> BenchRun:
    return BenchRun(tmp_path, SETS)


@pytest.fixture
def holding(tmp_path: Path) -> BenchRun:
    """One that leaves the servos on where it parks, so that it is seen where that was."""
    return BenchRun(tmp_path, (*SETS, "bench.acquisition.at_end=hold"))


def never() -> bool:
    return False


def is_let_go(state: dict[str, Any]) -> bool:
    return all(pulse is None for pulse in state["pulses_s"].values())


def is_parked(state: dict[str, Any]) -> bool:
    """Where it is told to be, by the true tables; the park pose is q2 = -50, q4 = -10 deg."""
    targets = {joint: s["target_rad"] for joint, s in state["joints"].items()}
    park = {"q1": 0.0, "q2": -50.0, "q3": 0.0, "q4": -10.0, "q5": 0.0, "q6": 0.0}
    return all(targets[j] is not None and abs(math.degrees(targets[j]) - a) < 2.5 for j, a in park.items())


class TestHostThatStalls:
    """Another client lets the time pass: to the board the host is silent, as one that was stopped or swapped out."""

    @pytest.mark.slow
    @pytest.mark.parametrize("seconds", [pytest.param(0.8, marks=SLOW), pytest.param(1.5, marks=SLOW), 10.0])
    def test_while_it_measures(
        self, run: BenchRun, undisturbed: dict, seconds: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        begun = [0, 0]
        begin = TrackerMonitor.begin

        def counted(monitor: TrackerMonitor) -> None:
            begun[0] += 1
            begin(monitor)

        monkeypatch.setattr(TrackerMonitor, "begin", counted)
        with run.simulated() as clock:

            def asked() -> bool:
                begun[1] = begun[1] + 1 if begun[0] == 2 else 0
                if begun[1] == 8:
                    clock.ask({"advance": seconds})
                return False

            assert run.acquire(asked).ending.how == "done"
            state = clock.ask({"state": True})
        assert state["offences"] == {}
        found = positions(run.measured())
        assert set(found) == set(undisturbed)
        for name, position in found.items():
            assert np.linalg.norm(position - undisturbed[name]) < AGREE_M, name

    @pytest.mark.slow
    def test_while_it_moves(self, run: BenchRun, undisturbed: dict) -> None:
        with run.simulated() as clock:
            looks = [0]

            def asked() -> bool:
                looks[0] += 1
                if looks[0] in (60, 170, 200):
                    clock.ask({"advance": 3.0})
                return False

            assert run.acquire(asked).ending.how == "done"
            assert clock.ask({"state": True})["offences"] == {}
        assert set(positions(run.measured())) == set(undisturbed)

    @pytest.mark.slow
    def test_while_somebody_thinks_about_energising(self, run: BenchRun) -> None:
        """After a run that was killed; the board has a way home of a leg that is long past."""
        with run.simulated() as clock:
            assert run.acquire_until_killed(300)
            clock.ask({"fault": {"kind": "silent"}})

            def thinks(motion: FirstMotion) -> bool:
                clock.ask({"advance": 20.0})
                return True

            clock.ask({"fault": {"kind": "seen"}})
            talk = Conversation(never, thinks)
            assert acquire(run.prepared(), run.plan, run.out, "resume", talk, unchecked=True).ending.how == "done"
            assert clock.ask({"state": True})["offences"] == {}


class TestJournalThatFails:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("fault", "call", "after"),
        [
            pytest.param(JournalFullError("no room"), "record", 3, marks=SLOW),
            pytest.param(JournalFullError("no room"), "note", 3, marks=SLOW),
            (JournalFullError("no room"), "note", 14),
            pytest.param(JournalFailedError("the disk fails"), "note", 14, marks=SLOW),
            (JournalFailedError("the disk fails"), "record", 14),
        ],
    )
    def test_the_arm_is_parked_and_the_run_can_go_on(
        self, holding: BenchRun, undisturbed: dict, fault: ArmcalError, call: str, after: int, monkeypatch: Any
    ) -> None:
        run = holding
        write, calls = getattr(Journal, call), [0]

        def failing(journal: Journal, kind: str, content: Any) -> int:
            calls[0] += 1
            if calls[0] > after:
                raise fault
            return int(write(journal, kind, content))

        with run.simulated() as clock:
            with monkeypatch.context() as patch:
                patch.setattr(Journal, call, failing)
                with pytest.raises(type(fault), match=str(fault)):
                    run.acquire()
            state = clock.ask({"state": True})
            assert state["offences"] == {}
            assert is_parked(state) or (after == 3 and call == "record")
            assert run.acquire().ending.how == "done"
        measured = [content["pose"] for content in run.entries("measured")]
        assert sorted(measured) == sorted(undisturbed)

    @pytest.mark.slow
    def test_a_limit_of_file_size(self, run: BenchRun, monkeypatch: pytest.MonkeyPatch) -> None:
        write, calls, unlimited = Journal.record, [0], resource.getrlimit(resource.RLIMIT_FSIZE)

        def limited(journal: Journal, kind: str, content: Any) -> int:
            calls[0] += 1
            if calls[0] == 40:
                size = journal.path.with_name(f"{journal.path.name}-wal").stat().st_size
                resource.setrlimit(resource.RLIMIT_FSIZE, (size, unlimited[1]))
            return write(journal, kind, content)

        with run.simulated() as clock:
            with monkeypatch.context() as patch:
                patch.setattr(Journal, "record", limited)
                with pytest.raises(JournalFullError, match="no room for an entry"):
                    run.acquire()
            resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
            assert is_let_go(clock.ask({"state": True}))
            assert run.acquire().ending.how == "done"

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "fault", [pytest.param(RuntimeError("a bug"), marks=SLOW), BrokenPipeError(errno.EPIPE, "nobody reads")]
    )
    def test_so_it_is_after_any_other_fault(self, holding: BenchRun, fault: Exception) -> None:
        run = holding
        write_plan(run.plan, POSES[:2])

        def told(progress: Any, total: int) -> None:
            raise fault

        with run.simulated() as clock:
            talk = Conversation(never, lambda start: True, told)
            with pytest.raises(type(fault)):
                acquire(run.prepared(), run.plan, run.out, "anew", talk, unchecked=True)
            state = clock.ask({"state": True})
            assert is_parked(state) and state["offences"] == {}
            assert run.acquire().ending.how == "done"
        assert len(run.entries("measured")) == 2


class TestAskedToEnd:
    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["nack", pytest.param("unplug", marks=SLOW), pytest.param("reset", marks=SLOW)])
    def test_a_passing_fault_on_the_way_home_does_not_leave_the_arm_standing(
        self, holding: BenchRun, kind: str
    ) -> None:
        run = holding
        with run.simulated() as clock:
            looks = [0]

            def asked() -> bool:
                looks[0] += 1
                if looks[0] == 150:
                    now = clock.ask({"state": True})["now"]
                    clock.ask({"fault": {"kind": kind, "at": now + 0.5}})
                    if kind == "unplug":
                        clock.ask({"fault": {"kind": "replug", "at": now + 0.9}})
                return looks[0] >= 150

            assert run.acquire(asked).ending.how == "parked"
            state = clock.ask({"state": True})
        assert is_parked(state) and state["offences"] == {}

    @pytest.mark.slow
    def test_while_the_question_is_put(self, run: BenchRun) -> None:
        answered = [False]

        def answer(motion: FirstMotion) -> bool:
            answered[0] = True
            return True

        with run.simulated() as clock:
            talk = Conversation(lambda: answered[0], answer)
            with pytest.raises(InputError, match="nothing was moved"):
                acquire(run.prepared(), run.plan, run.out, "anew", talk, unchecked=True)
            assert clock.ask({"state": True})["events"] == {}


class TestBoard:
    @pytest.mark.slow
    def test_a_brown_out_gives_joints_the_angles_that_they_had(self, run: BenchRun) -> None:
        """Not those at which the way began."""
        with run.simulated() as clock:
            looks, had = [0], {}

            def asked() -> bool:
                looks[0] += 1
                if looks[0] == 190:
                    had.update({j: s["target_rad"] for j, s in clock.ask({"state": True})["joints"].items()})
                    clock.ask({"fault": {"kind": "brown_out"}})
                return False

            assert run.acquire(asked).ending.how == "done"
            assert clock.ask({"state": True})["offences"] == {}
        again = {c["joint"]: c["angle"] for c in run.entries("energised")[6:]}
        assert set(again) == set(had)
        for joint, angle in again.items():
            assert angle == pytest.approx(had[joint], abs=math.radians(2.5)), joint

    @pytest.mark.parametrize("kind", [pytest.param("nack", marks=SLOW), "unplug", pytest.param("reset", marks=SLOW)])
    def test_joints_that_were_let_go_are_not_begun_again(self, run: BenchRun, kind: str, monkeypatch: Any) -> None:
        write_plan(run.plan, POSES[:1])
        release = Drive.release
        with run.simulated() as clock:

            def released(drive: Drive) -> None:
                now = clock.ask({"state": True})["now"]
                if not planned:
                    planned.append(now)
                    clock.ask({"fault": {"kind": kind, "at": now + 0.6}})
                    clock.ask({"fault": {"kind": "replug", "at": now + 1.6}} if kind == "unplug" else {"advance": 0})
                release(drive)

            planned: list[float] = []
            monkeypatch.setattr(Drive, "release", released)
            assert run.acquire().ending.how == "done"
            state = clock.ask({"state": True})
        assert is_let_go(state) and state["events"]["first_pulse"] == 6

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["reset", "brown_out", "unplug", "stuck"])
    @pytest.mark.parametrize("seconds", [0.3, 1.2, 2.9])
    def test_faults_while_joints_are_energised(self, run: BenchRun, kind: str, seconds: float) -> None:
        with run.simulated() as clock:
            clock.ask({"fault": {"kind": kind, "at": seconds, "seconds": 0.4}})
            clock.ask({"fault": {"kind": "replug", "at": seconds + 0.5}} if kind == "unplug" else {"advance": 0})
            assert run.acquire().ending.how == "done"
            assert clock.ask({"state": True})["offences"] == {}

    @pytest.mark.slow
    def test_unplugged_as_it_is_opened(self, run: BenchRun) -> None:
        with run.simulated() as clock:
            clock.ask({"fault": {"kind": "unplug"}})
            with pytest.raises(DeviceRefusedError, match="no such serial port"):
                run.acquire()
            clock.ask({"fault": {"kind": "replug"}})
            assert run.acquire().ending.how == "done", "a run that was refused is no run"

    @pytest.mark.slow
    def test_what_was_refused_may_be_begun_anew_with_another_configuration(self, run: BenchRun, tmp_path: Path) -> None:
        with run.simulated() as clock:
            clock.ask({"fault": {"kind": "silent"}})
            with pytest.raises(DeviceRefusedError, match="tracker"):
                run.acquire()
        other = BenchRun(tmp_path, (*SETS, "bench.acquisition.settle.window_s=0.9"))
        with other.simulated():
            talk = Conversation(never, lambda start: True)
            assert acquire(other.prepared(), other.plan, other.out, "anew", talk, unchecked=True).ending.how == "done"

    def test_pulses_that_are_not_those_that_were_told_are_not_measured(self) -> None:
        """Another program, or a chip that lost its supply and nothing else."""
        run = Run()
        drive = run.acquisition()._drive
        run.device.running = {"q1": 0.0, "q2": 0.0}
        assert drive.standing() == {"q1": 0.0, "q2": 0.0}
        run.device.running["q1"] = 5 * COUNT_RAD
        with pytest.raises(DeviceError, match=r"2\.66 deg for q1, expected 0\.00 deg"):
            drive.standing()
        del run.device.running["q1"]
        with pytest.raises(DeviceError, match="no pulses for q1"):
            drive.standing()

    def test_the_device_is_looked_at_while_the_arm_moves(self) -> None:
        """A chip that forgot its set-up must not be driven on to the end of the way."""
        run, alive = Run(), []
        run.device.keep_alive = lambda: alive.append(run.clock.now())  # type: ignore[method-assign]
        assert run.run() == "done"
        assert max(np.diff(alive)) < 0.2 + 1e-9

    def test_the_board_is_never_left_with_the_way_home_of_another_leg(self) -> None:
        run = Run()
        made = run.acquisition()
        made._drive._planner.find = lambda start, goal: None  # type: ignore[method-assign]
        made._drive.take_over({"q1": 0.4, "q2": 0.2})
        made._drive._guard(made._drive.at)
        assert run.device.guards[-1] == [{"q1": 0.4, "q2": 0.2}]

    @pytest.mark.slow
    def test_two_boards_on_one_link(self, tmp_path: Path) -> None:
        for name in ("servos.yaml", "bench_servos.yaml"):
            text = (CONFIG.parent / name).read_text()
            first = next(line for line in text.splitlines() if line.startswith("  front:"))
            second = first.replace("front", "back").replace("0x40", "0x41")
            second = second.replace("25060000.0", "24800000.0").replace("25000000.0", "24900000.0")
            text = text.replace(first, first + "\n" + second)
            for joint in ("q4", "q5", "q6"):
                text = text.replace(f"{joint}: {{board: front", f"{joint}: {{board: back")
            (tmp_path / name).write_text(text)
        places = (
            f"bench.device.servos={tmp_path / 'servos.yaml'}",
            f"bench.simulator.servos={tmp_path / 'bench_servos.yaml'}",
        )
        run = BenchRun(tmp_path, (*SETS, *places, f"arms.arm.effects.counts.servos={tmp_path / 'servos.yaml'}"))
        assert load_servo_file(tmp_path / "servos.yaml").boards["back"].address == 0x41
        with run.simulated() as clock:
            looks = [0]

            def asked() -> bool:
                looks[0] += 1
                if looks[0] in (80, 260):
                    clock.ask({"advance": 4.0} if looks[0] == 80 else {"fault": {"kind": "brown_out"}})
                return False

            assert run.acquire(asked).ending.how == "done"
            state = clock.ask({"state": True})
        assert state["offences"] == {} and state["violations"] == 0 and is_let_go(state)
        assert len(run.measured().ids) == len(POSES)


class TestNobodyFeelsWhereTheArmIs:
    @pytest.mark.slow
    def test_a_joint_that_does_not_arrive_is_not_measured_as_if_it_had(self, tmp_path: Path) -> None:
        blocked = "bench.simulator.joints={all: {backlash_deg: 0.1}, q3: {travel_deg: [-60, 30]}}"
        run = BenchRun(tmp_path, (*SETS, blocked))
        far = (
            (0,) * 6,
            (40, -30, 20, -50, 30, 20),
            (-60, 20, -10, 40, -40, -30),
            (20, -20, 90, 0, 0, 0),
            (50, 30, -50, 80, 60, 10),
        )
        write_plan(run.plan, far)
        with run.simulated():
            outcome = run.acquire()
        assert outcome.ending.how == "done"
        assert set(run.progress().measured) == {"p1", "p2", "p3", "p5"}
        assert "not where it was commanded to be" in run.progress().left_out["p4"]

    @pytest.mark.slow
    def test_an_arm_that_never_arrives_is_parked(self, tmp_path: Path) -> None:
        run = BenchRun(tmp_path, SETS)
        with run.simulated() as clock:
            looks = [0]

            def asked() -> bool:
                looks[0] += 1
                return False

            pose = TrackerMonitor.settled

            def slipped(monitor: TrackerMonitor) -> Any:
                found = pose(monitor)
                if not isinstance(found, str) and run_measured() >= 1:
                    found.base_T_target[:3, 3] += [0.0, 2.0, 2.0]
                return found

            def run_measured() -> int:
                return len(seen)

            seen: list[Any] = []
            talk = Conversation(asked, lambda start: True, lambda progress, total: seen.append(progress))
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(TrackerMonitor, "settled", slipped)
                outcome = acquire(run.prepared(), run.plan, run.out, "anew", talk, unchecked=True)
            assert outcome.ending.how == "parked" and "3 times in a row" in outcome.ending.sentence
            assert is_let_go(clock.ask({"state": True}))

    @pytest.mark.parametrize("knows_rotations", [True, False])
    def test_frames_do_not_matter(self, knows_rotations: bool) -> None:
        random = np.random.default_rng(1)
        expected = np.tile(np.eye(4), (8, 1, 1))
        expected[:, :3, 3] = random.uniform(-0.4, 0.4, (8, 3))
        expected[:, :3, :3] = Rotation.random(8, rng=random).as_matrix()
        world, target = np.eye(4), np.eye(4)
        world[:3, :3], world[:3, 3] = Rotation.from_rotvec([1.0, -2.0, 0.4]).as_matrix(), [5.0, -3.0, 1.0]
        target[:3, :3], target[:3, 3] = Rotation.from_rotvec([0.5, 0.2, 2.0]).as_matrix(), [0.01, -0.02, 0.01]
        seen = world @ expected @ target
        seen[:, :3, 3] += random.normal(0, 0.005, (8, 3))
        if not knows_rotations:
            seen[:, :3, :3] = np.nan
        measured, arrival = dict(enumerate(seen)), Arrival(expected, ArrivalSettings())
        assert not any(arrival.doubt(i, seen[i], measured) for i in range(8))
        elsewhere = seen[2].copy()
        elsewhere[:3, 3] += [0.0, 0.0, 0.5]
        assert arrival.doubt(2, elsewhere, measured)
        turned = seen[2].copy()
        turned[:3, :3] = turned[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, 1.0]).as_matrix()
        assert bool(arrival.doubt(2, turned, measured)) == knows_rotations
        assert arrival.doubt(0, seen[0], {}) == ""


class TestTracker:
    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["frozen", pytest.param("silent", marks=SLOW), pytest.param("lost", marks=SLOW)])
    def test_lost_exactly_as_the_arm_settles(
        self, run: BenchRun, undisturbed: dict, kind: str, monkeypatch: Any
    ) -> None:
        begin, begun, poses = TrackerMonitor.begin, [0], 2
        write_plan(run.plan, POSES[:poses])
        with run.simulated() as clock:

            def counted(monitor: TrackerMonitor) -> None:
                begun[0] += 1
                if begun[0] % 2:
                    now = clock.ask({"state": True})["now"]
                    clock.ask({"fault": {"kind": kind, "at": now + 0.9}})
                    clock.ask({"fault": {"kind": "seen", "at": now + 1.25}})
                begin(monitor)

            monkeypatch.setattr(TrackerMonitor, "begin", counted)
            assert run.acquire().ending.how == "done"
        found = positions(run.measured())
        assert set(found) == set(sorted(undisturbed)[:poses])
        assert all(np.linalg.norm(found[name] - undisturbed[name]) < AGREE_M for name in found)

    @pytest.mark.slow
    def test_one_that_comes_and_goes_does_not_keep_the_arm_for_ever(self, tmp_path: Path) -> None:
        flickers = ("bench.simulator.tracker.occluded={tool: 0.5}", "bench.simulator.tracker.occlusion_s=1")
        run = BenchRun(tmp_path, (*SETS, *flickers))
        with run.simulated() as clock:
            outcome = run.acquire()
            state = clock.ask({"state": True})
        assert outcome.ending.how in ("done", "parked") and state["offences"] == {}
        assert state["now"] < 2 * len(POSES) * 40 + 60

    def test_a_pose_that_hides_the_body_does_not_end_the_run(self) -> None:
        """The arm is held before it, and would be for ever; where it parks, the tracker sees it again."""
        run, since = Run(), [0.0]

        def trouble() -> tuple[float, str]:
            at = np.array([run.device.running.get(joint, 0.0) for joint in run.device.joint_names])
            if np.abs(at - run.poses[3]).max() > 0.1:
                since[0] = run.clock.now()
            return run.clock.now() - since[0], "body lost"

        run.monitor.trouble = trouble  # type: ignore[method-assign]
        run.clock.at.append((5000.0, lambda: pytest.fail("it never ends")))
        assert run.run() == "done"
        assert list(run.log.progress.left_out) == ["p3"] and "body lost" in run.log.progress.left_out["p3"]

    @pytest.mark.parametrize("motion", ["still", "moving"])
    @pytest.mark.slow
    def test_a_base_body_that_stays_out_of_sight_makes_it_park_and_leaves_nothing_out(
        self, tmp_path: Path, motion: str
    ) -> None:
        run = BenchRun(tmp_path, (*SETS, f"bench.bodies.base_motion={motion}"))
        with run.simulated() as clock:
            clock.ask({"fault": {"kind": "lost", "body": "base", "at": 10}})
            outcome = run.acquire()
            assert is_let_go(clock.ask({"state": True}))
        assert outcome.ending.how == "parked" and "base body" in outcome.ending.sentence
        assert run.progress().left_out == {}

    @pytest.mark.slow
    def test_nor_does_one_that_does_so_for_hours(self) -> None:
        run = Run()
        run.monitor.restless.update(tuple(round(a, 6) for a in pose) for pose in run.poses)
        run.monitor.trouble = lambda: (0.6, "silent") if run.clock.now() % 1.2 < 0.6 else (0.0, "")  # type: ignore[method-assign]
        run.clock.at.append((5000.0, lambda: pytest.fail("it never ends")))
        assert run.run() == "failed"
        assert len(run.log.progress.left_out) == len(run.poses)

    @pytest.mark.slow
    def test_frames_from_before_are_not_taken_for_frames_of_now(self, run: BenchRun) -> None:
        with run.simulated() as clock:
            bench = Bench.of(run.experiment)
            own = bench.settings
            monitor = TrackerMonitor(bench.tracker(), clock, own.acquisition.settle, own.bodies)
            monitor.open()
            try:
                clock.sleep(0.5)
                monitor.begin()
                clock.sleep(0.001)
                monitor.look()
                assert len(monitor._frames) <= 1
            finally:
                monitor.close()


class TestHeat:
    def test_an_arm_that_is_held_for_long_does_not_burn(self) -> None:
        """Held by a tracker that stays away, in a pose that costs more than the servo bears."""
        heat = {"q2": ServoHeatSettings.si(continuous=1.0, winding_time=20.0, case_time=30.0, budget=0.5)}
        run = Run(AcquisitionSettings.si(lost={"hold_s": 0.5, "park_s": 600}), heat=heat)
        run.clock.at += [
            (8.0, lambda: setattr(run.monitor, "blind_since", 8.0)),
            (400.0, lambda: setattr(run.monitor, "blind_since", None)),
        ]
        run.run()
        heats = [float(np.dot([0.3, 0.7], c["warmth"]["q2"])) for kind, c in run.log.entries if "warmth" in c]
        assert max(heats) < 0.6

    def test_a_rest_ends_though_another_servo_warms_in_it(self) -> None:
        run = Run(heat={joint: ServoHeatSettings.si(continuous=1.3) for joint in ("q1", "q2")})
        run.clock.at.append((3600.0, lambda: pytest.fail("it rests for ever")))
        acquisition = run.acquisition()
        drive = acquisition._drive
        drive.take_over({"q1": 0.0, "q2": 0.0})
        run.device.running = {"q1": 0.0, "q2": 0.0}
        expected = drive.thermal_state.model.after(np.array([[0.90, 0.5], [0.0, 0.0]]), torques(drive.at), 20.0)
        drive.thermal_state.warmth = np.array([[0.95, 0.5], [0.0, 0.0]])
        acquisition._rest(Rest((drive.at,), 20.0, expected))
        assert 20 < run.clock.now() < 120


class TestPlans:
    def sub(self, tmp_path: Path, poses: tuple[tuple[float, ...], ...], *sets: str) -> BenchRun:
        run = BenchRun(tmp_path, (*SETS, *sets))
        write_plan(run.plan, poses)
        return run

    @pytest.mark.slow
    def test_one_pose_the_park_pose_and_equal_poses(self, tmp_path: Path) -> None:
        park = (0, -50, 0, -10, 0, 0)
        run = self.sub(tmp_path, (park, park, (10, 0, 0, 0, 0, 0), (10, 0, 0, 0, 0, 0)))
        with run.simulated() as clock:
            assert run.acquire().ending.how == "done"
            assert clock.ask({"state": True})["offences"] == {}
        assert len(run.measured().ids) == 4

    @pytest.mark.slow
    def test_limits_wider_than_the_pulse_tables(self, tmp_path: Path) -> None:
        """Neither play nor a way round may lead where there are no pulses."""
        wide = tuple(f"plan.limits.{joint}=[-120 deg, 120 deg]" for joint in ("q1", "q4"))
        park = "bench.acquisition.park={q1: -100 deg, q2: -50 deg, q4: -10 deg}"
        run = self.sub(
            tmp_path, ((-100, 0, 0, 0, 0, 0), (100, 0, 0, 0, 0, 10)), *wide, park, "bench.acquisition.heat={}"
        )
        prepared = run.prepared()
        device = prepared.device
        for pose in prepared.scheduler.planner._roadmap:
            device.standing(dict(zip(device.joint_names, pose.tolist(), strict=True)))
        with run.simulated() as clock:
            assert run.acquire(prepared=prepared).ending.how == "done"
            assert clock.ask({"state": True})["offences"] == {}

    def test_a_pose_twice_by_its_name(self, tmp_path: Path) -> None:
        plan = write_plan(tmp_path / "p.csv")
        plan.write_text(plan.read_text().replace("p2,", "p1,"))
        result = CliRunner().invoke(cli, ["acquire", str(CONFIG), "--plan", str(plan), "--dry-run"])
        assert result.exit_code == 2 and "p1" in result.output and "Traceback" not in result.output


class _Wall:
    """Joint 1 must not be above 0.5 rad, but for what it is already."""

    def __call__(self, poses: np.ndarray) -> Checked:
        return Checked(0.5 - poses[:1])


class TestWays:
    def test_where_there_is_no_way_none_is_found_and_it_is_looked_for_alive(self) -> None:
        """A wall across the whole joint space."""

        def wall(poses: np.ndarray) -> Checked:
            return Checked(np.abs(poses[:1]) - 0.1)

        alive: list[int] = []
        planner = PathPlanner(wall, np.array([[-1.0, 1.0]] * 2), np.zeros((0, 2)), 0.02)  # type: ignore[arg-type]
        planner.meanwhile = lambda: alive.append(1)
        assert planner.find(np.array([-0.5, 0.0]), np.array([0.5, 0.0])) is None
        assert len(alive) > 100

    def test_an_arm_that_stands_too_near_goes_away_from_it(self) -> None:
        planner = PathPlanner(_Wall(), np.array([[-1.0, 1.0]] * 2), np.zeros((1, 2)), 0.02)  # type: ignore[arg-type]
        way = planner.find(np.array([0.52, 0.3]), np.array([0.4, -0.5]))
        assert way is not None and np.allclose(way[0], [0.52, 0.3]) and np.allclose(way[-1], [0.4, -0.5])
        assert all(np.diff([pose[0] for pose in way[:2]]) <= 0)

    def test_no_way_leads_into_what_is_too_near(self) -> None:
        planner = PathPlanner(_Wall(), np.array([[-1.0, 1.0]] * 2), np.zeros((1, 2)), 0.02)  # type: ignore[arg-type]
        assert planner.find(np.array([0.52, 0.3]), np.array([0.6, 0.3])) is None


class TestResume:
    @pytest.mark.slow
    def test_a_run_that_is_done_needs_no_bench_to_write_its_data_anew(self, run: BenchRun) -> None:
        write_plan(run.plan, POSES[:2])
        with run.simulated() as clock:
            run.acquire()
            first = (run.out / "dataset.csv").read_text()
            (run.out / "dataset.csv").unlink()
            clock.ask({"fault": {"kind": "unplug"}})
            outcome = run.acquire()
            assert outcome.ending.how == "done" and outcome.summary["measured"] == 2
            assert clock.ask({"state": True})["events"]["first_pulse"] == 6
        assert (run.out / "dataset.csv").read_text() == first
        assert json.loads((run.out / "summary.json").read_text())["board"]

    @pytest.mark.slow
    def test_months_later_and_with_a_wall_clock_that_went_back(self, run: BenchRun, monkeypatch: Any) -> None:
        wall = SimulatedClock.wall
        with run.simulated():
            looks = [0]

            def asked() -> bool:
                looks[0] += 1
                return looks[0] > 250

            assert run.acquire(asked).ending.how == "parked"
            before = len(run.entries("measured"))
            monkeypatch.setattr(SimulatedClock, "wall", lambda clock: wall(clock) - 3e7)
            looks[0] = 0
            run.acquire(asked)
            monkeypatch.setattr(SimulatedClock, "wall", lambda clock: wall(clock) + 3e7)
            assert run.acquire().ending.how == "done"
        assert before >= 1 and len(run.entries("measured")) == len(POSES)
        thermal_state = [c["warmth"] for c in run.entries("going")]
        assert all(0 <= part < 2 for each in thermal_state for parts in each.values() for part in parts)
        data = Experiment.load(CONFIG, data=run.out / "dataset.csv").read()
        assert sorted(data.ids) == ["p1", "p2", "p3", "p4"] and not data.has("time")
        assert "set back" in json.loads((run.out / "summary.json").read_text())["times"]


class TestFolders:
    def refused(self, tmp_path: Path, out: Path, plan: Path) -> str:
        sets = ["--set", f"bench.link.port={tmp_path / 'nothing'}"]
        result = CliRunner().invoke(
            cli, ["acquire", str(CONFIG), "--plan", str(plan), "--out", str(out), "--yes", *sets]
        )
        assert result.exit_code == 2, (result.output, result.exception)
        assert "Traceback" not in result.output
        return result.output

    def test_a_file(self, tmp_path: Path) -> None:
        plan = write_plan(tmp_path / "p.csv")
        assert "it is a file" in self.refused(tmp_path, plan, plan)
        self.refused(tmp_path, plan / "below", plan)

    def test_a_circle_of_links(self, tmp_path: Path) -> None:
        (tmp_path / "a").symlink_to(tmp_path / "b")
        (tmp_path / "b").symlink_to(tmp_path / "a")
        self.refused(tmp_path, tmp_path / "a", write_plan(tmp_path / "p.csv"))
        self.refused(tmp_path, tmp_path / "a" / "x", tmp_path / "p.csv")

    def test_a_name_that_is_too_long(self, tmp_path: Path) -> None:
        self.refused(tmp_path, tmp_path / ("x" * 300), write_plan(tmp_path / "p.csv"))

    def test_no_folder_below_a_device(self, tmp_path: Path) -> None:
        self.refused(tmp_path, Path("/proc/nothing"), write_plan(tmp_path / "p.csv"))

    def test_a_long_path_of_a_simulated_bench(self, tmp_path: Path) -> None:
        folder = tmp_path / ("y" * 120)
        folder.mkdir()
        server = JsonServer.at(folder / "clock", "taken", "hint", lambda request: {"now": 1.5, "wall": 2.5})
        with closing(server), ThreadPoolExecutor(1) as pool:
            clock = pool.submit(SimulatedClock, folder / "clock")
            while not clock.done():
                server.serve(0.01)
        with closing(clock.result()) as read:
            assert (read.now(), read.wall()) == (1.5, 2.5)

    @pytest.mark.slow
    def test_letters_of_other_alphabets(self, tmp_path: Path) -> None:
        folder = tmp_path / "Messung Ärm 臂"
        folder.mkdir()
        run = BenchRun(folder, SETS)
        with run.simulated():
            assert run.acquire().ending.how == "done"

    @pytest.mark.slow
    def test_two_runs_in_one_folder(self, run: BenchRun) -> None:
        with run.simulated():
            refusals: list[str] = []

            def asked() -> bool:
                if not refusals:
                    with pytest.raises(InputError) as refused:
                        run.acquire()
                    refusals.append(str(refused.value))
                return False

            assert run.acquire(asked).ending.how == "done"
        assert "another" in refusals[0]
