"""How a calibration's residuals scatter, and what neighbours share of it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.estimate.prediction import ResidualSpread, residual_spread


def told(residual: np.ndarray, places: np.ndarray | None = None, weight: np.ndarray | None = None) -> ResidualSpread:
    """The scatter of one measurement's residuals (3 x N), none of their freedom used up."""
    count = residual.shape[1]
    factor = SimpleNamespace(name="tracker", noise=(1.0, 1.0, 1.0))
    estimate = SimpleNamespace(values=None, degrees_of_freedom=3 * count, noise_scale=1.0)
    weights = np.ones(count) if weight is None else weight
    problem = SimpleNamespace(
        kernels=[SimpleNamespace(factor=factor)],
        records=[SimpleNamespace(count=count, weight=weights, measured=np.ones(count, dtype=bool))],
        correlation=None,
        residuals=lambda values: [residual],
        equations=lambda: 3 * count,
    )
    channels = {} if places is None else {"sequence": places}
    dataset = Dataset(tuple(str(i) for i in range(count)), channels)
    return residual_spread(problem, estimate, dataset)["tracker"]


def made(count: int, share: float, over: float, seed: int = 0) -> np.ndarray:
    """A common part that falls by e over so many records, beside an independent one; along skew axes."""
    random = np.random.default_rng(seed)
    kept = np.exp(-1 / over)
    common = random.normal(size=(3, count))
    for i in range(1, count):
        common[:, i] = kept * common[:, i - 1] + np.sqrt(1 - kept**2) * common[:, i]
    unit = np.sqrt(share) * common + np.sqrt(1 - share) * random.normal(size=(3, count))
    return np.array([[3.0, 0, 0], [1.0, 2.0, 0], [0.5, -0.3, 1.0]]) @ unit / 1000


def test_share_distance_and_covariance_are_found_again() -> None:
    found = told(made(20_000, 0.7, 5.0))
    root = np.array([[3.0, 0, 0], [1.0, 2.0, 0], [0.5, -0.3, 1.0]]) / 1000
    np.testing.assert_allclose(found.covariance, root @ root.T, rtol=0.15, atol=2e-7)
    assert found.share == pytest.approx(0.7, abs=0.05)
    assert found.over == pytest.approx(5.0, rel=0.15)
    assert found.channel == "record"


def test_independent_residuals_share_nothing() -> None:
    assert [told(made(300, 0.0, 5.0, seed)).share for seed in range(20)].count(0.0) >= 19


def test_places_say_the_order_and_the_distance() -> None:
    residual, order = made(5_000, 0.7, 5.0), np.random.default_rng(1).permutation(5_000)
    shuffled, plain = told(residual[:, order], 2.0 * order), told(residual)
    assert shuffled.channel == "sequence"
    assert shuffled.share == pytest.approx(plain.share)
    assert shuffled.over == pytest.approx(2 * plain.over)
    assert told(residual[:, order]).share == 0.0


def test_records_that_were_set_aside_do_not_count() -> None:
    residual, weight = made(500, 0.0, 5.0), np.ones(500)
    wild = residual.copy()
    wild[:, ::50] += 1.0
    weight[::50] = 0.0
    kept = told(residual[:, weight > 0])
    np.testing.assert_allclose(told(wild, weight=weight).covariance, kept.covariance, rtol=1e-12)
