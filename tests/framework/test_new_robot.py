"""``armcal new robot``: from rows or a URDF to a calibration that works; bad input is refused by place."""

from __future__ import annotations

import json
import math
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.calibration.calibration import Calibration
from armcal.calibration.convert import difference, load_source, nominal_values
from armcal.calibration.rigid_chain import numeric_chain, tool_poses
from armcal.cli.main import cli
from armcal.cli.new import direction, place
from armcal.config.yaml_source import word
from armcal.errors import InputError
from armcal.plugins import discover
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, calibrate, prepare
from armcal.scaffold.plugin_files import number
from armcal.scaffold.robot import (
    RECORDS,
    SIMULATED,
    RobotJoint,
    Row,
    _levels,
    read_rows,
    robot_of_rows,
    robot_of_urdf,
    write_robot,
)
from click.testing import CliRunner, Result
from scaffolds import ROOT, commands_of, files_of, page
from scipy.spatial.transform import Rotation

HEADER = "alpha_deg,a_mm,theta_deg,d_mm"
NOISE_MM = 0.1596  # mean length of three coordinates of 0.1 mm
REGISTRY = discover()
PAGE = page("new_robot.md")


def new_robot(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["new", "robot", *arguments], prog_name="armcal")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def table(folder: Path, text: str | bytes, name: str = "rows.csv") -> str:
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return name


# The page, word for word


@pytest.mark.page
def test_the_page_takes_five_joints_from_a_table_to_a_calibrated_urdf(here: Path) -> None:
    for name, content in files_of(PAGE).items():
        table(here, content, name)
    (here / "configs").symlink_to(ROOT / "configs")
    for command in commands_of(PAGE, "console"):
        ran = CliRunner().invoke(cli, shlex.split(command)[1:], prog_name="armcal")
        assert ran.exit_code == 0, f"{command}\n{ran.output}"
    arm5 = here / "arm5"
    files = {"arm.yaml", "calibrate.yaml", "plan.yaml", "simulated.yaml", "truth.yaml", "simulated.csv", "README.md"}
    assert files <= {path.name for path in arm5.iterdir()}
    content = json.loads((arm5 / "runs" / "simulated" / "metrics.json").read_text(encoding="utf-8"))
    errors = content["error_mm"]
    assert errors["nominal"]["holdout"]["mean"] > 1
    assert errors["calibrated"]["holdout"]["mean"] == pytest.approx(NOISE_MM, rel=0.2)
    assert f"calibrated {errors['calibrated']['holdout']['mean']:.3f} mm (the noise alone: 0.160 mm)" in PAGE
    assert f"nominal {errors['nominal']['holdout']['mean']:.3f} mm" in PAGE
    assert not [f for f in content["verdict"]["findings"] if f["grade"] in ("bad", "warning")]
    assert (arm5 / "arm5-calibrated.urdf").read_text(encoding="utf-8").count("<joint") >= 5
    assert (here / "arm7" / "arm7-calibrated.urdf").exists()


@pytest.mark.slow
def test_the_calibration_is_nearer_to_the_truth_everywhere_than_the_drawing(here: Path) -> None:
    """The made-up arm without noise, at poses of its own, against what was found: below the noise of one reading."""
    rows = table(here, files_of(PAGE)["arm5.csv"])
    assert new_robot("arm5", "--dh", rows, "--convention", "standard").exit_code == 0
    experiment = Experiment.load(here / "arm5" / "simulated.yaml", ["simulation.noise=0 mm", "simulation.seed=99"])
    from armcal.estimate.simulation import SimulationRequest

    system = experiment.system
    request = SimulationRequest(system.arms, system.measurements, experiment.parameters, system.environment)
    exact = experiment.simulator().simulate(request)
    found = Calibration.load(here / "arm5" / "runs" / "simulated" / "calibration.yaml").predict(exact)[0]
    off = np.array([found[f"tracker.{axis}"] - exact.column(f"tracker.{axis}") for axis in "xyz"])
    assert float(np.linalg.norm(off, axis=0).mean()) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [3, pytest.param(20, marks=pytest.mark.slow)])
