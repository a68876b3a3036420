"""URDFs that are wrong: every one is refused with a message and its line, or read as pinocchio reads it."""

from __future__ import annotations

import re

import casadi as ca
import numpy as np
import pytest
from armcal.arm.model import forward
from armcal.cli.main import cli
from armcal.config.system import build_system
from armcal.config.yaml_source import load_config
from armcal.errors import EXIT_BAD_INPUT, EXIT_DONE, ArmcalError, ConfigError
from armcal.plugins import discover
from armcal_urdf.model import chain_of
from armcal_urdf.robot import read_robot
from click.testing import CliRunner

MUTANTS = 700
BASE = """<?xml version="1.0"?>
<robot name="base">
  <!-- a chain with everything in it -->
  <link name="base"/>
  <link name="one"><inertial><origin xyz="0 0 0.1"/><mass value="2"/></inertial></link>
  <link name="two"/>
  <link name='three'/>
  <link name="tool"/>
  <link name="side"><inertial><mass value="0.5"/></inertial></link>
  <joint name="j1" type="revolute">
    <origin xyz="0 0.1 0.3" rpy="0.1 0.2 0.3"/>
    <parent link="base"/>
    <child link="one"/>
    <axis xyz="0 0 1"/>
    <limit lower="-2.5" upper="2.5" effort="10" velocity="1"/>
  </joint>
  <joint name="j2" type="continuous">
    <origin xyz="0.25 0 0" rpy="-1.5 0 0"/>
    <parent link="one"/>
    <child link="two"/>
    <axis xyz="0 -3 4"/>
  </joint>
  <joint name="j3" type="prismatic">
    <origin rpy="0 1.25 0"/>
    <parent link="two"/>
    <child link="three"/>
    <axis xyz="1 0 0"/>
    <limit lower="0" upper="0.4" effort="10" velocity="1"/>
    <mimic joint="j1" multiplier="0.5" offset="-0.125"/>
  </joint>
  <joint name="j4" type="fixed">
    <origin xyz="0 0 0.05"/>
    <parent link="three"/>
    <child link="tool"/>
  </joint>
  <joint name="j5" type="fixed">
    <parent link="one"/>
    <child link="side"/>
  </joint>
</robot>
"""
CONFIG = """
arms:
  arm: {model: {type: urdf, path: arm.urdf, tip: tool}}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
measurements: {tracker: {type: tip_position, noise_mm: 0.1}}
data: {type: csv, path: m.csv}
parameters: {free: [arm.urdf.*_z]}
"""
ATTRIBUTE = re.compile(r""" \w+=("[^"]*"|'[^']*')""")
TAG = re.compile(r"<(?:link|joint|origin|axis|parent|child|limit|mimic|mass|inertial)\b[^>]*>")
NUMBER = re.compile(r"-?[0-9.]+(?=[\" ])")
NAME = re.compile(r"(?<=[\"'])(?:base|one|two|three|tool|side|j[1-5])(?=[\"'])")
ABSURD = (
    *("nan", "inf", "-Infinity", "1e999", "1e308", "-1e300", "1e9", "0x10", "1_0", "1,5", "1.2.3", "--1", "1e", "e5"),
    *(
        "",
        " ",
        "1 2",
        "0 0 0",
        "\u0661",
        "\uff11",
        "1\u00a02",
        "${pi/2}",
        "true",
        "1f",
        "+",
        ".",
        "1d3",
        "1e-400",
        "&#49;",
    ),
    *("&lol;", "&amp;", "<", "\0", "\x01", "1;2", "1\t2", "0" * 5000 + "1", "9" * 500),
)
INSERTED = (
    *('<!DOCTYPE robot [<!ENTITY a "b">]>', "<!-- -- -->", "<![CDATA[x]]>", "<?php echo 1 ?>", "]]>", "&x;", "</link>"),
    *("<origin/>", '<origin xyz="1 2 3"/>', "<joint/>", '<link name="new"/>', '<mimic joint="j2"/>', "\ufeff", "\0"),
    *('<axis xyz="0 1 0"/>', '<xacro:if value="1"/>', "<orgin/>", '<parent link="base"/>', "<a" * 3, "<z>" * 60),
)


def spans(pattern, text):
    return [match.span() for match in pattern.finditer(text)]


def mutant(random):
    """A base file with one thing done to it, or two."""
    data = BASE.encode()
    for _ in range(1 + (random.random() < 0.2)):
        data = mutated(data, random)
    return data


