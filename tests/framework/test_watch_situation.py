"""The first screen of a watched recalibration: what to do, how far off, since when, and where to roll back to."""

from __future__ import annotations

import csv
import json
import math
import os
import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from armcal.cli.main import cli
from armcal_online.watch.feed import Feed
from armcal_online.watch.history import History
from armcal_online.watch.hours import MOST_HOURS, Hours, Truth, over_time, truth_beside
from armcal_online.watch.situation import AFTER_THE_END
from browser import CHROMIUM, Browser
from click.testing import CliRunner
from watching import Served, written

START = 1.93e9
ASK = "Stop the arm's work. Roll back to record r9."
GOOD = {"sequence": 9, "id": "r9", "at": START + 9 * 900}


def record(n: int, off_mm: float = 1.0, level: str = "nominal", **given: Any) -> dict[str, Any]:
    residual = [off_mm, 0.0, 0.0]
    return {
        **{"event": "record", "sequence": n, "id": f"r{n}", "at": START + 900 * n, "verdict": "accepted", "nis": 3.0},
        **{"limit": 16.3, "dof": 3, "level": level, "residual_mm": residual, **given},
    }


def decision(n: int, kind: str, level: str, do: str, **given: Any) -> dict[str, Any]:
    return {
        **{"event": "decision", "sequence": n, "at": START + 900 * n, "kind": kind, "level": level, "do": do},
        **{"what": f"It is {kind}.", "since": n - 1, "since_id": f"r{n - 1}", "since_at": START + 900 * (n - 1)},
        **{"sure_percent": 99.99, "tip_error_mm": 46.2, "confirm": "Look again.", "last_good": GOOD},
        **{"sentence": f"It is {kind}, in full.", **given},
    }


def level(n: int, before: str, after: str, do: str = "") -> dict[str, Any]:
    return {
        **{"event": "level", "sequence": n, "at": START + 900 * n, "from": before, "to": after, "do": do},
        **{"since_id": f"r{n}", "last_good": GOOD, "sentence": f"From {before} to {after}."},
    }


def seen(*events: dict[str, Any]) -> History:
    history = History()
    for event in events:
        history.take(event)
    return history


LOST = (
    *(record(n) for n in range(1, 10)),
    *(record(n, 80.0, verdict="rejected") for n in (10, 11)),
    *(decision(11, "model_no_longer_fits", "lost", ASK), level(11, "nominal", "lost", "Stop.")),
    *(record(n, 60.0 + n, "lost", verdict="rejected") for n in range(12, 15)),
)


# What is said


def test_at_the_level_lost_it_says_stop_how_far_off_since_when_and_the_way_back() -> None:
    now = seen(*LOST).situation("/data/my run", {})
    assert now["do"] == ASK and now["confirm"] == "Look again."
    assert now["what"] == "It is model_no_longer_fits. More than 99.9 % sure."
    assert (now["off_mm"], now["off_of"], now["off_before_mm"]) == (73.0, 3, 46.2)
    assert now["since"] == {"sequence": 10, "id": "r10", "at": START + 9000} and now["last_good"] == GOOD
    assert now["rollback"] == "armcal control '/data/my run' rollback 9"


def test_a_later_decision_that_means_less_does_not_say_go_on() -> None:
    """A level that is lost stays lost, whatever is decided after it."""
    now = seen(*LOST, decision(14, "joint_replaced", "watch", "Go on.")).situation("x", {})
    assert now["do"] == ASK and now["since"]["id"] == "r10" and now["last_good"] == GOOD


def test_trouble_began_with_its_first_record_whatever_the_last_decision_is_about() -> None:
    later = decision(30, "model_no_longer_fits", "lost", ASK, last_good={"sequence": 25})
    begun = (*LOST[:11], decision(11, "joint_slipped", "watch", "Go on."), level(11, "nominal", "watch"))
    now = seen(*begun, later, level(30, "watch", "lost")).situation("x", {})
    assert "model_no_longer_fits" in now["what"] and now["since"]["id"] == "r10" and now["last_good"] == GOOD


def test_a_later_decision_about_earlier_records_says_that_trouble_began_with_them() -> None:
    earlier = {"since": 5, "since_id": "r5", "since_at": START + 4500, "last_good": {"sequence": 4}}
    now = seen(*LOST, decision(14, "model_no_longer_fits", "lost", ASK, **earlier)).situation("x", {})
    assert now["since"]["id"] == "r5" and now["last_good"] == {"sequence": 4} and now["rollback"].endswith(" 4")


