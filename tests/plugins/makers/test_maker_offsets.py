"""Offsets of robot_calibration in a URDF's origins; a maker's URDF keeps all but its origins."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml
from armcal.calibration.convert_check import reload
from armcal.calibration.exporter import request_of
from armcal.calibration.rigid_chain import tool_poses
from armcal.cli.main import cli
from armcal.plugins import discover
from armcal_urdf.export import UrdfExporter, UrdfExportSettings
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from tests.made_calibrations import made_calibration
from tests.plugins.makers.maker_files import poses, shift, turn, without_origins, yaml_tip

ORIGINS = {
    "mount": ((0.1, 0, 0.2), (0, 0.3, 0)),
    "pan": ((0, 0.05, 0.1), (0.2, 0, 0.4)),
    "lift": ((0.3, 0, 0), (1.2, 0.1, 0)),
    "slide": ((0, 0.2, 0.1), (0, 0, 0.5)),
    "tip": ((0, 0, 0.1), (0, 0, 0)),
}
JOINT_OFFSETS = {"pan": 0.021, "lift": -0.013, "slide": 0.004}
LIFT = {"lift_x": 0.002, "lift_y": -0.001, "lift_z": 0.003, "lift_a": 0.01, "lift_b": -0.02, "lift_c": 0.005}
OFFSETS = {**JOINT_OFFSETS, **LIFT, "mount_x": 0.006, "mount_c": 0.011}
URDF = """<robot name="r">
  <link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="hand"/>
  <link name="eye"/><joint name="head" type="fixed"><parent link="base"/><child link="eye"/></joint>
"""
KINDS = {"mount": "fixed", "pan": "revolute", "lift": "revolute", "slide": "prismatic", "tip": "fixed"}
AXES = {"pan": "0 0 1", "lift": "0 1 0", "slide": "1 0 0"}


def urdf():
    links, text = ["base", "a", "b", "c", "d", "hand"], URDF
    for i, (name, (xyz, rpy)) in enumerate(ORIGINS.items()):
        numbers = [" ".join(map(repr, three)) for three in (xyz, rpy)]
        more = (
            f'<axis xyz="{AXES[name]}"/><limit lower="-1" upper="1" effort="1" velocity="1"/>' if name in AXES else ""
        )
        text += f'<joint name="{name}" type="{KINDS[name]}"><origin xyz="{numbers[0]}" rpy="{numbers[1]}"/>'
        text += f'<parent link="{links[i]}"/><child link="{links[i + 1]}"/>{more}</joint>\n'
    return text + "</robot>\n"


def tip(offsets, q):
    """Origin, frame's offset, joint at its angle and offset, one after another."""
    pose, angles = np.eye(4), iter(q)
    for name, (xyz, (roll, pitch, yaw)) in ORIGINS.items():
        pose = pose @ shift(*xyz) @ turn("z", yaw) @ turn("y", pitch) @ turn("x", roll)
        x, y, z, a, b, c = (offsets.get(f"{name}_{part}", 0.0) for part in "xyzabc")
        turned = np.eye(4)
        turned[:3, :3] = Rotation.from_rotvec((a, b, c)).as_matrix()
        pose = pose @ shift(x, y, z) @ turned
        if name in AXES:
            moved = next(angles) + offsets.get(name, 0.0)
            pose = pose @ (shift(moved, 0, 0) if name == "slide" else turn("z" if name == "pan" else "y", moved))
    return pose


