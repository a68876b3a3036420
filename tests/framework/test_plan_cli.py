"""``armcal plan`` as a user meets it, judged by the files it leaves and by the other commands that read them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.base.dataset import Dataset
from armcal.cli.main import cli
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment, clearance_check
from armcal.run.plan import JointSpace, spread
from click.testing import CliRunner, Result

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
DEMO, PLAN, DATA = (str(CONFIGS / name) for name in ("demo.yaml", "plan.yaml", "demo.csv"))
QUICK = ("--set", "evaluator=interpreted", "--set", "plan.starts=1")
NOSE = "{type: ball, centre: {frame: nose}, radius_mm: 1}"
NO_PARTS = "{between: [a, b], at_least_mm: 1}"


def armcal(*arguments: str) -> Result:
    return CliRunner().invoke(cli, list(arguments))


def planned(out: Path, *arguments: str, config: str = DEMO) -> dict:
    result = armcal("plan", config, "--out", str(out), "--json", *QUICK, *arguments)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.open()))


def angles(path: Path) -> np.ndarray:
    return np.array([[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows(path)])


def log_det(problem_rows: np.ndarray) -> float:
    return float(2 * np.sum(np.log(np.linalg.svd(problem_rows, compute_uv=False))))


def scaled_rows(path: Path) -> np.ndarray:
    """The whitened Jacobian of the poses in a file, by another path than the plan's."""
    experiment = Experiment.load(DEMO, ("evaluator=interpreted",))
    q = np.deg2rad(angles(path))
    dataset = Dataset(tuple(map(str, range(len(q)))), {f"arm.q{i + 1}": q[:, i] for i in range(6)})
    system = experiment.system
    problem = Problem.build(
        system.arms, system.measurements, experiment.parameters, system.environment, dataset, "interpreted"
    )
    triangle = problem.of(dataset).triangular_factor(experiment.parameters.nominal())
    return triangle * experiment.parameters.scales()


@pytest.mark.slow
def test_a_plan_is_a_csv_of_recorded_poses_and_trains_a_run(tmp_path: Path) -> None:
    out = tmp_path / "plan.csv"
    told = planned(out, "--poses", "30")
    recorded = {row["pose_id"]: row for row in rows(Path(DATA))}
    ids = [row["pose_id"] for row in rows(out)]
    assert ids == told["ids"] and len(set(ids)) == 30
    for row in rows(out):
        assert all(float(row[f"q{i}_deg"]) == float(recorded[row["pose_id"]][f"q{i}_deg"]) for i in range(1, 7))
    assert told["log_det"] == pytest.approx(log_det(scaled_rows(out)), rel=1e-9)
    flags = ["--set", "validation.holdout=0", "--set", f"validation.train_ids={out}", "--set", "validation.folds=0"]
    run = armcal("run", DEMO, "--out", str(tmp_path / "run"), "--json", "--set", "evaluator=interpreted", *flags)
    assert run.exit_code == 0, run.output
    assert json.loads(run.stdout)["records"]["train"] == 30


@pytest.mark.slow
def test_predicted_deviations_are_those_that_a_run_finds(tmp_path: Path) -> None:
    """The declared noise is the true one here, so the calibrated deviations agree up to the residuals' own scale."""
    out = tmp_path / "plan.csv"
    told = planned(out, "--poses", "60")
    flags = ["--set", "validation.holdout=0", "--set", f"validation.train_ids={out}", "--set", "validation.folds=0"]
    folder = tmp_path / "run"
    assert armcal("run", DEMO, "--out", str(folder), "-q", "--set", "evaluator=interpreted", *flags).exit_code == 0
    sd = {p["name"]: p["sd"] for p in yaml.safe_load((folder / "calibration.yaml").read_text())["parameters"]}
    ratios = [p["sd_after"] / sd[p["name"]] for p in told["parameters"]]
    assert 0.7 < np.median(ratios) < 1.4