def test_of_two_changes_at_once_both_are_said() -> None:
    both = [decision(11, "joint_slipped", "watch", "Go on."), decision(11, "sensor_moved", "watch", "Measure anew.")]
    now = seen(*LOST[:11], *both, level(11, "nominal", "watch", "Go on.")).situation("x", {})
    assert now["do"] == "Go on. Measure anew." and now["confirm"] == "Look again."
    assert "joint_slipped. More than" in now["what"] and "sensor_moved. More than" in now["what"]


def test_when_the_level_improves_the_advice_is_that_of_the_new_level_and_the_way_back_stays() -> None:
    history = seen(*LOST, level(30, "lost", "suspect", "Take 10 records."))
    now = history.situation("x", {})
    assert now["do"] == "Take 10 records." and now["last_good"] == GOOD and "confirm" not in now
    history.take(level(46, "suspect", "watch", "Take 16 records."))
    history.take(level(62, "watch", "nominal", "Go on."))
    history.take(record(62, 1.5))
    now = history.situation("x", {})
    assert now["do"] == "Go on." and now["last_good"]["id"] == "r62" and now["since"]["id"] == "r62"
    assert now["earlier"] == "It is model_no_longer_fits, in full." and "what" not in now
    assert history.situation("x", {"finished": True})["do"] == AFTER_THE_END


def test_a_rollback_ends_the_trouble() -> None:
    back = {"event": "decision", "kind": "rollback", "sequence": 20, "to": 9, "level": "nominal", "last_good": GOOD}
    history = seen(*LOST, {**back, "do": "Take 16 records.", "sentence": "The estimate was set back."})
    assert history.level == "nominal" and history.trouble.first is None
    now = history.situation("x", {})
    assert now["last_good"] == GOOD and now["do"] == "Take 16 records."
    assert now["off_mm"] is None  # those before were judged by another estimate
    history.take(record(21, 1.25))
    assert history.situation("x", {})["off_mm"] == 1.25


def test_events_of_an_earlier_version_have_the_advice_of_their_level() -> None:
    old = [record(1), {"event": "decision", "sequence": 2, "kind": "joint_slipped", "sentence": "Joint 3 slipped."}]
    now = seen(*old, {"event": "level", "sequence": 2, "from": "nominal", "to": "watch"}).situation("x", {})
    assert now["do"].startswith("Go on with coarse work.") and now["what"] == "Joint 3 slipped."
    assert seen().situation("x", {})["do"] == "Wait for the first record."
    lost = seen({"event": "level", "sequence": 2, "from": "nominal", "to": "lost"}).situation("x", {})
    assert "the calibration that it began from" in lost["do"] and lost["rollback"] is None


# Hours


def hourly(mm: list[float], levels: list[str] | None = None, each: int = 4) -> Hours:
    """Hours of records whose readings are so far off."""
    hours, chance = Hours(), random.Random(1)
    for i, size in enumerate(mm):
        for k in range(each):
            name = levels[i] if levels else "nominal"
            off = size * chance.uniform(0.95, 1.05)
            hours.take({"at": START + 3600 * i + 600 * k, "off_mm": off, "level": name, "verdict": "accepted"})
    return hours


def test_hours_that_are_off_while_nominal_are_found_and_an_outlier_is_none() -> None:
    known = over_time(hourly([1.0] * 10 + [4.0, 6.0] + [1.0] * 5), None)
    (span,) = known["off"]
    assert (
        span["to"] - span["from"] == 7200 and span["mm"] == pytest.approx(6.0, rel=0.06) and known["by"] == "readings"
    )
    at_watch = ["nominal"] * 10 + ["watch"] * 2 + ["nominal"] * 5
    assert over_time(hourly([1.0] * 10 + [4.0, 6.0] + [1.0] * 5, at_watch), None)["off"] == []
    hours = hourly([1.0] * 10)
    for at, verdict in ((900.0, "rejected"), (1000.0, "ignored")):
        hours.take({"at": START + 3600 * 9 + 1800 + at, "off_mm": 40.0, "level": "nominal", "verdict": verdict})
    assert over_time(hours, None)["off"] == []
    for verdict, off in (("rejected", 900.0), ("accepted", 1.0)):  # one wrong record of two
        hours.take({"at": START + 3600 * 11, "off_mm": off, "level": "nominal", "verdict": verdict})
    assert over_time(hours, None)["off"] == []
    assert over_time(Hours(), None)["limit_mm"] is None


def test_hours_are_bounded_and_medians() -> None:
    hours = hourly([float(1 + i % 7) for i in range(MOST_HOURS + 50)], each=3)
    assert len(hours.rows) == MOST_HOURS
    assert sum(len(hour.sizes) for hour in hours._hours) <= 3
    assert all(row["count"] == 3 for row in hours.rows[1:])
    json.dumps(over_time(hours, None), allow_nan=False)


