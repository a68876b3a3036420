"""Poses of a body on the tool: the residual against scipy's rotations, its derivatives, and a calibration by it."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from armcal.arm.assembly import ArmState
from armcal.base import se3
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.estimate.simulation import SimulationRequest, measured_without_noise
from armcal.run.experiment import Experiment, PlanSettings
from armcal.run.pipeline import calibrate
from armcal.run.plan import JointSpace, PlanContext
from armcal_tracker.position import TipPose, TipPoseSettings
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

NAMES = ("qw", "qx", "qy", "qz")
TURN = (0.8, 0.0, 0.6, 0.0)


def log_function():
    matrix = ca.SX.sym("matrix", 3, 3)
    return ca.Function("log", [matrix], [se3.rotation_vector(matrix)])


def log_of(vectors):
    function = log_function()
    return np.array([np.array(function(Rotation.from_rotvec(v).as_matrix())).ravel() for v in vectors])


def directions(count, seed=1):
    found = np.random.default_rng(seed).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1)[:, None]


@pytest.mark.parametrize(
    ("angle", "allowed"),
    [
        (0.0, 1e-29),
        (1e-12, 1e-27),
        (1e-6, 1e-21),
        (0.3, 1e-15),
        (np.pi / 2, 3e-15),
        (3.0, 3e-14),
        (np.pi - 1e-3, 3e-12),
        (np.pi - 1e-6, 3e-9),
    ],
)
def test_the_rotation_vector_is_scipys_up_to_half_a_turn(angle, allowed):
    vectors = angle * directions(200)
    np.testing.assert_allclose(log_of(vectors), vectors, rtol=0, atol=allowed)


def test_half_a_turn_exactly_is_finite_and_no_less_than_half_a_turn():
    for diagonal in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        found = np.array(log_function()(np.diag(diagonal))).ravel()
        assert np.linalg.norm(found) == pytest.approx(np.pi)


@pytest.mark.parametrize("at", [(0, 0, 0), (1e-9, 0, 0), (0.3, -0.4, 0.5), (1.0, 0.9, 0.8)])
def test_the_rotation_vectors_derivatives_at_zero_near_a_right_angle_and_between(at):
    """The logarithm undoes the exponential, so the derivative of both together is one and the second one is zero."""
    vector = ca.SX.sym("vector", 3)
    there_and_back = se3.rotation_vector(se3.small_rotation(vector))
    if np.linalg.norm(at) > 1:  # beyond the power series
        length = ca.norm_2(vector)
        there_and_back = se3.rotation_vector(se3.rotation_about_unit(vector / length, length))
    slope = ca.jacobian(there_and_back, vector)
    first = ca.Function("first", [vector], [ca.densify(slope)])(at)
    second = ca.Function("second", [vector], [ca.densify(ca.jacobian(ca.vec(slope), vector))])(at)
    np.testing.assert_allclose(np.array(first), np.eye(3), rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.array(second), 0, rtol=0, atol=1e-12)


def residual_function(**settings):
    """(tool position, tool quaternion, x y z qw qx qy qz, parameters) to residual and outputs."""
    measurement = TipPose(TipPoseSettings.si(noise=1e-3, orientation_noise=1e-3, **settings), ("arm",))
    place, turn, read = ca.SX.sym("place", 3), ca.SX.sym("turn", 3, 3), ca.SX.sym("read", 7)
    arms = {"arm": ArmState(se3.Transform(turn, place), {}, ca.SX(0, 1))}
    values = {block.name: ca.SX.sym(block.name, block.size) for block in measurement.parameters()}
    names = ("x", "y", "z", *NAMES)
    residual = measurement.residual(arms, {name: read[i] for i, name in enumerate(names)}, values)
    outputs = measurement.outputs(arms, values)
    shown = ca.vertcat(*[outputs[name] for name in names])
    function = ca.Function("f", [place, turn, read, ca.vertcat(*values.values())], [residual, shown])
    nominal = Parameters(measurement.parameters()).nominal()
    return lambda place, turn, read: [np.array(x).ravel() for x in function(place, turn.as_matrix(), read, nominal)]


def test_the_residual_is_position_and_scipys_rotation_from_predicted_to_measured():
    random, body = np.random.default_rng(2), Rotation.from_quat([*TURN[1:], TURN[0]])
    function = residual_function(target=(0.1, 0.02, -0.03), target_rotation=TURN)
    for _ in range(200):
        tool, measured = Rotation.random(random_state=random), Rotation.random(random_state=random)
        place, read = random.normal(size=3), random.normal(size=3)
        x, y, z, w = measured.as_quat()
        residual, shown = function(place, tool, [*read, w, x, y, z])
        predicted = tool * body
        position = place + tool.apply([0.1, 0.02, -0.03])
        np.testing.assert_allclose(residual[:3], read - position, rtol=0, atol=1e-14)
        np.testing.assert_allclose(residual[3:], (predicted.inv() * measured).as_rotvec(), rtol=0, atol=1e-10)
        np.testing.assert_allclose(shown[:3], position, rtol=0, atol=1e-14)
        assert shown[3] >= 0
        away = Rotation.from_quat([*shown[4:], shown[3]]).inv() * predicted
        assert away.magnitude() < 1e-14


def test_neither_sign_nor_length_of_a_quaternion_matters_and_outputs_leave_no_residual():
    function, tool = residual_function(), Rotation.from_rotvec([2.0, -1.0, 0.5])
    _, shown = function(np.ones(3), tool, [1.0, 1, 1, 1, 0, 0, 0])
    for factor in (1.0, -1.0, 0.999, -1.001):
        residual, _ = function(np.ones(3), tool, [*shown[:3], *(factor * shown[3:])])
        np.testing.assert_allclose(residual, 0, rtol=0, atol=1e-14)


def test_settings_noise_channels_and_dimensions():
    measurement = TipPose(TipPoseSettings(noise_mm=[1, 2, 3], orientation_noise_mrad=4), ("arm",))
    assert measurement.noise() == (0.001, 0.002, 0.003, 0.004, 0.004, 0.004)
    assert measurement.dimensions() == ("length",) * 3 + ("angle",) * 3
    first, last = measurement.noise_channels()[0], measurement.noise_channels()[-1]
    assert [(c.name, c.dimension) for c in first] == [("noise_x", "length"), ("noise", "length")]
    assert [(c.name, c.dimension) for c in last] == [("noise_rz", "angle"), ("noise_rotation", "angle")]
    assert [block.name for block in measurement.parameters()] == ["target_x", "target_y", "target_z", "target_rotation"]
    assert TipPoseSettings.si(noise=1, orientation_noise=1, target_rotation=(0.8001, 0, 0.6, 0)).target_rotation[
        0
    ] == pytest.approx(0.8001 / np.hypot(0.8001, 0.6))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"noise_mm": 0}, "not above zero"),
        ({"orientation_noise_deg": [1, 0, 1]}, "0 deg is not above zero"),
        ({"orientation_noise_mm": 1}, "angle"),
        ({"target_rotation": [1, 1, 0, 0]}, "length 1.4142"),
    ],
    ids=str,
)
def test_settings_that_make_no_sense(change, said):
    given = {"noise_mm": 1, "orientation_noise_deg": 0.1, **change}
    if "orientation_noise_mm" in change:
        del given["orientation_noise_deg"]
    with pytest.raises(ValidationError, match=said):
        TipPoseSettings.model_validate(given)


CONFIG = """
arms:
  arm:
    model:
      type: mdh
      convention: craig
      rows: [{d_mm: 200}, {alpha_deg: 90, a_mm: 30}, {a_mm: 300}, {alpha_deg: -90, d_mm: 250}, {alpha_deg: 90}]
