"""Pose residuals: errors of joints that no effect models, learned, kept where they help, and used wherever arms are."""

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from armcal.arm.pose_residual import ModelErrors, Postures
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.calibration.exporter import request_of
from armcal.errors import DataError
from armcal.functions.compiler import find_compiler
from armcal.run.experiment import Experiment
from armcal.run.pose_residual import Comparison, _harm
from armcal.testing import assert_contract
from armcal_residual.features import Products, packed, regressed, unpacked
from armcal_residual.gaussian_process import GaussianProcess, GaussianProcessSettings, _Likelihood, _squares
from compiled_arm import CompiledArm
from outside import armcal
from serving import ask, made

ARM = """
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{d_mm: 80, alpha_deg: 90}, {a_mm: 250}, {a_mm: 200, theta_deg: 10}]}
    effects: {%s}
    %s
measurements: {tracker: {type: tip_position, noise_mm: 0.05, target_mm: [20, 0, 30]}}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
parameters:
  free: ["arm.mdh.theta*", "arm.mdh.[ad]?", "tracker.*"]
  priors: {"arm.mdh.theta*": 2 deg, "arm.mdh.[ad]?": 3 mm, "tracker.*": 5 mm}
estimator: {type: cvxpy}
"""
SIMULATION = """
simulation:
  type: elastic_arm
  truth: truth.yaml
  seed: %d
  noise_mm: 0.05
  poses: {kind: random, count: %d, levels_deg: {q1: [-60, 60], q2: [-60, 60], q3: [-60, 60]}}
"""
GEARS = "arm.gears.sin2_1: 0.002 rad\narm.gears.cos2_2: -0.0015 rad\narm.gears.sin2_3: 0.002 rad\n"
HELD = "validation: {holdout: 0.25, seed: 2}\n"


def recorded(folder, truth=GEARS, count=240, seed=3):
    """Records of an arm whose gears err."""
    (folder / "sim.yaml").write_text(ARM % ("gears: {type: gear_error}", "") + SIMULATION % (seed, count))
    (folder / "truth.yaml").write_text(truth or "arm.mdh.a2: 251 mm\n")
    armcal("simulate", folder / "sim.yaml", "--out", folder / "data.csv")
    return folder / "data.csv"


def ran(folder, residual, data, *words):
    text = ARM % ("", f"residual: {residual}" if residual else "") + "data: {type: csv, path: data.csv}\n" + HELD
    (folder / "run.yaml").write_text(text)
    return armcal("run", folder / "run.yaml", "--data", data, "--out", folder / "run", "-q", *words)


@cache
def learned_run():
    import tempfile
    from pathlib import Path

    folder = Path(tempfile.mkdtemp())
    ran(folder, "{type: gaussian_process}", recorded(folder), "--parallel", "2")  # folds are sent to other processes
    metrics = json.loads((folder / "run/metrics.json").read_text())
    calibration = Calibration.load(folder / "run/calibration.yaml")
    return SimpleNamespace(folder=folder, metrics=metrics, calibration=calibration)


def test_the_contract():
    assert_contract(GaussianProcess, "residual")


@pytest.mark.slow
def test_unseen_errors_fall_to_near_the_noise_and_the_run_says_so():
    run = learned_run()
    errors, outcome = run.metrics["error_mm"]["calibrated"], run.metrics["pose_residual"]
    assert outcome["kept"] and outcome["folds"]["without_mm"] > 0.15
    noise = 0.05 * np.sqrt(8 / np.pi)  # the mean length of three coordinates' noise
    assert errors["holdout"]["mean"] < 1.4 * noise
    assert outcome["folds"]["with_mm"] == pytest.approx(errors["cross_validated"]["mean"], rel=1e-6)
    covered = run.metrics["prediction_intervals"]["same_recording"]["holdout"]
    chance = np.sqrt(0.9 * 0.1 / covered["coordinates"])
    assert abs(covered["share"]["90"] - 0.9) < 3.3 * chance  # once in a thousand by chance
    texts = [finding["text"] for finding in run.metrics["verdict"]["findings"]]
    assert any(text.startswith("The pose residual of arm takes unseen errors from") for text in texts)


@pytest.mark.slow
def test_what_is_learned_leaves_the_parameters_where_the_fit_has_them(tmp_path):
    """The length of the last link and the target trade: the shift that is learned would choose between them."""
    run = learned_run()
    ran(tmp_path, "", run.folder / "data.csv")
    plain = Calibration.load(tmp_path / "run/calibration.yaml").record.parameters
    assert [own.value for own in run.calibration.record.parameters] == [own.value for own in plain]
    assert [own.sd for own in run.calibration.record.parameters] == [own.sd for own in plain]


