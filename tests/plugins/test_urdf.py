"""Arms from URDF files against pinocchio: kinematics, gravity, joints that follow others, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
import yaml
from armcal.arm.assembly import Arm
from armcal.arm.model import forward
from armcal.base.dataset import Dataset
from armcal.base.parameters import ParameterBlock, Parameters
from armcal.calibration.calibration_file import dump
from armcal.config.system import build_system
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, DataError
from armcal.measure.checks import layout_of, refuse_joint_units, warn_beyond_limits
from armcal.measure.reader import requested_channels
from armcal.plugins import discover
from armcal.run.experiment import Experiment
from armcal.run.plan import stated_beyond
from armcal_joints.effects import ServoMap
from armcal_urdf.model import UrdfModel, UrdfSettings
from armcal_urdf.robot import MAX_BYTES
from holding import holding_efforts
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

EXACT_M = 1e-12
GRAVITY = np.array([1.2, -0.7, -9.5])

ODD = """<?xml version="1.0"?>
<robot name="odd">
  <link name="world"/>
  <link name="pedestal"><inertial><mass value="30"/></inertial></link>
  <link name="upper">
    <inertial><origin xyz="0.02 -0.01 0.2" rpy="0.3 0.4 0.5"/><mass value="3.25"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
  </link>
  <link name="fore"><inertial><origin xyz="0.1 0 0"/><mass value="1.5"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <link name="rod"/> <link name="plate"/> <link name="tool"/>
  <link name="camera"><inertial><origin xyz="0 0.01 0.03"/><mass value="0.4"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <link name="lens"><inertial><origin xyz="0 0 0.05"/><mass value="0.2"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <joint name="stand" type="fixed">
    <origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/><parent link="world"/><child link="pedestal"/></joint>
  <joint name="turn" type="continuous">
    <origin rpy="1 2 3"/><parent link="pedestal"/><child link="upper"/><axis xyz="1 -2 0.5"/></joint>
  <joint name="bend" type="revolute">
    <origin xyz="0 0 0.4" rpy="0.1 0 0"/><parent link="upper"/><child link="fore"/>
    <limit lower="-1" upper="2" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic">
    <origin xyz="0.3 0 0"/><parent link="fore"/><child link="rod"/><axis xyz="0 3 4"/>
    <limit lower="-0.1" upper="0.2" effort="1" velocity="1"/></joint>
  <joint name="level" type="revolute">
    <origin xyz="0 0 0.1" rpy="0 0.7 0"/><parent link="rod"/><child link="plate"/><axis xyz="0 0 -1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/><mimic joint="bend" multiplier="-1.5" offset="0.25"/></joint>
  <joint name="flange" type="fixed"><origin xyz="0 0.02 0.1"/><parent link="plate"/><child link="tool"/></joint>
  <joint name="mast" type="fixed">
    <origin xyz="0.1 0 0.05" rpy="0 0.3 0.2"/><parent link="fore"/><child link="camera"/></joint>
  <joint name="focus" type="prismatic"><origin xyz="0 0.01 0" rpy="0.5 0 0"/><parent link="camera"/><child link="lens"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
</robot>
"""


def settings(text=ODD, **more):
    return UrdfSettings.model_validate({"text": text, "tip": "tool", **more})


def arm_of(text=ODD, **more):
    model = UrdfModel(settings(text, **more))
    return Arm("arm", "urdf", model, {}, tuple(model.masses()))


def frames_of(arm):
    """A function q (commands) -> tool and named frames, at nominal parameters."""
    told = ca.SX.sym("q", len(arm.commanded))
    moved = arm.joint_commands(ca.vertsplit(told))
    frames = forward(arm.nominal_chain, moved, {})
    poses = {"": frames.base_T_tool, **frames.named}
    function = ca.Function("f", [told], [ca.densify(pose.matrix()) for pose in poses.values()])
    return lambda q: dict(zip(poses, (np.array(m) for m in function.call([ca.DM(q)])), strict=True))


class Oracle:
    """Pinocchio's reading of the same URDF."""

    def __init__(self, pin, text):
        self.pin, self.model = pin, pin.buildModelFromXML(text)
        self.data = self.model.createData()

    def configuration(self, displacements):
        """All joints by name, others at zero."""
        q = self.pin.neutral(self.model)
        for name, value in displacements.items():
            joint = self.model.joints[self.model.getJointId(name)]
            two = joint.nq == 2
            q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if two else [value]
        return q

    def poses(self, displacements, links, root):
        self.pin.framesForwardKinematics(self.model, self.data, self.configuration(displacements))
        ids = {link: self.model.getFrameId(link, self.pin.FrameType.BODY) for link in (root, *links)}
        inverse = self.data.oMf[ids[root]].inverse()
        return {link: (inverse * self.data.oMf[ids[link]]).homogeneous for link in links}


