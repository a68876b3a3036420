"""``armcal acceptance`` as a user meets it: nominal beside calibrated, the files, and what it says to bad input."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli
from click.testing import CliRunner, Result
from made_calibrations import exact_calibration
from made_calibrations import written as store

CONFIG = """
arms: {arm: {model: {type: mdh, convention: standard, rows: [{a_mm: 300}, {a_mm: 200}]}}}
measurements: {tracker: {type: tip_position, noise_mm: 0.1}}
statics: {gravity_m_s2: [0, 0, -9.81], body: earth, payload_g: 0}
data: {type: csv, path: none.csv}
"""
POSES = {"P1": (10.0, 20.0), "P2": (-30.0, 60.0), "P3": (40.0, -50.0)}
Rows = list[dict[str, object]]


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(each) for each in arguments])


def rows_of(cycles: int = 4) -> Rows:
    """Visits of a planar arm whose links are 301 and 199.5 mm long, by trigonometry."""
    random, rows = np.random.default_rng(2), []
    for cycle in range(1, cycles + 1):
        for pose, (q1, q2) in POSES.items():
            first, both = np.deg2rad([q1, q1 + q2])
            place = [301 * np.cos(first) + 199.5 * np.cos(both), 301 * np.sin(first) + 199.5 * np.sin(both), 0]
            x, y, z = place + random.normal(scale=0.02, size=3)
            rows.append({"pose": pose, "cycle": cycle, "q1_deg": q1, "q2_deg": q2, "x_mm": x, "y_mm": y, "z_mm": z})
    return rows


def written(path: Path, rows: Rows) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "arm.yaml"
    path.write_text(CONFIG, encoding="utf-8")
    return path


def test_a_calibration_stands_beside_its_nominal_arm_in_every_file(config: Path, tmp_path: Path) -> None:
    made = exact_calibration(config, {"arm.mdh.a1": 0.301, "arm.mdh.a2": 0.1995})
    calibration = store(made, tmp_path / "calibration.yaml")
    records = written(tmp_path / "records.csv", rows_of())
    done = armcal("acceptance", calibration, records, "--out", tmp_path / "out", "--frame", "stated")
    assert done.exit_code == 0, done.output
    told = json.loads((tmp_path / "out" / "acceptance.json").read_text())
    assert told["summary"]["nominal"]["AP_mm"]["mean"] > 0.5 > 0.05 > told["summary"]["calibrated"]["AP_mm"]["mean"]
    assert abs(told["summary"]["nominal"]["AD_mm"]["mean"]) > 0.2 > told["summary"]["calibrated"]["AD_mm"]["mean"]
    rows = list(csv.DictReader((tmp_path / "out" / "acceptance.csv").open()))
    stated = {(r["of"], r["model"]): float(r["value"]) for r in rows if r["figure"] == "AP_mm"}
    for row in told["poses"]:
        for model in ("nominal", "calibrated"):
            assert stated[row["pose"], model] == pytest.approx(row[model]["AP_mm"]["value"], rel=1e-5)
    page = (tmp_path / "out" / "acceptance.html").read_text()
    assert page.count("data:image/png") == 2 and "<script" not in page and "http" not in page.replace("http-equiv", "")
    assert "ISO 9283 asks for 30" in page and "ISO 9283 asks for 30" in " ".join(done.stdout.split())


def _without(column: str) -> Callable[[Rows], Rows]:
    return lambda rows: [{key: value for key, value in row.items() if key != column} for row in rows]


def _with(place: int, **changes: object) -> Callable[[Rows], Rows]:
    return lambda rows: [{**row, **changes} if i == place else row for i, row in enumerate(rows)]


def _in_metres(rows: Rows) -> Rows:
    return [
        {**row, **{f"{a}_mm": float(str(row[f"{a}_mm"])) / 1000 for a in "xyz"}} if i >= 9 else row
        for i, row in enumerate(rows)
    ]


def _exchanged(rows: Rows) -> Rows:
    own = [{f"{a}_mm": rows[i][f"{a}_mm"] for a in "xyz"} for i in (4, 3)]
    return [*rows[:3], {**rows[3], **own[0]}, {**rows[4], **own[1]}, *rows[5:]]


def _never_measured(rows: Rows) -> Rows:
    return [{**row, "x_mm": "", "y_mm": ""} if row["pose"] == "P2" else row for row in rows]


BAD: dict[str, tuple[Callable[[Rows], Rows], str]] = {
    "a missing joint": (_without("q2_deg"), "q2"),
    "a missing coordinate": (_without("z_mm"), "found no column for tracker.z, expected z_m or z_cm or z_mm"),
    "a coordinate without its unit": (
        lambda rows: [{("x" if k == "x_mm" else k): v for k, v in row.items()} for row in rows],
        "x has no unit",
    ),
    "one cycle": (lambda rows: rows[:3], "the pose P1 has one measured visit. Repeatability needs two visits"),
    "one cycle, poses not named": (
        lambda rows: _without("pose")(rows[:3]),
        "none of 3 poses was visited twice",
    ),
    "a pose never measured": (
        _never_measured,
        "records.csv:3, x_mm: the pose P2 was never measured; 4 of its rows were set aside",
    ),
    "rows in metres": (_in_metres, "among them if its coordinates are in m. Write all rows in the unit"),
    "exchanged rows": (_exchanged, "those to P2. If two rows were exchanged, put them right"),
    "a cycle twice": (_with(3, cycle=1), "records.csv:5, cycle: found cycle 1 of P1 again; the first is in line 2"),
    "a cycle that is none": (_with(3, cycle=1.5), "records.csv:5, cycle: found the cycle 1.5, expected a whole"),
    "a cycle in words": (_with(3, cycle="first"), "records.csv:5, cycle"),
    "a pose without a name": (_with(3, pose=" "), "records.csv:5, pose: no pose is named"),
    "half a commanded pose": (
        lambda rows: [{**row, "commanded_x_mm": 1} for row in rows],
        "expected commanded_y too",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_records_are_refused_with_their_place_and_mend(case: str, config: Path, tmp_path: Path) -> None:
    change, expected = BAD[case]
    records = written(tmp_path / "records.csv", change(rows_of()))
    done = armcal("acceptance", config, records, "--out", tmp_path / "out")
    assert done.exit_code == 2, done.output
    assert expected in " ".join(done.output.split())
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


@pytest.mark.slow
def test_one_value_that_is_missing_costs_its_record_and_is_named(config: Path, tmp_path: Path) -> None:
    records = written(tmp_path / "records.csv", _with(4, x_mm="nan")(rows_of()))
    done = armcal("acceptance", config, records, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "line 6" in done.output and "set aside" in " ".join(done.output.split())
    told = json.loads((tmp_path / "out" / "acceptance.json").read_text())
    assert {row["pose"]: row["cycles"] for row in told["poses"]} == {"P1": 4, "P2": 3, "P3": 4}
    assert {row["from"] + row["to"]: row["cycles"] for row in told["distances"]} == {"P1P2": 3, "P1P3": 4, "P2P3": 3}


def test_an_arm_that_no_instrument_sees_is_refused(tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text(CONFIG.replace("tip_position, noise_mm: 0.1", "plane, noise_mm: 0.1"))
    records = written(tmp_path / "records.csv", rows_of())
    done = armcal("acceptance", tmp_path / "arm.yaml", records, "--out", tmp_path / "out")
    assert done.exit_code == 2 and "Traceback" not in done.output


@pytest.mark.slow
def test_one_name_for_two_commanded_poses_is_named(config: Path, tmp_path: Path) -> None:
    rows, random = rows_of(), np.random.default_rng(1)
    for row in rows[::3]:
        row["q2_deg"] = 20.0 + random.normal(scale=0.1)
        both, first = np.deg2rad(30.0 + float(str(row["q2_deg"])) - 20.0), np.deg2rad(10)
        row["x_mm"], row["y_mm"] = (301 * f(first) + 199.5 * f(both) for f in (np.cos, np.sin))
    done = armcal("acceptance", config, written(tmp_path / "records.csv", rows), "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "visits to P1 were commanded up to" in " ".join(done.output.split())


@pytest.mark.slow
def test_a_visit_that_lies_out_is_named_and_counts(config: Path, tmp_path: Path) -> None:
    rows = rows_of(10)
    far = _with(9, y_mm=float(str(rows[9]["y_mm"])) + 3)(rows)
    done = armcal("acceptance", config, written(tmp_path / "records.csv", far), "--out", tmp_path / "out")
    assert done.exit_code == 0 and "1 of 10 visits to P1 lie out" in " ".join(done.output.split())
    assert "line 11" in done.output
