"""Noise and intervals of readings follow from residuals, whatever their order, sign, unit and number."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from armcal.plugins import discover
from armcal.testing.contract import check_component
from outside import armcal, installed

PIXEL, FOCAL, STATION_MM = 0.2, 1200.0, np.array([-1500, 100, 200])
ARM = """
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{alpha_deg: 90, d_mm: 150}, {a_mm: 300}, {a_mm: 250}]}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
data: {type: csv, path: records.csv}
simulation:
  type: elastic_arm
  truth: truth.yaml
  seed: %d
  poses: {kind: random, count: %d, levels_deg: {q1: [-60, 60], q2: [-30, 60], q3: [-90, 90]}}
parameters: {free: ["arm.mdh.theta[23]", "arm.mdh.a[23]"]}
validation: {holdout: 0, folds: 5}
"""
CAMERA = """
measurements:
  tracker: {type: tip_position, noise_mm: 0.5}
  camera: {type: pixel_camera, noise_of_a_pixel: 0.2, focal: 1200, station_mm: [-1500, 100, 200]}
"""
POSE = """
measurements:
  body: {type: tip_pose, noise_mm: 0.3, orientation_noise_deg: 0.4}
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, and a truth."""
    here = installed(tmp_path, monkeypatch)
    (here / "truth.yaml").write_text("arm.mdh.theta2: 0.4 deg\narm.mdh.a3: 251 mm\n")
    return here


def columns(path: str) -> dict[str, np.ndarray]:
    with Path(path).open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0] if name != "pose_id"}


def simulated(name: str, measurements: str, seed: int, count: int) -> dict[str, np.ndarray]:
    Path("arm.yaml").write_text(ARM % (seed, count) + measurements)
    armcal("simulate", "arm.yaml", "--out", name)
    return columns(name)


def true_tips_mm(read: dict[str, np.ndarray]) -> np.ndarray:
    """By hand (3 x N), with the truth above."""
    q1, q2, q3 = (np.radians(read[f"q{i}_deg"]) for i in (1, 2, 3))
    q2 = q2 + np.radians(0.4)
    along = 300 * np.cos(q2) + 251 * np.cos(q2 + q3)
    return np.array([np.cos(q1) * along, np.sin(q1) * along, 150 + 300 * np.sin(q2) + 251 * np.sin(q2 + q3)])


def true_pixels(read: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    x, y, z = true_tips_mm(read) - STATION_MM[:, None]
    return FOCAL * y / x, 3 * FOCAL * z / x


def test_pixels_are_simulated_with_their_own_noise(place: Path) -> None:
    read = simulated("records.csv", CAMERA, 1, 400)
    u, v = true_pixels(read)
    assert np.std(read["u"] - u) == pytest.approx(PIXEL, rel=0.12)
    assert np.std(read["v"] - v) == pytest.approx(3 * PIXEL, rel=0.12), "its rows are v, then u"
    assert np.std(np.array([read[f"{axis}_mm"] for axis in "xyz"]) - true_tips_mm(read)) == pytest.approx(0.5, rel=0.1)


def test_a_prediction_of_pixels_says_how_many_it_may_be_off(place: Path) -> None:
    simulated("records.csv", CAMERA, 1, 60)
    armcal("run", "arm.yaml", "--out", "run", "--parallel", "1")
    new = simulated("new.csv", CAMERA, 2, 400)
    armcal("predict", "run/calibration.yaml", "--poses", "new.csv", "--out", "predicted.csv")
    found = columns("predicted.csv")
    for name, noise in (("u", PIXEL), ("v", 3 * PIXEL)):
        half = found[f"plus_minus_{name}"]
        assert np.median(half) == pytest.approx(1.7 * noise, rel=0.25)
        held = np.mean(np.abs(new[name] - found[name]) <= half)
        assert 0.85 <= held <= 0.95
    assert np.median(found["tracker.radius95_mm" if "tracker.radius95_mm" in found else "radius95_mm"]) < 2


@pytest.mark.slow
def test_a_quaternion_has_the_noise_of_its_rotation_vector(place: Path) -> None:
    read = simulated("records.csv", POSE, 1, 60)
    lengths = np.linalg.norm([read[f"q{part}"] for part in "wxyz"], axis=0)
    assert np.allclose(lengths, 1, atol=1e-9)
    armcal("run", "arm.yaml", "--out", "run", "--parallel", "1")
    new = simulated("new.csv", POSE, 2, 300)
    armcal("predict", "run/calibration.yaml", "--poses", "new.csv", "--out", "predicted.csv")
    found = columns("predicted.csv")
    for name in ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"):
        sign = np.sign(np.sum([new[f"q{p}"] * found[f"q{p}"] for p in "wxyz"], axis=0)) if name[0] == "q" else 1
        held = np.mean(np.abs(sign * new[name] - found[name]) <= found[f"plus_minus_{name}"])
        assert 0.84 <= held <= 0.96, name
    angle = 2 * np.median(found["plus_minus_qx"])
    assert angle < 1.7 * np.radians(0.4) * 1.3


def test_the_contract_asks_for_the_noise_of_every_reading(place: Path) -> None:
    assert [each for each in check_component(discover().find("measurement", "pixel_camera")) if each.fault] == []
