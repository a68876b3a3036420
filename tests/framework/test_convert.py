"""Conversions between forms of one arm: exact against pinocchio, round and round, refused where they cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import frida
import numpy as np
import pytest
import yaml
from armcal.arm.model import forward
from armcal.base.quaternions import rpy_of
from armcal.calibration.convert import Difference, difference, load_source, mdh_section, poe_section, reload, urdf_text
from armcal.calibration.rigid_chain import largest_difference, random_commands, rigid_chain, tool_poses
from armcal.cli.main import cli
from armcal.errors import ConfigError, ProblemError
from armcal.plugins import discover
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

ROOT = Path(__file__).resolve().parents[2]
ARM = ROOT / "configs" / "lrm_arm" / "arm.yaml"
EXACT = 1e-12
REGISTRY = discover()
FORMS = ("poe", "mdh", "craig", "urdf")
Z, X = [0, 0, 1], [1, 0, 0]


def screw(kind, axis, *point, **more):
    return {"kind": kind, "axis": axis, **({"point_m": list(point)} if point else {}), **more}


DEGENERATE = {
    "joints": [
        screw("revolute", Z, 0, 0, 0, offset_deg=30),
        screw("revolute", Z, 0.3, 0, 0.1),  # parallel
        screw("revolute", [0, 0, -1], 0.5, 0.1, 0.2),  # antiparallel
        screw("prismatic", Z, offset_mm=50),  # along the one before
        screw("revolute", Z, 0.5, 0.1, 0.7),  # coincident with the one before but one
        screw("revolute", X, 0.5, 0.1, 0.6),  # intersecting
        screw("prismatic", X),  # parallel to the one before
        screw("revolute", [1, 1e-4, 0], 0.7, 0.3, 0.1),  # nearly parallel
        screw("revolute", [1, 1e-4, 1e-8], 0.7, 0.3, 0.2),  # more nearly
        screw("revolute", [-1, 1e-3, 2e-3], 0.6, 0.2, 0.2),  # nearly antiparallel
        screw("prismatic", [0.3, -0.2, 0.9]),  # skew
        screw("revolute", [0.2, 0.9, -0.1], 0.8, 0.1, 0.4),
    ],
    "tool": {"position_m": [0.9, 0, 0.3], "rpy_deg": [10, 90, 20]},
}


def loaded(section):
    return reload(yaml.safe_dump({"model": section}), REGISTRY)


def lrm_chain():
    return load_source(ARM, None, REGISTRY).chain


ARMS = {
    "lrm": lrm_chain,
    "frida": lambda: loaded({"type": "poe", **frida.model()}),
    "degenerate": lambda: loaded({"type": "poe", **DEGENERATE}),
}


def converted(chain, form):
    """The section of a form, from any chain."""
    rigid = rigid_chain(chain)
    if form == "urdf":
        return {"type": "urdf", "text": urdf_text(rigid, "arm")}
    if form == "poe":
        return poe_section(rigid)
    return mdh_section(rigid, "standard" if form == "mdh" else "craig")


def pinocchio_poses(pin, section, commands):
    """base_T_tool by pinocchio, from what was written and nothing else."""
    if section["type"] == "urdf":
        robot = pin.buildModelFromXML(section["text"])
        joints = [robot.joints[robot.getJointId(name)] for name in robot.names[1:]]
        columns = [
            c for q, j in zip(commands.T, joints, strict=True) for c in ((np.cos(q), np.sin(q)) if j.nq == 2 else (q,))
        ]
        data, tip = robot.createData(), robot.getFrameId("tip_link")
        found = []
        for q in np.array(columns).T.copy():
            pin.framesForwardKinematics(robot, data, q)
            found.append(data.oMf[tip].homogeneous)
        return np.array(found)
    robot, tool = (screws_in if section["type"] == "poe" else rows_in)(pin, section)
    data, found = robot.createData(), []
    for q in commands:
        pin.forwardKinematics(robot, data, q)
        found.append((data.oMi[robot.njoints - 1] * tool).homogeneous)
    return np.array(found)


def screws_in(pin, section):
    robot, joint, placed = pin.Model(), 0, pin.SE3.Identity()
    for stated in section["joints"]:
        axis = np.array(stated["axis"]) / np.linalg.norm(stated["axis"])
        kind = pin.JointModelRevoluteUnaligned if stated["kind"] == "revolute" else pin.JointModelPrismaticUnaligned
        here = pin.SE3(np.eye(3), np.array(stated["point_m"]))
        joint = robot.addJoint(joint, kind(axis), placed.inverse() * here, stated["name"])
        placed = here
    w, *xyz = section["tool"]["quaternion"]
    tool = pin.SE3(pin.Quaternion(w, *xyz).normalized().matrix(), np.array(section["tool"]["position_m"]))
    return robot, placed.inverse() * tool


def step(pin, key, value):
    """One elementary transform as a configuration writes it."""
    name, unit = key.split("_")
    axis = np.eye(3)["xyz".index(name[-1])]
    if unit == "mm":
        return pin.SE3(np.eye(3), axis * value / 1000)
    return pin.SE3(pin.AngleAxis(np.radians(value), axis).toRotationMatrix(), np.zeros(3))


def rows_in(pin, section):
    def steps(stated):
        here = pin.SE3.Identity()
        for one in stated:
            (key, value), *more = one.items()
            assert not more
            here = here * step(pin, key, value)
        return here

    robot, joint, pending = pin.Model(), 0, steps(section["base"])
    for name, row in zip(section["joints"], section["rows"], strict=True):
        pending = pending * steps(row.get("before", []))
        across = step(pin, "x_mm", row["a_mm"]) * step(pin, "rx_deg", row["alpha_deg"])
        along = step(pin, "z_mm", row["d_mm"]) * step(pin, "rz_deg", row["theta_deg"])
        kind = pin.JointModelPZ() if row.get("kind") == "prismatic" else pin.JointModelRZ()
        before, after = (pending, along * across) if section["convention"] == "standard" else (pending * across, along)
        joint = robot.addJoint(joint, kind, before, name)
        pending = after * steps(row.get("after", []))
    return robot, pending * steps(section["tool"])


@pytest.mark.quick("lrm-urdf")
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("arm", ARMS)
def test_every_form_of_an_arm_stands_where_the_arm_stands_by_pinocchio_too(arm, form):
    pin = pytest.importorskip("pinocchio")
    chain = ARMS[arm]()
    commands = random_commands(rigid_chain(chain), 10_000, 2)
    section = converted(chain, form)
    apart, angle = largest_difference(tool_poses(chain, commands), pinocchio_poses(pin, section, commands))
    assert apart < EXACT
    assert angle < EXACT


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.slow
def test_round_and_round_again_comes_back(arm):
    first = chain = ARMS[arm]()
    for form in ("poe", "urdf", "mdh", "craig", "urdf", "poe", "mdh"):
        chain = loaded(converted(chain, form))
        off = difference(first, chain)
        assert max(off.position_m, off.angle_rad) < EXACT
        assert off.poses == 10_000
        assert [joint.name for joint in chain.joints] == [joint.name for joint in first.joints]


def test_converted_twice_it_says_the_same():
    """Rows of rows are the same rows but for rounding: the common normals are found where they were put."""
    once = converted(ARMS["degenerate"](), "mdh")
    twice = converted(loaded(once), "mdh")
    for before, after in zip(once["rows"], twice["rows"], strict=True):
        assert before.keys() == after.keys()
        for key in ("alpha_deg", "theta_deg", "a_mm", "d_mm"):
            apart = before[key] - after[key]
            assert abs((apart + 180) % 360 - 180 if key.endswith("deg") else apart) < 1e-9


COMMON = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0.6, 0, 0.8), (1e-7, 0, 1), (0, 1, 1e-3)]
POINTS = st.sampled_from([0.0, 0.1, 0.25, -0.3])
AXES = st.one_of(st.sampled_from(COMMON), st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 0.1))


@st.composite
def arms(draw):
    """Arms whose axes meet, coincide and are parallel as often as not."""
    joints = []
    for _ in range(draw(st.integers(1, 6))):
        kind = draw(st.sampled_from(["revolute", "revolute", "prismatic"]))
        joints.append(screw(kind, list(draw(AXES)), *[draw(POINTS) for _ in range(3)]))
    angles = [draw(st.sampled_from([0.0, 90.0, -90.0, 180.0, 33.0])) for _ in range(3)]
    return {
        "type": "poe",
        "joints": joints,
        "tool": {"position_m": [draw(POINTS) for _ in range(3)], "rpy_deg": angles},
    }


@pytest.mark.slow
@pytest.mark.parametrize("examples", [8, pytest.param(40, marks=pytest.mark.slow)])
def test_any_arm_converts(examples):
    settings(max_examples=examples, deadline=None)(given(arms())(converts))()


def converts(section):
    chain = loaded(section)
    rigid = rigid_chain(chain)
    commands = random_commands(rigid, 100, 3)
    expected = tool_poses(chain, commands)
    for form in FORMS:
        again = tool_poses(loaded(converted(chain, form)), commands)
        assert max(largest_difference(expected, again)) < EXACT


def test_rows_are_plain_ones_unless_axes_are_nearly_parallel():
    rows = converted(ARMS["frida"](), "mdh")["rows"]
    assert all(row.keys() == {"alpha_deg", "theta_deg", "a_mm", "d_mm"} for row in rows)
    assert all(abs(row["alpha_deg"]) in (0.0, 90.0) for row in rows)
    turned = [i for i, row in enumerate(converted(ARMS["degenerate"](), "mdh")["rows"], 1) if "after" in row]
    assert turned == [7, 8, 9]


def test_a_small_correction_does_not_turn_rows_over():
    """The calibrated rows of an arm can be read beside its nominal ones."""
    moved = json.loads(json.dumps(frida.model()))
    random = np.random.default_rng(4)
    for joint in moved["joints"]:
        joint["axis"] = (np.array(joint["axis"]) + random.normal(size=3) * 1e-3).tolist()
        joint["point_m"] = (np.array(joint["point_m"]) + random.normal(size=3) * 1e-3).tolist()
    nominal, corrected = (converted(loaded({"type": "poe", **arm}), "mdh")["rows"] for arm in (frida.model(), moved))
    for before, after in zip(nominal, corrected, strict=True):
        for key in ("alpha_deg", "theta_deg"):
            assert abs((before[key] - after[key] + 180) % 360 - 180) < 2
        assert abs(before["a_mm"] - after["a_mm"]) < 10


def test_angles_of_a_rotation_are_exact_at_and_near_a_pitch_of_a_right_angle():
    random = np.random.default_rng(5)
    for pitch in (np.pi / 2, np.pi / 2 - 1e-9, -np.pi / 2 + 1e-6, 0.3):
        for roll, yaw in random.uniform(-3, 3, (50, 2)):
            rotation = turned("z", yaw) @ turned("y", pitch) @ turned("x", roll)
            r, p, y = rpy_of(rotation)
            np.testing.assert_allclose(turned("z", y) @ turned("y", p) @ turned("x", r), rotation, rtol=0, atol=2e-15)


def turned(axis, angle):
    i = "xyz".index(axis)
    j, k, m = (i + 1) % 3, (i + 2) % 3, np.eye(3)
    m[j, j] = m[k, k] = np.cos(angle)
    m[k, j], m[j, k] = np.sin(angle), -np.sin(angle)
    return m


def test_a_difference_is_seen_to_the_last_digits():
    pose = np.eye(4)[None]
    other = np.array(pose)
    other[0, :3, :3], other[0, 0, 3] = turned("x", 1e-11), 3e-13
    apart, angle = largest_difference(pose, other)
    assert apart == pytest.approx(3e-13)
    assert angle == pytest.approx(1e-11)
    other[0, :3, :3] = turned("y", np.pi)
    assert largest_difference(pose, other)[1] == pytest.approx(np.pi)


def test_loads_bend_the_converted_arm_as_they_bend_the_original(lrm):
    """Base spring, joint springs and masses at both ends: the screws carry what the rows carried."""
    import casadi as ca
    from armcal.arm.statics import Load, effort, wrenches

    chains = lrm_chain(), loaded(converted(lrm_chain(), "poe"))
    q = np.random.default_rng(6).uniform(-1, 1, 6)
    found = []
    for chain in chains:
        frames = forward(chain, [j.offset + a for j, a in zip(chain.joints, q, strict=True)], {})
        load = Load(ca.SX([1, 2, -9]), ca.SX(0.5), ca.SX([0.1, 0, 0]), ca.SX([1, 0, 2]), ca.SX([0.1, 0.2, 0.3]))
        carried = wrenches(chain, frames, [], load)
        efforts = [effort(j, frames.sites[i], carried[i]) for i, j in enumerate(chain.joints, 1)]
        at_mount = ca.mtimes(frames.sites[0].rotation.T, carried[0].moment)
        found.append(np.asarray(ca.evalf(ca.vertcat(*efforts, at_mount))).ravel())
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-14)


def full(*entries):
    """The Frida arm with six free numbers a joint, some of them other than nominal."""
    from armcal.calibration.rigid_chain import numeric_chain
    from armcal_poe.model import PoeModel, PoeSettings

    model = PoeModel(PoeSettings.model_validate(frida.model(parametrisation="full")))
    values = {block.name: np.array(block.nominal) for block in model.parameters()}
    for name, value in entries:
        values[name] = np.array([value])
    return numeric_chain(model, values)


@pytest.mark.parametrize("form", FORMS)
def test_a_pitch_or_a_scale_is_refused_by_name_and_size(form):
    """The second axis is y through (-0.03, 0, 0.11): v_y is its pitch, and w_y alone its scale with no pitch."""
    with pytest.raises(ProblemError, match=r"joint 2 \(q2\) has pitch 0.0005 m/rad and scale 1;"):
        converted(full(("twist2_vy", 0.0005)), form)
    with pytest.raises(ProblemError, match=r"joint 2 \(q2\) has no pitch and scale 1.001;"):
        converted(full(("twist2_wy", 1.001)), form)


@pytest.mark.parametrize("form", FORMS)
def test_a_twist_that_is_an_axis_converts_whatever_its_parametrisation(form):
    """Moved across itself (v_x, v_z) a twist is still an axis, but not where its frame stood."""
    chain = full(("twist2_vx", -0.115), ("twist2_vz", -0.04), ("offset3", 0.3))
    off = difference(chain, loaded(converted(chain, form)))
    assert max(off.position_m, off.angle_rad) < EXACT


URDF = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
<joint name="one" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
<limit lower="-0.25" upper="1.5" effort="1" velocity="1"/></joint>
<joint name="two" type="continuous"><origin xyz="0.1 0 0"/><parent link="b"/><child link="c"/>
<axis xyz="1 0 0"/>{mimic}</joint>
<joint name="three" type="prismatic"><origin xyz="0 0.2 0" rpy="0.1 0.2 0.3"/><parent link="c"/><child link="d"/>
<axis xyz="0 0 1"/><limit lower="0" upper="0.125" effort="1" velocity="1"/></joint></robot>"""


