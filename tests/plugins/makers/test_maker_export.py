"""Calibrated arms written as their makers' files: read back they are the same arm in 1,000 poses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.base.settings import Settings
from armcal.calibration.exporter import request_of
from armcal.cli.main import cli
from armcal.errors import ConfigError, InputError
from armcal_makers.files import UrExporter, UrSettings, XarmExporter
from click.testing import CliRunner

from tests.made_calibrations import made_calibration
from tests.plugins.makers.maker_files import (
    UR5_DELTAS,
    UR5E_YAML,
    UR10_DELTAS,
    XARM6_YAML,
    dh_tip,
    full_urdf,
    poses,
    ur_rows,
    yaml_tip,
)

KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
ROOT = Path(__file__).resolve().parents[3]
UR10 = ROOT.parent / "shared" / "data" / "ur10_leica" / "random_poses.csv"
PAGE = ROOT / "docs" / "pose_residual.md"
HASH = "calib_14698139022496758595"


def armcal(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def rows_of(content):
    """The six numbers of each joint, in order."""
    entries = yaml.safe_load(content)["kinematics"]
    return [[float(entry[key]) for key in KEYS] for entry in entries.values() if isinstance(entry, dict)]


def tips_of(content, q):
    return yaml_tip(rows_of(content), q)


def made(folder, model, **more):
    """A calibration of an arm, every number of which moved by up to 2 mm and 20 mrad."""
    config = {"arms": {"arm": {"model": model, **more}}, "measurements": {"t": {"type": "tip_position", "noise_mm": 1}}}
    (folder / "arm.yaml").write_text(yaml.safe_dump(config))
    return request_of(made_calibration(folder / "arm.yaml"), None)


def ur_mdh(robot, **more):
    rows = [
        {"theta_deg": float(np.degrees(t)), "a_m": float(a), "d_m": float(d), "alpha_deg": float(np.degrees(alpha))}
        for t, a, d, alpha in zip(*ur_rows(robot), strict=True)
    ]
    return {"type": "mdh", "convention": "standard", "rows": rows, **more}


def of_maker(folder, text, name):
    """The section ``model`` of a maker's file."""
    (folder / "k.yaml").write_text(text)
    ran = armcal("maker", folder / "k.yaml", "--out", folder / name)
    assert ran.exit_code == 0, ran.output
    return {"type": "urdf", "path": name}


@pytest.mark.parametrize(
    ("exporter", "text"), [(UrExporter(UrSettings()), UR5E_YAML), (XarmExporter(Settings()), XARM6_YAML)]
)
def test_a_makers_file_comes_back_number_by_number(tmp_path, exporter, text):
    request = made(tmp_path, of_maker(tmp_path, text, "arm.urdf"))
    nominal = {block.name: np.array(block.nominal) for block in request.arm.parameters()}
    exported = exporter.export(replace(request, values=nominal))
    q = poses()
    assert np.abs(tips_of(exported.content, q) - tips_of(text, q)).max() < 1e-13
    for here, there in zip(rows_of(exported.content), rows_of(text), strict=True):
        assert here[:3] == pytest.approx(there[:3], abs=1e-12)
    assert (exported.changed, exported.left_out, exported.remarks) == (0, (), ())
    assert yaml.safe_load(exported.content)["kinematics"].get("hash") == (HASH if text is UR5E_YAML else None)


@pytest.mark.parametrize("robot", ["ur3", "ur10", "ur16e"])
def test_a_calibrated_table_of_rows_is_written_for_the_driver(tmp_path, robot):
    request = made(tmp_path, ur_mdh(robot))
    scope = "arm.mdh."
    rows = [[request.values[f"{scope}{name}{i}"][0] for i in range(1, 7)] for name in ("theta", "a", "d", "alpha")]
    exported, q = UrExporter(UrSettings(hash=HASH)).export(request), poses()
    calibrated = dh_tip(rows, q)
    written = tips_of(exported.content, q)
    flange_T_tool = np.linalg.solve(written, calibrated)  # a and alpha of the last row lie behind the last joint
    assert np.abs(flange_T_tool - flange_T_tool[0]).max() < 1e-12
    assert np.abs(flange_T_tool[0] - np.eye(4)).max() < 0.03 and "TCP" in exported.remarks[0]
    assert exported.changed == 24
    nominal = np.linalg.norm((dh_tip(ur_rows(robot), q) - calibrated)[:, :3, 3], axis=1)
    assert max(nominal) > 0.003  # it is no copy of the nominal arm