@pytest.mark.slow
def test_a_plan_reads_back_as_candidates_and_as_given_records(tmp_path: Path) -> None:
    first, second, third = (tmp_path / f"{name}.csv" for name in "abc")
    before = planned(first, "--poses", "40")
    planned(second, "--poses", "20", "--candidates", str(first))
    assert {r["pose_id"] for r in rows(second)} < {r["pose_id"] for r in rows(first)}
    after = planned(third, "--poses", "10", "--given", str(first))
    assert not {r["pose_id"] for r in rows(third)} & {r["pose_id"] for r in rows(first)}
    assert after["given_records"] == 40 and after["candidates"]["left_out"] == {"measured already": 40}
    together = np.vstack([scaled_rows(first), scaled_rows(third)])
    assert after["log_det"] == pytest.approx(log_det(together), rel=1e-9)
    assert after["log_det"] > before["log_det"]
    sd = {p["name"]: p["sd_after"] for p in before["parameters"]}
    assert all(p["sd_before"] == pytest.approx(sd[p["name"]], rel=1e-6) for p in after["parameters"])
    assert all(p["sd_after"] < p["sd_before"] for p in after["parameters"])


@pytest.mark.slow
def test_the_bound_holds_over_other_plans_and_is_told(tmp_path: Path) -> None:
    told = planned(tmp_path / "plan.csv", "--poses", "30")
    other = planned(tmp_path / "other.csv", "--poses", "30", "--set", "plan.seed=3")
    assert told["bound"]["upper"] >= max(told["log_det"], other["log_det"])
    assert told["bound"]["gap"] == pytest.approx(told["bound"]["upper"] - told["log_det"])
    assert 0.95 < told["bound"]["efficiency"] <= 1
    spoken = armcal("plan", DEMO, "--poses", "30", "--out", str(tmp_path / "x.csv"), *QUICK).stdout
    assert "upper bound" not in spoken and "D-efficiency at least 9" in spoken and "least determined" in spoken


@pytest.mark.slow
def test_order_approach_and_travel_time_belong_together(tmp_path: Path) -> None:
    out, slow = tmp_path / "plan.csv", tmp_path / "slow.csv"
    told = planned(out, "--poses", "30")
    q = angles(out)
    moves = np.diff(q, axis=0)
    assert told["visit"]["travel_s"] == pytest.approx(np.abs(moves).max(axis=1).sum() / 60)
    approach = np.array([[float(row[f"approach{i}"]) for i in range(1, 7)] for row in rows(out)])
    assert (approach[0] == 0).all()
    moved = moves != 0
    assert np.array_equal(approach[1:][moved], np.sign(moves)[moved])
    assert np.array_equal(approach[1:][~moved], approach[:-1][~moved])
    assert [row["order"] for row in rows(out)] == [str(i) for i in range(1, 31)]
    half = planned(slow, "--poses", "30", "--set", "plan.speeds_deg_per_s={q1: 1}")
    assert half["visit"]["travel_s"] > told["visit"]["travel_s"]
    assert set(half["ids"]) == set(told["ids"])


def test_poses_are_drawn_until_enough_keep_a_clearance_that_few_keep() -> None:
    experiment = Experiment.load(PLAN)
    plan, space = experiment.settings.plan, JointSpace.of(experiment)
    assert plan is not None

    def one_in_ten(poses: np.ndarray) -> np.ndarray:
        return poses[0] > np.deg2rad(80)

    pool = spread(plan.model_copy(update={"count": 1500}), space, np.deg2rad([[-100, 100]] * 6), one_in_ten)
    assert len(pool.dataset) == 1500


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["grid", "continuous"])
def test_limits_and_clearance_are_kept(tmp_path: Path, kind: str) -> None:
    out = tmp_path / "plan.csv"
    narrow = ("--set", "plan.limits.q1=[-100 deg, 0 deg]", "--set", "plan.limits.q3=[-60 deg, 100 deg]")
    few = ("--set", "plan.count=600", "--set", "plan.sweeps=3")
    told = planned(out, "--poses", "15", "--set", f"plan.candidates={kind}", *narrow, *few, config=PLAN)
    q = angles(out)
    assert q[:, 0].max() <= 0 and q[:, 2].min() >= -60 - 1e-9
    assert (np.abs(q) <= np.array([100, 50, 100, 100, 100, 50]) + 1e-9).all()
    experiment = Experiment.load(PLAN)
    check = clearance_check(experiment.settings.plan.clearance, experiment.system.arms, experiment.source)
    assert check is not None and check(np.deg2rad(q.T)).allowed.all()
    assert told["candidates"]["left_out"]["too little clearance"] > 0
    assert (told["candidates"]["refined"] > 0) == (kind == "continuous")


