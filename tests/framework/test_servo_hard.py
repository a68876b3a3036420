"""Servo calibrations at their worst: the arm is never unsafe, nothing measured is lost, no wrong table is written."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from armcal.config.servo_file import BoardSettings, ServoFile, load_servo_file
from armcal.devices.device import DeviceError
from armcal.errors import ArmcalError, DataError, InputError
from armcal_bench.drive import Drive
from armcal_bench.hazards import HeatModel, ThermalState
from armcal_bench.servo_fit import improved, write_servo_file
from armcal_bench.servo_session import evaluated, measure
from armcal_bench.servo_setup import Record
from armcal_bench.session import Conversation
from armcal_bench.tracker_monitor import StopRequested

from tests.bench_fakes import FakeClock
from tests.framework.test_acquire_faults import faults
from tests.servo_fakes import CONFIGS, config_in, setup_on
from tests.servo_runs import SETS, ServoRun, put_rows

MANY = 150
SECONDS = 50.0
"""What a calibration takes when nothing goes wrong."""
KINDS = ("drop", "duplicate", "reorder", "flip", "split", "unplug", "reset", "brown_out", "nack", "stuck")
KINDS += ("lost", "silent", "frozen", "stall", "asked", "kill")
AGREE_US = 4.0
"""Counts of 4.9 us, and play taken up from energising in another pose."""


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> ServoRun:
    """One that nothing disturbed."""
    run = ServoRun(tmp_path_factory.mktemp("undisturbed"))
    with run.run.simulated() as clock:
        run.measure()
        state = clock.ask({"state": True})
    assert state["offences"] == {} and state["violations"] == 0
    return run


@pytest.fixture(scope="module")
def undisturbed(done: ServoRun) -> dict[str, np.ndarray]:
    return done.pulses()


@pytest.fixture
def run(tmp_path: Path) -> ServoRun:
    return ServoRun(tmp_path)


class Troubled:
    """One calibration through random troubles, gone on with until it is done."""

    def __init__(self, run: ServoRun, seed: int) -> None:
        self.run, self.random = run, np.random.default_rng(seed)
        self.kinds = [str(k) for k in self.random.choice(KINDS, int(self.random.integers(1, 4)), replace=False)]
        self.said: list[str] = []

    def go(self) -> dict[str, Any]:
        """Through the troubles and to the end; gives the bench's own account."""
        with self.run.run.simulated() as clock:
            for kind in self.kinds:
                if kind not in ("stall", "asked", "kill"):
                    for fault in faults(self.random, kind):
                        clock.ask({"fault": fault})
            if "kill" in self.kinds:
                self.run.measure_until_killed(int(self.random.integers(3, 1200)))
                clock.ask({"advance": float(self.random.uniform(0, 8))})
            self._once(self._asked(clock))
            for _ in range(6):
                if self.said[-1] == "done":
                    break
                clock.ask({"advance": 12.0})
                self._once(lambda: False)
            return clock.ask({"state": True})

    def _once(self, asked: Callable[[], bool]) -> None:
        try:
            self.run.measure(asked)
            self.said.append("done")
        except (StopRequested, DeviceError, ArmcalError) as end:
            self.said.append(f"{type(end).__name__}: {end}")

    def _asked(self, clock: Any) -> Callable[[], bool]:
        when, stall, seen = int(self.random.uniform(50, 1200)), int(self.random.uniform(50, 1200)), [0]
        seconds = float(self.random.uniform(0.5, 12))

        def asked() -> bool:
            seen[0] += 1
            if "stall" in self.kinds and seen[0] == stall:
                clock.ask({"advance": seconds})
            return "asked" in self.kinds and seen[0] > when

        return asked