def mission(folder: Path, mm: list[float], levels: list[str]) -> Path:
    """The files that a mission leaves beside its recalibration."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "mission.json").write_text(json.dumps({"began": START, "limit_mm": 3.0}))
    with (folder / "mission.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["day", "moment", "frozen_mm", "recalibrated_mm", "level", "temperature_C"])
        for i, (size, name) in enumerate(zip(mm, levels, strict=True)):
            rows.writerow([i / 24, "hour", 9.0, size, name, 20.0])
            rows.writerow([i / 24 + 0.01, "record", 9.0, 99.0, name, 20.0])
    return folder


def test_nights_that_only_the_truth_of_a_mission_shows_are_found(tmp_path: Path) -> None:
    folder = mission(tmp_path, [1.0, 4.0, 5.0, 1.0, 7.0], ["nominal"] * 4 + ["watch"])
    truth = truth_beside(folder / "recalibration")
    assert truth is not None and len(truth.rows) == 5
    known = over_time(hourly([0.5] * 5), truth)
    assert known["by"] == "truth" and known["limit_mm"] == 3.0
    (span,) = known["off"]
    assert (span["from"], span["to"], span["mm"]) == pytest.approx((START + 3600, START + 3 * 3600, 5.0))
    assert truth_beside(tmp_path / "none" / "recalibration") is None
    (folder / "mission.csv").write_text("day,moment\nx,hour\n")
    assert truth_beside(folder / "recalibration") is None
    assert over_time(Hours(), Truth([], None))["by"] == "readings"


# The terminal, and a browser


def lost_folder(folder: Path, finished: bool) -> Path:
    folder.mkdir(parents=True)
    names = [*(f"arm.mdh.theta{i}" for i in range(1, 40)), "arm.mdh.d1", "arm.mdh.d2"]
    listed = [{"name": name, "unit": "rad", "value": 0.1, "sd": 0.001} for name in names]
    start = {"event": "started", "sequence": 0, "at": START, "level": "nominal", "parameters": listed, "resumed": False}
    values = {name: [0.1 + (0.02 if name.endswith("theta7") else 0.0), 0.001] for name in names}
    end = [{"event": "finished", "sequence": 14, "at": START + 20_000, "sentence": "The source has ended."}]
    events = [start, *LOST, {"event": "estimate", "sequence": 14, "parameters": values}, *(end if finished else [])]
    (folder / "events.jsonl").write_text(written(events))
    (folder / "status.json").write_text(json.dumps({"level": "lost", "finished": finished, "records": 14}))
    return folder


ANSWERS = (ASK, "It is model_no_longer_fits.", "73 mm", "r10", "r9", "rollback 9")


def test_the_terminal_answers_on_its_first_lines(tmp_path: Path) -> None:
    shown = CliRunner().invoke(cli, ["watch", str(lost_folder(tmp_path / "x", True)), "--once"], env={"COLUMNS": "100"})
    first = " ".join(shown.output.replace("│", " ").split("╰")[0].split())
    for words in (*ANSWERS, "lost", "has ended at 2031-02-28 04:40:00 UTC", "46 mm before this was decided"):
        assert words in first, words


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no chromium is installed")
    opened = Browser(tmp_path_factory.mktemp("browser"))
    yield opened
    opened.close()


@pytest.mark.quick("1280-720")
@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 720)])
def test_the_first_screen_of_the_page_answers_everything_and_is_not_live(
    browser: Browser, tmp_path: Path, width: int, height: int
) -> None:
    folder = lost_folder(mission(tmp_path, [1.0] * 5 + [4.0], ["nominal"] * 6) / "recalibration", True)
    served = Served(folder)
    try:
        served.wait_for(14)
        browser.resize(width, height)
        browser.open(served.server.address)
        browser.wait_for("document.querySelectorAll('.parameter').length")
        browser.wait_for("document.getElementById('connection').dataset.state === 'ended'")
        for name, words in zip(("do", "sentence", "off", "since", "good", "rollback"), ANSWERS, strict=True):
            text, bottom = browser.value(
                f"[document.getElementById('{name}').innerText, document.getElementById('{name}')"
                ".getBoundingClientRect().bottom]"
            )
            assert words in text and bottom <= height, (name, text, bottom)
        assert browser.value("document.getElementById('level').innerText") == "lost"
        told = browser.value("document.getElementById('connection').innerText")
        assert told == "ended 2031-02-28 04:40:00 UTC, level lost" and "live" not in told
        assert browser.value("document.querySelector('#parameters .name').innerText") == "arm.mdh.theta7"
        assert browser.value("document.querySelectorAll('#parameters .parameter').length") == 6
        assert browser.value("document.querySelectorAll('#parameters-others .parameter').length") == 35
        assert not browser.value("document.getElementById('others').open")
        assert "in 1 of 6 hours (more than 3 mm of true tip error)" in browser.value(
            "document.getElementById('off-nominal').innerText"
        )
        assert browser.value("document.querySelectorAll('#hours rect.off').length") == 1
        assert browser.value("document.documentElement.scrollWidth") <= width and browser.logged == []
    finally:
        served.close()


@pytest.mark.slow
def test_a_page_of_what_was_killed_is_silent_and_one_that_runs_shows_a_decision_as_it_comes(
    browser: Browser, tmp_path: Path
) -> None:
    folder = lost_folder(tmp_path / "dir", False)
    (folder / "events.jsonl").write_text(written([record(n) for n in range(1, 10)]))
    (folder / "status.json").write_text(json.dumps({"level": "nominal", "finished": False}))
    served = Served(folder)
    try:
        served.wait_for(9)
        browser.open(served.server.address)
        browser.wait_for("document.getElementById('connection').dataset.state === 'live'")
        browser.wait_for("document.getElementById('do').innerText === 'Go on.'")
        assert browser.value("document.getElementById('back').hidden")
        served.tell(*LOST[9:])
        browser.wait_for(f"document.getElementById('do').innerText === {json.dumps(ASK)}")
        browser.wait_for("document.getElementById('rollback').innerText.endsWith('rollback 9')")
        assert browser.value("document.getElementById('off').innerText") == "73 mm"
        os.utime(folder / "status.json", (1.9e9 - 1e9, 1.9e9 - 1e9))
        browser.wait_for("document.getElementById('connection').innerText === 'silent'", 20.0)
        browser.wait_for("document.getElementById('level').innerText === 'not running'")
        assert "was killed, or hangs: its last sign came at 1998-07-09" in browser.value(
            "document.getElementById('alive').innerText"
        )
        assert browser.value("document.getElementById('do').innerText") == f"{ASK} {AFTER_THE_END}"
    finally:
        served.close()


@pytest.mark.parametrize(
    ("status", "age_s", "life", "says"),
    [
        ({"finished": False}, 2, "live", ""),
        ({"finished": False}, 60, "silent", "was killed, or hangs: its last sign came at 20"),
        (None, 60, "silent", "was killed, or hangs: its last sign came at 20"),
        ({"finished": True, "at": START, "fault": "no room. Make room."}, 60, "stopped", "UTC: no room. Make room."),
        ({"finished": True, "at": START}, 60, "ended", "has ended at 2031-02-27 23:06:40 UTC."),
    ],
)
def test_what_no_longer_runs_is_never_shown_as_nominal_and_go_on(
    tmp_path: Path, status: dict[str, Any] | None, age_s: float, life: str, says: str
) -> None:
    """Killed before or after its first status, stopped by a fault, or ended: since when, and what to do."""
    (tmp_path / "events.jsonl").write_text(written([record(n) for n in range(1, 4)]))
    if status is not None:
        (tmp_path / "status.json").write_text(json.dumps({"level": "nominal", **status}))
    for path in tmp_path.iterdir():
        os.utime(path, (time.time() - age_s, time.time() - age_s))
    shown = CliRunner().invoke(cli, ["watch", str(tmp_path), "--once"], env={"COLUMNS": "120"}).output
    told = " ".join(shown.replace("│", " ").split())
    state = json.loads(CliRunner().invoke(cli, ["watch", str(tmp_path), "--once", "--json"]).output)
    assert state["situation"]["life"] == life and says in (state["situation"]["over"] or "")
    assert ("Go on." in told) == (life == "live") and (AFTER_THE_END in told) == (life != "live")
    assert ("not running (it was nominal)" in told) == (life in ("silent", "stopped"))
    assert ("out of the ordinary" in told) == (life in ("live", "ended"))


def test_a_status_with_the_last_good_record_serves_where_no_event_of_it_is_left(tmp_path: Path) -> None:
    folder = tmp_path / "dir"
    folder.mkdir()
    (folder / "events.jsonl").write_text(written([record(50, level="watch")]))
    (folder / "status.json").write_text(json.dumps({"level": "watch", "finished": False, "last_good": GOOD}))
    feed = Feed(folder)
    while feed.step():
        pass
    now = feed.state()["situation"]
    assert now["last_good"] == GOOD and now["rollback"].endswith("rollback 9") and math.isclose(now["off_mm"], 1.0)
