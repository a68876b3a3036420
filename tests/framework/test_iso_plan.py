"""``armcal plan --iso-cube``: the standard's geometry, limits, and the whole way to a judgement of the arm."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from armcal.arm.assembly import only_arm
from armcal.cli.main import cli
from armcal.errors import ConfigError
from armcal.run.plan import CORNERS, POINTS
from click.testing import CliRunner, Result
from scipy.spatial.transform import Rotation

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
DH = ((0.0, 0.1273, 90), (-0.612, 0, 0), (-0.5723, 0, 0), (0, 0.163941, 90), (0, 0.1157, -90), (0, 0.0922, 0))
"""a (m), d (m), alpha (deg) of a UR10."""
LIMITS = {"q1": 180, "q2": 170, "q3": 150, "q4": 170, "q5": 170, "q6": 180}


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(each) for each in arguments])


def table_of(path: Path) -> list[dict[str, str]]:
    with path.open() as stream:
        return list(csv.DictReader(stream))


def tool_of(q: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Row by row: Rot_z(q) Trans(a, 0, d) Rot_x(alpha)."""
    turn, place = Rotation.identity(), np.zeros(3)
    for angle, (a, d, alpha) in zip(q, DH, strict=True):
        turn = turn * Rotation.from_rotvec([0, 0, angle])
        place = place + turn.apply([a, 0, d])
        turn = turn * Rotation.from_rotvec([np.deg2rad(alpha), 0, 0])
    return turn, place


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows = ", ".join(f"{{a_mm: {1000 * a}, d_mm: {1000 * d}, alpha_deg: {alpha}}}" for a, d, alpha in DH)
    limits = ", ".join(f"{joint}: [-{end} deg, {end} deg]" for joint, end in LIMITS.items())
    path = tmp_path_factory.mktemp("iso") / "ur10.yaml"
    path.write_text(
        f"arms: {{arm: {{model: {{type: mdh, convention: standard, rows: [{rows}]}}}}}}\n"
        "measurements: {tracker: {type: tip_pose, noise_mm: 0.05, orientation_noise_deg: 0.01}}\n"
        "statics: {gravity_m_s2: [0, 0, -9.81], body: earth, payload_g: 0}\n"
        f"plan: {{limits: {{{limits}}}}}\n",
        encoding="utf-8",
    )
    return path


@pytest.fixture(scope="module")
def planned(config: Path) -> tuple[dict, list[dict[str, str]]]:
    out = config.parent / "plan.csv"
    done = armcal("plan", config, "--iso-cube", 250, "--cycles", 3, "--out", out, "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout), table_of(out)


def test_the_one_arm_of_a_system_or_a_sentence() -> None:
    assert only_arm({"left": 1}, "", "") == 1  # type: ignore[dict-item,comparison-overlap]
    with pytest.raises(ConfigError, match=r"found 2 arms \(left, right\), expected one: a bench moves a single arm\. "):
        only_arm({"left": 1, "right": 2}, "a bench moves a single arm", "Configure each alone.")  # type: ignore[dict-item]


def test_the_poses_are_on_the_diagonals_a_tenth_of_their_length_from_the_corners() -> None:
    centre, size = np.array([0.3, -0.2, 0.5]), 0.4
    points, corners = centre + size * POINTS, centre + size * CORNERS
    assert np.allclose(points[0], centre)
    diagonal = size * np.sqrt(3)
    from_corner = np.linalg.norm(points[1:, None] - corners, axis=2).min(axis=1)
    assert np.allclose(from_corner, 0.1 * diagonal)
    assert np.linalg.matrix_rank(points - centre, tol=1e-9) == 2, "on one plane"
    sides = np.linalg.norm(points[1:] - np.roll(points[1:], 1, axis=0), axis=1)
    assert np.allclose(np.sort(sides), 0.8 * size * np.sqrt([1, 1, 2, 2])), "a rectangle, P2 to P5 round it"


@pytest.mark.slow
def test_the_commands_bring_the_tool_to_the_poses_turned_one_way_within_limits(
    planned: tuple[dict, list[dict[str, str]]],
) -> None:
    told, rows = planned
    assert told["cube"]["size_mm"] == 250 and told["tool_rpy_deg"] is not None
    turns = []
    for row in rows:
        q = np.deg2rad([float(row[f"q{i}_deg"]) for i in range(1, 7)])
        turn, place = tool_of(q)
        assert np.allclose(1000 * place, told["poses"][row["pose"]], atol=1e-4)
        assert np.allclose(1000 * place, [float(row[f"tool_{axis}_mm"]) for axis in "xyz"], atol=1e-4)
        assert (np.abs(np.rad2deg(q)) <= list(LIMITS.values())).all()
        turns.append(turn)
    assert max((turns[0].inv() * turn).magnitude() for turn in turns) < 1e-6


@pytest.mark.slow
def test_single_poses_are_come_to_along_each_axis_and_joints_from_the_sides_that_the_table_states(
    planned: tuple[dict, list[dict[str, str]]],
) -> None:
    _, rows = planned
    visits = [(row["pose"], row["direction"], row["cycle"]) for row in rows]
    path = [(f"P{i}", "path", str(cycle)) for cycle in (1, 2, 3) for i in range(1, 6)]
    assert visits[: len(path)] == path and len(visits) == len(set(visits)) == 15 + 27
    assert {row["pose"] for row in rows if row["direction"] in "xyz"} == {"P1", "P2", "P4"}
    for row in rows:
        q, before = ([float(row[f"{at}q{i}_deg"]) for i in range(1, 7)] for at in ("", "from_"))
        moved = np.subtract(q, before)
        for i, move in enumerate(moved, start=1):
            assert float(row[f"approach{i}"]) == (np.sign(move) if abs(move) > 1e-4 else 0)
        if row["direction"] in "xyz":
            way = tool_of(np.deg2rad(q))[1] - tool_of(np.deg2rad(before))[1]
            axis = "xyz".index(row["direction"])
            assert abs(abs(way[axis]) - 0.025) < 1e-5 and np.abs(np.delete(way, axis)).max() < 1e-5


@pytest.mark.quick(
    "options0-give --poses N to calibrate, or --iso-cube SIZE_MM to test",
    "options2-found '40cm', expected an edge of 1 to 10000 mm, or auto",
    "options3-found 'nan'",
    "options4---order has no meaning with --iso-cube",
    "options6-found no limits for q2",
)
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--iso-cube", "auto", "--poses", 5), "give --poses N to calibrate, or --iso-cube SIZE_MM to test"),
        ((), "give --poses N to calibrate, or --iso-cube SIZE_MM to test"),
        (("--iso-cube", "40cm"), "found '40cm', expected an edge of 1 to 10000 mm, or auto"),
        (("--iso-cube", "nan"), "found 'nan'"),
        (("--iso-cube", "auto", "--order", "none"), "--order has no meaning with --iso-cube"),
        (("--iso-cube", "9000"), "no cube of 9000 mm was found within joint limits"),
        (("--iso-cube", "auto", "--set", "plan.limits={q1: [0 deg, 9 deg]}"), "found no limits for q2"),
    ],
)
def test_what_cannot_be_planned_is_refused(
    options: tuple[object, ...], expected: str, config: Path, tmp_path: Path
) -> None:
    done = armcal("plan", config, *options, "--out", tmp_path / "plan.csv")
    assert done.exit_code == 2 and expected in " ".join(done.output.split()), done.output
    assert not (tmp_path / "plan.csv").exists()


