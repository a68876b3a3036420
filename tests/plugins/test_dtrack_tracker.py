"""The DTrack listener on a real socket, fed by hand and by the simulated DTrack."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator

import numpy as np
import pytest
from armcal.devices.device import DeviceRefusedError
from armcal.devices.live import REPEATED, TrackerFrame
from armcal_tracker.trackers import DTrackSettings, DTrackTracker
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from tests.simulated_lines.dtrack_sender import DTrackSenderSettings, SimulatedDTrack, angles_deg, datagram

MIDNIGHT = 1_699_999_200.0 - 1_699_999_200.0 % 86400


class FakeClock:
    """Time that stands where it is put."""

    def __init__(self, wall: float = MIDNIGHT + 1000.0) -> None:
        self.time, self.wall_time = 0.0, wall

    def now(self) -> float:
        return self.time

    def wall(self) -> float:
        return self.wall_time

    def sleep(self, seconds: float) -> None:
        self.time += seconds
        self.wall_time += seconds


class Listener:
    """A tracker on loopback, and what sends to it."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.tracker = DTrackTracker(DTrackSettings(port=0, host="127.0.0.1"))
        self.tracker.open(self.clock)
        self.sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send(self, *data: bytes) -> list[TrackerFrame]:
        for each in data:
            self.sender.sendto(each, self.tracker.address)
        return self.tracker.frames()

    def simulated(self, seed: int = 1, **settings: object) -> SimulatedDTrack:
        host, port = self.tracker.address
        return SimulatedDTrack(DTrackSenderSettings.si(**settings), host, port, seed)


@pytest.fixture
def listener() -> Iterator[Listener]:
    made = Listener()
    yield made
    made.tracker.close()
    made.sender.close()


def frame(counter: int, stamp: float = 100.0) -> bytes:
    return datagram(counter, stamp, {0: np.eye(4)}, "6d")


