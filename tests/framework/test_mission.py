"""A mission of three days: its errors against those worked out apart, power cuts, and the command itself."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.calibration.calibration import Calibration
from armcal.cli.main import cli
from armcal.errors import ConfigError
from armcal.estimate.simulation import SimulationRequest, measured_without_noise
from armcal_online.mission import (
    ErrorCurve,
    MissionLog,
    MissionPlan,
    before_launch,
    curve_text,
    error_curve,
    figures,
    mission_figure,
    random_poses,
)
from armcal_online.mission_simulator import DAY_S, Mission, with_payload
from click.testing import CliRunner, Result

from tests.mission_decisions import occurrences, verdicts

pytestmark = pytest.mark.slow

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "mission.yaml"
SLIP = {"kind": "slip", "day": 0.6, "joint": "arm.q3", "changes": {"arm.mdh.theta3": "14.4 deg"}}
SWAP = {"kind": "swap", "day": 1.5, "joint": "arm.q2", "changes": {"arm.mdh.theta2": "-3 deg"}}
BUMP = {"kind": "bump", "day": 2.5, "shift_mm": [3, -2, 1], "turn_deg": [0.2, 0.4, -0.3]}
EVENTS, EARLY = (
    yaml.safe_dump(events, default_flow_style=True, width=10_000).strip()
    for events in ([SLIP, SWAP, BUMP], [{**SLIP, "day": 0.3}])
)
SHORT = (
    "simulation.days=3",
    "simulation.records.every_min=20",
    f"simulation.events={EVENTS}",
    "simulation.power_cuts=[0.7, 1.55]",
    "mission.poses=20",
)
ONE_DAY = (
    *SHORT,
    "simulation.days=1.2",
    f"simulation.events={EARLY}",
    "simulation.power_cuts=[0.4, 0.9]",
)
INTERPRETED = ("evaluator=interpreted", "recalibrate.evaluator=interpreted")
DECIDED_AFTER = 3


@lru_cache
def plan() -> MissionPlan:
    return MissionPlan.load(CONFIG, (*SHORT, *INTERPRETED))


@lru_cache
def mission() -> Mission:
    return plan().simulated()


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> Parameters:
    """The calibration before launch."""
    return with_payload(Calibration.load(before_launch(plan(), tmp_path_factory.mktemp("bench"))).parameters)


def knowing_log(lag: int = 0) -> MissionLog:
    """Of a recalibration that knows the truth of ``lag`` records ago, and names what happens after a few records."""
    made, log = mission(), MissionLog()
    times, names = dict(zip(made.records.ids, made.times.tolist(), strict=True)), made.truth.parameters.entry_names
    truth = dict(zip(names, made.truth.values_at(np.zeros(1))[0].tolist(), strict=True))
    parameters = [{"name": n, "value": truth[n]} for n in truth]
    log.take({"event": "started", "level": "nominal", "parameters": parameters, "resumed": False}, times)
    begun = {event.kind: int(np.searchsorted(made.times, event.day * DAY_S)) for event in made.settings.events}
    for row, record in enumerate(made.records.ids):
        verdict = "rejected" if made.outliers[row] else "accepted"
        values = made.truth.values_at(made.times[[max(0, row - lag)]])[0]
        estimate = {name: [float(x), 0.0] for name, x in zip(names, values, strict=True)}
        events: list[Mapping[str, Any]] = [
            {"event": "record", "id": record, "verdict": verdict},
            {"event": "estimate", "parameters": estimate},
        ]
        for kind, first in begun.items():
            if row == first:
                events.append({"event": "level", "to": "suspect"})
            if row == first + DECIDED_AFTER:
                events.append({"event": "decision", "sentence": "So it is.", **RIGHT[kind]})
            if row == first + 20:
                events.append({"event": "level", "to": "watch"})
        for event in events:
            log.take(event, times)
    return log


RIGHT = {
    "slip": {"kind": "joint_slipped", "joint": "arm.q3"},
    "swap": {"kind": "joint_replaced", "joint": "arm.q2"},
    "bump": {"kind": "sensor_moved"},
}


def tips(values: np.ndarray, poses: Dataset) -> np.ndarray:
    """By the model that simulations use (N x 3, m)."""
    experiment = plan().experiment
    system, parameters = experiment.system, with_payload(experiment.parameters).with_nominal(values)
    exact = measured_without_noise(
        SimulationRequest(system.arms, system.measurements, parameters, system.environment), poses
    )
    return np.array([exact[f"tracker.{axis}"] for axis in "xyz"]).T


@pytest.fixture(scope="module")
def knowing(start: Parameters) -> tuple[ErrorCurve, dict[str, Any]]:
    """Who knows the truth at each record, and names what happens."""
    log = knowing_log()
    curve = error_curve(plan(), start, mission(), log, {})
    return curve, figures(plan(), mission(), log, curve)


@pytest.mark.slow
def test_frozen_errors_are_distances_between_tips_worked_out_apart(
    start: Parameters, knowing: tuple[ErrorCurve, dict[str, Any]]
) -> None:
    curve, poses = knowing[0], random_poses(plan(), mission())
    before = tips(start.nominal(), poses)
    for i in np.linspace(0, len(curve.times) - 1, 7).astype(int):
        at = curve.times[[i]]
        camera = mission().truth.camera_T_base_at(at)[0]
        true = tips(mission().truth.values_at(at)[0], poses) @ camera[:3, :3].T + camera[:3, 3]
        assert curve.errors["frozen"][i] == pytest.approx(np.linalg.norm(before - true, axis=1).mean(), abs=1e-9)


def test_who_knows_the_truth_has_no_error_until_the_camera_moves(knowing: tuple[ErrorCurve, dict[str, Any]]) -> None:
    curve = knowing[0]
    bumped, errors = curve.times >= 2.5 * DAY_S, curve.errors["recalibrated"]
    assert errors[curve.is_record & ~bumped].max() < 1e-9
    assert errors[bumped].min() > 0.001
    assert np.all(np.diff(curve.times) > 0) and curve.is_hour.sum() == 72
    assert curve.is_record.sum() == len(mission().records)


def test_events_have_the_first_decision_after_them_and_records_are_counted(
    knowing: tuple[ErrorCurve, dict[str, Any]],
) -> None:
    told, made = json.loads(json.dumps(knowing[1], allow_nan=False)), mission()
    for event, kind in zip(told["events"], RIGHT, strict=True):
        row = int(np.searchsorted(made.times, event["day"] * DAY_S)) + DECIDED_AFTER
        assert event["decision"] == RIGHT[kind]["kind"]
        assert event["decided_after_hours"] == pytest.approx(made.times[row] / 3600 - 24 * event["day"])
    assert verdicts(occurrences(made.settings.events, 3), told["decisions"]) == (["right"] * 3, [])
    counts = told["records"]
    assert counts["rejected"] == counts["outliers"] == made.outliers.sum() == len(told["outliers"])
    assert counts["good_rejected"] == counts["outliers_accepted"] == counts["ignored"] == 0
    assert counts["accepted"] + counts["rejected"] == counts["arrived"] == len(made.records)
    assert told["power_cuts"] == pytest.approx([0.7, 1.55]) and told["began"] == made.settings.began


def test_recovery_is_counted_in_records_that_arrived(start: Parameters, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who is ``lag`` records late has the new offset at the record after so many; warmth moves on meanwhile."""
    monkeypatch.setattr("armcal_online.mission._RECOVERED", 5.0)
    log = knowing_log(lag := 6)
    slip, swap, bump = figures(plan(), mission(), log, error_curve(plan(), start, mission(), log, {}))["events"]
    for event in (slip, swap):
        assert event["recovered_after_records"] == lag + 1
        assert event["aftermath"] == f"recovered in {lag + 1} records"
    assert bump["recovered_after_records"] is None and bump["aftermath"] == "not recovered"