@pytest.mark.slow
def test_poses_beyond_the_records_are_flagged_and_what_was_learned_of_a_joint_is_not_added_beyond_its_angles(tmp_path):
    run, angles = learned_run(), [[20, 20, 20], [170, 20, 20], [170, 170, 20]]
    rows = [f"{i},{','.join(map(str, row))}" for i, row in enumerate(angles)]
    (tmp_path / "poses.csv").write_text("\n".join(["pose_id,q1_deg,q2_deg,q3_deg", *rows]) + "\n")
    said = armcal(
        "predict", run.folder / "run/calibration.yaml", "--poses", tmp_path / "poses.csv", "--out", tmp_path / "out.csv"
    )
    found = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
    assert found["beyond_records"].tolist() == [0, 1, 1] and "2 of 3 poses are beyond" in said.output
    near, far, farther = (
        run.calibration.system.arms["arm"].residual.corrections(Postures(np.radians(angles).T, np.zeros((3, 3)))).T
    )
    assert near[6] != 0 and not far[:7].any()  # neither of the tool, nor of the first joint
    np.testing.assert_array_equal(far[7:], near[7:])
    assert not farther.any()


def test_what_was_learned_has_to_help_every_target_and_no_region_may_lose():
    random = np.random.default_rng(3)
    gains = 1e-4 * (1 + random.normal(size=(2, 200)))
    errors = np.full(200, 1e-3)
    assert Comparison.of(errors, errors, gains).sure > 5
    gains[1] = 1e-4 * random.normal(size=200)
    assert Comparison.of(errors, errors, gains).sure < 2.6
    unknown = random.permutation(200).astype(float)
    assert not _harm(gains, unknown)
    gains[:, unknown > 165] -= 4e-4
    assert "fifth 5 of 5" in _harm(gains, unknown)


@pytest.mark.slow
def test_gains_by_chance_alone_are_seldom_harm():
    """Five regions at one in 200 each: 2.5 % of residuals that do nothing."""
    random = np.random.default_rng(4)
    harmed = [bool(_harm(random.normal(size=(1, 200)), random.uniform(size=200))) for _ in range(1000)]
    assert 0.01 < np.mean(harmed) < 0.045


@pytest.mark.slow
def test_the_report_says_where_it_acts_and_how_much():
    run = learned_run()
    calibration, commands = run.calibration, Experiment.load(run.folder / "run.yaml").read()
    arm = calibration.system.arms["arm"]
    bare = replace(calibration, system=replace(calibration.system, arms={"arm": replace(arm, residual=None)}))
    apart = calibration.predict(commands)[1][0] - bare.predict(commands)[1][0]
    moved = 1000 * np.linalg.norm(apart[:, :3, 3], axis=1)
    said = run.metrics["pose_residual"]["moves_tool_mm"]
    assert said["altogether"] == pytest.approx({"mean": moved.mean(), "max": moved.max()}, rel=1e-6)
    assert {"tool", "q1", "q2", "q3"} <= set(said)
    page = (run.folder / "run/report.html").read_text()
    assert "What was learned beside the model" in page and "How far the pose residual moves the tool" in page


def test_a_calibration_predicts_what_the_run_found_and_compensates_to_the_same_arm():
    run = learned_run()
    commands = Experiment.load(run.folder / "run.yaml").read()
    angles = commands.stacked(["arm.q1", "arm.q2", "arm.q3"]).T
    read, tools = run.calibration.predict(commands)
    missed = 1000 * np.stack([commands.column(f"tracker.{axis}") - read[f"tracker.{axis}"] for axis in "xyz"])
    residuals = np.genfromtxt(run.folder / "run/residuals.csv", delimiter=",", names=True)
    np.testing.assert_allclose(missed, [residuals[f"d{axis}_mm"] for axis in "xyz"], atol=2e-5)
    found = run.calibration.compensate(tools[0][:20, :3, 3], start=angles[:20] + 0.1)
    back = {f"arm.q{i + 1}": row for i, row in enumerate(found.joint_angles.T)}
    back |= {f"arm.approach.q{i + 1}": row for i, row in enumerate(found.approach.T)}
    reached = run.calibration.predict(Dataset(commands.ids[:20], back))[1][0]
    np.testing.assert_allclose(reached[:, :3, 3], tools[0][:20, :3, 3], atol=1e-9)


