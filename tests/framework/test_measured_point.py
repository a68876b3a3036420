"""Which point of the tool arrives at targets: its frame's origin, or the ball, reflector or body that was measured."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.calibration.tool_expression import measured_point
from armcal.cli.main import cli
from armcal.errors import ConfigError
from armcal.plugins import discover
from armcal.run.compensate import Answer, Bench
from click.testing import CliRunner, Result
from made_calibrations import written
from scipy.spatial.transform import Rotation
from serving import made, told
from small_arms import calibration, compensator, drawn

OFF_MM = "measurements.tracker.target_mm=[12, -9, 20]"
BODY = (
    "measurements.tracker.type=tip_pose",
    "measurements.tracker.orientation_noise=0.1 deg",
    OFF_MM,
    "measurements.tracker.target_rotation=[0.8, 0.0, 0.6, 0.0]",
)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armcal.functions.compiler.find_compiler", lambda: None)


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(each) for each in arguments])


def rows(path: Path, names: str) -> np.ndarray:
    with path.open(encoding="utf-8", newline="") as stream:
        return np.array([[float(row[name]) for name in names.split()] for row in csv.DictReader(stream)])


def measured(folder: Path, name: str, overrides: tuple[str, ...]) -> Path:
    """A calibration, and a file of what its instrument reads in five poses: places that can be reached."""
    commands = np.degrees(drawn(compensator(name), 5))
    joints = compensator(name).joints
    lines = [",".join(f"{joint}_deg" for joint in joints), *(",".join(map(str, row)) for row in commands)]
    (folder / "poses.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    found = written(calibration(name, *overrides), folder / "calibration.yaml")
    assert armcal("predict", found, "--poses", folder / "poses.csv", "--out", folder / "shown.csv").exit_code == 0
    return found


def missed(folder: Path, found: Path, *more: str, columns: str = "x_mm y_mm z_mm") -> tuple[np.ndarray, Result]:
    """What the instrument would read where the commands lead, beside what it read (N x columns)."""
    ran = armcal("compensate", found, "--targets", folder / "shown.csv", "--out", folder / "commands.csv", *more)
    assert ran.exit_code == 0, ran.output
    again = armcal("predict", found, "--poses", folder / "commands.csv", "--out", folder / "again.csv")
    assert again.exit_code == 0, again.output
    return rows(folder / "again.csv", columns) - rows(folder / "shown.csv", columns), ran


def test_the_measured_target_arrives_where_it_was_measured(tmp_path: Path) -> None:
    found = measured(tmp_path, "three", (OFF_MM,))
    away, ran = missed(tmp_path, found, "--point", "target")
    assert np.abs(away).max() < 1e-5
    assert "5 of 5 targets are reached, by the measured target" in ran.output
    assert "warning: these commands" not in ran.output
    tool, target = (
        rows(tmp_path / "commands.csv", "tool_x_mm tool_y_mm tool_z_mm"),
        rows(tmp_path / "shown.csv", "x_mm y_mm z_mm"),
    )
    known = measured_point(calibration("three", OFF_MM).system, "arm", calibration("three", OFF_MM).parameters)
    assert known is not None and known.measurement == "tracker"
    assert np.linalg.norm(tool - target, axis=1) == pytest.approx(np.full(5, 1000 * known.distance), abs=1e-4)


@pytest.mark.parametrize(
    ("freed", "fitted"), [("target_x", True), ("target_rotation", False), ("arm.mdh.a1", False), (None, False)]
)
def test_only_a_target_whose_place_was_fitted_leaves_the_tools_origin_open(freed: str | None, fitted: bool) -> None:
    known = calibration("three", *BODY)
    name = freed if freed is None or "." in freed else f"tracker.{freed}"
    point = measured_point(known.system, "arm", known.parameters.with_free(set() if name is None else {name}))
    assert point is not None and point.fitted is fitted


def test_commands_for_a_tool_beside_a_fitted_target_state_no_radius(tmp_path: Path) -> None:
    """The target may do what a6, d6 and theta6 of the arm do: its own place is measured, the tool's origin is not."""
    measured(tmp_path, "three", (OFF_MM,))
    known = calibration("three", OFF_MM)
    entries = tuple(
        entry.model_copy(update={"free": entry.free or entry.name == "tracker.target_z"})
        for entry in known.record.parameters
    )
    fitted = replace(known, record=known.record.model_copy(update={"parameters": entries}))
    assert "tracker.target_z" in fitted.free
    open_ones = [Bench.of(fitted, None, None, discover(), point).is_judged for point in ("tool", "target")]
    assert open_ones == [False, True]
    assert Bench.of(known, None, None, discover()).is_judged
    path = written(fitted, tmp_path / "fitted.yaml")
    asked = ("compensate", path, "--targets", tmp_path / "shown.csv", "--out", tmp_path / "commands.csv", "--point")
    assert "tool frame's origin is off is not known" in armcal(*asked, "tool").output
    assert "is not known" not in armcal(*asked, "target").output


