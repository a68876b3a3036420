"""``armcal bus`` on servos at the far end of a pty: find, check, home."""

from __future__ import annotations

import json
import math
from pathlib import Path

import armcal
import pytest
import yaml
from armcal.cli.main import cli
from armcal.config.yaml_source import load_config
from armcal.devices.wiring import WiringRecord
from armcal.errors import InputError
from armcal_servobus.command import planned
from armcal_servobus.device import ServoJointsSettings, Servos
from click.testing import CliRunner, Result

from tests.plugins.servobus.fake_bus import FakeBus, sts
from tests.plugins.servobus.test_device_on_simulated_bus import PtyDesk
from tests.plugins.servobus.test_servobus_device import word

CONFIGS = Path(__file__).resolve().parents[3] / "configs"


def written(folder: Path, path: str, model: str = "sts3215", **changes: object) -> Path:
    servo = {"model": model, "range_deg": [-100, 100]}
    joints = {"q1": {"id": 1, **servo}, "q2": {"id": 2, "direction": -1, **servo}}
    device = {"type": "servobus", "port": path, "reply_ms": 20, "joints": joints, **changes}
    config = folder / "bench.yaml"
    config.write_text(yaml.safe_dump({"bench": {"device": device}}))
    return config


def called(*words: object, stdin: str = "") -> Result:
    return CliRunner().invoke(cli, ["bus", *map(str, words)], input=stdin)


def refusal(ran: Result) -> str:
    assert ran.exit_code == 2 and "Traceback" not in ran.output, ran.output
    return " ".join(ran.output.split())


def test_find_lists_the_servos():
    with FakeBus([sts(1, 10), sts(3, 30), sts(3, 900)]) as fake:
        words = ("find", fake.path, "--protocol", "feetech", "--baud", 1000000, "--last-id", 4)
        servos = json.loads(called(*words, "--json").stdout)["servos"]
        assert [(s["id"], s["model"], s["doubled"]) for s in servos] == [(1, "sts3215", False), (3, "sts3215", True)]
        assert servos[0] | {"baud": 1000000, "position": 10, "voltage_V": 12.1, "firmware": "3.10"} == servos[0]
        shown = called(*words)
        assert "two servos" in shown.output and "id 3" in shown.output


@pytest.mark.slow
def test_a_servo_of_an_unknown_model_is_found_and_can_be_driven_as_its_kin(tmp_path):
    with FakeBus([sts(1, **word(3, 0x0A0B)), sts(2)]) as fake:
        fake.servos.pop()
        ran = called("find", fake.path, "--baud", 1000000, "--last-id", 2, "--json")
        content = json.loads(ran.stdout)
        assert (content["protocol"], content["servos"][0]["model_number"]) == ("feetech", 0x0A0B)
        fake.servos.append(sts(2))
        config = written(tmp_path, fake.path)
        assert "a model of number 2571, expected sts3215" in refusal(called("check", config))
        assert called("check", written(tmp_path, fake.path, "sts")).exit_code == 0


def test_find_says_plainly_what_is_wrong(tmp_path):
    with FakeBus([]) as fake:
        words = ("find", fake.path, "--protocol", "feetech", "--baud", 1000000, "--last-id", 1)
        assert "no servo answers at these baud rates, ids 0 to 1" in refusal(called(*words))
    assert "no such serial port" in refusal(called("find", tmp_path / "ttyUSB7"))


@pytest.mark.slow
def test_check_shows_the_joints_and_names_mistakes(tmp_path):
    with FakeBus([sts(1, 2148, **word(31, 0x800 | 5)), sts(2)]) as fake:
        config = written(tmp_path, fake.path)
        content = json.loads(called("check", config, "--json").stdout)
        assert content["mistakes"] == []
        assert content["joints"][0] | {"angle_deg": 8.79, "offset": -5, "torque": False} == content["joints"][0]
        fake.servos[1].memory[33] = 1
        ran = called("check", config)
        assert ran.exit_code == 2 and "q2 (id 2) is in operating mode 1" in ran.output
        fake.servos.pop()
        assert "q2 (id 2) does not answer" in called("check", config).output


@pytest.mark.quick("xl430-w250")
@pytest.mark.parametrize("model", ["sts3215", "xl430-w250", "xl330-m288"])
def test_home_sets_offsets_and_restores_them(tmp_path, model):
    """On the simulated servos: what they report afterwards is what was stated, and the old values come back."""
    desk = PtyDesk(model)
    try:
        protocol = desk.servos[0].table.protocol
        config = written(tmp_path, desk.path, model, protocol=protocol)
        desk.servos[0].motor.shaft = desk.servos[0].motor.target = 0.2
        desk.servos[1].motor.shaft = desk.servos[1].motor.target = -0.1
        ran = called("home", config, "--at", "q1=0", "--at", "q2=30", "--yes", "--json")
        offsets = json.loads(ran.stdout)["offsets"]
        assert offsets["q1"]["change_deg"] == pytest.approx(-math.degrees(0.2), abs=0.1)
        rows = json.loads(called("check", config, "--json").stdout)["joints"]
        assert [row["angle_deg"] for row in rows] == pytest.approx([0.0, 30.0], abs=0.1)
        assert desk.servos[0].get("homing_offset") == offsets["q1"]["after"] != 0
        desk.bus.boot()
        assert desk.servos[0].get("homing_offset") == offsets["q1"]["after"], "it is in the EEPROM"
        before = [f"--offset={joint}={changed['before']}" for joint, changed in offsets.items()]
        again = called("home", config, *before, "--yes")
        assert again.exit_code == 0, again.output
        assert [servo.get("homing_offset") for servo in desk.servos] == [0, 0]
    finally:
        desk.close()