def test_intervals_widen_where_nothing_was_measured():
    run = learned_run()

    def widths(angle_deg):
        at = {f"arm.q{i}": np.full(1, np.radians(angle_deg if i == 1 else 20.0)) for i in (1, 2, 3)}
        return max(run.calibration.plus_minus(Dataset(("a",), at)).half_widths[f"tracker.{axis}"][0] for axis in "xyz")

    assert widths(170.0) > 3 * widths(20.0)


@pytest.mark.slow
def test_an_arm_without_such_errors_keeps_none(tmp_path):
    ran(tmp_path, "{type: gaussian_process}", recorded(tmp_path, ""))
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert not metrics["pose_residual"]["kept"]
    assert "What was learned beside" not in (tmp_path / "run/report.html").read_text()
    kept = Calibration.load(tmp_path / "run/calibration.yaml").system.arms["arm"].residual
    assert kept is not None and not kept.is_learned


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_c_code_stands_where_the_calibration_does(tmp_path):
    calibration = learned_run().calibration
    arm = CompiledArm(request_of(calibration, None, "arm.c"), tmp_path)
    record = arm.defaults()
    for angles in np.random.default_rng(0).uniform(-1, 1, (5, 3)):
        record[:3] = angles
        status, pose, _ = arm.forward(record)
        assert status == 0
        np.testing.assert_allclose(pose, calibration.forward(angles)[0, :3], atol=1e-12)


@pytest.mark.slow
def test_formats_that_cannot_hold_it_say_so_and_how_far_that_moves_the_tool(tmp_path):
    calibration = learned_run().folder / "run/calibration.yaml"
    said = armcal("export", calibration, "--format", "json", "--out", tmp_path / "arm.json", "--json")
    content = json.loads(said.stdout)
    assert content["left_out"] == ["the pose residual"] and content["left_out_mm"] > 0.5
    held = json.loads(armcal("export", calibration, "--format", "c", "--out", tmp_path / "arm.c", "--json").stdout)
    assert held["left_out"] == []
    assert (
        "not converted: residual" in armcal("convert", calibration, "--to", "poe", "--out", tmp_path / "a.yaml").output
    )


def test_a_study_compares_with_and_without(tmp_path):
    data = recorded(tmp_path, count=120)
    for name, residual in (("plain", ""), ("learned", "residual: {type: gaussian_process}")):
        (tmp_path / f"{name}.yaml").write_text(ARM % ("", residual) + "data: {type: csv, path: data.csv}\n")
    variants = "".join(f"    {name}: {{extends: {name}.yaml}}\n" for name in ("plain", "learned"))
    (tmp_path / "study.yaml").write_text(f"study:\n  folds: 3\n  variants:\n{variants}")
    armcal("study", tmp_path / "study.yaml", "--data", data, "--out", tmp_path / "study", "-q")
    found = json.loads((tmp_path / "study/study.json").read_text())
    errors = {v["name"]: v["error_mm"]["cross_validated"]["mean"] for v in found["variants"]}
    assert errors["learned"] < 0.3 * errors["plain"]


@pytest.mark.slow
def test_what_a_drift_could_explain_is_learned_all_the_same(tmp_path):
    data = recorded(tmp_path)
    head, *rows = data.read_text().splitlines()
    first = head.split(",").index("q1_deg")
    rows.sort(key=lambda row: float(row.split(",")[first]))  # neighbours in time stand alike
    data.write_text("\n".join([head + ",sequence", *(f"{row},{i}" for i, row in enumerate(rows))]) + "\n")
    ran(
        tmp_path, "{type: gaussian_process}", data, "--set", "parameters.drift={arm.mdh.theta*: {sd: 0.1 deg, over: 6}}"
    )
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    folds = metrics["pose_residual"]["folds"]
    assert metrics["pose_residual"]["kept"] and folds["with_mm"] < 0.5 * folds["without_mm"]


