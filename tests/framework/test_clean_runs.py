"""A sound recording is never called bad, whatever made it, and seldom warned of; each check states how often."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from armcal.diagnose.checks import DATA_CHECKS, EXACT, FIT_CHECKS, NOTES, Check
from armcal.plugins import use_plugins
from clean_runs import KINDS, RECORD, run
from scipy.stats import binom

from docs.tools.checks_page import PAGE, as_markdown

RUNS = 4


@pytest.fixture(autouse=True)
def _no_plugins_afterwards() -> Iterator[None]:
    yield
    use_plugins()


@pytest.mark.quick("range")
@pytest.mark.parametrize("kind", KINDS)
def test_sound_recordings_are_not_bad(kind: str, tmp_path: Path) -> None:
    """200 of each are the study of ``python -m tests.clean_runs``."""
    config = KINDS[kind].config(tmp_path)
    outcomes = [run(kind, seed, config) for seed in range(RUNS)]
    assert not [outcome.said for outcome in outcomes if outcome.grade in ("bad", "refused")]


OF_RUNS = json.loads(RECORD.read_text(encoding="utf-8"))
CHECKS = [check for check in (*DATA_CHECKS, *FIT_CHECKS) if check.rate not in (EXACT, NOTES)]
ALL_RUNS = sum(own["runs"] for own in OF_RUNS.values())


@pytest.mark.parametrize("kind", KINDS)
def test_at_most_five_percent_of_sound_recordings_are_warned_of(kind: str) -> None:
    own = OF_RUNS[kind]
    assert own["runs"] >= 200 and set(own["grades"]) <= {"good", "warning"}
    assert own["grades"].get("warning", 0) <= 0.05 * own["runs"]


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_each_check_warns_of_sound_recordings_as_often_as_it_states(check: Check) -> None:
    """By its level, beyond which chance seldom (1 in 1,000) goes; or by what was counted."""
    warned = sum(own["checks"].get(check.name, 0) for own in OF_RUNS.values())
    if check.rate.endswith(" %"):
        assert warned <= binom.ppf(0.999, ALL_RUNS, float(check.rate.removesuffix(" %")) / 100)
    else:
        assert check.rate == f"{warned} of {ALL_RUNS:,}"


def test_levels_add_up_to_five_percent_of_all_runs() -> None:
    """But that of a held scale, of which few recordings have one."""
    levels = {check.name: float(check.rate.removesuffix(" %")) for check in CHECKS if check.rate.endswith(" %")}
    assert sum(level for name, level in levels.items() if name != "scale") <= 5.0 + 1e-9


def test_the_page_of_checks_is_that_of_the_list() -> None:
    assert as_markdown() == PAGE.read_text(encoding="utf-8")
