"""What the filter has no hypothesis for, in short missions: it must not be worse than a robust refit of 40 records."""

from __future__ import annotations

import numpy as np
import pytest

from tests.mission_study import CASES, flown, row, table

SEEDS = (1, 2)


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in CASES if case != "nothing"])
def test_the_filter_is_better_than_a_robust_refit_of_the_last_records_and_than_no_recalibration(case: str) -> None:
    rows = [row(flown(case, seed)) for seed in SEEDS]
    print("\n".join(table({case: rows})))
    assert np.median([one.ratio for one in rows]) < 1
    assert all(one.filter_mm < one.frozen_mm for one in rows)
