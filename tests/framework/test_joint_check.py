"""The check of servos that know where they stand: inverted joints, exchanged ids, and wrong teeth are named."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal_bench.joint_check import JointCheck, Zero
from click.testing import CliRunner

from tests.bench_runs import BenchRun, overrides_for

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "so101"
SERVO = "bench.simulator.joints."


def checked(folder: Path, *sets: str) -> tuple[int, str, dict[str, int]]:
    """Exit code, what was printed, and the bench's offences; the configuration is in the folder afterwards."""
    config = shutil.copytree(CONFIGS, folder / "so101") / "bench.yaml"
    run = BenchRun(folder, sets, config, "device")
    port = run.experiment.settings.bench["tracker"]["port"]  # type: ignore[index]
    with run.simulated() as clock:
        more = (f"bench.tracker.port={port}", *overrides_for(run.bench, "device"))
        words = [word for text in more for word in ("--set", text)]
        done = CliRunner().invoke(cli, ["servo", str(config), "--check", "--yes", *words])
        offences = clock.ask({"state": True})["offences"]
    return done.exit_code, " ".join(done.output.split()), offences


def unchecked(folder: Path, *sets: str) -> str:
    """Why ``acquire`` would not drive the arm."""
    config, plan = folder / "so101" / "bench.yaml", folder / "one.csv"
    plan.write_text(
        "pose_id,shoulder_pan_deg,shoulder_lift_deg,elbow_flex_deg,wrist_flex_deg,wrist_roll_deg\np,0,-45,-25,20,0\n"
    )
    words = [word for text in (*overrides_for(folder / "bench", "device"), *sets) for word in ("--set", text)]
    done = CliRunner().invoke(cli, ["acquire", str(config), "--plan", str(plan), "--dry-run", "--json", *words])
    content: dict[str, Any] = json.loads(done.stdout)
    return str(content["unchecked"])


@pytest.mark.slow
def test_joints_that_turn_as_commanded_are_right_and_only_those_are_driven(tmp_path: Path) -> None:
    code, text, offences = checked(tmp_path)
    assert (code, offences) == (0, {}), text
    assert text.count("deg, commanded +12.0 deg.") == 5
    assert unchecked(tmp_path) == ""
    changed = "bench.device.joints.elbow_flex.direction=-1", "bench.device.joints.wrist_roll.id=7"
    assert "(elbow_flex, wrist_roll: changed since it was checked)" in unchecked(tmp_path, *changed)
    assert "wrist_flex: changed" in unchecked(tmp_path, "bench.device.joints.wrist_flex.range_deg=[-95, 96]")
    real = unchecked(tmp_path, "bench.simulated=null")
    assert "(shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll: changed" in real, "it was a simulated one"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (["elbow_flex.direction=-1"], "the other way. Give its direction in bench.device the other sign."),
        (["elbow_flex.id=4", "wrist_flex.id=3"], "Exchange their ids in bench.device, or their plugs."),
        (["shoulder_pan.horn_teeth=-1"], "servo says: 1 tooth of its horn (14.4 deg each) and a zero of +5."),
        (["elbow_flex={id: 2}"], "Two servos may have the id 2"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_unsafe_is_done(tmp_path: Path, changes: list[str], says: str) -> None:
    code, text, offences = checked(tmp_path, *(SERVO + change for change in changes))
    assert code != 0
    assert says in text
    assert offences == {}
    assert f"{changes[0].partition('.')[0].partition('=')[0]}" in unchecked(tmp_path)


@pytest.mark.slow
def test_a_horn_that_is_a_tooth_off_is_found_within_its_deviation(tmp_path: Path) -> None:
    code, text, offences = checked(tmp_path, f"{SERVO}elbow_flex.horn_teeth=-1")
    stands = re.search(r"elbow_flex stands ([+-][\d.]+) \+- ([\d.]+) deg from where its servo says", text)
    assert code != 0 and offences == {} and stands, text
    assert abs(float(stands[1]) - 360 / 25) < float(stands[2]) < 360 / 25 / 2
    assert "1 tooth of its horn (14.4 deg each)" in text and "elbow_flex" in unchecked(tmp_path)


@pytest.mark.parametrize("sd_deg", [0.2, 1.0, 4.0, 8.0])
def test_a_tooth_is_named_with_certainty_only_where_the_zero_tells(sd_deg: float) -> None:
    """Zeros set by hand to 5 deg, one horn in eight a tooth off, measured with noise; else both readings are given."""
    random = np.random.default_rng(3)
    teeth = random.choice([-1, 0, 1], 4000, p=[1 / 16, 7 / 8, 1 / 16])
    measured = 14.4 * teeth + random.normal(0, 5, 4000) + random.normal(0, sd_deg, 4000)
    zeros = [Zero(math.radians(value), math.radians(sd_deg)) for value in measured]
    named = [(zero.teeth[0][0], tooth) for zero, tooth in zip(zeros, teeth.tolist(), strict=True) if zero.is_sure]
    assert np.mean([said != true for said, true in named]) < 0.05
    covered = [tooth in dict(zero.teeth) for zero, tooth in zip(zeros, teeth.tolist(), strict=True)]
    assert np.mean(covered) > 0.95


def test_a_zero_that_hides_a_tooth_is_no_certainty() -> None:
    check = JointCheck([], {"lift": Zero(math.radians(-8.2), math.radians(4.1)), "roll": Zero(0.01, 0.02)})
    assert check.far_zeros == []
    assert "a zero set by hand (" in check.notes[0] and "or 1 tooth of its horn" in check.notes[0]
    assert check.notes[1:] and "The zeros of lift alone cannot tell" in check.notes[1]
