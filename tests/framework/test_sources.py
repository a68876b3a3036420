"""Sources of records: they read what the csv reader reads, survive any input, and are gone on with where they were."""

from __future__ import annotations

import json
import math
import os
import random
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import pytest
from armcal.base.dataset import Dataset
from armcal.errors import DataError, InputError
from armcal.io.lines import LineCutter
from armcal_online.loop import MAX_FILES, Progress
from armcal_online.sources import Incoming, Lines, RowParser, Source, open_source
from armcal_tracker.csv_reader import CsvReader, CsvSettings
from fake_recalibrator import HEADER, request, row

BLANK = Incoming(arrived=0.0, source_row=1)


def rows(**columns: str) -> RowParser:
    return RowParser(request(), columns)


def everything(source: Source, patience_s: float = 0.3) -> list[Incoming]:
    found: list[Incoming] = []
    while not source.ended:
        incoming = source.incoming(patience_s)
        if incoming is None:
            break
        found.append(incoming)
    return found


def ids(found: list[Incoming]) -> list[str]:
    return [incoming.record_id for incoming in found]


def table(count: int, first: int = 1) -> str:
    return "\n".join([HEADER, *(row(i) for i in range(first, first + count))]) + "\n"


def test_a_csv_file_gives_what_the_csv_reader_gives(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    header = f"{HEADER},approach1,payload_g,note"
    path.write_text("\n".join([header, *(f'{row(i)},{i % 3 - 1},{i}.5,"a, ""b"" {i}"' for i in range(1, 40))]))
    dataset: Dataset = CsvReader(CsvSettings(path=path)).read(request())
    found = everything(Lines(rows(), path))
    assert ids(found) == list(dataset.ids) and [r.source_row for r in found] == list(dataset.rows)
    for name, values in dataset.channels.items():
        assert [r.channels[name] for r in found] == values.tolist(), name
    assert [r.labels["note"] for r in found] == list(dataset.extra["note"])


def test_an_object_gives_what_a_row_gives() -> None:
    content = {
        "id": "p7",
        "q1_deg": 10,
        "q2_rad": -0.5,
        "x_mm": 3,
        "y_m": 0.25,
        "z_mm": 1.5,
        "socket": "B",
        "time_s": 1,
    }
    found = rows().object(content, BLANK)
    assert found.record_id == "p7" and found.labels == {"socket": "B"} and not found.fault
    expected = {"arm.q1": math.radians(10), "arm.q2": -0.5, "time": 1.0}
    assert found.channels == {**expected, "tracker.x": 0.003, "tracker.y": 0.25, "tracker.z": 0.0015}
    named = RowParser(request(), {"q1_deg": "J1", "pose_id": "nr"})
    renamed = {("J1" if k == "q1_deg" else "nr" if k == "id" else k): v for k, v in content.items()}
    assert named.object(renamed, BLANK) == found


def test_a_record_is_the_same_after_it_was_written_as_json() -> None:
    channels = {"a": 0.1, "b": 1e-320, "c": -0.0, "d": math.inf, "e": -math.inf, "f": 1 / 3}
    first = Incoming("p1", channels, {"socket": "\u00e9"}, 1.7e9 + 0.1, "f.csv", 7)
    again = Incoming.from_dict(json.loads(json.dumps(first.as_dict(), allow_nan=False)))
    assert again == first and math.copysign(1, again.channels["c"]) == -1
    assert math.isnan(Incoming.from_dict(Incoming("p", {"a": math.nan}, {}, 0.0).as_dict()).channels["a"])


WHOLE = {"id": "p", "q1_deg": 1, "q2_deg": 2, "x_mm": 3, "y_mm": 4, "z_mm": 5}
FAULTY_OBJECTS = {
    "[1, 2]": "expected a JSON object",
    "{": "not JSON",
    "[" * 100_000: "not JSON",
    json.dumps({**WHOLE, "x_mm": "abc"}): "x_mm: found 'abc', expected a number",
    json.dumps({**WHOLE, "x_mm": True}): "x_mm: found true",
    json.dumps({**WHOLE, "x_mm": [1]}): "x_mm: found [1]",
    json.dumps({**WHOLE, "x_mm": 10**400}): "too large",
    json.dumps(WHOLE).replace("5}", "9" * 5000 + "}"): "not JSON",
    json.dumps({**WHOLE, "approach1": 2}): "approach 2, expected -1, 0 or 1",
    json.dumps({k: v for k, v in WHOLE.items() if k != "x_mm"}): "no column for tracker.x",
    json.dumps({**WHOLE, "q1_rad": 1}): "both",
    json.dumps({("x" if k == "x_mm" else k): v for k, v in WHOLE.items()}): "x has no unit",
    json.dumps({**WHOLE, "id": " "}): "id is empty",
    json.dumps({**WHOLE, "": 1}): "no name",
    "{}": "",
}


@pytest.mark.parametrize("text", FAULTY_OBJECTS, ids=range(len(FAULTY_OBJECTS)))
def test_what_cannot_be_read_is_a_fault_that_says_why(text: str) -> None:
    found = rows().json_text(text, BLANK)
    assert found.fault and FAULTY_OBJECTS[text] in found.fault and not found.channels and len(found.fault) <= 500
    json.dumps(found.as_dict(), allow_nan=False).encode()


def test_missing_and_infinite_values_are_kept_as_they_are() -> None:
    found = rows().json_text(json.dumps({**WHOLE, "x_mm": None, "y_mm": "nan", "z_mm": math.inf}), BLANK)
    assert math.isnan(found.channels["tracker.x"]) and math.isnan(found.channels["tracker.y"])
    assert found.channels["tracker.z"] == math.inf and not found.fault


def test_half_a_surrogate_can_be_written() -> None:
    found = rows().json_text(
        '{"id": "\\ud800", "q1_deg": 1, "q2_deg": 2, "x_mm": 3, "y_mm": 4, "z_mm": 5, "\\udfff": "\\ud801"}', BLANK
    )
    json.dumps(found.as_dict(), ensure_ascii=False).encode("utf-8")


def test_lines_are_cut_however_they_come() -> None:
    random_ = random.Random(3)
    text = b"".join(random_.choice([b"\n", b"\r\n", b"abc", b"\0", b"\xff", b"x" * 50]) for _ in range(2000))
    whole = [line.removesuffix(b"\r") if len(line) <= 120 else None for line in text.split(b"\n")]
    for size in (1, 7, 1000):
        cutter = LineCutter(120)
        found = [line for i in range(0, len(text), size) for line in cutter.feed(text[i : i + size])]
        assert [*found, cutter.rest()] == whole


HOSTILE = [
    b"a" * 10_000_000,
    b"\0" * 50,
    b"\xff\xfe,1",
    HEADER.encode(),
    b"1,2",
    b'p1,"1',
    b"p1,1,2,3,4,abc",
    b"\xef\xbb\xbf",
]


def test_a_file_with_anything_in_it_gives_its_good_rows_and_a_fault_for_each_bad_one(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_bytes(b"\n".join([HEADER.encode(), row(1).encode(), *HOSTILE, row(2).encode(), b""]))
    found = everything(Lines(rows(), path))
    assert [r.record_id for r in found if not r.fault] == ["p1", "p2"]
    assert [r.source_row for r in found if r.fault] == [3, 4, 5, 2, 3, 4], "the header begins another text"
    assert found[-1].source_row == 6


@pytest.mark.slow
def test_bytes_at_random_never_raise(tmp_path: Path) -> None:
    random_ = random.Random(20)
    base = table(10).encode() + b"\n".join(json.dumps(WHOLE).encode() for _ in range(5))
    for trial in range(300):
        data = bytearray(base)
        for _ in range(random_.randint(1, 6)):
            at = random_.randrange(len(data))
            data[at : at + random_.randint(0, 3)] = bytes(random_.randrange(256) for _ in range(random_.randint(0, 4)))
        path = tmp_path / f"{trial}.txt"
        path.write_bytes(data)
        with path.open("rb") as file:
            for found in everything(Lines(rows(), file.fileno())):
                json.dumps(found.as_dict(), allow_nan=False).encode()


def read(path: Path, positions: dict[str, int]) -> list[Incoming]:
    source = Lines(rows(), path)
    source.resume(positions)
    return everything(source)


def test_a_text_is_known_by_its_first_record_whatever_it_comes_through(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(table(5))
    first = read(path, {})
    assert ids(first) == ["p1", "p2", "p3", "p4", "p5"] and len({r.source_key for r in first}) == 1
    positions = {first[0].source_key: 4}
    path.rename(tmp_path / "other.csv")
    assert ids(read(tmp_path / "other.csv", positions)) == ["p4", "p5"]
    assert ids(piped(table(5).encode(), positions=positions)) == ["p4", "p5"]
    path.write_text(table(3, first=10))
    assert ids(read(path, positions)) == ["p10", "p11", "p12"]


def test_the_header_once_more_begins_another_text(tmp_path: Path) -> None:
    """As ``tail -F`` goes on where a log was rotated: after a restart the newer file comes alone."""
    both = piped((table(5) + table(3, first=10)).encode())
    assert ids(both) == ["p1", "p2", "p3", "p4", "p5", "p10", "p11", "p12"]
    assert [r.source_row for r in both] == [2, 3, 4, 5, 6, 2, 3, 4] and len({r.source_key for r in both}) == 2
    (tmp_path / "poses.csv").write_text(table(4, first=10))
    progress = Progress()
    for sequence, incoming in enumerate(both):
        progress.take(incoming, sequence)
    assert ids(read(tmp_path / "poses.csv", progress.positions)) == ["p13"]


@pytest.mark.parametrize("taken", [0, 1, 4, 9])
def test_a_file_is_gone_on_with_after_the_last_row_that_was_taken(tmp_path: Path, taken: int) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(table(4) + "\nbad\n" + "\n".join(row(i) for i in range(5, 9)))
    progress, first = Progress(), Lines(rows(), path)
    found = [first.incoming(0.1) for _ in range(taken)]
    for sequence, incoming in enumerate(found):
        assert incoming is not None
        progress.take(incoming, sequence)
    second = Lines(rows(), path)
    second.resume(Progress(**json.loads(json.dumps(asdict(progress)))).positions)
    both = [*(r for r in found if r is not None), *everything(second)]
    assert [r.record_id for r in both if not r.fault] == [f"p{i}" for i in range(1, 9)] and len(both) == 9


def test_a_file_that_cannot_be_used_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    for content, expected in {"": "it is empty", "a,b\n1,2\n": "no column for", "1,2\n": "expected a header"}.items():
        path.write_text(content)
        with pytest.raises(DataError, match=expected):
            Lines(rows(), path)
    with pytest.raises(InputError, match="no such file"):
        open_source(str(tmp_path / "gone.csv"), rows())
    with pytest.raises(InputError, match=r"Give socket \(.*\), - \(standard input\), or a CSV file"):
        open_source("udp:5005", rows())
    with pytest.raises(InputError, match="it is a directory"):
        open_source(str(tmp_path), rows())


def test_what_is_remembered_of_files_does_not_grow() -> None:
    progress = Progress()
    for i in range(3 * MAX_FILES):
        progress.take(Incoming("p", {}, {}, 0.0, f"{i:06d}.csv", 5), i)
    assert len(progress.positions) == MAX_FILES and max(progress.positions) == f"{3 * MAX_FILES - 1:06d}.csv"


def piped(*pieces: bytes, positions: Mapping[str, int] | None = None) -> list[Incoming]:
    reading, writing = os.pipe()

    def write() -> None:
        for piece in pieces:
            os.write(writing, piece)
            time.sleep(0.01)
        os.close(writing)

    thread = threading.Thread(target=write)
    thread.start()
    source = Lines(rows(), reading)
    source.resume(positions or {})
    found = everything(source, 2.0)
    thread.join()
    os.close(reading)
    assert source.ended
    return found


def test_a_pipe_of_json_lines_or_of_csv() -> None:
    line = json.dumps(WHOLE).encode()
    assert ids(piped(line[:9], line[9:] + b"\r\n\n" + line, b"\n")) == ["p", "p"]
    text = table(3).encode()
    assert ids(piped(text[:20], text[20:90], text[90:])) == ["p1", "p2", "p3"]
    found = piped(b"hello\n", text, line + b"\n", row(4).encode())
    assert [bool(r.fault) for r in found] == [True, False, False, False, False, True]
    assert "may have been cut short" in found[-1].fault


def test_json_of_any_depth_is_a_fault_and_no_exception() -> None:
    """At some depth it can just be read, and not be written again."""
    for depth in (*range(800, 1020), 100_000):
        assert rows().json_text("[" * depth + "]" * depth, BLANK).fault


@pytest.mark.slow
def test_memory_stays_flat_over_a_long_line_and_many_records(tmp_path: Path) -> None:
    import tracemalloc

    path = tmp_path / "poses.csv"
    with path.open("w") as file:
        file.write(f"{HEADER}\n{'x' * 30_000_000}\n")
        file.writelines(f"{row(i)}\n" for i in range(5000))
    tracemalloc.start()
    source, count = Lines(rows(), path), 0
    while source.incoming(0.0) is not None:
        count += 1
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 5001 and peak < 12_000_000
