"""Inputs of people who do this job, rebuilt from public reports, by the commands that they would type."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest


class Told(NamedTuple):
    """What the commands of a case say, and do not say; patterns."""

    present: tuple[str, ...]
    absent: str = "Traceback"


CASES = {
    "01_pose_pairs_bad_verdict": Told(("exit 0",), "Do not use"),
    "03_dh_maker_calibrated_modified": Told(("(?s)27 free parameters.*exit 0.*27 free parameters.*exit 0",)),
    "05_lerobot_seam_becomes_limits": Told(("shoulder_lift has a range of 360 deg.*passed its end",)),
    "06_lerobot_longer_than_urdf_false_advice": Told((), "not reached|Traceback"),
    "07_lerobot_not_feetech_degrees": Told(("degrees, of an arm without Feetech STS servos",), "calibrate again"),
    "09_lerobot_file_before_2025": Told(("before June 2025 it wrote lists over all motors",)),
    "10_urdf_vendor_attribute": Told(("ignored: drake:acceleration", "exit 0")),
    "12_urdf_unused_xacro_property": Told(("ignored: <xacro:property>", "exit 0")),
    "13_intrinsics_of_another_size": Told(
        ("640 x 480 images, these are 1280 x 960: scale fx, fy, cx and cy by 2", "exit 2"), "exit 0"
    ),
    "14_rational_polynomial": Told(("Ready to run", "rational_polynomial.*Leave intrinsics out")),
    "16_symmetric_chessboard": Told(("the same upside down", "looks the same after half a turn"), "stands elsewhere"),
    "18_two_publishers_of_joint_states": Told(("two programs publish it.*joint_state_publisher", "exit 2")),
    "19_fanuc_j2_j3": Told((r"joint_3 \+ joint_2 taken for joint_3.*state couplings", "exit 2", "exit 0")),
    "21_dh_of_574_m": Told(("Nearly parallel axes.*armcal convert arm.yaml --to mdh",)),
    "23_dh_fixed_row": Told(("gen3: 7 joints", "exit 0")),
    "25_pairs_of_moveit": Told(("type: pose_pairs, path: eye_to_hand_samples.yaml", "exit 2")),
    "26_kalibr_target": Told(("u_[0-9]+",), "unknown key|board of another|Traceback"),
    "27_servo_file_does_not_cover_the_data": Told(("q1 is beyond its pulse table 0 to 180 deg in 66 of 200 records",)),
    "28_urdf_joints_named_1_to_5": Told(("1 is joint_1, 2 is joint_2", "(?s)exit 0.*exit 0"), "exit [1-9]"),
    "30_lerobot_joints_refused_by_acquire": Told(("exit 0",), "expected 0 to 4095"),
}
QUICK = ("07", "09", "13", "14", "21", "25", "26")


def marked(name: str) -> object:
    return name if name.startswith(QUICK) else pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.parametrize("name", [marked(name) for name in CASES])
def test_a_case_is_taken_or_its_cause_named(name: str, shared_data: Path, tmp_path: Path) -> None:
    case = shared_data.parent / "cases" / name
    if not case.is_dir():
        pytest.skip(f"no {case}")
    folder = shutil.copytree(case, tmp_path / name)
    command = {**os.environ, "ARMCAL": str(Path(sys.executable).with_name("armcal"))}
    done = subprocess.run(
        ["bash", str(folder / "cmd.sh")], env=command, capture_output=True, text=True, timeout=600, check=False
    )
    said = done.stdout + done.stderr
    for pattern in CASES[name].present:
        assert re.search(pattern, said), said
    assert not re.search(CASES[name].absent, said), said


def test_pairs_of_moveit_are_calibrated(shared_data: Path, tmp_path: Path) -> None:
    case = shared_data.parent / "cases" / "25_pairs_of_moveit"
    if not case.is_dir():
        pytest.skip(f"no {case}")
    folder = Path(shutil.copytree(case, tmp_path / "case"))
    pairs = "data: {type: pose_pairs, path: eye_to_hand_samples.yaml, mounting: eye_to_hand}"
    (folder / "pairs.yaml").write_text(re.sub("(?m)^data: .*$", pairs, (folder / "hand.yaml").read_text()))
    for name in ("hand", "pairs"):
        done = subprocess.run(
            [Path(sys.executable).with_name("armcal"), "run", f"{name}.yaml", "--out", name], cwd=folder, check=False
        )
        assert done.returncode == 0
    read = [(folder / name / "residuals.csv").read_text().splitlines()[1:] for name in ("hand", "pairs")]
    of_table, of_pairs = ([float(line.split(",")[-1]) for line in lines] for lines in read)
    assert of_pairs == pytest.approx(of_table, abs=1e-4)
