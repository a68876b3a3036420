"""``armcal lerobot``, as a user calls it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.errors import ArmcalError, DataError, InputError
from armcal.plugins import discover
from armcal_lerobot.command import lerobot
from armcal_lerobot.motor_files import Gripper, Motor, wiring_of
from click.testing import CliRunner

from tests.plugins.lerobot.planted import motor_entries, write_motors

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
    gripper = Gripper(Path(ARM), None, list(motor_entries()), [], discover())
    motors = {name: Motor(name, **entry) for name, entry in motor_entries().items()}
    radius = np.linalg.norm(gripper.positions(gripper.poses(motors))[:2], axis=0)
    assert pan["mm_per_deg"]["largest_mm"] == pytest.approx(1000 * np.radians(1) * radius.max(), rel=1e-3)
    chord = 2 * np.sin(np.radians(pan["zero_moved_deg"]) / 2)
    assert content["moved_mm"]["typical_mm"] == pytest.approx(1000 * chord * np.median(radius), rel=1e-3)
    assert "At the same command the gripper stands" in called("check", one, two, "--arm", ARM)


def test_servos_that_were_exchanged_between_the_files_are_named(tmp_path: Path) -> None:
    one, swapped = write_motors(tmp_path / "one.json"), {"shoulder_lift": {"id": 3}, "elbow_flex": {"id": 2}}
    notes = json_of("check", one, write_motors(tmp_path / "two.json", **swapped))["notes"]
    assert "shoulder_lift has the id 2 in one.json, 3 in two.json" in notes[0] and len(notes) == 2


def test_a_joint_without_a_motor_is_named_with_the_motors_that_turn_none(tmp_path: Path) -> None:
    file = tmp_path / "one.json"
    entries = json.loads(write_motors(file).read_text())
    renamed = {name.replace("_", " "): entry for name, entry in entries.items()}
    file.write_text(json.dumps(renamed))
    with pytest.raises(InputError, match=r"no motor for the joint shoulder_pan; motors without a joint: shoulder pan,"):
        called("check", file, "--arm", ARM)
    with pytest.raises(InputError, match=r"found --joint 'shoulder_pun=shoulder_pan', .*The motors are shoulder_pan,"):
        called("check", write_motors(tmp_path / "two.json"), "--arm", ARM, "--joint", "shoulder_pun=shoulder_pan")
    file.write_text(json.dumps({name: entry for name, entry in entries.items() if name != "elbow_flex"}))
    with pytest.raises(InputError, match="motors without a joint: none"):
        called("check", file, "--arm", ARM)


@pytest.mark.slow
def test_a_range_in_percent_stretches_the_motion(tmp_path: Path) -> None:
    one = write_motors(tmp_path / "one.json")
    two = write_motors(tmp_path / "two.json", shoulder_pan={"range_min": 1010, "range_max": 3085})
    degrees, percent = (json_of("check", one, two, "--arm", ARM, "--units", u) for u in ("degrees", "percent"))
    assert degrees["moved_mm"]["largest_mm"] == pytest.approx(0, abs=1e-9)
    assert percent["moved_mm"]["largest_mm"] > 20


def test_sections_are_a_configuration(tmp_path: Path) -> None:
    one = write_motors(tmp_path / "one.json", elbow_flex={"range_min": 1000})
    text = called("joints", one, "--arm", ARM, "--joint", "elbow_flex=-elbow_flex")
    sections = yaml.safe_load(text)
    device, planned = sections["bench"]["device"], sections["plan"]["limits_deg"]
    assert all(
        own["range_deg"][0]
        <= planned[name.partition(".")[2]][0]
        < planned[name.partition(".")[2]][1]
        <= own["range_deg"][1]
        for name, own in device["joints"].items()
    )  # acquire takes what plan gives
    assert discover().find("device", device.pop("type")).load().Settings.model_validate(device)
    assert device["joints"]["arm.elbow_flex"] == {
        "id": 3,
        "model": "sts3215",
        "zero_count": 2092,
        "offset": -50,
        "direction": -1,
        "range_deg": [-96.0, 95.9],
    }


def test_motors_of_any_name_give_sections_that_load(tmp_path: Path) -> None:
    name = "[odd]: 'motor"
    (tmp_path / "one.json").write_text(json.dumps({name: motor_entries()["elbow_flex"]}))
    device = yaml.safe_load(called("joints", tmp_path / "one.json"))["bench"]["device"]
    assert list(device["joints"]) == [f"arm.{name}"]


def test_ranges_that_were_not_swept_are_named_by_the_limits_of_the_arm(tmp_path: Path) -> None:
    config, joints = limited_arm(tmp_path, -1.0, 1.4)
    file, name = swept(tmp_path, joints, 2048 - 600, 2048 + 600), joints[0]  # 105 deg
    notes = " ".join(json_of("check", file, "--arm", config)["notes"])
    assert f"{name} has a range of 105 deg, and its joint one of 138 deg" in notes and "off by 16 deg" in notes


def limited_arm(folder: Path, lower: float, upper: float, kind: str = "revolute") -> tuple[Path, list[str]]:
    """The shipped arm of seven joints, all with these limits (rad)."""
    urdf = (CONFIGS.parent / "ball" / "arm7.urdf").read_text()
    joints = re.findall(r'<joint name="([^"]+)" type="revolute"', urdf)
    limits = f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'
    text = re.sub(r"<limit [^>]*/>", limits if kind == "revolute" else "", urdf).replace('"revolute"', f'"{kind}"')
    (folder / "arm.urdf").write_text(text)
    tip = yaml.safe_load((CONFIGS.parent / "ball" / "demo.yaml").read_text())["arms"]["arm"]["model"].get("tip")
    model = {"type": "urdf", "path": "arm.urdf", **({"tip": tip} if tip else {})}
    (folder / "arm.yaml").write_text(yaml.safe_dump({"arms": {"arm": {"model": model}}}))
    return folder / "arm.yaml", joints


def swept(folder: Path, joints: list[str], low: int, high: int) -> Path:
    """A file in which all motors have this range."""
    entry = {"drive_mode": 0, "homing_offset": 7, "range_min": low, "range_max": high}
    path = folder / "one.json"
    path.write_text(json.dumps({joint: {"id": i, **entry} for i, joint in enumerate(joints)}))
    return path


@pytest.mark.parametrize("ends", [(3, 4093), (0, 4095), (3, 3301), (812, 4090), (60, 3600)])
@pytest.mark.parametrize("motor", ["shoulder_pan", "elbow_flex"])
def test_a_range_of_which_the_encoder_passed_its_end_is_named_and_never_driven(
    tmp_path: Path, motor: str, ends: tuple[int, int]
) -> None:
    file = write_motors(tmp_path / "one.json", **{motor: dict(zip(("range_min", "range_max"), ends, strict=True))})
    notes = " ".join(json_of("check", file)["notes"])
    assert f"{motor} has a range of" in notes and "passed its end" in notes and "lerobot-calibrate again" in notes
    assert ("Dynamixel" in notes) == (ends == (0, 4095))
    with pytest.raises(DataError, match=rf"{motor} has a range of .*passed its end"):
        called("joints", file)


def test_sound_ranges_are_not_named(tmp_path: Path) -> None:
    """Of 200 files homed within 20 deg of the middle, with ranges up to 40 deg longer than the model's, none."""
    random = np.random.default_rng(0)
    for _ in range(200):
        middle, half = 2047 + random.uniform(-20, 20) * 4096 / 360, random.uniform(45, 120) * 4096 / 360
        motor = Motor("q", 1, 0, 0, round(middle - half), round(middle + half))
        assert not motor.passed_end(None) and not motor.passed_end(motor.range_deg - 40)
    config, joints = limited_arm(tmp_path, -1.5, 1.5)
    file = swept(tmp_path, joints, 800, 3300)
    assert not json_of("check", file, "--arm", config)["notes"]
    device = yaml.safe_load(called("joints", file, "--arm", config))["bench"]["device"]
    assert device["joints"][f"arm.{joints[0]}"]["range_deg"] == [-109.8, 109.8]
    limits = yaml.safe_load(called("joints", file, "--arm", config))["plan"]["limits_deg"]
    assert limits[joints[0]] == [-85.9, 85.9]  # the model's, 1.5 rad


