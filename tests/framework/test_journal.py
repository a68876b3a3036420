"""The journal as its users meet it: round trips, reopening, rotation, limits, refusals, one writer, kills."""

from __future__ import annotations

import json
import math
import os
import random
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from armcal.errors import DataError, InputError
from armcal.io.journal.files import FileLayer, write_whole
from armcal.io.journal.journal import Journal, JournalLimits
from armcal.io.journal.reader import read_entries, read_newest, read_segments, read_until, verify
from soak import shares

HEADER = {"software": "1.2.3", "evaluator": {"kernel": "abc"}}
SMALL = JournalLimits(segment_bytes=600, total_bytes=4000)
KILLER = Path(__file__).resolve().parents[1] / "journal_killer.py"


def filled(folder: Path, count: int, limits: JournalLimits = SMALL) -> list[tuple[int, str, object]]:
    """A journal of records, notes and checkpoints; what was written."""
    written = []
    with Journal.open(folder, HEADER, limits=limits) as journal:
        for number in range(count):
            written.append((journal.record("record", {"x": number / 7}), "record", {"x": number / 7}))
            written.append((journal.note("decision", [number]), "decision", [number]))
            if journal.wants_checkpoint:
                written.append((journal.checkpoint({"n": number}), "checkpoint", {"n": number}))
    return written


def said(entries) -> list[tuple[int, str, object]]:
    return [(entry.sequence, entry.kind, entry.content) for entry in entries]


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    content = {"a": [1, -2.5, True, None, "ä\n\0\ud800"], "b": {"": {}, "c": [[], 10**40]}}
    with Journal.open(tmp_path / "deep" / "journal", HEADER) as journal:
        assert journal.recovered.checkpoint is None and journal.recovered.entries == ()
        sequence = journal.record("record", content)
        assert journal.sequence == sequence
    with Journal.open(tmp_path / "deep" / "journal", {}) as journal:
        assert said(journal.recovered.entries) == [(sequence, "record", content)]
        assert journal.recovered.header == HEADER
        assert journal.recovered.cut is None
        assert type(journal.recovered.entries[0].content["a"][2]) is bool


def test_floats_come_back_bit_for_bit(tmp_path: Path) -> None:
    rng = random.Random(1)
    values = [struct.unpack("<d", rng.randbytes(8))[0] for _ in range(3000)]
    values = [v for v in values if math.isfinite(v)] + [0.0, -0.0, 5e-324, 0.1, 1e22, sys.float_info.max, 1.0]
    with Journal.open(tmp_path, {}) as journal:
        journal.record("record", values)
    (found,) = (entry.content for entry in read_entries(tmp_path) if entry.kind == "record")
    assert [struct.pack("<d", v) for v in found] == [struct.pack("<d", v) for v in values]
    assert all(type(v) is float for v in found)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, [1, {"x": math.nan}]])
def test_numbers_that_are_not_finite_are_refused_and_leave_no_trace(tmp_path: Path, bad: object) -> None:
    with Journal.open(tmp_path, {}) as journal:
        before = journal.sequence
        for write in (
            lambda: journal.record("record", bad),
            lambda: journal.note("n", bad),
            lambda: journal.checkpoint(bad),
        ):
            with pytest.raises(ValueError):
                write()
        assert journal.record("record", 1) == before + 1
    assert said(read_entries(tmp_path))[1:] == [(before + 1, "record", 1)]


def nested(depth: int) -> object:
    return [nested(depth - 1)] if depth else 1


@pytest.mark.parametrize("bad", [{1: 2}, {None: 1}, nested(200)])
def test_what_json_would_change_or_not_read_is_refused(tmp_path: Path, bad: object) -> None:
    circle: list = []
    circle.append(circle)
    with Journal.open(tmp_path, {}) as journal:
        for content in (bad, circle):
            with pytest.raises(ValueError):
                journal.record("record", content)
        with pytest.raises(TypeError):
            journal.record("record", b"bytes")
        for kind in ("header", "checkpoint", ""):
            with pytest.raises(ValueError):
                journal.record(kind, 1)


def test_reopening_goes_on_from_the_newest_checkpoint(tmp_path: Path) -> None:
    written = filled(tmp_path, 30)
    last = max(i for i, (_, kind, _) in enumerate(written) if kind == "checkpoint")
    with Journal.open(tmp_path, HEADER, limits=SMALL) as journal:
        assert (journal.recovered.checkpoint_sequence, journal.recovered.checkpoint) == (
            written[last][0],
            written[last][2],
        )
        assert said(journal.recovered.entries) == written[last + 1 :]
        assert journal.record("record", "more") == written[-1][0] + 1
    found = said(read_entries(tmp_path))
    assert found[-1] == (written[-1][0] + 1, "record", "more")
    assert [entry for entry in found if entry in written] == found[:-1] == written[-len(found) + 1 :]


