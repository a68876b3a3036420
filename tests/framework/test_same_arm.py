"""One arm in screws, rows and URDF: nominal forms stand alike, and calibrated on the same points they predict alike."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import frida
import numpy as np
import pytest
import yaml
from armcal.arm.model import Chain
from armcal.base.dataset import Dataset
from armcal.base.domains import ScrewAxis
from armcal.calibration.convert import load_source, mdh_section, nominal_values, poe_section, reload, urdf_text
from armcal.calibration.rigid_chain import numeric_chain, random_commands, rigid_chain, tool_poses
from armcal.estimate.estimator import estimate
from armcal.estimate.identifiability import identify
from armcal.plugins import discover
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment

LRM = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "arm.yaml"
REGISTRY = discover()
FORMS = ("poe", "mdh", "urdf")
TARGET = (0.02, -0.01, 0.03)
"""m: a point of the tool off the last axis, so that all of that axis moves it."""
NOISE_MM = 0.01
PRIOR = 0.1
POSES = 200
SAME_M = 1e-9


@cache
def nominal_chain(arm):
    if arm == "lrm":
        return load_source(LRM, None, REGISTRY).chain
    return reload(yaml.safe_dump({"model": {"type": "poe", **frida.model()}}), REGISTRY)


def section(arm, form):
    rigid = rigid_chain(nominal_chain(arm))
    if form == "urdf":
        return {"type": "urdf", "text": urdf_text(rigid, "arm")}
    return poe_section(rigid) if form == "poe" else mdh_section(rigid, "standard")


@dataclass(frozen=True)
class Form:
    """One form of an arm as an experiment in which every number of the geometry is free, under priors of 0.1 m and rad.

    The wide priors choose among what moves no point; what they cost in accuracy is below 1e-11 m.
    """

    experiment: Experiment
    name: str

    @classmethod
    def of(cls, arm, form, folder):
        content = {
            "arms": {"arm": {"model": section(arm, form)}},
            "measurements": {
                "tracker": {"type": "tip_position", "noise_mm": NOISE_MM, "target_mm": [1000 * x for x in TARGET]}
            },
            "statics": {"gravity_m_s2": [0, 0, -9.81], "payload_g": 0},
            "parameters": {"free": [f"arm.{form}.*"]},
        }
        path = folder / f"{arm}_{form}.yaml"
        path.write_text(yaml.safe_dump(content, sort_keys=False))
        return cls(Experiment.load(path), form)

    @property
    def model(self):
        return self.experiment.system.arms["arm"].model

    @property
    def nominal(self) -> Chain:
        return numeric_chain(self.model, nominal_values(self.model))

    def problem(self, data):
        experiment = self.experiment
        system, parameters = experiment.system, experiment.parameters
        held = {block.name: replace(block, prior_sd=PRIOR) for block in parameters.free}
        built = (system.arms, system.measurements, parameters.replaced(held), system.environment, data)
        problem = Problem.build(*built, "interpreted")
        return problem, problem.of(data).records

    def fit(self, data):
        problem, records = self.problem(data)
        solution = self.experiment.estimator.solve(problem.with_records(records), problem.parameters.nominal())
        return estimate(problem.with_records(records), solution)

    def chain(self, found) -> Chain:
        """As calibrated."""
        scope = f"arm.{self.name}."
        blocks = [b.name for b in found.parameters.blocks if b.name.startswith(scope)]
        values = {n.removeprefix(scope): found.values[found.parameters.entries_of(n)] for n in blocks}
        return numeric_chain(self.model, values)


def commands(arm, count, seed):
    return random_commands(rigid_chain(nominal_chain(arm)), count, seed)


def points(poses):
    """Where the target is (N x 3, m)."""
    return (poses @ np.array([*TARGET, 1.0]))[:, :3]


def pinocchio_poses(pin, text, q):
    """base_T_tool by pinocchio, from a URDF."""
    robot = pin.buildModelFromXML(text)
    data, tip = robot.createData(), robot.getFrameId("tip_link")
    found = []
    for angles in q:
        parts = []
        for joint, angle in zip(list(robot.joints)[1:], angles, strict=True):
            parts += [np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle]
        pin.framesForwardKinematics(robot, data, np.array(parts))
        found.append(data.oMf[tip].homogeneous)
    return np.array(found)


@cache
def true_chain(arm):
    """An arm beside the nominal one, in screws: every axis moved by up to a centimetre and 20 mrad, the tool too."""
    random = np.random.default_rng(7)
    chain = nominal_chain(arm)
    stated = poe_section(rigid_chain(chain))
    for joint in stated["joints"]:
        domain, axis, point = ScrewAxis(), np.array(joint["axis"]), np.array(joint["point_m"])
        twist = domain.retract(np.concatenate([axis, np.cross(point, axis)]), random.uniform(-0.01, 0.01, domain.dof))
        joint["axis"] = twist[:3].tolist()
        joint["point_m"] = np.cross(twist[:3], twist[3:]).tolist()
        joint["offset_rad"] = float(random.uniform(-0.02, 0.02))
    stated["tool"]["position_m"] = (np.array(stated["tool"]["position_m"]) + random.uniform(-0.01, 0.01, 3)).tolist()
    return reload(yaml.safe_dump({"model": stated}), REGISTRY)


@cache
def recorded(arm):
    """Exact points of the true arm."""
    q = commands(arm, POSES, 3)
    at = points(tool_poses(true_chain(arm), q))
    names = [joint.name for joint in nominal_chain(arm).joints]
    channels = {f"arm.{name}": q[:, i] for i, name in enumerate(names)}
    channels |= {f"tracker.{axis}": at[:, i] for i, axis in enumerate("xyz")}
    return Dataset(tuple(str(i) for i in range(POSES)), channels)


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["lrm", "frida"])
def test_the_nominal_forms_stand_where_pinocchio_puts_them(arm, tmp_path):
    pin = pytest.importorskip("pinocchio")
    q = commands(arm, 1000, 1)
    expected = pinocchio_poses(pin, section(arm, "urdf")["text"], q)
    for form in FORMS:
        found = tool_poses(Form.of(arm, form, tmp_path).nominal, q)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("arm", ["lrm", "frida"])
@pytest.mark.slow
def test_calibrated_on_the_same_points_all_forms_predict_the_same(arm, tmp_path):
    q = commands(arm, 10_000, 2)
    true, before = points(tool_poses(true_chain(arm), q)), points(tool_poses(nominal_chain(arm), q))
    assert np.linalg.norm(true - before, axis=1).mean() > 5e-3, "the truth is the nominal arm: the test is empty"
    ranks, predicted = {}, {}
    for form in FORMS:
        made = Form.of(arm, form, tmp_path)
        found = made.fit(recorded(arm))
        assert found.verdict.converged, form
        ranks[form] = found.identifiability.rank
        predicted[form] = points(tool_poses(made.chain(found), q))
        assert np.linalg.norm(predicted[form] - true, axis=1).max() < SAME_M, form
    for form in FORMS[1:]:
        assert np.linalg.norm(predicted[form] - predicted["poe"], axis=1).max() < SAME_M
    joints = len(nominal_chain(arm).joints)
    assert set(ranks.values()) == {4 * joints + 3}, "four numbers an axis, and the point"


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["lrm", "frida"])
def test_a_calibrated_form_written_as_a_urdf_predicts_the_same_by_pinocchio(arm, tmp_path):
    pin = pytest.importorskip("pinocchio")
    made = Form.of(arm, "mdh", tmp_path)
    chain = made.chain(made.fit(recorded(arm)))
    q = commands(arm, 1000, 4)
    there = points(pinocchio_poses(pin, urdf_text(rigid_chain(chain), "arm"), q))
    assert np.linalg.norm(there - points(tool_poses(true_chain(arm), q)), axis=1).max() < SAME_M


@pytest.mark.parametrize("arm", ["lrm", "frida"])
@pytest.mark.slow
def test_with_noise_the_forms_are_as_good_as_each_other(arm, tmp_path):
    """The same minimum but for priors: the same points left over, and the same rank, to the last thousandth."""
    data, random = recorded(arm), np.random.default_rng(9)
    noisy = {c: x + 1e-5 * random.normal(size=POSES) * c.startswith("tracker.") for c, x in data.channels.items()}
    q = commands(arm, 500, 5)
    predicted, scales = {}, []
    for form in FORMS:
        made = Form.of(arm, form, tmp_path)
        found = made.fit(replace(data, channels=noisy))
        predicted[form] = points(tool_poses(made.chain(found), q))
        scales.append(found.noise_scale)
    assert scales == pytest.approx([scales[0]] * 3, rel=1e-5)
    assert scales[0] == pytest.approx(1, abs=0.12)
    spread = np.linalg.norm(predicted["poe"] - points(tool_poses(true_chain(arm), q)), axis=1).mean()
    for form in FORMS[1:]:
        assert np.linalg.norm(predicted[form] - predicted["poe"], axis=1).max() < 1e-3 * spread


@pytest.mark.quick("mdh")
@pytest.mark.parametrize("form", FORMS)
def test_every_form_sees_as_much_at_its_nominal_values(form, tmp_path):
    """Where the point is off all axes the nominal arm is no special case."""
    problem, records = Form.of("frida", form, tmp_path).problem(recorded("frida"))
    assert identify(problem.with_records(records), problem.parameters.nominal()).rank == 4 * 7 + 3