def test_availability_needs_a_good_level_and_a_small_error(knowing: tuple[ErrorCurve, dict[str, Any]]) -> None:
    curve, told = knowing
    hours = [i for i in range(len(curve.times)) if curve.is_hour[i]]
    used = [curve.levels[i] in ("nominal", "watch") and curve.errors["recalibrated"][i] <= 0.003 for i in hours]
    assert told["availability"] == pytest.approx(np.mean(used))
    assert 0 < told["availability"] < 1
    made = mission()
    row = int(np.searchsorted(made.times, 0.6 * DAY_S))
    first = int(np.searchsorted(curve.times, made.times[row]))
    assert curve.levels[first - 1] == "nominal" and curve.levels[first] == "suspect"


def test_the_curve_has_every_error_and_the_truth(knowing: tuple[ErrorCurve, dict[str, Any]]) -> None:
    curve, rows = knowing[0], list(csv.DictReader(curve_text(knowing[0], mission()).splitlines()))
    assert [float(row["frozen_mm"]) for row in rows] == pytest.approx(1000 * curve.errors["frozen"], abs=1e-5)
    at_records = [np.degrees(float(row["arm.mdh.theta3"])) for row in rows if row["moment"] == "record"]
    assert len(at_records) == len(mission().records)
    place = int(np.searchsorted(mission().times, 0.6 * DAY_S))
    assert at_records[place] - at_records[place - 1] == pytest.approx(14.4, abs=0.1)
    assert "arm.mdh.d1" not in rows[0]


