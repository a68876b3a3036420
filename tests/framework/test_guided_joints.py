"""The joint stream of any device that knows where its joints stand, while the arm is guided by hand."""

from __future__ import annotations

import pytest
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError, DeviceState
from armcal.devices.live import GuidedJoints, GuidedSettings
from armcal.errors import ConfigError

CHANNELS = ("arm.q1", "arm.q2")


class Board:
    """Joints at stated angles (rad); some of them hold."""

    def __init__(self, holding: tuple[str, ...] = ()) -> None:
        self.holding, self.calls = list(holding), []
        self.angles = dict.fromkeys(CHANNELS, 0.1)
        self.fault: DeviceError | None = None

    def open(self, clock: Clock) -> None:
        self.calls.append("open")
        if self.fault is not None:
            raise self.fault

    def state(self) -> DeviceState:
        return DeviceState(dict.fromkeys(self.holding, 0.0))

    def measured(self) -> dict[str, float]:
        if self.fault is not None:
            raise self.fault
        return self.angles

    def release(self, joint: str) -> None:
        self.calls.append(f"release {joint}")

    def close(self) -> None:
        self.calls.append("close")


class Still(Clock):
    time = 0.0

    def now(self) -> float:
        return self.time

    def wall(self) -> float:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds


def stream(board: Board, **settings: object) -> GuidedJoints:
    return GuidedJoints(GuidedSettings.model_validate(settings), lambda channels: board)


def test_joints_are_read_at_the_rate_until_it_is_closed():
    board, clock = Board(), Still()
    made = stream(board, rate_hz=10)
    assert made.ended and made.samples() == []
    made.open(clock, CHANNELS)
    (sample,) = made.samples()
    assert (sample.arrived, sample.angles, made.samples()) == (0.0, board.angles, [])
    clock.sleep(0.1)
    assert len(made.samples()) == 1 and not made.ended
    made.close()
    made.close()
    assert made.ended and board.calls == ["open", "close"]


def test_joints_that_hold_are_refused_or_let_go_from_the_tip():
    board = Board(CHANNELS)
    with pytest.raises(DeviceRefusedError, match=r"arm\.q1, arm\.q2 hold.*torque: release"):
        stream(board).open(Still(), CHANNELS)
    assert board.calls == ["open", "close"], "nothing was let go"
    board = Board(CHANNELS)
    stream(board, torque="release").open(Still(), CHANNELS)
    assert board.calls == ["open", "release arm.q2", "release arm.q1"]


def test_a_device_that_is_lost_is_counted_and_opened_again():
    board, clock = Board(), Still()
    made = stream(board)
    made.open(clock, CHANNELS)
    board.fault = DeviceLostError("gone.")
    assert made.samples() == [] and dict(made.refused) == {"gone.": 2}
    board.fault = None
    assert made.samples() == [], "half a second later"
    clock.sleep(0.5)
    assert len(made.samples()) == 1


def test_a_device_that_is_not_there_is_refused():
    board = Board()
    board.fault = DeviceLostError("no servo answers.")
    with pytest.raises(DeviceRefusedError, match="no servo answers"):
        stream(board).open(Still(), CHANNELS)
    assert board.calls == ["open", "close"]

    def none_of(channels: tuple[str, ...]) -> Board:
        raise ValueError(f"found no servo for {channels[0]}")

    with pytest.raises(ConfigError, match=r"bench\.joints: found no servo for arm\.q1"):
        GuidedJoints(GuidedSettings(), none_of).open(Still(), CHANNELS)
