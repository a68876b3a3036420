"""What the journal leaves when the power fails, the disk is full or fails, and bytes change: never a wrong entry."""

from __future__ import annotations

import errno
import random
from pathlib import Path

import pytest
from armcal.errors import ArmcalError
from armcal.io.journal.journal import Journal, JournalFailedError, JournalFullError, JournalLimits
from armcal.io.journal.reader import read_entries, verify
from armcal.io.journal.segment import JournalDamagedError
from armcal.io.journal.writer import CUTS_KEPT
from file_layers import FOLDER, MemoryFiles, PowerLossError, no_lock
from soak import shares

LIMITS = JournalLimits(segment_bytes=3000, total_bytes=12_000)
FULL = (errno.ENOSPC, errno.EDQUOT)


def opened(files: MemoryFiles, limits: JournalLimits = LIMITS) -> Journal:
    return Journal.open(FOLDER, {"writer": 1}, files=files, limits=limits, lock=no_lock)


def entries_of(files: MemoryFiles) -> dict[int, tuple[str, object]]:
    return {entry.sequence: (entry.kind, entry.content) for entry in read_entries(FOLDER, files)}


class ReplayVerifier:
    """What was written under which number, and up to where it was acknowledged."""

    def __init__(self) -> None:
        self.written: dict[int, list[tuple[str, object]]] = {}
        self.acknowledged = 0

    def write(self, journal: Journal, kind: str, content: object) -> None:
        """One entry. What is under way when the power fails may be found, or not."""
        number = journal.sequence + (2 if kind == "checkpoint" else 1)
        self.written.setdefault(number, []).append((kind, content))
        if kind == "checkpoint":
            assert journal.checkpoint(content) == number
        elif kind == "note":
            assert journal.note("note", content) == number
            return
        else:
            assert journal.record(kind, content) == number
        self.acknowledged = number

    def fault(self, files: MemoryFiles) -> str:
        """What is wrong with what a disk holds; nothing if all acknowledged is there and nothing else."""
        try:
            found = entries_of(files)
        except ArmcalError as damage:
            return "" if not self.acknowledged and "no journal" in str(damage) else f"refused: {damage}"
        wrong = [n for n, entry in found.items() if n != 2 and entry not in self.written.get(n, [])]
        last = max(found)
        return f"wrong: {wrong}" if wrong else "lost" if last < self.acknowledged else ""


def work(journal: Journal, witness: ReplayVerifier, rng: random.Random, count: int) -> None:
    """Records, notes and checkpoints of sizes below and above a sector."""
    for _ in range(count):
        content = {"x": [rng.random() for _ in range(rng.choice((1, 1, 4, 30, 70)))]}
        kind = rng.choice(("record", "record", "note", "note", "note", "checkpoint"))
        if kind != "checkpoint" or journal.wants_checkpoint or rng.random() < 0.2:
            witness.write(journal, kind, content)


def lives(seed: int, **layer: bool) -> str:
    """Four power losses of one journal, each at any call; what was wrong after one."""
    rng = random.Random(seed)
    held: dict[Path, bytes] = {}
    witness = ReplayVerifier()
    for _ in range(4):
        files = MemoryFiles(held, dies_after=rng.choice((3, 10, 40, 80)) + rng.randrange(12), rng=rng, **layer)
        try:
            journal = opened(files)
            work(journal, witness, rng, 200)
        except PowerLossError:
            pass
        held = files.lose_power(rng)
        fault = witness.fault(MemoryFiles(held)) or _reopen(held, witness)
        if fault:
            return fault
    return ""


def _reopen(held: dict[Path, bytes], witness: ReplayVerifier) -> str:
    """Going on gives the same as reading without writing, and all is whole then."""
    seen = MemoryFiles(held)
    before = entries_of(seen) if witness.acknowledged else {}
    files = MemoryFiles(held)
    try:
        with opened(files) as journal:
            recovered = [(e.kind, e.content) for e in journal.recovered.entries]
            state = (journal.recovered.checkpoint_sequence, journal.recovered.checkpoint)
    except ArmcalError as refused:
        return f"refused: {refused}"
    after = entries_of(files)
    if before and (after != before or [*before.values()][len(before) - len(recovered) :] != recovered):
        return "reopening changed what is there"
    if after.get(state[0]) != ("checkpoint", state[1]):
        return "another state"
    return "torn after reopening" if verify(FOLDER, files).cut else ""


@pytest.mark.parametrize("seeds", shares(0, 3000, 6))
def test_power_losses_lose_nothing_acknowledged(seeds: range) -> None:
    faults = {seed: fault for seed in seeds if (fault := lives(seed))}
    assert faults == {}