def judge(run: ServoRun, seed: int, undisturbed: dict[str, np.ndarray]) -> None:
    troubled = Troubled(run, seed)
    state = troubled.go()
    told = f"seed {seed}, {troubled.kinds}: {troubled.said}"
    assert state["offences"] == {}, f"{told}: {state['offences']}"
    assert state["failed"] == [], told
    assert troubled.said[-1] == "done", told
    lines = [(e["joint"], e["counts"], e["came"]) for e in run.rows() if "counts" in e]
    assert len(lines) == len(set(lines)) == 12, told
    left_out = {(e["joint"], e["why"]) for e in run.entries("left_out")}
    assert not left_out, f"{told}, {left_out}"
    for joint, pulses in run.pulses().items():
        assert np.abs(pulses - undisturbed[joint]).max() < AGREE_US, f"{told}, {joint}: {pulses - undisturbed[joint]}"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(MANY))
def test_random_troubles_never_make_the_arm_unsafe(run: ServoRun, undisturbed: Any, seed: int) -> None:
    judge(run, seed, undisturbed)


def drawn(state: dict[str, Any]) -> dict[str, float]:
    """The angles that the pulses ask for, by the true tables (deg)."""
    return {joint: float(np.degrees(s["target_rad"])) for joint, s in state["joints"].items()}


class TestRecovery:
    @pytest.mark.slow
    def test_a_board_that_drove_by_itself_while_the_host_stalled(self, run: ServoRun, undisturbed: Any) -> None:
        looks = [0]
        with run.run.simulated() as clock:

            def asked() -> bool:
                looks[0] += 1
                if looks[0] in (300, 520):
                    clock.ask({"advance": 6.0})
                return False

            run.measure(asked)
            assert clock.ask({"state": True})["offences"] == {}
        assert all(np.abs(pulses - undisturbed[joint]).max() < AGREE_US for joint, pulses in run.pulses().items())

    @pytest.mark.slow
    def test_after_a_brown_out_the_board_is_told_the_way_home_again(self, run: ServoRun) -> None:
        """It had forgotten it: an arm whose host is killed later would be left where it is."""
        with run.run.simulated() as clock:
            clock.ask({"fault": {"kind": "brown_out", "at": 12}})
            killed = run.measure_until_killed(600)
            before = clock.ask({"state": True})
            assert killed and before["now"] > 20
            clock.ask({"advance": 12.0})
            state = clock.ask({"state": True})
        assert state["offences"] == {}
        assert drawn(state)["q3"] == pytest.approx(0.0, abs=2.5) and drawn(state)["q5"] == pytest.approx(0.0, abs=2.5)
        assert max(abs(drawn(before)[joint]) for joint in ("q3", "q5")) > 5

    @pytest.mark.slow
    def test_a_way_home_of_an_earlier_run_is_not_gone_while_somebody_thinks(self, run: ServoRun) -> None:
        with run.run.simulated() as clock:
            assert run.measure_until_killed(500)
            clock.ask({"fault": {"kind": "brown_out"}})

            def thinks(joints: tuple[str, ...]) -> bool:
                clock.ask({"advance": 20.0})
                return True

            measure(run.setup(), run.out, run.talk(may=thinks), "automatic")
            assert clock.ask({"state": True})["offences"] == {}
        assert len(run.entries("pose")) == 12

    @pytest.mark.slow
    def test_stopped_while_the_board_is_gone_it_does_not_say_that_the_arm_holds(self, run: ServoRun) -> None:
        with run.run.simulated() as clock:
            clock.ask({"fault": {"kind": "unplug", "at": 12}})
            with pytest.raises(StopRequested) as stop:
                run.measure(lambda: clock.ask({"state": True})["now"] > 15)
            assert "unless the board" in stop.value.arm and "lost" in str(stop.value)


