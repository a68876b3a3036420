"""``armcal record`` as a process: commands, kills and resumptions, a wrong posture, and what a run makes of it all."""

from __future__ import annotations

import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from armcal.cli.main import cli
from recordings import DEMO, QUICK, ROOT, GuidedArm, Recording, angles_of, command, postures, recorded, still_lines


@pytest.fixture
def arm() -> Iterator[GuidedArm]:
    guided = GuidedArm()
    yield guided
    guided.close()


@pytest.fixture
def started(tmp_path: Path, arm: GuidedArm) -> Iterator[list[Recording]]:
    going: list[Recording] = []
    yield going
    for each in going:
        each.close()


def stand(arm: GuidedArm, row: dict[str, str], **other: float) -> None:
    arm.stand({**angles_of(row), **other})


@pytest.mark.slow
def test_captures_undone_named_killed_and_resumed(tmp_path: Path, arm: GuidedArm, started: list[Recording]) -> None:
    rows, out = postures(), tmp_path / "out"
    stand(arm, rows[0])
    going = Recording(out, arm.source, *QUICK)
    started.append(going)
    going.ready()
    time.sleep(0.2)
    assert "no position and no socket was named" in going.capture()["sentence"]
    going.type("g front/hole_0")
    going.told("named")
    found = going.capture()
    assert found["posture"]["labels"] == {"position": "front", "socket": "hole_0"}
    assert found["posture"]["readings"] >= 5
    stand(arm, rows[1])
    assert going.capture()["posture"]["name"] == "2"
    going.type("u")
    assert going.told("undone")["posture"] == "2"
    stand(arm, rows[2])
    going.type("g hole_1")  # the position stays
    assert going.told("named")["name"] == "front/hole_1"
    going.type("1")
    assert going.told("named")["name"] == "front/hole_0"
    assert going.capture()["posture"]["name"] == "3"
    assert [row["pose_id"] for row in recorded(out)] == ["1", "3"]
    going.process.send_signal(signal.SIGKILL)
    going.process.wait()
    again = Recording(out, arm.source, *QUICK, "--resume")
    started.append(again)
    assert again.told("status")["postures"] == 2
    stand(arm, rows[3])
    kept = again.capture()
    assert kept["posture"]["name"] == "4" and kept["posture"]["labels"]["socket"] == "hole_0"
    assert again.finish() == 0
    found = recorded(out)
    assert [row["pose_id"] for row in found] == ["1", "3", "4"]
    for row, truth in zip(found, (rows[0], rows[2], rows[3]), strict=True):
        for joint, angle in angles_of(truth).items():
            assert abs(float(row[joint]) - angle) < 0.005


@pytest.mark.slow
def test_kills_at_any_moment_lose_nothing_acknowledged_and_repeat_nothing(
    tmp_path: Path, arm: GuidedArm, started: list[Recording]
) -> None:
    out, acknowledged = tmp_path / "out", []
    stand(arm, postures()[0])
    for kill in range(3):
        going = Recording(out, arm.source, *QUICK, *(["--resume"] if kill else []))
        started.append(going)
        going.type("g front/hole_0")
        going.told("named")
        for _ in range(2):
            time.sleep(0.15)
            acknowledged.append(going.capture()["posture"]["name"])
        time.sleep(0.15)
        going.type("c")
        time.sleep(0.03 * kill)
        going.process.kill()
        going.process.wait()
    last = Recording(out, arm.source, *QUICK, "--resume")
    started.append(last)
    last.told("status")
    assert last.finish() == 0
    names = [row["pose_id"] for row in recorded(out)]
    assert set(acknowledged) <= set(names) and len(names) == len(set(names)) <= 9
    assert names == [str(i) for i in range(1, len(names) + 1)]


@pytest.mark.slow
def test_keys_of_a_terminal_which_is_left_as_it_was(tmp_path: Path, arm: GuidedArm) -> None:
    stand(arm, postures()[0])
    leader, follower = pty.openpty()
    before = termios.tcgetattr(follower)
    line = [sys.executable, "-m", "armcal.cli", "record", str(DEMO), "--out", str(tmp_path / "out")]
    going = subprocess.Popen(
        [*line, "--from", arm.source, *QUICK], stdin=follower, stdout=follower, stderr=follower, cwd=ROOT
    )
    try:
        expect(leader, b"q ends")
        os.write(leader, b"gfrond\x7ft/hole_0\n")
        expect(leader, b"the arm touches front/hole_0.")
        time.sleep(0.2)
        os.write(leader, b"\n")
        expect(leader, b"posture 1 in front/hole_0 is kept")
        os.write(leader, b"u")
        expect(leader, b"posture 1 is taken back.")
        os.write(leader, b"x")
        expect(leader, b"found 'x'")
        assert not termios.tcgetattr(follower)[3] & termios.ICANON
        os.write(leader, b"q")
        expect(leader, b"0 postures are recorded")
        assert going.wait(20) == 0
        assert termios.tcgetattr(follower) == before
    finally:
        going.kill()
        going.wait()
        os.close(leader)
        os.close(follower)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.slow)])