def told(arm, q):
    """Displacements of all joints by name."""
    return dict(zip(arm.joint_names, arm.joint_commands(list(q)), strict=True))


def test_odd_axes_branches_and_followers_agree_with_pinocchio_in_1000_poses():
    pin = pytest.importorskip("pinocchio")
    arm, oracle, random = arm_of(), Oracle(pin, ODD), np.random.default_rng(1)
    assert arm.joint_names == ("turn", "bend", "slide", "level")
    assert dict(arm.commanded) == {"turn": "angle", "bend": "angle", "slide": "length"}
    frames = frames_of(arm)
    for q in random.uniform(-1, 1, (1000, 3)) * [6, 2, 0.3]:
        found = frames(q)
        expected = oracle.poses(told(arm, q), ["pedestal", "upper", "fore", "rod", "plate", "tool"], "world")
        for link, pose in expected.items():
            named = {"tool": "tool_link"}.get(link, link)
            np.testing.assert_allclose(found[named], pose, rtol=0, atol=EXACT_M)
        np.testing.assert_array_equal(found[""], found["tool_link"])
        np.testing.assert_array_equal(found["world"], np.eye(4))


def test_any_two_links_one_beyond_the_other_make_a_chain():
    pin = pytest.importorskip("pinocchio")
    arm, oracle = arm_of(root="upper", tip="rod"), Oracle(pin, ODD)
    assert arm.joint_names == ("bend", "slide")
    found = frames_of(arm)([0.7, 0.05])
    expected = oracle.poses({"turn": 2.0, "bend": 0.7, "slide": 0.05}, ["rod"], "upper")["rod"]
    np.testing.assert_allclose(found[""], expected, rtol=0, atol=EXACT_M)


@pytest.mark.quick("panda-ball_link")
@pytest.mark.parametrize(("name", "tip"), [("panda", "ball_link"), ("iiwa14", "ball_link"), ("gen3lite", "tool_frame")])
def test_measured_arms_agree_with_pinocchio_in_1000_poses(shared_data, name, tip):
    pin = pytest.importorskip("pinocchio")
    path = shared_data / "mukca" / "urdf" / f"{name}.urdf"
    if not path.is_file():
        pytest.skip(f"no {path}")
    model = UrdfModel(UrdfSettings.model_validate({"path": path, "tip": tip}))
    arm, oracle = Arm("arm", "urdf", model, {}, ()), Oracle(pin, path.read_text())
    frames, random = frames_of(arm), np.random.default_rng(2)
    low, high = np.array([joint.limits for joint in arm.nominal_chain.joints]).T
    for q in random.uniform(low, high, (1000, len(low))):
        pose = oracle.poses(told(arm, q), [tip], model.settings.root)[tip]
        np.testing.assert_allclose(frames(q)[""], pose, rtol=0, atol=EXACT_M)


def test_origins_are_fixed_axis_angles_and_derivatives_follow_them():
    """scipy's "xyz" (extrinsic) angles, away from the nominal ones."""
    model = UrdfModel(settings())
    rolled = {b.name: b.nominal[0] + 0.1 * (i % 5) for i, b in enumerate(model.parameters())}
    chain = model.chain({name: ca.SX(value) for name, value in rolled.items()})
    for i, joint in enumerate(("bend", "slide"), start=1):
        found = np.array(ca.DM(ca.densify(chain.joints[i].parent_T_joint.rotation)))
        angles = [rolled[f"{joint}_{angle}"] for angle in ("roll", "pitch", "yaw")]
        np.testing.assert_allclose(found, Rotation.from_euler("xyz", angles).as_matrix(), rtol=0, atol=1e-14)


def test_every_joint_on_the_chain_has_six_parameters_fixed_ones_too():
    blocks = {block.name: block for block in UrdfModel(settings()).parameters()}
    joints = ("stand", "turn", "bend", "slide", "level", "flange")
    assert set(blocks) == {f"{j}_{n}" for j in joints for n in ("x", "y", "z", "roll", "pitch", "yaw")}
    assert blocks["stand_pitch"].nominal == (-0.5,)
    assert blocks["stand_pitch"].unit == "rad"
    assert blocks["bend_z"].nominal == (0.4,)


