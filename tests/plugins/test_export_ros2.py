"""The format ros2: would ROS 2 take the file, and is it the calibrated arm?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.calibration.exporter import random_commands, request_of, rigid_tools
from armcal.errors import ConfigError, ProblemError
from armcal_export import ros2
from armcal_export.ros2 import Ros2Exporter, Ros2Settings, rebuilt_tools
from armcal_export.ros2_text import read_ros2, ros2_text

from tests.made_calibrations import made_calibration

CONFIGS = Path(__file__).parents[2] / "configs"
ALL = CONFIGS / "lrm_arm" / "best.yaml"
PANDA = CONFIGS / "mukca" / "panda.yaml"


def exported(config, *overrides, **settings):
    request = request_of(made_calibration(config, overrides), None)
    return Ros2Exporter(Ros2Settings(**settings)).export(request), request


@pytest.mark.parametrize("config", [ALL, PANDA], ids=["mdh", "urdf"])
def test_the_parameters_make_the_rigid_arm_again(config):
    found, request = exported(config)
    parameters = read_ros2(found.content.decode())["/**"]
    commands = random_commands(request.arm, 50, 4)
    tools = rebuilt_tools(parameters, commands)
    np.testing.assert_allclose(tools, rigid_tools(request.arm, request.values, commands), rtol=0, atol=1e-12)


def test_an_ordinary_yaml_reader_finds_the_same_numbers():
    found, request = exported(ALL, node="/arm_driver", namespace="left.arm")
    told = yaml.safe_load(found.content)["/arm_driver"]["ros__parameters"]["left"]["arm"]
    assert told["effects"]["servo"]["above1"] == request.values["arm.servo.above1"][0]
    assert told["effects"]["flex"]["C2_xy"] == request.values["arm.flex.C2"][1]
    assert told["links"]["holder"]["moved_by"] == "q6"
    own = request.values["arm.spring.k3"][0] + request.values["arm.flex.C3"][5]
    assert told["joints"]["q3"]["compliance"] == pytest.approx(own, rel=1e-12)
    assert told["digest"] == request.digest
    assert "lower" not in told["joints"]["q1"]


def test_limits_are_told_where_they_are_known():
    found, _ = exported(PANDA)
    parameters = read_ros2(found.content.decode())["/**"]
    assert parameters["joints.panda_joint4.upper"] == -0.0698


def walk(node, path=()):
    if isinstance(node, dict):
        for key, value in node.items():
            yield from walk(value, (*path, key))
    else:
        yield path, node


def test_every_value_is_of_a_type_that_ros_has():
    found, _ = exported(ALL)
    told = yaml.safe_load(found.content)
    for path, value in walk(told):
        assert all(isinstance(step, str) and step for step in path)
        entries = value if isinstance(value, list) else [value]
        assert entries, path
        assert len({type(each) for each in entries}) == 1, path
        assert all(isinstance(each, (bool, int, float, str)) for each in entries), path


@pytest.mark.parametrize(
    "value",
    [
        True,
        3,
        -1.5,
        1e-300,
        1e22,
        5e-324,
        "on",
        "0x1F",
        "1e5",
        "",
        'a: b # "c" \\ \n\té\u2028',
        [1.0, 2.0],
        ["1", "no"],
        [True],
    ],
)
def test_values_keep_their_type_and_their_last_bit(value):
    parameters = {"a.b": value, "yes": 1}
    again = read_ros2(ros2_text("/**", parameters, "a\nb"))
    assert again == {"/**": parameters}
    assert type(again["/**"]["a.b"]) is type(value)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("a: {ros__parameters: {x: null}}", "null"),
        ("a: {ros__parameters: {x: [[1.0]]}}", "list of lists"),
        ("a: {ros__parameters: {x: [1, 2.0]}}", "several types"),
        ("a: {ros__parameters: {x: []}}", "empty list"),
        ("a: {parameters: {x: 1}}", "expected ros__parameters"),
        ("a: {ros__parameters: {x: 1, x: 2}}", "twice"),
        ("a: 1", "no mapping"),
        ("", "no mapping"),
    ],
)
def test_what_ros_would_not_take_is_refused(text, match):
    with pytest.raises(ValueError, match=match):
        read_ros2(text)


@pytest.mark.parametrize(
    ("text", "value"),
    [("yes", True), ("0x10", 16), ("1", 1), ("1.", 1.0), (".inf", float("inf")), ("1e3", 1000.0), ("a", "a")],
)
def test_plain_words_are_typed_as_ros_types_them(text, value):
    found = read_ros2(f"a: {{ros__parameters: {{x: {text}}}}}")["a"]["x"]
    assert (found, type(found)) == (value, type(value))


def test_what_reads_back_differently_is_not_written(monkeypatch):
    def rounded(text):
        return {node: {**told, "tool.xyz": [0.0, 0.0, 0.0]} for node, told in read_ros2(text).items()}

    monkeypatch.setattr(ros2, "read_ros2", rounded)
    with pytest.raises(ProblemError, match="do not read back"):
        exported(PANDA)


def test_bad_names_are_refused():
    for settings in ({"node": "a b"}, {"node": "é"}, {"namespace": "a..b"}, {"namespace": "1"}, {"namespace": "a-b"}):
        with pytest.raises(ValueError):
            Ros2Settings(**settings)


def test_two_joints_of_one_name_are_refused():
    request = request_of(made_calibration(PANDA), None)
    told, rigid = ros2.describe(request), ros2.rigid_chain(ros2.chain_of(request))
    renamed = [j.model_copy(update={"name": n}) for j, n in zip(told.joints[:2], ("a-b", "a_b"), strict=True)]
    told = told.model_copy(update={"joints": [*renamed, *told.joints[2:]]})
    with pytest.raises(ConfigError, match=r"would be called 'joints\.a_b"):
        ros2._parameters(request, told, rigid)


def test_pulse_tables_and_settings_are_told_in_flat_lists():
    table = "arms.arm.effects.board={type: quantisation, tables: {q2: {angles_deg: [-90, 90], pulses_us: [600, 2400]}}}"
    found, _ = exported(CONFIGS / "lrm_arm" / "arm.yaml", table)
    parameters = read_ros2(found.content.decode())["/**"]
    assert found.left_out == ()
    assert parameters["joints.q2.servo.angles"] == pytest.approx([-np.pi / 2, np.pi / 2])
    assert parameters["joints.q2.servo.pulses"] == [0.0006, 0.0024]
    assert (parameters["effects.spring.type"], parameters["effects.spring.settings.base_axis"]) == (
        "torsional_spring", "y",
    )  # fmt: skip


def test_settings_that_ros_has_no_type_for_are_left_out():
    request = request_of(made_calibration(CONFIGS / "lrm_arm" / "arm.yaml"), None)
    description = {
        "effects": {"spring": {"type": "torsional_spring", "deep": {"a": 1}, "mixed": [1, "a"], "none": None}}
    }
    found = Ros2Exporter(Ros2Settings()).export(replace(request, description=description))
    assert found.left_out == ("deep of spring", "mixed of spring")