@pytest.mark.parametrize("kind", ["file_sync", "folder_sync"])
def test_a_missing_sync_would_be_seen(kind: str) -> None:
    """The same trial must fail where the disk is not asked to keep what it was given."""
    faults = [lives(seed, **{kind: False}) for seed in range(40)]
    assert sum(fault != "" for fault in faults) > 10
    assert "lost" in faults or any("no journal" in fault for fault in faults)


@pytest.mark.slow
def test_a_power_loss_at_every_call() -> None:
    """The same work, stopped at each call in turn."""
    calls = 0
    for dies_after in range(10_000):
        rng = random.Random(3)
        files, witness = MemoryFiles(dies_after=dies_after, rng=random.Random(dies_after)), ReplayVerifier()
        try:
            with opened(files) as journal:
                work(journal, witness, rng, 40)
            break
        except PowerLossError:
            calls += 1
        for seed in range(5):
            held = files.lose_power(random.Random(seed))
            assert (witness.fault(MemoryFiles(held)) or _reopen(held, witness)) == "", (dies_after, seed)
    assert calls > 60


def small_journal() -> tuple[dict[Path, bytes], list[dict]]:
    """Two segments, records and notes; entries after each frame of the last segment."""
    files, witness = MemoryFiles(), ReplayVerifier()
    with opened(files) as journal:
        for kind, size in [("record", 1), ("note", 2), ("checkpoint", 1), ("record", 1), ("note", 30), ("record", 2)]:
            witness.write(journal, kind, {"x": [0.1] * size, "@ `": "p@`0 "})
    return {path: file.now for path, file in files.now.items() if "journal-" in path.name}, [witness.written]


def test_truncation_at_every_byte_is_told() -> None:
    held, _ = small_journal()
    whole = entries_of(MemoryFiles(held))
    newest = max(held)
    for path in held:
        for size in range(len(held[path])):
            cut = {**held, path: held[path][:size]}
            if path != newest:
                with pytest.raises(JournalDamagedError):
                    verify(FOLDER, MemoryFiles(cut))
                continue
            found = entries_of(MemoryFiles(cut))
            assert list(found.items()) == list(whole.items())[: len(found)]
            told = verify(FOLDER, MemoryFiles(cut)).cut
            assert (told is None) == (size > 0 and cut[path].endswith(b"\n") and cut[path].count(b"\n") > 1), size
            assert told is None or "may have been" in told.sentence


