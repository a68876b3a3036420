"""The offset between the clocks of joints and measurement, from the motions between rests."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import recorded_bags as bags
from armcal.errors import DataError
from armcal.run.experiment import Experiment


@pytest.fixture(scope="module")
def tour(tmp_path_factory: pytest.TempPathFactory) -> bags.Tour:
    return bags.made_tour(tmp_path_factory.mktemp("tour"), rests=16)


def estimated(tour: bags.Tour, bag: Path) -> tuple[float, float]:
    """The offset and the half width of its interval (ms)."""
    dataset = Experiment.load(bags.of_bag(tour, bag, clock_offset="estimate")).read()
    sentence = re.search(r"tracker is (\S+) \+- (\S+) ms ahead", " ".join(dataset.warnings))
    assert sentence is not None and len(dataset) == len(tour.rests)
    return float(sentence[1]), float(sentence[2])


@pytest.mark.quick("-812.5")
@pytest.mark.parametrize("ahead_ms", [37.0, -812.5, 3_600_250.0])
def test_an_offset_is_found_within_its_interval(tour: bags.Tour, ahead_ms: float) -> None:
    bag = bags.write_bag(tour.config.with_name(f"ahead_{ahead_ms:.0f}"), tour.sent(ahead_ms / 1000))
    offset, half_width = estimated(tour, bag)
    assert half_width < 0.5
    assert abs(offset - ahead_ms) < 2 * half_width


@pytest.mark.slow
def test_play_of_the_joints_is_not_taken_for_a_clock(tmp_path: Path) -> None:
    """A tool that follows only after 2 deg of play comes late where each motion begins, and not where it ends."""
    tour = bags.made_tour(tmp_path, rests=16, play_deg=2.0)
    offset, half_width = estimated(tour, bags.write_bag(tmp_path / "bag", tour.sent(0.037)))
    assert abs(offset - 37) < 1 and half_width < 1


@pytest.mark.slow
def test_clocks_that_drift_apart_are_named(tour: bags.Tour) -> None:
    at, seen = tour.seen
    fast = replace(tour, seen=(at + 0.002 * (at - at[0]), seen))
    bag = bags.write_bag(tour.config.with_name("fast"), fast.sent())
    dataset = Experiment.load(bags.of_bag(tour, bag, clock_offset="estimate")).read()
    sentence = re.search(r"it grew by (\S+) ms during the recording", " ".join(dataset.warnings))
    assert sentence is not None and float(sentence[1]) == pytest.approx(2 * np.ptp(tour.rests[:-1]), rel=0.15)


@pytest.mark.slow
def test_intervals_hold_as_often_as_they_state(tmp_path: Path) -> None:
    """Of 40 recordings the 95 % interval holds the offset in at least 34: less has a probability of 0.003."""
    held = 0
    for seed in range(40):
        folder = tmp_path / str(seed)
        folder.mkdir()
        tour = bags.made_tour(folder, rests=12, seed=seed)
        offset, half_width = estimated(tour, bags.write_bag(folder / "bag", tour.sent(0.037)))
        held += abs(offset - 37) <= half_width
    assert held >= 34


@pytest.mark.slow
def test_what_cannot_be_known_is_refused_with_the_reason(tour: bags.Tour) -> None:
    at, seen = tour.seen
    times, joints = tour.joints
    random = np.random.default_rng(1)
    faulty = {
        "few": (replace(tour, joints=(times[:500], joints[:500])), "motions of more than 20 mm"),
        "other": (replace(tour, seen=(at, seen[::-1].copy())), "(does not follow the joints|motions disagree)"),
        "still": (replace(tour, seen=(at, seen[0] + random.normal(0, 1e-4, seen.shape))), "does not follow the joints"),
        "sparse": (replace(tour, seen=(at[::20], seen[::20])), "the measurement saw"),
    }
    for name, (changed, reason) in faulty.items():
        bag = bags.write_bag(tour.config.with_name(name), changed.sent())
        with pytest.raises(DataError, match=f"cannot be estimated: .*{reason}.*clock_offset_ms"):
            estimated(tour, bag)
