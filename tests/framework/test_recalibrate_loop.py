"""The loop of a recalibration: nothing acknowledged is lost, nothing counts twice, a restart changes no bit."""

from __future__ import annotations

import json
import resource
import sqlite3
import time
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from armcal.errors import InputError
from armcal.io.journal import JOURNAL, Journal, JournalFullError, KeptJournal
from armcal_online.decisions import EVENTS
from armcal_online.loop import Recalibration
from armcal_online.settings import RecalibrateSettings
from armcal_online.sources import Incoming, RowParser, Sent, open_source
from fake_recalibrator import FakeRecalibrator, begun
from recalibrations import (
    Listed,
    PowerCutError,
    events,
    kinds,
    limited,
    made,
    replayed,
    run,
    stepping,
    steps,
    table,
    taken,
)


def test_every_record_is_journalled_used_and_told_of(tmp_path: Path) -> None:
    folder, out = tmp_path / "out", BytesIO()
    fake = run(folder, Listed(made(1, 61)), stream=out)
    assert fake.count == 60 and taken(folder) == [f"p{i}" for i in range(1, 61)]
    told = events(folder)
    assert [json.loads(line) for line in out.getvalue().splitlines()] == told
    assert [e["id"] for e in told if e["event"] == "record"] == taken(folder)
    assert [told[0]["event"], told[-1]["event"]] == ["started", "finished"] and told[0]["resumed"] is False
    assert kinds(folder).count("decision") == 3 and kinds(folder).count("calibration") >= 6
    assert (folder / "calibration.yaml").read_text() == fake.calibration_text()
    status = json.loads((folder / "status.json").read_text())
    assert (status["count"], status["finished"], status["paused"], status["records"]) == (60, True, False, 60)
    assert replayed(folder).digest() == fake.digest()
    assert sorted(p.name for p in folder.iterdir()) == [
        "calibration.reserve",
        "calibration.yaml",
        "events.jsonl",
        "journal.sqlite",
        "status.json",
    ]


@pytest.mark.parametrize("cuts", [[1], [10, 11, 12], [25, 26, 50, 51, 99]])
def test_a_power_cut_changes_no_bit(tmp_path: Path, cuts: list[int]) -> None:
    folder = tmp_path / "out"
    for cut in cuts:
        with pytest.raises(PowerCutError):
            run(folder, Listed(made(1, cut), cut=True))
    fake = run(folder, Listed(made(1, 121)))
    assert taken(folder) == [f"p{i}" for i in range(1, 121)] and fake.count == 120
    assert replayed(folder).digest() == fake.digest()
    assert [e["resumed"] for e in events(folder) if e["event"] == "started"] == [False, *[True] * len(cuts)]
    again = run(folder, Listed(made(1, 121)))
    assert again.digest() == fake.digest()


def test_a_folder_of_another_calibration_or_other_settings_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    run(folder, Listed(made(1, 5)), settings=RecalibrateSettings())
    with pytest.raises(InputError, match="begun with other settings"):
        run(folder, Listed(made(1, 9)), settings=RecalibrateSettings(gating=False))
    (tmp_path / "out.start.yaml").write_text("other: 1\n")
    with pytest.raises(InputError, match="begun with another calibration"):
        run(folder, Listed(made(1, 9)), settings=RecalibrateSettings())
    with Journal(tmp_path / "run", {"plan": "a"}) as journal:
        journal.record("started", {})
    with pytest.raises(InputError, match="begun with another calibration"):
        run(tmp_path / "run", Listed([]))
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match=r"thesis\.tex"):
        run(foreign, Listed([]))
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "calibration.yaml").symlink_to(tmp_path / "own.start.yaml")
    with pytest.raises(InputError, match="would be replaced"):
        run(tmp_path / "own", Listed([]))


def test_a_second_one_in_the_folder_is_refused(tmp_path: Path) -> None:
    with begun(tmp_path / "out", FakeRecalibrator(), Listed([])), pytest.raises(InputError):
        run(tmp_path / "out", Listed([]))


