"""The characteristics of ISO 9283: by hand, by Monte Carlo with a known truth; and what is said to bad input."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armcal.calibration.intervals import PredictionRecord
from armcal.cli.main import cli
from armcal_capability import acceptance as of
from click.testing import CliRunner, Result
from made_calibrations import exact_calibration
from made_calibrations import written as store
from scipy.spatial.transform import Rotation

PLANAR = """
arms: {arm: {model: {type: mdh, convention: standard, rows: [{a_mm: 300}, {a_mm: 200}]}}}
measurements: {tracker: {type: tip_position, noise_mm: 0.1}}
statics: {gravity_m_s2: [0, 0, -9.81], body: earth, payload_g: 0}
data: {type: csv, path: none.csv}
"""
"""x = 300 cos q1 + 200 cos(q1 + q2), y with sines; z = 0."""
SPATIAL = """
arms:
  arm:
    model:
      type: mdh
      convention: standard
      base: [{x_mm: 0}, {y_mm: 0}, {z_mm: 0}, {rz_deg: 0}, {ry_deg: 0}, {rx_deg: 0}]
      rows: [{a_mm: 60, alpha_deg: 90, d_mm: 100}, {a_mm: 300}, {a_mm: 200, alpha_deg: 60}, {d_mm: 90, alpha_deg: 90}]
