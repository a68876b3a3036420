"""The characteristics of ISO 9283: by hand, by Monte Carlo with a known truth, and by what must not change them."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal_capability.acceptance import characteristics as of
from click.testing import CliRunner, Result
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
    first, second = told["poses"]
    assert first["nominal"]["AP_mm"]["value"] == pytest.approx(3)
    assert [first["nominal"][f"AP_{axis}_mm"] for axis in "xyz"] == pytest.approx([1, 2, 2])
    assert first["RP_mm"]["value"] == pytest.approx(1), "all distances are 1: mean 1, no deviation"
    assert second["nominal"]["AP_mm"]["value"] == pytest.approx(1)
    assert second["RP_mm"]["value"] == pytest.approx(1)
    # P1 - P2 = (200, -200, 0) commanded; attained differs by the offsets of the same cycle
    attained = np.linalg.norm(np.add((200, -200, 0), np.subtract(square, line)), axis=1)
    distance = told["distances"][0]
    assert distance["nominal"]["AD_mm"]["value"] == pytest.approx(np.mean(attained) - np.hypot(200, 200))
    assert distance["RD_mm"]["value"] == pytest.approx(3 * np.std(attained, ddof=1))
    assert told["frames"]["nominal"] == {
        "aligned": False,
        "numbers_found": 0,
        "words": "as stated: nothing was fitted to these records",
    }


def test_the_variation_over_directions_is_the_widest_distance_of_barycentres(tmp_path: Path) -> None:
    rows = planar_rows({"P1": [(0.5, 0, 0), (-0.5, 0, 0)] * 3})
    for row, direction, off in zip(rows, "xxyyzz", (0, 0, 3, 3, 3, 3), strict=True):
        row |= {"direction": direction, "y_mm": off, "z_mm": 4 if direction == "z" else 0}
    told = judged(tmp_path, PLANAR, rows)
    (only,) = told["directions"]
    assert only["vAP_mm"]["value"] == pytest.approx(5) and only["directions"] == "x, y, z"
    assert [row["RP_mm"]["value"] for row in told["poses"]] == pytest.approx([0.5] * 3), "each direction by itself"


def test_drift_is_that_of_the_last_ten_cycles_against_the_first(tmp_path: Path) -> None:
    signs = np.tile([1.0, -1.0], 15)
    moving = [(0.1 * s, 0.02 * i, 0) for i, s in enumerate(signs)]
    told = judged(tmp_path, PLANAR, planar_rows({"P1": moving}))
    (drift,) = told["drifts"]
    assert drift["nominal"]["dAP_mm"]["value"] == pytest.approx(0.02 * 20)
    assert drift["dRP_mm"]["value"] == pytest.approx(0, abs=1e-9)
    assert drift["measured"]["hours"] == pytest.approx(20 / 3600)


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
        told.append(judged(tmp_path / name, SPATIAL, _measured(rows, tools, base, shift)))
    near, far = told
    assert near["frames"]["nominal"]["aligned"] and near["frames"]["nominal"]["numbers_found"] == 9
    assert "(2000.0, -3000.0, 500.0)" not in near["frames"]["nominal"]["words"]
    for one, other in zip(near["poses"], far["poses"], strict=True):
        assert one["nominal"]["AP_mm"]["value"] == pytest.approx(other["nominal"]["AP_mm"]["value"], abs=1e-5)
        assert one["RP_mm"] == pytest.approx(other["RP_mm"], rel=1e-6)
        for axis in "abc":
            assert one["nominal"][f"AP_{axis}_deg"]["value"] == pytest.approx(
                other["nominal"][f"AP_{axis}_deg"]["value"], abs=1e-5
            )
            assert one[f"RP_{axis}_deg"]["value"] == pytest.approx(other[f"RP_{axis}_deg"]["value"], abs=1e-5)
    typical = np.mean([row[f"RP_{axis}_deg"]["value"] for row in near["poses"] for axis in "abc"])
    assert typical == pytest.approx(3 * 0.01, rel=0.3)
    assert 0.05 < near["summary"]["nominal"]["AP_deg"]["mean"] < 0.5, "joints are up to 0.2 deg off"


def test_a_stated_frame_is_taken_as_it_is_and_one_that_the_records_contradict_is_named(tmp_path: Path) -> None:
    rows, tools = _spatial_rows(np.random.default_rng(4), 12, 3)
    shift = np.array([0.0, 0.1, 0.0])
    told = judged(tmp_path, SPATIAL, _measured(rows, tools, Rotation.identity(), shift), "--frame", "stated")
    assert told["summary"]["nominal"]["AP_mm"]["mean"] > 60
    assert any("--frame found" in text for text in told["warnings"])


@pytest.mark.slow
def test_a_frame_found_from_few_poses_is_said_to_make_the_accuracy_smaller(tmp_path: Path) -> None:
    rows, tools = _spatial_rows(np.random.default_rng(4), 5, 3)
    told = judged(tmp_path, SPATIAL, _measured(rows, tools, Rotation.identity(), np.zeros(3)))
    assert any("9 numbers of base and target were found from the 15 coordinates" in t for t in told["warnings"])


@pytest.mark.slow
def test_records_in_another_order_give_the_same_figures(tmp_path: Path) -> None:
    rows, tools = _spatial_rows(np.random.default_rng(5), 6, 5)
    rows = _measured(rows, tools, Rotation.identity(), np.zeros(3))
    mixed = [rows[i] for i in np.random.default_rng(6).permutation(len(rows))]
    told = []
    for name, own in (("kept", rows), ("mixed", mixed)):
        (tmp_path / name).mkdir()
        told.append(judged(tmp_path / name, SPATIAL, own))
    by_pose = [{row["pose"]: row["nominal"]["AP_mm"]["value"] for row in one["poses"]} for one in told]
    assert by_pose[0] == pytest.approx(by_pose[1], abs=1e-4)
    spread = [{frozenset((r["from"], r["to"])): r["RD_mm"]["value"] for r in one["distances"]} for one in told]
    assert spread[0] == pytest.approx(spread[1], rel=1e-9), "pairs are of the same cycle"


@pytest.mark.slow
def test_commanded_poses_that_the_records_state_stand_above_the_joints(tmp_path: Path) -> None:
    rows = planar_rows({"P1": [(1, 0, 0), (1, 0, 0.1)], "P2": [(1, 0, 0), (1, 0, 0.1)]})
    for row, place in zip(rows, ((500, 0, 0),) * 2 + ((300, 200, 0),) * 2, strict=True):
        row |= dict(zip(("commanded_x_mm", "commanded_y_mm", "commanded_z_mm"), np.add(place, (1, 0, 0)), strict=True))
    told = judged(tmp_path, PLANAR, rows)
    assert told["commanded"]["nominal"] == "columns of the records"
    assert told["summary"]["nominal"]["AP_mm"]["most"] == pytest.approx(0.05)