def test_without_a_tool_behind_the_flange_nothing_is_left_over(tmp_path):
    request = made(tmp_path, ur_mdh("ur10", base=[{"x_mm": 1500}, {"rz_deg": 40}]))
    values = {**request.values, "arm.mdh.a6": np.zeros(1), "arm.mdh.alpha6": np.zeros(1)}
    exported = UrExporter(UrSettings(hash=HASH)).export(replace(request, values=values))
    assert exported.remarks == ()  # and where the arm stands is not in the file
    assert np.linalg.norm(rows_of(exported.content)[0][:2]) < 1e-12


def test_of_the_makers_own_urdf_the_arm_alone_is_written(tmp_path):
    (tmp_path / "cell.urdf").write_text(full_urdf())
    request = made(tmp_path, {"type": "urdf", "path": "cell.urdf"})
    nominal = {block.name: np.array(block.nominal) for block in request.arm.parameters()}
    exported = UrExporter(UrSettings(hash=HASH)).export(replace(request, values=nominal))
    q = poses()
    wanted = dh_tip(ur_rows("ur5e"), q)
    assert np.abs(tips_of(exported.content, q) - wanted).max() < 1e-12
    assert exported.remarks == ()


@pytest.mark.parametrize(("robot", "deltas"), [("ur5", UR5_DELTAS), *(("ur10", deltas) for deltas in UR10_DELTAS)])
def test_rows_far_away_are_moved_back_to_the_links_and_the_arm_stays(tmp_path, robot, deltas):
    """Rows put nearly parallel axes hundreds of metres along themselves, as in a controller's own file."""
    request, names = made(tmp_path, ur_mdh(robot)), ("theta", "a", "d", "alpha")
    rows = [np.add(row, delta) for row, delta in zip(ur_rows(robot), deltas, strict=True)]
    values = {f"arm.mdh.{name}{i + 1}": row[[i]] for name, row in zip(names, rows, strict=True) for i in range(6)}
    exported, q = (
        UrExporter(UrSettings(hash=HASH)).export(replace(request, values={**request.values, **values})),
        poses(),
    )
    assert np.abs(tips_of(exported.content, q) - dh_tip(rows, q)).max() < 1e-11
    assert np.abs([row[:3] for row in rows_of(exported.content)]).max() < 1  # and its links are where links are


def test_effects_are_named(tmp_path):
    model = of_maker(tmp_path, UR5E_YAML, "arm.urdf")
    effects = {"zero": {"type": "gear_error"}}
    exported = UrExporter(UrSettings()).export(made(tmp_path, model, effects=effects))
    assert exported.left_out == ("zero",)