@pytest.mark.slow
def test_where_nobody_says_which_point_arrives_the_miss_is_named(tmp_path: Path) -> None:
    found = measured(tmp_path, "three", (OFF_MM,))
    away, ran = missed(tmp_path, found, "--json")
    known = measured_point(calibration("three", OFF_MM).system, "arm", calibration("three", OFF_MM).parameters)
    assert known is not None
    with (tmp_path / "commands.csv").open(encoding="utf-8", newline="") as stream:
        reached = [row["reached"] == "yes" for row in csv.DictReader(stream)]
    assert any(reached)
    assert np.linalg.norm(away[reached], axis=1) == pytest.approx(1000 * known.distance, abs=1e-4)
    assert (
        f"arrives {1000 * known.distance:.3g} mm away from them. To bring that one there, give --point target"
        in ran.stderr
    )
    content = json.loads(ran.stdout)
    assert content["point"] == "tool" and np.linalg.norm(content["target_mm"]) == pytest.approx(1000 * known.distance)
    _, quiet = missed(tmp_path, found, "--point", "tool")
    assert "--point target" not in quiet.output


@pytest.mark.parametrize("point", ["tcp", None, 42, "Target", ["tool"]])
def test_a_point_that_is_none_is_refused_with_those_that_are(point: object) -> None:
    with pytest.raises(ConfigError, match=r"found the point .*Expected one of 'tool', 'target'"):
        calibration("three", OFF_MM).compensate(np.array([[0.3, 0.0, 0.2]]), point=point)  # type: ignore[arg-type]


def test_commands_say_where_the_tool_is_whichever_point_arrives() -> None:
    off = calibration("three", OFF_MM)
    known = measured_point(off.system, "arm", off.parameters)
    assert known is not None and known.distance > 0.02
    start = np.array([0.2, 0.4, -0.3])
    for point in ("tool", "target"):
        compensator = off.compensator(point=point)
        goal = compensator.forward(start[None])[:, :3, 3]
        commands = compensator.solve(compensator.targets(goal), start)
        assert commands.reached.all() and commands.base_T_point[:, :3, 3] == pytest.approx(goal, abs=1e-9)
        assert commands.base_T_tool == pytest.approx(off.forward(commands.joint_angles), abs=1e-9)
        away = np.linalg.norm(commands.base_T_tool[0, :3, 3] - commands.base_T_point[0, :3, 3])
        assert away == pytest.approx(known.distance if point == "target" else 0.0, abs=1e-9)


@pytest.mark.slow
def test_a_program_and_a_server_can_ask_for_the_measured_target(tmp_path: Path) -> None:
    """What the tracker would read at their commands is the goal; without the choice it is the tool's origin."""
    off = calibration("three", OFF_MM)
    measured(tmp_path, "three", (OFF_MM,))
    goals = rows(tmp_path / "shown.csv", "x_mm y_mm z_mm")
    commands = off.compensate(goals / 1000, point="target")
    text = (tmp_path / "calibration.yaml").read_text(encoding="utf-8")
    answerer = made(text, point="target")
    assert answerer.arms["arm"].shown["point"] == "target"
    asked = {"targets": [{"position_mm": goal} for goal in goals.tolist()], "units": "rad"}
    served = told(answerer, do="compensate", **asked)["commands"]
    angles = np.array([row["joint_angles_rad"] for row in served])
    for found in (commands.joint_angles, angles):
        records = Dataset(tuple("abcde"), {f"arm.q{i + 1}": found[:, i] for i in range(3)})
        read = off.predict(records)[0]
        assert 1000 * np.stack([read[f"tracker.{axis}"] for axis in "xyz"], axis=1) == pytest.approx(goals, abs=1e-4)
    tools = told(answerer, do="forward", joint_angles_rad=angles.tolist())["tools"]
    assert np.array([tool["position_mm"] for tool in tools]) == pytest.approx(goals, abs=1e-4)
    plain = off.compensate(goals[:1] / 1000)
    assert off.forward(plain.joint_angles)[0, :3, 3] * 1000 == pytest.approx(goals[0], abs=1e-4)