measurements: {tracker: {type: tip_pose, noise_mm: 0.1, orientation_noise_deg: 0.05}}
statics: {gravity_m_s2: [0, 0, -9.81], body: earth, payload_g: 0}
parameters: {free: ["arm.mdh.base_*", "tracker.target_*"]}
data: {type: csv, path: none.csv}
"""


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(each) for each in arguments])


def judged(folder: Path, config: str, rows: Sequence[dict[str, object]], *options: object) -> dict:
    """The content of acceptance.json for rows of a table."""
    (folder / "arm.yaml").write_text(config, encoding="utf-8")
    with (folder / "records.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    out = folder / "out"
    done = armcal("acceptance", folder / "arm.yaml", folder / "records.csv", "--out", out, "--json", *options)
    assert done.exit_code == 0, done.output
    return json.loads((out / "acceptance.json").read_text())


def row_of(told: dict, name: str, of: str = "P1", model: str = "measured", other: str | None = None) -> dict:
    """The one figure of this name, of a pose (with a direction or another pose), by a model."""
    found = [
        row
        for row in told["figures"]
        if (row["figure"], row["of"], row["model"]) == (name, of, model) and other in (None, row["with"])
    ]
    assert len(found) == 1, found
    return found[0]


def planar_rows(offsets: dict[str, Sequence[Sequence[float]]]) -> list[dict[str, object]]:
    """Visits to P1 at (500, 0, 0), P2 at (300, 200, 0) mm, each off by so much (mm)."""
    poses = {"P1": (0, 0, (500, 0, 0)), "P2": (0, 90, (300, 200, 0))}
    rows: list[dict[str, object]] = []
    for name, own in offsets.items():
        q1, q2, place = poses[name]
        for cycle, off in enumerate(own, start=1):
            x, y, z = np.add(place, off)
            row = {"pose": name, "cycle": cycle, "time_s": len(rows), "q1_deg": q1, "q2_deg": q2}
            rows.append({**row, "x_mm": x, "y_mm": y, "z_mm": z})
    return rows


def test_accuracy_repeatability_and_distances_are_those_of_a_calculation_by_hand(tmp_path: Path) -> None:
    """Four visits in the corners of a square about (1, 2, 2), so AP = 3 and RP = 1; and one that spreads along x."""
    square = [(2, 2, 2), (0, 2, 2), (1, 3, 2), (1, 1, 2)]
    line = [(0, 0, 0), (0, 0, 0), (0, 0, 2), (0, 0, 2)]
    told = judged(tmp_path, PLANAR, planar_rows({"P1": square, "P2": line}))
    assert row_of(told, "AP_mm", "P1", "nominal")["value"] == pytest.approx(3)
    by_axis = [row_of(told, f"AP_{axis}_mm", "P1", "nominal")["value"] for axis in "xyz"]
    assert by_axis == pytest.approx([1, 2, 2])
    assert row_of(told, "RP_mm", "P1")["value"] == pytest.approx(1), "all distances are 1: mean 1, no deviation"
    assert row_of(told, "AP_mm", "P2", "nominal")["value"] == pytest.approx(1)
    assert row_of(told, "RP_mm", "P2")["value"] == pytest.approx(1)
    # P1 - P2 = (200, -200, 0) commanded; attained differs by the offsets of the same cycle
    attained = np.linalg.norm(np.add((200, -200, 0), np.subtract(square, line)), axis=1)
    distance = row_of(told, "AD_mm", "P1", "nominal", "P2")
    assert distance["value"] == pytest.approx(np.mean(attained) - np.hypot(200, 200))
    assert row_of(told, "RD_mm", "P1", other="P2")["value"] == pytest.approx(3 * np.std(attained, ddof=1))
    words = "as stated: nothing was fitted to these records"
    assert told["frames"]["nominal"] == {"numbers_found": 0, "words": words}


def test_the_variation_over_directions_is_the_widest_distance_of_barycentres(tmp_path: Path) -> None:
    rows = planar_rows({"P1": [(0.5, 0, 0), (-0.5, 0, 0)] * 3})
    for row, direction, off in zip(rows, "xxyyzz", (0, 0, 3, 3, 3, 3), strict=True):
        row |= {"direction": direction, "y_mm": off, "z_mm": 4 if direction == "z" else 0}
    told = judged(tmp_path, PLANAR, rows)
    assert row_of(told, "vAP_mm", other="x, y, z")["value"] == pytest.approx(5)
    each = [row_of(told, "RP_mm", other=direction)["value"] for direction in "xyz"]
    assert each == pytest.approx([0.5] * 3), "each direction by itself"


@pytest.mark.slow
@pytest.mark.parametrize("visits", [3, 8])
def test_intervals_of_few_visits_contain_the_truth_as_often_as_they_say(visits: int) -> None:
    """Known truth: sd 0.1, 0.2 and 0.4 along the axes, AP 0.5; RP of the truth by a million draws of the definition."""
    random, sizes = np.random.default_rng(visits), np.array([0.1, 0.2, 0.4])
    far = np.linalg.norm(random.standard_normal((1_000_000, 3)) * sizes, axis=1)
    truth = far.mean() + 3 * far.std()
    held = np.zeros(3)
    for _ in range(200):
        errors = random.standard_normal((visits, 3)) * sizes + [0.3, 0.4, 0.0]
        found = (of.accuracy(errors), of.repeatability(errors), of.spread_figure(errors[:, 2]))
        held += [f.low <= true <= f.high for f, true in zip(found, (0.5, truth, 1.2), strict=True)]
    assert (held / 200 >= 0.91).all(), held / 200
    assert held[2] / 200 <= 0.99, "chi-square is exact"


def test_repeatability_of_many_visits_is_the_truth() -> None:
    """Of isotropic noise of 1 the distances are Maxwell's: mean 2 sqrt(2/pi), variance 3 - 8/pi."""
    positions = np.random.default_rng(1).standard_normal((5000, 3))
    expected = 2 * np.sqrt(2 / np.pi) + 3 * np.sqrt(3 - 8 / np.pi)
    assert of.repeatability(positions).value == pytest.approx(expected, rel=0.02)


def _spatial_rows(random: np.random.Generator, poses: int, cycles: int) -> tuple[list[dict[str, object]], np.ndarray]:
    """Rows of a spatial arm that repeats to 0.02 mm and 0.01 deg, by forward kinematics of its own."""
    commands = random.uniform(-1.2, 1.2, (poses, 4))
    rows, tools = [], []
    for cycle in range(1, cycles + 1):
        for i, q in enumerate(commands):
            turn, place = _forward(q + np.deg2rad(0.2) * np.sin(3 * i + np.arange(4)))
            turn = turn * Rotation.from_rotvec(random.normal(scale=np.deg2rad(0.01), size=3))
            rows.append({"pose": f"P{i + 1}", "cycle": cycle, **{f"q{j + 1}_rad": x for j, x in enumerate(q)}})
            tools.append((turn, place + random.normal(scale=2e-5, size=3)))
    return rows, np.array([np.r_[place, turn.as_quat()[[3, 0, 1, 2]]] for turn, place in tools])


