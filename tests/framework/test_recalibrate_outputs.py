"""What a recalibration writes for others, on disks that are full and to readers that are gone or asleep."""

from __future__ import annotations

import json
import os
import time
from io import BytesIO
from pathlib import Path

import pytest
from armcal.io.lines import StandardOutput
from armcal_online.loop import Outputs
from recalibrations import FullDisk


def test_on_a_full_disk_the_calibration_stays_whole_and_no_event_is_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, out = FullDisk(monkeypatch), BytesIO()
    outputs = Outputs(tmp_path, StandardOutput(out))
    assert outputs.calibration("one")
    outputs.event({"event": "record"})
    files.full = {"calibration", "status"}
    assert not outputs.calibration("two")
    outputs.status({"a": 1})
    outputs.status({"a": 2})
    assert (tmp_path / "calibration.yaml").read_text() == "one" and not (tmp_path / "status.json").exists()
    files.full = set()
    assert outputs.calibration("three") and (tmp_path / "calibration.yaml").read_text() == "three"
    outputs.status({"a": float("nan")})
    assert json.loads((tmp_path / "status.json").read_text()) == {"a": None}
    told = [json.loads(line).get("sentence", "") for line in out.getvalue().splitlines()]
    assert json.loads((tmp_path / "events.jsonl").read_text().splitlines()[0])["event"] == "record"
    for part in ("calibration.yaml cannot be written", "status.json cannot be written", "status.json is written again"):
        assert any(part in sentence for sentence in told), part
    assert len(told) < 10


def test_events_that_cannot_be_written_to_a_file_still_go_to_standard_output(tmp_path: Path) -> None:
    (tmp_path / "events.jsonl").symlink_to("/dev/full")
    out = BytesIO()
    outputs = Outputs(tmp_path, StandardOutput(out))
    for i in range(5):
        outputs.event({"event": "record", "n": i})
    told = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [e["n"] for e in told if e["event"] == "record"] == [0, 1, 2, 3, 4]
    assert ["events.jsonl cannot be written" in e["sentence"] for e in told if e["event"] == "alarm"] == [True]


def test_the_file_of_events_is_kept_short_and_half_a_line_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armcal_online.loop.EVENT_BYTES", 1000)
    (tmp_path / "events.jsonl").write_text('{"event": "rec')
    outputs = Outputs(tmp_path, StandardOutput(None))
    outputs.event({"event": "record", "n": 0, "text": "100 %s"})
    first = (tmp_path / "events.jsonl").read_text().splitlines()
    assert first[0] == '{"event": "rec' and json.loads(first[1])["text"] == "100 %s"
    for i in range(1, 200):
        outputs.event({"event": "record", "n": i})
    assert (tmp_path / "events.jsonl").stat().st_size <= 1000 >= (tmp_path / "events.jsonl.1").stat().st_size
    lines = [(tmp_path / name).read_text().splitlines() for name in ("events.jsonl.1", "events.jsonl")]
    assert json.loads(lines[1][-1])["n"] == 199 and json.loads(lines[1][0])["n"] == json.loads(lines[0][-1])["n"] + 1


def test_a_reader_that_sleeps_loses_lines_and_is_told_so(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    with os.fdopen(writing, "wb", buffering=0) as stream, os.fdopen(reading, "rb", buffering=0) as reader:
        outputs = Outputs(tmp_path, StandardOutput(stream, patience_s=0.05))
        for i in range(3000):
            outputs.event({"event": "record", "n": i, "text": "x" * 100})
        got = reader.read(10**6)
        outputs.event({"event": "record", "n": 3000})
        time.sleep(0.01)
        got += reader.read(10**6)
    whole = [json.loads(line) for line in got.splitlines() if line.endswith(b"}") and line.startswith(b"{")]
    numbers = [e["n"] for e in whole if e["event"] == "record"]
    assert numbers[-1] == 3000 and numbers[:-1] == [*range(len(numbers) - 1)] and len(numbers) < 2000
    assert "were left out here" in whole[-1]["sentence"]
    assert len((tmp_path / "events.jsonl").read_text().splitlines()) == 3001
