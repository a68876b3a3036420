"""The folder of a run: a whole set of files or no calibration, whatever ends the run; one run at a time."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from armcal.cli.main import cli
from armcal.errors import InputError
from armcal.io.plain_files import reserved
from click.testing import CliRunner

ROOT = Path(__file__).resolve().parents[2]
DEMO = str(ROOT / "configs" / "lrm_arm" / "demo.yaml")
FAST = ("--set", "validation.folds=0", "--set", "evaluator=interpreted")
OURS = ("notes.txt", "table.csv", "page.html", "result.yaml")


@pytest.mark.slow
def test_a_run_asks_nothing_of_the_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full one ended in a traceback after the fit, and nothing was written."""

    def full(*given: object, **more: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(tempfile, "gettempdir", full)
    monkeypatch.setattr(tempfile, "TemporaryDirectory", full)
    ran = CliRunner().invoke(cli, ["run", DEMO, "--out", str(tmp_path / "run"), "-q", *FAST])
    assert ran.exit_code == 0, ran.output
    assert (tmp_path / "run" / "calibration.yaml").exists()


def place(folder: Path, contents: dict[str, str]) -> None:
    with reserved(folder, OURS) as held:
        held.place(contents)


def texts(mark: str, names: tuple[str, ...] = OURS) -> dict[str, str]:
    return {name: f"{name} of {mark}\n" for name in names}


def found(folder: Path) -> dict[str, str]:
    return {p.name: p.read_text() for p in folder.iterdir() if p.is_file() and p.name in OURS}


def everything(folder: Path) -> set[str]:
    """The content of every file under a folder and beside it."""
    return {path.read_text() for path in folder.parent.rglob("*") if path.is_file()}


def counted(monkeypatch: pytest.MonkeyPatch, act: Callable[[str], None]) -> None:
    """Call ``act`` with a name before each call that changes what is on the disk."""

    def before(name: str, call: Callable[..., object]) -> Callable[..., object]:
        def watched(*given: object, **more: object) -> object:
            act(name)
            return call(*given, **more)

        return watched

    for name in ("mkdir", "rmdir", "unlink"):
        monkeypatch.setattr(Path, name, before(name, getattr(Path, name)))
    for name in ("fsync", "replace"):
        monkeypatch.setattr(os, name, before(name, getattr(os, name)))


def steps(tmp_path: Path) -> int:
    """How many changes of the disk a second set takes."""
    folder, count = tmp_path / "counting", []
    place(folder, texts("a"))
    with pytest.MonkeyPatch.context() as patch:
        counted(patch, count.append)
        place(folder, texts("b"))
    assert found(folder) == texts("b")
    return len(count)


def killed_at(step: int, folder: Path, mark: str) -> int:
    """Write a set in a process that is killed before its ``step``-th change of the disk; its exit code."""

    def run() -> None:
        left = [step]

        def act(name: str) -> None:
            left[0] -= 1
            if left[0] < 0:
                os.kill(os.getpid(), signal.SIGKILL)

        counted(pytest.MonkeyPatch(), act)
        place(folder, texts(mark))

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    process.join(60)
    return int(process.exitcode or 0)


@pytest.mark.slow
def test_a_killed_run_leaves_no_result_with_other_companions(tmp_path: Path) -> None:
    """Each change of the disk in turn is the one before which the process is killed."""
    total, ends = steps(tmp_path), []
    assert total > 10
    for step in range(total):
        folder = tmp_path / f"step{step}" / "out"
        place(folder, texts("first"))
        assert killed_at(step, folder, "second") == -signal.SIGKILL
        now = found(folder)
        ends.append(now.get("result.yaml"))
        if "result.yaml" in now:
            assert now in (texts("first"), texts("second")), (step, now)
        assert set(texts("first").values()) <= everything(folder), step
        place(folder, texts("third"))
        assert found(folder) == texts("third") and not list(folder.glob(".armcal-*"))
        assert [path.name for path in folder.parent.iterdir()] == ["out"]
    assert {*ends} == {None, texts("first")["result.yaml"], texts("second")["result.yaml"]}


def test_a_full_disk_at_any_step_leaves_the_earlier_set_or_the_new_one(tmp_path: Path) -> None:
    refused = 0
    for step in range(steps(tmp_path)):
        folder, left = tmp_path / f"step{step}" / "out", [step]
        place(folder, texts("first"))

        def act(name: str, left: list[int] = left) -> None:
            left[0] -= 1
            if left[0] == -1 and name not in ("rmdir", "unlink"):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        with pytest.MonkeyPatch.context() as patch:
            counted(patch, act)
            try:
                place(folder, texts("second"))
            except InputError as fault:
                refused += 1
                assert "No space left" in str(fault) and found(folder) == texts("first"), step
                assert not list((folder / "earlier").glob("*")), step
            else:
                assert found(folder) == texts("second"), step
        assert set(texts("first").values()) <= everything(folder), step
        place(folder, texts("third"))
        assert found(folder) == texts("third")
    assert refused > 5


def test_a_folder_that_is_the_working_directory_stays_the_same_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    folder.mkdir(mode=0o700)
    monkeypatch.chdir(folder)
    for mark in ("first", "second"):
        place(Path(), texts(mark))
        assert found(Path.cwd()) == found(folder) == texts(mark)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "latest").symlink_to(folder)
    place(Path("latest"), texts("third"))
    assert (tmp_path / "latest").is_symlink() and found(folder) == texts("third")
    assert folder.stat().st_mode & 0o777 == 0o700, "its rights are those that it had"
    assert [found(path) for path in sorted((folder / "earlier").iterdir())] == [texts("first"), texts("second")]