def _forward(q: Sequence[float]) -> tuple[Rotation, np.ndarray]:
    """The spatial arm's tool, row by row: Rot_z(q) Trans(a, 0, d) Rot_x(alpha)."""
    turn, place = Rotation.identity(), np.zeros(3)
    for angle, (a, d, alpha) in zip(q, ((0.06, 0.1, 90), (0.3, 0, 0), (0.2, 0, 60), (0, 0.09, 90)), strict=True):
        turn = turn * Rotation.from_rotvec([0, 0, angle])
        place = place + turn.apply([a, 0, d])
        turn = turn * Rotation.from_rotvec([np.deg2rad(alpha), 0, 0])
    return turn, place


def _measured(rows: list[dict[str, object]], tools: np.ndarray, base: Rotation, shift: np.ndarray) -> list[dict]:
    """Rows as an instrument sees them that has the base elsewhere, and the body turned on the tool."""
    mounted, offset = Rotation.from_rotvec([0.2, -0.5, 0.9]), np.array([0.01, 0.03, 0.05])
    seen = []
    for row, tool in zip(rows, tools, strict=True):
        turn = Rotation.from_quat(tool[[4, 5, 6, 3]])
        place = base.apply(tool[:3] + turn.apply(offset)) + shift
        quaternion = (base * turn * mounted).as_quat()[[3, 0, 1, 2]]
        own = dict(zip(("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"), (*place, *quaternion), strict=True))
        seen.append({**row, **own})
    return seen


def test_where_the_frame_is_found_the_instruments_pose_changes_no_figure(tmp_path: Path) -> None:
    rows, tools = _spatial_rows(np.random.default_rng(4), 12, 4)
    told = []
    for name, base, shift in (
        ("near", Rotation.identity(), np.zeros(3)),
        ("far", Rotation.from_rotvec([0.7, -1.9, 1.1]), np.array([2.0, -3.0, 0.5])),
    ):
        (tmp_path / name).mkdir()
        told.append(judged(tmp_path / name, SPATIAL, _measured(rows, tools, base, shift), "--frame", "found"))
    near, far = told
    assert near["frames"]["nominal"]["numbers_found"] == 9
    assert "(2000.0, -3000.0, 500.0)" not in near["frames"]["nominal"]["words"]
    assert len(near["figures"]) == len(far["figures"])
    for one, other in zip(near["figures"], far["figures"], strict=True):
        assert {**one, "value": 0, "low_95": 0, "high_95": 0} == {**other, "value": 0, "low_95": 0, "high_95": 0}
        assert one["value"] == pytest.approx(other["value"], abs=1e-5, rel=1e-6)
    turns = [row["value"] for row in near["figures"] if row["figure"] in ("RP_a_deg", "RP_b_deg", "RP_c_deg")]
    assert np.mean(turns) == pytest.approx(3 * 0.01, rel=0.3)
    for axis in "abc":
        assert 0.01 < near["summary"]["nominal"][f"AP_{axis}_deg"]["mean"] < 0.5, "joints are up to 0.2 deg off"


def test_a_stated_frame_is_taken_as_it_is_and_one_that_the_records_contradict_is_named(tmp_path: Path) -> None:
    rows, tools = _spatial_rows(np.random.default_rng(4), 12, 3)
    shift = np.array([0.0, 0.1, 0.0])
    told = judged(tmp_path, SPATIAL, _measured(rows, tools, Rotation.identity(), shift))
    assert told["summary"]["nominal"]["AP_mm"]["mean"] > 60
    assert any("--frame found" in text for text in told["warnings"])


