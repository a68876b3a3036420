"""Calibrated origins written back: only their numbers change, and what is written is the calibrated arm."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml
from armcal.arm.assembly import Arm
from armcal.calibration.calibration import Calibration
from armcal.calibration.convert import reload
from armcal.calibration.exporter import ExportRequest, effects_reach, random_commands, request_of, rigid_tools
from armcal.calibration.rigid_chain import tool_poses
from armcal.cli.main import cli
from armcal.errors import ConfigError, ProblemError
from armcal.plugins import discover
from armcal.testing.planar import planar_arms
from armcal_urdf import export
from armcal_urdf.export import UrdfExporter, UrdfExportSettings
from armcal_urdf.model import UrdfModel, UrdfSettings
from armcal_urdf.robot import decode
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from tests.made_calibrations import made_calibration

STRANGE = """<?xml version="1.0"?>
<!-- <joint name="turn"><origin xyz="9 9 9"/></joint> -->
<robot name='strange'>
  <link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e > f"/>
  <joint name="turn" type="revolute"><!-- <origin xyz="8 8 8"/> -->
\t<origin   rpy = '0.10 0 -.5'
\t          xyz="1e-1  0.20\t3."  ></origin>
    <parent link="base"/><child link="a"/><axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/>
  </joint>
  <joint type="prismatic" name="bare">
    <parent link="a"/> <child link="b"/> <limit lower="-0.2" upper="0.4" effort="1" velocity="1"/>
  </joint>
  <joint name="half" type="continuous"><origin rpy="0.1 0.2 0.3"/><parent link="b"/><child link="c"/></joint>
  <joint name='empty &lt; "1"' type='fixed'><parent link="c"/><child link="d"/><origin/></joint>
  <joint name="far" type="fixed"><origin xyz="0 0 &#48;.1" rpy="1 2 3"/><parent link="d"/><child link="e > f"/></joint>
  <!-- é 😀 -->
</robot>