class TestTracker:
    @pytest.mark.slow
    def test_one_that_stays_away_leaves_the_arm_in_its_base_pose(self, run: ServoRun) -> None:
        """Where it may stay: nobody looks after the heat of an arm that was left alone."""
        with run.run.simulated() as clock:
            clock.ask({"fault": {"kind": "lost", "at": 15}})
            with pytest.raises(StopRequested, match="nothing of use") as stop:
                run.measure()
            state = clock.ask({"state": True})
            assert "base pose" in stop.value.arm and state["offences"] == {}
            assert drawn(state)["q3"] == pytest.approx(0.0, abs=2.5)
            clock.ask({"fault": {"kind": "seen"}})
            run.measure()
        assert len(run.entries("pose")) == 12 and not run.entries("left_out")

    @pytest.mark.slow
    def test_servos_rest_while_it_is_waited_for(self, run: ServoRun) -> None:
        heat = ("bench.acquisition.heat={q2: {continuous_Nm: 1.5, winding_time_s: 5, case_time_s: 9, budget: 0.9}}",)
        setup = run.setup(*heat, "bench.acquisition.lost.park_s=60", "bench.servo.joints=[q2]")
        rests: list[float] = []
        stand = Drive.stand
        with run.run.simulated() as clock, pytest.MonkeyPatch.context() as patch:
            patch.setattr(Drive, "stand", lambda drive, s, may: (rests.append(s), stand(drive, s, may))[1])
            clock.ask({"fault": {"kind": "lost", "at": 15}})
            with pytest.raises(StopRequested, match="nothing of use"):
                run.measure(setup=setup)
            assert clock.ask({"state": True})["offences"] == {}
        assert rests

    @pytest.mark.slow
    def test_warmth_outlasts_the_program(self, run: ServoRun) -> None:
        times, shares = np.array([[20.0, 300.0]]), np.array([[0.3, 0.7]])
        heat = HeatModel(np.array([1.0]), times, shares, np.array([0.48]), lambda pose: 2.0 * np.abs(pose))
        clock = FakeClock()
        warm = ThermalState(heat, ("q1",), clock)

        def must_rest() -> bool:
            return heat.over(warm.warmth)

        warm.go_on({"q1": [0.9, 0.5]}, {"q1": 0.0}, 0.0)
        assert must_rest()
        warm.go_on({"q1": [0.9, 0.5]}, {"q1": 0.0}, 3600.0)
        assert not must_rest()
        warm.go_on({"q1": [0.9, 0.5]}, {"q1": 1.0}, 3600.0)
        assert must_rest()  # it held something heavy meanwhile
        warm.go_on({"q1": [0.9, 0.5]}, {}, 3600.0)
        assert not must_rest()  # it hung free
        warm.go_on({"q1": [0.9, 0.5]}, {"q1": 0.0}, -1e9)
        assert must_rest()  # by a wall clock that was set back


@pytest.mark.slow
def test_guided_nothing_goes_beyond_the_range(tmp_path: Path, monkeypatch: Any) -> None:
    """Not even where an angle at its end is come to from aside."""
    config = config_in(tmp_path, "bench:\n  servo: {joints: [q1, q5], ranges: {q1: [-60 deg, 60 deg]}}\n")
    setup, device, _ = setup_on(monkeypatch, config)

    class Content:
        def next(self, seconds: float) -> str:
            return "ok"

    talk = Conversation(lambda: False, lambda j: True, lambda *t: None, lambda t: None, lambda: nullcontext(Content()))
    measure(setup, tmp_path / "out", talk, "guided")
    for joint in ("q1", "q5"):
        servo = setup.file.calibrated(joint)
        low, high = np.degrees(setup.ranges[joint])
        angles = [float(np.degrees(servo.table.angle(c * servo.clock.tick))) for j, c, _ in device.log if j == joint]
        assert low - 0.3 < min(angles) < low + 1 and high - 1 < max(angles) < high + 0.3


class TestRecord:
    def test_without_its_beginning_nobody_knows_by_which_tables_it_was_measured(
        self, done: ServoRun, tmp_path: Path
    ) -> None:
        put_rows(tmp_path, done.rows()[1:])
        with pytest.raises(DataError, match="by which tables"):
            Record(tmp_path)

    @pytest.mark.slow
    def test_another_base_pose_or_adapter_is_refused_and_other_steps_are_not(self, done: ServoRun) -> None:
        with done.run.simulated() as clock:
            with pytest.raises(InputError, match=r"another base pose: q2 stood at -50.0 deg, not at -40.0 deg"):
                done.measure(setup=done.setup("bench.servo.base={q2: -40 deg}"))
            rows = done.rows()
            rows[0]["adapter"] = "LRM-2"
            put_rows(done.out, rows)
            with pytest.raises(InputError, match="adapter 'LRM-2', found 'LRM-1'"):
                done.measure()
            assert clock.ask({"state": True})["events"].get("first_pulse", 0) == 0
            rows[0]["adapter"] = "LRM-1"
            put_rows(done.out, rows)
            before = done.pulses()
            done.measure(setup=done.setup("bench.servo.step_deg=92", "bench.servo.knots_deg=[-100, 0, 100]"))
        assert done.rows()[: len(rows)] == rows
        assert all(np.abs(before[joint] - pulses).max() < AGREE_US for joint, pulses in done.pulses().items())