def mutated(data, random):
    text = data.decode("utf-8", "replace")

    def pick(pattern):
        found = spans(pattern, text) or [(0, 0)]
        return found[random.integers(len(found))]

    kind = random.integers(11)
    at = int(random.integers(len(data)))
    if kind == 0:
        return data[:at] + bytes([data[at] ^ (1 << int(random.integers(8)))]) + data[at + 1 :]
    if kind == 1:
        return data[:at] + bytes([int(random.integers(256))]) + data[at + 1 :]
    if kind == 2:
        return data[:at]
    if kind == 3:
        return data[:at] + data[at + int(random.integers(1, 40)) :]
    if kind in (4, 5):
        start, end = pick(ATTRIBUTE if kind == 4 else TAG)
        return (text[:start] + text[end:]).encode()
    if kind in (6, 7):
        start, end = pick(ATTRIBUTE if kind == 6 else TAG)
        return (text[:end] + text[start:end] + text[end:]).encode()
    if kind == 8:
        (start, end), (other, stop) = pick(NAME), pick(NAME)
        return (text[:start] + text[other:stop] + text[end:]).encode()
    if kind == 9:
        start, end = pick(NUMBER)
        return (text[:start] + ABSURD[random.integers(len(ABSURD))] + text[end:]).encode()
    start, end = pick(TAG)
    place = start if random.random() < 0.5 else end
    return (text[:place] + INSERTED[random.integers(len(INSERTED))] + text[place:]).encode()


@pytest.fixture(scope="module")
def registry():
    return discover()


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "a.yaml").write_text(CONFIG)
    rows = [f"{i},{0.1 * i:.1f},{0.2 * i:.1f},{i % 3},{i % 5},{i % 7}" for i in range(12)]
    (tmp_path / "m.csv").write_text("\n".join(["pose_id,j1_rad,j2_rad,x_mm,y_mm,z_mm", *rows]) + "\n")
    return tmp_path


def built(folder, data, registry):
    """The arm of a file, by way of a configuration."""
    (folder / "arm.urdf").write_bytes(data)
    return build_system(load_config(folder / "a.yaml"), registry).arms["arm"]


def poses(arm, commands):
    told = ca.SX.sym("q", len(arm.commanded))
    frames = forward(arm.nominal_chain, arm.joint_commands(ca.vertsplit(told)), {})
    tool = ca.Function("f", [told], [ca.densify(frames.base_T_tool.matrix())])
    return [np.array(tool(q)) for q in commands]


def expected(pin, arm, data, commands):
    """Pinocchio's poses of the same file, None if it refuses it."""
    try:
        model = pin.buildModelFromXML(data.decode())
    except (ValueError, RuntimeError, UnicodeDecodeError):
        return None
    cache, found = model.createData(), []
    chain, settings = arm.model.urdf_chain, arm.model.settings
    numbers = {re.sub(r"\s", " ", name): i for i, name in enumerate(model.names)}  # as XML has attributes read
    for q in commands:
        configuration = pin.neutral(model)
        for each, value in zip(chain.moving, arm.joint_commands(list(q)), strict=True):
            joint = model.joints[numbers[each.urdf.name]]
            told = [np.cos(value), np.sin(value)] if joint.nq == 2 else [value]
            configuration[joint.idx_q : joint.idx_q + joint.nq] = told
        pin.framesForwardKinematics(model, cache, configuration)
        ends = [cache.oMf[model.getFrameId(link, pin.FrameType.BODY)] for link in (settings.root, settings.tip)]
        found.append((ends[0].inverse() * ends[1]).homogeneous)
    return found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.slow
