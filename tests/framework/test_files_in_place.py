"""Files put in place: whole or not at all, and none for want of room where several are written together."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from armcal.errors import InputError
from armcal.io.plain_files import write_new, write_over, write_whole

NAMES = ("arm.h", "arm.c", "check.c")


def contents(folder: Path, mark: str) -> dict[Path, bytes]:
    return {folder / name: f"{name} of {mark}".encode() for name in NAMES}


def found(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), KeyboardInterrupt()], ids=repr)
@pytest.mark.parametrize("is_first", [True, False], ids=["new", "over"])
def test_a_fault_while_any_is_written_leaves_the_earlier_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: BaseException, is_first: bool
) -> None:
    write, real = (write_new if is_first else write_over), os.fsync
    for step in range(3):
        folder, left = tmp_path / str(step), [step]
        folder.mkdir()
        if not is_first:
            write_new(contents(folder, "first"))
        before = found(folder)

        def failing(*given: object, left: list[int] = left) -> object:
            left[0] -= 1
            if left[0] == -1:
                raise fault
            return real(*given)

        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", failing)
            with pytest.raises(KeyboardInterrupt if isinstance(fault, KeyboardInterrupt) else InputError):
                write(contents(folder, "second"))
        assert found(folder) == before, step
    write_over(contents(folder, "third"))
    assert found(folder) == dict(sorted(contents(folder, "third").items()))


def test_what_is_there_is_not_written_over_unless_that_was_asked_for(tmp_path: Path) -> None:
    write_over({tmp_path / "arm.c": b"mine"})
    with pytest.raises(InputError, match="it is there already"):
        write_new(contents(tmp_path, "second"))
    assert found(tmp_path) == {tmp_path / "arm.c": b"mine"}


def test_a_file_is_put_in_place_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "calibration.yaml"
    write_whole(path, b"first")
    for name in ("fsync", "replace"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, lambda *given: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
            with pytest.raises(OSError, match="full"):
                write_whole(path, b"second")
        assert found(tmp_path) == {path: b"first"}
    write_whole(path, b"third")
    assert found(tmp_path) == {path: b"third"}