@pytest.mark.parametrize(
    ("exporter", "robot", "message"),
    [
        (UrExporter(UrSettings()), "ur5", "no hash"),
        (UrExporter(UrSettings(hash="1")), "ur5", "expected the hash"),
        (XarmExporter(Settings()), "ur5", "not a calibration of"),
    ],
)
def test_other_arms_are_refused(tmp_path, exporter, robot, message):
    with pytest.raises(InputError, match=message):
        exporter.export(made(tmp_path, ur_mdh(robot)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("alpha", [0, 90, 180])
def test_an_arm_of_six_other_joints_is_refused(tmp_path, alpha):
    model = ur_mdh("ur5", base=[{"ry_deg": alpha}])
    model["rows"] = [{**row, "alpha_deg": alpha} for row in model["rows"]]
    with pytest.raises(InputError, match="not a calibration of"):
        UrExporter(UrSettings(hash=HASH)).export(made(tmp_path, model))


def test_a_joint_that_slides_is_refused(tmp_path):
    model = ur_mdh("ur5")
    model["rows"][2]["kind"] = "prismatic"
    with pytest.raises(ConfigError, match="slides"):
        UrExporter(UrSettings(hash=HASH)).export(made(tmp_path, model))


@pytest.mark.slow
def test_a_file_to_a_robot_and_back(tmp_path):
    """Read, made a robot with narrow priors, calibrated on simulated records, written, read."""
    of_maker(tmp_path, UR5E_YAML, "arm.urdf")
    folder = tmp_path / "r"
    widths = ("--prior-mm", "0.5", "--prior-deg", "0.05")
    ran = armcal("new", "robot", "r", "--urdf", tmp_path / "arm.urdf", "--out", folder, *widths)
    assert ran.exit_code == 0, ran.output
    priors = yaml.safe_load((folder / "calibrate.yaml").read_text())["parameters"]["priors"]
    assert set(priors.values()) == {"0.5 mm", "0.05 deg"}
    calibration, out = folder / "runs" / "simulated" / "calibration.yaml", tmp_path / "new.yaml"
    ran = armcal("export", calibration, "--format", "ur_calibration", "--out", out)
    assert ran.exit_code == 0, ran.output
    said = json.loads(armcal("maker", out, "--json").stdout)
    assert (said["robot"], said["hash"]) == ("ur5e", HASH)
    assert said["largest_mm"] > 2


@pytest.mark.slow
@pytest.mark.skipif(not UR10.exists(), reason="measured data that are not published here")
def test_a_measured_ur10_is_written_for_its_driver(tmp_path):
    """A quarter of its random poses: the file is the calibrated arm, which is nearer than the nominal one."""
    text = next(part for part in PAGE.read_text().split("```") if "random_poses.csv" in part).partition("\n")[2]
    (tmp_path / "run.yaml").write_text(text.replace("    residual: {type: gaussian_process}\n", ""))
    lines = UR10.read_text().splitlines(keepends=True)
    (tmp_path / "random_poses.csv").write_text("".join([lines[0], *lines[1::4]]))
    calibration, out = tmp_path / "out" / "calibration.yaml", tmp_path / "ur10.yaml"
    assert armcal("run", tmp_path / "run.yaml", "--out", tmp_path / "out", "-q").exit_code == 0
    ran = armcal("export", calibration, "--format", "ur_calibration", "--option", f"hash={HASH}", "--out", out)
    assert ran.exit_code == 0, ran.output
    values = {e["name"]: e["value"] for e in yaml.safe_load(calibration.read_text())["parameters"]}
    rows = [[values[f"arm.mdh.{name}{i}"] for i in range(1, 7)] for name in ("theta", "a", "d", "alpha")]
    q = poses()
    written, calibrated = tips_of(out.read_bytes(), q), dh_tip(rows, q)
    flange_T_tool = np.linalg.solve(written, calibrated)
    assert np.abs(flange_T_tool - flange_T_tool[0]).max() < 1e-10
    said = json.loads(armcal("maker", out, "--json").stdout)
    assert said["robot"] == "ur10" and 0.5 < said["median_mm"] < 5
    quality = json.loads((tmp_path / "out" / "metrics.json").read_text())["error_mm"]
    assert quality["calibrated"]["holdout"]["mean"] < 0.7 * quality["nominal"]["holdout"]["mean"]


def test_a_prior_of_no_width_is_refused(tmp_path):
    of_maker(tmp_path, UR5E_YAML, "arm.urdf")
    ran = armcal("new", "robot", "r", "--urdf", tmp_path / "arm.urdf", "--out", tmp_path / "r", "--prior-mm", "0")
    assert (ran.exit_code, "--prior-mm 0" in ran.stderr, (tmp_path / "r").exists()) == (2, True, False)