def test_an_arm_in_a_plane_has_no_cube(tmp_path: Path) -> None:
    (tmp_path / "arm.yaml").write_text(
        "arms: {arm: {model: {type: mdh, convention: standard, rows: [{a_mm: 300}, {a_mm: 200}]}}}\n"
        "measurements: {tracker: {type: tip_position, noise_mm: 0.1}}\n"
        "plan: {limits: {q1: [-90 deg, 90 deg], q2: [-90 deg, 90 deg]}}\n"
    )
    done = armcal("plan", tmp_path / "arm.yaml", "--iso-cube", "auto", "--out", tmp_path / "plan.csv")
    assert done.exit_code == 2 and "an arm that moves in a plane has no cube" in " ".join(done.output.split())


@pytest.mark.slow
def test_a_plan_is_simulated_and_judged_and_the_calibrated_arm_is_the_truer_one(
    demo_calibration: Path, tmp_path: Path
) -> None:
    """The truth of AP is that of the same poses measured without noise."""
    plan, told = tmp_path / "plan.csv", []
    done = armcal(
        "plan", CONFIGS / "plan.yaml", "--iso-cube", 40, "--cycles", 12, "--directions", 1, "--out", plan, "-q"
    )
    assert done.exit_code == 0, done.output
    for name, noise in (("measured", 0.5), ("truth", 0.0)):
        simulated = armcal(
            "simulate", CONFIGS / "demo.yaml", "--poses", plan, "--out", tmp_path / f"{name}.csv",
            "--set", f"simulation.noise_mm={noise}",
        )  # fmt: skip
        assert simulated.exit_code == 0, simulated.output
        out = tmp_path / name
        judged = armcal("acceptance", demo_calibration, tmp_path / f"{name}.csv", "--out", out, "-q")
        assert judged.exit_code == 0, judged.output
        told.append(json.loads((out / "acceptance.json").read_text()))
    measured, truth = told
    pairs = [
        (row, exact)
        for row, exact in zip(measured["figures"], truth["figures"], strict=True)
        if row["figure"] == "AP_mm"
    ]
    assert len(pairs) == 2 * 8 and {row["cycles"] for row, _ in pairs} == {12}
    assert sum(row["low_95"] <= exact["value"] <= row["high_95"] for row, exact in pairs) >= len(pairs) - 1
    assert measured["summary"]["calibrated"]["AP_mm"]["mean"] < 0.1 * measured["summary"]["nominal"]["AP_mm"]["mean"]
    assert measured["repeatability_mm"]["mean"] == pytest.approx(measured["of_instrument_mm"], rel=0.15)
    assert truth["repeatability_mm"]["most"] == pytest.approx(0, abs=1e-9)


def test_a_simulator_that_has_poses_of_its_own_refuses_a_table(tmp_path: Path) -> None:
    ball = CONFIGS.parent / "ball"
    poses = tmp_path / "poses.csv"
    poses.write_text("pose_id," + ",".join(f"q{i}_deg" for i in range(1, 8)) + "\n1,0,0,0,0,0,0,0\n2,1,1,1,1,1,1,1\n")
    done = armcal("simulate", ball / "demo.yaml", "--poses", poses, "--out", tmp_path / "out.csv")
    assert done.exit_code == 2 and "Traceback" not in done.output
    assert not (tmp_path / "out.csv").exists()