def test_limits_are_kept_in_a_urdf_and_poses_lie_within_them():
    chain = loaded({"type": "urdf", "text": URDF.format(mimic="")})
    again = loaded(converted(chain, "urdf"))
    assert [j.limits for j in again.joints] == [(-0.25, 1.5), None, (0.0, 0.125)]
    assert [j.endless for j in again.joints] == [False, True, False]
    commands = random_commands(rigid_chain(chain), 1000, 1)
    assert commands.min(axis=0) == pytest.approx([-0.25, -np.pi, 0.0], abs=0.02)
    assert commands.max(axis=0) == pytest.approx([1.5, np.pi, 0.125], abs=0.02)


def test_a_joint_that_follows_another_stays_so_in_a_urdf_and_is_refused_elsewhere():
    text = URDF.format(mimic='<mimic joint="one" multiplier="-0.5" offset="0.2"/>')
    chain = loaded({"type": "urdf", "text": text})
    mimic = loaded(converted(chain, "urdf")).joints[1].mimic
    assert (mimic.master, mimic.multiplier, mimic.offset) == ("one", -0.5, 0.2)
    for form in ("poe", "mdh"):
        with pytest.raises(ProblemError, match="joint two follows one"):
            converted(chain, form)


def armcal(*arguments):
    return CliRunner().invoke(cli, ["convert", *map(str, arguments)])


