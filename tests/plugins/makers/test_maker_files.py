"""Makers' files: the arm that they mean, by forward kinematics in 1,000 poses; wrong ones named."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.calibration.convert import reload
from armcal.calibration.rigid_chain import tool_poses
from armcal.cli.main import cli
from armcal.errors import InputError
from armcal.plugins import discover
from armcal_makers.files import at_zero, nominal_arms, read_kinematics, tips
from click.testing import CliRunner

from tests.plugins.makers.maker_files import (
    UR5_ROWS,
    UR5_YAML,
    UR5E_ROWS,
    UR5E_YAML,
    XARM6_ROWS,
    XARM6_YAML,
    dh_tip,
    poses,
    ur_rows,
    yaml_of,
    yaml_tip,
)

EXACT = 1e-11


def armcal(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def read(folder, text, name="file.yaml"):
    (folder / name).write_text(text)
    return read_kinematics(text, folder / name)


def urdf_tips(path, q):
    """As the arm model ``urdf`` has it."""
    section = yaml.safe_dump({"model": {"type": "urdf", "text": path.read_text()}})
    return tool_poses(reload(section, discover()), q)


@pytest.mark.parametrize(
    ("text", "rows", "robot"),
    [(UR5_YAML, UR5_ROWS, "ur5"), (UR5E_YAML, UR5E_ROWS, "ur5e"), (XARM6_YAML, XARM6_ROWS, "xarm6")],
)
def test_the_urdf_is_the_arm_of_the_file(tmp_path, text, rows, robot):
    (tmp_path / "k.yaml").write_text(text)
    ran = armcal("maker", tmp_path / "k.yaml", "--out", tmp_path / "arm.urdf", "--json")
    assert ran.exit_code == 0, ran.output
    said, q = json.loads(ran.stdout), poses()
    wanted = yaml_tip(rows, q)
    assert said["robot"] == robot
    assert np.abs(urdf_tips(tmp_path / "arm.urdf", q) - wanted).max() < 1e-12


def test_the_table_is_the_distance_to_the_nominal_arm(tmp_path):
    (tmp_path / "k.yaml").write_text(UR5E_YAML)
    said = json.loads(armcal("maker", tmp_path / "k.yaml", "--json").stdout)
    q = poses()
    apart = np.linalg.norm((yaml_tip(UR5E_ROWS, q) - dh_tip(ur_rows("ur5e"), q))[:, :3, 3], axis=1)
    assert said["median_mm"] == pytest.approx(1000 * np.median(apart), rel=0.1)
    assert said["largest_mm"] == pytest.approx(1000 * max(apart), rel=0.1)
    assert said["joints"]["shoulder_pan_joint"]["shift_mm"] == pytest.approx(0.2122, abs=1e-3)
    ran = armcal("maker", tmp_path / "k.yaml")
    assert "median 0.89" in ran.stdout and "ur5e" in ran.stdout


def test_nominal_arms_are_what_their_makers_publish():
    arms = nominal_arms()
    angles = (
        -1.6007002035724084,
        -1.7271001974688928,
        -2.202999893819891,
        -0.807999912892477,
        1.595100045204163,
        -0.031,
    )
    ur10 = tips(arms["ur10"].frames, np.array([[*angles[:5], angles[5] + 3.75058716e-08]]))
    assert ur10[0, :3, 3] == pytest.approx([-0.179925914147547, -0.606869755162764, 0.230789102067257], abs=1e-8)
    zero = {name: at_zero(arm.frames)[-1][:3, 3] for name, arm in arms.items()}
    assert zero["xarm6"] == pytest.approx([0.207, 0, 0.112], abs=1e-12)  # stands folded, by its manual
    assert zero["xarm7"] == pytest.approx([0.206, 0, 0.1205], abs=1e-12)
    assert zero["lite6"] == pytest.approx([0.087, 0, 0.15365 + 0.00014], abs=1e-3)


def without(text, start):
    return "\n".join(line for line in text.splitlines() if not line.strip().startswith(start))


DEGREES = yaml_of([(*row[:3], *map(math.degrees, row[3:])) for row in UR5E_ROWS])
WRONG = {
    "empty": ("", "no keys"),
    "not yaml": ("a: [1\n", "not valid YAML"),
    "another file": ("arms: {arm: {model: {type: mdh}}}\n", "expected kinematics"),
    "degrees": (DEGREES, "looks like degrees"),
    "millimetres": (yaml_of([(*(1000 * x for x in row[:3]), *row[3:]) for row in UR5E_ROWS]), "expected metres"),
    "100 times": (UR5E_YAML.replace("-0.425", "-2.425"), "not a calibration of"),
    "other names": (UR5E_YAML.replace("forearm", "lower_arm"), "found the joints shoulder, upper_arm, lower_arm"),
    "missing number": (without(UR5E_YAML, "yaw"), "found x, y, z, roll, pitch, expected"),
    "text": (UR5E_YAML.replace("z: 0.1627", "z: high # "), "found 'high', expected a number"),
    "not finite": (UR5E_YAML.replace("z: 0.1627122445743823", "z: .nan"), "expected a number"),
    "hash missing": (without(UR5E_YAML, "hash"), "no hash"),
    "hash wrong": (UR5E_YAML.replace("calib_1", "1"), "expected hash: calib_"),
    "twice": (UR5E_YAML + "  shoulder: {x: 1}\n", "here and at line 2"),
    "calibration.conf": ("[mounting]\ndelta_theta = [0, 0, 0, 0, 0, 0]\n", "with ur_calibration"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_files_are_refused_and_named(tmp_path, case):
    text, expected = WRONG[case]
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        read_kinematics(text, path)
    assert expected in str(refused.value) and "wrong.yaml" in str(refused.value)


def test_a_refusal_ends_with_2_and_writes_nothing(tmp_path):
    (tmp_path / "k.yaml").write_text(DEGREES)
    ran = armcal("maker", tmp_path / "k.yaml", "--out", tmp_path / "arm.urdf")
    assert (ran.exit_code, (tmp_path / "arm.urdf").exists()) == (2, False)
    assert "k.yaml:" in ran.stderr and "Traceback" not in ran.output
    (tmp_path / "k.yaml").write_text(UR5E_YAML)
    assert armcal("maker", tmp_path / "k.yaml", "--out", tmp_path / "k.yaml").exit_code == 2
    (tmp_path / "arm.urdf").write_text("mine")
    assert armcal("maker", tmp_path / "k.yaml", "--out", tmp_path / "arm.urdf").exit_code == 2
    assert (tmp_path / "arm.urdf").read_text() == "mine"


def test_aliases_are_refused_before_they_grow(tmp_path: Path) -> None:
    lines = ["a0: &a0 {x: 1}", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9))]
    with pytest.raises(InputError, match=r"k\.yaml:7.*more than 1000000 values"):
        read(tmp_path, "\n".join([*lines, "kinematics: {shoulder: *a8}", ""]), "k.yaml")
