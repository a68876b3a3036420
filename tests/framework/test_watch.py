"""A watched recalibration: what to do, how far off, since when, where to roll back to, and whether it runs at all."""

from __future__ import annotations

import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from armcal.cli.main import cli
from armcal.errors import InputError
from armcal_online.decisions import AFTER_THE_END, SOCKET, Situation, present
from armcal_online.watch import WatchServer, newest_events, page
from browser import CHROMIUM, Browser
from click.testing import CliRunner

ROOT = Path(__file__).resolve().parents[2]
START = 1.93e9
ASK = "Stop the arm's work. Roll back to record r9."
GOOD = {"sequence": 9, "id": "r9", "at": START + 9 * 900}
HOSTILE = "</script><script>document.title='taken'</script><img src=x onerror=\"document.title='taken'\">\x1b[2J"


def record(n: int, off_mm: float = 1.0, level: str = "nominal", **given: Any) -> dict[str, Any]:
    residual = [off_mm, 0.0, 0.0]
    return {
        **{"event": "record", "sequence": n, "id": f"r{n}", "at": START + 900 * n, "verdict": "accepted", "nis": 3.0},
        **{"limit": 16.3, "dof": 3, "level": level, "residual_mm": residual, "inputs": {"arm.q1": 0.1}, **given},
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


BEFORE = tuple(record(n) for n in range(1, 10))
LOST = (
    *BEFORE,
    *(record(n, 80.0, verdict="rejected") for n in (10, 11)),
    *(decision(11, "model_no_longer_fits", "lost", ASK), level(11, "nominal", "lost", "Stop.")),
    *(record(n, 60.0 + n, "lost", verdict="rejected") for n in range(12, 15)),
)


def told(*events: dict[str, Any], at: str = "lost", good: Any = None) -> dict[str, Any]:
    situation = Situation()
    for event in events:
        situation.take(event)
    return situation.first_screen(at, good, Path("/data/my run"))


# What is said


def test_at_the_level_lost_it_says_stop_how_far_off_since_when_and_the_way_back() -> None:
    now = told(*LOST)
    assert now["do"] == ASK and now["confirm"] == "Look again."
    assert now["what"] == "It is model_no_longer_fits. More than 99.9 % sure."
    assert (now["off_mm"], now["off_of"], now["off_before_mm"]) == (73.0, 3, 46.2)
    assert now["since"] == {"sequence": 10, "id": "r10", "at": START + 9000} and now["last_good"] == GOOD
    assert now["rollback"] == "armcal control '/data/my run' rollback 9"


def test_a_later_decision_that_means_less_does_not_say_go_on() -> None:
    """A level that is lost stays lost, whatever is decided after it."""
    now = told(*LOST, decision(14, "joint_replaced", "watch", "Go on."))
    assert now["do"] == ASK and now["since"]["id"] == "r10" and now["last_good"] == GOOD


def test_trouble_began_with_its_first_record_whatever_the_last_decision_is_about() -> None:
    later = decision(30, "model_no_longer_fits", "lost", ASK, last_good={"sequence": 25})
    begun = (*LOST[:11], decision(11, "joint_slipped", "watch", "Go on."), level(11, "nominal", "watch"))
    now = told(*begun, later, level(30, "watch", "lost"))
    assert "model_no_longer_fits" in now["what"] and now["since"]["id"] == "r10" and now["last_good"] == GOOD


def test_a_later_decision_about_earlier_records_says_that_trouble_began_with_them() -> None:
    earlier = {"since": 5, "since_id": "r5", "since_at": START + 4500, "last_good": {"sequence": 4}}
    now = told(*LOST, decision(14, "model_no_longer_fits", "lost", ASK, **earlier))
    assert now["since"]["id"] == "r5" and now["last_good"] == {"sequence": 4} and now["rollback"].endswith(" 4")


def test_of_two_changes_at_once_both_are_said() -> None:
    both = [decision(11, "joint_slipped", "watch", "Go on."), decision(11, "sensor_moved", "watch", "Measure anew.")]
    now = told(*LOST[:11], *both, level(11, "nominal", "watch", "Go on."), at="watch")
    assert now["do"] == "Go on. Measure anew." and now["confirm"] == "Look again."
    assert "joint_slipped. More than" in now["what"] and "sensor_moved. More than" in now["what"]


def test_when_the_level_improves_the_advice_is_that_of_the_new_level_and_the_way_back_stays() -> None:
    better = (*LOST, level(30, "lost", "suspect", "Take 10 records."))
    now = told(*better, at="suspect")
    assert now["do"] == "Take 10 records." and now["last_good"] == GOOD and "confirm" not in now
    calm = (level(46, "suspect", "watch", "Take 16 records."), level(62, "watch", "nominal", "Go on."))
    newest = {"sequence": 62, "id": "r62"}
    now = told(*better, *calm, record(62, 1.5), at="nominal", good=newest)
    assert now["do"] == "Go on." and now["last_good"] == newest and now["since"]["id"] == "r62"
    assert now["earlier"] == "It is model_no_longer_fits, in full." and "what" not in now


def test_a_rollback_ends_the_trouble() -> None:
    back = {"event": "decision", "kind": "rollback", "sequence": 20, "to": 9, "level": "nominal", "last_good": GOOD}
    events = (*LOST, {**back, "do": "Take 16 records.", "sentence": "The estimate was set back."})
    now = told(*events, at="nominal", good=GOOD)
    assert now["last_good"] == GOOD and now["do"] == "Take 16 records."
    assert now["off_mm"] is None  # those before were judged by another estimate
    assert told(*events, record(21, 1.25), at="nominal", good=GOOD)["off_mm"] == 1.25


def test_without_a_decision_it_is_the_advice_of_the_level() -> None:
    assert told(at="")["do"] == "Wait for the first record."
    lost = told({"event": "level", "sequence": 2, "from": "nominal", "to": "lost"})
    assert "the calibration that it began from" in lost["do"] and lost["rollback"] is None


def test_one_that_goes_on_knows_what_was_before_and_one_that_begins_anew_does_not(tmp_path: Path) -> None:
    written = "".join(json.dumps(event) + "\n" for event in LOST)
    half = len(written) // 2
    (tmp_path / "events.jsonl.1").write_text(written[:half])
    (tmp_path / "events.jsonl").write_text(f'{written[half:]}[]\n{{"event": "record", "residual_mm": 3}}\n{{"half')
    known = Situation.recovered(tmp_path)
    now = known.first_screen("lost", None, tmp_path)
    assert now["do"] == ASK and now["since"]["id"] == "r10" and now["last_good"] == GOOD
    known.take({"event": "started", "sequence": 90, "resumed": True})
    assert known.first_screen("lost", None, tmp_path)["do"] == ASK
    known.take({"event": "started", "sequence": 0, "resumed": False})
    assert known.first_screen("nominal", None, tmp_path)["do"] == "Go on."


# Whether it runs


@contextmanager
def folder_of(place: Path, runs: bool, *events: dict[str, Any], **status: Any) -> Iterator[Path]:
    """A folder as a recalibration leaves it; while it runs, its socket answers."""
    place.mkdir(parents=True, exist_ok=True)
    (place / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    situation = Situation.recovered(place)
    counts = {"accepted": 1288, "rejected": 9, "ignored": 3}
    whole = {
        "level": "nominal",
        "why": "All is well.",
        "last_good": GOOD,
        "counts": counts,
        "at": time.time(),
        **status,
    }
    whole["situation"] = situation.first_screen(whole["level"], whole["last_good"], place)
    (place / "status.json").write_text(json.dumps(whole))
    with ExitStack() as opened:
        listener = opened.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        listener.bind(str(place / SOCKET))
        if runs:
            listener.listen(64)
        yield place


@pytest.mark.parametrize(
    ("runs", "status", "life", "says"),
    [
        (True, {}, "running", ""),
        (True, {"finished": True}, "running", ""),  # the one before ended; this one has not written yet
        (False, {}, "killed", "was killed: no process answers here, and its last sign came at 20"),
        (False, {"at": START}, "killed", "its last sign came at 2031-02-27 23:06:40 UTC. Nothing follows the arm"),
        (True, {"at": 1.5e9}, "hangs", "hangs, or was killed: its last sign came at 2017-07-14"),
        (False, {"finished": True, "at": START, "fault": "no room. Make room."}, "stopped", "UTC: no room. Make room."),
        (False, {"finished": True, "at": START}, "ended", "has ended at 2031-02-27 23:06:40 UTC."),
    ],
)
def test_what_no_longer_runs_is_never_shown_as_nominal_and_go_on(
    tmp_path: Path, runs: bool, status: dict[str, Any], life: str, says: str
) -> None:
    """Killed, stopped by a fault, ended or stuck, whatever it wrote last: since when, and what to do."""
    with folder_of(tmp_path / "x", runs, *BEFORE, **status) as folder:
        shown = CliRunner().invoke(cli, ["watch", str(folder), "--once"]).output
        state = present(folder)
    assert state["life"] == life and says in (state["over"] or "")
    assert ("Go on." in shown) == (life == "running") and (AFTER_THE_END in shown) == (life != "running")
    assert ("(it was nominal)" in shown) == (life in ("killed", "stopped", "hangs"))
    assert ("All is well." in shown) == (life in ("running", "ended"))


def test_a_folder_without_a_status_is_waited_for_and_half_a_status_is_none(tmp_path: Path) -> None:
    assert present(tmp_path)["life"] == "waiting"
    (tmp_path / "status.json").write_text('{"level": "nom')
    assert present(tmp_path)["life"] == "waiting"
    shown = CliRunner().invoke(cli, ["watch", str(tmp_path), "--once"])
    assert shown.exit_code == 0 and "unknown, waiting" in shown.output and "Wait for the first record." in shown.output


ANSWERS = (ASK, "It is model_no_longer_fits.", "73 mm", "r10", "r9", "rollback 9")


def test_the_state_printed_once_answers_everything(tmp_path: Path) -> None:
    with folder_of(tmp_path / "x", False, *LOST, level="lost", finished=True, at=START) as folder:
        shown = CliRunner().invoke(cli, ["watch", str(folder), "--once"]).output
    for words in (*ANSWERS, "lost, ended", "has ended at 2031-02-27 23:06:40 UTC", "46 mm before this was decided"):
        assert words in shown, words


def test_the_newest_events_are_read_from_the_end_of_both_files(tmp_path: Path) -> None:
    lines = [json.dumps(record(n, why="x" * 200)) for n in range(1, 4001)]
    (tmp_path / "events.jsonl.1").write_text("\n".join(lines[:3900]) + "\n")
    (tmp_path / "events.jsonl").write_text(
        "\n".join([*lines[3900:], json.dumps(level(4000, "nominal", "lost")), '{"ev'])
    )
    found = newest_events(tmp_path)
    assert [known["sequence"] for known in found["records"]] == [*range(3701, 4001)]
    assert found["records"][0]["off_mm"] == 1.0 and "inputs" not in found["records"][0]
    assert [event["to"] for event in found["listed"]] == ["lost"]
    assert newest_events(tmp_path / "none") == {"records": [], "listed": []}


# The command


def test_bad_calls_are_told(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("")
    for arguments, says in (
        ([str(path)], "it is a file"),
        ([str(tmp_path / "none")], "there is no such folder"),
        ([str(tmp_path / "none"), "--once"], "there is no such folder"),
        ([str(tmp_path), "--port", "70000"], "70000"),
    ):
        result = CliRunner().invoke(cli, ["watch", *arguments])
        assert result.exit_code == 2 and says in result.stderr, arguments


def test_a_watcher_stays_light() -> None:
    heavy = ("numpy", "casadi", "yaml", "pydantic")
    script = f"import sys, armcal_online.watch; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.slow
def test_the_command_serves_changes_nothing_and_ends_when_asked(tmp_path: Path) -> None:
    with folder_of(tmp_path / "dir", True, *LOST, level="lost") as folder:
        before = {path.name: (path.stat().st_mtime_ns, path.stat().st_size) for path in folder.iterdir()}
        command = [sys.executable, "-m", "armcal.cli", "watch", str(folder), "--port", "0"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stdout is not None
        address = urlsplit(process.stdout.readline().split()[-1])
        connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=10)
        connection.request("GET", "/")
        assert b"armcal watch" in connection.getresponse().read()
        process.terminate()
        _, errors = process.communicate(timeout=20)
        assert process.returncode == -signal.SIGTERM and errors == ""
        assert {path.name: (path.stat().st_mtime_ns, path.stat().st_size) for path in folder.iterdir()} == before


# The server


@contextmanager
def serving(folder: Path, port: int = 0) -> Iterator[WatchServer]:
    with WatchServer(folder, port) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield server
        server.shutdown()


def asked(server: WatchServer, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read()


@pytest.mark.parametrize(
    ("header", "allowed"),
    [
        ("localhost", True),
        ("localhost:1234", True),
        ("127.0.0.1:8642", True),
        ("[::1]:8642", True),
        ("LOCALHOST", True),
        ("", False),
        (None, False),
        ("rebound.example", False),
        ("127.0.0.1.rebound.example", False),
        ("localhost:80@rebound.example", False),
        ("[::1].rebound.example", False),
        ("0.0.0.0", False),
    ],
)
def test_on_this_machine_only_names_of_this_machine_are_answered(
    tmp_path: Path, header: str | None, allowed: bool
) -> None:
    with WatchServer(tmp_path) as server:
        assert server.allows(header) is allowed


def test_only_two_addresses_are_answered_and_nothing_can_be_written(tmp_path: Path) -> None:
    with folder_of(tmp_path / "x", True, *LOST, level="lost") as folder, serving(folder) as server:
        for path, status in {"/": 200, "/state": 200, "/events": 404, "/../etc/passwd": 404}.items():
            assert asked(server, path)[0] == status
        for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
            assert asked(server, "/state", method)[0] == 501
        for path in ("/", "/state"):
            assert asked(server, path, Host="rebound.example")[0] == 403
        state = json.loads(asked(server, "/state", Host="localhost:9")[1])
        assert state["life"] == "running" and state["situation"]["do"] == ASK and len(state["records"]) == 14
        with pytest.raises(InputError, match="another --port"):
            WatchServer(folder, server.server_address[1])


def test_broken_requests_do_not_end_the_server(tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        for raw in (
            b"\r\n\r\n",
            b"GET\r\n\r\n",
            b"GET / HTTP/9.9\r\n\r\n",
            b"\x16\x03\x01" * 50,
            b"GET /" + b"a" * 70_000,
        ):
            with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=5) as client:
                client.sendall(raw)
                client.shutdown(socket.SHUT_WR)
                try:
                    while client.recv(65536):
                        pass
                except ConnectionResetError:
                    pass
        assert asked(server, "/")[0] == 200


# The page


def test_the_page_needs_nothing_from_elsewhere_and_its_policy_lets_nothing_in() -> None:
    sent, policy = page()
    html = sent.decode()
    assert set(re.findall(r"https?://[^\s\"'`)]+", html)) == {"http://www.w3.org/2000/svg"}  # a name, not fetched
    assert not re.search(r"\son\w+=|innerHTML|insertAdjacent|document\.write|\beval\b|style=\"|url\(", html)
    assert policy.startswith("default-src 'none'") and "unsafe" not in policy
    assert html.count("<script>") == html.count("</script>") == 1


@pytest.mark.slow
def test_the_wheel_holds_the_page(tmp_path: Path) -> None:
    pytest.importorskip("hatchling")
    import zipfile

    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=120)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        assert "armcal_online/watch.html" in wheel.namelist()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no chromium is installed")
    opened = Browser(tmp_path_factory.mktemp("browser"))
    yield opened
    opened.close()


def content(browser: Browser, name: str) -> str:
    return str(browser.value(f"document.getElementById({name!r}).innerText"))


@pytest.mark.quick("1280-720")
@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 720)])
def test_the_first_screen_of_the_page_answers_everything(
    browser: Browser, tmp_path: Path, width: int, height: int
) -> None:
    with folder_of(tmp_path / "run", True, *LOST, level="lost") as folder, serving(folder) as server:
        browser.resize(width, height)
        browser.requested.clear()
        browser.open(server.address)
        browser.wait_for("document.querySelectorAll('#events li').length")
        for name, words in zip(("do", "what", "off", "since", "good", "rollback"), ANSWERS, strict=True):
            bottom = browser.value(f"document.getElementById('{name}').getBoundingClientRect().bottom")
            assert words in content(browser, name) and bottom <= height, (name, bottom)
        assert (content(browser, "level"), content(browser, "life")) == ("lost", "live")
        assert content(browser, "last") == "r14 rejected" and "1,288 accepted" in content(browser, "counts")
        assert browser.value("document.querySelectorAll('#chart circle').length") == 14
        assert browser.value("document.querySelectorAll('#chart circle.rejected').length") == 5
        assert content(browser, "events").startswith("level lost") and "Confirm: Look again." in content(
            browser, "events"
        )
        assert browser.value("document.documentElement.scrollWidth") <= width and browser.logged == []
        host = urlsplit(server.address).netloc
        assert {urlsplit(url).netloc for url in browser.requested if not url.startswith("data:")} == {host}


