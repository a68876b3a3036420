"""The golden set: every entry is recorded, and the comparison sees what a user would see."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest

from tests import golden


@pytest.fixture(scope="module")
def recorded() -> dict[str, dict[str, golden.Record]]:
    return dict(json.loads(golden.RECORDED.read_text()))


def test_every_entry_is_recorded_with_its_files_and_no_other_is(recorded: dict[str, Any]) -> None:
    assert [entry.name for entry in golden.ENTRIES] == list(recorded)
    for entry in golden.ENTRIES:
        files = recorded[entry.name]
        assert len(files) > len(entry.reads), entry.name
        assert all(files.values()), entry.name


def test_it_is_written_as_it_is_read(recorded: dict[str, Any]) -> None:
    assert golden.written(recorded) == golden.RECORDED.read_text()
    assert len(golden.RECORDED.read_bytes()) < 1.5e6


@pytest.mark.parametrize(("change", "seen"), [(1e-5, True), (1e-8, False)])
def test_a_changed_digit_is_seen_and_rounding_is_not(recorded: dict[str, Any], change: float, seen: bool) -> None:
    for file, key in (
        ("calibration.yaml", "parameters.arm.mdh.a4.value"),
        ("metrics.json", "error_mm.calibrated.holdout"),
        ("residuals.csv", "calibrated_mm"),
    ):
        before = recorded["lrm-demo"][file]
        after = copy.deepcopy(before)
        one = after[key]
        if isinstance(one, dict):
            one["mean" if "mean" in one else "sum"] *= 1 + change
        else:
            after[key] = one * (1 + change)
        assert [k for k, _, _ in golden.differences(before, after)] == ([key] if seen else []), file


def test_a_changed_sentence_and_a_missing_one_are_seen(recorded: dict[str, Any]) -> None:
    before = recorded["lrm-demo"]["metrics.json"]
    key = next(k for k, v in before.items() if isinstance(v, str) and v.startswith("Strongly correlated"))
    after = {**before, key: before[key].replace("Strongly", "Tightly")}
    assert golden.differences(before, after) == [(key, before[key], after[key])]
    after = {k: v for k, v in before.items() if k != key}
    assert golden.differences(before, after) == [(key, before[key], "(nothing)")]


def test_a_count_a_state_and_the_order_of_rows_are_seen() -> None:
    assert golden.same(12, 12) and not golden.same(12, 13) and not golden.same(True, 1)
    assert golden.same([1.0, 1e-9], [1.0, 2e-9]) and not golden.same([1.0, 1e-3], [1.0, 2e-3])
    rows = [{"x": f"{i / 3:.6f}", "name": "abc"[i % 3]} for i in range(30)]
    before = dict(golden._columns(rows))
    assert golden.differences(before, dict(golden._columns(rows[::-1])))
    last = [{**row, "x": row["x"][:-1] + "9"} if i == 4 else row for i, row in enumerate(rows)]
    assert not golden.differences(before, dict(golden._columns(last))), "the last digit may be rounded either way"
