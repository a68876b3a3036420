"""``armcal lerobot``, as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.errors import ArmcalError, InputError
from armcal.plugins import discover
from armcal_lerobot.command import lerobot
from armcal_lerobot.gripper import Gripper, wiring_of
from armcal_lerobot.motors import Motor
from click.testing import CliRunner

from tests.plugins.lerobot.planted import episodes, motor_entries, write_dataset, write_motors

CONFIGS = Path(__file__).parents[3] / "configs" / "so101"
ARM = str(CONFIGS / "arm.yaml")


def called(*arguments: object) -> str:
    return CliRunner().invoke(lerobot, [str(a) for a in arguments], catch_exceptions=False).output


def json_of(*arguments: object) -> dict:
    result = CliRunner().invoke(lerobot, [*map(str, arguments), "--json"], catch_exceptions=False)
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import armcal

    out = tmp_path_factory.mktemp("run") / "run"
    armcal.Experiment.load(CONFIGS / "demo.yaml", ["validation.folds=0"]).run().write(out)
    return out / "calibration.yaml"


def test_what_a_wrong_zero_costs(tmp_path: Path) -> None:
    one = write_motors(tmp_path / "one.json")
    two = write_motors(tmp_path / "two.json", shoulder_pan={"homing_offset": -250 + 193})
    content = json_of("check", one, two, "--arm", ARM)
    pan = content["motors"]["shoulder_pan"]
    assert pan["zero_moved_deg"] == pytest.approx(193 * 360 / 4096) and pan["teeth"] == 0
    gripper = Gripper(Path(ARM), None, {}, discover())
    motors = {name: Motor(name, **entry) for name, entry in motor_entries().items()}
    radius = np.linalg.norm(gripper.positions(gripper.poses(motors))[:2], axis=0)
    assert pan["mm_per_deg"]["largest_mm"] == pytest.approx(1000 * np.radians(1) * radius.max(), rel=1e-3)
    chord = 2 * np.sin(np.radians(pan["zero_moved_deg"]) / 2)
    assert content["moved_mm"]["typical_mm"] == pytest.approx(1000 * chord * np.median(radius), rel=1e-3)
    assert "At the same command the gripper stands" in called("check", one, two, "--arm", ARM)


def test_servos_that_were_exchanged_between_the_files_are_named(tmp_path: Path) -> None:
    one, swapped = write_motors(tmp_path / "one.json"), {"shoulder_lift": {"id": 3}, "elbow_flex": {"id": 2}}
    two = write_motors(tmp_path / "two.json", **swapped)
    notes = json_of("check", one, two)["notes"]
    assert "shoulder_lift has the id 2 in one.json and 3 in two.json" in notes[0] and len(notes) == 2


def test_a_joint_without_a_motor_is_offered_the_nearest_that_is_free(tmp_path: Path) -> None:
    file = tmp_path / "one.json"
    entries = json.loads(write_motors(file).read_text())
    renamed = {name.replace("_", " "): entry for name, entry in entries.items()}
    file.write_text(json.dumps(renamed))
    with pytest.raises(InputError, match="--joint 'shoulder pan=shoulder_pan'"):
        called("check", file, "--arm", ARM)
    with pytest.raises(InputError, match="no motor called 'shoulder_pun' for the joint shoulder_pan"):
        called("check", write_motors(tmp_path / "two.json"), "--arm", ARM, "--joint", "shoulder_pun=shoulder_pan")
    file.write_text(json.dumps({name: entry for name, entry in entries.items() if name != "elbow_flex"}))
    with pytest.raises(InputError, match="None of them is without a joint"):
        called("check", file, "--arm", ARM)


@pytest.mark.slow
def test_a_range_in_percent_stretches_the_motion(tmp_path: Path) -> None:
    one = write_motors(tmp_path / "one.json")
    two = write_motors(tmp_path / "two.json", shoulder_pan={"range_min": 1010, "range_max": 3085})
    degrees, percent = (json_of("check", one, two, "--arm", ARM, "--units", u) for u in ("degrees", "percent"))
    assert degrees["moved_mm"]["largest_mm"] == pytest.approx(0, abs=1e-9)
    assert percent["moved_mm"]["largest_mm"] > 20


@pytest.mark.slow
def test_poses_of_a_data_set_count(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    one = write_motors(tmp_path / "one.json")
    data = write_dataset(tmp_path / "set", [(np.zeros((30, 6)), np.zeros((30, 6)))], "v3.0")
    content = json_of("check", one, "--arm", ARM, "--data", data)
    reach = 30 + 135 + 100  # the arm at zero
    assert content["motors"]["shoulder_pan"]["mm_per_deg"]["typical_mm"] == pytest.approx(np.radians(reach), rel=1e-3)


def test_sections_are_a_configuration(tmp_path: Path) -> None:
    one = write_motors(tmp_path / "one.json", elbow_flex={"range_min": 1000})
    text = called("joints", one, "--arm", ARM, "--joint", "elbow_flex=-elbow_flex")
    sections = yaml.safe_load(text)
    device = sections["bench"]["device"]
    assert discover().find("device", device.pop("type")).load().Settings.model_validate(device)
    joint = device["joints"]["arm.elbow_flex"]
    assert joint == {
        "id": 3,
        "model": "sts3215",
        "zero_count": 2092,
        "offset": -50,
        "direction": -1,
        "range_deg": [-96.0, 96.0],
    }
    assert sections["plan"]["limits"]["shoulder_pan"] == ["-100.0 deg", "100.0 deg"]
    for name in ("skeleton.yaml", "arm.yaml"):
        (tmp_path / name).write_bytes((CONFIGS / name).read_bytes())
    path, parameters = tmp_path / "plan.yaml", {**sections["parameters"], "free": ["arm.zeros.offset*"]}
    path.write_text("extends: arm.yaml\n" + yaml.safe_dump({"parameters": parameters, "plan": sections["plan"]}))
    import armcal

    assert armcal.Experiment.load(path).parameters["arm.zeros.offset3"].free


def test_motors_of_any_name_give_sections_that_load(tmp_path: Path) -> None:
    name = "[odd]: 'motor"
    (tmp_path / "one.json").write_text(json.dumps({name: motor_entries()["elbow_flex"]}))
    sections = yaml.safe_load(called("joints", tmp_path / "one.json"))
    assert list(sections["bench"]["device"]["joints"]) == [f"arm.{name}"] and list(sections["plan"]["limits"]) == [name]


def test_limits_of_the_arm_give_zeros_and_name_ranges_that_were_not_swept(tmp_path: Path) -> None:
    import re

    urdf = (CONFIGS.parent / "ball" / "arm7.urdf").read_text()
    joints = re.findall(r'<joint name="([^"]+)" type="revolute"', urdf)
    name = joints[0]
    limited = re.sub(r"<limit [^>]*/>", '<limit lower="-1.0" upper="1.4" effort="1" velocity="1"/>', urdf)
    (tmp_path / "arm.urdf").write_text(limited)
    tips = yaml.safe_load((CONFIGS.parent / "ball" / "demo.yaml").read_text())["arms"]["arm"]["model"].get("tip")
    model = {"type": "urdf", "path": "arm.urdf", **({"tip": tips} if tips else {})}
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump({"arms": {"arm": {"model": model}}}))
    swept = {"drive_mode": 0, "homing_offset": 0, "range_min": 2048 - 600, "range_max": 2048 + 600}  # 105 deg
    entries = {joint: {"id": i, **swept} for i, joint in enumerate(joints)}
    file = tmp_path / "one.json"
    file.write_text(json.dumps(entries))
    notes = " ".join(json_of("check", file, "--arm", tmp_path / "arm.yaml")["notes"])
    assert f"{name} has a range of 105 deg, and the joint {name} one of 138 deg" in notes and "off by 16 deg" in notes
    values = yaml.safe_load(called("joints", file, "--arm", tmp_path / "arm.yaml"))["parameters"]["values"]
    assert values["arm.zeros.offset1"] == "11.5 deg"


@pytest.mark.slow
def test_calibrated_zeros_go_back_into_the_file(tmp_path: Path, calibrated: Path) -> None:
    """The demo's true zeros are known: by the new file the joints stand within 0.5 deg of their commands."""
    path = write_motors(tmp_path / "arm.json")
    text = path.read_text()
    with pytest.raises(InputError, match="no terminal to ask"):
        called("zeros", calibrated, path)
    assert path.read_text() == text and len(list(tmp_path.iterdir())) == 1
    content = json_of("zeros", calibrated, path, "--yes")
    assert content["written"] and Path(content["before"]).read_text() == text
    truth = yaml.safe_load((CONFIGS / "arm_truth.yaml").read_text())
    before, after = json.loads(text), json.loads(path.read_text())
    for number, motor in enumerate(list(before)[:5], start=1):
        true = float(truth[f"arm.zeros.offset{number}"].split()[0])
        moved = (before[motor]["homing_offset"] - after[motor]["homing_offset"]) * 360 / 4095
        assert moved == pytest.approx(true, abs=0.5)
    assert after["gripper"] == before["gripper"]


