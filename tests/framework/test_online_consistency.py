"""Whether an online filter knows how wrong it is: errors and innovations against chi-square, and planted lies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from armcal.estimate.online import normalised_innovation_squared
from armcal_kalman.filters import ExtendedFilter, ExtendedSettings
from armcal_online.state import FilterSetup
from online_arm import STATES, Filtered, World, begun, begun_setup, nees, random_walk, settings, told
from scipy.stats import chi2

pytestmark = pytest.mark.slow

UPDATES = 300


@dataclass(frozen=True)
class Study:
    """Surprise and error of each update (runs x updates)."""

    nis: np.ndarray
    nees: np.ndarray

    @property
    def band(self) -> tuple[float, float]:
        """Of 95 % for the mean NEES of all runs."""
        runs = len(self.nees)
        low, high = chi2.ppf([0.025, 0.975], STATES * runs) / runs
        return float(low), float(high)

    @property
    def inside(self) -> float:
        """Share of steps whose mean lies in the band."""
        low, high = self.band
        mean = self.nees.mean(axis=0)
        return float(np.mean((mean > low) & (mean < high)))

    def sees_by_nees(self) -> bool:
        return self.inside < 0.5

    def sees_by_nis(self) -> bool:
        """Beyond what chance makes of its mean, four standard deviations, and the figure that a sound one keeps."""
        return abs(self.nis.mean() - 3) > max(0.05, 4 * np.sqrt(6 / self.nis.size))


def study(runs: int, setup: FilterSetup, world: Callable[[int], World], updates: int = UPDATES) -> Study:
    nis, errors = np.zeros((runs, updates)), np.zeros((runs, updates))
    for run in range(runs):
        arm, one = world(run), Filtered.fresh(ExtendedFilter(ExtendedSettings()), setup)
        for k in range(updates):
            arm.step()
            update = one.take(arm.measured())
            nis[run, k] = normalised_innovation_squared(update.innovation, update.covariance)
            errors[run, k] = nees(setup, one.belief, arm.values)
    return Study(nis, errors)


@pytest.mark.parametrize("runs", [12, pytest.param(50, marks=pytest.mark.slow)])
def test_nees_and_nis_of_a_sound_filter(runs: int) -> None:
    found = study(runs, begun_setup(), World.drawn)
    low, high = found.band
    print(
        f"\nNEES of {runs} runs of {UPDATES}: mean {found.nees.mean():.2f}, {100 * found.inside:.1f} % of steps in "
        f"[{low:.2f}, {high:.2f}]; NIS {found.nis.mean():.3f}"
    )
    assert found.inside >= 0.9
    assert abs(found.nis.mean() - 3) <= 0.05
    # Not only its mean: the whole distribution of surprise is chi-square.
    for share in (0.5, 0.9, 0.99):
        assert np.mean(found.nis < chi2.ppf(share, 3)) == pytest.approx(share, abs=4 * np.sqrt(0.25 / found.nis.size))


def _drawn(**given) -> Callable[[int], World]:
    return lambda seed: World.drawn(seed, **given)


BIAS = np.array([0.0, 0.001, 0.0])
LIES = {
    "a quarter of the noise": (lambda: begun_setup(noise_mm=0.15), _drawn(), True, True),
    "no process noise under drift": (lambda: begun_setup(walk=0.0), _drawn(), True, True),
    # Surprise cannot tell: records take the prior's place before their number makes it significant.
    "half the prior's deviations": (lambda: begun_setup(sd_factor=0.5), _drawn(), False, True),
    "1 mm bias": (
        lambda: begun_setup(held_base=True),
        lambda seed: World.drawn(seed, begun_setup(held_base=True), bias=BIAS),
        True,
        True,
    ),
    # A shift of the base is a parameter of its own: records cannot tell a biased instrument from it.
    "1 mm bias, base free": (lambda: begun_setup(), _drawn(bias=BIAS), False, True),
}


@pytest.mark.slow
@pytest.mark.parametrize("lie", LIES)
def test_a_planted_inconsistency_is_seen(lie: str) -> None:
    setup, world, by_nis, by_nees = LIES[lie]
    found = study(2, setup(), world)
    print(f"\n{lie}: NIS {found.nis.mean():.2f}, NEES {found.nees.mean():.0f}, {100 * found.inside:.0f} % in the band")
    assert found.sees_by_nees() == by_nees
    if by_nis:
        assert found.sees_by_nis()
    else:
        assert abs(found.nis.mean() - 3) < 0.4


@pytest.mark.slow
@pytest.mark.parametrize("held", [False, True])
def test_what_is_sound_is_not_seen_as_inconsistent(held: bool) -> None:
    setup = begun_setup(held_base=held)
    found = study(2, setup, lambda seed: World.drawn(100 + seed, setup))
    assert not found.sees_by_nees() and not found.sees_by_nis()


NOTICED = {
    "a quarter of the noise": ({"noise_mm": 0.15}, {}, {}),
    "no process noise under drift": ({}, {"process_noise": {}}, {}),
    "1 mm bias": ({"held_base": True}, {"process_noise": random_walk(1, True)}, {"bias": BIAS}),
}


@pytest.mark.slow
@pytest.mark.parametrize("lie", NOTICED)
def test_the_recalibrator_notices(lie: str) -> None:
    of, changed, world = NOTICED[lie]
    recalibrator = begun(settings(**changed), **of)
    fresh, after = recalibrator.snapshot(), []
    for seed in range(2):
        recalibrator.restore(fresh)
        arm = World.drawn(seed, begun_setup(held_base=of.get("held_base", False)), **world)
        for sequence in range(1, UPDATES + 1):
            events = recalibrator.take(arm.record(), sequence)
            if told(events, "decision"):
                break
        else:
            pytest.fail(f"{lie}: no decision in {UPDATES} records")
        assert recalibrator.state.health.level != "nominal"
        after.append((sequence, told(events, "decision")[0]["kind"]))
    print(f"\n{lie}: first decision after {', '.join(f'{n} ({kind})' for n, kind in after)}")


@pytest.mark.slow
@pytest.mark.parametrize("runs", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_the_recalibrator_stays_calm_where_all_is_as_stated(runs: int) -> None:
    recalibrator = begun()
    fresh = recalibrator.snapshot()
    for seed in range(runs):
        recalibrator.restore(fresh)
        arm = World.drawn(seed)
        for sequence in range(1, UPDATES + 1):
            events = recalibrator.take(arm.record(), sequence)
            assert not told(events, "decision") and not told(events, "level")
