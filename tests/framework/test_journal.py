"""The journal: what it acknowledged outlasts kills, full disks and limits of file size, and others read meanwhile."""

from __future__ import annotations

import json
import math
import random
import shutil
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from armcal.errors import ArmcalError, DataError, InputError
from armcal.io.journal import JOURNAL, JOURNAL_FILES, Journal, JournalFailedError, JournalFullError, KeptJournal
from journal_killer import content
from soak import shares

KILLER = Path(__file__).resolve().parents[1] / "journal_killer.py"


def kept(folder: Path) -> list[tuple[int, str, object]]:
    with KeptJournal(folder) as journal:
        return [(entry.sequence, entry.kind, entry.content) for entry in journal.entries()]


def written(folder: Path, count: int) -> None:
    with Journal(folder, {"made": "here"}) as journal:
        for number in range(count):
            journal.record("record", {"n": number})


def files_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_what_is_written_is_read_again_and_a_closed_journal_is_one_file(tmp_path: Path) -> None:
    with Journal(tmp_path / "a" / "b", {"made": "here"}) as journal:
        assert journal.is_new and journal.sequence == 0 and journal.checkpoint is None
        assert (journal.record("record", {"x": (1, 2)}), journal.note("level", None)) == (1, 2)
        assert journal.record("é", []) == 3
        assert files_in(journal.folder) == {*JOURNAL_FILES[:3], JOURNAL_FILES[4]}
    assert kept(tmp_path / "a" / "b") == [(1, "record", {"x": [1, 2]}), (2, "level", None), (3, "é", [])]
    assert files_in(tmp_path / "a" / "b") == {JOURNAL}
    with Journal(tmp_path / "a" / "b", {"made": "there"}) as journal:
        assert not journal.is_new and journal.header == {"made": "here"} and journal.record("record", 1) == 4


def test_floats_come_back_bit_for_bit(tmp_path: Path) -> None:
    chance = random.Random(1)
    numbers = [chance.uniform(-1, 1) * 10.0 ** chance.randint(-300, 300) for _ in range(300)]
    numbers += [0.0, -0.0, 5e-324, 1.7976931348623157e308, 0.1 + 0.2]
    with Journal(tmp_path, {}) as journal:
        journal.record("record", numbers)
        journal.put_checkpoint(numbers)
        assert journal.checkpoint is not None
        assert list(map(repr, journal.checkpoint.content)) == list(map(repr, numbers))
    assert list(map(repr, kept(tmp_path)[0][2])) == list(map(repr, numbers))  # type: ignore[call-overload]


@pytest.mark.parametrize("bad", [math.nan, math.inf, [1, {"x": math.nan}], {1, 2}, b"x"])
def test_what_is_no_json_is_refused_and_leaves_no_trace(tmp_path: Path, bad: object) -> None:
    with Journal(tmp_path, {}) as journal:
        for write in (lambda: journal.record("record", bad), lambda: journal.put_checkpoint(bad)):
            with pytest.raises((ValueError, TypeError)):
                write()
        assert journal.record("record", 1) == 1


def test_every_entry_is_reached_from_the_checkpoint_before_it(tmp_path: Path) -> None:
    with Journal(tmp_path, {}) as journal:
        journal.put_checkpoint(0)
        for number in range(1, 31):
            assert journal.record("record", number) == number
            if number % 7 == 0:
                journal.put_checkpoint(number)
        for number in range(1, 31):
            checkpoint, entries = journal.until(number)
            assert checkpoint.content == number - number % 7
            assert [entry.content for entry in entries] == list(range(checkpoint.content + 1, number + 1))
        for wrong in (-1, 0, 31, 10**9):
            with pytest.raises(InputError, match=rf"found no entry {wrong}; the journal goes from 1 to 30"):
                journal.until(wrong)


def test_the_oldest_go_where_there_would_be_more_than_may_be(tmp_path: Path) -> None:
    with Journal(tmp_path, {}, total_bytes=200_000) as journal:
        for number in range(1, 3001):
            journal.note("record", {"x": [number / 7] * 20})
            if number % 100 == 0:
                journal.put_checkpoint({"n": number, "x": [0.1] * 500})
        assert (tmp_path / JOURNAL).stat().st_size < 600_000
        numbers = [entry.sequence for entry in journal.entries()]
        assert numbers == list(range(numbers[0], 3001)) and 200 < len(numbers) < 1200
        assert journal.until(numbers[0])[0].content["n"] == numbers[0]
        with pytest.raises(InputError, match=f"goes from {numbers[0]} to 3000"):
            journal.until(numbers[0] - 1)
        journal.verify()


def test_a_state_larger_than_the_limit_is_kept(tmp_path: Path) -> None:
    with Journal(tmp_path, {}, total_bytes=65536) as journal:
        for number in range(3):
            journal.record("record", number)
            journal.put_checkpoint("x" * 100_000 + str(number))
        assert journal.checkpoint is not None and journal.checkpoint.content.endswith("x2")
        assert [entry.content for entry in journal.entries()] == [2]