def test_a_signal_ends_it_and_restores_the_terminal(tmp_path: Path, arm: GuidedArm, number: int) -> None:
    leader, follower = pty.openpty()
    before = termios.tcgetattr(follower)
    line = [sys.executable, "-m", "armcal.cli", "record", str(DEMO), "--out", str(tmp_path / "out")]
    going = subprocess.Popen([*line, "--from", arm.source], stdin=follower, stdout=follower, stderr=follower, cwd=ROOT)
    try:
        expect(leader, b"q ends")
        time.sleep(0.1)
        going.send_signal(number)
        expect(leader, b"0 postures are recorded")
        assert going.wait(20) == 0 and termios.tcgetattr(follower) == before
    finally:
        going.kill()
        going.wait()
        os.close(leader)
        os.close(follower)


def expect(terminal: int, text: bytes, timeout_s: float = 30.0) -> None:
    """Read a terminal until it shows a text."""
    seen, ends = b"", time.monotonic() + timeout_s
    while text not in seen:
        assert time.monotonic() < ends, seen
        if select.select([terminal], [], [], 0.2)[0]:
            seen += os.read(terminal, 4096)


@pytest.mark.slow
def test_what_cannot_be_captured_is_refused_in_a_sentence(
    tmp_path: Path, arm: GuidedArm, started: list[Recording]
) -> None:
    row = postures()[0]
    going = Recording(tmp_path / "out", arm.source, *QUICK)
    started.append(going)
    going.type("g front/hole_0")
    going.told("named")
    assert "no joint readings came for" in going.told("silent")["sentence"]
    assert "is the sender running?" in going.capture()["sentence"]
    in_radians = {key.replace("_deg", "_rad"): value for key, value in angles_of(row).items()}
    arm.stand(in_radians)
    assert "more than one turn (2 pi rad): does the stream give degrees" in going.capture()["sentence"]
    stand(arm, row, j4_deg=float("nan"))
    time.sleep(0.5)
    assert "arm.j4 is not finite" in going.capture()["sentence"]
    stand(arm, row, j8_deg=1.0)
    time.sleep(0.5)
    assert "it has 8 joints, expected 7: found j8_deg" in going.capture()["sentence"]
    stand(arm, row)
    going.told("heard")
    moving = GuidedStep(arm, row)
    refused = moving.until_refused(going)
    assert "the arm does not stand still: arm.j2 moved by" in refused and "allowed: 0.2 deg" in refused
    stand(arm, row)
    going.type("g front/[x]")
    assert "which is no name" in going.told("refused")["sentence"]
    going.type("g a/b/c")
    assert "expected position/socket" in going.told("refused")["sentence"]
    going.type("7")
    assert "7 stands for no name: 1 */hole_0, 2 */hole_1" in going.told("refused")["sentence"]
    time.sleep(0.2)
    assert going.capture()["event"] == "captured"
    stand(arm, row, j2_deg=angles_of(row)["j2_deg"] + 0.5)
    going.type("c")
    assert "is nearly posture" in going.told("warning")["sentence"]
    assert going.finish() == 0


class GuidedStep:
    """An arm that moves by half a degree between two readings."""

    def __init__(self, arm: GuidedArm, row: dict[str, str]) -> None:
        self._arm, self._row = arm, row

    def until_refused(self, going: Recording) -> str:
        for turn in range(20):
            moved = angles_of(self._row)
            moved["j2_deg"] += 0.5 * (turn % 2)
            self._arm._message = dict(moved)
            time.sleep(0.05)
            going.type("c")
            found = going.told("captured", "refused")
            if found["event"] == "refused":
                return str(found["sentence"])
            going.type("u")
            going.told("undone")
        raise AssertionError("an arm that moves was captured each time")


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--from", "udp:99999"), "expected - (standard input), udp:PORT"),
        (("--from", "udp:0.0.0.0:9000"), "expected - (standard input), udp:PORT of this machine"),
        (("--from", "/no/such/file"), "no joint readings come"),
        ((), "found no bench"),
        (("--from", "udp:0", "--set", "bench.joints={type: json_lines, joints: {j9: x}}"), "no joint is called 'j9'"),
        (("--from", "udp:0", "--set", "bench.recording.window_s=0"), "window is not above zero"),
        (("--from", "udp:0", "--resume"), "holds no recording to resume"),
        (("--from", "-"), "no key can start a capture"),
    ],
)
def test_bad_requests_are_refused_before_anything_is_written(
    tmp_path: Path, more: tuple[str, ...], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    with Path("/dev/null").open() as nothing, pytest.raises(SystemExit) as end:
        monkeypatch.setattr(sys, "stdin", nothing)
        cli.main(["record", str(DEMO), "--out", str(tmp_path / "out"), *more])
    stderr = capsys.readouterr().err
    assert end.value.code == 2 and said in stderr and "Traceback" not in stderr, stderr
    assert not (tmp_path / "out" / "dataset.csv").exists()


@pytest.mark.slow
def test_a_recording_is_not_begun_over_another(tmp_path: Path) -> None:
    out = tmp_path / "out"
    lines = still_lines(postures()[:1])
    assert command("record", DEMO, "--out", out, "--from", "-", "--capture", "still", given=lines).returncode == 0
    again = command("record", DEMO, "--out", out, "--from", "-", "--capture", "still", given=lines)
    assert again.returncode == 2 and "holds a recording already" in again.stderr
    more = command("record", DEMO, "--out", out, "--from", "-", "--capture", "still", "--resume", given=lines)
    assert more.returncode == 0 and len(recorded(out)) == 1  # the arm stands where it stood