@cache
def expanding_run():
    """An arm that is longer where it is warmer, of which its model knows nothing."""
    import tempfile
    from pathlib import Path

    folder = Path(tempfile.mkdtemp())
    head, *rows = recorded(folder, "", 300).read_text().splitlines()
    warmth = np.random.default_rng(1).uniform(15, 30, len(rows))
    lines = []
    for row, celsius in zip(rows, warmth, strict=True):
        *rest, x, y, z = row.split(",")
        longer = [repr(float(own) * (1 + 2e-4 * (float(celsius) - 20))) for own in (x, y, z)]
        lines.append(",".join([*rest, *longer, repr(float(celsius))]))
    (folder / "data.csv").write_text("\n".join([head + ",temperature_C", *lines]) + "\n")
    ran(folder, "{type: gaussian_process}", folder / "data.csv")
    return SimpleNamespace(folder=folder, calibration=Calibration.load(folder / "run/calibration.yaml"))


@pytest.mark.slow
def test_errors_that_depend_on_the_temperature_are_learned_where_it_was_recorded():
    run = expanding_run()
    folds = json.loads((run.folder / "run/metrics.json").read_text())["pose_residual"]["folds"]
    assert folds["without_mm"] > 0.25 and folds["with_mm"] < 1.3 * 0.05 * np.sqrt(8 / np.pi)
    (part,) = [own for own in run.calibration.system.arms["arm"].residual.settings.learned if own.first == 0][-1:]
    assert [own.of for own in part.terms[0].inputs][-1] == "temperature"


@pytest.mark.slow
def test_a_prediction_that_lacks_the_temperature_is_less_sure():
    calibration = expanding_run().calibration
    at = {f"arm.q{i}": np.full(2, 0.3) for i in (1, 2, 3)}
    warm = Dataset(("a", "b"), {**at, "temperature": np.array([16.0, 29.0])})
    read = calibration.predict(warm)[0]
    moved = 1000 * np.linalg.norm([np.diff(read[f"tracker.{axis}"]) for axis in "xyz"])
    length = 1000 * np.linalg.norm([read[f"tracker.{axis}"][0] for axis in "xyz"])
    assert moved == pytest.approx(13 * 2e-4 * length, rel=0.15)
    told, untold = (
        max(calibration.plus_minus(own).half_widths[f"tracker.{axis}"].max() for axis in "xyz")
        for own in (warm, Dataset(("a", "b"), at))
    )
    assert untold > 2 * told


@pytest.mark.slow
def test_compensation_and_c_code_take_the_temperature(tmp_path):
    calibration, angles = expanding_run().calibration, np.random.default_rng(0).uniform(-1, 1, (6, 3))
    celsius = np.linspace(16, 29, 6)
    at = {f"arm.q{i + 1}": row for i, row in enumerate(angles.T)}
    tools = calibration.predict(Dataset(tuple("abcdef"), {**at, "temperature": celsius}))[1][0]
    found = calibration.compensate(tools[:, :3, 3], start=angles + 0.1, conditions={"temperature": celsius})
    back = {f"arm.q{i + 1}": row for i, row in enumerate(found.joint_angles.T)}
    back |= {f"arm.approach.q{i + 1}": row for i, row in enumerate(found.approach.T)}
    reached = calibration.predict(Dataset(tuple("abcdef"), {**back, "temperature": celsius}))[1][0]
    np.testing.assert_allclose(reached[:, :3, 3], tools[:, :3, 3], atol=1e-9)
    if find_compiler() is not None:
        arm = CompiledArm(request_of(calibration, None, "arm.c"), tmp_path, conditions=("temperature",))
        record = arm.defaults()
        record[:3], record[-1] = angles[5], celsius[5]
        status, pose, _ = arm.forward(record)
        assert status == 0
        np.testing.assert_allclose(pose, tools[5, :3], atol=1e-12)


@cache
def loaded_run():
    """An arm that is stiff in its model, and whose tool sinks under its load."""
    import tempfile
    from pathlib import Path

    folder = Path(tempfile.mkdtemp())
    head, *rows = recorded(folder, "", 300).read_text().splitlines()
    lines = []
    for row, grams in zip(rows, np.random.default_rng(1).uniform(0, 1500, len(rows)), strict=True):
        *rest, x, y, z = row.split(",")
        sunk = float(z) - sag_mm(np.array([float(x), float(y)]), grams / 1000)
        lines.append(",".join([*rest, x, y, repr(float(sunk)), repr(float(grams))]))
    (folder / "data.csv").write_text("\n".join([head + ",payload_g", *lines]) + "\n")
    ran(
        folder,
        "{type: gaussian_process}",
        folder / "data.csv",
        "--set",
        "validation.folds=2",
        "--set",
        "statics.payload_g=null",
    )
    return SimpleNamespace(folder=folder, calibration=Calibration.load(folder / "run/calibration.yaml"))


