"""Requests that tell how warm the arm is: against the calibration's predictions and ``armcal compensate``."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal_serve.answers import Answerer
from click.testing import CliRunner
from made_calibrations import written
from serving import answered, ask, made, told
from small_arms import calibration, predicted

NAMES = ["q1", "q2", "q3"]
HERE = {"position_mm": [1, 2, 3]}
REFERENCE_C = -40.0
HEAT = f"arms.arm.effects.heat={{type: thermal_length, reference_C: {REFERENCE_C}}}"
POSTURES_DEG = [[10.0, 20.0, 30.0], [-40.0, 35.0, -60.0], [80.0, -15.0, 50.0]]
NEAR = {"start_deg": [9, 19, 29], "units": "deg"}


@pytest.fixture(scope="module")
def warm_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An elastic arm of three joints whose links grow with the temperature."""
    return written(calibration("three", HEAT), tmp_path_factory.mktemp("warm") / "warm.yaml")


@pytest.fixture(scope="module")
def warm(warm_path: Path) -> Answerer:
    return made(warm_path.read_text())


@pytest.fixture(scope="module")
def other(warm_path: Path) -> Answerer:
    """The same arm, whose lengths are what they are."""
    return made(written(calibration("three"), warm_path.with_name("other.yaml")).read_text())


def places_mm(postures_deg: Any, **channels: Any) -> np.ndarray:
    """Of the tool, by the calibration's own prediction."""
    return 1000 * predicted(calibration("three", HEAT), np.deg2rad(postures_deg), **channels)[:, :3, 3]


def commanded(answer: dict[str, Any]) -> np.ndarray:
    assert all(command["reached"] for command in answer["commands"]), answer
    return np.array([command["joint_angles_deg"] for command in answer["commands"]])


@pytest.mark.slow
def test_a_warm_arm_is_where_the_calibration_predicts_it(warm: Answerer) -> None:
    for said, channels in (
        ({}, {}),
        ({}, {"temperature": REFERENCE_C}),
        ({"temperature_C": REFERENCE_C}, {}),
        ({"temperature_C": 0}, {"temperature": 0.0}),
        ({"temperature": "60 °C", "payload_g": 300}, {"temperature": 60.0, "payload": 0.3}),
    ):
        answer = told(warm, do="forward", joint_angles_deg=POSTURES_DEG, **said)
        found = np.array([tool["position_mm"] for tool in answer["tools"]])
        assert found == pytest.approx(places_mm(POSTURES_DEG, **channels), abs=1e-9)
    assert np.abs(places_mm(POSTURES_DEG) - places_mm(POSTURES_DEG, temperature=60.0)).max() > 0.1


@pytest.mark.parametrize("path", [False, True])
def test_targets_are_reached_at_the_temperature_of_the_request(warm: Answerer, path: bool) -> None:
    near = places_mm(POSTURES_DEG[:1])[0]
    targets = [{"position_mm": (near + np.array([0, 2 * i, 0])).tolist()} for i in range(5)]
    for temperature in (None, 35.0):
        stated = {} if temperature is None else {"temperature_C": temperature}
        answer = told(warm, do="compensate", targets=targets, path=path, **NEAR, **stated)
        actual = REFERENCE_C if temperature is None else temperature
        reached = places_mm(commanded(answer), temperature=np.full(5, actual))
        assert reached == pytest.approx(np.array([t["position_mm"] for t in targets]), abs=1e-5)
        tools = [command["tool"]["position_mm"] for command in answer["commands"]]
        assert np.array(tools) == pytest.approx(reached, abs=1e-5)


@pytest.mark.parametrize("temperature", [None, 60.0])
def test_the_command_line_finds_the_same(warm: Answerer, warm_path: Path, temperature: float | None) -> None:
    places = places_mm(POSTURES_DEG, temperature=10.0)
    said = {} if temperature is None else {"temperature_C": temperature}
    table, out = warm_path.with_name("targets.csv"), warm_path.with_name("commands.csv")
    rows = [",".join(["x_mm", "y_mm", "z_mm", *said])]
    rows += [",".join(map(repr, [*place.tolist(), *said.values()])) for place in places]
    table.write_text("\n".join(rows) + "\n")
    words = ["compensate", warm_path, "--targets", table, "--out", out]
    start = [word for q, at in zip(NAMES, NEAR["start_deg"], strict=False) for word in ("--start", f"{q}={at} deg")]
    result = CliRunner().invoke(cli, [*map(str, words), *start])
    assert result.exit_code == 0, result.output
    with out.open() as file:
        expected = [[float(row[f"q{i}_deg"]) for i in (1, 2, 3)] for row in csv.DictReader(file)]
    targets = [{"position_mm": place.tolist()} for place in places]
    answer = told(warm, do="compensate", targets=targets, **NEAR, **said)
    assert commanded(answer) == pytest.approx(np.array(expected), abs=1e-6)


def test_what_is_wrong_with_a_temperature_is_said(other: Answerer, warm: Answerer) -> None:
    forward = {"do": "forward", "joint_angles_deg": POSTURES_DEG}
    single = {"do": "compensate", "targets": [HERE, HERE]}
    for who, request, where, says in (
        (warm, forward | {"temperature": 20}, "temperature", "unit missing: write temperature_C: 20"),
        (warm, forward | {"temperature_C": -273.2}, "temperature_C", "greater than or equal to -273.15"),
        (
            warm,
            forward | {"temperature_mm": 20},
            "temperature_mm",
            "(length), expected temperature: write temperature_C",
        ),
        (warm, forward | {"temperature_C": [20, 30, 40]}, "temperature_C", "expected a number"),
        (warm, forward | {"humidity_1": 0.5}, "humidity_1", "unknown key"),
        (other, forward | {"temperature_C": 20}, "temperature_C", "does not change"),
        (warm, single | {"targets": HERE | {"temperature_C": 20}}, "targets.0.temperature_C", "unknown key"),
        (other, single | {"temperature_C": 20}, "temperature_C", "does not change"),
    ):
        answer = ask(who, **request)
        assert not answer["ok"] and answer["where"] == where, answer
        assert says in answer["error"], answer
    infinite = b'{"do": "forward", "joint_angles_deg": [1, 2, 3], "temperature_C": 1e999}'
    assert "finite" in json.loads(answered(warm, infinite))["error"]
    assert other.arms["arm"].shown == {"joints": NAMES, "point": "tool"}
    assert warm.arms["arm"].shown == {"joints": NAMES, "conditions": ["temperature_C"], "point": "tool"}