def test_a_segment_rotates_when_it_is_full_and_the_oldest_go(tmp_path: Path) -> None:
    sizes, largest = [], 0
    with Journal.open(tmp_path, HEADER, limits=SMALL) as journal:
        for number in range(400):
            journal.record("record", {"x": number})
            if journal.wants_checkpoint:
                journal.checkpoint({"n": number})
                sizes.append(sum(path.stat().st_size for path in tmp_path.glob("journal-*.log")))
            largest = max(largest, *(path.stat().st_size for path in tmp_path.glob("journal-*.log")))
    assert largest < SMALL.segment_bytes + 400
    assert max(sizes) <= SMALL.total_bytes and len(sizes) > 20
    found = verify(tmp_path)
    assert found.segments >= 3 and found.last_sequence == journal_end(tmp_path) and found.first_sequence > 100
    assert sorted(path.name for path in tmp_path.iterdir() if "journal" not in path.name) == ["lock"]


def journal_end(folder: Path) -> int:
    return max(entry.sequence for entry in read_entries(folder))


def test_a_state_larger_than_all_limits_is_kept(tmp_path: Path) -> None:
    state = ["x" * 100] * 100
    with Journal.open(tmp_path, {}, limits=JournalLimits(1000, 2000)) as journal:
        for _ in range(4):
            journal.checkpoint(state)
            assert not journal.wants_checkpoint
            journal.record("record", 1)
    assert [path.name for path in tmp_path.glob("journal-*")] == ["journal-00000005.log"]
    with Journal.open(tmp_path, {}) as journal:
        assert journal.recovered.checkpoint == state and len(journal.recovered.entries) == 1


def test_every_sequence_number_is_reached_from_the_checkpoint_before_it(tmp_path: Path) -> None:
    written = {sequence: (kind, content) for sequence, kind, content in filled(tmp_path, 30)}
    kept = [entry.sequence for entry in read_entries(tmp_path)]
    for sequence in kept:
        checkpoint, entries = read_until(tmp_path, sequence)
        chain = [checkpoint, *entries]
        assert chain[-1].sequence == sequence and [e.kind for e in chain].count("checkpoint") == 1
        assert [e.sequence for e in chain] == list(range(checkpoint.sequence, sequence + 1))
        assert all(written[e.sequence] == (e.kind, e.content) for e in chain)
    for sequence in (0, kept[0] - 1, kept[-1] + 1):
        with pytest.raises(
            InputError, match=f"found no entry {sequence}; the journal goes from {kept[0]} to {kept[-1]}"
        ):
            read_until(tmp_path, sequence)


def test_an_entry_says_where_it_stands_and_standard_tools_read_it(tmp_path: Path) -> None:
    filled(tmp_path, 20)
    for entry in read_entries(tmp_path):
        line = (tmp_path / f"journal-{entry.segment:08d}.log").read_bytes()[entry.offset :].split(b"\n")[0]
        assert int(line[:16], 16) == entry.sequence
        assert json.loads(line[35:])["content"] == entry.content


def test_a_second_writer_is_told_who_the_first_is(tmp_path: Path) -> None:
    with Journal.open(tmp_path, {}) as journal:
        journal.record("record", 1)
        with pytest.raises(InputError, match=f"process {os.getpid()} writes this journal already") as refused:
            Journal.open(tmp_path, {})
        assert refused.value.exit_code == 2
        assert journal_end(tmp_path) == journal.sequence, "reading needs no lock"
        assert journal.record("record", 2) == journal.sequence
    Journal.open(tmp_path, {}).close()


def test_a_closed_journal_takes_nothing(tmp_path: Path) -> None:
    journal = Journal.open(tmp_path, {})
    journal.close()
    journal.close()
    with pytest.raises(ValueError, match="closed"):
        journal.record("record", 1)


def test_places_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "taken" / "journal-00000001.log").mkdir(parents=True)
    for place in (tmp_path / "file", tmp_path / "file" / "journal", tmp_path / "taken"):
        with pytest.raises(InputError) as refused:
            Journal.open(place, {})
        assert refused.value.exit_code == 2 and refused.value.hint
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_refused(tmp_path: Path) -> None:
    filled(tmp_path, 5)
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(InputError, match="cannot be written"):
            Journal.open(tmp_path, {})
        assert verify(tmp_path).entries == 10
    finally:
        tmp_path.chmod(0o700)


def test_an_empty_folder_is_no_journal_and_becomes_one(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "none"):
        with pytest.raises(DataError, match="there is no journal here"):
            verify(place)
    assert read_newest(tmp_path).segment is None
    Journal.open(tmp_path, {}).close()
    assert verify(tmp_path).entries == 0


def test_files_of_others_are_left_alone(tmp_path: Path) -> None:
    names = ["notes.txt", "journal-1.log", "journal-00000001.log.gz", "journal-abcdefgh.log", "xjournal-00000009.log"]
    for name in [*names, "journal-٠٠٠٠٠٠٠٩.log"]:
        (tmp_path / name).write_text("not ours")
    filled(tmp_path, 40)
    assert verify(tmp_path).segments > 2
    assert all((tmp_path / name).read_text() == "not ours" for name in names)


