"""A sound recording is never called bad, whatever instrument made it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from armcal.plugins import use_plugins
from clean_runs import KINDS, run

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