"""


def model_of(data, tip="e > f"):
    text, encoding = decode(data, "strange.urdf")
    return UrdfModel(UrdfSettings.model_validate({"text": text, "encoding": encoding, "tip": tip}))


def request_for(model, change):
    """The arm with every parameter changed by a function of its name and nominal value."""
    arm = Arm("arm", "urdf", model, {}, ())
    values = {b.name: np.array([change(b.name.removeprefix("arm.urdf."), b.nominal[0])]) for b in arm.parameters()}
    return ExportRequest("arm", arm, values)


def exported(data, change, **more):
    model = model_of(data)
    request = replace(request_for(model, change), **more)
    return UrdfExporter(UrdfExportSettings()).export(request), request


def random_change(seed):
    random = np.random.default_rng(seed)
    return lambda name, value: value + random.normal(0, 0.01)


SOURCES = {
    "as it is": STRANGE.encode(),
    "line ends of Windows": STRANGE.replace("\n", "\r\n").encode(),
    "a byte order mark": STRANGE.encode("utf-8-sig"),
    "Latin-1": STRANGE.replace(" 😀", "").replace("?>", " encoding='latin1'?>", 1).encode("latin1"),
}


@pytest.mark.parametrize("name", SOURCES)
def test_a_written_arm_reads_back_to_the_last_bit(name):
    found, request = exported(SOURCES[name], random_change(1))
    again = {f"arm.urdf.{b.name}": b.nominal[0] for b in model_of(found.content).parameters()}
    assert again == {name: float(value[0]) for name, value in request.values.items()}
    assert found.changed == 30
    commands = random_commands(request.arm)
    nominal = {name: np.array([value]) for name, value in again.items()}
    tools = [rigid_tools(request.arm, values, commands) for values in (request.values, nominal)]
    np.testing.assert_allclose(tools[0], tools[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("pitch", ["1.5707963267948966", "-1.5707963", "1.4"])
def test_a_joint_pitched_by_a_right_angle_is_written_in_the_formats_own_angles(pitch):
    data = STRANGE.replace('rpy="0.1 0.2 0.3"', f'rpy="0.1 {pitch} 0.3"').encode()
    assert exported(data, lambda name, value: value)[0].content == data
    found, request = exported(data, random_change(1))
    again = request_for(model_of(found.content), lambda name, value: value)
    commands = random_commands(request.arm)
    tools = [rigid_tools(each.arm, each.values, commands) for each in (request, again)]
    np.testing.assert_allclose(tools[0], tools[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", SOURCES)
def test_nothing_is_touched_where_nothing_changed(name):
    found, _ = exported(SOURCES[name], lambda name, value: value)
    assert found.content == SOURCES[name]
    assert found.changed == 0


@pytest.mark.parametrize("name", SOURCES)
def test_everything_but_origins_stays_byte_for_byte(name):
    """The file with its numbers put in by hand."""
    found, request = exported(SOURCES[name], random_change(2))

    def numbers(joint, names):
        return " ".join(repr(float(request.values[f"arm.urdf.{joint}_{each}"][0])) for each in names.split())

    def xyz(joint):
        return numbers(joint, "x y z")

    def rpy(joint):
        return numbers(joint, "roll pitch yaw")

    text, encoding = decode(SOURCES[name], "")
    gap = "\r\n    " if "\r" in text else "\n    "
    for old, new in (
        ('"1e-1  0.20\t3."', f'"{xyz("turn")}"'),
        ("'0.10 0 -.5'", f"'{rpy('turn')}'"),
        ('name="bare">', f'name="bare">{gap}<origin xyz="{xyz("bare")}" rpy="{rpy("bare")}"/>'),
        ('<origin rpy="0.1 0.2 0.3"/>', f'<origin xyz="{xyz("half")}" rpy="{rpy("half")}"/>'),
        ("<origin/>", f'<origin xyz="{xyz("empty____1_")}" rpy="{rpy("empty____1_")}"/>'),
        ('xyz="0 0 &#48;.1" rpy="1 2 3"', f'xyz="{xyz("far")}" rpy="{rpy("far")}"'),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    assert found.content == text.encode(encoding)


@pytest.mark.slow
def test_one_number_changes_one_number():
    for name, old, new in (
        ("turn_y", '"1e-1  0.20\t3."', '"1e-1 0.25 3."'),
        ("turn_roll", "'0.10 0 -.5'", "'0.25 0 -.5'"),
        ("half_yaw", '<origin rpy="0.1 0.2 0.3"/>', '<origin rpy="0.1 0.2 0.25"/>'),
        ("half_x", '<origin rpy="0.1 0.2 0.3"/>', '<origin xyz="0.25 0.0 0.0" rpy="0.1 0.2 0.3"/>'),
        ("empty____1__z", "<origin/>", '<origin xyz="0.0 0.0 0.25"/>'),
        ("far_x", '"0 0 &#48;.1"', '"0.25 0 0.1"'),
        ("bare_pitch", 'name="bare">\n', 'name="bare">\n    <origin rpy="0.0 0.25 0.0"/>\n'),
    ):
        assert STRANGE.count(old) == 1
        found, _ = exported(STRANGE.encode(), lambda each, value, name=name: 0.25 if each == name else value)
        assert found.content.decode() == STRANGE.replace(old, new), name
        assert found.changed == 1


@pytest.mark.parametrize("seed", range(20))
def test_numbers_of_any_size_read_back(seed):
    random = np.random.default_rng(seed)
    found, request = exported(
        STRANGE.encode(), lambda name, value: float(random.normal() * 10.0 ** random.integers(-300, 3))
    )
    again = [b.nominal[0] for b in model_of(found.content).parameters()]
    before = [b.nominal[0] for b in request.arm.model.parameters()]
    for now, was, value in zip(again, before, request.values.values(), strict=True):
        assert now == float(value[0]) or (now == was and abs(value[0] - was) <= 1e-13)


def test_what_reads_back_differently_is_not_written(monkeypatch):
    monkeypatch.setattr(export, "repr", lambda number: f"{number:.6f}", raising=False)
    with pytest.raises(ProblemError, match="off the calibrated arm"):
        exported(STRANGE.encode(), random_change(3))


def test_an_arm_of_another_model_is_refused():
    arm = planar_arms(["arm"])["arm"]
    request = ExportRequest("arm", arm, {b.name: np.array(b.nominal) for b in arm.parameters()})
    with pytest.raises(ConfigError, match="armcal convert"):
        UrdfExporter(UrdfExportSettings()).export(request)
    assert export.TOLERANCE_M <= 1e-9


# The command

CONFIG = """
arms:
  arm:
    model: {type: urdf, path: arm.urdf, tip: hand}
    effects: {spring: {type: torsional_spring, joints: [q2]}}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 500}
measurements: {tracker: {type: tip_position, noise_mm: 0.01}}
data: {type: csv, path: m.csv}
simulation:
  type: elastic_arm
  truth: truth.yaml
  poses: {kind: random, count: 60, levels_rad: {q1: [-2, 2], q2: [-1, 1]}, travel_mm: {q3: [0, 200]}}