def test_a_second_writer_is_refused(tmp_path: Path) -> None:
    with Journal(tmp_path, {}) as journal:
        with pytest.raises(InputError, match="another process writes this journal already"):
            Journal(tmp_path, {})
        assert journal.record("record", 1) == 1
    written(tmp_path, 1)


def test_it_is_read_and_backed_up_while_another_process_writes_it(tmp_path: Path) -> None:
    """Half a million bytes at a time, or all: what is read has every entry up to its last."""
    folder, ends = tmp_path / "journal", threading.Event()
    code = f"import journal_killer, os; journal_killer.live(journal_killer.Path({str(folder)!r}), 3, os.dup(1))"
    writer = subprocess.Popen([sys.executable, "-c", code], cwd=KILLER.parent, stdout=subprocess.PIPE)
    assert writer.stdout is not None
    acknowledged: list[int] = []

    def hear() -> None:
        assert writer.stdout is not None
        for line in writer.stdout:
            acknowledged.append(int(line.split()[0]))
        ends.set()

    listener = threading.Thread(target=hear)
    listener.start()
    try:
        for turn in range(20):
            while len(acknowledged) < 30 * (turn + 1) and writer.poll() is None:
                ends.wait(0.01)
            before = acknowledged[-1]
            found = kept(folder)
            assert [number for number, _, _ in found] == list(range(found[0][0], found[-1][0] + 1))
            assert found[-1][0] >= before
            copy = tmp_path / "copy" / JOURNAL
            copy.parent.mkdir(exist_ok=True)
            copy.unlink(missing_ok=True)
            source, target = sqlite3.connect(f"file:{folder / JOURNAL}?mode=ro", uri=True), sqlite3.connect(copy)
            source.backup(target, pages=50 if turn % 2 else -1)
            target.close()
            source.close()
            with KeptJournal(copy.parent) as journal:
                journal.verify()
                assert journal.sequence >= before
    finally:
        writer.kill()
        writer.wait()
        listener.join()
    assert kept(folder)[-1][0] >= acknowledged[-1]


@pytest.mark.parametrize("lives", [range(20), *shares(20, 200, 3)])
def test_kills_at_random_moments_lose_nothing_acknowledged(tmp_path: Path, lives: range) -> None:
    kills, seed = str(len(lives)), str(lives.start)
    done = subprocess.run(
        [sys.executable, str(KILLER), str(tmp_path), kills, seed], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[0]) > len(lives)


LIMITED = """
import json, resource, sys
from pathlib import Path
from armcal.io.journal import Journal, JournalFullError
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
with Journal(Path(sys.argv[1]), {}) as journal:
    full = 0
    for number in range(1000):
        try:
            print(journal.record("record", {"n": number, "x": "x" * 1000}), number, flush=True)
        except JournalFullError as fault:
            full += 1
            if full == 3:
                sys.exit(str(fault))
"""


@pytest.mark.parametrize("limit", [100_000, 250_001])
def test_a_limit_of_file_size_refuses_entries_and_keeps_all_that_were_acknowledged(tmp_path: Path, limit: int) -> None:
    command = [sys.executable, "-c", LIMITED, str(tmp_path / "out"), str(limit)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "there is no room for an entry" in done.stderr and "Traceback" not in done.stderr
    said = [tuple(map(int, line.split())) for line in done.stdout.splitlines()]
    assert len(said) > limit / 10_000
    assert [(number, entry["n"]) for number, _, entry in kept(tmp_path / "out")] == said  # type: ignore[index]
    with Journal(tmp_path / "out", {}) as journal:
        journal.verify()
        assert journal.record("record", 1) == said[-1][0] + 1


@pytest.fixture()
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 1 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    given = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", place]
    if subprocess.run(given, capture_output=True, check=False).returncode:
        pytest.skip("no tmpfs can be mounted here")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=True)