def test_mutants_are_refused_or_read_as_pinocchio_reads_them(folder, registry, seed):
    pin = pytest.importorskip("pinocchio")
    random, refused, compared = np.random.default_rng(seed), 0, 0
    for _ in range(MUTANTS // 4):
        data = mutant(random)
        try:
            arm = built(folder, data, registry)
        except ArmcalError as fault:
            assert str(fault)
            assert fault.exit_code == EXIT_BAD_INPUT
            assert fault.where is not None
            assert fault.where.line is not None, str(fault)
            refused += 1
            continue
        commands = random.uniform(-1, 1, (3, len(arm.commanded)))
        oracle = expected(pin, arm, data, commands)
        if oracle is not None:
            far = 1 + max(float(np.abs(pose[:3, 3]).max()) for pose in oracle)
            np.testing.assert_allclose(poses(arm, commands), oracle, rtol=0, atol=1e-12 * far, err_msg=data.decode())
            compared += 1
    assert refused > MUTANTS // 4 // 3
    assert compared > 10


@pytest.mark.parametrize("count", [12, pytest.param(40, marks=pytest.mark.slow)])
def test_a_sample_of_mutants_on_the_command_line(folder, count):
    """Exit code 0 or 2, one message and no traceback."""
    random, codes = np.random.default_rng(9), []
    for _ in range(count):
        (folder / "arm.urdf").write_bytes(mutant(random))
        ran = CliRunner().invoke(cli, ["check", str(folder / "a.yaml")])
        assert ran.exit_code in (EXIT_DONE, EXIT_BAD_INPUT), ran.output
        assert ran.exception is None or isinstance(ran.exception, SystemExit)
        assert "Traceback" not in ran.output
        codes.append(ran.exit_code)
    assert codes.count(EXIT_BAD_INPUT) > 10


REFUSED = {
    "a document type": (
        "<robot ",
        '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>\n<robot ',
        "document type (<!DOCTYPE r>)",
        2,
    ),
    "an external entity": (
        "<robot ",
        '<!DOCTYPE r SYSTEM "file:///etc/passwd"><robot ',
        "which could name files and entities",
        2,
    ),
    "an entity that is not known": ('"j1" type', '"&j;" type', "undefined entity", 10),
    "another root": ("robot", "sdf", "found <sdf> at the top, expected <robot>", 2),
    "xacro": ("<link name='three'/>", '<xacro:arm prefix=""/>', "this is xacro, not yet a URDF", 7),
    "an expression": ('"0 0.1 0.3"', '"0 ${d} 0.3"', "found '${d}' in <origin xyz=", 11),
    "two numbers": ('"0 0.1 0.3"', '"0 0.1"', 'found 2 in <origin xyz="0 0.1">, expected 3 numbers', 11),
    "a number that is none": ('"0 0.1 0.3"', '"0 0x1 0.3"', "found '0x1'", 11),
    "not finite": ('"0 0.1 0.3"', '"0 inf 0.3"', "found 'inf'", 11),
    "too large": ('"0 0.1 0.3"', '"0 1e7 0.3"', "expected a number of size 1e+06 at most", 11),
    "no axis": ('"0 0 1"', '"0 0 0"', "found an axis of length 0", 14),
    "an axis without numbers": ('<axis xyz="0 0 1"/>', "<axis/>", "found no attribute 'xyz' in <axis>", 14),
    "a twice named joint": ('"j2" type', '"j1" type', "the joint 'j1' stands twice", 17),
    "a twice named link": ("'three'", "'one'", "the link 'one' stands twice", 7),
    "an unknown parent": ('parent link="two"', 'parent link="tow"', "no link is called 'tow' (parent)", 23),
    "two parents": ('child link="side"', 'child link="two"', "the link 'two' has two parents", 36),
    "a loose link": (
        "<link name='three'/>",
        "<link name='three'/><link name='loose'/>",
        "2 links that no joint carries",
        7,
    ),
    "a circle": ('parent link="base"', 'parent link="tool"', "joints go round in a circle", 10),
    "self": ('mimic joint="j1"', 'mimic joint="j3"', "joint 'j3' follows itself", 29),
    "a floating joint": ('"j2" type="continuous"', '"j2" type="floating"', "joint 'j2' is floating, and stands", 17),
    "a planar joint": ('"j2" type="continuous"', '"j2" type="planar"', "joint 'j2' is planar, and stands", 17),
    "an unknown type": ('type="continuous"', 'type="Continuous"', "joint 'j2' has the type 'Continuous'", 17),
    "no type": (' type="continuous"', "", "found no attribute 'type' in <joint>", 17),
    "no parent": ('<parent link="base"/>', "", "found no <parent> in joint 'j1'", 10),
    "two origins": ('<axis xyz="0 0 1"/>', "<origin/>", "found <origin> twice in one <joint>", 14),
    "a misspelt origin": ("<origin rpy", "<orgin rpy", "found <orgin>, which nothing reads. Did you mean origin?", 24),
    "a capital": ("<origin rpy", "<Origin rpy", "Did you mean origin?", 24),
    "another attribute": (
        '<origin rpy="0 1.25 0"',
        '<origin quat_xyzw="0 0 0 1"',
        "found the attribute 'quat_xyzw'",
        24,
    ),
    "a misspelt limit": ('lower="-2.5"', 'lowr="-2.5"', "found the attribute 'lowr'", 15),
    "swapped limits": ('lower="-2.5"', 'lower="2.75"', "limits 2.75 and 2.5, expected the lower one first", 15),
    "a negative mass": ('value="2"', 'value="-2"', "found a mass of -2 kg", 5),
    "no mass": ('<mass value="0.5"/>', "", "found no <mass> in the <inertial> of link 'side'", 9),
    "a torn file": ("</robot>", "", "not well-formed XML", None),
    "nothing": (BASE, "", "not well-formed XML", None),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_is_said_with_its_line(case):
    old, new, match, line = REFUSED[case]
    assert old in BASE
    text = BASE.replace(old, new) if case == "another root" else BASE.replace(old, new, 1)
    with pytest.raises((ConfigError, ValueError)) as refused:
        chain_of(read_robot(text, "arm.urdf"), "base" if 'name="base"' in text else None, "tool")
    fault = refused.value
    assert isinstance(fault, ConfigError), fault
    assert match in fault.message + " " + fault.hint
    assert fault.where.file == "arm.urdf"
    if line is not None:
        assert fault.where.line == line, str(fault)


def test_a_lone_surrogate_is_refused():
    with pytest.raises(ValueError, match="surrogates not allowed"):
        read_robot(BASE.replace("chain", "\ud800"), "arm.urdf")


def test_what_is_not_ours_is_passed_over():
    extra = '<gazebo reference="one"><origin xyz="a"/></gazebo><transmission name="t"><joint name="j1"/></transmission>'
    text = BASE.replace("</robot>", f'{extra}<?pi x?><material name="m"/></robot>').replace(
        '<link name="two"/>', '<link name="two"><visual/><visual/><sensor/></link>'
    )
    assert set(read_robot(text, "").joints) == {"j1", "j2", "j3", "j4", "j5"}