@pytest.mark.slow
def test_a_controller_of_the_nominal_arm_can_be_sent_poses_of_the_measured_target(tmp_path: Path) -> None:
    """The nominal arm's target is sent to the corrected place; the tracker then reads the place that was asked for."""
    lrm = calibration("lrm", OFF_MM)
    nodes = np.array([[170.0, -20, 160], [220, -20, 160], [220, 20, 160], [220, 20, 200]])
    targets = "x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg,payload_g\n"
    targets += "".join(f"{x},{y},{z},0,90,0,0\n" for x, y, z in nodes)
    (tmp_path / "targets.csv").write_text(targets)
    found, out = written(lrm, tmp_path / "calibration.yaml"), tmp_path / "sent.csv"
    asked = ("compensate", found, "--targets", tmp_path / "targets.csv", "--path", "--out", out)
    ran = armcal(*asked, "--point", "target", "--for", "nominal", "--json")
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout)["point"] == "target" and "the tool frame's origin" not in ran.stderr
    places, shifts = rows(out, "x_mm y_mm z_mm"), rows(out, "dx_mm dy_mm dz_mm")
    assert places - shifts == pytest.approx(nodes, abs=1e-9)
    bench = Bench.of(lrm, None, None, discover(), "target")
    real, nominal = bench.compensator(), bench.nominal
    turned = np.repeat(Rotation.from_euler("xyz", [0, 90, 0], degrees=True).as_matrix()[None], len(nodes), axis=0)
    given = real.targets(nodes / 1000, turned, payload=0.0)
    commands = real.follow(given)
    read = lrm.predict(Answer(bench, real, given, commands).dataset)[0]
    assert 1000 * np.stack([read[f"tracker.{axis}"] for axis in "xyz"], axis=1) == pytest.approx(nodes, abs=1e-3)
    assert 1000 * nominal.forward(commands.joint_angles)[:, :3, 3] == pytest.approx(places, abs=1e-3)
    warned = armcal(*asked, "--for", "nominal")
    assert "these commands bring the tool frame's origin" in warned.stderr


def test_a_measured_body_arrives_with_its_rotation(tmp_path: Path) -> None:
    found = measured(tmp_path, "three", BODY)
    away, _ = missed(tmp_path, found, "--point", "target", columns="x_mm y_mm z_mm qw qx qy qz")
    assert np.abs(away).max() < 1e-5


@pytest.mark.slow
def test_a_target_beyond_the_tool_is_not_called_out_of_reach(tmp_path: Path) -> None:
    """The arm's tool reaches 0.41 m from its base, a rod of 0.3 m on it reaches farther."""
    rod = ("measurements.tracker.target_mm=[300, 0, 0]",)
    found = written(calibration("three", *rod), tmp_path / "calibration.yaml")
    (tmp_path / "poses.csv").write_text("q1_deg,q2_deg,q3_deg\n20,5,5\n", encoding="utf-8")
    assert armcal("predict", found, "--poses", tmp_path / "poses.csv", "--out", tmp_path / "shown.csv").exit_code == 0
    away, _ = missed(tmp_path, found, "--point", "target")
    assert np.abs(away).max() < 1e-5
    _, ran = missed(tmp_path, found, "--point", "tool")
    assert "0 of 1 targets are reached" in ran.output


def test_a_contact_reads_no_point_of_the_tool(tmp_path: Path) -> None:
    found = written(calibration("seven"), tmp_path / "calibration.yaml")
    (tmp_path / "t.csv").write_text("x_mm,y_mm,z_mm\n300,0,300\n", encoding="utf-8")
    ran = armcal("compensate", found, "--targets", tmp_path / "t.csv", "--out", tmp_path / "o.csv", "--point", "target")
    assert ran.exit_code == 2
    assert "no measurement reads the place of a target on the tool of 'arm'" in ran.output
    assert not (tmp_path / "o.csv").exists()