@pytest.mark.quick("mdh")
@pytest.mark.parametrize("form", ["poe", "mdh", "urdf"])
def test_the_command_writes_what_reads_as_the_same_arm(tmp_path, form):
    out = tmp_path / "converted"
    result = armcal(ARM, "--to", form, "--out", out)
    assert result.exit_code == 0
    assert "largest difference over 10000 poses: " in result.stdout
    assert "not converted: effects (spring); links (link1, " in result.stderr
    text = out.read_text()
    section = {"type": "urdf", "text": text} if form == "urdf" else yaml.safe_load(text)["model"]
    off = difference(lrm_chain(), loaded(section))
    assert max(off.position_m, off.angle_rad) < EXACT


@pytest.mark.slow
def test_the_mount_is_said_to_be_lost_where_it_is():
    assert "the mount" not in armcal(ARM, "--to", "poe").stderr
    assert "the mount" in armcal(ARM, "--to", "mdh").stderr


def test_masses_that_a_urdf_states_are_said_to_be_left(tmp_path):
    text = URDF.format(mimic="").replace(
        '<link name="b"/>', '<link name="b"><inertial><mass value="2"/></inertial></link>'
    )
    path = tmp_path / "arm.yaml"
    path.write_text(yaml.safe_dump({"arms": {"arm": {"model": {"type": "urdf", "text": text}}}}))
    told = armcal(path, "--to", "poe").stderr
    assert "not converted: masses (b); limits (one, three)" in told