@pytest.mark.slow
def test_a_frame_found_from_few_poses_is_said_to_make_the_accuracy_smaller(tmp_path: Path) -> None:
    rows, tools = _spatial_rows(np.random.default_rng(4), 5, 3)
    told = judged(tmp_path, SPATIAL, _measured(rows, tools, Rotation.identity(), np.zeros(3)), "--frame", "found")
    assert any("9 numbers of base and target were found from the 15 coordinates" in t for t in told["warnings"])


@pytest.mark.slow
def test_records_in_another_order_give_the_same_figures(tmp_path: Path) -> None:
    rows, tools = _spatial_rows(np.random.default_rng(5), 6, 5)
    rows = _measured(rows, tools, Rotation.identity(), np.zeros(3))
    mixed = [rows[i] for i in np.random.default_rng(6).permutation(len(rows))]
    told = []
    for name, own in (("kept", rows), ("mixed", mixed)):
        (tmp_path / name).mkdir()
        told.append(judged(tmp_path / name, SPATIAL, own, "--frame", "found"))
    for name, tolerance in (("AP_mm", {"abs": 1e-4}), ("RD_mm", {"rel": 1e-9})):
        one, other = (
            {frozenset((r["of"], r["with"])): r["value"] for r in each["figures"] if r["figure"] == name}
            for each in told
        )
        assert one == pytest.approx(other, **tolerance), "pairs are of the same cycle"


PLACES = {"P1": (10.0, 20.0), "P2": (-30.0, 60.0), "P3": (40.0, -50.0)}
Rows = list[dict[str, object]]


def rows_of(cycles: int = 4) -> Rows:
    """Visits of a planar arm whose links are 301 and 199.5 mm long, by trigonometry."""
    random, rows = np.random.default_rng(2), []
    for cycle in range(1, cycles + 1):
        for pose, (q1, q2) in PLACES.items():
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
    path.write_text(PLANAR, encoding="utf-8")
    return path