parameters: {free: [arm.urdf.q2_x, arm.urdf.q3_y, arm.spring.k2]}
validation: {holdout: 0.2, folds: 0}
evaluator: interpreted
"""
ARM = b"""<?xml version='1.0'?>\r
<robot name="r">\r
  <link name="base"/><link name="column"/><link name="beam"/>\r
  <link name="hand"><inertial><mass value="2"/></inertial></link>\r
  <joint name="q1" type="revolute">\r
    <origin xyz="0 0 0.3"/><parent link="base"/><child link="column"/><axis xyz="0 0 1"/>\r
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>\r
  <joint name="q2" type="revolute">\r
    <parent link="column"/><child link="beam"/><axis xyz="0 1 0"/>\r
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>\r
  <joint name="q3" type="prismatic">\r
    <origin rpy="0 0.2 0" xyz="0.4 0 0"/><parent link="beam"/><child link="hand"/>\r
    <limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>\r
</robot>\r
"""


def armcal(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A calibrated arm: its run, and the URDF gone."""
    place = tmp_path_factory.mktemp("urdf")
    (place / "a.yaml").write_text(CONFIG)
    (place / "arm.urdf").write_bytes(ARM)
    (place / "truth.yaml").write_text("arm.urdf.q2_x: 2 mm\narm.urdf.q3_y: -1 mm\narm.spring.k2: 0.002 rad/Nm\n")
    for arguments in (
        ("simulate", place / "a.yaml", "--out", place / "m.csv"),
        ("run", place / "a.yaml", "--out", place / "run"),
    ):
        ran = armcal(*arguments)
        assert ran.exit_code == 0, ran.output
    (place / "arm.urdf").unlink()
    return place


@pytest.mark.slow
def test_a_calibration_is_exported_and_what_is_left_out_is_told(folder, tmp_path):
    out = tmp_path / "out.urdf"
    ran = armcal("export", folder / "run" / "calibration.yaml", "--format", "urdf", "--out", out, "--json")
    assert ran.exit_code == 0, ran.output
    told = json.loads(ran.stdout)
    assert told["changed"] == 2
    assert told["left_out"] == ["spring"]
    assert "left out, a urdf file cannot hold it: spring" in ran.stderr
    loaded = Calibration.load(folder / "run" / "calibration.yaml")
    shift, side = (loaded.parameters[f"arm.urdf.{name}"].nominal[0] for name in ("q2_x", "q3_y"))
    assert (shift, side) == (pytest.approx(2e-3, abs=1e-4), pytest.approx(-1e-3, abs=1e-4))
    q2 = b'name="q2" type="revolute">'
    expected = ARM.replace(q2, q2 + f'\r\n    <origin xyz="{shift!r} 0.0 0.0"/>'.encode())
    expected = expected.replace(b'"0.4 0 0"', f'"0.4 {side!r} 0"'.encode())
    assert out.read_bytes() == expected


def test_what_is_left_out_is_measured_against_the_elastic_arm(folder):
    """The largest bend: compliance times torque times lever, by hand and to first order."""
    loaded = Calibration.load(folder / "run" / "calibration.yaml")
    request = request_of(loaded, None)
    commands = random_commands(request.arm)
    compliance = loaded.parameters["arm.spring.k2"].nominal[0]
    reach = (0.4 + np.abs(commands[2])) * np.cos(commands[1] - 0.0)
    expected = np.max(compliance * 2.5 * 9.81 * reach * (0.4 + commands[2]))
    assert effects_reach(loaded, request) == pytest.approx(expected, rel=0.15)
    tools = loaded.forward(commands.T)
    apart = tools[:, :3, 3] - rigid_tools(request.arm, request.values, commands)[:, :3, 3]
    assert effects_reach(loaded, request) == pytest.approx(np.linalg.norm(apart, axis=1).max(), rel=1e-9)


@pytest.mark.slow
def test_files_are_overwritten_only_by_force_and_never_the_calibration(folder, tmp_path):
    calibration, out = folder / "run" / "calibration.yaml", tmp_path / "out.urdf"
    out.write_text("mine")
    for arguments, match in (
        (("--out", out), "it is there already"),
        (("--out", calibration, "--force"), "it is one of the inputs"),
        (("--out", tmp_path), "it is a directory"),
        (("--out", tmp_path / "no" / "x.urdf"), "it cannot be written"),
        (("--out", out, "--force", "--arm", "other"), "no arm is called 'other'"),
    ):
        ran = armcal("export", calibration, "--format", "urdf", *arguments)
        assert ran.exit_code == 2, ran.output
        assert match in ran.stderr
    assert out.read_text() == "mine"
    kept = calibration.read_bytes()
    ran = armcal("export", calibration, "--format", "urdf", "--out", out, "--force")
    assert ran.exit_code == 0, ran.output
    assert out.read_bytes().startswith(ARM[:60])
    assert calibration.read_bytes() == kept
    assert [path.name for path in tmp_path.iterdir()] == ["out.urdf"]


def test_formats_that_nobody_offers_are_refused(folder, tmp_path):
    ran = armcal("export", folder / "run" / "calibration.yaml", "--format", "urdff", "--out", tmp_path / "x")
    assert ran.exit_code == 2
    assert "Did you mean 'urdf'?" in ran.stderr