def test_without_a_file_the_section_goes_to_standard_output_and_the_rest_does_not():
    result = armcal(ARM, "--to", "mdh", "--convention", "craig")
    assert yaml.safe_load(result.stdout)["model"]["convention"] == "craig"
    assert "largest difference" in result.stderr
    content = json.loads(armcal(ARM, "--to", "mdh", "--json").stdout)
    assert content["largest_position_m"] < EXACT
    assert content["largest_angle_rad"] < EXACT
    assert yaml.safe_load(content["text"])["model"]["type"] == "mdh"


def test_a_conversion_that_is_off_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr("armcal.cli.calibration.difference", lambda one, two: Difference(2e-9, 0.0, 10_000, True))
    result = armcal(ARM, "--to", "poe", "--out", tmp_path / "no.yaml")
    assert result.exit_code == 1
    assert "differs by up to 2.0e-09 m" in result.stderr
    assert not (tmp_path / "no.yaml").exists()


def test_a_file_with_an_arm_alone_is_enough_and_several_want_a_name(tmp_path):
    path = tmp_path / "two.yaml"
    arm = {"model": {"type": "poe", **frida.model()}}
    path.write_text(yaml.safe_dump({"arms": {"left": arm, "right": arm}}))
    assert armcal(path, "--to", "mdh", "--arm", "right").exit_code == 0
    for more, said in (((), "found the arms left, right"), (("--arm", "up"), "no arm is called 'up'")):
        result = armcal(path, "--to", "mdh", *more)
        assert result.exit_code == 2
        assert said in result.stderr
        assert "Traceback" not in result.output
    result = armcal(path, "--to", "mdh", "--arm", "left", "--out", path)
    assert result.exit_code == 2
    assert "it is one of the inputs" in result.stderr


