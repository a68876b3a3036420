"""Simulated images of a small board by cameras that an arm's frames carry, or that stand beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import armcal
import casadi as ca
import numpy as np
import pytest
import yaml
from armcal.arm.model import forward
from armcal.base.arrays import Array
from armcal.base.quaternions import quaternion_of
from armcal.estimate.estimator import Estimate
from armcal.measure.tables import write_csv
from armcal.run.experiment import Experiment
from armcal.run.pipeline import RunContext, Stopwatch, fitted, prepare
from armcal_camera.images_reader import View
from scipy.spatial.transform import Rotation

ARM = Path(__file__).resolve().parents[3] / "configs" / "camera" / "arm.yaml"
MIDDLE = np.deg2rad([10.0, -80, 90, -100, -90, 20])
NOISE_PX = 0.2
CAMERA = {
    "type": "camera",
    "noise_px": NOISE_PX,
    "image_px": [1280, 960],
    "intrinsics": {"fx_px": 1000, "fy_px": 1000, "cx_px": 640, "cy_px": 480},
    "board": {"type": "chessboard", "columns": 5, "rows": 4, "square_mm": 40},
}


def pose(place: tuple[float, ...], rpy_deg: tuple[float, ...] = (0, 0, 0)) -> Array:
    """4 x 4 (m)."""
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix(), place
    return made


def base_T(frame: str) -> Array:  # noqa: N802
    """Where a frame of the nominal arm is at the middle of all poses (4 x 4, m)."""
    arm = Experiment.load(ARM).system.arms["arm"]
    chain = arm.nominal_chain
    frames = forward(chain, [j.offset + ca.SX(float(q)) for j, q in zip(chain.joints, MIDDLE, strict=True)], {})
    there = frames.base_T_tool if frame == "tool" else frames.named[frame]
    return np.asarray(ca.evalf(ca.densify(there.matrix())).full())


def numbers(name: str, placed: Array) -> dict[str, float]:
    """The parameters of a pose, as a file of true values has them (m)."""
    turned = zip("wxyz", quaternion_of(placed[:3, :3]), strict=True)
    place = {f"{name}_{axis}": f"{float(placed[i, 3])!r} m" for i, axis in enumerate("xyz")}
    return {**place, **{f"{name}_rotation[{axis}]": float(x) for axis, x in turned}}  # type: ignore[dict-item]


def simulated(folder: Path, cameras: dict[str, dict[str, object]], truth: dict[str, float], count: int) -> Experiment:
    """An experiment with the records of a simulation of these cameras."""
    (folder / "truth.yaml").write_text(yaml.safe_dump(truth))
    experiment = configured(folder, cameras, count)
    made = experiment.simulator().simulate(experiment.simulation_request)
    write_csv(folder / "records.csv", made, experiment.request(measured=True).channels)
    return experiment


def configured(folder: Path, cameras: dict[str, dict[str, object]], count: int = 1) -> Experiment:
    """An experiment with these cameras, whose poses are free and found from the images."""
    levels = {f"q{i + 1}": [f"{np.rad2deg(q) - 18} deg", f"{np.rad2deg(q) + 18} deg"] for i, q in enumerate(MIDDLE)}
    own = [f"{name}.camera_*" for name in cameras]
    boards = [f"{name}.board_[xyzr]*" for name, stated in cameras.items() if "boards_of" not in stated]
    content = {
        "arms": yaml.safe_load(ARM.read_text())["arms"],
        "measurements": {name: {**CAMERA, **stated} for name, stated in cameras.items()},
        "data": {"type": "csv", "path": "records.csv"},
        "simulation": {
            "type": "elastic_arm",
            "truth": "truth.yaml",
            "seed": 3,
            "poses": {"kind": "random", "count": count, "levels": levels},
        },
        "parameters": {"free": [*own, *boards]},
        "validation": {"holdout": 0, "folds": 0},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(content))
    return armcal.Experiment.load(folder / "config.yaml")


def estimated(experiment: Experiment) -> Estimate:
    """The fit from where the images have the start."""
    ready = prepare(experiment, Stopwatch())
    assert ready.start.taken
    return fitted(RunContext(experiment, lambda *_: None, None, Stopwatch()), ready).estimate


def assert_found(estimate: Estimate, **poses: Array) -> None:
    """Each body is where it truly is, within its stated region and within 2 mm; its name has a dot for a blank."""
    for name, truth in poses.items():
        place, covariance = of(estimate, name.replace("_", ".", 1))
        off = place - truth[:3, 3]
        assert off @ np.linalg.solve(covariance, off) < 7.8, f"{name}: chi-squared of 3, 95 %"
        assert np.linalg.norm(off) < 2e-3 and np.sqrt(np.trace(covariance)) < 2e-3


def of(estimate: Estimate, name: str) -> tuple[Array, Array]:
    """Where a body stands (3, m) by the fit, and the covariance of that (3 x 3)."""
    entries, free = estimate.parameters.entry_names, list(estimate.free_entries)
    places = [entries.index(f"{name}_{axis}") for axis in "xyz"]
    rows = [free.index(i) for i in places]
    return estimate.values[places], estimate.covariance[np.ix_(rows, rows)]


def stand_for_images(monkeypatch: pytest.MonkeyPatch, corners: Mapping[str, Array]) -> None:
    """Corners (K x 2, px) that the reader ``images`` finds, by the names of images that are not there."""
    views = {name: View(np.asarray(pixels), sha256=name) for name, pixels in corners.items()}
    monkeypatch.setattr("armcal_camera.images_reader._views", lambda *_: views)
