"""Which bytes of a watched file are tried: renamed ones at once, others when they rest, and never half of them."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
from armcal.config.yaml_source import MAX_BYTES
from armcal.errors import ConfigError
from armcal_serve.server import AGAIN_S, QUIET_S, CalibrationWatch
from serving import put

END = f"# sha256 of the lines above: {'0' * 64}\n"
FIRST, SECOND, THIRD = (f"number: {i}\n{END}" for i in range(3))


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def watch(tmp_path: Path, clock: Clock) -> CalibrationWatch:
    path = tmp_path / "calibration.yaml"
    path.write_text(FIRST)
    found = CalibrationWatch(path, clock)
    assert found.first().data == FIRST.encode()
    found.taken()
    return found


def looks(watch: CalibrationWatch, clock: Clock, seconds: float) -> list[bytes]:
    found = []
    for _ in range(round(seconds / 0.2)):
        clock.now += 0.2
        snapshot = watch.look()
        if snapshot is not None:
            found.append(snapshot.data)
    return found


def test_a_renamed_file_is_taken_once_at_the_second_look(watch: CalibrationWatch, clock: Clock) -> None:
    assert looks(watch, clock, 2) == []
    put(watch.path, SECOND)
    assert looks(watch, clock, 0.2) == [] and looks(watch, clock, 0.2) == [SECOND.encode()]
    assert watch.state == "loading"
    watch.taken()
    assert looks(watch, clock, 20) == []


def test_every_renamed_file_is_seen_although_numbers_of_inodes_come_again(
    watch: CalibrationWatch, clock: Clock
) -> None:
    for i in range(20):
        put(watch.path, f"file {i}\n{END}")  # the same size and, on some disks, the inode of the one before the last
        assert looks(watch, clock, 0.4) == [f"file {i}\n{END}".encode()], i
        watch.taken()


def test_a_file_that_is_written_in_place_is_read_when_it_rests(watch: CalibrationWatch, clock: Clock) -> None:
    with watch.path.open("w", buffering=1) as file:
        for i in range(30):
            file.write(f"line {i}\n")
            file.flush()
            os.utime(file.fileno(), (i, i))
            assert looks(watch, clock, 0.8) == []
            assert watch.state == "settling" and "in place" in watch.why
        file.write(END)
    assert looks(watch, clock, QUIET_S - 0.4) == []
    (found,) = looks(watch, clock, 1)
    assert found.count(b"\n") == 31


def test_a_new_file_that_grows_is_read_when_it_rests(watch: CalibrationWatch, clock: Clock) -> None:
    watch.path.unlink()
    assert looks(watch, clock, 1) == [] and watch.state == "missing"
    watch.path.write_text("half")
    assert looks(watch, clock, 0.2) == []
    watch.path.write_text("half and more, ")
    assert looks(watch, clock, 0.4) == []
    with watch.path.open("a") as file:
        file.write(f"whole\n{END}")
    assert looks(watch, clock, QUIET_S - 0.2) == []
    assert looks(watch, clock, 1) == [f"half and more, whole\n{END}".encode()]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "empty"),
        ("cut", "no end"),
        ("recalibrated: null\n", "the line that ends"),
        ("x" * (MAX_BYTES + 1), "larger"),
    ],
)
def test_what_is_not_whole_is_refused_and_the_next_is_taken(
    watch: CalibrationWatch, clock: Clock, text: str, why: str
) -> None:
    put(watch.path, text)
    assert looks(watch, clock, 20) == []
    assert watch.state == "refused" and why in watch.why
    put(watch.path, THIRD)
    assert looks(watch, clock, 1) == [THIRD.encode()]


def test_the_same_content_again_is_no_news(watch: CalibrationWatch, clock: Clock) -> None:
    put(watch.path, FIRST)
    assert looks(watch, clock, 2) == [] and watch.state == "taken"
    os.utime(watch.path)
    assert looks(watch, clock, 2 * QUIET_S) == [] and watch.state == "taken"
    text = watch.path.read_text()
    watch.path.unlink()
    assert looks(watch, clock, 1) == [] and watch.state == "missing"
    watch.path.write_text(text)
    assert looks(watch, clock, 1) == [] and watch.state == "taken"


def test_what_was_refused_is_tried_again_only_if_it_was_not_its_own_fault(
    watch: CalibrationWatch, clock: Clock
) -> None:
    put(watch.path, SECOND)
    assert looks(watch, clock, 1) == [SECOND.encode()]
    watch.refused("no memory", again=True)
    assert looks(watch, clock, AGAIN_S - 1) == []
    assert looks(watch, clock, 2) == [SECOND.encode()]
    watch.refused("another arm")
    assert looks(watch, clock, 3 * AGAIN_S) == []
    assert (watch.state, watch.why) == ("refused", "another arm")


def test_after_a_refusal_the_file_that_is_served_may_come_back(watch: CalibrationWatch, clock: Clock) -> None:
    put(watch.path, SECOND)
    looks(watch, clock, 1)
    watch.refused("another arm")
    put(watch.path, FIRST)
    assert looks(watch, clock, 2) == [] and watch.state == "taken"
    put(watch.path, SECOND)
    assert looks(watch, clock, 2) == [SECOND.encode()]


def test_a_file_that_cannot_be_had_at_the_start_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "empty").write_text("")
    os.mkfifo(tmp_path / "pipe")
    for name in ("none", ".", "empty", "pipe"):
        with pytest.raises(ConfigError):
            CalibrationWatch(tmp_path / name).first()


def test_a_pipe_in_the_place_of_the_calibration_is_refused_and_not_waited_for(
    watch: CalibrationWatch, clock: Clock
) -> None:
    """Nobody writes to it: to open it as a file is opened would hold the server up for ever."""
    watch.path.unlink()
    os.mkfifo(watch.path)
    looking = threading.Thread(target=looks, args=(watch, clock, 2), daemon=True)
    looking.start()
    looking.join(5)
    assert not looking.is_alive()
    assert watch.state == "refused" and watch.why == "it is a device or pipe, expected a calibration.yaml."
    watch.path.unlink()
    put(watch.path, SECOND)
    assert looks(watch, clock, QUIET_S + 2) == [SECOND.encode()]  # it may have the pipe's inode
