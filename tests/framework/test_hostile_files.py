"""What files from outside may not do: steer a terminal, break a file or a table, never end, or be written through."""

from __future__ import annotations

import os
import pty
import shutil
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest
from armcal.base.config_text import shown
from armcal.cli.main import cli
from armcal_bench.commands import QueuedOutput
from armcal_export.c_code import in_comment
from click.testing import CliRunner, Result
from made_calibrations import written
from small_arms import calibration

BALL = Path(__file__).resolve().parents[2] / "configs" / "ball"
ESCAPE = "\x1b"
HOSTILE = "[/x] \x1b]0;owned\x07[bold]\u202egod\x9b31m"


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(each) for each in arguments])


def checked(ran: Result, code: int) -> str:
    """What was said: with this exit code, without a traceback, and without a character that steers a terminal."""
    if ran.exception is not None and not isinstance(ran.exception, SystemExit):
        raise ran.exception
    assert ran.exit_code == code, ran.output
    assert shown(ran.output) == ran.output
    return ran.output


@pytest.fixture
def found(tmp_path: Path) -> Path:
    return written(calibration("rigid"), tmp_path / "calibration.yaml")


# -- names are data ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_name_with_brackets_and_escapes_is_shown_and_steers_nothing(tmp_path: Path) -> None:
    shutil.copytree(BALL, tmp_path / "ball")
    text = (BALL / "demo.yaml").read_text(encoding="utf-8").partition("\n")[2]
    name = HOSTILE.encode("unicode_escape").decode()
    config = tmp_path / "ball" / "demo.yaml"
    config.write_text(
        "\n".join(line for line in text.splitlines() if not line.startswith("name:")) + f'\nname: "{name}"\n'
    )
    told = checked(armcal("run", config, "--out", tmp_path / "run"), 0)
    assert "[/x] \\x1b]0;owned" in told and "[bold]" in told
    assert checked(armcal("check", config), 0).startswith("[/x] \\x1b")
    export = ("export", tmp_path / "run" / "calibration.yaml", "--format", "c", "--out", tmp_path / "arm.c")
    checked(armcal(*export), 0)
    assert ESCAPE not in (tmp_path / "arm.c").read_text(encoding="utf-8")


def test_a_name_ends_no_comment_of_c() -> None:
    text = in_comment(f"{HOSTILE} */ b\n: 1")
    assert text.isprintable() and text.isascii() and "*/" not in text


@pytest.mark.parametrize("place", ["header", "cell", "id"])
def test_a_data_file_steers_no_terminal(place: str, found: Path, tmp_path: Path) -> None:
    header, row = ["pose_id", "q1_deg", "q2_deg", "q3_deg"], ["1", "0", "10", "20"]
    if place == "header":
        header[3] = f"q3_{HOSTILE}"
    elif place == "cell":
        row[3] = HOSTILE
    else:
        row[0], row[3] = HOSTILE, "nan"
    poses = tmp_path / "poses.csv"
    poses.write_text("\n".join([",".join(header), ",".join(row), "2,0,10,20"]) + "\n", encoding="utf-8")
    ran = armcal("predict", found, "--poses", poses, "--out", tmp_path / "o.csv", "-v")
    checked(ran, 0 if place == "id" else 2)


def test_what_is_shown_is_told_apart_from_what_steers() -> None:
    assert shown("Grüße, 関節 [1]\n\tµm") == "Grüße, 関節 [1]\n\tµm"
    assert shown(HOSTILE) == "[/x] \\x1b]0;owned\\x07[bold]\\u202egod\\x9b31m"
    assert shown("a\nb", keep="") == "a\\x0ab"
    assert shown("\ud800\U000e0041") == "\\ud800\\U000e0041"


# -- files that never end, or never begin --------------------------------------------------------------------------