def test_the_figure_is_a_picture_of_fair_size(knowing: tuple[ErrorCurve, dict[str, Any]]) -> None:
    picture = mission_figure(*knowing)
    assert picture.startswith(b"\x89PNG") and len(picture) > 20_000
    assert int.from_bytes(picture[16:20], "big") >= 1200


def test_a_calibration_of_another_arm_is_refused(start: Parameters) -> None:
    fewer = replace(start, blocks=start.blocks[1:])
    with pytest.raises(ConfigError, match="not those of the simulated arm"):
        error_curve(plan(), fewer, mission(), MissionLog(levels=[(0.0, "nominal")]), {})


def armcal(*arguments: str) -> Result:
    """One command in this process."""
    return CliRunner().invoke(cli, list(arguments))


def overridden(*settings: str) -> list[str]:
    return [part for setting in settings for part in ("--set", setting)]


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (["mission=null"], "mission"),
        (["mission.limit_mm=-1"], "limit"),
        (["mission.calibration=arm.yaml"], "both or neither"),
        (["simulation.days=0"], "days"),
        (["recalibrate.no_such_key=1"], "no_such_key"),
        (["simulation.losses.fraction=1"], "no record arrives"),
    ],
)
def test_bad_missions_end_with_2_and_a_sentence(settings: list[str], told: str, tmp_path: Path) -> None:
    result = armcal("mission", str(CONFIG), "--out", str(tmp_path / "out"), *overridden(*SHORT, *settings))
    assert result.exit_code == 2 and told in result.output, result.output
    assert "Traceback" not in result.output


def test_a_simulator_without_a_truth_over_time_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.yaml"
    other.write_text(
        (CONFIG.parent / "mission_bench.yaml").read_text(encoding="utf-8") + "mission: {calibration: c.yaml}\n"
    )
    for name in ("mission_arm.yaml", "arm.yaml", "mission_truth.yaml"):
        (tmp_path / name).write_text((CONFIG.parent / name).read_text(encoding="utf-8"))
    result = armcal("mission", str(other), "--out", str(tmp_path / "out"))
    assert result.exit_code == 2 and "no truth over time" in result.output and "type: mission" in result.output


