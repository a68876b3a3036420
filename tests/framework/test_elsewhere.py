"""What contacts determine of the tool away from them, against the errors of calibrated arms in plain numpy."""

from __future__ import annotations

import re
from pathlib import Path

import contact_oracle as co
import numpy as np
from armcal.base.dataset import Dataset
from armcal.diagnose.verdict import Elsewhere, away, away_from_contacts, elsewhere
from armcal.estimate.polish import started
from armcal.estimate.robust import fit
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from armcal_contact.contacts import BallInSocket
from armcal_ipopt.estimator import IpoptEstimator
from fits import fit_that_found

IPOPT = IpoptEstimator(IpoptEstimator.Settings())
NOISE = 1e-3
BALL = Path(__file__).resolve().parents[2] / "configs" / "ball" / "demo.yaml"
FREE = ("arm.mdh.a2", "arm.mdh.theta3", "arm.mdh.a4")


def off(q: np.ndarray, v: dict[str, float]) -> float:
    """Root mean square distance from the true tool, the base and the point of the tool moved to where it is least."""
    poses = co.tool_poses(co.ELBOW, q)
    at, axes = poses[:, :3, 3], np.moveaxis(poses[:, :3, :3], 2, 0)
    shifts = [np.broadcast_to(axis, at.shape) for axis in np.eye(3)]
    motions = [*shifts, *(np.cross(axis, at) for axis in np.eye(3)), *axes]
    columns = np.array([motion.ravel() for motion in motions]).T
    error = (co.points(co.ELBOW, q, v=v) - at).ravel()
    left = error - columns @ np.linalg.lstsq(columns, error, rcond=None)[0]
    return float(np.sqrt(np.mean(np.sum(left.reshape(-1, 3) ** 2, axis=1))))


def test_the_tool_is_off_away_from_the_sockets_by_as_much_as_is_said() -> None:
    places = {"hole_0": (0.35, 0.1, 0.25), "hole_1": (0.2, -0.3, 0.35)}
    q = [co.touching(co.ELBOW, co.in_socket(place), 12, seed) for seed, place in enumerate(places.values())]
    poses = co.random_joints(co.ELBOW, 100, 5)
    stated, true = [], []
    for seed in range(8):
        random = np.random.default_rng(seed)
        noisy = [at + random.normal(0, NOISE, at.shape) for at in q]
        parts = [(co.joints(at), {"position": "here", "socket": name}) for at, name in zip(noisy, places, strict=True)]
        ball = BallInSocket(BallInSocket.Settings.si(noise=NOISE), ("arm",))
        problem, records = co.Bench({"arm": co.the_arm(co.ELBOW)}, {"balls": ball}, FREE).problem(co.dataset(parts))
        problem = started(problem.with_records(records))
        estimate = fit(problem, IPOPT, problem.parameters.nominal()).estimate
        found = away_from_contacts(problem, estimate, Dataset(tuple(map(str, range(100))), co.joints(poses)))
        assert found is not None
        stated.append(found.rms_mm)
        true.append(1e3 * off(poses, co.by_name(problem.parameters, estimate.values)))
    ratio = np.sqrt(np.mean(np.square(true)) / np.mean(np.square(stated)))
    assert 0.7 < ratio < 1.4


def test_it_is_no_warning_but_stands_before_how_well_postures_at_one_place_agree() -> None:
    """Sound contacts always agree better than the tool is known: a warning of it comes with each of them."""
    (note,) = away(fit_that_found(None, {elsewhere: Elsewhere(0.3, 400, "")}))
    assert note.grade == "note" and "known to 0.30 mm" in note.text
    assert away(fit_that_found(None, {elsewhere: None})) == []
    run = Experiment.load(BALL, ["evaluator=interpreted"])
    assert re.match(
        r"Away from the contacts the tool is known to 0\.1\d mm .*\. Postures at one place agree within \+- 0\.1\d mm",
        calibrate(run).verdict.paragraph,
    )
