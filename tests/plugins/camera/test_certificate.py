"""The certificate of a hand-eye pose: a bound that no answer goes below, whoever looks for one."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal_camera import hand_eye as of
from armcal_camera.hand_eye import HandEye, certificate, hand_eye, sentence
from scipy.spatial.transform import Rotation

from tests.plugins.camera.test_hand_eye import noisy, pose

pytest.importorskip("cvxpy", reason="cvxpy is not installed: pip install 'armcal[convex]'")


def poses(seed: int, mm: float, deg: float) -> tuple[Array, Array, Array, Array]:
    random = np.random.default_rng(seed)
    x, y, a = pose(random), pose(random), np.array([pose(random) for _ in range(20)])
    return a, np.array([noisy(one, random, mm, deg) for one in np.linalg.inv(y) @ a @ x]), x, y


@pytest.mark.slow
@pytest.mark.parametrize(("mm", "deg"), [(0.0, 0.0), (0.3, 0.03), (20.0, 3.0)])
def test_the_best_answer_is_certified_and_no_other_is_better(mm: float, deg: float) -> None:
    a, b, x, y = poses(1, mm, deg)
    start = hand_eye(a, b)
    assert start is not None
    shown = certificate(a, b, start, (x, y))
    assert shown.gap < 1e-3
    random = np.random.default_rng(2)
    for spread in (1e-3, 0.1, 3.0):
        others = [(noisy(shown.x, random, 100, 20 * spread), noisy(shown.y, random, 100, 20)) for _ in range(10)]
        assert all(certificate(a, b, start, other).ratio > 1 - shown.gap for other in others[:2])


def test_the_form_is_the_sum_of_squares_with_the_best_places() -> None:
    a, b, x, y = poses(3, 5.0, 1.0)
    weights = np.array([40.0, 300.0])
    rows = np.concatenate([a[:, :3, :3], np.tile(-np.eye(3), (20, 1, 1))], axis=2).reshape(-1, 6)
    places = np.linalg.lstsq(rows, (b[:, :3, 3] @ y[:3, :3].T - a[:, :3, 3]).ravel(), rcond=None)[0]
    x[:3, 3], y[:3, 3] = places[:3], places[3:]
    entries = np.concatenate([x[:3, :3].ravel(), y[:3, :3].ravel(), [1.0]])
    expected = sum(float(np.sum(part**2)) for part in of._misfits(a, b, x, y, weights))
    assert entries @ of._form(a, b, weights) @ entries == pytest.approx(expected, rel=1e-9)
    assert np.abs(np.einsum("i,kij,j->k", entries, of._equations(), entries)).max() < 1e-12


def test_sentences_say_what_is_shown_and_what_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, x, y = poses(4, 1.0, 0.1)
    start = hand_eye(a, b)
    assert start is not None
    assert sentence(a, b, start, (x, y)).startswith("no other place of the camera fits the 20 poses")
    turned = x.copy()
    turned[:3, :3] = x[:3, :3] @ Rotation.from_euler("z", 10, degrees=True).as_matrix()
    assert "look for a better fit" in sentence(a, b, start, (turned, y))
    random = np.random.default_rng(5)
    unrelated = np.array([pose(random) for _ in range(20)])
    lost = HandEye(x, y, "none", 0.0, np.ones(20, bool))
    assert "could not be shown" in sentence(a, unrelated, lost, (x, y))
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    without = sentence(a, b, start, (x, y))
    assert "could not be shown" in without and "armcal[convex]" in without