@pytest.mark.quick("zero")
@pytest.mark.parametrize("kind", ["zero", "pipe", "directory", "large"])
def test_what_is_no_file_is_refused_at_once(kind: str, found: Path, tmp_path: Path) -> None:
    path = {"zero": Path("/dev/zero"), "directory": tmp_path}.get(kind, tmp_path / kind)
    if kind == "pipe":
        os.mkfifo(path)
    if kind == "large":
        with path.open("wb") as file:
            file.truncate((1 << 31) + 1)
    says = {
        "zero": "device or pipe",
        "pipe": "device or pipe",
        "directory": "a directory",
        "large": "larger than 2 GiB",
    }
    config = BALL / "demo.yaml"
    for command in (
        ("predict", found, "--poses", path, "--out", tmp_path / "o.csv"),
        ("compensate", found, "--targets", path, "--out", tmp_path / "o.csv"),
        ("run", config, "--data", path, "--out", tmp_path / "run"),
        ("run", config, "--set", f"validation={{train_ids: '{path}'}}", "--out", tmp_path / "run"),
        ("new", "robot", "r", "--dh", path, "--convention", "standard", "--out", tmp_path / "r"),
        ("new", "robot", "r", "--urdf", path, "--out", tmp_path / "r"),
        ("check", path),
    ):
        text = checked(armcal(*command), 2)
        assert says[kind].split()[-1] in text or "larger than" in text, text
    assert not (tmp_path / "o.csv").exists() and not (tmp_path / "r").exists()


def test_a_recording_behind_a_link_is_not_read_nor_quoted(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("token=hunter2\n")
    front = tmp_path / "robot" / "front"
    front.mkdir(parents=True)
    (front / "hole_0.csv").symlink_to(tmp_path / "secret")
    (front / "hole_1.csv").write_text("0,0,0,0,0,0,0\n")
    text = checked(armcal("check", BALL / "demo.yaml", "--set", f"data={{type: mukca, path: '{front.parent}'}}"), 2)
    assert "it is a link that leads out of the folder" in text and "hunter2" not in text


# -- outputs -------------------------------------------------------------------------------------------------------


@pytest.mark.quick("pipe")
@pytest.mark.parametrize("kind", ["device", "link", "pipe"])
def test_an_output_replaces_no_device_and_follows_no_link(kind: str, found: Path, tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text("q1_deg,q2_deg,q3_deg\n0,10,20\n")
    (tmp_path / "mine").write_text("mine")
    out = {"device": Path("/dev/null")}.get(kind, tmp_path / kind)
    if kind == "link":
        out.symlink_to(tmp_path / "mine")
    if kind == "pipe":
        os.mkfifo(out)
    before = out.lstat()
    for command in (
        ("predict", found, "--poses", tmp_path / "poses.csv", "--out", out),
        ("export", found, "--format", "yaml", "--out", out, "--force"),
        ("convert", found, "--to", "poe", "--out", out),
    ):
        text = checked(armcal(*command), 2)
        assert "is never replaced nor written through" in text, text
    assert (out.lstat().st_ino, out.lstat().st_mode) == (before.st_ino, before.st_mode)
    assert (tmp_path / "mine").read_text() == "mine"


# -- terminals and pipes -------------------------------------------------------------------------------------------

COMMAND = [sys.executable, "-m", "armcal.cli"]


def test_what_moves_an_arm_waits_for_no_terminal() -> None:
    """Ctrl-S while more is printed than any terminal keeps: nothing waits, and the newest comes later."""
    master, slave = pty.openpty()
    termios.tcflow(slave, termios.TCOOFF)
    with os.fdopen(slave, "w") as terminal:
        output = QueuedOutput(terminal, terminal.buffer.raw)
        began = time.monotonic()
        for i in range(20_000):
            print(f"line {i} {'.' * 60}", file=output)
        assert output.isatty() and time.monotonic() - began < 5
        termios.tcflow(slave, termios.TCOON)
        read = b""
        while b"line 19999 " not in read:
            read += os.read(master, 65536)
        output.finish()
    os.close(master)


def test_a_reader_that_goes_away_changes_no_exit_code() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    ran = subprocess.run([*COMMAND, "plugins", "list", "-v"], stdout=writer, stderr=subprocess.PIPE, timeout=60)
    os.close(writer)
    assert (ran.returncode, ran.stderr) == (0, b"")


def test_output_that_is_lost_is_a_fault() -> None:
    with Path("/dev/full").open("wb") as full:
        ran = subprocess.run([*COMMAND, "--help"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert ran.returncode == 1
    assert "standard output cannot be written (No space left on device)" in ran.stderr and "Traceback" not in ran.stderr