def test_a_record_that_the_recalibrator_refuses_is_passed_over_for_good(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    records = made(1, 9)
    records[4] = Incoming("refused", {}, {}, 0.0, "list", 5)
    fake = run(folder, Listed(records))
    (ignored,) = [e for e in events(folder) if e.get("verdict") == "ignored"]
    assert "it is refused" in ignored["why"] and fake.count == 7 and replayed(folder).digest() == fake.digest()


def test_a_record_that_a_file_has_twice_is_used_once(tmp_path: Path) -> None:
    folder, records = tmp_path / "out", made(1, 9)
    records.insert(5, replace(records[2], source_row=3, arrived=7.0))
    records.insert(7, replace(records[2], channels={"arm.q1": 9.0}))
    fake = run(folder, Listed(records))
    (ignored,) = [e for e in events(folder) if e.get("verdict") == "ignored"]
    assert ignored["id"] == "p3" and "came before" in ignored["why"] and fake.count == 9
    assert len(taken(folder)) == 10 and replayed(folder).digest() == fake.digest()


def sent(number: int, **given: Any) -> dict[str, Any]:
    return {"id": f"p{number}", "q1_deg": number, "q2_deg": 2, "x_mm": 3, "y_mm": 4, "z_mm": 5, **given}


def by_socket() -> Sent:
    return Sent(RowParser(FakeRecalibrator().request, {}))


def test_a_record_that_is_sent_again_counts_once_and_has_the_same_acknowledgement(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with stepping(folder, by_socket()) as (going, _):
        first, second, third, fourth, _ = (going.receive(sent(*n)) for n in ((1,), (2,), (1,), (2,), (7,)))
        other = going.receive(sent(1, q1_deg=9))
        assert taken(folder) == ["p1", "p2", "p7", "p1"] and other["acknowledged"] > second["acknowledged"]
        assert (first, second) == (third, fourth) and first["id"] == "p1" and first["ok"]
    with stepping(folder, by_socket()) as (going, _):
        assert going.receive(sent(2)) == second and going.receive(sent(3))["id"] == "p3"
    assert taken(folder)[4:] == ["p3"]


def test_a_sent_record_that_cannot_be_read_is_kept_with_its_fault_and_no_other_source_takes_any(tmp_path: Path) -> None:
    with stepping(tmp_path / "out", by_socket()) as (going, fake):
        reply = going.answer({"id": "p1", "q1_deg": 1})
        assert reply["ok"] and "missing: q2" in reply["fault"] and fake.count == 0
        assert going.answer({"command": "finish"})["ok"]
        with pytest.raises(InputError, match="about to end"):
            going.answer(sent(2))
    with (
        stepping(tmp_path / "file", Listed(made(1, 9))) as (going, _),
        pytest.raises(InputError, match="--from socket"),
    ):
        going.answer(sent(1))


def test_without_room_a_sent_record_has_no_acknowledgement_and_it_stops(tmp_path: Path) -> None:
    with stepping(tmp_path / "out", by_socket()) as (going, _):
        assert going.receive(sent(1))["ok"]
        with limited(tmp_path / "out"):
            with pytest.raises(JournalFullError):
                going.answer(sent(2))
            with pytest.raises(JournalFullError, match="no room for an entry"):
                going.run()
    assert "no room for an entry" in json.loads((tmp_path / "out" / "status.json").read_text())["fault"]
    assert taken(tmp_path / "out") == ["p1"]


def test_while_paused_files_keep_their_records_and_those_of_streams_are_passed_over(tmp_path: Path) -> None:
    with stepping(tmp_path / "file", Listed(made(1, 9))) as (going, fake):
        steps(going, 3)
        going.answer({"command": "pause"})
        steps(going, 3)
        assert fake.count == 3
        going.answer({"command": "resume"})
        steps(going, 9)
        assert fake.count == 8
    with stepping(tmp_path / "stream", Listed(made(1, 9, key=""), keeps_records=False)) as (going, fake):
        steps(going, 2)
        going.answer({"command": "pause"})
        steps(going, 3)
        going.answer({"command": "resume"})
        steps(going, 3)
        assert fake.count == 5
    assert len(taken(tmp_path / "stream")) == 8
    passed = [e for e in events(tmp_path / "stream") if e.get("verdict") == "ignored"]
    assert len(passed) == 3 and "paused" in passed[0]["why"]
    assert replayed(tmp_path / "stream").digest() == fake.digest()


def test_a_pause_outlasts_a_restart(tmp_path: Path) -> None:
    with stepping(tmp_path / "out", Listed(made(1, 9))) as (going, _):
        steps(going, 3)
        going.answer({"command": "pause"})
    with stepping(tmp_path / "out", Listed(made(1, 9))) as (going, fake):
        assert going.paused
        steps(going, 3)
        assert fake.count == 3


def test_a_rollback_restores_every_bit_and_so_does_its_journal(tmp_path: Path) -> None:
    folder, states = tmp_path / "out", {}
    with stepping(folder, Listed(made(1, 120), cut=True)) as (going, fake):
        for _ in range(90):
            going.step(0.0)
            states[going.sequence] = fake.digest()
        for target in (going.sequence, *list(states)[70:80:3], *list(states)[:30:7]):
            going.roll_back(target)
            assert fake.digest() == states[target]
        before = fake.digest()
        for wrong in (0, 10**6):
            with pytest.raises(InputError, match="found no entry"):
                going.roll_back(wrong)
            assert fake.digest() == before
        going.step(0.0)
        going.roll_back(going.sequence - 5)
        with pytest.raises(PowerCutError):
            steps(going, 100)
    after = run(folder, Listed(made(1, 120)))
    assert after.digest() == fake.digest() == replayed(folder).digest()
    assert len(taken(folder)) == 119


def test_a_rollback_that_no_checkpoint_followed_is_made_again_after_a_restart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Recalibration, "_checkpoint", lambda self: None)
    with stepping(tmp_path / "out", Listed(made(1, 50))) as (going, fake):
        steps(going, 10)
        target = going.sequence
        digest = fake.digest()
        steps(going, 20)
        going.roll_back(target)
        going.roll_back(going.sequence)
    with stepping(tmp_path / "out", Listed(made(1, 50))) as (going, again):
        assert again.digest() == digest
        steps(going, 1)
        assert again.count == 11


def test_a_full_journal_stops_it_says_so_and_keeps_all_that_was_acknowledged(tmp_path: Path) -> None:
    fake, source, out = FakeRecalibrator(), Listed(made(1, 9)), BytesIO()
    with begun(tmp_path / "out", fake, source, out) as going:
        steps(going, 3)
        with limited(tmp_path / "out"):
            with pytest.raises(JournalFullError):
                going.answer({"command": "pause"})
            before = fake.digest()
            with pytest.raises(JournalFullError):
                going.roll_back(going.sequence - 1)
            assert fake.digest() == before
            with pytest.raises(JournalFullError, match="no room for an entry"):
                going.run()
    assert fake.count == 3 and taken(tmp_path / "out") == ["p1", "p2", "p3"]
    status = json.loads((tmp_path / "out" / "status.json").read_text())
    assert status["finished"] and "no room for an entry" in status["fault"] and "Make room" in status["fault"]
    assert json.loads((tmp_path / "out" / "calibration.yaml").read_text())["count"] == 3
    told = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [e["sentence"].startswith("It stopped: ") for e in told if e["event"] == "finished"] == [True]
    fake = run(tmp_path / "out", Listed(made(1, 9)))
    assert taken(tmp_path / "out") == [f"p{i}" for i in range(1, 9)]
    assert replayed(tmp_path / "out").digest() == fake.digest()


def test_a_crash_is_told_to_whoever_watches_and_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with stepping(tmp_path / "out", Listed(made(1, 9))) as (going, fake):
        monkeypatch.setattr(fake, "take", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            going.run()
    assert "division by zero" in json.loads((tmp_path / "out" / "status.json").read_text())["fault"]
    assert "division by zero" in events(tmp_path / "out")[-1]["sentence"]


def test_a_fault_of_an_estimator_is_raised_after_a_restart_too_and_no_fault_of_the_journal(tmp_path: Path) -> None:
    def broken(*_: object) -> None:
        raise TypeError("a fault of a plugin")

    for _ in range(2):
        fake = FakeRecalibrator()
        fake.take = broken  # type: ignore[assignment]
        going = begun(tmp_path / "out", fake, Listed(made(1, 3)))
        with pytest.raises(TypeError, match="a fault of a plugin"), going as recalibration:
            recalibration.run()


def test_a_journal_without_a_checkpoint_is_taken_up_from_its_first_entry(tmp_path: Path) -> None:
    digest = run(tmp_path / "out", Listed(made(1, 6))).digest()
    with sqlite3.connect(tmp_path / "out" / JOURNAL) as database:
        database.execute("delete from checkpoint")
    assert run(tmp_path / "out", Listed([])).digest() == digest


def test_no_event_follows_half_a_line_where_a_disk_was_full_for_a_while(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with stepping(out, Listed(made(1, 9))) as (going, _):
        steps(going, 3)
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        going._outputs.event({"event": "before"})
        resource.setrlimit(resource.RLIMIT_FSIZE, ((out / EVENTS).stat().st_size + 20, before[1]))
        try:
            going._outputs.event({"event": "lost", "sentence": "longer than the room that is left"})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        going._outputs.event({"event": "after"})
    assert [event["event"] for event in events(out)].count("after") == 1


def test_the_pace_of_what_is_written(tmp_path: Path) -> None:
    settings = RecalibrateSettings(output={"calibration_every_records": 1000, "calibration_every_s": 1e9})
    folder = tmp_path / "out"
    run(
        folder,
        Listed(made(1, 20)),
        settings,
        pace={"CALIBRATION_GAP_S": 1.0, "STATUS_S": 1e9, "CHECKPOINT_RECORDS": 10},
    )
    assert kinds(folder).count("calibration") == 2
    with KeptJournal(folder) as journal:
        found = {journal.until(e.sequence)[0].sequence for e in journal.entries()}
    assert len(found) == 3


@pytest.mark.slow
def test_the_real_source_in_the_real_loop(tmp_path: Path) -> None:
    (tmp_path / "in.csv").write_text(table(10))
    fake = FakeRecalibrator()
    records = open_source(str(tmp_path / "in.csv"), RowParser(fake.request, {}))
    with begun(tmp_path / "out", fake, records) as going:
        ends = time.monotonic() + 10
        while len(taken(tmp_path / "out")) < 10 and time.monotonic() < ends:
            going.step(0.1)
    assert taken(tmp_path / "out") == [f"p{i}" for i in range(1, 11)]