UPRIGHT = ODD.replace('<origin xyz="0 0 0.4" rpy="0.1 0 0"/>', '<origin xyz="0 0 0.4" rpy="0.3 {} -0.4"/>')


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, 1.5707963, 1.45, -1.7])
def test_a_joint_pitched_by_a_right_angle_turns_in_all_three_directions(pitch):
    """At the format's own angles, roll and yaw would be one rotation there: gimbal lock."""
    pin = pytest.importorskip("pinocchio")
    text = UPRIGHT.format(pitch)
    arm, oracle = arm_of(text), Oracle(pin, text)
    found, expected = frames_of(arm)([0.3, 0.5, 0.1]), oracle.poses(told(arm, [0.3, 0.5, 0.1]), ["tool"], "world")
    np.testing.assert_allclose(found[""], expected["tool"], rtol=0, atol=EXACT_M)
    names = ("roll", "pitch", "yaw")
    angles = [ca.SX.sym(name) for name in names]
    blocks = {block.name: block.nominal[0] for block in arm.model.parameters()}
    nominal = [blocks[f"bend_{name}"] for name in names]
    values = {**blocks, **{f"bend_{name}": angle for name, angle in zip(names, angles, strict=True)}}
    rotation = ca.densify(arm.model.chain(values).joints[1].parent_T_joint.rotation)
    jacobian = ca.Function("j", angles, [ca.jacobian(rotation, ca.vertcat(*angles))])(*nominal)
    assert np.linalg.svd(np.array(jacobian), compute_uv=False)[-1] > 0.7


# Gravity


def test_holding_torques_agree_with_pinocchios_gravity_torques():
    """Branches at their zero; the payload-free arm of every link; the followed joint carries its follower's too."""
    pin = pytest.importorskip("pinocchio")
    arm, oracle, random = arm_of(), Oracle(pin, ODD), np.random.default_rng(3)
    oracle.model.gravity.linear = GRAVITY
    chain = arm.nominal_chain
    commands = random.uniform(-1, 1, (3, 50)) * np.array([[3], [1.5], [0.1]])
    found = holding_efforts(arm, commands, tuple(GRAVITY))
    for i in range(commands.shape[1]):
        q = oracle.configuration(told(arm, commands[:, i]))
        torques = pin.computeGeneralizedGravity(oracle.model, oracle.data, q)
        for row, name in zip(found, arm.commanded, strict=True):
            joint = oracle.model.joints[oracle.model.getJointId(name)]
            # What gravity does to a joint is the opposite of what holds it.
            assert -row[i] == pytest.approx(torques[joint.idx_v], abs=1e-10), name
    assert [joint.name for joint in chain.joints if joint.mimic] == ["level"]


def test_links_before_the_first_moving_joint_load_nothing_and_branches_ride_on_the_chain():
    masses = {mass.name: mass for mass in UrdfModel(settings()).masses()}
    assert set(masses) == {"upper", "fore", "camera", "lens"}
    assert masses["lens"].frame == masses["camera"].frame == masses["fore"].frame == "fore"
    assert UrdfModel(settings(inertials="ignore")).masses() == ()


def test_a_configured_link_takes_the_place_of_the_urdfs(tmp_path):
    (tmp_path / "arm.urdf").write_text(ODD)
    (tmp_path / "a.yaml").write_text(CONFIG.replace("LINKS", "{upper: {mass_kg: 5, com_mm: [0, 0, 9], frame: upper}}"))
    arm = build_system(load_config(tmp_path / "a.yaml"), discover()).arms["arm"]
    masses = {mass.name: mass for mass in arm.masses}
    assert masses["upper"].mass == 5
    assert masses["fore"].mass == 1.5
    assert len(arm.masses) == 4


