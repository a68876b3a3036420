"""Watching a recalibration: files that rotate and break, who may look, the stream, and a real browser."""

from __future__ import annotations

import http.client
import io
import json
import math
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
import yaml
from armcal.calibration.calibration import Calibration
from armcal.cli.main import cli
from armcal.io.lines import MAX_LINE_BYTES
from armcal_online.event_file import EventFile, EventTail
from armcal_online.watch.estimates import Thinned
from armcal_online.watch.events import LONGEST_TEXT, message_of, number, parsed, record_of, text
from armcal_online.watch.feed import Feed
from armcal_online.watch.history import OLDER_ACCEPTED, OLDER_OTHERS, RECENT_RECORDS, History
from armcal_online.watch.shape import Shape, drawing_of
from armcal_online.watch.terminal import line, picture
from click.testing import CliRunner
from rich.console import Console
from watching import SLIP, append, made_up, made_up_folder, written

ROOT = Path(__file__).resolve().parents[2]
HOSTILE = "</script><script>document.title='taken'</script><img src=x onerror=\"document.title='taken'\">"


@pytest.fixture(scope="module")
def calibration(demo_calibration: Path) -> Path:
    """A real one, of the shipped demonstration."""
    return demo_calibration


# Files


def all_lines(tail: EventTail) -> list[str]:
    found: list[str] = []
    while lines := tail.lines():
        found += [line.decode() for line in lines]
    return found


def test_half_a_line_waits_for_its_end(tmp_path: Path) -> None:
    tail = EventTail(tmp_path)
    assert all_lines(tail) == []
    append(tmp_path / "events.jsonl", '{"event": "rec')
    assert all_lines(tail) == []
    append(tmp_path / "events.jsonl", 'ord"}\n\n{"a"')
    assert all_lines(tail) == ['{"event": "record"}']
    append(tmp_path / "events.jsonl", ": 1}\n")
    assert all_lines(tail) == ['{"a": 1}']


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_lost_or_doubled_over_many_rotations(tmp_path: Path, seed: int) -> None:
    """By the writer itself, read at moments of chance, at least once in each file's time."""
    chance, writer, tail = random.Random(seed), EventFile(tmp_path, max_bytes=1000), EventTail(tmp_path)
    found: list[str] = []
    for n in range(2000):
        writer.write(f"line {n} {'x' * chance.randrange(60)}")
        if n % 7 == 0 or chance.random() < 0.1:
            found += all_lines(tail)
    found += all_lines(tail)
    assert [int(line.split()[1]) for line in found] == list(range(2000))


def test_a_watcher_that_was_away_goes_on_with_what_is_left(tmp_path: Path) -> None:
    writer, tail = EventFile(tmp_path, max_bytes=100), EventTail(tmp_path)
    writer.write("line 0")
    assert all_lines(tail) == ["line 0"]
    for n in range(1, 200):
        writer.write(f"line {n}")
    left = (tmp_path / "events.1.jsonl").read_text() + (tmp_path / "events.jsonl").read_text()
    assert all_lines(tail) == left.splitlines()
    assert all_lines(EventTail(tmp_path)) == left.splitlines()


def test_a_new_file_with_the_inode_number_of_the_read_one_does_not_hide_the_rotated_one(tmp_path: Path) -> None:
    newest, tail = tmp_path / "events.jsonl", EventTail(tmp_path)
    newest.write_text("read\n")
    assert all_lines(tail) == ["read"]
    (tmp_path / "events.1.jsonl").write_text("rotated\n")
    newest.write_text("newest\n")  # in place: the number is the same for certain
    assert all_lines(tail) == ["rotated", "newest"]


def test_a_file_that_was_cut_or_written_anew_is_read_from_its_start(tmp_path: Path) -> None:
    path, tail = tmp_path / "events.jsonl", EventTail(tmp_path)
    path.write_text("one\ntwo\nthr")
    assert all_lines(tail) == ["one", "two"]
    path.write_text("1\n")  # shorter
    assert all_lines(tail) == ["1"]
    with path.open("r+") as file:
        file.write("another and longer\n")  # in place, begins otherwise
    assert all_lines(tail) == ["another and longer"]
    path.unlink()
    assert all_lines(tail) == []
    path.write_text("new\n")
    assert all_lines(tail) == ["new"]