@pytest.mark.slow
def test_a_flip_of_every_bit_is_told() -> None:
    """All entries, or damage, or a told cut of at most the last entry: never another entry in silence."""
    held, _ = small_journal()
    whole = list(entries_of(MemoryFiles(held)).items())
    newest, cuts = max(held), 0
    for path, data in held.items():
        for place in range(8 * len(data)):
            changed = bytearray(data)
            changed[place // 8] ^= 1 << place % 8
            files = MemoryFiles({**held, path: bytes(changed)})
            try:
                told = verify(FOLDER, files).cut
            except ArmcalError as fault:
                assert str(path) in str(fault) or str(newest) in str(fault)
                continue
            found = list(entries_of(files).items())
            assert path == newest and told is not None and found == whole[:-1], place
            cuts += 1
    assert cuts < 8


def test_frames_lost_repeated_or_swapped_are_damage() -> None:
    held, _ = small_journal()
    path = max(held)
    lines = held[path].splitlines(keepends=True)
    for i in range(len(lines) - 1):
        for changed in (
            lines[:i] + lines[i + 1 :],
            lines[: i + 1] + lines[i:],
            [*lines[:i], lines[i + 1], lines[i], *lines[i + 2 :]],
        ):
            with pytest.raises(JournalDamagedError, match=r"repeated or out of order|as the (first|second) entry"):
                verify(FOLDER, MemoryFiles({**held, path: b"".join(changed)}))


def test_segments_of_two_journals_do_not_fit_together() -> None:
    one, other = {}, {}
    for held, content in ((one, 0.1), (other, 0.2)):
        files = MemoryFiles()
        with opened(files) as journal:
            journal.record("record", content)
            journal.checkpoint({})
        held.update({path: file.now for path, file in files.now.items() if "journal-" in path.name})
    with pytest.raises(JournalDamagedError, match="the segment before ends with"):
        verify(FOLDER, MemoryFiles({min(one): one[min(one)], max(other): other[max(other)]}))


def test_a_space_that_lost_its_bit_at_the_border_of_a_sector_is_no_hole() -> None:
    """A blank in a header may become a zero just where a hole would end; the entry was acknowledged."""
    for filling in range(100, 420):
        files = MemoryFiles()
        with opened(files) as journal:
            journal.record("record", "x" * filling)
            journal.record("record", 1)
            journal.note("note", 2)
        data = files.read(FOLDER / "journal-00000001.log")
        if data[511:512] == b" ":
            with pytest.raises(JournalDamagedError):
                entries_of(MemoryFiles({FOLDER / "journal-00000001.log": data[:511] + b"\0" + data[512:]}))
            return
    raise AssertionError("no filling put a blank there")


def test_half_an_entry_that_was_taken_back_does_not_return_after_a_power_loss() -> None:
    """A full disk tore an entry; other notes went in its place; then the power fails."""
    for seed in range(150):
        rng = random.Random(seed)
        files, witness = MemoryFiles(rng=rng), ReplayVerifier()
        journal = opened(files)
        for number in range(12):
            torn = number == 3
            files.fault = lambda call, _, torn=torn: errno.ENOSPC if torn and call == "write" else None
            try:
                witness.write(journal, "note", {"x": [rng.random() for _ in range(80 if torn else rng.randrange(40))]})
            except JournalFullError:
                assert torn
        held = files.lose_power(rng)
        assert (witness.fault(MemoryFiles(held)) or _reopen(held, witness)) == "", seed


def test_damage_says_where_and_what_is_still_good() -> None:
    held, _ = small_journal()
    path = max(held)
    data = held[path]
    at = data.index(b'"record"')
    with pytest.raises(JournalDamagedError) as refused:
        opened(MemoryFiles({**held, path: data.replace(b'"record"', b'"recorf"', 1)}))
    fault, line = refused.value, data[:at].count(b"\n") + 1
    assert fault.offset == data[:at].rindex(b"\n") + 1
    assert fault.where is not None and fault.where.line == line == 3
    assert f"damaged at byte {fault.offset}" in str(fault) and f"up to number {fault.last_good_sequence}" in str(fault)
    assert fault.hint.startswith(
        "Replay the journal up to entry 6, or start a new folder from the last calibration.yaml"
    )
    assert fault.exit_code == 2


def test_a_hole_behind_which_an_acknowledged_entry_stands_is_damage() -> None:
    files, witness = MemoryFiles(), ReplayVerifier()
    with opened(files, JournalLimits(1 << 20)) as journal:
        for _ in range(40):
            witness.write(journal, "record", {"x": [0.1] * 20})
    path = FOLDER / "journal-00000001.log"
    data = files.read(path)
    for sector in range(len(data) // 512 - 1):
        holed = data[: sector * 512] + bytes(512) + data[sector * 512 + 512 :]
        with pytest.raises(JournalDamagedError):
            verify(FOLDER, MemoryFiles({path: holed}))


def test_what_is_cut_off_is_kept_and_told() -> None:
    held, _ = small_journal()
    path = max(held)
    files = MemoryFiles({**held, path: held[path][:-9]})
    with opened(files) as journal:
        cut = journal.recovered.cut
        assert cut is not None and cut.kept is not None and cut.kept.name in cut.sentence
        assert files.read(cut.kept) == held[path].splitlines(keepends=True)[-1][:-9]
        assert journal.record("record", 1) == cut.sequence
    with opened(files) as journal:
        assert journal.recovered.cut is None and journal.recovered.entries[-1].content == 1


def test_cut_ends_do_not_fill_the_disk() -> None:
    files = MemoryFiles()
    for _ in range(30):
        with opened(files) as journal:
            journal.record("record", 1)
        path = max(p for p in files.now if "journal-" in p.name)
        files.now[path].versions.append(files.read(path) + b"half")
    assert len([name for name in files.names(FOLDER) if name.startswith("cut-")]) == CUTS_KEPT


class Failing:
    """A fault at the n-th call of a kind, once or from then on."""

    def __init__(self, number: int, kinds: tuple[str, ...], error: int, lasting: int) -> None:
        self.number, self.kinds, self.error, self.lasting = number, kinds, error, lasting
        self.seen, self.hit = 0, False

    def __call__(self, call: str, _: int) -> int | None:
        if call not in self.kinds:
            return None
        self.seen += 1
        if self.number <= self.seen < self.number + self.lasting:
            self.hit = True
            return self.error
        return None


def under_fault(failing: Failing) -> tuple[MemoryFiles, ReplayVerifier, list[Exception]]:
    """The same work over a disk that fails; what it held, what it acknowledged, what was raised."""
    rng = random.Random(5)
    files, witness, raised = MemoryFiles(rng=random.Random(failing.number)), ReplayVerifier(), []
    files.fault = failing
    try:
        journal = opened(files)
    except ArmcalError as fault:
        return files, witness, [fault]
    for _ in range(30):
        try:
            work(journal, witness, rng, 1)
        except (JournalFullError, JournalFailedError) as fault:
            raised.append(fault)
    journal.close()
    files.fault = lambda call, number: None
    return files, witness, raised


@pytest.mark.quick("kinds0-28-3", "kinds1-122-3", "kinds3-28-3", "kinds4-5-1", "kinds5-5-3")
@pytest.mark.parametrize("lasting", [1, 3, 10_000])
@pytest.mark.parametrize(
    ("kinds", "error"),
    [
        (("write", "open"), errno.ENOSPC),
        (("write",), errno.EDQUOT),
        (("sync", "sync_folder"), errno.ENOSPC),
        (("write", "open", "sync", "sync_folder"), errno.ENOSPC),
        (("sync", "sync_folder"), errno.EIO),
        (("write", "truncate", "rename", "remove"), errno.EIO),
    ],
)
def test_a_fault_at_every_call_loses_nothing_acknowledged(kinds: tuple[str, ...], error: int, lasting: int) -> None:
    count = 0
    for number in range(1, 1000):
        failing = Failing(number, kinds, error, lasting)
        files, witness, raised = under_fault(failing)
        if not failing.hit:
            break
        count += 1
        assert witness.fault(files) == "", number
        held = files.lose_power(random.Random(number))
        assert (witness.fault(MemoryFiles(held)) or _reopen(held, witness)) == "", number
        if error in FULL and kinds in (("write",), ("write", "open")):
            assert all(isinstance(fault, JournalFullError) for fault in raised), "the next entry may find room"
    assert count > 15


def test_a_failed_sync_is_never_asked_for_again() -> None:
    files, witness = MemoryFiles(), ReplayVerifier()
    journal = opened(files)
    witness.write(journal, "record", 1)
    syncs = []
    files.fault = lambda call, number: syncs.append(call) or (errno.EIO if call == "sync" else None)
    with pytest.raises(JournalFailedError, match="could not be made durable"):
        journal.record("record", 2)
    files.fault = lambda call, number: syncs.append(call)
    for write in (journal.record, journal.note):
        with pytest.raises(JournalFailedError, match="takes no more entries") as refused:
            write("record", 3)
        assert "All that was acknowledged before is kept" in str(refused.value)
    with pytest.raises(JournalFailedError):
        journal.checkpoint(4)
    journal.close()
    assert syncs == ["write", "sync", "truncate"]
    with opened(files) as again:
        assert [e.content for e in again.recovered.entries] == [1]
        assert again.record("record", 5) == witness.acknowledged + 1


def test_a_full_disk_refuses_entries_keeps_all_that_were_acknowledged_and_goes_on_when_there_is_room() -> None:
    files, witness = MemoryFiles(capacity=14_000), ReplayVerifier()
    journal = opened(files, JournalLimits(3000, 1 << 30))
    for number in range(1000):
        try:
            witness.write(journal, "checkpoint" if journal.wants_checkpoint else "record", {"n": [number] * 20})
        except JournalFullError as full:
            assert "there is no room for an entry" in str(full) and "what was acknowledged is kept" in str(full)
            break
    before = files.names(FOLDER)
    assert sum("journal-" in name for name in before) > 3
    for kind in ("record", "note", "checkpoint"):
        with pytest.raises(JournalFullError):
            witness.write(journal, kind, {"n": [5] * 60})
    assert files.names(FOLDER) == before and witness.fault(files) == ""
    files.capacity = None
    witness.write(journal, "record", 6)
    witness.write(journal, "checkpoint", 7)
    journal.close()
    assert witness.fault(files) == "" and _reopen({p: f.now for p, f in files.now.items()}, witness) == ""


def test_a_full_disk_does_not_keep_a_journal_from_being_opened() -> None:
    held, _ = small_journal()
    path = max(held)
    torn = {**held, path: held[path][:-9]}
    files = MemoryFiles(torn, capacity=sum(map(len, torn.values())))
    with opened(files) as journal:
        assert journal.recovered.cut is not None and journal.recovered.cut.kept is None
    with pytest.raises(JournalFullError):
        opened(MemoryFiles(capacity=10))


def test_a_read_only_disk_is_refused_and_told() -> None:
    held, _ = small_journal()
    files = MemoryFiles({**held, max(held): held[max(held)][:-9]})
    files.fault = lambda call, number: errno.EROFS
    with pytest.raises(ArmcalError, match="cannot be written") as refused:
        opened(files)
    assert refused.value.exit_code == 2


@pytest.mark.parametrize("moment", range(60))
def test_an_interrupt_leaves_a_whole_journal(moment: int) -> None:
    """A signal's handler may raise anywhere."""
    files, witness, rng = MemoryFiles(rng=random.Random(moment)), ReplayVerifier(), random.Random(9)
    journal = opened(files)

    def interrupt(call: str, number: int) -> None:
        if files.calls == start + moment:
            raise KeyboardInterrupt

    start, files.fault = files.calls + 1, interrupt
    for _ in range(25):
        try:
            work(journal, witness, rng, 1)
        except KeyboardInterrupt:
            pass
        except JournalFailedError as failed:
            assert "interrupted" in str(failed)
    files.fault = lambda call, number: None
    journal.close()
    assert witness.fault(files) == ""
    assert verify(FOLDER, files).cut is None