def test_first_runs_warn_by_chance_only_as_often_as_one_test_at_5_percent(here: Path, seeds: int) -> None:
    """Over seeds of the noise: each finding has a level of its own, and of a few records one run in five warns."""
    rows = read_rows(
        here / table(here, f"{HEADER},mass_g,com_x_mm\n90,0,0,120,400,0\n0,200,0,0,900,-100\n0,160,0,0,500,-80\n"),
        REGISTRY,
    )
    write_robot(replace(robot_of_rows("arm", "standard", rows), up=(0, 0, 1)), here / "arm", REGISTRY)
    warned = [seed for seed in range(1, seeds + 1) if warnings_of_a_first_run(here / "arm", seed)]
    assert len(warned) <= 1, warned


def warnings_of_a_first_run(folder: Path, seed: int) -> list[str]:
    """What the calibration of its simulated records warns of, their noise drawn from a seed."""
    seeded = f"simulation.seed={seed}"
    ran = CliRunner().invoke(
        cli, ["simulate", str(folder / SIMULATED), "--set", seeded, "--out", str(folder / RECORDS)]
    )
    assert ran.exit_code == 0, ran.output
    verdict = calibrate(Experiment.load(folder / SIMULATED, registry=REGISTRY)).verdict
    return [finding.text for finding in verdict.findings if finding.grade in ("bad", "warning")]


# What is written


@pytest.mark.slow
def test_nothing_that_is_free_is_redundant_or_unknown(here: Path) -> None:
    rows = read_rows(here / table(here, files_of(PAGE)["arm5.csv"]), REGISTRY)
    choice = write_robot(robot_of_rows("arm5", "standard", rows), here / "arm5", REGISTRY)
    experiment = Experiment.load(here / "arm5" / "simulated.yaml", registry=REGISTRY)
    ready = prepare(experiment, Stopwatch())
    assert not [text for text in ready.warnings if "determine" in text]
    assert {block.name for block in ready.problem.parameters.free} == set(choice.kept)
    # Six of the base, four a joint less two of the last, three of the target and its gauge; springs 2 to 4 are loaded.
    assert {"arm.mdh.base_x", "arm.mdh.base_rz", "tracker.target_z", "arm.mdh.after2_ry"} <= set(choice.kept)
    assert {"arm.mdh.theta1", "arm.mdh.d1", "arm.spring.k1"} <= {dropped.name for dropped in choice.redundant}
    assert {"arm.spring.k2", "arm.spring.k3"} <= set(choice.kept)


def test_the_rows_are_those_of_the_table(here: Path) -> None:
    rows = read_rows(here / table(here, files_of(PAGE)["arm5.csv"]), REGISTRY)
    write_robot(robot_of_rows("arm5", "standard", rows), here / "arm5", REGISTRY)
    told = yaml.safe_load((here / "arm5" / "arm.yaml").read_text(encoding="utf-8"))["arms"]["arm"]
    lines = [line.split(",") for line in files_of(PAGE)["arm5.csv"].splitlines()[1:]]
    assert told["model"]["joints"] == [line[0] for line in lines]
    for row, line in zip(told["model"]["rows"], lines, strict=True):
        assert [row[key] for key in HEADER.split(",")] == pytest.approx([float(cell) for cell in line[1:5]])
    assert told["links"]["link3"] == {"mass_g": 250, "com_mm": [-80, 0, 0], "frame": "row3"}
    plan = yaml.safe_load((here / "arm5" / "plan.yaml").read_text(encoding="utf-8"))["plan"]
    assert plan["limits_deg"]["shoulder"] == [-60, 100]
    assert plan["levels_deg"]["shoulder"] == [-60, 20, 100]


@pytest.mark.parametrize(("degrees", "levels"), [(360, [-120, 0, 120]), (179, [-120, 0, 120]), (150, [-150, 0, 150])])
def test_the_levels_of_a_joint_that_turns_around_are_different_angles(degrees: float, levels: list[float]) -> None:
    joint = RobotJoint("q1", True, (-np.radians(degrees), np.radians(degrees)))
    assert [float(text) for text in _levels(joint)] == pytest.approx(levels)


def test_units_names_and_kinds_of_a_table(here: Path) -> None:
    text = (
        "type,joint,alpha_rad,a_m,theta_deg,d_cm,lower_deg,upper_deg,lower_mm,upper_mm,mass_kg\n"
        ",1,0,0.25,0,30,-130,130,,,2\n"
        "\n"
        "revolute,2,3.141592653589793,0.2,0,0,,,,,1.5\n"
        "prismatic,quill,0,0,0,0,,,0,150,\n"
    )
    rows = read_rows(here / table(here, b"\xef\xbb\xbf" + text.encode()), REGISTRY)
    assert [row.joint.name for row in rows] == ["q1", "q2", "quill"]
    assert [row.joint.turns for row in rows] == [True, True, False]
    assert (rows[0].a, rows[0].d, rows[1].alpha) == pytest.approx((0.25, 0.3, math.pi))
    assert rows[0].joint.limits == pytest.approx((-math.radians(130), math.radians(130)))
    assert [row.joint.assumed for row in rows] == [False, True, False]
    assert rows[2].joint.limits == pytest.approx((0, 0.15))
    assert [row.mass.mass if row.mass else None for row in rows] == [2, 1.5, None]


