"""Bad input through the command line: what is refused or warned of, with the place and the mend.

Faults of YAML itself are in test_yaml_*.py, of rows and columns in test_checks.py and test_csv_reader.py; here
are those that show only when configuration, data and problem meet.
"""

from __future__ import annotations

import json
import random
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli
from click.testing import CliRunner, Result

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs" / "lrm_arm"
DEMO = str(CONFIGS / "demo.yaml")


def check(*settings: str, config: str = DEMO, data: Path | None = None) -> Result:
    """``armcal check`` with --set for each setting."""
    arguments = ["check", config, *(x for s in settings for x in ("--set", s))]
    return CliRunner().invoke(cli, arguments + (["--data", str(data)] if data else []))


def refused(result: Result, *words: str) -> None:
    """Exit 2, no traceback, and the words in the message."""
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    text = " ".join(result.output.split())
    for word in words:
        assert word in text, (word, text)


def warned(result: Result, *words: str) -> None:
    """Exit 0, and a warning with the words."""
    assert result.exit_code == 0, result.output
    text = " ".join(result.output.split())
    assert "warning" in text
    for word in words:
        assert word in text, (word, text)


def some_rows(tmp_path: Path, count: int, columns: dict[str, str] | None = None, factor: float = 1.0) -> Path:
    """The first rows of the shipped data, perhaps under other headers and in another unit."""
    lines = (CONFIGS / "demo.csv").read_text().splitlines()
    header = lines[0].split(",")
    rows = [line.split(",") for line in lines[1 : count + 1]]
    for row in rows:
        for i, name in enumerate(header):
            if name in ("x_mm", "y_mm", "z_mm"):
                row[i] = repr(float(row[i]) * factor)
    renamed = [(columns or {}).get(name, name) for name in header]
    path = tmp_path / "rows.csv"
    path.write_text("\n".join([",".join(renamed), *(",".join(row) for row in rows)]) + "\n")
    return path


@pytest.mark.slow
def test_fewer_equations_than_parameters_needs_priors_and_says_both_numbers(tmp_path: Path) -> None:
    data = some_rows(tmp_path, 8)
    alone = ("validation.holdout=0", "validation.folds=0")
    refused(check(*alone, data=data), "24 equations", "28 free parameters", "prior")
    every = '"arm.mdh.[atd]*": 0.05 rad'
    angles = "parameters.priors={" + every.replace("[atd]*", "alpha*") + ', "arm.mdh.theta*": 3 deg'
    lengths = ', "arm.mdh.a[3-5]": 5 mm, "arm.mdh.d[45]": 5 mm, "arm.mdh.base_[xyz]": 5 mm'
    rest = ', "arm.mdh.tool_[yz]": 5 mm, "arm.mdh.after2_z": 5 mm, "arm.spring.k?": 0.1 rad/Nm}'
    warned(check(*alone, angles + lengths + rest, data=data), "24 equations", "28 free parameters", "priors")