@pytest.mark.slow
def test_a_second_run_into_one_folder_is_refused_while_the_first_lasts(tmp_path: Path) -> None:
    """Both ended with 0, and the folder had files of both."""
    folder = tmp_path / "out"
    with reserved(folder, folders_of_a_run()) as held:
        second = CliRunner().invoke(cli, ["run", DEMO, "--out", str(folder), "-q", *FAST])
        assert second.exit_code == 2 and "another run writes to it" in second.output, second.output
        assert "Wait until it ends, or give another --out." in second.output
        held.place({"metrics.json": "{}\n"})
        third = CliRunner().invoke(cli, ["run", DEMO, "--out", str(folder), "-q", *FAST])
        assert third.exit_code == 2 and "another run writes to it" in third.output, "it lasts on after its files"
    assert [path.name for path in folder.iterdir()] == ["metrics.json"]
    assert CliRunner().invoke(cli, ["run", DEMO, "--out", str(folder), "-q", *FAST]).exit_code == 0


def folders_of_a_run() -> tuple[str, ...]:
    from armcal.run.result import FILES

    return FILES


def test_what_a_refused_run_reserved_is_not_left_behind(tmp_path: Path) -> None:
    bad = tmp_path / "bad.yaml"
    bad.write_text("arms: 3\n")
    assert CliRunner().invoke(cli, ["run", str(bad), "--out", str(tmp_path / "runs" / "new")]).exit_code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["bad.yaml"]


@pytest.mark.slow
def test_real_runs_killed_at_random_moments_leave_a_whole_set_or_no_calibration(tmp_path: Path) -> None:
    import random

    import yaml

    folder, dice, names = tmp_path / "out", random.Random(24), None
    command = [sys.executable, "-m", "armcal.cli", "run", DEMO, "--out", str(folder), "-q", *FAST]
    began = time.monotonic()
    subprocess.run(command, check=True)
    lasts = time.monotonic() - began
    for number in range(20):
        process = subprocess.Popen(command)
        time.sleep(dice.uniform(0.6, 1.05) * lasts)
        process.kill()
        process.wait()
        present = {path.name for path in folder.iterdir() if path.is_file() and not path.name.startswith(".armcal-")}
        names = names or present
        if "calibration.yaml" in present:
            assert present == names, (number, present)
            assert yaml.safe_load((folder / "calibration.yaml").read_text())["created"]
    subprocess.run(command, check=True)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_link_that_leads_nowhere_is_moved_away_as_a_file_is(tmp_path: Path) -> None:
    """Left there, what is written later under its name would be written elsewhere."""
    folder, elsewhere = tmp_path / "run", tmp_path / "elsewhere.txt"
    folder.mkdir()
    (folder / "notes.txt").symlink_to(elsewhere)
    with reserved(folder, OURS) as held:
        held.place({})
    assert not os.path.lexists(folder / "notes.txt") and (folder / "earlier" / "1" / "notes.txt").is_symlink()
    assert not elsewhere.exists()
