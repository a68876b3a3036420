"""The net under the filter: refits of windows of records, and when they take over."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from armcal.errors import ConfigError
from armcal.estimate.online import Gaussian
from armcal.estimate.robust import tuned
from armcal_online.tracking.belief import Belief
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.refit import NetRecord, NetState, Prior, Refit, Refitter
from armcal_online.tracking.settings import load_settings
from online_arm import NOISE_M, STATES, World, begun, begun_setup, settings, tip_error_mm, told


def _window(arm: World, count: int) -> tuple[NetRecord, ...]:
    readings = [arm.setup.observer.readings(arm.record().channels, {}) for _ in range(count)]
    return tuple(NetRecord(k, reading, (None,)) for k, reading in enumerate(readings))


def _wide_prior() -> Prior:
    gaussian = begun_setup().belief.gaussian
    return Prior.of(Belief(begun_setup().belief.origin, Gaussian(gaussian.mean, 400 * gaussian.covariance)))


def _cost(refit: Refit, scale: float, prior: Prior, window: tuple[NetRecord, ...], move: np.ndarray) -> float:
    """The robust cost, record by record, a move (35; scaled) away from a refit."""
    setup, loss = begun_setup(), tuned("cauchy", 3)
    values = setup.space.moved(refit.origin, move)
    residuals = [setup.observer.linearise(values, record.readings[0])[0] for record in window]
    norms = np.linalg.norm(residuals, axis=1) / NOISE_M
    off = setup.space.between(prior.belief.origin, values) - prior.belief.gaussian.mean
    held = off @ np.linalg.solve(prior.belief.gaussian.covariance, off) / refit.widening**2
    return float(np.sum(loss.rho(norms / scale)) + 0.5 * held)


def test_a_refit_ends_where_the_robust_cost_is_least() -> None:
    setup, prior, arm = begun_setup(), _wide_prior(), World.drawn(4, outliers=0.2, outlier=0.3)
    arm.moved("arm.mdh.theta3", np.radians(14.4))
    arm.moved("arm.mdh.theta5", np.radians(-14.4))
    window, refitter = _window(arm, 40), Refitter(setup.observer)
    refit = refitter.refitted(Refit(setup.belief.origin, np.zeros(STATES)), prior, window, 40)
    assert tip_error_mm(setup, refit.origin, arm.values) < 0.5
    scale = refitter.innovations(refit.origin, refit.mean, window).scale(refit.taken)
    deviations = np.sqrt(np.diag(refitter.belief(refit, prior, window, 0).gaussian.covariance))
    here = _cost(refit, scale, prior, window, np.zeros(STATES))
    random = np.random.default_rng(1)
    for _ in range(20):
        along = random.normal(size=STATES) * deviations / np.sqrt(STATES)
        assert _cost(refit, scale, prior, window, along) > here
        assert _cost(refit, scale, prior, window, -along) > here


def _blind(recalibrator: Recalibrator, monkeypatch: pytest.MonkeyPatch) -> Recalibrator:
    """Its judgement finds nothing, whatever the records say: only the net is left."""
    monkeypatch.setattr(recalibrator._judge, "after", lambda state: (state, ()))
    return recalibrator


def _run(recalibrator: Recalibrator, arm: World, count: int) -> list[dict]:
    first = recalibrator.state.sequence
    return [event for k in range(count) for event in recalibrator.take(arm.record(), first + k + 1)]


@pytest.mark.slow
def test_a_filter_that_is_stuck_is_taken_over_by_a_refit(monkeypatch: pytest.MonkeyPatch) -> None:
    recalibrator, arm = _blind(begun(), monkeypatch), World.drawn(5, outliers=0.05)
    _run(recalibrator, arm, 20)
    assert not recalibrator.state.net.predictions[-1].relative[0] > 10
    arm.moved("arm.mdh.theta2", np.radians(14.4))
    arm.moved("arm.mdh.theta4", np.radians(-14.4))
    events = _run(recalibrator, arm, 25)
    (decision,) = told(events, "decision")
    assert decision["kind"] == "refit_took_over"
    assert 21 <= decision["since"] < decision["sequence"] <= 40
    assert decision["what"].startswith("A robust refit of the last")
    assert decision["tip_error_mm"] > 20
    assert tip_error_mm(arm.setup, recalibrator.values, arm.values) < 1.0
    assert recalibrator.state.health.level in ("watch", "nominal")


@pytest.mark.slow
def test_without_a_net_it_stays_stuck(monkeypatch: pytest.MonkeyPatch) -> None:
    recalibrator, arm = _blind(begun(settings(net=False)), monkeypatch), World.drawn(5, outliers=0.05)
    arm.moved("arm.mdh.theta2", np.radians(14.4))
    arm.moved("arm.mdh.theta4", np.radians(-14.4))
    assert not told(_run(recalibrator, arm, 40), "decision")
    assert tip_error_mm(arm.setup, recalibrator.values, arm.values) > 20
    assert recalibrator.state.net == NetState()


def test_off_in_a_file_of_settings_leaves_it_out(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text("net: off\n", encoding="utf-8")
    assert load_settings(path).net is False
    assert load_settings(None).net is True


def test_a_change_of_another_section_than_the_one_that_is_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("days: 3\nrecalibrate: {net: off}\n", encoding="utf-8")
    assert load_settings(path, ["recalibrate.gate.window=6"]).gate.window == 6
    for elsewhere in ("gate.window=6", "evaluator=interpreted", "recalibrates.net=on"):
        with pytest.raises(ConfigError, match=r"only the section recalibrate .*--set recalibrate\."):
            load_settings(path, [elsewhere])


@pytest.mark.slow
def test_a_net_that_was_interrupted_goes_on_to_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    one, arm = _blind(begun(), monkeypatch), World.drawn(6, outliers=0.05)
    arm.moved("arm.mdh.theta2", np.radians(14.4))
    records = [arm.record() for _ in range(32)]
    events, snapshots = [], []
    for k, record in enumerate(records):
        events.append(one.take(record, k + 1))
        snapshots.append(json.dumps(one.snapshot()))
    assert any(told(each, "decision") for each in events)
    other = _blind(begun(), monkeypatch)
    for k in (7, 9, 12, 20):
        other.restore(json.loads(snapshots[k]))
        assert json.dumps(other.snapshot()) == snapshots[k]
        for later in range(k + 1, min(k + 8, len(records))):
            assert other.take(records[later], later + 1) == events[later]
            assert json.dumps(other.snapshot()) == snapshots[later]
    assert json.dumps(other.snapshot()) == snapshots[27]


@pytest.mark.slow
def test_a_state_of_an_earlier_version_starts_an_empty_net() -> None:
    recalibrator = begun(settings(net=False))
    earlier = recalibrator.snapshot()
    whole = recalibrator.snapshot()
    del earlier["net"]
    recalibrator.restore(earlier)
    assert recalibrator.state.net == NetState()
    assert recalibrator.snapshot() == whole


@pytest.mark.slow
@pytest.mark.parametrize(
    ("outliers", "count"),
    [(0.0, 100), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((0.2, 100), (0.0, 2500), (0.2, 2500)))],
)
def test_no_refit_takes_over_from_a_filter_that_is_right(count: int, outliers: float) -> None:
    recalibrator, arm = begun(), World.drawn(8, outliers=outliers, outlier=0.2)
    taken_over = [d for d in told(_run(recalibrator, arm, count), "decision") if d["kind"] == "refit_took_over"]
    assert not taken_over