def test_springs_bend_the_arm_by_compliance_times_pinocchios_torque(tmp_path):
    pin = pytest.importorskip("pinocchio")
    (tmp_path / "arm.urdf").write_text(ODD)
    (tmp_path / "a.yaml").write_text(CONFIG.replace("LINKS", "{}"))
    experiment = Experiment.load(tmp_path / "a.yaml")
    from armcal.problem.problem import Problem

    q = np.array([0.4, 0.3, 0.02])
    channels = {f"arm.{name}": np.array([x]) for name, x in zip(("turn", "bend", "slide"), q, strict=True)}
    records = Dataset(("1",), channels | {f"tracker.{axis}": np.zeros(1) for axis in "xyz"})
    system, parameters = experiment.system, experiment.parameters
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, records, "interpreted")
    values = parameters.nominal()
    values[parameters.entries_of("arm.spring.k2")] = 1e-6
    tip = -problem.of(records).residuals(values)[0][:, 0]
    arm, oracle = arm_of(), Oracle(pin, ODD)
    oracle.model.gravity.linear = np.array([0, 0, -9.81])
    index = oracle.model.joints[oracle.model.getJointId("bend")].idx_v
    torque = pin.computeGeneralizedGravity(oracle.model, oracle.data, oracle.configuration(told(arm, q)))[index]
    bent = told(arm, q) | {"bend": q[1] - 1e-6 * torque}
    np.testing.assert_allclose(tip, oracle.poses(bent, ["tool"], "world")["tool"][:3, 3], rtol=0, atol=1e-9)


CONFIG = """
arms:
  arm:
    model: {type: urdf, path: arm.urdf, tip: tool}
    effects: {spring: {type: torsional_spring, joints: [bend]}}
    links: LINKS
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
measurements: {tracker: {type: tip_position, noise_mm: 0.1}}
data: {type: csv, path: m.csv}
parameters: {free: [arm.spring.k2, arm.urdf.bend_z]}
"""


# Joints that follow others, limits, endless joints


def test_records_have_no_column_of_a_joint_that_follows():
    wanted = [channel.channel for channel in requested_channels({"arm": arm_of()}, {}, measured=False)]
    assert "arm.bend" in wanted
    assert "arm.level" not in wanted
    assert arm_of().joint_commands([0.1, 0.2, 0.3]) == [0.1, 0.2, 0.3, -1.5 * 0.2 + 0.25]
    assert arm_of().joint_approaches([1, 1, 0]) == [1, 1, 0, -1]


def test_a_joint_that_follows_a_follower_follows_the_first():
    text = ODD.replace('<axis xyz="0 3 4"/>', '<axis xyz="0 3 4"/><mimic joint="level" multiplier="2" offset="0.1"/>')
    joint = arm_of(text).nominal_chain.joints[2]
    assert joint.mimic.master == "bend"
    assert joint.mimic.multiplier == -3.0
    assert joint.mimic.offset == pytest.approx(0.6)


@pytest.mark.parametrize("master", ["focus", "stand", "nowhere"])
def test_a_joint_whose_master_is_not_on_the_chain_is_a_joint_of_its_own_and_that_is_said(master):
    arm = arm_of(ODD.replace('mimic joint="bend"', f'mimic joint="{master}"'))
    assert list(dict(arm.commanded)) == ["turn", "bend", "slide", "level"]
    (note,) = arm.model.settings.notes
    off = f"level follows {master}, which is no moving joint of the chain from world to tool"
    assert note == f"{off}: level needs angles of its own"


def test_records_beyond_limits_are_warned_of_by_joint_count_and_worst():
    channels = {"arm.turn": [0, 50.0, 0], "arm.bend": [0.0, 2.5, 2.0005], "arm.slide": [-0.3, 0.3, 0]}
    data = Dataset(("1", "2", "3"), {name: np.array(x, dtype=float) for name, x in channels.items()})
    (text,) = warn_beyond_limits(data, {"arm": arm_of()}, Parameters(())).warnings
    assert "bend is beyond its limits -57.3 to 114.6 deg in 1 of 3 records, at worst 143.2" in text
    assert "slide is beyond its limits -100 to 200 mm in 2 of 3 records, at worst -300" in text
    assert "level is beyond" in text
    assert "turn is" not in text
    assert text.endswith("check the joints' order, signs and units.")
    quiet = Dataset(("1",), {name: np.zeros(1) for name in channels})
    assert warn_beyond_limits(quiet, {"arm": arm_of()}, Parameters(())).warnings == ()


def beyond(stated: dict, arm: Arm | None = None, *known: ParameterBlock) -> tuple[str, ...]:
    system = SimpleNamespace(arms={"arm": arm or arm_of()})
    return stated_beyond(SimpleNamespace(system=system, parameters=Parameters(known)), stated)  # type: ignore[arg-type]