def armcal(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def baked(folder, offsets, *more):
    (folder / "robot.urdf").write_text(urdf())
    (folder / "offsets.yaml").write_text("".join(f"{name}: {value}\n" for name, value in offsets.items()))
    return armcal("maker", folder / "offsets.yaml", "--urdf", folder / "robot.urdf", "--tip", "hand", *more)


@pytest.mark.slow
def test_the_urdf_with_offsets_is_the_arm_that_they_describe(tmp_path):
    ran = baked(tmp_path, OFFSETS, "--out", tmp_path / "new.urdf", "--json")
    assert ran.exit_code == 0, ran.output
    section = yaml.safe_dump({"model": {"type": "urdf", "text": (tmp_path / "new.urdf").read_text(), "tip": "hand"}})
    q = poses(1000, 3)
    expected = np.array([tip(OFFSETS, angles) for angles in q])
    assert np.abs(tool_poses(reload(section, discover()), q) - expected).max() < 1e-12
    said = json.loads(ran.stdout)
    assert (set(said["joints"]), said["unused"]) == ({"mount", "pan", "lift", "slide"}, [])
    assert said["joints"]["pan"]["turn_deg"] == pytest.approx(np.degrees(0.021))
    within = np.random.default_rng(3).uniform(-1, 1, (1000, 3))
    apart = [np.linalg.norm((tip(OFFSETS, angles) - tip({}, angles))[:3, 3]) for angles in within]
    assert said["median_mm"] == pytest.approx(1000 * np.median(apart), rel=0.05)


def test_offsets_of_others_are_listed(tmp_path):
    ran = baked(tmp_path, {"pan": 0.01, "head_x": 0.1, "camera_fx": 0.02})
    assert (ran.exit_code, "left out: camera_fx, head_x" in ran.stderr) == (0, True)


@pytest.mark.parametrize(
    ("offsets", "expected"),
    [
        ({"camera_fx": 0.1}, "none of a joint"),
        ({"pan": 2.5}, "looks like mm or degrees"),
        ({"pan": "high"}, "expected a number"),
        ({"pan": "{x: 1}"}, "found pan, expected kinematics"),
        ({}, "no keys"),
    ],
)
def test_wrong_offsets_are_refused(tmp_path, offsets, expected):
    ran = baked(tmp_path, offsets, "--out", tmp_path / "new.urdf")
    assert (ran.exit_code, (tmp_path / "new.urdf").exists()) == (2, False)
    assert expected in ran.stderr and "offsets.yaml" in ran.stderr


def test_offsets_without_their_urdf_are_named(tmp_path):
    baked(tmp_path, OFFSETS)
    ran = armcal("maker", tmp_path / "offsets.yaml")
    assert (ran.exit_code, "robot_calibration need the --urdf" in ran.stderr) == (2, True)
    assert baked(tmp_path, OFFSETS, "--robot", "ur5").exit_code == 2


PANDA = (
    (0, 0, 0.333, 0, 0, 0),
    (0, 0, 0, -np.pi / 2, 0, 0),
    (0, -0.316, 0, np.pi / 2, 0, 0),
    (0.0825, 0, 0, np.pi / 2, 0, 0),
    (-0.0825, 0.384, 0, -np.pi / 2, 0, 0),
    (0, 0, 0, np.pi / 2, 0, 0),
    (0.088, 0, 0, np.pi / 2, 0, 0),
)


def panda_urdf():
    """A Panda as Franka describes it, with made-up weights."""
    text = '<robot name="panda"><link name="panda_link0"/>\n'
    for i, row in enumerate(PANDA, start=1):
        xyz, rpy = (" ".join(repr(float(x)) for x in part) for part in (row[:3], row[3:]))
        text += (
            f'<link name="panda_link{i}"><inertial><origin xyz="0.01 0 {i / 100}"/><mass value="{i / 2}"/>'
            f'<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>\n'
            f'<joint name="panda_joint{i}" type="revolute"><origin rpy="{rpy}" xyz="{xyz}"/>'
            f'<parent link="panda_link{i - 1}"/><child link="panda_link{i}"/><axis xyz="0 0 1"/>'
            f'<limit effort="87" lower="{-2.0 - i / 10}" upper="{2.0 + i / 10}" velocity="2.175"/>'
            f'<dynamics damping="1.0"/></joint>\n'
        )
    return text + "</robot>\n"


def test_a_frankas_urdf_comes_back_with_limits_and_inertials_and_its_calibrated_arm(tmp_path):
    (tmp_path / "panda.urdf").write_text(panda_urdf())
    model = {"type": "urdf", "path": "panda.urdf"}
    config = {
        "arms": {"arm": {"model": model, "effects": {"spring": {"type": "torsional_spring"}}}},
        "measurements": {"t": {"type": "tip_position", "noise_mm": 1}},
        "statics": {"gravity_m_s2": [0, 0, -9.81], "payload_g": 0},
    }
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(config))
    request = request_of(made_calibration(tmp_path / "arm.yaml"), None)
    exported = UrdfExporter(UrdfExportSettings()).export(request)
    text = exported.content.decode()
    assert without_origins(text) == without_origins(panda_urdf()) and text != panda_urdf()
    keys = ("x", "y", "z", "roll", "pitch", "yaw")
    rows = [[float(request.values[f"arm.urdf.panda_joint{i}_{key}"][0]) for key in keys] for i in range(1, 8)]
    q = poses(1000, 7)
    section = yaml.safe_dump({"model": {"type": "urdf", "text": text}})
    expected = yaml_tip(rows, q)
    assert np.abs(tool_poses(reload(section, discover()), q) - expected).max() < 1e-12
    assert "spring" in exported.left_out