def sag_mm(beside_mm, load_kg):
    return 1.2 * load_kg * np.sum(beside_mm**2) / 450**2


@pytest.mark.slow
def test_errors_that_depend_on_the_load_are_learned_and_hold_on_unseen_records():
    run = loaded_run()
    metrics = json.loads((run.folder / "run/metrics.json").read_text())
    folds, unseen = metrics["pose_residual"]["folds"], metrics["error_mm"]["calibrated"]["holdout"]["mean"]
    assert metrics["pose_residual"]["kept"] and folds["without_mm"] > 0.35 and unseen < 0.4 * folds["without_mm"]
    part = [own for own in run.calibration.system.arms["arm"].residual.settings.learned if own.first == 0][-1]
    assert [own.of for own in part.terms[0].inputs][-1] == "payload"
    with pytest.raises(DataError, match="learned what loads do and its payload is not stated"):
        run.calibration.forward(np.zeros(3))


@pytest.mark.slow
def test_a_server_asks_for_the_load_that_was_learned():
    content = (loaded_run().folder / "run/calibration.yaml").read_text()
    answer = ask(made(content), do="forward", joint_angles_deg=[0, 0, 0])
    assert not answer["ok"] and "nor the calibration states its payload" in answer["error"]


@pytest.mark.slow
def test_compensation_and_c_code_take_the_load(tmp_path):
    calibration, angles = loaded_run().calibration, np.random.default_rng(0).uniform(-0.9, 0.9, (2, 3))
    at = {f"arm.q{i + 1}": row for i, row in enumerate(angles.T)}
    tools = {
        load: calibration.predict(Dataset(("a", "b"), {**at, "payload": np.full(2, load)}))[1][0] for load in (0.2, 1.3)
    }
    sunk = 1000 * (tools[0.2] - tools[1.3])[:, 2, 3]
    read = calibration.predict(Dataset(("a", "b"), {**at, "payload": np.full(2, 0.2)}))[0]
    beside = 1000 * np.stack([read["tracker.x"], read["tracker.y"]])
    np.testing.assert_allclose(sunk, [sag_mm(own, 1.1) for own in beside.T], atol=0.1)
    found = calibration.compensate(tools[1.3][:, :3, 3], start=angles + 0.1, payload=np.full(2, 1.3))
    back = {f"arm.q{i + 1}": row for i, row in enumerate(found.joint_angles.T)}
    back |= {f"arm.approach.q{i + 1}": row for i, row in enumerate(found.approach.T)}
    reached = calibration.predict(Dataset(("a", "b"), {**back, "payload": np.full(2, 1.3)}))[1][0]
    np.testing.assert_allclose(reached[:, :3, 3], tools[1.3][:, :3, 3], atol=1e-9)
    if find_compiler() is not None:
        request = request_of(calibration, None, "arm.c")
        arm, names = CompiledArm(request, tmp_path), request.expression(()).channels
        record = arm.defaults()
        record[:3], record[names.index("payload")] = angles[1], 1.3
        status, pose, _ = arm.forward(record)
        assert status == 0
        np.testing.assert_allclose(pose, tools[1.3][1, :3], atol=1e-12)


@pytest.mark.slow
def test_a_recalibration_holds_what_was_learned(tmp_path):
    run = learned_run()
    (tmp_path / "calibration.yaml").write_text((run.folder / "run/calibration.yaml").read_text())
    armcal(
        "recalibrate",
        tmp_path / "calibration.yaml",
        "--from",
        run.folder / "data.csv",
        "--out",
        tmp_path / "out",
        "-q",
    )
    after = Calibration.load(tmp_path / "out/calibration.yaml")
    postures = Postures(np.random.default_rng(0).uniform(-1, 1, (3, 20)), np.zeros((3, 20)))
    kept = [own.system.arms["arm"].residual.corrections(postures) for own in (run.calibration, after)]
    np.testing.assert_array_equal(*kept)