def test_a_newest_file_that_is_replaced_does_not_bring_the_rotated_one_back(tmp_path: Path) -> None:
    (tmp_path / "events.1.jsonl").write_text("old\n")
    (tmp_path / "events.jsonl").write_text("new\n")
    tail = EventTail(tmp_path)
    assert all_lines(tail) == ["old", "new"]
    (tmp_path / "other").write_text("newer\n")
    os.replace(tmp_path / "other", tmp_path / "events.jsonl")
    assert all_lines(tail) == ["newer"]


def test_no_file_is_held_so_that_what_is_dropped_makes_room(tmp_path: Path) -> None:
    made_up_folder(tmp_path, 20)
    feed = Feed(tmp_path)
    assert feed.step()
    held = [str(link.readlink()) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    assert not [path for path in held if str(tmp_path) in path]


def test_a_line_without_end_is_passed_over_and_memory_stays_flat(tmp_path: Path) -> None:
    path, tail = tmp_path / "events.jsonl", EventTail(tmp_path)
    path.write_bytes(b"before\n" + b"x" * (3 * MAX_LINE_BYTES) + b"\nafter\n")
    assert all_lines(tail) == ["before", "after"]
    assert tail.too_long == 1


# What is kept


def test_thinning_keeps_the_newest_whole_and_the_rest_even() -> None:
    kept: Thinned[int] = Thinned(100, 50)
    for n in range(100_000):
        kept.add(n)
        assert len(kept) <= 150
    known = list(kept)
    assert known[-100:] == list(range(99_900, 100_000))
    steps = np.diff(known[:-100])
    assert len(set(steps.tolist())) == 1 and known[0] == 0 and len(steps) >= 24


@pytest.mark.slow
def test_memory_is_flat_however_long_it_goes_on() -> None:
    history = History()
    events = made_up(400)
    sizes = {}
    for n in range(1, 14_001):
        event = events[1 + n % 380]
        history.take({**event, "sequence": n} if event["event"] == "record" else event)
        if n % 2000 == 0:
            sizes[n] = len(json.dumps(history.state()))
    state = history.state()
    assert max(sizes.values()) < 1.25 * max(size for n, size in sizes.items() if n <= 6000)
    assert len(state["records"]) <= RECENT_RECORDS * 1.5 + OLDER_ACCEPTED + OLDER_OTHERS
    whole = [r for r in state["records"] if "why" in r]
    assert len(whole) >= RECENT_RECORDS
    assert [r["sequence"] for r in state["records"]] == sorted(r["sequence"] for r in state["records"])


def test_the_state_says_what_the_events_said(tmp_path: Path) -> None:
    feed = Feed(made_up_folder(tmp_path))
    while feed.step():
        pass
    state = feed.state()
    records = [e for e in made_up() if e["event"] == "record"]
    for verdict in ("accepted", "rejected", "ignored"):
        assert state["counts"][verdict] == sum(r["verdict"] == verdict for r in records)
    assert state["level"] == "nominal" and state["level_sentence"] == "The slip is followed."
    assert state["last"]["id"] == "p300"
    assert state["last"]["nis"] == pytest.approx(records[-1]["nis"], rel=1e-6)
    theta3 = [p["name"] for p in state["estimates"]["parameters"]].index("arm.mdh.theta3")
    last = [e for e in made_up() if e["event"] == "estimate"][-1]["parameters"]["arm.mdh.theta3"]
    start = made_up()[0]["parameters"][theta3]
    row = state["estimates"]["rows"][-1]
    assert row["change"][theta3] == pytest.approx(math.degrees(last[0] - start["value"]), rel=1e-5)
    assert row["sd"][theta3] == pytest.approx(math.degrees(last[1]), rel=1e-3)
    assert {p["unit"] for p in state["estimates"]["parameters"]} == {"deg", "mm", "deg/Nm"}
    assert "joint_slipped" in [e.get("kind") for e in state["events"]]
    assert state["written"]["sequence"] == SLIP + 4


@pytest.mark.parametrize("source", ["calibration", "start"])
def test_what_was_rotated_away_is_known_from_the_status_and_the_calibration_or_a_later_start(
    tmp_path: Path, calibration: Path, source: str
) -> None:
    """A watcher that comes late knows neither the first records nor the event with the units."""
    name = next(entry["name"] for entry in _entries(calibration) if entry["unit"] == "rad")
    events = [
        {"event": "estimate", "sequence": 900 + n, "parameters": {name: [0.1 + 0.01 * n, 0.02]}} for n in range(3)
    ]
    (tmp_path / "events.jsonl").write_text(written(events))
    feed = Feed(tmp_path)
    feed.step()
    before = feed.state()
    row = before["estimates"]["rows"][-1]
    assert row["change"] == [pytest.approx(0.02)] and feed.state()["estimates"]["parameters"][0]["unit"] == ""
    if source == "calibration":
        shutil.copy(calibration, tmp_path / "calibration.yaml")
    else:
        listed = [{"name": name, "unit": "rad", "value": 0.12, "sd": 0.02}]
        start = {"event": "started", "sequence": 903, "resumed": True, "parameters": listed}
        append(tmp_path / "events.jsonl", written([start]))
    counts = {"accepted": 890, "rejected": 9, "ignored": 3}
    (tmp_path / "status.json").write_text(json.dumps({"level": "watch", "why": "Because.", "counts": counts}))
    feed.step()
    assert feed.state(before["place"])["whole"]  # pages begin anew, with the units
    estimates = feed.state()["estimates"]
    assert estimates["parameters"][0]["unit"] == "deg"
    assert estimates["rows"][-1]["change"] == [pytest.approx(math.degrees(0.02), rel=1e-5)]
    assert estimates["rows"][-1]["sd"] == [pytest.approx(math.degrees(0.02), rel=1e-3)]
    assert feed.step() == []
    console = Console(width=100)
    with console.capture() as shown:
        console.print(picture(feed.state()))
    assert "890 accepted" in shown.get()


def _entries(calibration: Path) -> list[dict[str, Any]]:
    listed: list[dict[str, Any]] = yaml.safe_load(calibration.read_text())["parameters"]
    return listed


def test_a_new_start_forgets_and_one_that_goes_on_does_not() -> None:
    history = History()
    for event in made_up(50):
        history.take(event)
    again = {**made_up(1)[0], "resumed": True, "sequence": 51}
    shifted = [{**p, "value": p["value"] + 0.01} for p in again["parameters"]]
    assert "reset" not in [m["event"] for m in history.take({**again, "parameters": shifted})]
    assert history.take(made_up(50)[3]) == []  # a record told a second time
    state = history.state()
    assert sum(state["counts"].values()) == 50
    change = state["estimates"]["rows"][-1]["change"]
    assert change[0] == pytest.approx(math.degrees(0.01), rel=1e-5)  # since the first start
    assert history.take(made_up(1)[0])[0] == {"event": "reset"}
    state = history.state()
    assert sum(state["counts"].values()) == 0 and state["records"] == []


def test_what_is_not_an_event_is_counted_and_never_hurts() -> None:
    chance, history = random.Random(1), History()
    values: list[Any] = [None, True, 3, -1e400, 10**400, 1e400, "x" * 5000, [], [1], [1, 2, "3"], {}, {"a": []}, "nan"]
    keys = sorted({key for event in made_up(200) for key in event})
    for _ in range(5000):
        event = {key: chance.choice(values) for key in chance.sample(keys, 12)}
        event["event"] = chance.choice(["record", "estimate", "started", "level", "decision", "new", 5, None])
        if event["event"] == "record":
            event["verdict"] = chance.choice(["accepted", "rejected", "maybe"])
        messages = history.take(event)
        json.dumps(messages, allow_nan=False)
        assert all(line(m) is None or isinstance(line(m), str) for m in messages)
    for raw in (b"\xff\xfe", b"[1]", b"{", b'{"a": NaN', b"[" * 100_000, b'{"event": "record"', b"\x00" * 10):
        assert parsed(raw) is None
        history.take(parsed(raw))
    assert history.unreadable == 7 and history.unknown > 0
    json.dumps(history.state(), allow_nan=False)
    Console(file=io.StringIO(), width=80).print(picture(_whole_state(history)))


def _whole_state(history: History) -> dict[str, Any]:
    """What a feed adds to a history."""
    first = {"situation": history.situation("x", {}), "over_time": history.over_time(None)}
    return {**history.state(), **first, "folder": "x", "waiting": None, "heard_s": 0.0, "status": {}}


def test_numbers_that_json_cannot_hold_and_texts_that_act_on_terminals_are_made_harmless() -> None:
    assert number(float("nan")) is None and number(10**400) is None and number(True) is None
    assert text("\x1b[2Jred\x07\u202egnp") == "\ufffd[2Jred\ufffd\ufffdgnp"
    assert text("two\nlines") == "two lines"
    assert len(text("x" * 10_000) or "") == LONGEST_TEXT
    told = message_of({"event": "decision", "sentence": "\x1b]0;title\x07"})
    assert told is not None and "\x1b" not in str(line(told))
    record = record_of({"event": "record", "verdict": "accepted", "id": "[bold red]x[/]", "nis": float("inf")})
    assert record is not None and "nis" not in record
    history = History()
    history.take({"event": "record", "verdict": "accepted", "id": "[bold]\x1b[2Jx[/]"})
    console = Console(width=100, force_terminal=True)
    with console.capture() as shown:
        console.print(picture(_whole_state(history)))
    assert "[bold]" in shown.get() and "\x1b[2J" not in shown.get()


# The arm


def test_the_drawn_arm_ends_where_the_calibration_says(calibration: Path) -> None:
    """Springs, effects and load included; its parts are as long in every pose."""
    chance, draw, loaded = np.random.default_rng(2), drawing_of(calibration), Calibration.load(calibration)
    angles = chance.uniform(-1.2, 1.2, (12, 6))
    points = np.array([draw({f"arm.q{i + 1}": q for i, q in enumerate(row)})["arm"] for row in angles])
    assert points.shape == (12, 9, 3) and np.all(points[:, 0] == 0)
    tools = loaded.forward(angles)[:, :3, 3] * 1000
    assert np.allclose(tools, points[:, -1], atol=0.02)
    parts = np.linalg.norm(np.diff(points, axis=1), axis=2)
    assert np.allclose(parts, parts[0], atol=0.03)
    assert draw({"arm.q1": 0.0}) == {}


def test_a_calibration_that_cannot_be_read_is_told_and_mended_ones_are_used(tmp_path: Path, calibration: Path) -> None:
    shape, angles = Shape(tmp_path, every=10.0), {f"arm.q{i}": 0.1 for i in range(1, 7)}
    assert shape.points(angles, None, 0.0) == {} and shape.fault is None
    assert shape.points(angles, str(tmp_path / "gone.yaml"), 1.0) == {}
    assert "arm" in shape.points(angles, str(calibration), 2.0)  # what it was started from
    (tmp_path / "calibration.yaml").write_text("armcal_calibration: 1\n")
    assert "arm" in shape.points(angles, str(calibration), 13.0)  # the earlier one is still drawn
    assert shape.fault and "calibration.yaml" in shape.fault
    shutil.copy(calibration, tmp_path / "calibration.yaml")
    assert "arm" in shape.points(angles, None, 24.0) and shape.fault is None


# The command


def test_the_present_state_is_printed_once(tmp_path: Path) -> None:
    folder = made_up_folder(tmp_path / "dir")
    shown = CliRunner().invoke(cli, ["watch", str(folder), "--once"])
    assert shown.exit_code == 0, shown.output
    for part in ("nominal", "288 accepted", "p300", "arm.mdh.theta3", "Joint 3 slipped"):
        assert part in shown.output
    state = json.loads(CliRunner().invoke(cli, ["watch", str(folder), "--once", "--json"]).output)
    assert state["level"] == "nominal" and len(state["records"]) == 300
    (tmp_path / "early").mkdir()
    early = CliRunner().invoke(cli, ["watch", str(tmp_path / "early"), "--once"])
    assert early.exit_code == 0 and "Waiting for a recalibration" in early.output
    for more in (["--once"], [], ["--terminal"], ["--once", "--wait"]):
        nowhere = CliRunner().invoke(cli, ["watch", str(tmp_path / "none"), *more])
        assert nowhere.exit_code == 2 and "there is no such folder" in nowhere.stderr, more


def test_what_has_finished_is_not_shown_as_if_it_went_on(tmp_path: Path) -> None:
    folder, said = made_up_folder(tmp_path / "dir", 20), "The recalibration has ended"
    (folder / "status.json").write_text(json.dumps({"level": "nominal", "finished": False}))
    going = CliRunner().invoke(cli, ["watch", str(folder), "--once"])
    (folder / "status.json").write_text(json.dumps({"level": "nominal", "finished": True}))
    over = CliRunner().invoke(cli, ["watch", str(folder), "--once"])
    assert said not in going.output and said in over.output


@pytest.mark.slow
def test_a_calibration_that_is_nested_deeply_does_not_end_the_watcher(tmp_path: Path) -> None:
    """In a process of its own: where the nesting is followed by recursion in C, the process is killed."""
    (tmp_path / "events.jsonl").write_text(written([{"event": "estimate", "sequence": 9, "parameters": {"a": [1, 2]}}]))
    for opening in ("[", "{a: "):
        (tmp_path / "calibration.yaml").write_text("parameters: " + opening * 200_000)
        command = [sys.executable, "-m", "armcal.cli", "watch", str(tmp_path), "--once", "--json"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["estimates"]["parameters"][0]["name"] == "a"


def test_a_watcher_that_draws_nothing_stays_light() -> None:
    heavy = ("numpy", "casadi", "yaml", "pydantic")
    script = f"import sys, armcal_online.commands.watch; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_bad_calls_are_told(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("")
    for arguments in ([str(path)], [str(tmp_path), "--json"], [str(tmp_path), "--port", "70000"]):
        result = CliRunner().invoke(cli, ["watch", *arguments])
        assert result.exit_code == 2, arguments


@pytest.mark.slow
def test_the_command_serves_changes_nothing_and_ends_when_asked(tmp_path: Path) -> None:
    folder = made_up_folder(tmp_path / "dir", 20)
    before = {path.name: (path.stat().st_mtime_ns, path.stat().st_size) for path in folder.iterdir()}
    command = [sys.executable, "-m", "armcal.cli", "watch", str(folder), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    told = process.stdout.readline()
    address = urlsplit(told.split()[-1])
    connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=10)
    connection.request("GET", "/")
    assert b"armcal watch" in connection.getresponse().read()
    process.terminate()
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 0 and "Traceback" not in errors
    assert {path.name: (path.stat().st_mtime_ns, path.stat().st_size) for path in folder.iterdir()} == before


@pytest.mark.slow
def test_where_there_is_no_terminal_it_is_a_line_an_event(tmp_path: Path) -> None:
    folder = tmp_path / "dir"
    command = [sys.executable, "-m", "armcal.cli", "watch", str(folder), "--terminal", "--wait"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None and process.stdout is not None
    assert "Waiting for a recalibration" in process.stderr.readline()
    made_up_folder(folder, 20)
    lines = [process.stdout.readline() for _ in range(22)]
    assert "The recalibration started." in lines[0]
    assert lines[1].startswith("record 1 (p1), 2027-01-15 08:00:15 UTC: accepted (NIS ")
    assert "outlier: Record p17 is an outlier" in "".join(lines)
    process.terminate()
    process.communicate(timeout=20)
    assert process.returncode == 0
