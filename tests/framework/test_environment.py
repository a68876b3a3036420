"""Columns of load, gravity and time that are incomplete, misspelt or jump."""

from __future__ import annotations

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.errors import DataError
from armcal.measure.checks import noticed


def records(count: int = 10, extra: tuple[str, ...] = (), **channels: object) -> Dataset:
    """A dataset with these channels and these unused columns."""
    columns = {name: np.broadcast_to(np.asarray(value, dtype=float), count) for name, value in channels.items()}
    unused = dict.fromkeys(extra, ("",) * count)
    return Dataset(tuple(str(i) for i in range(1, count + 1)), columns, unused, source="poses.csv")


@pytest.mark.parametrize("vector", ["gravity", "force", "torque", "payload"])
def test_a_vector_without_all_its_components_is_refused(vector: str) -> None:
    with pytest.raises(DataError, match=f"poses.csv: {vector} has no {vector}_x, {vector}_y. Give all three"):
        noticed(records(**{f"{vector}_z": 1.0}))
    whole = {f"{vector}_{axis}": 1.0 for axis in "xyz"}
    assert noticed(records(**whole)).warnings == ()


def test_a_payload_without_its_centre_is_whole() -> None:
    assert noticed(records(payload=0.1)).warnings == ()


def test_a_misspelt_column_is_warned_of_and_others_are_left_alone() -> None:
    told = noticed(records(extra=("paylod_g", "operator", "note_mm"))).warnings
    assert len(told) == 1 and "paylod_g" in told[0] and "payload" in told[0]


def test_a_long_pause_is_warned_of_with_its_records() -> None:
    seconds = np.arange(10.0) * 15
    assert noticed(records(time=seconds)).warnings == ()
    seconds[6:] += 3600
    (told,) = noticed(records(time=seconds)).warnings
    assert "3615 s" in told and "records 6 and 7" in told