def random_poses(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    poses[:, :3, 3] = rng.uniform(-2, 2, (count, 3))
    return poses


@pytest.mark.parametrize("lines", ["6d", "6di"])
def test_what_the_simulated_dtrack_sends_is_what_is_read(listener: Listener, lines: str) -> None:
    sender = listener.simulated(noise=0.0, orientation_noise=0.0, lines=lines)
    base, tool = random_poses(3, 2)
    sender.send(MIDNIGHT + 1000.0, {"base": base, "tool": tool})
    sender.send(MIDNIGHT + 1000.0 + 1 / 60, {"base": base, "tool": None})
    first, second = listener.tracker.frames()
    assert (first.counter, second.counter) == (1, 2)
    for name, truth in (("1", base), ("2", tool)):
        pose = first.bodies[name]
        assert pose is not None
        np.testing.assert_allclose(pose[:3, 3], truth[:3, 3], atol=0.51e-6)
        np.testing.assert_allclose(pose[:3, :3], truth[:3, :3], atol=0.51e-6)
    assert second.bodies.get("2") is None and second.bodies["1"] is not None
    assert first.stamp == pytest.approx(1000.0)
    assert listener.tracker.refused == {}


def test_printed_angles_are_those_of_the_matrix() -> None:
    for pose in random_poses(5, 50):
        expected = Rotation.from_matrix(pose[:3, :3]).as_euler("XYZ", degrees=True)
        np.testing.assert_allclose(angles_deg(pose.tolist()), expected, atol=1e-9)
    # the manual's example of a Flystick
    columns = [-0.241543, 0.968868, -0.054332, -0.482366, -0.168461, -0.859619, -0.842010, -0.181427, 0.508039]
    rows = np.reshape(columns, (3, 3)).T.tolist()
    np.testing.assert_allclose(angles_deg(rows), [19.6522, -57.3530, 116.5992], atol=2e-4)


def test_repeated_and_late_frames_are_dropped(listener: Listener) -> None:
    found = listener.send(frame(1), frame(1), frame(5), frame(3), frame(6))
    assert [f.counter for f in found] == [1, 5, 6]
    assert listener.tracker.refused[REPEATED] == 1
    assert sum(listener.tracker.refused.values()) == 2


def test_stamps_go_on_over_midnight(listener: Listener) -> None:
    found = listener.send(frame(1, 86399.99), frame(2, 0.01), frame(3, 0.03))
    np.testing.assert_allclose([f.stamp for f in found], [86399.99, 86400.01, 86400.03])


def test_bad_datagrams_are_counted_by_reason(listener: Listener) -> None:
    found = listener.send(b"", b"hello", frame(1)[:-60], frame(2), b"\xff" * 65000)
    assert [f.counter for f in found] == [2]
    assert sum(listener.tracker.refused.values()) == 4
    assert all(reason for reason in listener.tracker.refused)


def test_it_never_waits_and_says_nothing_when_nothing_comes(listener: Listener) -> None:
    assert listener.tracker.frames() == []


def test_a_taken_port_is_refused(listener: Listener) -> None:
    port = listener.tracker.address[1]
    with pytest.raises(DeviceRefusedError, match=f"udp:127.0.0.1:{port}.*cannot be opened"):
        DTrackTracker(DTrackSettings(port=port, host="127.0.0.1")).open(FakeClock())


def test_it_can_be_closed_and_opened_again(listener: Listener) -> None:
    listener.send(frame(50))
    listener.tracker.close()
    listener.tracker.close()
    assert listener.tracker.frames() == []
    listener.tracker.open(listener.clock)
    assert [f.counter for f in listener.send(frame(1))] == [1]


def test_other_senders_do_not_count_where_one_is_named() -> None:
    tracker = DTrackTracker(DTrackSettings(port=0, host="127.0.0.1", sender="127.0.0.9"))
    tracker.open(FakeClock())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.sendto(frame(1), tracker.address)
        assert tracker.frames() == []
        assert tracker.refused == {"a datagram from another sender": 1}
    tracker.close()


@pytest.mark.parametrize(
    "settings", [{"port": 70000}, {"host": "nowhere"}, {"group": "10.0.0.1"}, {"bodies": {}}, {"port": True}]
)
def test_bad_settings(settings: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        DTrackSettings.model_validate(settings)


def sent(listener: Listener, sender: SimulatedDTrack, count: int, begin: float = 0.0) -> list[TrackerFrame]:
    found = []
    for i in range(count):
        sender.send(MIDNIGHT + begin + i / 60, {"base": np.eye(4), "tool": np.eye(4)})
        found += listener.tracker.frames()
    return found


def test_the_noise_is_as_stated(listener: Listener) -> None:
    found = sent(listener, listener.simulated(noise=1e-3, orientation_noise=2e-3), 1500)
    poses = np.array([f.bodies["2"] for f in found])
    np.testing.assert_allclose(poses[:, :3, 3].std(axis=0), 1e-3, rtol=0.1)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    np.testing.assert_allclose(turns.std(axis=0), 2e-3, rtol=0.1)


@pytest.mark.slow
def test_occlusions_take_the_stated_part_of_the_time_in_pieces(listener: Listener) -> None:
    found = sent(listener, listener.simulated(occluded={"tool": 0.3}, occlusion=0.2), 6000)
    unseen = np.array([f.bodies.get("2") is None for f in found])
    assert unseen.mean() == pytest.approx(0.3, abs=0.06)
    pieces = np.count_nonzero(np.diff(unseen.astype(int)) == 1)
    assert unseen.sum() / pieces / 60 == pytest.approx(0.2, rel=0.25)
    assert all(f.bodies["1"] is not None for f in found)


def test_lost_frames_are_missing_among_the_numbers(listener: Listener) -> None:
    found = sent(listener, listener.simulated(lost_frames=0.2), 2000)
    assert len(found) == pytest.approx(1600, abs=80)
    assert found[-1].counter == pytest.approx(2000, abs=10)


def test_the_clock_is_ahead_and_gains(listener: Listener) -> None:
    found = sent(listener, listener.simulated(clock_offset=2.0, clock_skew_ppm=1000.0), 601)
    stamps = [f.stamp for f in found]
    assert stamps[0] == pytest.approx(2.0, abs=2e-6)
    assert stamps[-1] == pytest.approx(12.0 + 0.010, abs=2e-6)


def test_latency_holds_datagrams_back(listener: Listener) -> None:
    sender = listener.simulated(latency=0.1)
    assert sent(listener, sender, 6) == []
    [late] = sent(listener, sender, 1, begin=0.101)
    assert late.counter == 1 and late.stamp == pytest.approx(0.0)


def test_planted_faults(listener: Listener) -> None:
    sender = listener.simulated()
    [good] = sent(listener, sender, 1)
    sender.faults.frozen = "rising"
    frozen = sent(listener, sender, 3, 1.0)
    assert [f.counter for f in frozen] == [2, 3, 4]
    assert all(np.array_equal(f.bodies["2"], good.bodies["2"]) for f in frozen)
    sender.faults.frozen = "same"
    assert sent(listener, sender, 3, 2.0) == [] and listener.tracker.refused
    sender.faults.frozen = "no"
    [live] = sent(listener, sender, 1, 3.0)
    assert live.counter == 8 and not np.array_equal(live.bodies["2"], good.bodies["2"])
    sender.faults.hidden.add("base")
    assert sent(listener, sender, 1, 4.0)[0].bodies.get("1") is None
    sender.faults.silent = True
    assert sent(listener, sender, 2, 5.0) == []
    sender.faults.silent = False
    assert sent(listener, sender, 1, 6.0)[0].counter == 12


def test_the_same_seed_sends_the_same_bytes() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        runs = []
        for _ in range(2):
            settings = DTrackSenderSettings.si(occluded={"tool": 0.2}, lost_frames=0.1, clock_skew_ppm=50.0)
            sender = SimulatedDTrack(settings, *ear.getsockname(), seed=7)
            data = []
            for i in range(100):
                sender.send(MIDNIGHT + i / 60, {"base": np.eye(4), "tool": np.eye(4)})
                while select.select([ear], [], [], 0)[0]:
                    data.append(ear.recv(65536))
            sender.close()
            runs.append(data)
        assert runs[0] == runs[1] and len(runs[0]) > 50


def test_the_time_of_day_never_shows_a_whole_day() -> None:
    assert b"ts 86399.999999\r\n" in datagram(1, 86399.9999999, {}, "6d")