def test_stated_limits_beyond_the_models_are_told_by_joint():
    deg = np.pi / 180
    (text,) = beyond({"turn": (-7.0, 7.0), "bend": (-1.0, 114.5 * deg), "slide": (-0.1, 0.25)})
    assert "limits of slide, -100 to 250 mm, go beyond those of the arm's model, -100 to 200 mm" in text
    assert not beyond({"bend": (-57.33 * deg, 0.0)})  # rounded
    (text,) = beyond({"bend": (-179.8 * deg, 0.0)})
    assert "limits of bend, -179.8 to 0 deg, go beyond those of the arm's model, -57.3 to 114.6 deg" in text


def test_limits_are_those_of_commands_where_a_zero_is_known():
    """A joint that stands 60 deg beyond its command reaches its end stop so much before."""
    effect = ServoMap(ServoMap.Settings.model_validate({"joints": ["bend"], "gains": "one"}), arm_of().joint_names)
    arm, number = replace(arm_of(), effects={"zeros": effect}), effect.joints[0]
    zero = ParameterBlock(f"arm.zeros.offset{number}", "rad", (np.pi / 3,))
    assert not beyond({"bend": (-2.0, 0.9)}, arm, zero)
    assert "-117.3 to 54.59 deg" in beyond({"bend": (-1.5, 1.9)}, arm, zero)[0]
    commanded = {"arm.turn": [0.0, 0.0], "arm.bend": [-2.0, 1.9], "arm.slide": [0.0, 0.0]}
    data = Dataset(("1", "2"), {name: np.array(x) for name, x in commanded.items()})
    (text,) = warn_beyond_limits(data, {"arm": arm}, Parameters((zero,))).warnings
    assert "bend is beyond its limits -117.3 to 54.59 deg in 1 of 2 records, at worst 108.9" in text


def test_only_endless_joints_may_be_recorded_beyond_one_turn():
    wanted = requested_channels({"arm": arm_of()}, {}, measured=False)
    data = Dataset(("1",), {"arm.turn": np.array([40.0]), "arm.bend": np.zeros(1), "arm.slide": np.zeros(1)})
    layout = layout_of(wanted, data, {}, {}, by_line=False)
    refuse_joint_units(data, layout)
    turned = Dataset(("1",), {**data.channels, "arm.bend": np.array([40.0])})
    with pytest.raises(DataError, match="one turn"):
        refuse_joint_units(turned, layout)


# Names


def test_names_that_do_not_fit_are_made_to_fit_and_collisions_refused():
    text = ODD.replace('"bend"', '"bend.1 [a*]"')
    model = UrdfModel(settings(text))
    assert model.joint_names == ("turn", "bend_1__a__", "slide", "level")
    assert model.urdf_chain.joints[4].mimic.master == "bend_1__a__"
    with pytest.raises(ValidationError, match=r"'turn.1' and 'turn\*1' would both be called 'turn_1'"):
        settings(ODD.replace('"bend"', '"turn*1"').replace('"turn"', '"turn.1"'))


def test_what_other_programs_read_is_ignored_and_said():
    pin = pytest.importorskip("pinocchio")
    text = ODD.replace(
        '<robot name="odd">', '<robot name="odd" xmlns:drake="d">\n<xacro:property name="w" value=".2"/>'
    )
    text = text.replace('<axis xyz="0 3 4"/>', '<axis xyz="0 3 4" rpy="0 0 0"/>')
    text = text.replace('upper="0.2"', 'upper="0.2" drake:acceleration="5"').replace('"turn"', '"1"')
    model = UrdfModel(settings(text))
    assert model.settings.notes[0] == "ignored: <xacro:property>, rpy of <axis>, drake:acceleration"
    assert model.settings.notes[1] == "joints are named so that columns can be: 1 is joint_1"
    found = frames_of(arm_of(text))([0.3, 0.7, 0.05])
    arm = Arm("arm", "urdf", model, {}, ())
    displacements = {"1" if name == "joint_1" else name: q for name, q in told(arm, [0.3, 0.7, 0.05]).items()}
    expected = Oracle(pin, text.replace(' xmlns:drake="d"', "")).poses(displacements, ["tool"], "world")
    np.testing.assert_allclose(found[""], expected["tool"], rtol=0, atol=EXACT_M)
    with pytest.raises(ConfigError, match="this is xacro, not yet a URDF"):
        settings(text.replace('"0 0 0.4"', '"0 0 ${w}"'))


