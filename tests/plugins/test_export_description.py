"""The formats yaml and json: does the file alone make the arm again, and does it say what the calibration says?"""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.base.settings import Settings
from armcal.calibration.exporter import Origin, random_commands, request_of, rigid_tools
from armcal.errors import ProblemError
from armcal_export.description import SCHEMA_FILE, JsonExporter, YamlExporter
from scipy.linalg import expm

from tests.made_calibrations import following_arm, made_calibration

CONFIGS = Path(__file__).parents[2] / "configs"
EXPORTERS = {"yaml": YamlExporter, "json": JsonExporter}
ARMS = {
    "mdh, all effects": (CONFIGS / "lrm_arm" / "best.yaml", ()),
    "urdf": (CONFIGS / "mukca" / "panda.yaml", ()),
    "placed": (
        CONFIGS / "lrm_arm" / "arm.yaml",
        ("arms.arm.placement={position_mm: [300, 20, 5], rpy_deg: [10, 20, 30]}",),
    ),
}


def exported(kind, request):
    return EXPORTERS[kind](Settings()).export(request)


def request_for(name):
    config, overrides = ARMS[name]
    return request_of(made_calibration(config, overrides), None)


@pytest.mark.quick("mdh, all effects-json")
@pytest.mark.parametrize("kind", EXPORTERS)
@pytest.mark.parametrize("name", ARMS)
def test_the_file_alone_makes_the_rigid_arm_again(kind, name):
    """By matrix exponentials of the screws, as the file's own words say."""
    request = request_for(name)
    told = (yaml.safe_load if kind == "yaml" else json.loads)(exported(kind, request).content)
    commands = random_commands(request.arm, 20, 9)
    tools = rigid_tools(request.arm, request.values, commands)
    np.testing.assert_allclose(rebuilt_tools(told, commands), tools, rtol=0, atol=1e-12)


def rebuilt_tools(told, commands):
    """base_T_tool (N x 4 x 4) of a description at commands (commanded joints x N)."""
    names = [joint["name"] for joint in told["joints"] if joint["follows"] is None]
    tools = []
    for q in commands.T:
        given, pose = dict(zip(names, q, strict=True)), np.eye(4)
        for joint in told["joints"]:
            rotation, point = np.array(joint["base_T_joint"]["rotation"]), np.array(joint["base_T_joint"]["position_m"])
            axis, screw, follows = rotation @ joint["axis"], np.zeros((4, 4)), joint["follows"]
            screw[:3, :3] = np.cross(np.eye(3), axis)
            screw[:3, 3] = np.cross(point, axis) + joint["pitch"] * axis
            if joint["kind"] == "prismatic":
                screw[:3, :3], screw[:3, 3] = 0.0, axis
            command = given[follows["joint"] if follows else joint["name"]]
            command = follows["multiplier"] * command + follows["offset"] if follows else command
            pose = pose @ expm(screw * command * joint["scale"])
        last = np.eye(4)
        last[:3, :3], last[:3, 3] = told["base_T_tool"]["rotation"], told["base_T_tool"]["position_m"]
        tools.append(pose @ last)
    return np.array(tools)


def read_description(content):
    """As any program reads it."""
    return json.loads(content) if content.startswith(b"{") else yaml.safe_load(content)


def test_both_formats_say_the_same():
    request = request_for("mdh, all effects")
    assert read_description(exported("yaml", request).content) == read_description(exported("json", request).content)


def test_parameters_have_value_unit_and_deviation():
    request = request_for("mdh, all effects")
    told = read_description(exported("json", request).content)
    kept = {entry.name: (entry.unit, entry.value, entry.sd) for entry in request.entries}
    assert {p["name"]: (p["unit"], p["value"], p["sd"]) for p in told["parameters"]} == kept
    assert told["calibration"]["digest"] == request.digest
    (servo,) = [effect for effect in told["effects"] if effect["name"] == "servo"]
    assert (servo["type"], servo["settings"]["gains"]) == ("servo_map", "two")


