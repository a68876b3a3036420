"""The real arm: calibrated on the odd pose ids, then kept true by the even ones, one at a time in recorded order."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import sealed
from armcal.estimate.online import Gaussian
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from armcal.run.result import calibration_content
from armcal_online.belief import Belief
from armcal_online.recalibrator import Recalibrator
from armcal_online.settings import RecalibrateSettings
from armcal_online.sources import Incoming

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.shared
STEP_AT = 80
"""The record (from 0) from which on the commanded q3 is shifted."""
HALF = 80
MODELS = [pytest.param("option1", id="option1"), pytest.param("best", id="best", marks=pytest.mark.slow)]


@dataclass(frozen=True)
class Halves:
    """A calibration on the odd ids, and the even ones in recorded order."""

    calibration: Calibration
    even: Dataset
    experiment: Experiment


@dataclass(frozen=True)
class Course:
    """What came of a run: innovation of each record (mm), events, the session."""

    innovations: np.ndarray
    events: list[dict]
    session: Recalibrator

    def decisions(self) -> list[dict]:
        return [event for event in self.events if event["event"] == "decision"]


def calibrated(model: str, data: Path, folder: Path, *overrides: str) -> Calibration:
    experiment = Experiment.load(
        ROOT / "configs" / "lrm_arm" / f"{model}.yaml", ["validation.folds=0", *overrides], data
    )
    path = folder / f"{model}.yaml"
    path.write_text(sealed(calibration_content(calibrate(experiment), experiment)), encoding="utf-8")
    return Calibration.load(path)


def written(poses: Path, folder: Path, name: str, remainder: int) -> Path:
    with poses.open(newline="") as file:
        header, *rows = csv.reader(file)
    with (folder / name).open("w", newline="") as file:
        csv.writer(file).writerows([header, *(row for row in rows if int(row[0]) % 2 == remainder)])
    return folder / name


_KEPT: dict[str, Halves] = {}


@pytest.fixture(scope="module")
def poses(shared_data: Path) -> Path:
    return shared_data / "lrm_arm" / "poses.csv"


@pytest.fixture
def halves(request: pytest.FixtureRequest, poses: Path, tmp_path_factory: pytest.TempPathFactory) -> Halves:
    model = request.param
    if model not in _KEPT:
        folder = tmp_path_factory.mktemp(model)
        found = calibrated(model, written(poses, folder, "odd.csv", 1), folder)
        experiment = Experiment.load(
            ROOT / "configs" / "lrm_arm" / f"{model}.yaml", data=written(poses, folder, "even.csv", 0)
        )
        _KEPT[model] = Halves(found, experiment.read(), experiment)
    return _KEPT[model]


def run(halves: Halves, settings: RecalibrateSettings, step_rad: float = 0.0) -> Course:
    session = Recalibrator(halves.calibration, settings)
    events: list[dict] = []
    for i in range(len(halves.even)):
        channels = {name: float(values[i]) for name, values in halves.even.channels.items()}
        if i >= STEP_AT:
            channels["arm.q3"] += step_rad
        events += session.take(Incoming(halves.even.ids[i], channels, {}, 0.0), i + 1)
    residuals = [event["residual_mm"] for event in events if event["event"] == "record"]
    return Course(np.linalg.norm(residuals, axis=1), events, session)


@pytest.mark.parametrize("halves", MODELS, indirect=True)
@pytest.mark.slow
def test_a_clean_run_raises_no_alarm_and_foretells_as_a_refit_would(halves: Halves) -> None:
    """A refit of option 1 before every other of the last 80 records errs by 5.7 mm on them in the mean; of the best
    model before every fifth by what docs/recalibrate.md states."""
    course = run(halves, RecalibrateSettings())
    print(f"mean innovation over the last {HALF}: {course.innovations[-HALF:].mean():.3f} mm")
    assert course.decisions() == []
    assert course.session.state.health.level == "nominal"
    white = run(halves, RecalibrateSettings(model_error="white"))
    assert course.innovations[-HALF:].mean() < white.innovations[-HALF:].mean()


@pytest.mark.slow
@pytest.mark.parametrize("halves", MODELS, indirect=True)
@pytest.mark.parametrize("step_deg", [5.0, 14.4])
def test_a_step_of_joint_3_is_named_and_followed(halves: Halves, step_deg: float) -> None:
    """In the eight poses after the step joint 2 stands at zero and the axes of joints 1 and 3 coincide: no pose tells
    one from the other before the ninth record, so two joints are named at first, and one by the tenth."""
    clean, course = run(halves, RecalibrateSettings()), run(halves, RecalibrateSettings(), math.radians(step_deg))
    first = course.decisions()[0]
    assert first["sequence"] - STEP_AT <= 5
    assert "arm.q3" in first["candidates"] and set(first["candidates"]) <= {"arm.q1", "arm.q3"}
    named = next(event for event in course.decisions() if event["kind"] == "joint_named")
    assert named["joint"] == "arm.q3" and named["sequence"] - STEP_AT <= 10
    assert abs(named["size_deg"] + step_deg) < 1.0
    after, undisturbed = course.innovations[STEP_AT + 10 :].mean(), clean.innovations[STEP_AT + 10 :].mean()
    print(f"{step_deg} deg: {after:.3f} mm after ten records, {undisturbed:.3f} mm undisturbed")
    assert after <= 1.2 * undisturbed
    assert [e["joint"] for e in course.decisions()[2:] if "joint" in e] == []


@pytest.mark.parametrize("halves", MODELS, indirect=True)
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_a_tenth_of_the_records_exchanged_is_no_change_of_the_arm(halves: Halves, seed: int) -> None:
    """Two by two; of two rows exchanged one says by half a metre that the arm is elsewhere."""
    even, random = halves.even, np.random.default_rng(seed)
    order, count = np.arange(len(even)), len(even) // 20
    places = random.choice(len(even), 2 * count, replace=False)
    order[places[:count]], order[places[count:]] = places[count:], places[:count]
    axes = {name: column[order] for name, column in even.channels.items() if name.startswith("tracker.")}
    course = run(replace(halves, even=replace(even, channels={**even.channels, **axes})), RecalibrateSettings())
    rejected = course.session.state.counts["rejected"]
    print(f"{2 * count} of {len(even)} exchanged, {rejected} rejected: {[d['sentence'] for d in course.decisions()]}")
    assert {decision["kind"] for decision in course.decisions()} <= {"unexplained"}
    assert rejected >= 1.8 * count


COARSE = 'parameters.free=["arm.mdh.theta[1-6]","arm.mdh.base_[xyz]"]'
"""No springs: this arm sags by as much as a joint that slipped by several degrees."""
OWN_ERROR = ", or the model's own error"


@pytest.fixture(scope="module")
def coarse(poses: Path, tmp_path_factory: pytest.TempPathFactory) -> Halves:
    found = calibrated("option1", poses, tmp_path_factory.mktemp("coarse"), COARSE)
    experiment = Experiment.load(ROOT / "configs" / "lrm_arm" / "option1.yaml", data=poses)
    return Halves(found, experiment.read(), experiment)


def some_of(halves: Halves, missing: float, seed: int, joint: str = "q2", step_deg: float = 0.0) -> list[dict]:
    """Decisions on the records in order, a part of them missing; from the 150th on a joint has slipped."""
    session, records, events = Recalibrator(halves.calibration, RecalibrateSettings()), halves.even, []
    kept = np.flatnonzero(np.random.default_rng(seed).random(len(records)) >= missing)
    for k, i in enumerate(kept.tolist()):
        channels = {name: float(values[i]) for name, values in records.channels.items()}
        channels[f"arm.{joint}"] += math.radians(step_deg) if k >= 150 else 0.0
        events += session.take(Incoming(records.ids[i], channels, {}, 0.0), k + 1)
    return [event for event in events if event["event"] == "decision"]


@pytest.mark.slow
def test_what_a_coarse_model_makes_look_like_a_slip_is_named_beside_the_models_own_error(coarse: Halves) -> None:
    (decision,) = some_of(coarse, 0.3, 0)
    assert decision["kind"] == "joint_slipped" and OWN_ERROR in decision["sentence"]
    assert "standard deviations of what the calibration's residuals" in decision["why"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("missing", [0.3, 0.5])
def test_no_healthy_joint_is_accused_alone(coarse: Halves, missing: float, seed: int) -> None:
    assert all(OWN_ERROR in d["sentence"] for d in some_of(coarse, missing, seed) if "joint" in d or "measurement" in d)


@pytest.mark.slow
@pytest.mark.parametrize(("step_deg", "within", "may_be_the_model"), [(5.0, 6, True), (25.0, 6, False)])
def test_a_slip_is_found_as_soon_and_named_alone_where_no_model_error_is_as_large(
    coarse: Halves, step_deg: float, within: int, may_be_the_model: bool
) -> None:
    found = next(d for d in some_of(coarse, 0.3, 0, "q2", step_deg) if d["sequence"] > 150)
    assert (found["kind"], found["joint"]) == ("joint_slipped", "arm.q2") and found["sequence"] - 150 <= within
    assert (OWN_ERROR in found["sentence"]) == may_be_the_model


@pytest.mark.slow
def test_without_gate_and_process_noise_the_filter_ends_where_a_batch_over_all_does(
    poses: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Option 1; the noise is the residuals' size that the batch over the odd ids found, in both.

    A batch and a filter agree where both take records for independent, so nothing is widened for neighbours alike.
    """
    monkeypatch.setattr("armcal.run.pipeline.widened", lambda problem, estimate, position: estimate)
    first = calibrated("option1", written(poses, tmp_path, "odd.csv", 1), tmp_path)
    noise_mm = 0.5 * float(first.record.noise["scale"])
    declared = f"measurements.tracker.noise_mm={noise_mm!r}"
    odd = calibrated("option1", tmp_path / "odd.csv", tmp_path, declared)
    every = calibrated("option1", poses, tmp_path, declared)
    covariance = np.eye(3) * (noise_mm / 1000) ** 2
    odd.record.noise["scatter"]["tracker"] = {"covariance": covariance.tolist(), "share": 0.0, "over": 1.0}
    experiment = Experiment.load(
        ROOT / "configs" / "lrm_arm" / "option1.yaml", data=written(poses, tmp_path, "even.csv", 0)
    )
    course = run(Halves(odd, experiment.read(), experiment), RecalibrateSettings(gating=False, model_error="white"))
    values = course.session.values
    off = [
        abs(values[i] - entry.value) / (entry.sd / every.record.noise["scale"])
        for i, entry in enumerate(every.record.parameters)
        if entry.free and entry.sd
    ]
    print(f"farthest from the batch: {max(off):.3f} sd")
    assert len(off) == 28
    assert max(off) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_from_nominal_values_on_shuffled_records_it_ends_within_two_percent_of_the_batch(
    model: str, poses: Path, tmp_path: Path
) -> None:
    """The plain filter diverges there with the full model; looked at again from where they lead, the records do not."""
    priors = ["parameters.drift={}"] if model == "best" else []
    first = calibrated(model, poses, tmp_path, *priors)
    declared = 0.7 if model == "best" else 0.5
    noise_mm = declared * float(first.record.noise["scale"])
    batch = calibrated(model, poses, tmp_path, *priors, f"measurements.tracker.noise_mm={noise_mm!r}")
    covariance = np.eye(3) * (noise_mm / 1000) ** 2
    batch.record.noise["scatter"]["tracker"] = {"covariance": covariance.tolist(), "share": 0.0, "over": 1.0}
    experiment = Experiment.load(ROOT / "configs" / "lrm_arm" / f"{model}.yaml", priors, poses)
    dataset = experiment.read()
    order = np.random.default_rng(0).permutation(len(dataset))
    session = from_nominal(batch, experiment)
    for k, i in enumerate(order):
        channels = {name: float(values[i]) for name, values in dataset.channels.items()}
        session.take(Incoming(dataset.ids[i], channels, {}, 0.0), k + 1)
    ends, aim = (mean_error(session, dataset, v) for v in (session.values, batch.parameters.nominal()))
    print(f"{model}: {ends:.3f} mm, batch {aim:.3f} mm")
    assert session.state.counts["accepted"] == len(dataset)
    assert ends <= 1.02 * aim


def from_nominal(batch: Calibration, experiment: Experiment) -> Recalibrator:
    """A session that knows nothing but nominal values and priors, five times the typical scale where none is stated."""
    session = Recalibrator(batch, RecalibrateSettings(gating=False, model_error="white"))
    free = session.setup.space.parameters.free
    stated = [(b, experiment.parameters[b.name].prior_sd or 5 * b.scale) for b in free]
    deviations = np.array([sd / b.scale for b, sd in stated for _ in range(b.domain.dof)])
    start = Gaussian(np.zeros(len(deviations)), np.diag(deviations**2))
    belief = Belief(experiment.parameters.nominal(), start)
    session.state = replace(session.state, belief=belief)
    return session


def mean_error(session: Recalibrator, dataset: Dataset, values: np.ndarray) -> float:
    observer, found = session.setup.observer, []
    for i in range(len(dataset)):
        readings = observer.readings({name: float(column[i]) for name, column in dataset.channels.items()}, {})
        found.append(np.linalg.norm(observer.linearise(session.setup.space.inside(values), readings[0])[0]))
    return 1000 * float(np.mean(found))
