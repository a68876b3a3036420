"""What the page on servos shows of a rehearsal, as printed, in a folder that holds nothing but ``configs``."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.docs_commands import blocks

ROOT = Path(__file__).resolve().parents[2]
ARMCAL = [sys.executable, "-m", "armcal.cli"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A fresh one."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    return tmp_path


def shown(page: str, *commands: str) -> list[list[str]]:
    """The words of the block on a page that gives these commands of armcal, one after the other."""
    for block in blocks((ROOT / "docs" / page).read_text(encoding="utf-8")):
        words = [shlex.split(line) for line in block.text.splitlines() if line.startswith("armcal ")]
        if tuple(line[1] for line in words) == commands:
            return [line[1:] for line in words]
    raise AssertionError(f"{page} shows no {commands}")


def given(words: list[str], folder: Path) -> str:
    """What a command said, once it ended well."""
    done = subprocess.run([*ARMCAL, *words], cwd=folder, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
def test_the_page_on_servos_calibrates_those_of_the_sound_bench(folder: Path) -> None:
    (command,) = shown("bench.md", "rehearse")
    said = given(command, folder)
    assert "times those of the model" not in said and "unsafe was: nothing" in said
    found = yaml.safe_load((folder / "runs" / "servo" / "servo.json").read_text())["servos"]
    truth = yaml.safe_load((folder / "configs" / "lrm_arm" / "bench_servos.yaml").read_text())
    longer = truth["boards"]["front"]["oscillator_hz"] / 25e6
    for joint, servo in truth["servos"].items():
        pulses = [knot["pulse_us"] for knot in found[joint]["knots"]]
        true = [pulse * longer for pulse in servo["pulses_us"]]
        assert pulses[2] - pulses[0] == pytest.approx(true[2] - true[0], abs=12), joint


@pytest.mark.slow
def test_the_base_pose_on_the_page_on_servos_checks_all_joints_and_lets_them_cool(folder: Path) -> None:
    base = re.search(r"\n    base: (\{.*\})\n", (ROOT / "docs" / "bench.md").read_text(encoding="utf-8"))
    (command,) = shown("bench.md", "rehearse")
    sets = ["--set", f"bench.servo.base={base and base[1]}"]
    said = given([*command[:2], "--servo", "check", "--out", "runs/check", *sets], folder)
    assert said.count(" turned by ") == 6 and "other way" not in said and "cannot be" not in said
    given([*command, *sets, "--set", "bench.servo.step=46 deg"], folder)