def test_a_full_disk_refuses_entries_keeps_all_that_were_acknowledged_and_goes_on_when_there_is_room(
    small_disk: Path,
) -> None:
    folder, said = small_disk / "out", []
    filler = small_disk / "filler"
    filler.write_bytes(b"x" * 400_000)
    with Journal(folder, {}) as journal:
        with pytest.raises(JournalFullError, match=r"no room for an entry.*Make room on the disk"):
            while True:
                said.append(journal.record("record", {"x": "x" * 3000}))
        for _ in range(3):
            with pytest.raises(JournalFullError):
                journal.put_checkpoint("x" * 100_000)
        assert [entry.sequence for entry in journal.entries()] == said and len(said) > 20
        filler.unlink()
        assert journal.record("record", {"x": "x" * 3000}) == said[-1] + 1
    assert len(kept(folder)) == len(said) + 1
    filler.write_bytes(b"x" * (shutil.disk_usage(small_disk).free // 4096 * 4096))
    with pytest.raises(JournalFullError, match="Make room on the disk"):
        Journal(folder, {})
    assert len(kept(folder)) == len(said) + 1


def test_one_that_another_program_holds_locked_takes_nothing_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armcal.io.journal._WAIT_S", 0.1)
    with Journal(tmp_path, {}) as journal:
        journal.record("record", 1)
        other = sqlite3.connect(tmp_path / JOURNAL, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        for _ in range(2):
            with pytest.raises(JournalFailedError, match=r"database is locked.*a program that holds the file locked"):
                journal.record("record", 2)
        other.close()
    assert [content for _, _, content in kept(tmp_path)] == [1]


def test_places_that_hold_none_or_cannot_be_written_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for place in (tmp_path / "file", tmp_path / "file" / "within", Path("/proc/nothing")):
        with pytest.raises(InputError, match="cannot be written"):
            Journal(place, {})
        with pytest.raises(DataError, match="there is no journal here"):
            KeptJournal(place)
    assert (tmp_path / "file").read_text() == "mine"


def test_a_closed_journal_and_that_of_a_killed_writer_are_read_where_nothing_can_be_written(tmp_path: Path) -> None:
    subprocess.run([sys.executable, str(KILLER), str(tmp_path / "killed"), "1", "5"], check=True, capture_output=True)
    written(tmp_path / "closed", 3)
    for name in ("killed", "closed"):
        before = {path: path.read_bytes() for path in sorted((tmp_path / name).iterdir())}
        (tmp_path / name).chmod(0o555)
        assert kept(tmp_path / name)
        (tmp_path / name).chmod(0o755)
        assert {path: path.read_bytes() for path in sorted((tmp_path / name).iterdir()) if "shm" not in path.name} == {
            path: data for path, data in before.items() if "shm" not in path.name
        }


def test_what_is_no_journal_of_this_version_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    written(tmp_path / "later", 2)
    with sqlite3.connect(tmp_path / "later" / JOURNAL) as database:
        database.execute("PRAGMA user_version = 9")
    database.close()
    (tmp_path / "other").mkdir()
    with sqlite3.connect(tmp_path / "other" / JOURNAL) as database:
        database.execute("CREATE TABLE mine (x)")
    database.close()
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / JOURNAL).write_text("what I wrote\n" * 100)
    for name, words in (
        ("later", "found journal format 9, expected 2"),
        ("other", "a database of another program"),
        ("text", "not a database"),
    ):
        before = {path: path.read_bytes() for path in (tmp_path / name).rglob("*") if path.is_file()}
        for opened in (lambda name=name: Journal(tmp_path / name, {}), lambda name=name: KeptJournal(tmp_path / name)):
            with pytest.raises(ArmcalError, match=words):
                opened()
        assert {path: path.read_bytes() for path in (tmp_path / name).rglob("*") if path.is_file()} == before


def test_one_that_was_never_begun_in_whole_is_begun(tmp_path: Path) -> None:
    (tmp_path / JOURNAL).write_bytes(b"")
    with pytest.raises(DataError, match="never begun"):
        KeptJournal(tmp_path)
    written(tmp_path, 1)
    assert len(kept(tmp_path)) == 1


@pytest.mark.parametrize("seeds", [range(40), *shares(40, 1000, 2)])
def test_damaged_bytes_are_read_as_they_were_or_end_with_a_sentence(tmp_path: Path, seeds: range) -> None:
    with Journal(tmp_path, {}) as journal:
        for number in range(60):
            journal.record("record", content(1, number))
    whole = (tmp_path / JOURNAL).read_bytes()
    for seed in seeds:
        chance, bad = random.Random(seed), bytearray(whole)
        at = chance.randrange(200 if chance.random() < 0.3 else len(bad))
        match chance.randrange(3):
            case 0:
                bad[at] ^= 1 << chance.randrange(8)
            case 1:
                bad[at : at + 4096] = bytes(len(bad[at : at + 4096]))
            case _:
                del bad[at:]
        (tmp_path / JOURNAL).write_bytes(bad)
        for opened in (lambda: KeptJournal(tmp_path), lambda: Journal(tmp_path, {})):
            try:
                with opened() as journal:
                    for entry in journal.entries():
                        json.dumps(entry.content)
                    assert journal.checkpoint is None
            except (DataError, InputError, JournalFailedError) as fault:
                assert JOURNAL in str(fault) and len(str(fault)) > 60


@pytest.mark.slow
def test_memory_stays_flat(tmp_path: Path) -> None:
    """What a journal holds on to does not grow with what went through it."""
    import tracemalloc

    def go_on(journal: Journal, count: int) -> None:
        for number in range(count):
            journal.note("record", {"x": [number / 3] * 20})
            if number % 100 == 0:
                journal.put_checkpoint([0.5] * 100)

    with Journal(tmp_path, {}, total_bytes=100_000) as journal:
        go_on(journal, 1000)
        tracemalloc.start()
        go_on(journal, 100)
        before = tracemalloc.get_traced_memory()[0]
        go_on(journal, 2000)
        grown = tracemalloc.get_traced_memory()[0] - before
        tracemalloc.stop()
    assert grown < 10_000