def test_a_mission_goes_to_no_folder_with_other_files(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    result = armcal("mission", str(CONFIG), "--out", str(tmp_path))
    assert result.exit_code == 2 and "mine.txt" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def flown(folder: Path, *settings: str) -> tuple[Path, dict[str, Any]]:
    """A mission through the command: its folder and what it prints."""
    result = armcal("mission", str(CONFIG), "--out", str(folder), "--json", *overridden(*settings, *INTERPRETED))
    assert result.exit_code == 0, result.output
    return folder, json.loads(result.stdout)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Three days, with a slip, a swap, a bump and two power cuts."""
    return flown(tmp_path_factory.mktemp("mission") / "out", *SHORT)


@pytest.fixture(scope="module")
def one_day(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A day and some hours, most of them after a slip, with two power cuts."""
    return flown(tmp_path_factory.mktemp("mission") / "out", *ONE_DAY)


def test_the_command_leaves_every_file(one_day: tuple[Path, dict[str, Any]]) -> None:
    folder, told = one_day
    texts = {"bench.csv", "records.csv", "calibration.yaml", "mission.csv", "mission.json"}
    assert {path.name for path in folder.iterdir()} == texts | {"mission.png", "recalibration"}
    assert json.loads((folder / "mission.json").read_text())["error_mm"] == told["error_mm"]
    assert Calibration.load(folder / "recalibration" / "calibration.yaml").parameters.names


@pytest.mark.parametrize("days", ["one_day", pytest.param("short", marks=pytest.mark.slow)])
def test_the_recalibration_goes_on_after_power_cuts_and_sees_every_record(
    days: str, request: pytest.FixtureRequest
) -> None:
    _, told = request.getfixturevalue(days)
    assert told["resumed"] == 2
    counts = told["records"]
    assert counts["accepted"] + counts["rejected"] + counts["ignored"] == counts["arrived"]
    assert counts["ignored"] == 0


@pytest.mark.slow
def test_power_cuts_change_nothing(short: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """To the last digit of every error at every moment: the journal is all that a restart needs."""
    folder, _ = short
    calibration = f"mission={{calibration: {folder / 'calibration.yaml'}, poses: 20}}"
    again, told = flown(tmp_path / "out", *SHORT, "simulation.power_cuts=[]", calibration)
    assert told["resumed"] == 0
    assert (again / "mission.csv").read_bytes() == (folder / "mission.csv").read_bytes()


@pytest.mark.parametrize("days", ["one_day", pytest.param("short", marks=pytest.mark.slow)])
def test_the_recalibrated_arm_is_better_than_the_frozen_one(days: str, request: pytest.FixtureRequest) -> None:
    _, told = request.getfixturevalue(days)
    assert told["error_mm"]["recalibrated"]["median"] < 0.2 * told["error_mm"]["frozen"]["median"]
    slip = told["events"][0]
    assert slip["recovered_after_records"] is not None
    loaded = MissionPlan.load(CONFIG, SHORT if days == "short" else ONE_DAY)
    found, _ = verdicts(occurrences(loaded.simulator._settings.events, told["days"]), told["decisions"])
    assert found[0] == "right" and slip["decision"] in ("joint_slipped", "joint_named")
    assert set(told["error_mm"]) == {"frozen", "recalibrated"}


def test_records_of_the_mission_are_what_was_simulated(one_day: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = one_day
    rows = list(csv.DictReader((folder / "records.csv").open()))
    records = MissionPlan.load(CONFIG, ONE_DAY).simulated().records
    assert [row["pose_id"] for row in rows] == list(records.ids)
    read = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in rows]) / 1000
    assert np.allclose(read.T, records.stacked([f"tracker.{axis}" for axis in "xyz"]), atol=1e-12)


@pytest.mark.parametrize("fault", [ModuleNotFoundError("No module", name="matplotlib"), ImportError("libfreetype")])
def test_a_missing_or_broken_library_is_told_before_the_mission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: ImportError
) -> None:
    def failing(name: str) -> None:
        assert name == "matplotlib"
        raise fault

    monkeypatch.setattr("armcal_online.mission.import_module", failing)
    monkeypatch.setattr("armcal_online.mission.run_mission", lambda *_: pytest.fail("it began first"))
    done = CliRunner().invoke(cli, ["mission", str(CONFIG), "--out", str(tmp_path / "out")])
    assert done.exit_code in (1, 2) and isinstance(done.exception, SystemExit)
    assert "Traceback" not in done.output
    if isinstance(fault, ModuleNotFoundError):
        assert "armcal mission needs the library matplotlib" in done.output and "'armcal[figures]'" in done.output
    else:
        assert "cannot be loaded (libfreetype)" in done.output and "armcal doctor" in done.output