def test_a_reader_changes_nothing(tmp_path: Path) -> None:
    filled(tmp_path, 20)
    newest = max(tmp_path.glob("journal-*"))
    newest.write_bytes(newest.read_bytes()[:-5])
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in tmp_path.iterdir()}
    cut = verify(tmp_path).cut
    assert cut is not None and cut.kept is None and "may have been" in cut.sentence
    assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in tmp_path.iterdir()} == before


def test_a_journal_is_read_while_it_is_written(tmp_path: Path) -> None:
    with Journal.open(tmp_path, {}, limits=SMALL) as journal:
        for number in range(60):
            reading = read_segments(tmp_path)
            first = next(reading)
            sequence = journal.record("record", number)
            if journal.wants_checkpoint:
                sequence = journal.checkpoint(number)
            later = [first.link.sequence, *(segment.link.sequence for segment in reading)]
            assert later[-1] in (sequence - 2, sequence - 1, sequence) or later[-1] >= sequence - 3
            assert verify(tmp_path).last_sequence == sequence


def test_a_segment_that_is_gone_is_damage(tmp_path: Path) -> None:
    filled(tmp_path, 40)
    paths = sorted(tmp_path.glob("journal-*.log"))
    paths[1].unlink()
    with pytest.raises(DataError, match="the file is missing") as damage:
        verify(tmp_path)
    assert damage.value.good_entries > 0
    Journal.open(tmp_path, {}).close()  # what it needs is there


def test_another_format_is_refused(tmp_path: Path) -> None:
    from armcal.io.journal.frames import encode_frame, payload_of

    header = {"kind": "header", "format": 2, "segment": 1, "previous": "00000000", "content": {}}
    (tmp_path / "journal-00000001.log").write_bytes(encode_frame(1, payload_of(header), 0)[0])
    with pytest.raises(DataError, match="found journal format 2, expected 1"):
        Journal.open(tmp_path, {})


def test_a_journal_that_another_appends_to_stops(tmp_path: Path) -> None:
    with Journal.open(tmp_path, {}) as journal:
        journal.record("record", 1)
        with (tmp_path / "journal-00000001.log").open("ab") as file:
            file.write(b"me too\n")
        with pytest.raises(Exception, match="changed by another"):
            journal.record("record", 2)
    with pytest.raises(DataError, match="damaged at byte"):
        Journal.open(tmp_path, {})


def test_a_journal_whose_folder_is_removed_stops(tmp_path: Path) -> None:
    with Journal.open(tmp_path / "j", {}) as journal:
        journal.record("record", 1)
        (tmp_path / "j" / "journal-00000001.log").unlink()
        with pytest.raises(Exception, match="takes no more entries"):
            journal.record("record", 2)


@pytest.mark.slow
def test_short_writes_are_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: real(descriptor, bytes(data[:7])))
    written = filled(tmp_path, 10)
    assert said(read_entries(tmp_path))[-5:] == written[-5:]


def test_a_file_is_put_in_place_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files, path = FileLayer(), tmp_path / "calibration.yaml"
    write_whole(files, path, b"first")
    (tmp_path / "calibration.yaml.new").write_bytes(b"left by a kill")
    write_whole(files, path, b"2nd")
    assert path.read_bytes() == b"2nd"

    def full(descriptor: int, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match="No space"):
        write_whole(files, path, b"third")
    assert path.read_bytes() == b"2nd" and [p.name for p in tmp_path.iterdir()] == ["calibration.yaml"]


@pytest.mark.slow
def test_memory_stays_flat(tmp_path: Path) -> None:
    """What a journal holds on to does not grow with what went through it."""
    import tracemalloc

    def go_on(journal: Journal, count: int) -> None:
        for number in range(count):
            journal.note("record", {"x": [number / 3] * 20})
            if journal.wants_checkpoint:
                journal.checkpoint([0.5] * 100)

    with Journal.open(tmp_path, {}, limits=JournalLimits(20_000, 100_000)) as journal:
        go_on(journal, 1000)
        tracemalloc.start()
        go_on(journal, 100)
        before = tracemalloc.get_traced_memory()[0]
        go_on(journal, 2000)
        grown = tracemalloc.get_traced_memory()[0] - before
        tracemalloc.stop()
    assert grown < 10_000


@pytest.mark.parametrize("lives", [range(100), *shares(100, 2000, 3)])
def test_kills_at_random_moments_lose_nothing_acknowledged(tmp_path: Path, lives: range) -> None:
    """A killed process leaves its writes in the cache of the system; power loss is in test_journal_faults.py."""
    kills, seed = str(len(lives)), str(lives.start)
    done = subprocess.run(
        [sys.executable, str(KILLER), str(tmp_path), kills, seed], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[0]) > len(lives)