# Where the arm stands


def with_base(folder, free, truth, placement=""):
    """The arm with its base elsewhere in the tracker's frame: simulated, calibrated, exported."""
    config = CONFIG.replace("    effects: {spring: {type: torsional_spring, joints: [q2]}}\n", placement)
    config = config.replace("free: [arm.urdf.q2_x, arm.urdf.q3_y, arm.spring.k2]", f"free: [{free}]")
    (folder / "a.yaml").write_text(config)
    (folder / "arm.urdf").write_bytes(ARM)
    (folder / "truth.yaml").write_text(truth)
    for arguments in (
        ("simulate", folder / "a.yaml", "--out", folder / "m.csv"),
        ("run", folder / "a.yaml", "--out", folder / "run"),
        ("export", folder / "run" / "calibration.yaml", "--format", "urdf", "--force", "--out", folder / "out.urdf"),
    ):
        ran = armcal(*arguments)
        assert ran.exit_code == 0, ran.output
    return ran.stderr, (folder / "out.urdf").read_bytes()


def test_a_base_that_holds_the_trackers_frame_is_warned_of_with_its_amount(tmp_path):
    free = "arm.urdf.q1_x, arm.urdf.q1_yaw, arm.urdf.q2_x"
    told, _ = with_base(tmp_path, free, "arm.urdf.q1_x: 840 mm\narm.urdf.q1_yaw: 89 deg\narm.urdf.q2_x: 2 mm\n")
    assert "the first joint, q1, moved by 840 mm and turned by 89 deg against its URDF" in told
    assert "give the arm a placement" in told
    quiet, _ = with_base(tmp_path, free, "arm.urdf.q1_x: 2 mm\narm.urdf.q1_yaw: 1 deg\narm.urdf.q2_x: 2 mm\n")
    assert "moved by" not in quiet


def test_a_placement_stays_out_of_the_urdf_and_is_said(tmp_path):
    placement = "    placement: {position_mm: [0, 0, 0], rpy_deg: [0, 0, 0]}\n"
    free = "'arm.placement_*', arm.urdf.q2_x"
    yaw = np.radians(60) / 2
    truth = "arm.placement_x: 840 mm\narm.placement_z: -90 mm\narm.urdf.q2_x: 2 mm\n"
    truth += f"'arm.placement_rotation[w]': {np.cos(yaw)}\n'arm.placement_rotation[z]': {np.sin(yaw)}\n"
    told, content = with_base(tmp_path, free, truth, placement)
    assert re.search(r"in the measurement frame that base stands at x (839.99|840.00)\d, y", told)
    assert "yaw 60.0" in told and "up to 0.000" not in told and "left out" not in told
    assert content.count(b"<origin") == ARM.count(b"<origin") + 1
    assert b'<origin xyz="0 0 0.3"/>' in content


@pytest.mark.parametrize(
    ("moved_m", "words"),
    [
        (0.0384794, "(up to 38.5 mm, in"),
        (1.23e-7, "(up to 0.000123 mm, in"),
        (1e-16, "(which does not move the tool, in"),
        (None, "does not settle"),
    ],
)
def test_what_is_left_out_is_said_in_significant_digits(moved_m, words):
    from armcal.cli.calibration import _show_exported

    console, exported = MagicMock(), MagicMock(changed=2, left_out=("springs",), remarks=())
    _show_exported(console, MagicMock(), exported, moved_m, [Path("out.urdf")], "urdf")
    (said,) = console.warn.call_args.args
    assert words in said and "cannot hold it: springs" in said


def without_origins(text):
    """All of a URDF but the origins of its joints."""
    root = ElementTree.fromstring(text)
    for joint in root.iter("joint"):
        joint.find("origin").attrib.clear()
    return ElementTree.tostring(root)


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
    q, expected = np.random.default_rng(7).uniform(-np.pi, np.pi, (1000, 7)), np.eye(4)
    for i in range(1, 8):
        x, y, z, *angles = (float(request.values[f"arm.urdf.panda_joint{i}_{key}"][0]) for key in keys)
        origin, turns = np.eye(4), np.tile(np.eye(4), (len(q), 1, 1))
        origin[:3, :3], origin[:3, 3] = Rotation.from_euler("xyz", angles).as_matrix(), (x, y, z)
        turns[:, :3, :3] = Rotation.from_rotvec(np.outer(q[:, i - 1], (0, 0, 1))).as_matrix()
        expected = expected @ origin @ turns
    section = yaml.safe_dump({"model": {"type": "urdf", "text": text}})
    assert np.abs(tool_poses(reload(section, discover()), q) - expected).max() < 1e-12
    assert "spring" in exported.left_out