@pytest.mark.parametrize("text", ["name: x\n", "arms: {}\n", "arms: {arm: {links: {}}}\n", "arms: {arm: 3}\n"])
def test_a_file_without_an_arm_is_refused(tmp_path, text):
    path = tmp_path / "none.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError):
        load_source(path, None, REGISTRY)


@pytest.mark.slow
def test_a_calibration_gives_its_calibrated_arm(demo_calibration, tmp_path):
    """The shipped demonstration, run and converted: not the nominal arm, and the one that predicts."""
    from armcal.calibration.calibration import Calibration

    path = demo_calibration
    assert armcal(path, "--to", "poe", "--out", tmp_path / "poe.yaml").exit_code == 0
    section = yaml.safe_load((tmp_path / "poe.yaml").read_text())["model"]
    off = difference(lrm_chain(), loaded(section))
    assert off.position_m > 1e-3
    calibration = Calibration.load(path, REGISTRY)
    arm, values = calibration.system.arms["arm"], calibration.parameters.nominal()
    named = {b.name: values[calibration.parameters.entries_of(b.name)] for b in calibration.parameters.blocks}
    own = arm.chain({name: _expression(value) for name, value in named.items()})
    off = difference(own, loaded(section))
    assert max(off.position_m, off.angle_rad) < EXACT


def _expression(value):
    import casadi as ca

    return ca.SX(ca.DM(value))
