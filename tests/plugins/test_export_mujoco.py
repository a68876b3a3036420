"""The format mujoco: does MuJoCo's arm stand, and sag, where the calibrated arm does?"""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from armcal.calibration.exporter import random_commands, request_of, rigid_tools
from armcal.errors import InputError, ProblemError
from armcal_export import mujoco_model
from armcal_export.description import content_of
from armcal_export.mujoco_model import Hinge, LoadedModel, MujocoExporter, MujocoSettings, mjcf

from tests.made_calibrations import following_arm, made_calibration

CONFIGS = Path(__file__).parents[2] / "configs"
LRM = CONFIGS / "lrm_arm" / "arm.yaml"
PHYSICAL = tuple(f"arms.arm.links.link{i}.loads_up_to_joint=null" for i in (1, 3, 5))
FLEX = "arms.arm.effects={flex: {type: compliance, compliance_rad_per_Nm: 0.01}}"


@pytest.fixture(autouse=True)
def fewer_poses(monkeypatch):
    monkeypatch.setattr(mujoco_model, "POSES", 100)


def exported(config, *overrides, change=None, **settings):
    calibration = made_calibration(config, overrides)
    request = request_of(calibration, None)
    if change:
        request = replace(request, values={name: change(name, value) for name, value in request.values.items()})
    return MujocoExporter(MujocoSettings(**settings)).export(request), request, calibration


def loaded(found, request):
    return LoadedModel(found.content, content_of(request).rigid)


mujoco_only = pytest.mark.skipif(
    find_spec("mujoco") is None, reason="mujoco is not installed: pip install armcal[mujoco]"
)


@mujoco_only
@pytest.mark.parametrize("config", [LRM, CONFIGS / "mukca" / "panda.yaml"], ids=["mdh", "urdf"])
def test_the_rigid_arm_stands_where_it_should(config):
    found, request, _ = exported(config)
    model, commands = loaded(found, request), random_commands(request.arm, 50, 6)
    tools = np.array([model.rigid_tool(command) for command in commands.T])
    np.testing.assert_allclose(tools, rigid_tools(request.arm, request.values, commands), rtol=0, atol=1e-9)


@mujoco_only
def test_springs_about_joints_sag_as_the_calibrated_arm_does():
    """Masses on the joints that carry them, springs about own axes: nothing is left out, and nothing differs."""
    found, request, calibration = exported(LRM, *PHYSICAL)
    assert (found.left_out, found.changed > 50) == ((), True)
    model, commands = loaded(found, request), random_commands(request.arm, 30, 8)
    expected = calibration.forward(commands.T)
    tools = np.array([model.tool_at_rest(command) for command in commands.T])
    sag = np.linalg.norm(expected[:, :3, 3] - rigid_tools(request.arm, request.values, commands)[:, :3, 3], axis=1)
    assert sag.max() > 0.01
    np.testing.assert_allclose(tools, expected, rtol=0, atol=1e-9)


@mujoco_only
def test_compliances_in_all_directions_sag_to_second_order():
    """Three hinges along the principal axes turn as one rotation vector does, but for the square of the angle."""
    apart = []
    for scale in (0.1, 0.05):
        found, _, _ = exported(
            LRM, *PHYSICAL, FLEX, change=lambda name, value, s=scale: value * s if ".flex." in name else value
        )
        assert found.left_out == ("turns of second order in its springs",)
        apart.append(found.reach)
    assert apart[0] < 5e-4
    assert apart[1] == pytest.approx(apart[0] / 4, rel=0.35)


@mujoco_only
def test_what_is_left_out_is_named_and_measured():
    found, _, _ = exported(CONFIGS / "lrm_arm" / "best.yaml")
    assert found.left_out == (
        "servo", "lag", "play", "cubic", "what link1, link3, link5 load beyond the joints that carry them",
    )  # fmt: skip
    assert 1e-3 < found.reach < 0.2


@mujoco_only
def test_a_payload_hangs_on_the_tool_and_gravity_is_the_calibrated_one():
    overrides = ("statics.payload_g=150", "statics.gravity_m_s2=[1, 2, -9]", "statics.body=null")
    found, request, calibration = exported(LRM, *PHYSICAL, *overrides)
    model, commands = loaded(found, request), random_commands(request.arm, 20, 8)
    tools = np.array([model.tool_at_rest(command) for command in commands.T])
    np.testing.assert_allclose(tools, calibration.forward(commands.T), rtol=0, atol=1e-9)


@mujoco_only
def test_joints_that_slide_and_follow(tmp_path):
    found, request, calibration = exported(following_arm(tmp_path), "statics.force_N=[0, 0, 0]")
    assert found.left_out == ()
    model, commands = loaded(found, request), random_commands(request.arm, 20, 8)
    tools = np.array([model.tool_at_rest(command) for command in commands.T])
    np.testing.assert_allclose(tools, calibration.forward(commands.T), rtol=0, atol=1e-9)


@mujoco_only
def test_the_model_runs_and_comes_to_rest_near_the_calibrated_arm():
    """Drives of finite gain bend too: with a high gain little."""
    import mujoco

    found, request, calibration = exported(LRM, *PHYSICAL, gain=20000.0, damping=200.0)
    model = mujoco.MjModel.from_xml_string(found.content.decode())
    data = mujoco.MjData(model)
    command = np.array([0.3, 0.4, -0.5, 0.6, 0.2, 0.1])
    data.ctrl[:] = command
    data.qpos[[model.joint(name).qposadr[0] for name in request.arm.joint_names]] = command
    for _ in range(4000):
        mujoco.mj_step(model, data)
    assert np.abs(data.qvel).max() < 1e-3
    expected = calibration.forward(command)[0]
    np.testing.assert_allclose(data.site("tool").xpos, expected[:3, 3], rtol=0, atol=2e-4)


@mujoco_only
def test_an_arm_that_reads_back_differently_is_not_written(monkeypatch):
    whole = mujoco_model.mjcf
    with monkeypatch.context() as patch, pytest.raises(ProblemError, match="off the calibrated one"):
        patch.setattr(mujoco_model, "rigid_tools", lambda *given: rigid_tools(*given) + 1e-8)
        exported(LRM)
    monkeypatch.setattr(mujoco_model, "mjcf", lambda *a: whole(*a).replace(b"hinge", b"hunge"))
    with pytest.raises(ProblemError, match="does not take the model"):
        exported(LRM)


def test_names_of_a_urdf_stay_names_in_the_model():
    """Whatever XML lets a joint be called; MuJoCo need not be there."""
    request = request_of(made_calibration(CONFIGS / "mukca" / "panda.yaml"), None)
    arm, odd = content_of(request), "j<2>&\"'é"
    rigid = replace(arm.rigid, joints=(replace(arm.rigid.joints[0], name=odd), *arm.rigid.joints[1:]))
    springs, nothing = {1: [Hinge((0.0, 0.0, 1.0), False, 0.01)]}, (0.0, (0.0, 0.0, 0.0))
    model = ElementTree.fromstring(mjcf(replace(arm, name=odd, rigid=rigid), nothing, springs, MujocoSettings()))
    assert model.get("model") == odd
    names = [each.get("name") for each in model.iter("joint")]
    assert names[:2] == [odd, f"{odd}_spring1"]
    assert next(iter(model.find("actuator"))).get("joint") == odd


def test_without_mujoco_the_export_is_refused_with_the_way_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"pip install 'armcal\[mujoco\]'"):
        exported(LRM)


def test_joints_with_a_pitch_are_refused():
    with pytest.raises(ProblemError, match="has pitch"):
        exported(CONFIGS / "frida" / "twists_and_offsets.yaml")