def test_the_tip_must_be_said_where_the_tree_ends_in_several():
    with pytest.raises(ValidationError, match="the tree ends in 2 links, lens, tool; say which is the tip"):
        UrdfSettings.model_validate({"text": ODD})
    assert settings(
        root="fore", tip="camera", text=ODD.replace('name="mast" type="fixed"', 'name="mast" type="revolute"')
    ).root
    with pytest.raises(ValidationError, match="tip: no link is called 'toolx'"):
        settings(tip="toolx")
    with pytest.raises(ValidationError, match="'world' is not beyond the root 'fore'"):
        settings(root="fore", tip="world")
    with pytest.raises(ValidationError, match="no joint between the links 'plate' and 'tool' moves"):
        settings(root="plate")


# The file, kept whole


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "iso-8859-1", "us-ascii"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_a_calibration_holds_the_file_byte_for_byte(tmp_path, encoding, newline):
    declared = "utf-8" if encoding == "utf-8-sig" else encoding
    special = "tab\t quotes '\" # : - \\n %" + ("" if encoding == "us-ascii" else " \x85 ä é")
    text = ODD.replace('<?xml version="1.0"?>', f'<?xml version="1.0" encoding="{declared}"?>')
    text = text.replace("<link name=", f"<!-- {special} -->\n\t <link name=", 3).replace("\n", newline) + newline * 2
    data = text.encode(encoding)
    (tmp_path / "arm.urdf").write_bytes(data)
    (tmp_path / "a.yaml").write_text(CONFIG.replace("LINKS", "{}"))
    system = build_system(load_config(tmp_path / "a.yaml"), discover())
    (tmp_path / "arm.urdf").unlink()
    (tmp_path / "kept.yaml").write_text(dump(system.description), encoding="utf-8", newline="")
    again = build_system(load_config(tmp_path / "kept.yaml"), discover())
    assert "path" not in system.description["arms"]["arm"]["model"]
    assert again.description == system.description
    kept = again.arms["arm"].model.settings
    assert kept.content == data
    assert kept.file == "arm.urdf"
    assert again.arms["arm"].joint_names == ("turn", "bend", "slide", "level")


@pytest.mark.parametrize("seed", range(3))
def test_any_text_survives_yaml(seed):
    random = np.random.default_rng(seed)
    signs = [
        "\n",
        "\r",
        "\r\n",
        "\t",
        " ",
        "  ",
        "\x85",
        "\u2028",
        "\ufeff",
        "é",
        "😀",
        "'",
        '"',
        "#",
        ": ",
        "- ",
        "a",
        "<",
        "\\",
    ]
    for _ in range(200):
        text = "".join(random.choice(signs, random.integers(1, 60)))
        assert yaml.safe_load(dump({"text": text}))["text"] == text


def test_faults_of_a_file_name_the_file_and_the_line(tmp_path):
    (tmp_path / "arm.urdf").write_text(ODD.replace('<axis xyz="0 3 4"/>', '\n<axis xyz="0 0 0"/>'))
    (tmp_path / "a.yaml").write_text(CONFIG.replace("LINKS", "{}"))
    with pytest.raises(ConfigError) as refused:
        build_system(load_config(tmp_path / "a.yaml"), discover())
    line = ODD[: ODD.index('<axis xyz="0 3 4"/>')].count("\n") + 2
    assert str(refused.value).startswith(f"{(tmp_path / 'arm.urdf').resolve()}:{line}: found an axis of length 0")


def test_files_that_cannot_be_read_are_refused(tmp_path):
    for name, content, match in (
        ("missing", None, "there is no such file"),
        ("large", b" " * (MAX_BYTES + 1), "larger than 256 KiB"),
        ("wide", '<?xml version="1.0"?><robot/>'.encode("utf-16"), "not well-formed XML"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ConfigError, match=match):
            UrdfSettings.model_validate({"path": tmp_path / name})
    with pytest.raises(ConfigError, match="it is a directory, expected a URDF file"):
        UrdfSettings.model_validate({"path": tmp_path})
    for given, match in (({}, "neither path nor text"), ({"text": ODD, "path": tmp_path / "x"}, "both path and text")):
        with pytest.raises(ValidationError, match=match):
            UrdfSettings.model_validate(given)