def test_contacts_have_nothing_to_learn_from(tmp_path):
    config = ARM % ("", "residual: {type: gaussian_process}")
    config = config.replace("tip_position, noise_mm: 0.05, target_mm: [20, 0, 30]", "plane_contact, noise_mm: 0.05")
    (tmp_path / "a.yaml").write_text(config.replace("tracker.*", "arm.mdh.alpha*").replace("5 mm}", "5 deg}"))
    rows = "\n".join(f"{i},{10 * i},{-5 * i},{7 * i},table" for i in range(12))
    (tmp_path / "data.csv").write_text(f"pose_id,q1_deg,q2_deg,q3_deg,plane\n{rows}\n")
    done = armcal("run", tmp_path / "a.yaml", "--data", tmp_path / "data.csv", "--out", tmp_path / "out", code=2)
    assert "a pose residual is learned from measured positions" in done.stderr


@pytest.mark.parametrize("damage", ["cut", "text"])
def test_what_was_learned_is_refused_when_it_is_damaged(damage):
    section = dict(learned_run().calibration.record.arms["arm"]["residual"])
    section.pop("type")
    own = GaussianProcessSettings.model_validate(section)
    part = own.learned[0]
    weights = part.weights[:-12] if damage == "cut" else "!" + part.weights[1:]
    spoiled = own.model_copy(update={"learned": (part.model_copy(update={"weights": weights}),)})
    with pytest.raises(ValueError, match="cannot be read"):
        GaussianProcess(spoiled, ("q1", "q2", "q3"))
    with pytest.raises(ValueError, match="other joints"):
        GaussianProcess(own, ("q1", "q2"))


def test_numbers_survive_to_the_last_bit():
    numbers = np.random.default_rng(0).normal(size=(7, 3))
    np.testing.assert_array_equal(unpacked(packed(numbers), 7, 3), numbers)
    np.testing.assert_array_equal(unpacked(packed(numbers), None, 3), numbers)
    assert unpacked(packed(np.zeros((5, 0))), 5, None).shape == (5, 0)


def test_the_gradient_of_the_marginal_likelihood():
    random = np.random.default_rng(1)
    numbers = random.uniform(-2, 2, (2, 40))
    likelihood = _Likelihood(_squares(numbers, [("angle", 0), ("length", 1)]), random.normal(size=(40, 3)))
    at = np.array([0.2, -0.3, -0.5])
    step = 1e-6
    numeric = [(likelihood(at + step * e)[0] - likelihood(at - step * e)[0]) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(likelihood(at)[1], numeric, rtol=1e-5)


def test_the_evidence_finds_the_noise_and_leaves_out_what_is_not_there():
    random = np.random.default_rng(2)
    there, absent = random.normal(size=(2, 400, 10))
    weights = random.normal(0, 0.5, 10)
    features, errors = np.hstack([there, absent]), there @ weights + random.normal(0, 0.2, 400)
    found = regressed(Products(features.T @ features, features.T @ errors, float(errors @ errors), 400), [10, 10])
    assert np.sqrt(found.noise) == pytest.approx(0.2, rel=0.1)
    assert np.sqrt(found.variances[0]) == pytest.approx(0.5, rel=0.5)
    assert found.is_known(0) and not found.is_known(1)
    np.testing.assert_allclose(found.weights[0], weights, atol=0.05)


def test_a_slow_error_under_a_fine_one_holds_on_where_no_record_stood():
    def error(angle):
        return 0.002 * np.sin(2 * angle) + 0.0005 * np.sin(40 * angle)

    random, count = np.random.default_rng(1), 500
    commands = np.vstack([random.uniform(-1.2, 0.6, count), np.zeros((2, count))])
    slopes = np.zeros((count, 1, 9))
    slopes[:, 0, 6] = -1 / 1e-4  # the error is measured to 0.1 mrad
    measured = (error(commands[0]) / 1e-4 + random.normal(size=count))[:, None]
    errors = ModelErrors(Postures(commands, 0 * commands), ("angle",) * 3, measured, slopes, 0)
    learned = GaussianProcess(GaussianProcessSettings(), ("a", "b", "c")).learned(errors)
    beside = np.vstack([np.linspace(0.62, 0.77, 50), np.zeros((2, 50))])
    left = error(beside[0]) - learned.corrections(Postures(beside, 0 * beside))[6]
    assert np.mean(np.abs(left)) < 0.5 * np.mean(np.abs(error(beside[0])))


def test_few_records_teach_nothing():
    postures = Postures(np.random.default_rng(0).uniform(-1, 1, (3, 8)), np.zeros((3, 8)))
    errors = ModelErrors(postures, ("angle",) * 3, np.ones((8, 3)), np.ones((8, 3, 9)), 3)
    assert GaussianProcess(GaussianProcessSettings(), ("a", "b", "c")).learned(errors) is None