@pytest.mark.parametrize(
    ("convention", "marked"), [("standard", [True, False, False]), ("craig", [False, False, True])]
)
def test_a_tilt_is_put_between_parallel_axes_only(convention: str, marked: list[bool]) -> None:
    """alpha lies after the joint, in Craig's convention before it: 0, then a right angle, then pi."""
    alphas = (0.0, math.pi / 2, math.pi)
    joints = [row_of(name).joint for name in ("q1", "q2", "q3")]
    rows = tuple(Row(joint, alpha, 0.1, 0, 0) for joint, alpha in zip(joints, alphas, strict=True))
    found = robot_of_rows("r", convention, rows)  # type: ignore[arg-type]
    assert [row.tilts for row in found.rows] == marked


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_fixed_rows_are_the_base_and_the_tool(convention: str, here: Path) -> None:
    """Against the product of all rows, the fixed ones too."""
    cells = [[20, 30, -40, 50], [90, 0, 10, 120], [-70, 200, 5, -11.8], [15, 12, 35, 7]]
    lines = [",".join(map(str, row)) + kind for row, kind in zip(cells, [",fixed", ",", ",", ",Fixed"], strict=True)]
    rows = read_rows(here / table(here, "\n".join([f"{HEADER},type", *lines])), REGISTRY)
    robot = robot_of_rows("r", convention, rows)  # type: ignore[arg-type]
    assert [joint.name for joint in robot.joints] == ["q1", "q2"]
    write_robot(robot, here / "r", REGISTRY)
    stated = yaml.safe_load((here / "r" / "arm.yaml").read_text(encoding="utf-8"))["arms"]["arm"]["model"]
    made = REGISTRY.find("model", stated.pop("type")).load()
    model = made(made.Settings.model_validate(stated))
    found = tool_poses(numeric_chain(model, nominal_values(model)), np.array([[0.3, -0.8]]))[0]
    expected = np.eye(4)
    for (alpha, a, theta, d), turned in zip(cells, (0.0, 0.3, -0.8, 0.0), strict=True):
        about_x, about_z = rotated("x", math.radians(alpha)), rotated("z", math.radians(theta) + turned)
        about_x[0, 3], about_z[2, 3] = a / 1000, d / 1000
        expected = expected @ (about_z @ about_x if convention == "standard" else about_x @ about_z)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def rotated(axis: str, angle: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
    return pose


def test_hayatis_beta_is_a_step_behind_the_row(here: Path) -> None:
    rows = read_rows(here / table(here, f"{HEADER},beta_deg\n0,200,0,0,0.4\n90,1,2,3,0\n0,1,2,3,\n"), REGISTRY)
    robot = robot_of_rows("r", "standard", rows)
    assert [row.beta for row in robot.rows] == pytest.approx([math.radians(0.4), 0, 0]) and robot.rows[0].tilts
    write_robot(robot, here / "r", REGISTRY)
    assert "after: [{ry_deg: 0.4}]" in (here / "r" / "arm.yaml").read_text(encoding="utf-8")
    with pytest.raises(InputError, match=r"found beta in a table of the modified convention.* as before: or after:"):
        robot_of_rows("r", "craig", rows)


def test_axes_that_a_maker_calibrated_give_the_freedoms_of_parallel_ones(here: Path) -> None:
    drawn, calibrated = [], []
    for folder, off in (("drawn", 0.0), ("calibrated", 0.17)):
        text = f"{HEADER}\n0,0,0,120\n90,0,90,0\n{180 + off},400,0,0\n{180 - off},300,0,100\n90,0,0,90\n-90,0,0,80\n"
        robot = robot_of_rows("r", "craig", read_rows(here / table(here, text), REGISTRY))
        kept = write_robot(robot, here / folder, REGISTRY).kept
        (drawn if off == 0 else calibrated).extend(kept)
    assert len(drawn) == len(calibrated)
    assert {name for name in drawn if name.endswith("_ry")} == {name for name in calibrated if name.endswith("_ry")}
    assert "arm.mdh.before4_ry" in drawn


def row_of(name: str) -> Row:
    from armcal.scaffold.robot import ASSUMED_TURN, RobotJoint

    return Row(RobotJoint(name, True, ASSUMED_TURN), 0, 0, 0, 0)


@pytest.mark.parametrize(
    ("value", "text"),
    [(90.00000000000001, "90"), (1e-7, "0.0000001"), (-0.0, "0"), (1e9, "1000000000"), (0.1 + 0.2, "0.3")],
)
def test_numbers_are_written_as_people_do(value: float, text: str) -> None:
    assert number(value) == text
    assert yaml.safe_load(number(value)) == pytest.approx(value, abs=1e-15, rel=1e-11)


@pytest.mark.parametrize("name", ["waist", "y", "no", "on", "J-1", "null", "a_b"])
def test_names_stay_text_in_yaml(name: str) -> None:
    assert yaml.safe_load(f"[{word(name)}]") == [name]


@pytest.mark.parametrize("name", ["on", pytest.param("no", marks=pytest.mark.slow)])
def test_a_robots_files_can_be_used_whatever_it_is_called(name: str, here: Path) -> None:
    done = new_robot(
        name,
        "--dh",
        table(here, f"{HEADER}\n90,0,0,100\n0,300,0,0\n0,250,0,0\n"),
        "--convention",
        "standard",
        "--up",
        "z",
    )
    assert done.exit_code == 0, done.output
    assert Experiment.load(here / name / "calibrate.yaml").name == name


# Other sources


@pytest.mark.parametrize("convention", ["standard", "modified"])
@pytest.mark.slow
def test_a_scara_slides_in_either_convention(convention: str, here: Path) -> None:
    rows = [
        f"name,type,{HEADER},lower_deg,upper_deg,lower_mm,upper_mm",
        "y,,0,250,0,300,-130,130,,".replace("y", "no"),  # a YAML word for false
        "q2,,180,200,0,0,-140,140,,",
        "q3,prismatic,0,0,0,0,,,0,150",
        "q4,,0,50,0,40,-180,180,,",
    ]
    ran = new_robot("scara", "--dh", table(here, "\n".join(rows)), "--convention", convention, "--json")
    assert ran.exit_code == 0, ran.output
    content = json.loads(ran.stdout)
    assert content["works"]
    assert content["holdout_calibrated_mm"] < 1.3 * NOISE_MM < 4 * NOISE_MM < content["holdout_nominal_mm"]
    read = (here / "scara" / "simulated.csv").read_text(encoding="utf-8").splitlines()[0]
    assert "no_deg" in read and "q3_mm" in read
    text = (here / "scara" / "README.md").read_text(encoding="utf-8")
    assert "masses" not in text and "assumed" not in text


@pytest.mark.slow
def test_an_so101_begins_as_the_arm_of_the_shipped_configurations(here: Path) -> None:
    ran = new_robot("so101", "--up", "z", "--json")
    assert ran.exit_code == 0 and json.loads(ran.stdout)["works"], ran.output
    ours, shipped = (
        load_source(path, None, REGISTRY) for path in (here / "so101" / "arm.yaml", ROOT / "configs/so101/arm.yaml")
    )
    assert [joint.name for joint in ours.chain.joints] == [joint.name for joint in shipped.chain.joints]
    off = difference(ours.chain, shipped.chain)
    assert max(off.position_m, off.angle_rad) < 1e-12
    weights = [
        {link["mass_g"]: link["com_mm"] for link in yaml.safe_load(path.read_text())["arms"]["arm"]["links"].values()}
        for path in (here / "so101" / "arm.yaml", ROOT / "configs" / "so101" / "skeleton.yaml")
    ]
    assert weights[0] == weights[1]


@pytest.mark.slow
def test_a_urdf_gives_limits_and_masses(here: Path) -> None:
    source = ROOT / "configs" / "mukca" / "gen3lite.urdf"
    ran = new_robot("lite", "--urdf", str(source), "--json")
    assert ran.exit_code == 0, ran.output
    content = json.loads(ran.stdout)
    assert content["works"] and any(name.startswith("arm.spring.k") for name in content["free"])
    assert (here / "lite" / "lite.urdf").read_bytes() == source.read_bytes()
    plan = yaml.safe_load((here / "lite" / "plan.yaml").read_text(encoding="utf-8"))["plan"]
    experiment = Experiment.load(here / "lite" / "simulated.yaml", registry=REGISTRY)
    for joint in experiment.system.arms["arm"].nominal_chain.joints:
        if joint.limits:
            low, high = (math.degrees(limit) for limit in joint.limits)
            assert low - 1e-6 <= plan["limits_deg"][joint.name][0] < plan["limits_deg"][joint.name][1] <= high + 1e-6
    assert experiment.simulator() is not None


def test_a_joint_that_follows_another_has_priors_too(here: Path) -> None:
    """A parallelogram: what carries the forearm is off its drawing as any joint is."""
    follows, text = '<mimic joint="j2" multiplier="-1"/>', (ROOT / "configs" / "ball" / "arm7.urdf").read_text()
    name = table(
        here, re.sub(r'(<joint name="j3".*?)(</joint>)', rf"\1{follows}\2", text, count=1, flags=re.S), "r.urdf"
    )
    robot = robot_of_urdf("r", Path(name), "ball_link", REGISTRY)
    assert "j3" not in [joint.name for joint in robot.joints] and "arm.urdf.j3_[xyz]" in robot.priors


@pytest.mark.slow
def test_the_trackers_frame_stays_out_of_a_urdfs_joints(here: Path) -> None:
    """Measured by a tracker 0.8 m away and turned by 80 deg: the first joint is exported as it was."""
    source = ROOT / "configs" / "ball" / "arm7.urdf"
    assert new_robot("arm7", "--urdf", str(source), "--tip", "ball_link").exit_code == 0
    truth = (here / "arm7" / "truth.yaml").read_text(encoding="utf-8").splitlines()
    half = math.radians(80) / 2
    stands = {
        "x": "820 mm",
        "y": "-310 mm",
        "z": "505 mm",
        "rotation[w]": math.cos(half),
        "rotation[z]": math.sin(half),
    }
    kept = [line for line in truth if "placement" not in line]
    kept += [f"'arm.placement_{name}': {value}" for name, value in stands.items()]
    (here / "arm7" / "truth.yaml").write_text("\n".join(kept), encoding="utf-8")
    for command in (
        "simulate arm7/simulated.yaml --out arm7/simulated.csv",
        "run arm7/simulated.yaml --out arm7/runs/away --set validation.folds=0",
        "export arm7/runs/away/calibration.yaml --format urdf --out arm7/out.urdf",
    ):
        ran = CliRunner().invoke(cli, command.split(), prog_name="armcal")
        assert ran.exit_code == 0, ran.output
    assert "in the measurement frame that base stands at x 8" in ran.stderr and "yaw 7" in ran.stderr
    first, now = ((path.read_text().partition('name="j2"')[0]) for path in (source, here / "arm7" / "out.urdf"))
    assert now == first


# Which way is up


@pytest.mark.slow
def test_a_frame_that_is_tilted_is_stated_or_the_assumption_is_a_finding(here: Path) -> None:
    """The tracker's y axis points up: stated, the spring is found; not stated, the run says what it assumed."""
    rows = table(here, f"{HEADER},mass_g,com_x_mm\n90,0,0,120,400,0\n0,200,0,0,900,-100\n0,160,0,0,500,-80\n")
    assert new_robot("arm", "--dh", rows, "--convention", "standard", "--up", "y").exit_code == 0
    arm = here / "arm" / "arm.yaml"
    assert yaml.safe_load(arm.read_text(encoding="utf-8"))["statics"]["gravity_m_s2"] == [0, -9.81, 0]

    def run(**more: str) -> list[str]:
        path = here / "arm" / "simulated.yaml"
        settings = [f"--set={key.replace('__', '.')}={value}" for key, value in more.items()]
        ran = CliRunner().invoke(cli, ["run", str(path), "--out", str(here / "run"), "--json", *settings])
        assert ran.exit_code in (0, 3), ran.output
        findings = json.loads(ran.stdout)["verdict"]["findings"]
        return [finding["text"] for finding in findings if finding["grade"] == "warning"]

    assert not [text for text in run() if "gravity" in text]
    arm.write_text(arm.read_text(encoding="utf-8").replace("  gravity_m_s2", "  # gravity_m_s2"), encoding="utf-8")
    fixed = {"validation__folds": "0", "parameters__free": '["arm.mdh.base_*", "arm.mdh.theta2", "tracker.target_*"]'}
    told = [text for text in run(**fixed) if "gravity" in text]
    assert told and "assumed to be (0, 0, -9.80665) m/s^2" in told[0]
    asked = CliRunner().invoke(cli, ["check", str(here / "arm" / "simulated.yaml")])
    assert "The direction of gravity is not stated" in asked.output

    columns = re.findall(r"gravity_[xyz]_\w+", asked.output)
    records = here / "arm" / "simulated.csv"
    head, *lines = records.read_text(encoding="utf-8").splitlines()
    rows_with_gravity = [",".join([head, *columns]), *(f"{line},0,-9.81,0" for line in lines)]
    records.write_text("\n".join(rows_with_gravity) + "\n", encoding="utf-8")
    asked = CliRunner().invoke(cli, ["check", str(here / "arm" / "simulated.yaml")])
    assert asked.exit_code == 0 and len(columns) == 3, asked.output
    assert "The direction of gravity is not stated" not in asked.output


@pytest.mark.slow
def test_an_arm_without_springs_needs_no_statics(here: Path) -> None:
    rows = table(here, f"{HEADER}\n90,0,0,120\n0,200,0,0\n0,160,0,0\n")
    ran = new_robot("arm", "--dh", rows, "--convention", "standard")
    assert ran.exit_code == 0 and "gravity" not in ran.output
    assert "statics" not in yaml.safe_load((here / "arm" / "arm.yaml").read_text(encoding="utf-8"))
    found = here / "arm" / "runs" / "simulated" / "calibration.yaml"
    poses = here / "arm" / "simulated.csv"
    ran = CliRunner().invoke(cli, ["predict", str(found), "--poses", str(poses), "--out", str(here / "p.csv")])
    assert ran.exit_code == 0, ran.output


@pytest.mark.parametrize(
    ("up", "expected"),
    [("z", (0, 0, 1)), ("-x", (-1, 0, 0)), ("0.3, 0,0.4", (0.6, 0, 0.8)), ("+y", None), ("0,0,0", None)],
)
def test_up_is_an_axis_or_three_numbers(up: str, expected: tuple[float, ...] | None) -> None:
    if expected is None:
        with pytest.raises(InputError, match="expected x, y, z"):
            direction(up)
    else:
        assert direction(up) == pytest.approx(expected)


# Where the target sits


@pytest.mark.slow
def test_a_target_off_the_last_axis_is_stated_and_estimated(here: Path) -> None:
    """Far off the axis all three of its coordinates are found; on the axis, the last row stands in for two of them."""
    rows = table(here, files_of(PAGE)["arm5.csv"])
    ran = new_robot(
        "arm5", "--dh", rows, "--convention", "standard", "--up", "z", "--target", "30, -1.2 cm, 55", "--json"
    )
    assert ran.exit_code == 0, ran.output
    content = json.loads(ran.stdout)
    assert {"tracker.target_x", "tracker.target_y", "tracker.target_z"} <= set(content["free"])
    assert content["holdout_calibrated_mm"] < 1.2 * NOISE_MM
    told = yaml.safe_load((here / "arm5" / "arm.yaml").read_text(encoding="utf-8"))["measurements"]["tracker"]
    assert told["target_mm"] == [30, -12, 55]
    kept = yaml.safe_load((here / "arm5" / "runs" / "simulated" / "calibration.yaml").read_text(encoding="utf-8"))
    found = {each["name"]: each for each in kept["parameters"]}
    assert [found[f"tracker.target_{axis}"]["nominal"] for axis in "xyz"] == pytest.approx([0.03, -0.012, 0.055])
    assert all(found[f"tracker.target_{axis}"]["sd"] < 1e-4 for axis in "xyz")


@pytest.mark.slow
def test_a_target_that_was_not_stated_is_taken_to_sit_beside_the_last_axis(here: Path) -> None:
    """Then all is free that a target beside the axis shows, as where its place was stated."""
    rows = robot_of_rows(
        "arm", "standard", read_rows(here / table(here, f"{HEADER}\n90,0,0,90\n90,160,0,0\n0,0,0,90\n"), REGISTRY)
    )
    places = {"unstated": None, "beside": (0.03, -0.012, 0.055), "on": (0.0, 0.0, 0.055)}
    free = {n: set(write_robot(replace(rows, target=at), here / n, REGISTRY).kept) for n, at in places.items()}
    assert free["unstated"] == free["beside"]
    assert free["beside"] - free["on"] == {"arm.mdh.alpha2", "arm.mdh.a2"}


@pytest.mark.parametrize("target", ["30,0", "30,0,0,0", "a,0,0", "30 deg,0,0", "nan,0,0", "1e9,0,0"])
def test_a_target_that_is_no_place_is_refused(target: str) -> None:
    with pytest.raises(InputError, match="for the target, expected three lengths"):
        place(target)


# What is refused

TABLES = {
    "a column without its unit": ("alpha,a_mm,theta_deg,d_mm\n0,1,2,3\n", ":1, alpha: alpha has no unit. Write alpha_"),
    "another unit": ("alpha_mm,a_mm,theta_deg,d_mm\n", ":1, alpha_mm: alpha_mm has a unit of length"),
    "a missing column": ("alpha_deg,a_mm,theta_deg\n", "found no column for d, expected d_m or d_cm or d_mm"),
    "a misspelt column": (
        f"{HEADER},masss_g\n0,1,2,3,4\n",
        "masss_g: found the column 'masss_g', expected some of name, joint, type,",
    ),
    "a column twice": (f"{HEADER},a_m\n", ":1, a_mm: found both a_m and a_mm"),
    "another delimiter": (HEADER.replace(",", ";") + "\n", ":1: found ';' between the columns"),
    "NaN": (f"{HEADER}\n0,1,2,3\n0,1,nan,3\n", ":3: theta_deg is empty or NaN. Write a number, 0 for none."),
    "infinity": (f"{HEADER}\n0,1,2,3\n0,inf,0,3\n", ":3: a_mm is infinite"),
    "too much": (f"{HEADER}\n0,1,2,3\n1e300,1,0,3\n", ":3, alpha: found 1e+300 deg, expected an arm's angle"),
    "an empty cell": (f"{HEADER}\n0,1,,3\n0,1,2,3\n", ":2: theta_deg is empty or NaN"),
    "a text": (f"{HEADER}\n0,1,2 deg,3\n", ":2, theta_deg: found '2 deg'"),
    "a decimal comma": (f'{HEADER}\n0,"1,5",2,3\n', ":2, a_mm: found '1,5', a decimal comma"),
    "one row": (f"{HEADER}\n0,1,2,3\n", ":2: found 1 joint, expected 2 to 20"),
    "no row": (f"{HEADER}\n", "found a header and no records"),
    "a short line": (f"{HEADER}\n0,1,2,3\n0,1,2\n", ":3: found 3 cells, expected 4"),
    "a long line": (f"{HEADER}\n0,1,2,3,4\n", ":2: found 5 cells, expected 4"),
    "an open quote": (f'{HEADER}\n0,1,"2,3\n', "not CSV"),
    "no UTF-8": (f"{HEADER}\n0,1,2,".encode() + b"\xff\n", ":2: found the byte 0xff"),
    "NUL": (f"{HEADER}\n0,1,2,\0\n", ":2: found a NUL byte"),
    "nothing": ("", "it is empty"),
    "limits the wrong way": (f"{HEADER},lower_deg,upper_deg\n0,1,2,3,9,-9\n", ":2, lower angle: found no lower limit"),
    "half of the limits": (f"{HEADER},lower_deg,upper_deg\n0,1,2,3,9,\n", ":2, lower angle: found no lower limit"),
    "limits of the other kind": (
        f"{HEADER},type,lower_deg,upper_deg\n0,1,2,3,prismatic,0,9\n",
        ":2, lower angle: found a limit of angle, and the joint slides. Write them under lower_m or",
    ),
    "a fixed row between joints": (
        f"{HEADER},type\n0,1,2,3,\n0,1,2,3,fixed\n0,1,2,3,\n",
        ":3: q2 is fixed and stands between joints.",
    ),
    "a mass in a fixed row": (f"{HEADER},type,mass_g\n0,1,2,3,fixed,4\n", ":2, mass: found a mass in a fixed row"),
    "nearly parallel axes": (
        f"{HEADER}\n-0.042,-57,0,574241\n0.19,1,2,-507363\n",
        "Nearly parallel axes (alpha -0.042 deg) make d so long. Write the rows in an arm.yaml, and shorten them:",
    ),
    "an unknown type": (f"{HEADER},type\n0,1,2,3,ball\n", ":2, type: found 'ball'"),
    "a mass below zero": (f"{HEADER},mass_g\n0,1,2,3,-1\n", ":2, mass: found a mass below zero"),
    "a name twice": (f"{HEADER},name\n0,1,2,3,a\n0,1,2,3,a\n", ":3: found the joint name 'a', a second time"),
    "a name that is taken": (f"{HEADER},name\n0,1,2,3,a\n0,1,2,3,x\n", ":3: found the joint name 'x'"),
    "a name like a unit": (f"{HEADER},name\n0,1,2,3,a_mm\n0,1,2,3,b\n", ":2: found the joint name 'a_mm'"),
    "a name that is none": (f"{HEADER},name\n0,1,2,3,a b\n0,1,2,3,b\n", ":2: found the joint name 'a b'"),
}


@pytest.mark.parametrize("fault", TABLES)
def test_a_faulty_table_is_refused_with_its_place(fault: str, here: Path) -> None:
    text, told = TABLES[fault]
    with pytest.raises(InputError) as refused:
        read_rows(here / table(here, text), REGISTRY)
    assert told in str(refused.value)
    assert "rows.csv" in str(refused.value)
    assert refused.value.hint


URDF = '<robot name="r"><link name="a"/><link name="b"/>{}</robot>'
JOINT = '<joint name="j" type="{}"><parent link="a"/><child link="b"/>{}</joint>'
URDFS = {
    "no chain": (URDF.format(JOINT.format("fixed", "")), "moves"),
    "no joint": ('<robot name="r"><link name="a"/></robot>', "moves"),
    "one joint": (URDF.format(JOINT.format("continuous", "")), "found 1 moving joints"),
    "no XML": ("<robot", "not well-formed XML"),
    "no text": (b"\xff\xfe\xfa", "not well-formed XML"),
}


@pytest.mark.parametrize("fault", URDFS)
def test_a_faulty_urdf_is_refused(fault: str, here: Path) -> None:
    text, told = URDFS[fault]
    ran = new_robot("r", "--urdf", table(here, text, "r.urdf"))
    assert ran.exit_code == 2, ran.output
    assert told in ran.output and "r.urdf" in ran.output
    assert [path.name for path in here.iterdir()] == ["r.urdf"]


COMMANDS = {
    "no description": (
        [],
        "no description of the robot r, expected a file of it, or the name of a known skeleton (so101)",
    ),
    "a way up alone": (["--up", "z"], "Give --dh FILE with --convention, or --urdf FILE"),
    "no convention": (["--dh", "rows.csv"], "two go by the same name"),
    "two sources": (["--dh", "rows.csv", "--urdf", "r.urdf"], "found both --dh and --urdf"),
    "a tip of rows": (["--tip", "hand"], "found --tip without --urdf"),
    "a convention of nothing": (["--convention", "standard"], "found --convention without --dh"),
    "no file": (["--dh", "none.csv", "--convention", "standard"], "none.csv: there is no such file"),
    "a folder": (["--dh", ".", "--convention", "standard"], "it is a directory"),
    "no URDF": (["--urdf", "none.urdf"], "none.urdf: there is no such file"),
    "a folder that is there": (
        ["--dh", "rows.csv", "--convention", "standard", "--out", "taken"],
        "taken: it is there",
    ),
    "an arm of no size": (["--dh", "flat.csv", "--convention", "standard"], "the tip stays within 0 mm"),
}


@pytest.mark.parametrize("fault", COMMANDS)
def test_a_faulty_command_is_refused_and_leaves_nothing(fault: str, here: Path) -> None:
    arguments, told = COMMANDS[fault]
    table(here, f"{HEADER}\n90,0,0,100\n0,200,0,0\n")
    table(here, f"{HEADER}\n0,0,0,0\n0,0,0,0\n", "flat.csv")
    (here / "taken").mkdir()
    before = sorted(path.name for path in here.rglob("*"))
    ran = new_robot("r", *arguments)
    assert ran.exit_code == 2, ran.output
    assert told in ran.output
    assert "Traceback" not in ran.output and ".r." not in ran.output
    assert sorted(path.name for path in here.rglob("*")) == before


@pytest.mark.parametrize("name", ["", "1r", "a b", "../r", "a/b", "r" * 31])
def test_a_name_that_is_none_is_refused(name: str, here: Path) -> None:
    ran = new_robot("--dh", table(here, f"{HEADER}\n"), "--convention", "standard", "--", name)
    assert ran.exit_code == 2
    assert "found the name" in ran.output
