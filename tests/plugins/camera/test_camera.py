"""The measurement ``camera``: against OpenCV's projection, unrolled expressions, lost corners, and the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import armcal
import casadi as ca
import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, ProblemError
from armcal.estimate.start import Start, with_proposals
from armcal.estimate.validation import record_errors
from armcal.problem.factor import build_factor
from armcal.problem.problem import Problem
from armcal.problem.variants import as_seen, with_few_points
from armcal.run.experiment import Experiment
from armcal_camera.intrinsics import normalised, pinhole, projected
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[3]
DEMO = ROOT / "configs" / "camera" / "demo.yaml"


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return Experiment.load(DEMO)


@pytest.fixture(scope="module")
def dataset(experiment: Experiment) -> Dataset:
    return experiment.read()


def problem_of(experiment: Experiment, dataset: Dataset) -> Problem:
    system = experiment.system
    parts = (system.arms, system.measurements, experiment.parameters, system.environment, dataset)
    return Problem.build(*parts, evaluator="interpreted")


def away(problem: Problem) -> Array:
    """Values at which every board is in front of the camera, and nothing is zero."""
    values, parameters = problem.parameters.nominal(), problem.parameters
    entries = {name: i for i, name in enumerate(parameters.entry_names)}
    random = np.random.default_rng(3)
    values = values + 0.01 * random.normal(size=len(values)) * np.isin(np.arange(len(values)), parameters.free_entries)
    for name, value in {"board_x": -0.65, "board_y": -0.12, "camera_z": 0.05, "fx": 1.1, "fy": 1.05}.items():
        values[entries[f"camera.{name}"]] = value
    turned = Rotation.from_euler("xyz", [178, 3, -2], degrees=True).as_quat()[[3, 0, 1, 2]]
    for axis, number in zip("wxyz", turned, strict=True):
        values[entries[f"camera.board_rotation[{axis}]"]] = number
    for axis, number in zip("wxyz", (1.0, 0.0, 0.0, 0.0), strict=True):
        values[entries[f"camera.camera_rotation[{axis}]"]] = number
    return values


DISTORTED = [(0.0,) * 5, (-0.2, 0.05, 0.001, -0.002, 0.01)]


@pytest.mark.parametrize("distortion", DISTORTED)
def test_pinhole_projects_as_opencv(distortion: tuple[float, ...]) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'armcal[camera]'")
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 1.5], (20, 3))
    matrix = np.array([[900.0, 0, 640], [0, 910, 400], [0, 0, 1]])
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0].reshape(-1, 2)
    symbol = ca.SX.sym("p", 3)
    own = ca.Function("p", [symbol], [projected("pinhole", symbol, (0.9, 0.91), (0.64, 0.4), distortion)])
    assert np.allclose([1000 * np.array(own(point)).ravel() for point in points], seen, atol=1e-9)


@pytest.mark.parametrize("distortion", [(0.0,) * 4, (0.02, -0.01, 0.003, -0.001)])
def test_fisheye_projects_as_opencv(distortion: tuple[float, ...]) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'armcal[camera]'")
    points = np.random.default_rng(0).uniform([-1.5, -1.2, 0.4], [1.5, 1.2, 1.5], (20, 3))
    matrix = np.array([[300.0, 0, 640], [0, 310, 400], [0, 0, 1]])
    seen = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0]
    symbol = ca.SX.sym("p", 3)
    own = ca.Function("p", [symbol], [projected("fisheye", symbol, (0.3, 0.31), (0.64, 0.4), distortion)])
    assert np.allclose([1000 * np.array(own(point)).ravel() for point in points], seen.reshape(-1, 2), atol=1e-7)


@pytest.mark.parametrize(("lens", "distortion"), [("pinhole", DISTORTED[1]), ("fisheye", (0.02, -0.01, 0.003, -0.001))])
def test_undistorted_places_project_back(lens: str, distortion: tuple[float, ...]) -> None:
    rays = np.random.default_rng(1).uniform(-0.4, 0.4, (2, 30))
    focal, centre = np.array([0.9, 0.92]), np.array([0.6, 0.4])
    symbol = ca.SX.sym("p", 3)
    own = ca.Function("p", [symbol], [projected(lens, symbol, focal, centre, distortion)])
    image = np.array(own(np.vstack([rays, np.ones(30)])))
    assert np.allclose(normalised(lens, image.T, focal, centre, np.array(distortion)).T, rays, atol=1e-7)
    assert pinhole(0.0, 0.0, DISTORTED[0]) == (0.0, 0.0)


@pytest.mark.slow
def test_points_evaluate_as_one_long_expression(experiment: Experiment, dataset: Dataset) -> None:
    problem, few = problem_of(experiment, dataset), np.arange(5)
    values, records = away(problem), problem.of(dataset).subset(few).records
    (kernel,), plan = problem.kernels, problem.blueprint
    measurement = plan.measurements["camera"]
    unrolled = build_factor(
        "camera", measurement, plan.arms, plan.parameters, plan.environment, plan.channels, unrolled=True
    )
    order = [kernel.factor.channels.index(channel) for channel in unrolled.channels]
    free = values[list(problem.parameters.free_entries)]
    function = unrolled.linearise_function
    (residual,), (jacobian,) = (
        problem.with_records(records).residuals(values),
        problem.with_records(records).jacobians(values),
    )
    noise = np.array(kernel.factor.noise)
    for i in few:
        _, expected, slopes = (np.asarray(x) for x in function(free, records[0].record[order, i], np.zeros(0)))
        assert np.allclose(residual[:, i], expected.ravel(), atol=1e-13)
        assert np.allclose(jacobian[:, :, i] * noise[:, None], slopes.T, atol=1e-10)
    shown = problem.with_records(records).predict(values)[0].outputs
    read = dataset.stacked(kernel.factor.output_channels)[:, few]
    assert np.allclose(read - shown, residual, atol=1e-13)


def test_a_lost_corner_costs_its_rows_alone(experiment: Experiment, dataset: Dataset) -> None:
    channels = {name: values.copy() for name, values in dataset.channels.items()}
    channels["camera.u_7"][3] = np.nan  # v_7 is there: half a corner is none
    for corner in range(54):
        channels[f"camera.v_{corner}"][5] = np.nan
    lost = replace(dataset, channels=channels)
    problem = problem_of(experiment, lost)
    values, whole, records = away(problem), problem.of(dataset).records, problem.of(lost).records
    assert problem.with_records(whole).equations() - problem.with_records(records).equations() == 2 + 108
    (before,), (after,) = problem.with_records(whole).residuals(values), problem.with_records(records).residuals(values)
    assert not after[14:16, 3].any() and np.array_equal(
        np.delete(after[:, 3], [14, 15]), np.delete(before[:, 3], [14, 15])
    )
    (jacobian,) = problem.with_records(records).jacobians(values)
    assert not jacobian[14:16, :, 3].any() and jacobian[13, :, 3].any()
    errors = record_errors(problem.with_records(records), values)
    own = before[:, 3].reshape(-1, 2)[np.arange(54) != 7]
    assert errors[3] == pytest.approx(np.sqrt(np.sum(own**2) / 53))
    assert np.isnan(errors[5]) and np.isfinite(np.delete(errors, 5)).all()


def test_few_points_keep_their_own_rows(experiment: Experiment, dataset: Dataset) -> None:
    problem = problem_of(experiment, dataset)
    problem, values = problem.of(dataset), away(problem)
    small = with_few_points(problem)
    rows = [problem.kernels[0].factor.output_channels.index(c) for c in small.kernels[0].factor.output_channels]
    assert len(rows) == 24
    assert np.array_equal(small.residuals(values)[0], problem.residuals(values)[0][rows])
    assert np.allclose(small.jacobians(values)[0], problem.jacobians(values)[0][rows], atol=1e-12)


def test_what_is_behind_or_outside_is_not_seen(experiment: Experiment, dataset: Dataset) -> None:
    problem = problem_of(experiment, dataset)
    values = away(problem)
    place = problem.parameters.entry_names.index("camera.board_z")
    _, seen = as_seen(problem, values, dataset)
    values[place] = 3.0  # above the camera, which looks down
    hidden, none = as_seen(problem, values, dataset)
    assert seen.any() and not none.any()
    assert np.isnan(hidden.column("camera.u_0")).all()


def test_settings_that_contradict_each_other_are_refused() -> None:
    for key, value in {
        "measurements.camera.boards": "[{type: tag, id: 1, tag_mm: 40}]",
        "measurements.camera.board_poses": "[{position_mm: [0, 0, 1]}, {position_mm: [0, 0, 2]}]",
        "measurements.camera.noise_px": "0",
        "measurements.camera.intrinsics": "{fx_px: 900, fy_px: 900, cx_px: 640, cy_px: 480, distortion: [0.1]}",
    }.items():
        with pytest.raises(ConfigError) as refused:
            Experiment.load(DEMO, (f"{key}={value}",))
        assert "camera" in str(refused.value)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return armcal.Experiment.load(DEMO).run().write(tmp_path_factory.mktemp("camera") / "run")


@pytest.mark.slow
def test_arm_camera_and_board_together_come_to_the_truth(calibrated: Path) -> None:
    truth = load_config(DEMO.parent / "truth.yaml").data
    calibration = Calibration.load(calibrated / "calibration.yaml")
    stated = {record.name: record for record in calibration.record.parameters}
    pixels = {name: float(text.split()[0]) / 1000 for name, text in truth.items() if str(text).endswith("px")}
    lengths = {name: float(text.split()[0]) / 1000 for name, text in truth.items() if str(text).endswith("mm")}
    off = [abs(stated[n].value - v) / stated[n].sd for n, v in {**pixels, **lengths}.items()]
    assert len(off) == 4 + 6 + 4
    assert max(off) < 4 and np.mean(np.array(off) < 2) >= 0.8
    assert calibration.record.quality_px["calibrated"]["holdout"]["mean"] < 0.32


def test_a_hand_that_did_not_turn_is_refused_with_the_motion_that_is_missing(dataset: Dataset, tmp_path: Path) -> None:
    still = {f"arm.{joint}": np.full(12, 0.1) for joint in ("rz", "ry", "rx")}
    moved = {f"arm.{axis}": np.random.default_rng(0).uniform(-0.1, 0.1, 12) for axis in "xyz"}
    shown = {name: values[:12] for name, values in dataset.channels.items() if name.startswith("camera.")}
    config = tmp_path / "shifted.yaml"
    config.write_text(
        "name: shifted\narms: {arm: {model: {type: flange_pose}}}\n"
        "measurements:\n  camera:\n    type: camera\n    noise_px: 0.2\n"
        "    board: {type: chessboard, columns: 9, rows: 6, square_mm: 25}\n"
        'parameters: {free: ["camera.camera_*", "camera.board_[xyzr]*"]}\n'
    )
    experiment = Experiment.load(config)
    records = Dataset(tuple(map(str, range(12))), {**still, **moved, **shown})
    problem = problem_of(experiment, records)
    with pytest.raises(ProblemError, match="hardly turned") as refused:
        with_proposals(Start(problem.of(records)), records)
    assert "30 deg" in refused.value.hint