class TestTables:
    @pytest.mark.slow
    def test_a_joint_that_cannot_lift_its_load_ends_it_before_anything_burns(self, tmp_path: Path) -> None:
        sets = [s for s in SETS if "joints" not in s and "ranges" not in s and "step" not in s]
        weak = "bench.simulator.joints.q2={stall_Nm: 1.2, backlash_deg: 0.1}"
        run = ServoRun(tmp_path, (*sets, "bench.servo.joints=[q2]", "bench.servo.step_deg=12", weak))
        with run.run.simulated() as clock:
            with pytest.raises(StopRequested, match=r"while the arm should stand|did not come to stand 3 times"):
                run.measure()
            state = clock.ask({"state": True})
        assert state["offences"] == {} and drawn(state)["q2"] == pytest.approx(-50, abs=2.5)

    @pytest.mark.slow
    def test_exchanged_servos_leave_the_tables_as_they_were(self, tmp_path: Path) -> None:
        sets = [s for s in SETS if "joints" not in s and "ranges" not in s]
        ranges = "bench.servo.ranges={q4: [-45 deg, 45 deg], q6: [-45 deg, 45 deg]}"
        run = ServoRun(tmp_path, (*sets, "bench.servo.joints=[q4, q6]", ranges))
        path = tmp_path / "bench_servos.yaml"
        truth = yaml.safe_load(path.read_text())
        truth["servos"]["q4"]["channel"], truth["servos"]["q6"]["channel"] = 5, 3
        path.write_text(yaml.safe_dump(truth))
        setup = run.setup()
        with run.run.simulated():
            run.measure()
        outcome = evaluated(setup, run.out)
        assert "what turned is q6" in outcome.silent["q4"] and "what turned is q4" in outcome.silent["q6"]
        assert improved(setup.file, outcome).servos == setup.file.servos

    def test_what_was_measured_by_another_oscillator_is_written_by_the_files(self, done: ServoRun) -> None:
        """An oscillator was found and written; later the same record is evaluated without what told it."""
        setup, stated = done.setup(), done.setup().file.boards["front"].oscillator_hz
        fitted = evaluated(setup, done.out)
        hertz = 1.01 * stated
        boards = {"front": BoardSettings.si(**{**setup.file.boards["front"].model_dump(), "oscillator_hz": hertz})}
        later = improved(ServoFile(boards, setup.file.servos), fitted)
        for joint, servo in fitted.servos.items():
            ticks = np.array(later.servos[joint].pulses) * hertz
            assert ticks == pytest.approx(np.array(servo.pulses) * stated, abs=0.03)

    def test_a_read_only_file_is_left_and_a_link_stays_one(self, tmp_path: Path) -> None:
        real = tmp_path / "real.yaml"
        real.write_text((CONFIGS / "servos.yaml").read_text())
        link = tmp_path / "servos.yaml"
        link.symlink_to(real)
        file = load_servo_file(link)
        real.chmod(0o444)
        before = real.read_bytes()
        with pytest.raises(InputError, match="read-only"):
            write_servo_file(link, file)
        assert real.read_bytes() == before and sorted(p.name for p in tmp_path.iterdir()) == [
            "real.yaml",
            "servos.yaml",
        ]
        real.chmod(0o644)
        assert write_servo_file(link, file) is None  # nothing to change
        boards = {"front": BoardSettings.si(**{**file.boards["front"].model_dump(), "oscillator_hz": 25.5e6})}
        kept = write_servo_file(link, ServoFile(boards, file.servos))
        assert link.is_symlink() and kept is not None and kept.read_bytes() == before and real.read_bytes() != before
