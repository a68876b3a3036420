"""Leader and follower: what was planted in recorded data is found within its interval, and doubt is stated."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow")
from armcal_lerobot.recordings import Recording, open_recording
from armcal_lerobot.tracking import Tracking, findings_of, trackings

from tests.plugins.lerobot.planted import MOTORS, Planted, episodes, write_dataset

PLANTED = {
    "shoulder_pan": Planted(offset=0.5),
    "shoulder_lift": Planted(offset=-2.0, gain=0.98, backlash=1.0, delay=0.15),
    "elbow_flex": Planted(offset=1.2, gain=1.02, backlash=2.0, delay=0.05),
    "wrist_flex": Planted(backlash=0.4, delay=0.2),
    "wrist_roll": Planted(gain=-1.0, backlash=0.5),
}


def motion_of(folder: Path, made: list, version: str = "v2.1") -> Recording:
    return open_recording(write_dataset(folder, made, version))


def by_motor(motion: Recording) -> Mapping[str, Tracking]:
    return {t.motor: t for t in trackings(motion)}


@pytest.fixture(scope="module")
def planted_motion(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return motion_of(tmp_path_factory.mktemp("data") / "planted", episodes(PLANTED, count=5, frames=800))


@pytest.mark.quick("elbow_flex")
@pytest.mark.parametrize("motor", PLANTED)
def test_what_was_planted_is_found_within_its_interval(planted_motion: Recording, motor: str) -> None:
    found, true = by_motor(planted_motion)[motor], PLANTED[motor]
    assert found.delay_s and found.gain and found.offset and found.backlash and not found.doubts
    assert found.delay_s == pytest.approx(true.delay, abs=0.002)
    assert found.backlash.low <= true.backlash <= found.backlash.high
    assert found.backlash.high - found.backlash.low < 0.12
    assert abs(found.gain.value - true.gain) < 3 * (found.gain.high - found.gain.low)
    assert found.gain.high - found.gain.low < 0.004
    middle = np.mean([np.mean(stretch.commanded[:, MOTORS.index(motor)]) for stretch in planted_motion.motion])
    assert found.offset.value == pytest.approx(true.offset + (true.gain - 1) * middle, abs=0.1 + abs(true.gain - 1))


@pytest.mark.slow
def test_intervals_cover_what_was_planted(tmp_path: Path) -> None:
    """40 data sets, 95 % intervals of gain and backlash of six motors: at least 90 % cover."""
    covered = []
    for seed in range(40):
        for t in trackings(motion_of(tmp_path / str(seed), episodes(PLANTED, count=6, frames=900, seed=seed))):
            true = PLANTED.get(t.motor, Planted())
            for figure, value in ((t.gain, true.gain), (t.backlash, true.backlash)):
                assert figure is not None
                covered.append(figure.low <= value <= figure.high)
    assert np.mean(covered) > 0.9


@pytest.mark.slow
def test_a_follower_that_lags_like_a_spring_and_damper_has_no_backlash(tmp_path: Path) -> None:
    """A first-order lag, which is no pure delay, must not be taken for play."""
    made = []
    for action, _ in episodes({}, count=5, frames=800):
        state = action.copy()
        for k in range(1, len(state)):
            state[k] = state[k - 1] + (action[k] - state[k - 1]) * (1 - np.exp(-1 / 30 / 0.12))
        made.append((action, state))
    for t in by_motor(motion_of(tmp_path / "set", made)).values():
        assert t.backlash and t.delay_s
        assert abs(t.backlash.value) < 0.1 and 0.06 < t.delay_s < 0.14


@pytest.mark.slow
def test_what_stopped_a_joint_is_left_out_and_named(tmp_path: Path) -> None:
    """A limit at 25 deg is no gain."""
    planted, made = {"elbow_flex": Planted(offset=1.0, backlash=0.8)}, []
    for action, state in episodes(planted, count=5, frames=800):
        state[:, 2] = np.minimum(state[:, 2], 25.0)
        made.append((action, state))
    elbow = by_motor(motion_of(tmp_path / "set", made))["elbow_flex"]
    assert elbow.gain and elbow.backlash and elbow.offset
    assert elbow.gain.value == pytest.approx(1.0, abs=0.003) and elbow.offset.value == pytest.approx(1.0, abs=0.1)
    assert elbow.backlash.low <= 0.8 <= elbow.backlash.high
    assert "a limit or an obstacle stopped it" in elbow.doubts[0]


@pytest.mark.slow
def test_exchanged_leader_and_follower_are_named(tmp_path: Path) -> None:
    made = [(state, action) for action, state in episodes({}, count=4, frames=600)]
    findings = findings_of(trackings(motion_of(tmp_path / "set", made)))
    assert re.search(r"exchanged: the commands follow the states, by (9\d|10\d|11\d) ms, in 6 of 6", findings[0])


@pytest.mark.slow
def test_faults_of_a_motor_are_named(tmp_path: Path) -> None:
    planted = {"elbow_flex": Planted(offset=-28.8), "wrist_roll": Planted(gain=-1.0), "wrist_flex": Planted(gain=0.8)}
    findings = findings_of(trackings(motion_of(tmp_path / "set", episodes(planted, count=4, frames=600))))
    assert len(findings) == 3
    assert "elbow_flex stands -28.8 deg from its command: 2 teeth of its horn" in findings[0]
    assert "wrist_flex moves 0.800 times as far" in findings[1] and "wrist_roll is inverted" in findings[2]


@pytest.mark.slow
def test_a_healthy_follower_has_no_findings(tmp_path: Path) -> None:
    assert not findings_of(trackings(motion_of(tmp_path / "set", episodes({}, count=4, frames=600))))


def test_doubt_is_stated(tmp_path: Path) -> None:
    """A motor that stands still, one that only ever rises, one that never moves fast."""
    random, made = np.random.default_rng(3), []
    for _ in range(4):
        action = np.zeros((600, 6))
        action[:, 1] = np.linspace(0, 50, 600)
        action[:, 2] = 20 * np.sin(np.linspace(0, 6, 600))
        made.append((action, action + random.normal(0, 0.05, action.shape)))
    motors = by_motor(motion_of(tmp_path / "set", made))
    assert "nothing but its offset" in motors["shoulder_pan"].doubts[0] and motors["shoulder_pan"].gain is None
    assert motors["shoulder_pan"].offset is not None
    assert motors["shoulder_lift"].backlash is None and "no backlash" in " ".join(motors["shoulder_lift"].doubts)
    assert motors["elbow_flex"].delay_s is None and "hardly moves fast" in motors["elbow_flex"].doubts[0]


def test_one_short_episode_gives_doubt_and_no_number(tmp_path: Path) -> None:
    for t in by_motor(motion_of(tmp_path / "set", episodes(PLANTED, count=1, frames=40))).values():
        assert t.backlash is None and t.gain is None and t.doubts
