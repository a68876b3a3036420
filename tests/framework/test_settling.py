"""When the arm stands: never while it moves, soon after it stopped, and with honest deviations."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from armcal.devices.live import REPEATED, TrackerFrame
from armcal.measure.rests import deviations_of_mean, mean_pose
from armcal_bench.bench import BodySettings, SettleSettings
from armcal_bench.tracker_monitor import Settled, TrackerMonitor, drift_of
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.bench_fakes import FakeClock

RATE = 60.0
NOISE_M, NOISE_RAD = 5e-5, 3e-4
SPREAD_M = 5e-4
BODIES = BodySettings(tool="tool", base="base")
ONLY_TOOL = BodySettings(tool="tool")
RULES = SettleSettings.si(wait=0.0)

Path = Callable[[float], np.ndarray]


def at(x: float, y: float = 0.1, z: float = 0.2, turn: tuple[float, ...] = (0.1, 0.2, 0.3)) -> np.ndarray:
    found = np.eye(4)
    found[:3, 3] = x, y, z
    found[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    return found


def noisy(pose: np.ndarray, rng: np.random.Generator, scale: float = 1.0) -> np.ndarray:
    found = pose.copy()
    found[:3, 3] += scale * rng.normal(0, NOISE_M, 3)
    found[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(scale * rng.normal(0, NOISE_RAD, 3)).as_matrix()
    return found


def frames(
    path: Path, end: float, seed: int = 0, world: np.ndarray | None = None, scale: float = 1.0
) -> list[TrackerFrame]:
    """What a tracker sees until a time, at its rate, with noise in both bodies."""
    rng = np.random.default_rng(seed)
    world = np.eye(4) if world is None else world
    found = []
    for i in range(int(end * RATE)):
        time = (i + 0.5) / RATE
        bodies = {"base": world @ noisy(np.eye(4), rng, scale), "tool": world @ noisy(path(time), rng, scale)}
        found.append(TrackerFrame(i, time, None, bodies))
    return found


class NoFrames:
    """A tracker that sends nothing by itself."""

    def __init__(self) -> None:
        self.refused: dict[str, int] = {}

    def frames(self) -> list[TrackerFrame]:
        return []


class Watched(TrackerMonitor):
    """A monitor that is given its frames."""

    def __init__(self, rules: SettleSettings, bodies: BodySettings) -> None:
        self.clock = FakeClock()
        super().__init__(NoFrames(), self.clock, rules, bodies)  # type: ignore[arg-type]

    def begin_at(self, now: float) -> None:
        self.clock.time = now
        self.begin()

    def settled_at(self, now: float) -> Settled | str:
        self.clock.time = now
        return self.settled()

    def trouble_at(self, now: float) -> tuple[float, str]:
        self.clock.time = now
        return self.trouble()


def state(seen: Iterable[TrackerFrame], now: float, rules: SettleSettings = RULES, bodies: BodySettings = ONLY_TOOL):
    watched = Watched(rules, bodies)
    watched.feed(seen, {})
    return watched.settled_at(now)


def why(found: Settled | str) -> str:
    assert isinstance(found, str), found
    return found


def test_an_arm_that_stands_stands() -> None:
    found = state(frames(lambda t: at(0.3), 2.0), 2.0)
    assert isinstance(found, Settled)
    assert found.frames == 60 and found.rejected == 0
    assert 1.0 < found.begun < found.ended <= 2.0
    np.testing.assert_allclose(found.base_T_target[:3, 3], [0.3, 0.1, 0.2], atol=4e-5)
    np.testing.assert_allclose(found.base_T_target[:3, :3], at(0)[:3, :3], atol=3e-4)


@pytest.mark.slow
@given(st.integers(0, 1000), st.floats(1.2e-3, 0.1), st.integers(0, 2), st.floats(0.2, 3.0))
@settings(max_examples=60, deadline=None)
def test_a_ramp_is_never_settled(seed: int, speed: float, axis: int, scale: float) -> None:
    """Any speed that moves the halves of a window of 1 s apart by the spread, 1 mm/s, and what noise may hide."""

    def ramp(time: float) -> np.ndarray:
        found = at(0.3)
        found[axis, 3] += speed * time
        return found

    seen = frames(ramp, 2.0, seed, scale=scale)
    for now in (1.0, 1.5, 2.0):
        assert "moving" in why(state([f for f in seen if f.arrived <= now], now))


@pytest.mark.slow
@given(st.integers(0, 1000), st.floats(0.0, 0.94), st.floats(1.2e-3, 0.1), st.floats(0.2, 2.0))
@settings(max_examples=80, deadline=None)
def test_a_step_within_the_window_is_not_settled(seed: int, share: float, size: float, scale: float) -> None:
    """Anywhere in it, but within its first two frames: the arm has stood for all the others then."""
    step_at = 1.0 + 2.51 / RATE + share * (1.0 - 2.51 / RATE)
    seen = frames(lambda t: at(0.3 + (size if t >= step_at else 0.0)), 2.0, seed, scale=scale)
    assert not isinstance(state(seen, 2.0), Settled)


def test_once_the_step_is_past_it_is_settled_where_it_stands_now() -> None:
    seen = frames(lambda t: at(0.3 if t < 1.0 else 0.35), 2.2)
    for now in np.arange(0.02, 2.01, 0.02):
        found = state([f for f in seen if f.arrived <= now], now)
        if isinstance(found, Settled):
            assert abs(found.base_T_target[0, 3] - (0.3 if found.ended < 1.0 else 0.35)) < 1e-4
    assert isinstance(state(seen, 2.1), Settled)


def test_a_turn_about_the_target_is_motion_too() -> None:
    seen = frames(lambda t: at(0.3, turn=(0.02 * t, 0, 0)), 2.0)
    assert "moving" in why(state(seen, 2.0))


@pytest.mark.slow
def test_the_slow_end_of_a_motion_is_waited_for() -> None:
    """An arm that creeps to rest: what is called settled is where it comes to, within the spread."""
    seen = frames(lambda t: at(0.3 - 0.05 * np.exp(-t / 0.4)), 8.0)
    first = next(now for now in np.arange(1.0, 8.0, 0.02) if isinstance(state(seen, now), Settled))
    found = state(seen, first)
    assert isinstance(found, Settled) and abs(found.base_T_target[0, 3] - 0.3) < SPREAD_M


@pytest.mark.slow
@given(st.integers(0, 1000), st.sampled_from(["moving", "still"]))
@settings(max_examples=25, deadline=None)
def test_where_the_world_is_does_not_matter(seed: int, motion: str) -> None:
    rng = np.random.default_rng(seed)
    world = at(*rng.normal(0, 2, 3), turn=tuple(rng.normal(0, 1, 3)))
    bodies = BodySettings(tool="tool", base="base", base_motion=motion)
    here, there = (state(frames(lambda t: at(0.3), 1.5, seed, w), 1.5, bodies=bodies) for w in (None, world))
    assert isinstance(here, Settled) and isinstance(there, Settled)
    np.testing.assert_allclose(here.base_T_target, there.base_T_target, atol=1e-9)


def test_feeding_in_lumps_or_one_by_one_is_the_same() -> None:
    seen = frames(lambda t: at(0.3), 1.5)
    one_by_one = Watched(RULES, BODIES)
    for frame in seen:
        one_by_one.feed([frame], {})
    found, expected = one_by_one.settled_at(1.5), state(seen, 1.5, bodies=BODIES)
    assert isinstance(found, Settled) and isinstance(expected, Settled)
    np.testing.assert_array_equal(found.base_T_target, expected.base_T_target)


def test_a_few_outliers_are_set_aside() -> None:
    seen = frames(lambda t: at(0.3), 1.5)
    clean = state(seen, 1.5)
    for i in (40, 41, 60, 75):
        seen[i].bodies["tool"][:3, 3] += 0.02  # type: ignore[index]
    found = state(seen, 1.5)
    assert isinstance(found, Settled) and isinstance(clean, Settled)
    assert (found.rejected, found.frames) == (4, 56)
    np.testing.assert_allclose(found.base_T_target[:3, 3], clean.base_T_target[:3, 3], atol=3e-5)


def test_many_outliers_or_many_in_a_row_are_not() -> None:
    for which in (range(32, 90, 6), (60, 61, 62), (89,)):
        seen = frames(lambda t: at(0.3), 1.5)
        for i in which:
            seen[i].bodies["tool"][:3, 3] += 0.02  # type: ignore[index]
        assert not isinstance(state(seen, 1.5), Settled)


@pytest.mark.parametrize("motion", ["moving", "still"])
@pytest.mark.slow
def test_deviations_are_those_of_the_mean(motion: str) -> None:
    bodies = BodySettings(tool="tool", base="base", base_motion=motion)
    found = [state(frames(lambda t: at(0.3), 1.1, seed), 1.1, bodies=bodies) for seed in range(150)]
    poses = np.array([f.base_T_target for f in found])  # type: ignore[union-attr]
    claimed = np.sqrt(np.mean([f.deviations**2 for f in found], axis=0))  # type: ignore[union-attr]
    turns = Rotation.from_matrix(at(0)[:3, :3].T @ poses[:, :3, :3]).as_rotvec()
    actual = np.concatenate([poses[:, :3, 3].std(axis=0), turns.std(axis=0)])
    np.testing.assert_allclose(claimed, actual, rtol=0.25)


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_noise_that_lasts_counts_for_less(correlation: float) -> None:
    rng = np.random.default_rng(3)
    claimed, means = [], []
    for _ in range(300):
        noise = rng.normal(0, 1e-4, (60, 3))
        for i in range(1, 60):
            noise[i] += correlation * noise[i - 1]
        poses = np.tile(np.eye(4), (60, 1, 1))
        poses[:, :3, 3] = noise
        mean = mean_pose(poses)
        means.append(mean[:3, 3])
        claimed.append(deviations_of_mean(poses, mean)[:3] ** 2)
    np.testing.assert_allclose(np.sqrt(np.mean(claimed)), np.std(means), rtol=0.15)


def test_what_came_before_the_arm_stood_does_not_count() -> None:
    seen = frames(lambda t: at(0.3), 4.0)
    settling = Watched(SettleSettings.si(wait=0.5), ONLY_TOOL)
    settling.feed(seen[:60], {})
    settling.begin_at(1.0)
    for frame in seen[60:]:
        settling.feed([frame], {})
        found = settling.settled_at(frame.arrived)
        assert isinstance(found, Settled) == (frame.arrived >= 2.5)
        if frame.arrived < 2.5:
            assert "too early" in why(found)


def without(seen: list[TrackerFrame], name: str, begin: float, end: float) -> list[TrackerFrame]:
    return [
        TrackerFrame(f.counter, f.arrived, None, {**f.bodies, name: None}) if begin <= f.arrived < end else f
        for f in seen
    ]


def test_why_it_is_not_known_to_stand() -> None:
    seen = frames(lambda t: at(0.3), 2.0)
    assert "silent" in why(state([], 2.0))
    assert "silent" in why(state(seen, 4.0))
    assert "too few frames: 4 usable" in why(state(seen[-4:], 2.0))
    assert "no usable frame for 0.5" in why(state([f for f in seen if not 1.2 < f.arrived < 1.7], 2.0))
    assert "does not see the tool body 'tool'" in why(state(without(seen, "tool", 1.0, 2.0), 2.0))
    assert "does not see the base body 'base'" in why(state(without(seen, "base", 1.3, 1.9), 2.0, bodies=BODIES))
    frozen = [TrackerFrame(f.counter, f.arrived, None, seen[0].bodies) for f in seen]
    assert "frozen" in why(state(frozen, 2.0))
    same = [TrackerFrame(7, f.arrived, None, f.bodies) for f in seen]
    assert "frozen" in why(state(same, 2.0))


def test_short_losses_do_not_matter() -> None:
    seen = without(frames(lambda t: at(0.3), 2.0), "tool", 1.3, 1.5)
    found = state(seen, 2.0)
    assert isinstance(found, Settled) and found.frames == 48


def test_positions_alone_settle_too() -> None:
    seen = frames(lambda t: at(0.3), 1.5)
    for frame in seen:
        frame.bodies["tool"][:3, :3] = np.nan  # type: ignore[index]
    found = state(seen, 1.5)
    assert isinstance(found, Settled)
    assert np.isnan(found.base_T_target[:3, :3]).all() and np.isnan(found.deviations[3:]).all()
    assert (found.deviations[:3] > 0).all()


@pytest.mark.slow
def test_memory_is_bounded() -> None:
    settling = Watched(RULES, ONLY_TOOL)
    for frame in frames(lambda t: at(0.3), 60.0):
        settling.feed([frame], {})
    assert len(settling._frames) <= RATE + 1
    settling.begin_at(60.0)
    for frame in frames(lambda t: at(0.3), 100.0):
        settling.feed([frame], {})
    assert len(settling._frames) <= 30 * RATE + 1


def health(seen: Iterable[TrackerFrame], refused: dict[str, int] | None = None) -> Watched:
    found = Watched(RULES, BODIES)
    found.feed(seen, refused or {})
    return found


def test_the_health_of_a_tracker() -> None:
    seen = frames(lambda t: at(0.3), 2.0)
    assert health(seen).trouble_at(2.0) == (0.0, "")
    seconds, reason = health(seen).trouble_at(5.0)
    assert seconds == pytest.approx(3.0, abs=0.02) and reason == "silent: no frame comes"
    seconds, reason = health(without(seen, "base", 1.5, 2.0)).trouble_at(2.0)
    assert seconds == pytest.approx(0.5, abs=0.02) and reason.startswith("body lost") and "'base'" in reason
    frozen = seen[:90] + [TrackerFrame(f.counter, f.arrived, None, seen[89].bodies) for f in seen[90:]]
    seconds, reason = health(frozen).trouble_at(2.0)
    assert seconds == pytest.approx(0.5, abs=0.02) and reason.startswith("frozen")
    assert health([]).trouble_at(0.7) == (0.7, "silent: no frame comes")


def test_what_was_refused_tells_why_a_tracker_is_silent() -> None:
    seen = frames(lambda t: at(0.3), 1.0)
    found = health(seen, {"not ASCII text": 5})
    found.feed([], {"not ASCII text": 5, REPEATED: 40})
    assert found.trouble_at(2.0)[1].startswith("frozen")
    found.feed([], {"not ASCII text": 99, REPEATED: 40})
    assert found.trouble_at(2.0)[1] == "silent: what comes cannot be read (94 times: not ASCII text)"
    found.feed([TrackerFrame(1000, 2.0, None, seen[0].bodies)], {"not ASCII text": 99, REPEATED: 40})
    assert found.trouble_at(2.0) == (0.0, "")


def test_a_still_base_may_be_out_of_sight_once_it_was_seen() -> None:
    bodies = BodySettings(tool="tool", base="base", base_motion="still")
    seen = frames(lambda t: at(0.3), 2.0)
    found = Watched(RULES, bodies)
    found.feed(without(seen, "base", 1.0, 2.0), {})
    assert found.trouble_at(2.0) == (0.0, "")
    unseen = Watched(RULES, bodies)
    unseen.feed(without(seen, "base", 0.0, 2.0), {})
    assert unseen.trouble_at(2.0)[1].startswith("body lost")


def test_the_drift_of_a_stand_and_its_deviations() -> None:
    """Of 400 stands of one drift the estimates spread as their stated deviations."""
    random, times = np.random.default_rng(4), np.arange(0, 1, 1 / 60)
    rates, found, sds = np.array([1e-3, -2e-3, 0.0]), [], []
    for _ in range(400):
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, 3] = np.outer(times, rates) + random.normal(0, 5e-5, (len(times), 3))
        stand = drift_of(times, poses)
        assert stand is not None
        found.append(stand.rates)
        sds.append(stand.sds)
    assert np.mean(found, axis=0) == pytest.approx(rates, abs=1e-4)
    assert np.std(found, axis=0) == pytest.approx(np.sqrt(np.mean(np.square(sds), axis=0)), rel=0.2)
    assert drift_of(times[:1], poses[:1]) is None
