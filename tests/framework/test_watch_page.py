"""The page of a recalibration in a real browser, and what it is made of."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from armcal_online.watch.server import page
from armcal_online.watch.shape import Shape
from browser import CHROMIUM, Browser
from watching import Served, decision, made_up, made_up_folder

ROOT = Path(__file__).resolve().parents[2]
HOSTILE = "</script><script>document.title='taken'</script><img src=x onerror=\"document.title='taken'\">"


@pytest.fixture(scope="module")
def calibration(demo_calibration: Path) -> Path:
    """A real one, of the shipped demonstration."""
    return demo_calibration


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    server = Served(made_up_folder(tmp_path / "dir", 60))
    server.wait_for(60)
    yield server
    server.close()


# The page


def test_the_page_needs_nothing_from_elsewhere_and_its_policy_lets_nothing_in() -> None:
    sent, policy = page()
    html = sent.decode()
    assert set(re.findall(r"https?://[^\s\"'`)]+", html)) == {"http://www.w3.org/2000/svg"}  # a name, not fetched
    assert not re.search(r"\son\w+=|innerHTML|insertAdjacent|document\.write|\beval\b|style=\"|url\(", html)
    assert policy.startswith("default-src 'none'") and "unsafe" not in policy
    assert html.count("<script>") == html.count("</script>") == 1
    assert "/* style */" not in html and "/* script */" not in html


@pytest.mark.slow
def test_the_wheel_holds_the_page(tmp_path: Path) -> None:
    pytest.importorskip("hatchling")
    import zipfile

    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=120)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        held = {Path(name).name for name in wheel.namelist() if name.startswith("armcal_online/watch/")}
    files = {path.name for path in (ROOT / "plugins/armcal_online/watch").iterdir() if path.is_file()}
    assert files <= held and "page.html" in held


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no chromium is installed")
    opened = Browser(tmp_path_factory.mktemp("browser"))
    yield opened
    opened.close()


def content(browser: Browser, name: str) -> str:
    return str(browser.value(f"document.getElementById({name!r}).textContent"))


def test_a_browser_shows_the_state_and_what_comes_after(browser: Browser, tmp_path: Path, calibration: Path) -> None:
    folder = made_up_folder(tmp_path / "dir", 300, calibration)
    served = Served(folder, shape=Shape(folder))
    try:
        served.wait_for(300)
        browser.requested.clear()
        browser.open(served.server.address)
        browser.wait_for("document.querySelector('#arm .limb')")
        assert content(browser, "level") == "nominal" and content(browser, "last-id") == "p300"
        last = served.state()["last"]
        assert float(content(browser, "last-nis")) == pytest.approx(last["nis"], rel=0.01)
        assert content(browser, "rejected") == str(served.state()["counts"]["rejected"])
        assert "Joint 3 slipped by 2.03 deg" in content(browser, "events")
        assert browser.value("document.querySelectorAll('.parameter').length") == 18
        moved = browser.value("document.querySelector('.parameter.moved').textContent")
        assert moved.startswith("arm.mdh.theta3+2.0")
        assert browser.value("document.querySelectorAll('#arm .tip').length") == 40
        assert "enlarged" in content(browser, "arm-caption")
        record = {**made_up(300)[-2], "sequence": 301, "id": "p301", "verdict": "rejected", "nis": 98.7, "limit": 16.27}
        level = {"event": "level", "sequence": 301, "at": 1.8e9, "from": "nominal", "to": "lost", "sentence": "Gone."}
        served.tell(record, decision(301, "A planted sentence."), level)
        browser.wait_for("document.getElementById('level').textContent === 'lost'")
        browser.wait_for("document.getElementById('last-nis').textContent === '98.7'")
        assert content(browser, "events").startswith("level lost") and content(browser, "sentence") == "Gone."
        assert "A planted sentence." in content(browser, "events")
        assert content(browser, "connection").startswith("live")
        (folder / "status.json").write_text(json.dumps({"level": "lost", "finished": True}))
        browser.wait_for("document.getElementById('connection').textContent.startsWith('ended')")
        host = urlsplit(served.server.address).netloc
        assert {urlsplit(url).netloc for url in browser.requested if not url.startswith("data:")} == {host}
        assert browser.logged == []
    finally:
        served.close()


@pytest.mark.slow
def test_hostile_text_is_shown_as_text(browser: Browser, tmp_path: Path) -> None:
    folder = made_up_folder(tmp_path / HOSTILE[2:9], 3)
    served = Served(folder)
    try:
        served.wait_for(3)
        browser.open(served.server.address)
        browser.wait_for("document.getElementById('last-id').textContent === 'p3'")
        record = {**made_up(3)[-1], "sequence": 4, "id": HOSTILE, "why": HOSTILE, "measurement": HOSTILE}
        estimate = {"event": "estimate", "sequence": 4, "parameters": {HOSTILE: [1.0, 0.1], "__proto__": [1, 1]}}
        start = {**made_up(1)[0], "resumed": True, "sequence": 4, "parameters": [{"name": HOSTILE, "unit": HOSTILE}]}
        level = {"event": "level", "sequence": 4, "to": HOSTILE, "sentence": HOSTILE}
        served.tell(start, record, estimate, {**decision(4, HOSTILE), "kind": HOSTILE}, level)
        browser.wait_for("document.getElementById('events').children.length >= 4")
        browser.wait_for("document.querySelectorAll('.parameter').length >= 20")
        browser.value("Innovations.choose(4)")
        assert HOSTILE in content(browser, "last-id") and HOSTILE in content(browser, "events")
        assert HOSTILE in content(browser, "parameters-others") and HOSTILE in content(browser, "readout")
        assert browser.value("document.querySelectorAll('script').length") == 1
        assert browser.value("document.querySelectorAll('img').length") == 0
        assert browser.value("document.title") != "taken"
        assert browser.value("document.getElementById('level').textContent") == "nominal"
    finally:
        served.close()


@pytest.mark.slow
def test_a_page_that_is_opened_too_early_or_loses_its_server_comes_to_itself(browser: Browser, tmp_path: Path) -> None:
    folder = tmp_path / "later"
    served = Served(folder)
    port = served.server.server_port
    try:
        browser.open(served.server.address)
        browser.wait_for("document.getElementById('waiting').textContent.startsWith('Waiting for a recal')")
        browser.wait_for("document.getElementById('connection').textContent === 'waiting'")
        made_up_folder(folder, 10)
        browser.wait_for("document.getElementById('last-id').textContent === 'p10'")
        assert browser.value("document.getElementById('waiting').hidden")
    finally:
        served.close()
    browser.wait_for("document.getElementById('connection').dataset.state === 'lost'")
    again = Served(folder, port=port)
    try:
        again.tell({**made_up(10)[-2], "sequence": 11, "id": "p11"})
        browser.wait_for("document.getElementById('last-id').textContent === 'p11'")
    finally:
        again.close()


@pytest.mark.slow
def test_a_watcher_that_does_not_answer_is_not_taken_for_a_recalibration_that_was_killed(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    served, gap = Served(made_up_folder(tmp_path / "dir", 10)), threading.Event()
    state = served.feed.state
    try:
        browser.open(served.server.address)
        browser.wait_for("document.getElementById('connection').dataset.state === 'live'")
        monkeypatch.setattr(served.feed, "state", lambda *since: gap.wait(60.0) and state(*since))
        browser.wait_for("document.getElementById('connection').textContent === 'no answer; waiting for it'", 20.0)
        assert content(browser, "connection") == "no answer; waiting for it" and content(browser, "alive") == ""
        gap.set()
        browser.wait_for("document.getElementById('connection').dataset.state === 'live'")
    finally:
        gap.set()
        served.close()


@pytest.mark.slow
def test_the_page_works_with_a_token_and_says_so_without(browser: Browser, tmp_path: Path) -> None:
    served = Served(made_up_folder(tmp_path / "dir", 5), "0.0.0.0")
    try:
        served_at = f"http://127.0.0.1:{served.server.server_port}/"
        browser.open(f"{served_at}?token={served.server.access.token}")
        browser.wait_for("document.getElementById('last-id').textContent === 'p5'")
        browser.wait_for("document.getElementById('connection').dataset.state === 'live'")
        browser.open(served_at)
        browser.wait_for("document.body.textContent.startsWith('Forbidden')")
    finally:
        served.close()


@pytest.mark.parametrize("width", [400, 1280])
def test_nothing_is_wider_than_the_window(browser: Browser, served: Served, width: int) -> None:
    browser.resize(width, 900)
    browser.open(served.server.address)
    browser.wait_for("document.querySelectorAll('.parameter').length")
    assert browser.value("document.documentElement.scrollWidth") <= width
