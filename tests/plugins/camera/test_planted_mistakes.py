"""What goes wrong with a camera at a bench, planted one by one, and the sentence that names it; clean records none."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.base.dataset import Dataset
from armcal.errors import ProblemError
from armcal.estimate.identifiability import deviations
from armcal.measure.tables import write_csv
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble, calibrate
from scipy.spatial.transform import Rotation

from tests.plugins.camera.simulated_views import ARM, MIDDLE, base_T, numbers

DEMO = ARM.with_name("demo.yaml")
JOINTS = [f"arm.q{i}" for i in range(1, 7)]
SENTENCES = {
    "swapped": "the corners of the board lie as if its columns and rows were exchanged",
    "second": "images show a board that stands elsewhere than in the others: two boards, or one that was moved",
    "rolled": "the hand does not turn between images as the board is seen to turn",
    "bumped": "the camera, or the board, was moved there",
    "focus": "the recorded order: the focal length changes (autofocus, zoom, warming)",
    "bent": "Board is not flat: camera.board_bend_x is held at 0 mm, but the records put it at ",
    "lens": "The lens is another than stated: camera.p1 is held at 0, but the records put it at 0.00",
}


class Bench:
    """A six-joint arm with a camera, in hand or beside it, and its simulated records."""

    def __init__(self, folder: Path, mounting: str, count: int) -> None:
        self._folder = folder
        self.truth = yaml.safe_load(ARM.with_name("truth.yaml").read_text())
        self._content = {**yaml.safe_load(ARM.read_text()), **yaml.safe_load(DEMO.read_text())}
        self._content.pop("extends")
        poses = self._content["simulation"]["poses"]
        poses["count"] = count
        if mounting == "eye_to_hand":
            self._content["measurements"]["camera"]["mounting"] = mounting
            spans = zip(np.rad2deg(MIDDLE), (12, 12, 15, 20, 20, 60), strict=True)
            poses["levels"] = {f"q{i}": [f"{q - s} deg", f"{q + s} deg"] for i, (q, s) in enumerate(spans, start=1)}
            tool, board, camera = base_T("tool"), np.eye(4), np.eye(4)
            board[:3, 3] = -0.1, -0.06, 0.04
            camera[:3, :3] = tool[:3, :3] @ Rotation.from_euler("xyz", [188, -6, 4], degrees=True).as_matrix()
            camera[:3, 3] = tool[:3, 3] + 0.59 * tool[:3, 2]
            self.truth |= {**numbers("camera.camera", camera), **numbers("camera.board", board)}
        self.clean = self.simulated(self.truth)

    def simulated(self, truth: dict[str, object], poses: Dataset | None = None) -> Dataset:
        experiment = self.experiment(truth)
        if poses is not None:
            kept = {name: values for name, values in poses.channels.items() if not name.startswith("camera.")}
            poses = replace(poses, channels=kept)
        return experiment.simulator().simulate(replace(experiment.simulation_request, poses=poses))

    def experiment(self, truth: dict[str, object] | None = None) -> Experiment:
        (self._folder / "truth.yaml").write_text(yaml.safe_dump(truth or self.truth))
        (self._folder / "config.yaml").write_text(yaml.safe_dump(self._content))
        return Experiment.load(self._folder / "config.yaml")

    def recorded(self, dataset: Dataset) -> Experiment:
        experiment = self.experiment()
        write_csv(self._folder / "demo.csv", dataset, experiment.request(measured=True).channels)
        return experiment

    def planted(self, mistake: str) -> Dataset:
        clean, channels, order = self.clean, dict(self.clean.channels), np.arange(len(self.clean))
        if mistake == "swapped":  # a detector that counts the corners column by column
            for k in range(54):
                for axis in "uv":
                    channels[f"camera.{axis}_{k % 9 * 6 + k // 9}"] = clean.channels[f"camera.{axis}_{k}"]
        if mistake == "rolled":
            channels |= {JOINTS[(i + 1) % 6]: clean.channels[name] for i, name in enumerate(JOINTS)}
        if mistake in ("second", "bumped"):
            own, part, by, which = {
                "second": ("board", "x", 0.15, order % 2 == 0),
                "bumped": ("camera", "x", 0.004, order >= 25),
            }[mistake]
            name = f"camera.{own}_{part}"
            place, unit = str(self.truth[name]).split()
            moved = float(place) + by * (1000 if unit == "mm" else 1)
            other = self.simulated({**self.truth, name: f"{moved} {unit}"}, clean).channels
            channels |= {k: np.where(which, other[k], v) for k, v in channels.items() if k.startswith("camera.")}
        if mistake == "bent":
            return self.simulated({**self.truth, "camera.board_bend_x": "1 mm"}, clean)
        if mistake == "lens":
            return self.simulated({**self.truth, "camera.p1": 0.003}, clean)
        if mistake == "focus":
            for axis, centre in (("u", 0.633), ("v", 0.487)):
                for k in range(54):
                    own = channels[f"camera.{axis}_{k}"]
                    channels[f"camera.{axis}_{k}"] = centre + (own - centre) * (1 + 0.006 * order / len(order))
        return replace(clean, channels=channels)


@pytest.mark.quick("eye_in_hand-swapped")
@pytest.mark.parametrize("mistake", ["swapped", "second", "rolled"])
@pytest.mark.parametrize("mounting", ["eye_in_hand", pytest.param("eye_to_hand", marks=pytest.mark.slow)])
def test_what_does_not_belong_together_is_refused_by_name(tmp_path: Path, mounting: str, mistake: str) -> None:
    bench = Bench(tmp_path, mounting, 40)
    with pytest.raises(ProblemError) as refusal:
        assemble(bench.recorded(bench.planted(mistake)), Stopwatch())
    assert SENTENCES[mistake] in str(refusal.value)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 20))])
@pytest.mark.parametrize("mounting", ["eye_in_hand", pytest.param("eye_to_hand", marks=pytest.mark.slow)])
def test_the_errors_of_a_poor_arm_are_no_second_board(tmp_path: Path, mounting: str, seed: int) -> None:
    bench, random = Bench(tmp_path, mounting, 40), np.random.default_rng(seed)
    off = {f"arm.mdh.theta{i}": f"{random.uniform(-2, 2)} deg" for i in range(2, 6)}
    poor = bench.simulated({**bench.truth, **off})
    assemble(bench.recorded(poor), Stopwatch())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "mistake"),
    [(60, "clean"), (60, "bumped"), (60, "focus"), (60, "bent"), (25, "clean"), (25, "bent"), (25, "lens")],
)
@pytest.mark.parametrize("mounting", ["eye_in_hand", "eye_to_hand"])
def test_what_changed_meanwhile_or_is_bent_is_named_by_the_verdict(
    tmp_path: Path, mounting: str, count: int, mistake: str
) -> None:
    bench = Bench(tmp_path, mounting, count)
    verdict = calibrate(bench.recorded(bench.planted(mistake))).verdict
    text = " ".join(finding.text for finding in verdict.findings)
    for name, sentence in SENTENCES.items():
        assert (sentence in text) == (name == mistake)
    for size, sd in re.findall(r"board_bend_x is held at 0 mm, but the records put it at (\S+) \+- (\S+) mm", text):
        assert abs(float(size) - 1) < 3 * float(sd) < 0.15


def scale_held(*changes: str) -> tuple[str, str]:
    """The grade and text of what the verdict says of the board's size."""
    verdict = calibrate(Experiment.load(DEMO, ["validation={holdout: 0.25}", *changes])).verdict
    (said,) = [(f.grade, f.text) for f in verdict.findings if "board_scale" in f.text]
    return said