measurements:
  tracker: {type: tip_pose, noise_mm: 0.1, orientation_noise_mrad: 0.2, target_mm: [20, 0, 60]}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
parameters: {free: ["arm.mdh.theta[2-4]", arm.mdh.a3, "tracker.target_*"]}
validation: {folds: 0}
data: {type: pose_csv, path: poses.csv, quaternion: {columns: [a, b, c, d], order: xyzw}}
"""


def turned_and_placed(q, offsets, body):
    """base_T_body of the arm above, composed from scipy's rotations."""
    rows = [(0, 0, 0.2), (np.pi / 2, 0.03, 0), (0, 0.302, 0), (-np.pi / 2, 0, 0.25), (np.pi / 2, 0, 0)]
    turn, place = Rotation.identity(), np.zeros(3)
    for i, (alpha, a, d) in enumerate(rows):
        turn = turn * Rotation.from_rotvec([alpha, 0, 0])
        place = place + turn.apply([a, 0, 0])
        turn = turn * Rotation.from_rotvec([0, 0, q[i] + offsets[i]])
        place = place + turn.apply([0, 0, d])
    return turn * body, place + turn.apply([0.02, 0, 0.06])


def recorded(path, offsets, body):
    """Noisy poses, quaternions of either sign."""
    random = np.random.default_rng(3)
    lines = ["q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,x_m,y_m,z_m,a,b,c,d"]
    for q in random.uniform(-1.5, 1.5, (60, 5)):
        turn, place = turned_and_placed(q, offsets, body)
        seen = turn * Rotation.from_rotvec(2e-4 * random.normal(size=3))
        read = [*q, *(place + 1e-4 * random.normal(size=3)), *(seen.as_quat() * random.choice([-1, 1]))]
        lines.append(",".join(repr(float(x)) for x in read))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.mark.slow
