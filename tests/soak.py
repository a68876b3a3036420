"""Trials of random cases: how many, in members that test workers share."""

from __future__ import annotations

import os

import pytest

TIMES = int(os.environ.get("ARMCAL_SOAK", "1"))
"""``ARMCAL_SOAK=10 make test-all`` tries ten times as many cases of each trial."""


def shares(first: int, count: int, members: int) -> list[object]:
    """Slow parameters, each a range of seeds: from ``first``, ``count`` in all, times ``ARMCAL_SOAK``."""
    step = -(-count * TIMES // members)
    ranges = (range(first + i * step, first + (i + 1) * step) for i in range(members))
    return [pytest.param(r, id=f"{r.start}-{r.stop - 1}", marks=pytest.mark.slow) for r in ranges]