def test_springs_and_masses_are_the_arms():
    request = request_for("mdh, all effects")
    told = read_description(exported("json", request).content)
    flex = {s["site"]: np.array(s["compliance"]) for s in told["springs"] if s["effect"] == "flex"}
    entries = request.values["arm.flex.C3"]
    np.testing.assert_array_equal(flex[3][np.triu_indices(3)], entries)
    assert all(s["linear"] for s in told["springs"] if s["effect"] in ("spring", "flex"))
    assert not any(s["linear"] for s in told["springs"] if s["effect"] in ("play", "cubic"))
    masses = {mass["name"]: mass for mass in told["masses"]}
    assert masses["link2"]["mass_kg"] == request.values["arm.links.link2.mass"][0]
    assert (masses["link1"]["moved_by"], masses["link1"]["loads_up_to"]) == (0, 1)
    tool, holder = told["base_T_tool"], masses["holder"]
    com = [request.values[f"arm.links.holder.com_{axis}"][0] for axis in "xyz"]
    expected = np.array(tool["rotation"]) @ com + tool["position_m"]
    np.testing.assert_allclose(holder["com_m"], expected, rtol=0, atol=1e-15)


def test_joints_that_follow_and_slide_and_turn_on_and_on(tmp_path):
    request = request_of(made_calibration(following_arm(tmp_path)), None)
    told = read_description(exported("yaml", request).content)
    assert [j["kind"] for j in told["joints"]] == ["revolute", "prismatic", "revolute", "revolute"]
    assert told["joints"][2]["follows"]["joint"] == "turn"
    assert told["joints"][3]["endless"] and told["joints"][3]["lower"] is None
    commands = random_commands(request.arm, 50, 2)
    tools = rebuilt_tools(told, commands)
    np.testing.assert_allclose(tools, rigid_tools(request.arm, request.values, commands), rtol=0, atol=1e-12)


def conforms(value, schema, whole, where="description"):
    """What of JSON schema the shipped one uses."""
    if "$ref" in schema:
        return conforms(value, whole["$defs"][schema["$ref"].rpartition("/")[2]], whole, where)
    if "anyOf" in schema:
        assert any(fits(value, one, whole) for one in schema["anyOf"]), where
        return None
    kinds = {
        "object": dict,
        "array": list,
        "string": str,
        "number": float,
        "integer": int,
        "boolean": bool,
        "null": type(None),
    }
    if "type" in schema:
        assert type(value) is kinds[schema["type"]], (where, value)
    assert value == schema.get("const", value) and value in schema.get("enum", [value]), (where, value)
    if isinstance(value, dict):
        known, more = schema.get("properties", {}), schema.get("additionalProperties")
        assert set(schema.get("required", ())) <= set(value) and (more is not False or set(value) <= set(known)), where
        for name, own in value.items():
            conforms(own, known.get(name, more if isinstance(more, dict) else {}), whole, f"{where}.{name}")
    if isinstance(value, list):
        assert schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value)), where
        for own in value:
            conforms(own, schema.get("items", {}), whole, f"{where}[]")
    return None


def fits(value, schema, whole):
    try:
        conforms(value, schema, whole)
    except AssertionError:
        return False
    return True


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("kind", EXPORTERS)
def test_files_are_as_the_shipped_schema_says(name, kind):
    shipped = json.loads(resources.files("armcal_export").joinpath(SCHEMA_FILE).read_bytes())
    found = exported(kind, request_for(name))
    told = read_description(found.content)
    conforms(told, shipped, shipped)
    assert json.loads(found.companions[SCHEMA_FILE]) == shipped
    assert all(part["additionalProperties"] is False for part in (shipped, *shipped["$defs"].values()))
    for damage in (
        lambda told: told.pop("joints"),
        lambda told: told["joints"][0].update(extra=1),
        lambda told: told["joints"][0].update(axis=[0.0, 0.0]),
        lambda told: told["joints"][0].update(scale="1"),
        lambda told: told.update(armcal_arm=2),
        lambda told: told["statics"].update(gravity_m_s2=[0.0, 0.0, None]),
    ):
        spoilt = json.loads(json.dumps(told))
        damage(spoilt)
        assert not fits(spoilt, shipped, shipped)


def test_what_reads_back_as_another_arm_is_not_written(monkeypatch):
    def rounded(self, content):
        told = json.loads(content)
        told["joints"][2]["base_T_joint"]["position_m"][0] += 1e-9
        return told

    monkeypatch.setattr(JsonExporter, "read", rounded)
    with pytest.raises(ProblemError, match="not the calibrated arm to the last digit"):
        exported("json", request_for("urdf"))


@pytest.mark.parametrize("kind", EXPORTERS)
def test_texts_of_any_kind_survive(kind):
    request = replace(request_for("urdf"), origin=Origin("a: [b] # c\n\u2028\x85 'é' \"", "no", {"on": "1e5"}, {}))
    told = read_description(exported(kind, request).content)
    assert (told["calibration"]["experiment"], told["calibration"]["created"]) == (request.origin.experiment, "no")
    assert told["calibration"]["software"] == {"on": "1e5"}