def test_a_question_before_anything_is_written(
    tmp_path: Path, calibrated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_motors(tmp_path / "arm.json")
    text = path.read_text()
    monkeypatch.setattr("armcal_lerobot.command._agreed", lambda _: False)
    assert "nothing was written" in called("zeros", calibrated, path)
    assert path.read_text() == text


def test_a_data_set_is_compared(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    data = write_dataset(tmp_path / "set", episodes({}, count=3, frames=400))
    out = called("compare", data, "--arm", ARM, "--out", tmp_path / "page.html")
    assert "the gripper is off its command by" in out and "What one data set cannot show" in out
    assert (tmp_path / "page.html").read_text().startswith("<!DOCTYPE html>")
    content = json_of("compare", data, data)
    assert content["between"]["motors"]["elbow_flex"]["gain"]["value"] == 0
    with pytest.raises(InputError, match="found numbers in percent"):
        called("compare", data, "--arm", ARM, "--units", "percent")
    file = write_motors(tmp_path / "arm.json")
    percent = json_of("compare", data, "--arm", ARM, "--units", "percent", "--calibration", file)
    assert percent["sets"][0]["motors"]["elbow_flex"]["span"] == pytest.approx(
        content["sets"][0]["motors"]["elbow_flex"]["span"] * 1137.5 * 360 / 4095 / 100, rel=1e-6
    )


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["a"], "expected MOTOR=JOINT"),
        (["a=b", "a=c"], "twice"),
        (["a=b", "c=-b"], "twice"),
        (["a=-"], "expected MOTOR"),
    ],
)
def test_wiring_that_is_none_is_refused(texts: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        wiring_of(texts)


def test_options_without_an_arm_are_refused(tmp_path: Path) -> None:
    path = write_motors(tmp_path / "arm.json")
    for options in (["--data", tmp_path], ["--arm-name", "arm"], ["--joint", "a=b"]):
        with pytest.raises(InputError, match=r"without --arm\."):
            called("check", path, *options)
    pytest.importorskip("pyarrow")
    with pytest.raises(ArmcalError, match="expected a LeRobot data set"):
        called("compare", path)


def test_joints_without_a_motor_are_named(tmp_path: Path) -> None:
    path = write_motors(tmp_path / "arm.json")
    path.write_text(path.read_text().replace("wrist_roll", "roll"))
    with pytest.raises(ArmcalError, match=r"found no motor for the joint wrist_roll.*--joint roll=wrist_roll"):
        called("check", path, "--arm", ARM)
    assert "roll" in called("check", path, "--arm", ARM, "--joint", "roll=-wrist_roll")
    with pytest.raises(ArmcalError, match="found no joint 'q9'"):
        called("check", path, "--arm", ARM, "--joint", "roll=q9")


def test_zeros_are_written_once(tmp_path: Path, calibrated: Path) -> None:
    path = write_motors(tmp_path / "arm.json")
    called("zeros", calibrated, path, "--yes")
    text = path.read_text()
    with pytest.raises(InputError, match="it has these zeros already"):
        called("zeros", calibrated, path, "--yes")
    assert path.read_text() == text


def test_zeros_of_a_misspelt_joint_are_refused(tmp_path: Path, calibrated: Path) -> None:
    path = write_motors(tmp_path / "arm.json")
    with pytest.raises(InputError, match="no joint 'elbow'"):
        called("zeros", calibrated, path, "--joint", "elbow_flex=-elbow", "--yes")
    with pytest.raises(InputError, match="found shoulder_pan twice"):
        called("zeros", calibrated, path, "--joint", "shoulder_pan=elbow_flex", "--yes")
    with pytest.raises(InputError, match="found elbow_flex twice"):
        called("check", path, "--arm", ARM, "--joint", "elbow_flex=shoulder_pan")


def test_states_that_were_copied_from_commands_are_named(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    made = episodes({}, count=2, frames=200)
    same = write_dataset(tmp_path / "same", [(state, state) for _, state in made])
    assert "Every state is the command of the same frame" in called("compare", same)
    late = write_dataset(tmp_path / "late", [(np.r_[state[1:], state[-1:]], state) for _, state in made])
    assert "Every state is the command of the frame before" in called("compare", late)
    assert "Every state" not in called("compare", write_dataset(tmp_path / "set", made))