@pytest.mark.slow
def test_a_square_of_another_size_contradicts_the_priors_of_lengths() -> None:
    grade, text = scale_held("measurements.camera.board.square_mm=25.5")
    assert grade == "warning" and "although records and priors put it -2 +- 0.81 %" in text


@pytest.mark.slow
def test_where_nothing_is_wrong_with_the_square_the_verdict_says_what_would_not_show() -> None:
    """The first-order statement is what a fit with the scale free finds."""
    grade, text = scale_held()
    assert grade == "note" and "An error of up to 1.7 % would not show" in text
    free = yaml.safe_load(DEMO.read_text())["parameters"]["free"]
    named = f"parameters.free={yaml.safe_dump([*free, 'camera.board_scale'], default_flow_style=True)}"
    estimate = calibrate(Experiment.load(DEMO, ["validation={holdout: 0.25}", named])).estimate
    place = estimate.parameters.coordinate_names.index("camera.board_scale")
    off = float(estimate.values[estimate.parameters.entries_of("camera.board_scale")][0]) - 1
    sd = deviations(estimate.square_root_information)[place]
    said = [float(number) for number in re.findall(r"put it (\S+) \+- (\S+) %", text)[0]]
    assert said == pytest.approx([100 * off, 100 * sd], rel=0.02, abs=0.005)
