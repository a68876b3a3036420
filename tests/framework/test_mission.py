"""A mission of three days: the judge against errors worked out apart, power cuts, and the command itself."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from armcal.base.config_text import plain
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.cli.main import cli
from armcal.errors import ConfigError, InputError
from armcal.estimate.simulation import DAY_S, Mission, SimulationRequest, measured_without_noise
from armcal_online.mission.errors import error_curve, random_poses
from armcal_online.mission.figure import mission_figure
from armcal_online.mission.files import curve_text, figures, schedule, surprise_text, truth_text, write_files
from armcal_online.mission.judge import Judgement, judge
from armcal_online.mission.log import MissionLog
from armcal_online.mission.mission import (
    MissionResult,
    MissionSource,
    PowerCutError,
    before_launch,
    recalibrated,
    simulated,
)
from armcal_online.mission.settings import MissionPlan
from armcal_online.tracking.settings import RecalibrateSettings
from click.testing import CliRunner, Result

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "mission.yaml"
SLIP = {"kind": "slip", "day": 0.6, "joint": "arm.q3", "parameter": "arm.mdh.theta3", "teeth": 1}
SWAP = {"kind": "swap", "day": 1.5, "joint": "arm.q2", "changes": {"arm.mdh.theta2": "-3 deg"}}
BUMP = {"kind": "bump", "day": 2.5, "shift_mm": [3, -2, 1], "turn_deg": [0.2, 0.4, -0.3]}
EVENTS, EARLY = (
    yaml.safe_dump(events, default_flow_style=True, width=10_000).strip()
    for events in ([SLIP, SWAP, BUMP], [{**SLIP, "day": 0.3}])
)
REFIT = "{records: 60, every: 100}"
SHORT = (
    "simulation.days=3",
    "simulation.records.every_min=20",
    f"simulation.events={EVENTS}",
    "simulation.power_cuts=[0.7, 1.55]",
    "mission.poses=20",
    f"mission.refit={REFIT}",
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
    return MissionPlan.load(CONFIG, SHORT)


@lru_cache
def mission() -> Mission:
    return simulated(plan())


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """The calibration before launch."""
    return Calibration.load(before_launch(plan(), tmp_path_factory.mktemp("bench")))


class Knowing:
    """A recalibration that knows the truth of ``lag`` records ago, and says what it is told to say."""

    def __init__(self, lag: int = 0, decisions: Mapping[str, Mapping[str, str]] | None = None) -> None:
        self.lag, self.decisions = lag, decisions or {}
        self.taken: list[str] = []
        self.positions: dict[str, int] = {}
        self.sessions = 0

    def __call__(
        self, calibration: Path, settings: RecalibrateSettings, source: MissionSource, folder: Path
    ) -> Sequence[Mapping[str, Any]]:
        assert settings.output.estimate_every_records == 1
        events: list[Mapping[str, Any]] = []
        if not self.sessions:
            truth = dict(zip(mission().truth.names, mission().truth.values_at(np.zeros(1))[0].tolist(), strict=True))
            parameters = [{"name": n, "value": truth[n]} for n in truth]
            events.append({"event": "started", "level": "nominal", "parameters": parameters, "resumed": False})
        else:
            events.append({"event": "started", "level": "nominal", "parameters": [], "resumed": True})
        self.sessions += 1
        source.resume(self.positions)
        try:
            while not source.ended:
                incoming = source.incoming(0)
                assert incoming is not None
                self.positions = {incoming.source_key: incoming.source_row}
                self.taken.append(incoming.record_id)
                events += self._told(incoming.source_row - 1, incoming.record_id)
        except PowerCutError:
            pass
        return events

    def _told(self, row: int, record_id: str) -> list[Mapping[str, Any]]:
        made = mission()
        verdict = "rejected" if made.outliers[row] else "accepted"
        values = made.truth.values_at(made.times[[max(0, row - self.lag)]])[0]
        estimate = {name: [float(x), 0.0] for name, x in zip(made.truth.names, values, strict=True)}
        events: list[Mapping[str, Any]] = [
            {"event": "record", "id": record_id, "verdict": verdict},
            {"event": "estimate", "parameters": estimate},
        ]
        for event in made.events:
            since = row - int(np.searchsorted(made.times, event.time))
            if since == 0:
                events.append({"event": "level", "to": "suspect"})
            if since == DECIDED_AFTER and event.kind in self.decisions:
                events.append({"event": "decision", "sentence": "So it is.", **self.decisions[event.kind]})
            if since == 20:
                events.append({"event": "level", "to": "watch"})
        return events


RIGHT = {
    "slip": {"kind": "joint_slipped", "joint": "arm.q3"},
    "swap": {"kind": "joint_replaced", "joint": "arm.q2"},
    "bump": {"kind": "sensor_moved"},
}


def judged(start: Calibration, session: Knowing, recovered: float | None = None) -> tuple[MissionLog, Judgement]:
    log = recalibrated(mission(), Path("calibration.yaml"), plan().recalibrate, session, Path("folder"))
    settings = plan().settings
    curve = error_curve(plan().experiment.system, start.parameters, mission(), log, settings, "interpreted")
    return log, judge(mission(), log, curve, settings.limit, recovered or settings.recovered)


def tips(values: np.ndarray, poses: Dataset) -> np.ndarray:
    """By the model that simulations use (N x 3, m)."""
    experiment = plan().experiment
    system, parameters = experiment.system, experiment.parameters.with_nominal(values)
    exact = measured_without_noise(
        SimulationRequest(system.arms, system.measurements, parameters, system.environment), poses
    )
    return np.array([exact[f"tracker.{axis}"] for axis in "xyz"]).T


@pytest.fixture(scope="module")
def knowing(start: Calibration) -> tuple[MissionLog, Judgement]:
    """Who knows the truth at each record, and names what happens."""
    return judged(start, Knowing(0, RIGHT))


def test_power_cuts_end_sessions_and_each_record_is_taken_once() -> None:
    session = Knowing()
    log = recalibrated(mission(), Path("c.yaml"), plan().recalibrate, session, Path("folder"))
    assert session.sessions == 3 and log.resumed == 2
    assert tuple(session.taken) == mission().records.ids


@pytest.mark.slow
def test_frozen_errors_are_distances_between_tips_worked_out_apart(
    start: Calibration, knowing: tuple[MissionLog, Judgement]
) -> None:
    curve, settings = knowing[1].curve, plan().settings
    joints = tuple(f"q{i}" for i in range(1, 7))
    poses = random_poses(mission().records, joints, "arm", settings.poses, settings.seed)
    before = tips(start.parameters.nominal(), poses)
    for i in np.linspace(0, len(curve.times) - 1, 7).astype(int):
        at = curve.times[[i]]
        camera = mission().truth.camera_T_base_at(at)[0]
        true = tips(mission().truth.values_at(at)[0], poses) @ camera[:3, :3].T + camera[:3, 3]
        assert curve.frozen[i] == pytest.approx(np.linalg.norm(before - true, axis=1).mean(), abs=1e-9)


def test_who_knows_the_truth_has_no_error_until_the_camera_moves(knowing: tuple[MissionLog, Judgement]) -> None:
    curve = knowing[1].curve
    bumped = curve.times >= 2.5 * DAY_S
    assert curve.recalibrated[curve.is_record & ~bumped].max() < 1e-9
    assert curve.recalibrated[bumped].min() > 0.001
    assert np.all(np.diff(curve.times) > 0) and curve.is_hour.sum() == 72
    assert curve.is_record.sum() == len(mission().records)


def test_events_are_named_right_and_nothing_is_missed(knowing: tuple[MissionLog, Judgement]) -> None:
    log, judgement = knowing
    assert [report.finding.verdict for report in judgement.events] == ["right"] * 3
    assert judgement.count("right") == 3 and judgement.count("missed") == 0 and judgement.false_alarms == ()
    made = mission()
    for report in judgement.events:
        row = int(np.searchsorted(made.times, report.occurrence.time)) + DECIDED_AFTER
        decision = report.finding.decision
        assert decision is not None and decision.time == made.times[row]
    counts = judgement.records
    assert counts["rejected"] == counts["outliers"] == made.outliers.sum() and counts["good_rejected"] == 0
    assert counts["accepted"] + counts["rejected"] + counts["ignored"] == counts["arrived"] == len(made.records)
    assert counts["made"] == counts["arrived"] + made.lost
    assert log.verdicts[made.records.ids[0]] in ("accepted", "rejected")


def test_recovery_is_counted_in_records_that_arrived(start: Calibration) -> None:
    """Who is ``lag`` records late has the new offset at the record after so many; warmth moves on meanwhile."""
    lag = 6
    _, judgement = judged(start, Knowing(lag, RIGHT), recovered=5.0)
    slip, swap, bump = judgement.events
    for report in (slip, swap):
        row = int(np.searchsorted(mission().times, report.occurrence.time))
        assert report.records == lag + 1
        assert report.seconds == pytest.approx(mission().times[row + lag] - report.occurrence.time)
        assert report.worst > 5 * report.before
    assert bump.records is None and bump.seconds is None


@pytest.mark.slow
def test_wrong_names_missed_events_and_false_alarms_are_told_apart(start: Calibration) -> None:
    wrong = {"slip": {"kind": "joint_slipped", "joint": "arm.q2"}, "swap": {"kind": "sensor_moved"}}
    _, judgement = judged(start, Knowing(0, wrong))
    assert [report.finding.verdict for report in judgement.events] == ["wrong", "wrong", "missed"]
    assert judgement.count("missed") == 1
    _, judgement = judged(start, Knowing(0, {"bump": {"kind": "general_change"}}))
    assert [report.finding.verdict for report in judgement.events] == ["missed", "missed", "vague"]
    made, apart = mission(), Knowing(0, {})
    told = apart._told

    def crying(row: int, record_id: str) -> list[Mapping[str, Any]]:
        alarm = {"event": "decision", "kind": "model_no_longer_fits", "sentence": "All is lost."}
        return [*told(row, record_id), *([alarm] if row == 2 else [])]

    apart._told = crying  # type: ignore[method-assign]
    _, judgement = judged(start, apart)
    (alarm,) = judgement.false_alarms
    assert alarm.kind == "model_no_longer_fits" and alarm.time == made.times[2]


def test_availability_needs_a_good_level_and_a_small_error(knowing: tuple[MissionLog, Judgement]) -> None:
    _, judgement = knowing
    curve = judgement.curve
    hours = [i for i in range(len(curve.times)) if curve.is_hour[i]]
    used = [curve.levels[i] in ("nominal", "watch") and curve.recalibrated[i] <= 0.003 for i in hours]
    assert judgement.availability == pytest.approx(np.mean(used))
    assert 0 < judgement.availability < 1
    made = mission()
    row = int(np.searchsorted(made.times, made.events[0].time))
    first = int(np.searchsorted(curve.times, made.times[row]))
    assert curve.levels[first - 1] == "nominal" and curve.levels[first] == "suspect"


def test_what_is_written_says_the_same_as_what_was_judged(knowing: tuple[MissionLog, Judgement]) -> None:
    log, judgement = knowing
    told = json.loads(json.dumps(figures("short", mission(), log, judgement), allow_nan=False))
    assert told["availability"] == judgement.availability and len(told["events"]) == 3
    assert sum(told["hours_at_level"].values()) == 72
    rows = list(csv.DictReader(truth_text(mission(), plan().experiment.parameters).splitlines()))
    assert [row["pose_id"] for row in rows] == list(mission().records.ids)
    slipped = [float(row["arm.mdh.theta3_deg"]) for row in rows]
    place = int(np.searchsorted(mission().times, 0.6 * DAY_S))
    assert slipped[place] - slipped[place - 1] == pytest.approx(14.4, abs=0.1)
    assert [row["outlier"] == "yes" for row in rows] == mission().outliers.tolist()
    planned = json.loads(json.dumps(schedule(mission())))
    assert [event["day"] for event in planned["events"]] == [0.6, 1.5, 2.5]
    assert planned["power_cuts"] == pytest.approx([0.7, 1.55])
    temperature = mission().truth.temperature_at(judgement.curve.times)
    lines = list(csv.DictReader(curve_text(judgement.curve, temperature).splitlines()))
    assert [float(line["frozen_mm"]) for line in lines] == pytest.approx(1000 * judgement.curve.frozen, abs=1e-5)


def test_the_figure_is_a_picture_of_fair_size(knowing: tuple[MissionLog, Judgement]) -> None:
    picture = mission_figure(mission(), knowing[1], "Three days", 30)
    assert picture.startswith(b"\x89PNG") and len(picture) > 20_000
    assert int.from_bytes(picture[16:20], "big") >= 1200


def test_a_calibration_of_another_arm_is_refused(start: Calibration) -> None:
    log = MissionLog({}, ((0.0, {}),), ((0.0, "nominal"),), (), 0)
    fewer = replace(start.parameters, blocks=start.parameters.blocks[1:])
    with pytest.raises(ConfigError, match="not those of the simulated arm"):
        error_curve(plan().experiment.system, fewer, mission(), log, plan().settings, "interpreted")


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
    for more in ((), ("--surprise", "1")):
        result = armcal("mission", str(other), "--out", str(tmp_path / "out"), *more)
        assert result.exit_code == 2 and "no truth over time" in result.output and "type: mission" in result.output


def test_a_surprise_minds_no_configured_event_after_the_last_day() -> None:
    with pytest.raises(ConfigError, match="before the mission ends after 2 days"):
        MissionPlan.load(CONFIG, (*SHORT, "simulation.days=2"))
    drawn, registry = {}, plan().experiment.registry
    for events in (EVENTS, "[]"):
        overrides = (*SHORT, "simulation.days=2", f"simulation.events={events}")
        drawn[events] = MissionPlan.surprised(CONFIG, 7, overrides, registry).planted
    assert drawn[EVENTS] == drawn["[]"] and all(event["day"] < 2 for event in drawn["[]"]["simulation"]["events"])


def test_a_surprise_is_repeated_from_its_file_with_what_the_command_line_changed(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(CONFIG.parent, tmp_path / "configs"))
    overrides = (*SHORT, "simulation.days=2", "simulation.losses.fraction=0.1", "mission.limit_mm=4", "name=rehearsal")
    drawn = MissionPlan.surprised(folder / CONFIG.name, 7, overrides, plan().experiment.registry)
    (folder / "surprise.yaml").write_text(surprise_text(drawn), encoding="utf-8")
    again = MissionPlan.load(folder / "surprise.yaml")
    assert again.settings == drawn.settings and again.recalibrate == drawn.recalibrate
    one, other = (plain(p.experiment.source.data) for p in (drawn, again))
    assert one == other and one["simulation"]["days"] == 2 and one["name"] == "rehearsal"


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
    texts = {"bench.csv", "records.csv", "calibration.yaml", "truth.csv", "truth.json", "mission.csv", "mission.json"}
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
    calibration = f"mission={{calibration: {folder / 'calibration.yaml'}, poses: 20, refit: {REFIT}}}"
    again, told = flown(tmp_path / "out", *SHORT, "simulation.power_cuts=[]", calibration)
    assert told["resumed"] == 0
    assert (again / "mission.csv").read_bytes() == (folder / "mission.csv").read_bytes()


@pytest.mark.parametrize("days", ["one_day", pytest.param("short", marks=pytest.mark.slow)])
def test_the_recalibrated_arm_is_better_than_the_frozen_one(days: str, request: pytest.FixtureRequest) -> None:
    _, told = request.getfixturevalue(days)
    assert told["error_mm"]["recalibrated"]["median"] < 0.2 * told["error_mm"]["frozen"]["median"]
    slip = told["events"][0]
    assert slip["named"] == "right" and slip["recovered_after_records"] is not None
    assert slip["decided_after_hours"] == pytest.approx(24 * (slip["decision"]["day"] - slip["day"]))
    if days == "short":  # one day is too short for a refit
        assert set(told["error_mm"]) == {"frozen", "refit", "refit_recent", "recalibrated"}
        assert told["worst_ratio_to_recent_refit"]["ratio"] > 0


def test_records_of_the_mission_are_what_was_simulated(one_day: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = one_day
    rows = list(csv.DictReader((folder / "records.csv").open()))
    records = simulated(MissionPlan.load(CONFIG, ONE_DAY)).records
    assert [row["pose_id"] for row in rows] == list(records.ids)
    read = np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in rows]) / 1000
    assert np.allclose(read.T, records.stacked([f"tracker.{axis}" for axis in "xyz"]), atol=1e-12)


def test_a_mission_writes_through_no_link(
    start: Calibration, knowing: tuple[MissionLog, Judgement], tmp_path: Path
) -> None:
    """One that stands by its end where one of its files goes, however it came there."""
    folder, elsewhere = tmp_path / "out", tmp_path / "elsewhere.csv"
    folder.mkdir()
    (folder / "mission.csv").symlink_to(elsewhere)
    with pytest.raises(InputError, match=r"mission\.csv: it is a link"):
        write_files(folder, plan(), MissionResult(mission(), start, *knowing), {})
    assert not elsewhere.exists()
