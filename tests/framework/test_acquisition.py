"""A measuring run's decisions, on a bench of plain Python; test_acquire_bench.py has the real protocols."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from armcal.devices.device import DeviceError, DeviceIdentity, DeviceLostError, DeviceUnwellError
from armcal_bench.bench import AcquisitionSettings, ServoHeatSettings
from armcal_bench.drive import Drive, PathPlanner
from armcal_bench.hazards import HeatModel
from armcal_bench.preparation import Scheduler
from armcal_bench.run_log import Progress
from armcal_bench.session import AcquisitionRun
from armcal_bench.tracker_monitor import MotionGate

from tests.bench_fakes import COUNT_RAD, FakeClock, FakeDevice, FakeLog, FakeTrackerMonitor, KilledError, NoEvidence

POSES = COUNT_RAD * np.round(np.random.default_rng(5).uniform(-1.5, 1.5, (8, 2)) / COUNT_RAD)
IDS = tuple(f"p{i}" for i in range(len(POSES)))
RATE = np.deg2rad(20)


class Run:
    """A run with everything at hand that a test may break."""

    def __init__(
        self,
        settings: AcquisitionSettings | None = None,
        progress: Progress | None = None,
        device: FakeDevice | None = None,
        clock: FakeClock | None = None,
        heat: dict[str, ServoHeatSettings] | None = None,
    ) -> None:
        self.clock = clock or FakeClock()
        self.device = device or FakeDevice(self.clock)
        self.settings = settings or AcquisitionSettings()
        self.monitor, self.log, self.asked = FakeTrackerMonitor(self.clock, self.device), FakeLog(), False
        self.log.progress, self.poses = progress or Progress(), POSES
        self.model = HeatModel.of(self.device.joint_names, heat or {}, torques)

    def acquisition(self) -> AcquisitionRun:
        settings, clock, device = self.settings, self.clock, self.device
        planner = PathPlanner(None, np.array([[-2.0, 2.0]] * 2), self.poses, 0.02)
        drive = Drive(device, clock, planner, settings, self.model, self.log)
        scheduler = Scheduler(self.poses, IDS, 0 * self.poses, drive.park, planner, self.model, RATE, 2.0)
        gate = MotionGate(self.monitor, clock, settings.lost, lambda: self.asked)
        identity = device.open(clock)
        return AcquisitionRun(drive, identity, scheduler, gate, self.log, NoEvidence(), lambda progress: None)

    def run(self) -> str:
        self.made = self.acquisition()
        ending = self.made.run()
        assert ending.sentence
        assert self.log.entries[-1][0] == "ended"
        return ending.how

    def measured(self) -> dict[str, np.ndarray]:
        found = [(c["pose"], np.array(c["position"][:2])) for kind, c in self.log.entries if kind == "measured"]
        assert len({name for name, _ in found}) == len(found), "measured twice"
        return dict(found)

    def fastest(self) -> float:
        """Of any joint over a quarter of a second, rad/s, one count allowed for."""
        moves = [(t, np.array(list(angles.values()))) for t, what, angles in self.device.log if what == "command"]
        worst = 0.0
        for i, (t0, a0) in enumerate(moves):
            for t1, a1 in moves[i + 1 :]:
                if t1 - t0 > 0.25:
                    break
                worst = max(worst, (np.abs(a1 - a0).max() - COUNT_RAD) / max(t1 - t0, 0.02))
        return worst


def torques(pose: np.ndarray) -> np.ndarray:
    return np.array([0.0, 0.7 + 0.4 * abs(pose[1])])


def test_every_pose_is_measured_where_it_was_planned() -> None:
    run = Run()
    assert run.run() == "done"
    for name, pose in zip(IDS, POSES, strict=True):
        assert np.allclose(run.measured()[name], pose, atol=1e-9)
    assert list(run.measured()) == list(IDS)
    assert run.fastest() <= RATE * 1.0001
    assert not run.device.running, "let go at the end"
    assert [what for _, what, _ in run.device.log[-2:]] == ["release", "release"]


def test_the_way_to_the_first_pose_begins_at_the_park_pose_and_joints_are_energised_one_by_one() -> None:
    run = Run(AcquisitionSettings.si(park={"q1": 0.3}))
    run.run()
    times = [t for t, what, _ in run.device.log if what == "energise"]
    assert len(times) == 2 and times[1] - times[0] >= 0.5
    first = next(angles for _, what, angles in run.device.log if what == "command")
    assert first["q1"] == pytest.approx(0.3, abs=2 * COUNT_RAD)


def test_every_joint_has_come_from_a_known_side_even_where_it_stays_where_it_parks() -> None:
    run = Run()
    run.poses = POSES * [1, 0]
    assert run.run() == "done"
    sides = [content["approach"] for kind, content in run.log.entries if kind == "measured"]
    assert all(side["q1"] and side["q2"] for side in sides)
    moved = [t for t, what, angles in run.device.log if what == "command" and angles["q2"]]
    first = next(c["at"] for kind, c in run.log.entries if kind == "measured") - 1.7e9
    assert moved and max(moved) < first, "only once"


def test_a_joint_that_stays_keeps_the_side_it_came_from() -> None:
    run, signs = Run(), np.sign(np.diff(np.vstack([np.zeros(2), POSES]), axis=0))
    run.poses = np.repeat(POSES[:4], 2, axis=0) + [[0.0, 0.0], [0.0, 0.5]] * 4
    assert run.run() == "done"
    sides = [content["approach"]["q1"] for kind, content in run.log.entries if kind == "measured"]
    assert sides[0::2] == sides[1::2] == signs[:4, 0].tolist()


def test_a_turn_back_that_may_end_within_the_play_takes_the_play_up_first() -> None:
    run = Run()
    run.poses = np.tile([[0.5, 0.2], [0.5 - np.deg2rad(0.5), 0.4]], (len(IDS) // 2, 1))
    assert run.run() == "done"
    first, second = [c for kind, c in run.log.entries if kind == "measured"][:2]
    times = [c["at"] - 1.7e9 for c in (first, second)]
    between = [a["q1"] for t, what, a in run.device.log if what == "command" and times[0] < t < times[1]]
    assert first["approach"]["q1"] == 1.0
    assert second["approach"]["q1"] != 0.0
    turned = max(between) - min(between)
    assert turned >= np.deg2rad(2.9), "half a degree back is less than the play of some servos"


def test_the_board_is_always_told_a_way_home_that_begins_on_the_leg_that_is_driven() -> None:
    run = Run()
    run.run()
    assert all(np.allclose(list(guard[-1].values()), 0.0) for guard in run.device.guards)
    starts = {tuple(np.round(list(guard[0].values()), 6)) for guard in run.device.guards}
    assert starts >= {tuple(np.round(pose, 6)) for pose in POSES}


def test_someone_who_asks_for_the_end_gets_a_parked_arm() -> None:
    run = Run()
    run.clock.at.append((20.0, lambda: setattr(run, "asked", True)))
    assert run.run() == "parked"
    assert 0 < len(run.measured()) < len(IDS)
    assert not run.device.running
    again = Run(progress=run.log.progress)
    assert again.run() == "done"
    assert {*run.measured()} | {*again.measured()} == set(IDS) and not {*run.measured()} & {*again.measured()}


def test_a_tracker_that_comes_back_costs_time_alone() -> None:
    run = Run()
    run.clock.at += [
        (15.0, lambda: setattr(run.monitor, "blind_since", 15.0)),
        (25.0, lambda: setattr(run.monitor, "blind_since", None)),
    ]
    assert run.run() == "done"
    still = [t for t, what, _ in run.device.log if what == "command" and 15.6 < t < 25.0]
    assert still == [], "it held while nothing was seen"


def test_a_tracker_that_stays_away_makes_it_park() -> None:
    run = Run()
    run.clock.at.append((15.0, lambda: setattr(run.monitor, "blind_since", 15.0)))
    assert run.run() == "parked"
    assert "30 s" in run.log.entries[-1][1]["sentence"] and "silent" in run.log.entries[-1][1]["sentence"]


def test_a_device_that_comes_back_goes_on_from_where_it_stands() -> None:
    run = Run()
    run.clock.at += [
        (12.0, lambda: setattr(run.device, "gone", True)),
        (20.0, lambda: setattr(run.device, "gone", False)),
    ]
    assert run.run() == "done"
    assert set(run.measured()) == set(IDS)
    assert run.fastest() <= RATE * 1.0001


def test_a_device_that_stays_away_leaves_the_arm_held() -> None:
    run = Run()
    run.clock.at.append((12.0, lambda: setattr(run.device, "gone", True)))
    assert run.run() == "held"
    assert "30 s" in run.log.entries[-1][1]["sentence"]


def test_joints_that_lost_their_pulses_get_them_again_one_by_one_where_they_were() -> None:
    run = Run()

    def brown_out() -> None:
        run.fallen = dict(run.device.running)
        run.device.running.clear()
        run.device.gone = True
        run.clock.at.append((run.clock.now() + 0.3, lambda: setattr(run.device, "gone", False)))

    run.clock.at.append((12.0, brown_out))
    assert run.run() == "done"
    times = [t for t, what, _ in run.device.log if what == "energise"]
    assert len(times) == 4 and min(np.diff(times)) >= 0.5
    assert set(run.measured()) == set(IDS)


def test_a_device_that_fails_again_and_again_is_given_up() -> None:
    run = Run()
    original = run.device.command
    calls = [0]

    def failing(angles) -> None:
        calls[0] += 1
        if calls[0] > 50:
            raise DeviceError("NACK at byte 3")
        original(angles)

    run.device.command = failing  # type: ignore[method-assign]
    assert run.run() == "held"
    assert "times in a row" in run.log.entries[-1][1]["sentence"] and "NACK" in run.log.entries[-1][1]["sentence"]


def test_a_pose_that_never_settles_is_tried_again_at_the_end_and_then_left_out() -> None:
    run = Run()
    run.monitor.restless.add(tuple(round(a, 6) for a in POSES[2]))
    assert run.run() == "done"
    assert list(run.measured()) == [name for name in IDS if name != "p2"]
    assert run.log.progress.left_out["p2"] == "still moving by 3 mm"
    assert "1 were left out" in run.log.entries[-1][1]["sentence"]
    goings = [content["pose"] for kind, content in run.log.entries if kind == "going"]
    assert goings.count("p2") == 2 and goings[-1] == "p2"


def test_hot_servos_rest_where_the_arm_parks() -> None:
    heat = {"q2": ServoHeatSettings.si(continuous=1.3, winding_time=20.0, case_time=20.0, budget=0.5)}
    run = Run(heat=heat)
    assert run.run() == "done"
    assert set(run.measured()) == set(IDS)
    assert any(c["what"] == "rest" for kind, c in run.log.entries if kind == "told")
    heats = [float(np.dot([0.3, 0.7], c["warmth"]["q2"])) for kind, c in run.log.entries if "warmth" in c]
    assert 0.3 < max(heats) <= 0.5


def test_where_parking_is_too_much_as_well_poses_are_left_out_and_none_is_lost() -> None:
    heat = {"q2": ServoHeatSettings.si(continuous=0.9, case_time=60.0, budget=0.5)}
    parked_torque = torques(np.zeros(2))[1]
    assert (parked_torque / 0.9) ** 2 > 0.5
    run = Run(heat=heat)
    assert run.run() == "done"
    assert set(run.log.progress.left_out) | set(run.measured()) == set(IDS) and run.log.progress.left_out


@pytest.mark.parametrize("dies_after", range(1, 34))
@pytest.mark.quick("14")
def test_killed_after_any_entry_nothing_is_measured_twice_and_nothing_is_lost(dies_after: int) -> None:
    run = Run()
    run.log.dies_after = dies_after
    before = FakeLog()
    try:
        run.run()
    except KilledError:
        before = run.log
    progress = Progress()
    for kind, content in before.entries:
        progress = progress.after(kind, content)
    again = Run(progress=replace(progress, ended=""), device=run.device, clock=run.clock)
    assert again.run() == "done"
    done = [c["pose"] for log in (before, again.log) for kind, c in log.entries if kind == "measured"]
    assert sorted(done) == sorted(IDS) if before.entries else sorted(done) == sorted(again.measured())
    assert again.fastest() <= RATE * 1.0001


@pytest.mark.quick("2", "5", "6", "7", "9")
@pytest.mark.parametrize("seed", [*range(10), *(pytest.param(s, marks=pytest.mark.slow) for s in range(10, 30))])
def test_random_troubles_end_in_done_held_or_parked(seed: int) -> None:
    random = np.random.default_rng(seed)
    run = Run()

    def trouble(kind: str, seconds: float) -> None:
        now = run.clock.now()
        if kind == "blind":
            run.monitor.blind_since = now
            run.clock.at.append((now + seconds, lambda: setattr(run.monitor, "blind_since", None)))
        elif kind == "gone":
            run.device.gone = True
            run.clock.at.append((now + seconds, lambda: setattr(run.device, "gone", False)))
        elif kind == "drop":
            run.device.running.clear()
            run.device.gone = True
            run.clock.at.append((now + 0.2, lambda: setattr(run.device, "gone", False)))
        else:
            run.asked = True

    for time in np.cumsum(random.exponential(8.0, 8)):
        kind, lasts = (
            random.choice(["blind", "gone", "drop", "asked"], p=[0.35, 0.35, 0.25, 0.05]),
            random.exponential(12),
        )
        run.clock.at.append((float(time), partial(trouble, kind, float(lasts))))
    how = run.run()
    assert how in ("done", "held", "parked")
    assert (how == "done") == (set(run.measured()) | set(run.log.progress.left_out) == set(IDS)) or how != "done"
    assert run.fastest() <= RATE * 1.0001
    energised = [t for t, what, _ in run.device.log if what == "energise"]
    assert len(energised) < 2 or min(np.diff(energised)) >= 0.5 - 1e-9


def test_a_lost_device_while_asked_to_stop_is_held() -> None:
    run = Run()
    run.clock.at += [(12.0, lambda: setattr(run.device, "gone", True)), (14.0, lambda: setattr(run, "asked", True))]
    assert run.run() == "held"
    assert isinstance(DeviceLostError("x"), DeviceError)


class MeasuringFake(FakeDevice):
    """Its servos know where they stand: 0.4 rad at first, then a little off from where they were commanded to be."""

    def measured(self) -> dict[str, float]:
        return {joint: self.running.get(joint, 0.39) + 0.01 for joint in self.joint_names}

    def energise(self, joint: str, angle: float) -> None:
        assert angle == pytest.approx(0.4), f"{joint} jumps"
        super().energise(joint, angle)


@pytest.mark.parametrize("chosen", ["commanded", "measured"])
def test_servos_that_know_where_they_stand_do_not_jump_and_are_measured(chosen) -> None:
    clock = FakeClock()
    run = Run(AcquisitionSettings.si(angles=chosen), device=MeasuringFake(clock), clock=clock)
    assert run.run() == "done"
    records = [content for kind, content in run.log.entries if kind == "measured"]
    other, offset = ("commanded", 0.01) if chosen == "measured" else ("measured", 0.0)
    for record, pose in zip(records, POSES, strict=True):
        assert list(record["standing"].values()) == pytest.approx(pose + offset, abs=1e-9)
        assert list(record[other].values()) == pytest.approx(pose + 0.01 - offset, abs=1e-9)


def test_a_servo_that_is_too_hot_parks_the_arm_and_lets_it_go() -> None:
    class Hot(FakeDevice):
        def keep_alive(self) -> None:
            super().keep_alive()
            if self.clock.now() > 30 and not self.boots > 1:
                self.boots = 2
                raise DeviceUnwellError("q2 is at 66 deg C.")

    clock = FakeClock()
    run = Run(device=Hot(clock), clock=clock)
    assert run.run() == "parked"
    assert 0 < len(run.measured()) < len(POSES)
    assert not run.device.running and "66 deg C" in run.log.entries[-1][1]["sentence"]
    last = [angles for _, what, angles in run.device.log if what == "command"][-1]
    assert last == pytest.approx({"q1": 0.0, "q2": 0.0}, abs=COUNT_RAD)


def test_another_board_that_is_plugged_in_meanwhile_is_not_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run()

    def unplug() -> None:
        run.device.gone = True

    def plug_another_in() -> None:
        run.device.gone = False
        monkeypatch.setattr(run.device, "open", lambda clock: DeviceIdentity("another", "d1"))

    run.clock.at += [(8.0, unplug), (9.0, plug_another_in)]
    assert run.run() == "held"
    assert "found another, expected fake" in run.log.entries[-1][1]["sentence"]
    assert max(t for t, what, _ in run.device.log if what != "release") <= 8.0