def test_home_asks_and_writes_nothing_unasked(tmp_path):
    with FakeBus([sts(1, 2000), sts(2)]) as fake:
        config = written(tmp_path, fake.path)
        assert "no terminal to ask at" in refusal(called("home", config))
        assert "JOINT=DEG" in refusal(called("home", config, "--at", "q1=x", "--yes"))
        assert "JOINT=COUNTS" in refusal(called("home", config, "--offset", "q1=1.5", "--yes"))
        assert "found no joint q9" in refusal(called("home", config, "--at", "q9=0", "--yes"))
        fake.servos[0].memory[40] = 1
        assert "q1 hold, expected servos without torque" in refusal(called("home", config, "--yes"))
        assert not [i for i in fake.instructions if i[1] in (3, 0x83)]


def servos_of(fake: FakeBus, model: str = "sts3215"):
    servo = {"model": model, "range_deg": [-100, 100]}
    joints = {"q1": {"id": 1, **servo}, "q2": {"id": 2, "direction": -1, **servo}}
    settings = ServoJointsSettings.model_validate({"port": fake.path, "joints": joints})
    servos = Servos(settings, joints)
    servos.bus.open()
    return servos


def test_offsets_at_the_ends_of_the_register(tmp_path):
    """Half a turn off is the one offset that an STS3215 cannot hold: -2048."""
    with FakeBus([sts(1, 0), sts(2)]) as fake:
        ran = called("home", written(tmp_path, fake.path), "--yes")
        assert "remount it by 1 tooth of its horn (14.4 deg each)" in refusal(ran)
        assert not [i for i in fake.instructions if i[1] in (3, 0x83)]
        for count, offset in ((1, -2047), (4095, 2047), (2049, 1)):
            fake.servos[0].memory[56:58] = count.to_bytes(2, "little")
            servos = servos_of(fake)
            assert planned(servos, {}, {}, {})[0].after == offset
            servos.bus.close()


def test_what_was_checked_lasts_until_offsets_are_written(tmp_path):
    with FakeBus([sts(1), sts(2)]) as fake:
        config = written(tmp_path, fake.path)
        source = load_config(config)
        checks = WiringRecord.of_config(source, ("arm.q1", "arm.q2"))
        with pytest.raises(InputError, match="never checked"):
            checks.check(("arm.q1",))
        checks.note(("q1", "q2"), (), {"adapter": "", "by": "tracker", "at": 0.0})
        checks.check(("arm.q1", "q2"))
        with pytest.raises(InputError, match="an adapter without an id"):
            checks.check(("q1",), "A1B2")
        ran = called("home", config, "--at", "q1=0", "--yes")
        assert ran.exit_code == 0, ran.output
        checks.check(("q2",))
        with pytest.raises(InputError, match=r"\(q1: never checked\)"):
            checks.check(("q1", "q2"))


def test_a_configuration_without_a_servo_bus_is_refused(tmp_path):
    config = tmp_path / "bench.yaml"
    config.write_text("bench: {device: {type: pca9685}}\n")
    assert "found no servo bus" in refusal(called("check", config))
    config.write_text("bench: {device: {type: servobus, port: tty, joints: {q1: {id: 1, model: sts3215}}}}\n")
    assert "range" in refusal(called("check", config))


@pytest.mark.slow
def test_calibrated_zeros_go_into_the_servos(tmp_path):
    """Afterwards each servo reports the angle at which its joint truly stands."""
    true = {"shoulder_pan": 4.4, "shoulder_lift": 6.2, "elbow_flex": -4.7, "wrist_flex": 5.6, "wrist_roll": -7.3}
    armcal.Experiment.load(CONFIGS / "so101" / "demo.yaml", ["validation.folds=0"]).run().write(tmp_path / "run")
    desk = PtyDesk("sts3215", 5)
    directions = dict(zip(true, (1, -1, 1, -1, 1), strict=True))
    servo = {"model": "sts3215", "range_deg": [-100, 100]}
    joints = {n: {"id": i, "direction": directions[n], **servo} for i, n in enumerate(true, start=1)}
    try:
        config = written(tmp_path, desk.path, joints=joints)
        before = json.loads(called("check", config, "--json").stdout)["joints"]
        zeros = ("home", config, "--calibration", tmp_path / "run" / "calibration.yaml", "--yes")
        assert "no arm is called 'left'. The arms are arm." in refusal(called(*zeros, "--arm-name", "left"))
        ran = called(*zeros)
        assert ran.exit_code == 0 and "set them to 0" in ran.output, ran.output
        after = json.loads(called("check", config, "--json").stdout)["joints"]
    finally:
        desk.close()
    moved = {a["joint"]: b["angle_deg"] - a["angle_deg"] for a, b in zip(before, after, strict=True)}
    assert moved == pytest.approx(true, abs=0.3)