@pytest.mark.slow
def test_a_decision_shows_as_it_comes_and_a_process_that_dies_is_not_running(browser: Browser, tmp_path: Path) -> None:
    with serving_lives(tmp_path / "run", browser) as (folder, server):
        with folder_of(folder, True, *BEFORE):
            browser.open(server.address)
            browser.wait_for("document.getElementById('do').innerText === 'Go on.'")
            assert browser.value("document.getElementById('back').hidden") and content(browser, "level") == "nominal"
            (folder / SOCKET).unlink()
            with folder_of(folder, True, *LOST, level="lost"):
                browser.wait_for(f"document.getElementById('do').innerText === {json.dumps(ASK)}")
                assert content(browser, "off") == "73 mm" and content(browser, "rollback").endswith("rollback 9")
        browser.wait_for("document.getElementById('level').innerText === 'not running'", 20.0)
        assert "The level was lost. The recalibration was killed: no process answers here" in content(browser, "over")
        assert content(browser, "do") == f"{ASK} {AFTER_THE_END}" and content(browser, "life") == "not running"


@contextmanager
def serving_lives(folder: Path, browser: Browser) -> Iterator[tuple[Path, WatchServer]]:
    folder.mkdir()
    with serving(folder) as server:
        browser.open(server.address)
        browser.wait_for("document.getElementById('life').innerText === 'no record yet'")
        yield folder, server


