"""Causes that no list of effects has: none is named with certainty for another, and what was held is named."""

from __future__ import annotations

from pathlib import Path

import pytest
from planted_causes import CAUSES, experiment, graded, left, recording

SEEDS = 8
QUICK = ("a held length a4", "a held twist alpha2", "a target that moved", "a link that grew")


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
