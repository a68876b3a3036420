"""Which content of a watched file is loaded: a whole one, once, whatever is written meanwhile or cannot be used."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import pytest
from armcal.config.yaml_source import MAX_BYTES
from armcal.errors import ConfigError
from armcal_serve.answers import Answerer
from armcal_serve.loading import CalibrationFile, Loader
from serving import put, sha256

END = f"# sha256 of the lines above: {'0' * 64}\n"
FIRST, SECOND, THIRD = (f"number: {i}\n{END}" for i in range(3))


class Fake(Loader):
    """Takes what is whole, but for what says that it is of another arm."""

    def load(self, data: bytes) -> tuple[Answerer, list[str]]:
        if not data.endswith(END.encode()):
            raise ConfigError("it was cut.")
        if b"another arm" in data:
            raise ConfigError("it is of another arm.")
        if b"odd" in data:
            raise ZeroDivisionError("odd")
        self.sequence += 1
        tag: dict[str, Any] = {"sequence": self.sequence, "sha256": sha256(data.decode()), "created": "", "level": None}
        return Answerer({}, tag), []


@pytest.fixture
def file(tmp_path: Path) -> CalibrationFile:
    path = tmp_path / "calibration.yaml"
    path.write_text(FIRST)
    return opened(path)


NEWS: list[str] = []  # the names of the events since they were last looked at


def opened(path: Path) -> CalibrationFile:
    found = CalibrationFile(Fake(str(path)), lambda event, sentence, content: NEWS.append(event))
    found.load()
    looks(found, 2)
    return found


def looks(file: CalibrationFile, times: int) -> list[str]:
    """The names of the events."""
    for _ in range(times):
        file.look()
    names = [*NEWS]
    NEWS.clear()
    return names


def test_a_renamed_file_is_taken_once(file: CalibrationFile) -> None:
    put(file.path, SECOND)
    assert looks(file, 1) == ["calibration"]
    assert looks(file, 20) == [] and file.state == "taken"
    assert file.served is not None and file.served.tag["sha256"] == sha256(SECOND)


def test_every_renamed_file_is_seen_although_numbers_of_inodes_come_again(file: CalibrationFile) -> None:
    for i in range(20):
        put(file.path, f"file {i:02}\n{END}")  # the same size and, on some disks, the inode of the one before the last
        os.utime(file.path, (i, i))
        assert looks(file, 2) == ["calibration"], i


def test_a_file_that_is_written_in_place_is_taken_when_it_is_whole(file: CalibrationFile) -> None:
    with file.path.open("w", buffering=1) as out:
        for i in range(30):
            out.write(f"line {i}\n")
            out.flush()
            os.utime(out.fileno(), (i, i))
            assert set(looks(file, 3)) <= {"refused"}
            assert file.state == "refused" and "it was cut" in file.why
        out.write(END)
    assert looks(file, 2) == ["calibration"] and file.state == "taken"


def test_a_file_that_is_gone_is_told_once_and_may_come_back(file: CalibrationFile) -> None:
    file.path.unlink()
    assert looks(file, 3) == ["missing"] and "the calibration before is used on" in file.why
    file.path.write_text(FIRST)
    assert looks(file, 2) == [] and file.state == "taken"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "it was cut"),
        ("recalibrated: null\n", "it was cut"),
        ("x" * (MAX_BYTES + 1), "larger"),
        (f"another arm\n{END}", "another arm"),
        (f"odd\n{END}", "ZeroDivisionError: odd"),
    ],
)
def test_what_cannot_be_used_is_refused_and_the_next_is_taken(file: CalibrationFile, text: str, why: str) -> None:
    put(file.path, text)
    assert looks(file, 20) == ["refused"]
    assert file.state == "refused" and why in file.why
    assert file.served is not None and file.served.tag["sha256"] == sha256(FIRST)
    put(file.path, THIRD)
    assert looks(file, 2) == ["calibration"]


def test_the_same_content_again_is_no_news(file: CalibrationFile) -> None:
    put(file.path, FIRST)
    assert looks(file, 3) == [] and file.state == "taken"
    put(file.path, f"another arm\n{END}")
    assert looks(file, 3) == ["refused"]
    put(file.path, FIRST)
    assert looks(file, 3) == [] and file.state == "taken"


def test_a_file_that_cannot_be_had_at_the_start_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "empty").write_text("")
    os.mkfifo(tmp_path / "pipe")
    for name in ("none", ".", "empty", "pipe"):
        with pytest.raises(ConfigError):
            opened(tmp_path / name)


def test_a_pipe_in_the_place_of_the_calibration_is_refused_and_not_waited_for(file: CalibrationFile) -> None:
    """Nobody writes to it: to open it as a file is opened would hold the server up for ever."""
    file.path.unlink()
    os.mkfifo(file.path)
    looking = threading.Thread(target=looks, args=(file, 3), daemon=True)
    looking.start()
    looking.join(5)
    assert not looking.is_alive()
    assert file.state == "refused" and "it is a device or pipe, expected a calibration.yaml." in file.why
    file.path.unlink()
    put(file.path, SECOND)
    assert looks(file, 2) == ["calibration"]