def test_a_calibration_stands_beside_its_nominal_arm_in_every_file(config: Path, tmp_path: Path) -> None:
    made = exact_calibration(config, {"arm.mdh.a1": 0.301, "arm.mdh.a2": 0.1995})
    calibration = store(made, tmp_path / "calibration.yaml")
    records = written(tmp_path / "records.csv", rows_of())
    done = armcal("acceptance", calibration, records, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    told = json.loads((tmp_path / "out" / "acceptance.json").read_text())
    assert told["summary"]["nominal"]["AP_mm"]["mean"] > 0.5 > 0.05 > told["summary"]["calibrated"]["AP_mm"]["mean"]
    assert abs(told["summary"]["nominal"]["AD_mm"]["mean"]) > 0.2 > told["summary"]["calibrated"]["AD_mm"]["mean"]
    rows = list(csv.DictReader((tmp_path / "out" / "acceptance.csv").open()))
    stated = {(r["of"], r["model"]): float(r["value"]) for r in rows if r["figure"] == "AP_mm"}
    for (pose, model), value in stated.items():
        assert value == pytest.approx(row_of(told, "AP_mm", pose, model)["value"], rel=1e-5)
    assert "ISO 9283 asks for 30" in " ".join(done.stdout.split())


def test_records_are_read_as_the_calibrations_data_was(config: Path, tmp_path: Path) -> None:
    made = exact_calibration(config, {"arm.mdh.a1": 0.301, "arm.mdh.a2": 0.1995})
    kept = PredictionRecord(entries=(), covariance=(), columns={"q1_deg": "J1", "q2_deg": "J2", "cycle": "visit"})
    named = replace(made, record=made.record.model_copy(update={"prediction": kept}))
    calibration, names, told = store(named, tmp_path / "c.yaml"), {"q1_deg": "J1", "cycle": "visit"}, []
    for own in ({}, names):
        rows = [{own.get(key, key): value for key, value in row.items()} for row in rows_of()]
        records = written(tmp_path / "records.csv", rows)
        done = armcal("acceptance", calibration, records, "--out", tmp_path / "out")
        assert done.exit_code == 0, done.output
        told.append(json.loads((tmp_path / "out" / "acceptance.json").read_text())["figures"])
    assert told[0] == told[1] and len(told[0]) > 10


def test_what_is_set_of_data_says_how_the_records_of_a_calibration_are_read(config: Path, tmp_path: Path) -> None:
    calibration = store(exact_calibration(config, {"arm.mdh.a1": 0.301, "arm.mdh.a2": 0.1995}), tmp_path / "c.yaml")
    rows = [{"J1" if key == "q1_deg" else key: value for key, value in row.items()} for row in rows_of()]
    records = written(tmp_path / "records.csv", rows)
    refused = armcal("acceptance", calibration, records, "--out", tmp_path / "out")
    assert refused.exit_code == 2 and "q1" in refused.output
    done = armcal(
        "acceptance", calibration, records, "--out", tmp_path / "out", "--set", "data.columns={q1_deg: J1}", "--json"
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["summary"]["calibrated"]["AP_mm"]["mean"] < 0.05


def test_a_pose_that_was_visited_once_is_left_out_and_named(config: Path, tmp_path: Path) -> None:
    records = written(tmp_path / "records.csv", [row for i, row in enumerate(rows_of()) if i not in (4, 7, 10)])
    done = armcal("acceptance", config, records, "--out", tmp_path / "out", "--json")
    assert done.exit_code == 0, done.output
    (warning,) = json.loads(done.stdout)["warnings"]
    assert warning.startswith("1 of 3 poses were visited once and are left out (P2). Repeatability needs two visits")


def test_positions_out_of_the_arms_reach_are_refused_with_the_option_that_finds_the_frame(
    config: Path, tmp_path: Path
) -> None:
    records = written(tmp_path / "records.csv", [{**row, "x_mm": float(str(row["x_mm"])) + 9000} for row in rows_of()])
    done = armcal("acceptance", config, records, "--out", tmp_path / "out")
    assert done.exit_code == 2 and "give --frame found" in " ".join(done.output.split()), done.output


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


BAD: dict[str, tuple[Callable[[Rows], Rows], str]] = {
    "a missing joint": (_without("q2_deg"), "q2"),
    "a missing coordinate": (_without("z_mm"), "found no column for tracker.z, expected z_m or z_cm or z_mm"),
    "a coordinate without its unit": (
        lambda rows: [{("x" if k == "x_mm" else k): v for k, v in row.items()} for row in rows],
        "x has no unit",
    ),
    "one cycle": (lambda rows: rows[:3], "none of 3 poses was visited twice. Repeatability needs two visits"),
    "one cycle, poses not named": (lambda rows: _without("pose")(rows[:3]), "none of 3 poses was visited twice"),
    "rows in metres": (_in_metres, "Write all rows in the unit of the column names"),
    "exchanged rows": (_exchanged, "those to P2. If two rows were exchanged, put them right"),
    "a cycle twice": (_with(3, cycle=1), "records.csv:5, cycle: found cycle 1 of P1 again; the first is in line 2"),
    "a cycle in words": (_with(3, cycle="first"), "records.csv:5, cycle"),
    "a pose without a name": (_with(3, pose=" "), "records.csv:5, pose: no pose is named"),
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
    cycles = {row["of"] + row["with"]: row["cycles"] for row in told["figures"]}
    assert cycles == {"P1": 4, "P2": 3, "P3": 4, "P1P2": 3, "P1P3": 4, "P2P3": 3}


def test_an_arm_that_no_instrument_sees_is_refused(tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text(PLANAR.replace("tip_position, noise_mm: 0.1", "plane, noise_mm: 0.1"))
    records = written(tmp_path / "records.csv", rows_of())
    done = armcal("acceptance", tmp_path / "arm.yaml", records, "--out", tmp_path / "out")
    assert done.exit_code == 2 and "Traceback" not in done.output