def test_a_refusal_comes_with_the_warnings_of_the_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They may be its cause: here most records are copies."""
    path = some_rows(tmp_path, 3)
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([header, *(rows * 4)]) + "\n")
    refused(check(data=path), "exact duplicates", "5 folds of 2 records")
    arguments = ["check", DEMO, "--json", "--data", str(path)]
    monkeypatch.setattr("sys.argv", ["armcal", *arguments])
    shown = CliRunner().invoke(cli, arguments)
    assert "exact duplicates" in json.loads(shown.stdout)["error"]["warnings"][0]
    alone = ("validation.folds=0", "validation.holdout=0", "noise.estimate=true", 'parameters.free=["arm.mdh.theta2"]')
    (tmp_path / "one.csv").write_text("\n".join([header, *([rows[0]] * 4)]) + "\n")
    flags = [text for setting in alone for text in ("--set", setting)]
    run = ["run", DEMO, "--data", str(tmp_path / "one.csv"), "--out", str(tmp_path / "run"), *flags]
    refused(CliRunner().invoke(cli, run), "exact duplicates", "too few to estimate")


@pytest.mark.slow
def test_a_rank_deficiency_is_named_and_needs_a_prior() -> None:
    more = 'parameters.free=["arm.mdh.*_z", "arm.mdh.d3", "arm.mdh.theta*"]'
    refused(check(more), "does not determine", "arm.mdh.d3", "arm.mdh.after2_z", "prior")
    held = 'parameters.priors={"arm.mdh.d3": 2 mm, "arm.mdh.*_z": 2 mm}'
    result = check(more, held)
    assert result.exit_code == 0
    assert "held by priors: arm.mdh.after2_z, arm.mdh.d3 (rank 10 of 11" in " ".join(result.output.split())


@pytest.mark.parametrize("noise", ["0 mm", "-0.5 mm"])
def test_a_noise_that_is_not_positive_is_refused(noise: str) -> None:
    refused(check(f"measurements.tracker.noise_mm={noise}"), "noise", "command line", "standard deviation")


@pytest.mark.parametrize("prior", ["0 deg", "-1 deg"])
def test_a_prior_that_is_not_positive_is_refused(prior: str) -> None:
    refused(check(f'parameters.priors={{"arm.mdh.alpha2": {prior}}}'), "prior", "above zero")


def test_a_prior_in_the_wrong_unit_or_without_one_is_refused() -> None:
    refused(check('parameters.priors={"arm.mdh.alpha2": 3 mm}'), "arm.mdh.alpha2", "deg")
    refused(check('parameters.priors={"arm.mdh.alpha2": 3}'), "without a unit", "rad")


def test_a_compliance_below_zero_is_refused_as_nominal_value_and_as_setting() -> None:
    refused(check('parameters.values={"arm.spring.k2": -0.1 rad/Nm}'), "arm.spring.k2", "outside")
    refused(check("arms.arm.effects.spring.compliance_rad_per_Nm=-0.1"), "below zero")


@pytest.mark.slow
def test_gravity_of_the_wrong_sign_or_of_another_body_is_warned_of() -> None:
    warned(check("statics.gravity_m_s2=[0, 0, 9.81]"), "points up")
    warned(check("statics.gravity_m_s2=[0, 0, -1.62]"), "1.620", "earth", "9.807")


def test_compliances_without_a_stated_payload_are_refused(tmp_path: Path) -> None:
    refused(check("statics.payload_g=null"), "payload", "payload_g: 0")


def test_a_prediction_without_the_payload_its_calibration_had_is_refused(tmp_path: Path) -> None:
    lines = (CONFIGS / "demo.csv").read_text().splitlines()
    loaded = tmp_path / "loaded.csv"
    loaded.write_text("\n".join([lines[0] + ",payload_g", *(line + ",10" for line in lines[1:])]) + "\n")
    settings = ("statics.payload_g=null", "validation.folds=0", "evaluator=interpreted")
    flags = [x for s in settings for x in ("--set", s)]
    out = tmp_path / "run"
    run = CliRunner().invoke(cli, ["run", DEMO, "--data", str(loaded), "--out", str(out), *flags])
    assert run.exit_code == 0, run.output

    def predict(poses: Path) -> Result:
        arguments = ["--poses", str(poses), "--out", str(tmp_path / "predicted.csv")]
        return CliRunner().invoke(cli, ["predict", str(out / "calibration.yaml"), *arguments])

    refused(predict(CONFIGS / "demo.csv"), "demo.csv", "payload is not stated", "payload_g")
    assert predict(loaded).exit_code == 0
    refused(check("statics.payload_g=-5"), "payload", "found -5", "greater than or equal to 0")


@pytest.mark.slow
def test_grams_called_kilograms_are_warned_of() -> None:
    warned(
        check("statics.payload_g=100000"),
        "a payload of 100 kg is",
        "times the mass of the links (0.779 kg): is it in g?",
    )


@pytest.mark.slow
def test_millimetres_called_metres_and_the_reverse_are_refused(tmp_path: Path) -> None:
    metres = {f"{axis}_mm": f"{axis}_m" for axis in "xyz"}
    refused(check(data=some_rows(tmp_path, 60, metres)), "typically", "Check the unit", "rows.csv")
    refused(check(data=some_rows(tmp_path, 60, factor=1e-3)), "typically", "Check the unit")


def test_degrees_called_radians_are_refused(tmp_path: Path) -> None:
    wrong = {f"q{i}_deg": f"q{i}_rad" for i in range(1, 7)}
    refused(check(data=some_rows(tmp_path, 60, wrong)), "q1_rad", "degrees")


def test_training_ids_must_be_records_of_the_dataset(tmp_path: Path) -> None:
    ids = tmp_path / "ids.csv"
    ids.write_text("pose_id\n1\n99999\n")
    both = ("validation.holdout=0", f"validation.train_ids={ids}")
    refused(check(*both), "99999", "training ids")
    ids.write_text("pose_id\n1\n1\n")
    refused(check(*both), "1 stands twice", "ids.csv")
    refused(check("validation.train_ids=nowhere.csv", "validation.holdout=0"), "nowhere.csv", "no such file")
    refused(check(f"validation.train_ids={ids}"), "holdout", "train_ids")


@pytest.mark.parametrize("name", ["poses.mat", "poses.npz", "poses.npy", "poses.pkl"])
def test_binary_tables_are_refused_with_how_to_convert(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name.endswith("npz"):
        np.savez(path, q=np.zeros((3, 6)))
    elif name.endswith("npy"):
        np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    else:
        magic = b"MATLAB 7.3 MAT-file" if name.endswith("mat") else b"\x80\x04\x95"
        path.write_bytes(magic + bytes(range(256)) * 4)
    refused(check(data=path), name, "CSV")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("arms.arm.model.convention=denavit", ("convention", "standard", "craig")),
        ("arms.arm.model.convention=null", ("convention",)),
        ("arms.arm.model.type=mhd", ("mhd", "Did you mean 'mdh'")),
        ("arms.arm.model.rows.2.d_mn=3", ("d_mn", "did you mean d_m")),
        ("arms.arm.model.rows.2.d_mm=5 deg", ("5 deg", "length")),
        ("arms.arm.links.link2.frame=upperarm", ("upperarm", "upper_arm")),
        ("arms.arm.links.link3.loads_up_to_joint=9", ("found joint 9", "0 to 6")),
        ("arms.arm.effects.spring.joints=[q9]", ("q9", "q1, q2")),
        ("parameters.free=[arm.mdh.thetta*]", ("thetta", "arm.mdh.theta")),
        ("estimator.type=ipot", ("ipot", "ipopt")),
        ("estimator.hessian=newton", ("newton", "gauss-newton")),
        ("validation.holdout=1.5", ("holdout", "1.5")),
        ("validation.holdout=25", ("validation.holdout: found 25", "0.25 for a quarter")),
        ("validation.holdout=0.001", ("a share of 0.001 of 200 records is no record", "a quarter (0.25)")),
        ("validation.group_by=nowhere", ("found no column nowhere in the records", "group_by: NAME")),
        ("validation.folds=1", ("folds",)),
        ("measurements={}", ("found no measurement", "tip_position")),
        ("arms={}", ("there is no arm", "under arms")),
        ("arms.arm.model.rows=[]", ("found a list of 0 values, expected at least 1: add what is missing",)),
        ("measurements.tracker.arm=left", ("left", "arm")),
        ("simulation.poses.count=0", ("poses.count",)),
        ("nonsense", ("--set", "nonsense")),
    ],
)
def test_a_wrong_setting_is_refused_with_its_name_and_what_was_meant(setting: str, words: tuple[str, ...]) -> None:
    if setting.startswith("simulation"):
        result = CliRunner().invoke(cli, ["simulate", DEMO, "--out", "/dev/null/x.csv", "--set", setting])
    else:
        result = check(setting)
    refused(result, *words)


def test_a_path_in_a_file_may_not_leave_its_directory(tmp_path: Path) -> None:
    outside, inside = tmp_path / "outside.csv", tmp_path / "configs"
    outside.write_text((CONFIGS / "demo.csv").read_text())
    inside.mkdir()
    for name in ("arm.yaml", "option1.yaml"):
        (inside / name).write_text((CONFIGS / name).read_text())
    (inside / "link.csv").symlink_to(outside)
    mine = inside / "mine.yaml"
    for place in ("../outside.csv", str(outside), "link.csv"):
        mine.write_text(f"extends: option1.yaml\ndata: {{type: csv, path: {place}}}\n")
        refused(check(config=str(mine)), "mine.yaml:2, data.path", f"outside {inside}:", "by --data PATH")
    assert check(config=str(mine), data=outside).exit_code == 0
    mine.write_text("extends: ../outside.yaml\n")
    refused(check(config=str(mine)), "mine.yaml:1, extends", "Copy the file into")


@pytest.mark.slow
def test_two_hundred_damaged_configurations_never_end_in_a_traceback(tmp_path: Path) -> None:
    """Lines taken out, doubled, swapped and cut: a result or a refusal that names the file."""
    lines = (CONFIGS / "arm.yaml").read_text().splitlines()
    rng = random.Random(7)
    path = tmp_path / "arm.yaml"
    tail = ["data: {type: csv, path: demo.csv}", "parameters: {free: [arm.mdh.theta*]}"]
    (tmp_path / "demo.csv").write_text("\n".join((CONFIGS / "demo.csv").read_text().splitlines()[:40]))
    codes = set()
    for _ in range(200):
        damaged = list(lines)
        for _ in range(rng.randint(1, 3)):
            i, j = rng.randrange(len(damaged)), rng.randrange(len(damaged))
            what = rng.randrange(4)
            if what == 0:
                del damaged[i]
            elif what == 1:
                damaged.insert(j, damaged[i])
            elif what == 2:
                damaged[i], damaged[j] = damaged[j], damaged[i]
            else:
                damaged[i] = damaged[i][: rng.randrange(len(damaged[i]) + 1)]
        path.write_text("\n".join(damaged + tail) + "\n")
        result = check(config=str(path), data=None)
        codes.add(result.exit_code)
        assert result.exit_code in (0, 2), (result.output, result.exception)
        assert (
            result.exit_code == 0
            or "arm.yaml" in result.output
            or "demo.csv" in result.output
            or ("does not determine" in result.output)
        ), result.output
    assert codes == {0, 2}


def test_positions_in_a_far_frame_are_placed_where_the_base_is_free(tmp_path: Path) -> None:
    """Total stations count from where a survey began; the unit is right."""
    lines = [line.split(",") for line in (CONFIGS / "demo.csv").read_text().splitlines()]
    place = lines[0].index("x_mm")
    for line in lines[1:]:
        line[place] = repr(float(line[place]) + 35_000)
    data = tmp_path / "far.csv"
    data.write_text("\n".join(",".join(line) for line in lines) + "\n")
    assert check(data=data).exit_code == 0
    held = check("parameters.free=[arm.mdh.alpha*]", data=data)
    refused(held, "base elsewhere by 35000 mm")