@pytest.mark.slow
def test_moving_on_through_joint_space_tells_more(tmp_path: Path) -> None:
    few = ("--poses", "15", "--set", "plan.candidates=continuous", "--set", "plan.count=300")
    held = planned(tmp_path / "a.csv", *few, "--set", "plan.sweeps=0", config=PLAN)
    moved = planned(tmp_path / "b.csv", *few, config=PLAN)
    assert moved["log_det"] > held["log_det"] + 1
    assert moved["log_det"] == pytest.approx(log_det(scaled_rows(tmp_path / "b.csv")), rel=1e-9)


@pytest.mark.slow
def test_the_same_command_gives_the_same_file(tmp_path: Path) -> None:
    for name in ("a", "b"):
        planned(
            tmp_path / f"{name}.csv",
            "--poses",
            "12",
            "--set",
            "plan.candidates=continuous",
            "--set",
            "plan.count=300",
            config=PLAN,
        )
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--poses", "5"], "5 poses give 15 equations, and 28 of 28"),
        (["--poses", "9999"], "found 200 candidates"),
        (["--poses", "50", "--candidates", "nowhere.csv"], "nowhere.csv"),
        (["--poses", "50", "--given", "nowhere.csv"], "nowhere.csv"),
        (["--poses", "50", "--calibration", "nowhere.yaml"], "nowhere.yaml"),
        (["--poses", "50", "--set", "plan.order=torque"], "plan.order"),
        (["--poses", "50", "--set", "plan.limits={q1: [9 deg, 1 deg]}"], "not in rising order"),
        (["--poses", "50", "--set", "plan.limits={q9: [1 deg, 9 deg]}"], "'q9'"),
        (["--poses", "50", "--set", "plan.limits={q1: [1 deg, 9 deg]}"], "200 beyond joint limits"),
        (["--poses", "50", "--set", "plan.candidates=continuous"], "found no limits for q1"),
        (["--poses", "50", "--set", "plan.candidates=grid"], "found no levels for q1"),
        (["--poses", "50", "--set", "plan.speeds_deg_per_s={q9: 3}"], "'q9'"),
        (["--poses", "50", "--set", "parameters.free=[]"], "no parameter is free"),
        (["--poses", "50", "--set", "parameters.free=[arm.mdh.*]"], "even all 200 candidates leave"),
        (["--poses", "50", "--set", f"plan.clearance={{parts: {{a: [{NOSE}]}}}}"], "'nose'"),
        (["--poses", "50", "--set", f"plan.clearance={{rules: [{NO_PARTS}]}}"], "no part is called 'a'"),
    ],
)  # fmt: skip
def test_bad_input_ends_with_2_and_leaves_no_file(tmp_path: Path, arguments: list[str], words: str) -> None:
    out = tmp_path / "plan.csv"
    result = armcal("plan", DEMO, "--out", str(out), *QUICK, *arguments)
    assert result.exit_code == 2, result.output
    assert words in result.output and "Traceback" not in result.output
    assert not out.exists()


def test_an_out_that_cannot_be_written_is_refused_before_any_work(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "nowhere" / "plan.csv"):
        result = armcal("plan", DEMO, "--poses", "30", "--out", str(place), *QUICK)
        assert result.exit_code == 2 and str(place) in result.output.replace("\n", "")


@pytest.mark.slow
def test_a_plan_about_a_calibration_takes_its_values(tmp_path: Path, demo_run: Path) -> None:
    nominal = planned(tmp_path / "n.csv", "--poses", "30")
    about = planned(tmp_path / "c.csv", "--poses", "30", "--calibration", str(demo_run / "calibration.yaml"))
    assert about["log_det"] != pytest.approx(nominal["log_det"], abs=0.01)


@pytest.mark.parametrize("command", ["check", "identify", "plan", "run", "study"])
@pytest.mark.quick("check")
def test_another_data_file_wins_over_an_absolute_path_that_leads_nowhere(command: str, tmp_path: Path) -> None:
    """The configured path is not even looked at."""
    away = f"data.path={tmp_path / 'away' / 'records.csv'}"
    config = "study_demo.yaml" if command == "study" else "demo.yaml"
    more = {"plan": ["--poses", "12"], "run": ["--set", "validation.folds=0"], "study": ["--set", "validation.folds=2"]}
    out = [] if command in ("check", "identify") else ["--out", str(tmp_path / "out.csv")]
    arguments = [command, str(CONFIGS / config), "--set", away, *QUICK[:2], *more.get(command, []), *out]
    refused = CliRunner().invoke(cli, arguments)
    assert refused.exit_code == 2, refused.output
    ran = CliRunner().invoke(cli, [*arguments, "--data", DATA])
    assert ran.exit_code == 0, ran.output