@pytest.mark.slow
def test_a_page_that_loses_its_server_says_so_and_comes_to_itself(browser: Browser, tmp_path: Path) -> None:
    with folder_of(tmp_path / "run", True, *BEFORE) as folder:
        with serving(folder) as server:
            port = server.server_address[1]
            browser.open(server.address)
            browser.wait_for("document.getElementById('level').innerText === 'nominal'")
        browser.wait_for("document.getElementById('life').innerText.startsWith('the watcher does not answer')")
        assert content(browser, "level") == "unknown"
        with serving(folder, port=port):
            browser.wait_for("document.getElementById('level').innerText === 'nominal'")


@pytest.mark.slow
def test_hostile_text_is_shown_as_text(browser: Browser, tmp_path: Path) -> None:
    good = {**GOOD, "id": HOSTILE}
    hostile = dict.fromkeys(("confirm", "what", "why", "since_id", "sentence"), HOSTILE)
    events = (record(3, 30.0, id=HOSTILE, why=HOSTILE), decision(4, "drift", "lost", HOSTILE, **hostile))
    given = {"level": "lost", "last_good": good, "why": HOSTILE, "paused": HOSTILE, "process": HOSTILE}
    with folder_of(tmp_path / HOSTILE[2:9], True, *events, **given) as folder, serving(folder) as server:
        browser.open(server.address)
        browser.wait_for("document.querySelectorAll('#events li').length")
        for name in ("do", "what", "confirm", "since", "last", "events"):
            assert HOSTILE[:90] in content(browser, name), name
        assert browser.value("document.querySelectorAll('script').length") == 1
        assert browser.value("document.querySelectorAll('img').length") == 0
        assert browser.value("document.title") == "lost, armcal watch"
        shown = CliRunner().invoke(cli, ["watch", str(folder), "--once"]).output
        assert "\x1b" not in shown and "\\x1b[2J" in shown