def test_a_whole_turn_is_sound_where_the_joint_turns_freely(tmp_path: Path) -> None:
    config, joints = limited_arm(tmp_path, 0, 0, "continuous")
    file = swept(tmp_path, joints, 0, 4095)
    assert not json_of("check", file, "--arm", config)["notes"]
    device = yaml.safe_load(called("joints", file, "--arm", config))["bench"]["device"]
    chosen = discover().find("device", device.pop("type")).load().Settings.model_validate(device)
    for joint in chosen.chosen(joints).values():
        joint.require_drivable()
    assert not json_of("check", write_motors(tmp_path / "two.json"))["notes"]  # its wrist_roll is a whole turn


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
    monkeypatch.setattr("armcal_lerobot.command._is_agreed", lambda _: False)
    assert "nothing was written" in called("zeros", calibrated, path)
    assert path.read_text() == text


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["a"], "expected MOTOR=JOINT"),
        (["a=b", "a=c"], "found a twice"),
        (["a=b", "c=-b"], "found b twice"),
        (["a=-"], "expected MOTOR"),
    ],
)
def test_wiring_that_is_none_is_refused(texts: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        wiring_of(["b", "c"], ["a", "c"], texts)


def test_a_joint_that_keeps_its_zero_needs_no_motor() -> None:
    assert wiring_of(["b"], ["a"], ["a=-b"], idle=["c"])["b"] == ("a", -1)
    with pytest.raises(InputError, match="no motor for the joint c"):
        wiring_of(["b", "c"], ["a"], ["a=-b"])


def test_options_without_an_arm_are_refused(tmp_path: Path) -> None:
    path = write_motors(tmp_path / "arm.json")
    for options in (["--arm-name", "arm"], ["--joint", "a=b"]):
        with pytest.raises(InputError, match=r"without --arm\."):
            called("check", path, *options)
    pytest.importorskip("pyarrow")
    with pytest.raises(ArmcalError, match=r"meta/info\.json: there is no such file"):
        called("rests", path.parent, "--out", path.parent / "rests.csv")


def test_joints_without_a_motor_are_named(tmp_path: Path) -> None:
    path = write_motors(tmp_path / "arm.json")
    path.write_text(path.read_text().replace("wrist_roll", "roll"))
    with pytest.raises(ArmcalError, match=r"found no motor for the joint wrist_roll.*without a joint: roll\."):
        called("check", path, "--arm", ARM)
    assert "roll" in called("check", path, "--arm", ARM, "--joint", "roll=-wrist_roll")
    with pytest.raises(ArmcalError, match="found --joint 'roll=q9'"):
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
    with pytest.raises(InputError, match="found --joint 'elbow_flex=-elbow'"):
        called("zeros", calibrated, path, "--joint", "elbow_flex=-elbow", "--yes")
    with pytest.raises(InputError, match="found shoulder_pan twice"):
        called("zeros", calibrated, path, "--joint", "shoulder_pan=elbow_flex", "--yes")
    with pytest.raises(InputError, match="found elbow_flex twice"):
        called("check", path, "--arm", ARM, "--joint", "elbow_flex=shoulder_pan")