def test_what_priors_alone_hold_is_a_note_where_tips_do_not_depend_on_it(tmp_path):
    """The last joint's zero trades with the target's place and rotation: a gauge, and no reason not to use it."""
    recorded(tmp_path / "poses.csv", (0, 0.02, -0.03, 0.015, 0), Rotation.from_rotvec([0.03, -0.5, 0.2]))
    (tmp_path / "arm.yaml").write_text(CONFIG, encoding="utf-8")
    free = 'parameters.free=["arm.mdh.theta[2-5]", "arm.mdh.a3", "tracker.target_*"]'
    result = calibrate(Experiment.load(tmp_path / "arm.yaml", [free, 'parameters.priors={"*.theta5": 2 deg}']))
    finding = next(f for f in result.verdict.findings if "held by priors" in f.text)
    assert finding.grade == "note" and "does not depend on them" in finding.text
    assert not result.verdict.bad
    known = result.estimate.identifiability
    assert len(known) - known.rank == len(known.undetermined) == 1 and finding.text.startswith("The data determines ")


@pytest.mark.slow
def test_a_calibration_finds_offsets_and_the_bodys_rotation_from_a_file(tmp_path):
    """What is found lies within five standard deviations of the truth."""
    offsets, body = (0, 0.02, -0.03, 0.015, 0), Rotation.from_rotvec([0.03, -0.5, 0.2])
    recorded(tmp_path / "poses.csv", offsets, body)
    path = tmp_path / "arm.yaml"
    path.write_text(CONFIG, encoding="utf-8")
    result = calibrate(Experiment.load(path))
    found, values = result.estimate.parameters, result.estimate.values
    names = [found.entry_names[i] for i in result.estimate.free_entries]
    sd = dict(zip(names, np.sqrt(np.diag(result.estimate.covariance)), strict=True))
    for number, offset in enumerate(offsets[1:4], start=2):
        name = f"arm.mdh.theta{number}"
        assert abs(float(values[found.entries_of(name)][0]) - offset) < 5 * sd[name]
    w, x, y, z = values[found.entries_of("tracker.target_rotation")]
    assert (Rotation.from_quat([x, y, z, w]).inv() * body).magnitude() < 1e-3
    assert max(sd.values()) < 1e-3


SIMULATION = """
extends: arm.yaml
simulation:
  type: elastic_arm
  truth: truth.yaml
  poses: {kind: random, count: 300, levels_deg: {q1: [-80, 80], q2: [-80, 80], q3: [-80, 80], q4: [0, 9], q5: [1, 9]}}
  seed: 4
  outliers: {fraction: 0.1, size_mm: 50}
"""


def test_simulated_orientations_are_turned_by_the_declared_noise_and_stay_quaternions(tmp_path):
    (tmp_path / "arm.yaml").write_text(CONFIG, encoding="utf-8")
    (tmp_path / "sim.yaml").write_text(SIMULATION, encoding="utf-8")
    (tmp_path / "truth.yaml").write_text("arm.mdh.theta2: 0 deg\n", encoding="utf-8")
    experiment = Experiment.load(tmp_path / "sim.yaml")
    system = experiment.system
    request = SimulationRequest(system.arms, system.measurements, experiment.parameters, system.environment)
    dataset = experiment.simulator().simulate(request)
    exact = measured_without_noise(request, dataset)
    w, x, y, z = dataset.stacked([f"tracker.{name}" for name in NAMES])
    np.testing.assert_allclose(w**2 + x**2 + y**2 + z**2, 1, rtol=1e-14)
    truth = Rotation.from_quat(np.array([exact[f"tracker.q{part}"] for part in "xyzw"]).T)
    turned = (truth.inv() * Rotation.from_quat(np.array([x, y, z, w]).T)).as_rotvec()
    np.testing.assert_allclose(turned.std(axis=0), 2e-4, rtol=0.15)


def test_a_plan_counts_what_measured_orientations_would_tell(tmp_path):
    """Rows of poses of which nothing is measured, against differences of scipy's rotations and of the positions."""
    (tmp_path / "arm.yaml").write_text(CONFIG.replace("a_mm: 300", "a_mm: 302"), encoding="utf-8")
    experiment = Experiment.load(tmp_path / "arm.yaml", ("parameters.free=['arm.mdh.theta[2-4]']",))
    q = np.random.default_rng(5).uniform(-1.5, 1.5, (20, 5))
    poses = Dataset(tuple(map(str, range(20))), {f"arm.q{i + 1}": q[:, i] for i in range(5)})
    setup = PlanContext(experiment, PlanSettings(), JointSpace.of(experiment), experiment.parameters, None)
    step, found = 1e-6, setup.rows(poses)
    scales = experiment.parameters.scales()
    for n, angles in enumerate(q):
        turn, place = turned_and_placed(angles, np.zeros(5), Rotation.identity())
        for j in range(3):
            turned, placed = turned_and_placed(angles, step * np.eye(5)[j + 1], Rotation.identity())
            expected = np.concatenate([(placed - place) / 1e-4, (turn.inv() * turned).as_rotvec() / 2e-4])
            np.testing.assert_allclose(-found[:, n, j], expected / step * scales[j], rtol=0, atol=3e-2 * scales[j])
