"""Causes that no list of effects has: none is named with certainty for another, and what was held is named."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from armcal.diagnose.fit import FitRows
from armcal.diagnose.residual_structure import (
    Contest,
    ResidualStructure,
    depends,
    neighbours,
    repeated,
)
from fits import fit_that_left, whole
from planted_causes import CAUSES, COUNT, DEG, LIMITS, Cause, experiment, graded, joint, left, recording, when

SEEDS = 8
QUICK = ("a held twist alpha2", "a target that moved", "a link that grew")


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_what_was_held_or_moved_is_named_and_what_grew_is_no_drift_of_a_joint(tmp_path: Path, name: str) -> None:
    base, cause = experiment(tmp_path), CAUSES[name]
    found = left(base, cause, recording(base, cause, 1))
    assert graded(found, cause) == ("open" if name == "a link that grew" else "right")


@pytest.mark.slow
def test_a_cause_that_is_not_listed_is_named_wrong_at_most_once_in_twenty(tmp_path: Path) -> None:
    """Eight recordings of each; what was held is among what is named."""
    base, wrong = experiment(tmp_path), 0
    for name, cause in CAUSES.items():
        found = [left(base, cause, recording(base, cause, seed)) for seed in range(SEEDS)]
        grades = [graded(one, cause) for one in found]
        print(name, {grade: grades.count(grade) for grade in sorted(set(grades))})
        wrong += grades.count("wrong")
        if name.startswith("a held"):
            named = [" ".join((s.words, *s.alternatives)) for one in found for s in one.worthwhile[:1]]
            assert len(named) == SEEDS and all(any(word in said for word in cause.right) for said in named), name
    assert wrong <= 0.05 * SEEDS * len(CAUSES)


def along_a_path(seed: int) -> np.ndarray:
    """Poses one after another, each joint to and fro in its own time."""
    random = np.random.default_rng(seed)
    turns, phases = random.uniform(0.5, 3, 6), random.uniform(0, 6, 6)
    return np.sin(2 * np.pi * np.linspace(0, 1, COUNT)[:, None] * turns + phases) * LIMITS


def said(found: ResidualStructure) -> str:
    fit = fit_that_left(found)
    findings = [*depends(fit), *neighbours(fit)]
    return " ".join(whole(finding) for finding in findings)


@pytest.mark.slow
def test_no_drift_is_advised_for_a_function_of_the_pose_along_a_path(tmp_path: Path) -> None:
    base, cause = experiment(tmp_path), CAUSES["a third harmonic"]
    found = left(base, cause, recording(base, cause, 0, along_a_path(0)))
    assert found.shows and found.in_order
    text = said(found)
    assert "parameters.drift" not in text and "do not show whether the pose or time is the cause" in text
    assert "Repeat some of the first poses at the end" in text and "Learn it" not in text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a third harmonic", "sag of q5 by q2 and q3", "an axis that wobbles"])
def test_no_drift_is_advised_for_functions_of_poses_in_any_order(tmp_path: Path, name: str) -> None:
    base, cause = experiment(tmp_path), CAUSES[name]
    for seed in range(3):
        q = np.random.default_rng(seed).uniform(-1, 1, (COUNT, 6)) * LIMITS
        orders = (np.argsort(q[:, 0]), np.argsort(q[:, 2]), np.lexsort((q[:, 0], np.round(3 * q[:, 1]))))
        for poses in (along_a_path(seed), *(q[order] for order in orders)):
            assert "parameters.drift" not in said(left(base, cause, recording(base, cause, seed, poses)))


@pytest.mark.slow
def test_a_base_that_drifts_while_poses_come_at_random_is_let_drift(tmp_path: Path) -> None:
    drifting = Cause(read=lambda q, p: p + 0.002 * when(q)[:, None] ** 2 * [1, 0.5, 0.2])
    base = experiment(tmp_path)
    assert "parameters.drift" in said(left(base, drifting, recording(base, drifting, 2)))


def sagging(q: np.ndarray) -> np.ndarray:
    sagged = joint(3, lambda q: 0.4 * DEG * np.cos(q[:, 1] + q[:, 2]))(q)
    return joint(2, lambda q: 0.5 * DEG * np.cos(q[:, 1]))(sagged)


@pytest.mark.slow
@pytest.mark.parametrize("sags", [True, False])
def test_repeats_in_each_rest_say_what_is_no_noise(tmp_path: Path, sags: bool) -> None:
    random, cause = np.random.default_rng(1), Cause(stands=sagging if sags else None)
    q = np.repeat(random.uniform(-1, 1, (50, 6)) * LIMITS, 3, axis=0) + 1e-4 * random.normal(size=(150, 6))
    base = experiment(tmp_path)
    found = left(base, cause, recording(base, cause, 1, q, 4e-5))
    assert found.repeats is not None and (found.repeats.poses, found.repeats.records) == (50, 150)
    assert found.repeats.scatter_mm == pytest.approx(0.069, rel=0.1)  # of three coordinates
    findings = repeated(fit_that_left(found))
    assert len(findings) == sags and (not sags or "the model lacks something" in findings[0].text)


def test_repeats_call_noise_the_models_error_as_often_as_the_level_says() -> None:
    random, pose, count = np.random.default_rng(0), np.repeat(np.arange(20), 3), 60
    numbers, p_values = np.arange(3 * count).reshape(3, count), []
    whitening = (np.repeat(np.eye(3)[:, :, None], count, axis=2),)
    for _ in range(200):  # the model is alike in records of one pose
        basis = np.linalg.qr(np.repeat(random.normal(size=(3, 20, 10)), 3, axis=1).reshape(3 * count, 10))[0]
        noise = random.normal(size=3 * count)
        residual = noise - basis @ (basis.T @ noise)
        rows = FitRows(basis, residual, np.tile(np.arange(count), 3), numbers.T, whitening, (np.ones(count),), (True,))
        found = Contest(SimpleNamespace(rows=rows), [], [], [], pose, np.ones(count - 1, dtype=bool))._repeats()
        assert found is not None and not found.exceeded
        p_values.append(found.p_value)
    assert np.mean(np.array(p_values) < 0.01) <= 0.025 and 0.4 < np.mean(p_values) < 0.6
