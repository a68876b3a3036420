"""Which weights place a camera better where the arm errs: fits to halves of the images say it, pixels do not."""

from pathlib import Path

import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal.diagnose.gross import steadier_weights
from armcal.estimate.validation import Halves, pose_size
from armcal.run.pipeline import calibrate
from armcal.run.result import RunResult

from tests.plugins.camera.test_planted_mistakes import Bench


def run(folder: Path, mounting: str, seed: int, off: float) -> tuple[RunResult, dict[str, object]]:
    """A camera placed by 30 images with the nominal arm, which is ``off`` times 0.1 deg and 0.5 mm; and the truth."""
    bench, random = Bench(folder, mounting, 30), np.random.default_rng(seed)
    bench._content |= {
        "parameters": {"free": ["camera.camera_*", "camera.board_[xyzr]*", "camera.[fc][xy]", "camera.k[12]"]},
        "noise": {"estimate": True},
        "validation": {"holdout": 0.25, "folds": 0},
    }
    bench._content["simulation"]["seed"] = seed
    truth = {name: value for name, value in bench.truth.items() if not name.startswith("arm.")}
    truth |= {f"arm.mdh.theta{i}": f"{off * random.normal(0, 0.1)} deg" for i in range(2, 6)}
    alphas = zip(range(1, 6), (90, 0, 0, 90, -90), strict=True)
    truth |= {f"arm.mdh.alpha{i}": f"{alpha + off * random.normal(0, 0.03)} deg" for i, alpha in alphas}
    lengths = (("a2", -425), ("a3", -392.2), ("d4", 133.3), ("d5", 99.7))
    truth |= {f"arm.mdh.{name}": f"{length + off * random.normal(0, 0.5)} mm" for name, length in lengths}
    recorded = bench.recorded(bench.simulated(truth))
    bench.truth = truth
    return calibrate(recorded), truth


def off_mm(result: RunResult, values: Array, truth: dict[str, object]) -> float:
    """How far the camera is from its true place."""
    names, places = result.estimate.parameters, []
    for axis in "xyz":
        number, unit = str(truth[f"camera.camera_{axis}"]).split()
        places.append(
            values[names.entries_of(f"camera.camera_{axis}")][0] - float(number) / (1000 if unit == "mm" else 1)
        )
    return 1000 * float(np.linalg.norm(places))


@pytest.mark.parametrize(
    ("mounting", "seed"),
    [
        pytest.param(*case, marks=pytest.mark.slow)
        for case in (("eye_in_hand", 1), *(("eye_to_hand", s) for s in range(4)))
    ],
)
def test_where_the_arm_errs_weights_are_not_ranked_by_pixels(tmp_path: Path, mounting: str, seed: int) -> None:
    """In hand, seed 1: held-out images are 2.05 px off, by the declared noise 0.89 px; the camera 0.5 and 3.3 mm."""
    result, truth = run(tmp_path, mounting, seed, 1.0)
    findings = {finding.text: finding.action for finding in result.verdict.findings}
    (known,) = (text for text in findings if text.startswith("camera: its place"))
    assert " mm and " in known.partition("(95 %), and differs by ")[2] and known.endswith(
        "between halves of the records."
    )
    assert not any(text.startswith("Estimated variances make") for text in findings)
    actions = [
        action for text, action in findings.items() if text.startswith("camera: its pose differs between halves")
    ]
    assert off_mm(result, result.estimate.values, truth) < 2.5
    assert actions == ["Keep noise.estimate."] or (mounting == "eye_to_hand" and not actions)


@pytest.mark.slow
@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_to_hand"])
def test_a_perfect_arm_is_judged_by_pixels(tmp_path: Path, mounting: str) -> None:
    result, _ = run(tmp_path, mounting, 1, 0.0)
    components = result.fit.fitted.components
    assert components is not None and not components.mostly_joints
    assert not any("its pose differs between halves" in finding.text for finding in result.verdict.findings)


def apart(mm: Array, seed: int, error: float) -> Halves:
    """Poses apart by about so much in each of some divisions."""
    random = np.random.default_rng(seed)
    return Halves({"camera": np.c_[mm, 0.05 * mm] * random.uniform(0.9, 1.1, (len(mm), 1))}, np.full(len(mm), error))


def test_the_weights_that_keep_the_pose_are_advised_and_pixels_are_said() -> None:
    near, far = apart(np.full(6, 0.3), 1, 2.18), apart(np.array([1.0, 1.4, 2.0, 1.1, np.nan, 1.5]), 2, 1.39)
    (kept,) = steadier_weights("camera", near, far, "px")
    assert kept.action == "Keep noise.estimate." and "2.18 px" in kept.text and "1.39 px" in kept.text
    (left,) = steadier_weights("camera", far, near, "px")
    assert left.action.startswith("Leave out noise.estimate")
    turned = Halves({"camera": far.apart["camera"] * [1.0, 0.01]}, far.errors)
    assert not steadier_weights("camera", near, turned, "px"), "place and turn do not agree"
    assert not steadier_weights("camera", near, Halves({"camera": np.full((6, 2), np.nan)}, near.errors), "px")


def test_chance_seldom_ranks_weights() -> None:
    random, found = np.random.default_rng(3), 0
    for _ in range(1000):
        one, other = (Halves({"camera": np.abs(random.normal(1, 0.3, (6, 2)))}, np.ones(6)) for _ in range(2))
        found += len(steadier_weights("camera", one, other, "px"))
    assert found < 0.1 * 1000, "5 % on either side"


def test_lengths_of_a_pose_and_of_none() -> None:
    steps = {"camera.camera_x": 0.003, "camera.camera_y": 0.004, "camera.camera_z": 0.0}
    assert np.isnan(pose_size(steps, "camera.camera")[1]) and pose_size(steps, "camera.camera")[0] == pytest.approx(5)
