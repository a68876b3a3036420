"""Files written together: an export with its companions is the earlier one or the new one, whatever goes wrong."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from armcal.errors import InputError
from armcal.io.file_set import write_new, write_over

NAMES = ("arm.h", "arm.c", "check.c")


def contents(folder: Path, mark: str) -> dict[Path, bytes]:
    return {folder / name: f"{name} of {mark}".encode() for name in NAMES}


def found(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), KeyboardInterrupt()], ids=repr)
@pytest.mark.parametrize("is_first", [True, False], ids=["new", "over"])
def test_a_fault_at_any_rename_or_write_leaves_the_earlier_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: BaseException, is_first: bool
) -> None:
    """At an interrupt those that had their place already kept it, and the earlier ones were lost."""
    write = write_new if is_first else write_over
    for call, owner in (("replace", Path), ("fsync", os)):
        real = getattr(owner, call)
        for step in range(3 if is_first or call == "replace" else 6):
            folder, left = tmp_path / f"{call}{step}", [step]
            folder.mkdir()
            if not is_first:
                write_new(contents(folder, "first"))
            before = found(folder)

            def failing(*given: object, left: list[int] = left, real=real) -> object:
                left[0] -= 1
                if left[0] == -1:
                    raise fault
                return real(*given)

            with monkeypatch.context() as patch:
                patch.setattr(owner, call, failing)
                with pytest.raises(KeyboardInterrupt if isinstance(fault, KeyboardInterrupt) else InputError):
                    write(contents(folder, "second"))
            assert found(folder) == before, (call, step)
    write_over(contents(folder, "third"))
    assert found(folder) == dict(sorted(contents(folder, "third").items()))


def test_what_a_killed_process_staged_goes_with_the_next_write_and_files_of_others_stay(tmp_path: Path) -> None:
    stale, fresh, foreign = (tmp_path / n for n in (".armcal-arm.c-abcdefgh", ".armcal-arm.c-abcdefgi", ".arm.c.swp"))
    for path in (stale, fresh, foreign):
        path.write_text("kept")
    os.utime(stale, (0, 0))
    os.utime(foreign, (0, 0))
    write_new(contents(tmp_path, "first"))
    assert not stale.exists() and fresh.exists() and foreign.exists()
