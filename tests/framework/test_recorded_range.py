"""Poses beyond the records of a calibration are named: nothing tested there how far off predictions are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.calibration.intervals import beyond_records, recorded_ranges

ARMS: Any = {"arm": SimpleNamespace(command_channels={"arm.q1": "angle", "arm.rail": "length"})}


def dataset(**channels: list[float]) -> Dataset:
    named = {name if name == "payload" else f"arm.{name}": np.array(values) for name, values in channels.items()}
    return Dataset(tuple(map(str, range(len(next(iter(named.values())))))), named)


RECORDED = recorded_ranges(dataset(q1=[-1.0, np.nan, 1.0], rail=[0.2, 0.2, 0.2]), ARMS, 0.1)


def test_the_range_is_that_of_the_records_or_the_configured_payload() -> None:
    assert RECORDED == {"payload": (0.1, 0.1), "arm.q1": (-1.0, 1.0), "arm.rail": (0.2, 0.2)}
    stated = recorded_ranges(dataset(q1=[0.0, 1.0], payload=[0.0, 0.5]), ARMS, 0.1)
    assert stated == {"payload": (0.0, 0.5), "arm.q1": (0.0, 1.0)}


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        ({"q1": [0.5, 1.1, -1.1], "rail": [0.2, 0.21, 0.19]}, ""),
        ({"q1": [0.5, np.nan]}, ""),
        (
            {"q1": [0.5, 2.0, -1.3]},
            "2 of 3 poses are beyond the calibration's records (q1 114.6 deg, recorded -57.3 to",
        ),
        ({"rail": [0.2, 0.5]}, "1 of 2 poses are beyond the calibration's records (rail 500 mm, recorded 200)"),
        ({"q1": [0.0], "payload": [0.3]}, "(payload 300 g, recorded 100)"),
        ({"q1": [0.0], "payload": [0.105]}, ""),
    ],
)
def test_what_lies_beyond_is_named_with_its_unit(poses: dict[str, list[float]], words: str) -> None:
    beyond, sentence = beyond_records(RECORDED, dataset(**poses), ARMS)
    assert beyond.any() == bool(words)
    assert (words in sentence and sentence.endswith("was not tested there.")) if words else not sentence


def test_a_calibration_that_keeps_no_ranges_warns_of_nothing() -> None:
    beyond, sentence = beyond_records({}, dataset(q1=[99.0]), ARMS)
    assert not beyond.any() and not sentence
