"""A calibration.yaml that was damaged, edited, or is used with other physics than it was made with."""

from __future__ import annotations

import json
import random
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import dump, read_record, sealed
from armcal.cli.main import cli
from armcal.config.yaml_source import load_config
from armcal.errors import ArmcalError, CalibrationWarning, ConfigError
from armcal.plugins import PluginRegistry, discover
from armcal_joints.effects import TorsionalSprings
from click.testing import CliRunner, Result
from soak import shares

ROOT = Path(__file__).resolve().parents[2]
DEMO = str(ROOT / "configs" / "lrm_arm" / "demo.yaml")
POSES = str(ROOT / "configs" / "lrm_arm" / "demo.csv")
FAST = ("--set", "validation.folds=0", "--set", "evaluator=interpreted")


def armcal(*arguments: str) -> Result:
    return CliRunner().invoke(cli, list(arguments))


@pytest.fixture(scope="module")
def calibration(demo_calibration: Path) -> Path:
    return demo_calibration


def predicted(path: Path) -> Result:
    return armcal("predict", str(path), "--poses", POSES, "--out", str(path.with_suffix(".csv")))


def recalibrate(path: Path, out: Path) -> tuple[str, ...]:
    """The command that follows a few records without a compiler."""
    few = out.with_name("few.csv")
    few.write_text("".join(Path(POSES).read_text().splitlines(keepends=True)[:12]))
    settings = out.with_name("settings.yaml")
    settings.write_text("evaluator: interpreted\n")
    return ("recalibrate", str(path), "--from", str(few), "--config", str(settings), "--out", str(out))


def digit_changed(text: str, name: str) -> str:
    """Another first decimal in the value of a parameter."""
    pattern = re.compile(rf"(name: {re.escape(name)}\n(?:  .*\n)*?  value: -?\d\.)(\d)")
    changed, count = pattern.subn(lambda m: f"{m[1]}{(int(m[2]) + 1) % 10}", text, count=1)
    assert count == 1
    return changed


def free_names(path: Path) -> list[str]:
    return [entry["name"] for entry in yaml.safe_load(path.read_text())["parameters"] if entry["free"]]


@pytest.mark.parametrize("every", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_one_digit_of_any_calibrated_value_is_refused_by_what_uses_it(
    calibration: Path, tmp_path: Path, every: int
) -> None:
    text = calibration.read_text()
    names = free_names(calibration)
    assert len(names) == 28
    for name in names[::every]:
        changed = digit_changed(text, name)
        path = tmp_path / "changed.yaml"
        path.write_text(changed)
        with pytest.raises(ConfigError, match=r"it was edited or damaged.*calibration accept"):
            Calibration.load(path)
        assert path.read_text() == changed
    out = str(tmp_path / "out.urdf")
    for command in (
        ("predict", str(path), "--poses", POSES, "--out", out),
        ("export", str(path), "--format", "urdf", "--out", out),
        ("compensate", str(path), "--targets", str(ROOT / "configs/lrm_arm/targets.csv"), "--out", out),
        recalibrate(path, tmp_path / "kept"),
        ("serve", str(path)),
    ):
        result = armcal(*command)
        assert result.exit_code == 2 and "edited or damaged" in result.output, command
    assert not Path(out).exists()


def damaged(data: bytes, dice: random.Random) -> bytes:
    """One byte, or one digit, of a file is another one, gone, or there twice."""
    kind = dice.choice(("byte", "digit", "gone", "twice"))
    digits = [m.start() for m in re.finditer(rb"\d", data)]
    place = dice.choice(digits) if kind == "digit" else dice.randrange(len(data))
    new = {
        "byte": bytes([data[place] ^ (1 << dice.randrange(8))]),
        "digit": str((int(chr(data[place])) + dice.randint(1, 9)) % 10 if kind == "digit" else 0).encode(),
        "gone": b"",
        "twice": data[place : place + 1] * 2,
    }[kind]
    return data[:place] + new + data[place + 1 :]


@pytest.mark.parametrize("seeds", shares(0, 6000, 2))
def test_no_damage_of_one_byte_is_taken_or_ends_in_a_traceback(calibration: Path, tmp_path: Path, seeds: range) -> None:
    data, path, registry = calibration.read_bytes(), tmp_path / "damaged.yaml", discover()
    dice = random.Random(seeds.start)
    for number in seeds:
        changed = damaged(data, dice)
        if changed == data:
            continue
        path.write_bytes(changed)
        try:
            Calibration.load(path, registry)
        except ArmcalError as fault:
            assert fault.exit_code == 2 and fault.hint and fault.where is not None, (number, str(fault))
        else:
            pytest.fail(f"damage {number} was taken: {set(changed.splitlines()) - set(data.splitlines())}")
    assert predicted(path).exit_code == 2


@pytest.mark.parametrize("seeds", shares(0, 200, 4))
def test_what_is_accepted_by_hand_is_used_or_refused_without_a_traceback(
    calibration: Path, tmp_path: Path, seeds: range
) -> None:
    """Whoever accepts a damaged file gets a calibration that works, or a sentence."""
    data, dice, path, taken = calibration.read_bytes(), random.Random(seeds.start), tmp_path / "damaged.yaml", 0
    for number in seeds:
        path.write_bytes(damaged(data, dice))
        done = armcal("calibration", "accept", str(path))
        assert done.exit_code in (0, 2) and not isinstance(done.exception, Exception), (number, done.exception)
        if done.exit_code == 0:
            taken += 1
            used = predicted(path)
            assert used.exit_code in (0, 2), (number, used.exception)
            assert not isinstance(used.exception, Exception), (number, used.exception)
    assert 0 < taken < len(seeds)


@pytest.mark.slow
def test_an_edit_on_purpose_is_checked_noted_and_said_until_the_next_run(calibration: Path, tmp_path: Path) -> None:
    content = yaml.safe_load(calibration.read_text())
    entry = next(entry for entry in content["parameters"] if entry["name"] == "arm.mdh.base_z")
    entry["value"] = entry["lower"] + 0.9 * (entry["upper"] - entry["lower"])
    path = tmp_path / "edited.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    assert predicted(path).exit_code == 2
    done = armcal("calibration", "accept", str(path))
    assert done.exit_code == 0 and "tools at its check poses moved by up to 0." in done.output
    used = predicted(path)
    assert used.exit_code == 0 and used.stderr.count("edited by hand and accepted on") == 1
    again = yaml.safe_load(path.read_text())
    assert next(e for e in again["parameters"] if e["name"] == "arm.mdh.base_z")["value"] == entry["value"]
    kept = tmp_path / "kept"
    followed = armcal(*recalibrate(path, kept), "-q")
    assert followed.exit_code == 0, followed.output
    assert "edited by hand" in predicted(kept / "calibration.yaml").stderr


@pytest.mark.slow
def test_a_server_says_that_its_calibration_was_edited(calibration: Path, tmp_path: Path) -> None:
    path = tmp_path / "edited.yaml"
    path.write_text(calibration.read_text().rpartition("#")[0])
    assert armcal("calibration", "accept", str(path)).exit_code == 0
    command = [sys.executable, "-m", "armcal.cli", "serve", str(path), "--evaluator", "interpreted"]
    asked = b'{"do": "forward", "joint_angles_deg": [10, -20, 30, 40, -50, 60]}\n'
    done = subprocess.run([*command, "-q"], input=asked, capture_output=True, timeout=120, check=False)
    assert done.returncode == 0 and json.loads(done.stdout)["ok"]
    assert done.stderr.decode().count("edited by hand and accepted on") == 1


@pytest.mark.slow
def test_what_no_run_could_have_written_is_not_accepted(calibration: Path, tmp_path: Path) -> None:
    path = tmp_path / "edited.yaml"
    original = calibration.read_text()
    for change, sentence in (
        (lambda e: e.update(value=e["upper"] + 0.001), "its own lower and upper"),
        (lambda e: e.update(free=False, value=e["value"] + 0.001), "Write the same number for nominal and value"),
    ):
        content = yaml.safe_load(original)
        change(next(entry for entry in content["parameters"] if entry["name"] == "arm.mdh.base_z"))
        path.write_text(sealed(content))
        before = path.read_bytes()
        done = armcal("calibration", "accept", str(path))
        assert done.exit_code == 2 and sentence in done.output, done.output
        assert re.search(r"edited\.yaml:\d+", done.output) and path.read_bytes() == before
    path.write_text(original)
    done = armcal("calibration", "accept", str(path))
    assert done.exit_code == 0 and "nothing to accept" in done.output and path.read_text() == original


@pytest.mark.slow
def test_line_ends_of_another_system_are_no_damage(calibration: Path, tmp_path: Path) -> None:
    path = tmp_path / "windows.yaml"
    path.write_bytes(calibration.read_bytes().replace(b"\n", b"\r\n"))
    assert predicted(path).exit_code == 0


@pytest.fixture
def upgraded(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Every plugin in its next version."""
    now = discover()
    later = replace(now, plugins=tuple(replace(p, version="99.1") for p in now.plugins))

    def install() -> None:
        monkeypatch.setattr("armcal.cli.common.discover", lambda: later)
        monkeypatch.setattr("armcal.calibration.calibration.discover", lambda: later)

    yield install


def softer(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    """Springs that give more under the same torque: what a plugin's next version might have."""
    before = TorsionalSprings.spring
    monkeypatch.setattr(
        TorsionalSprings, "spring", lambda self, site, compliance: before(self, site, factor * compliance)
    )


def test_the_calibration_names_the_plugins_that_it_is_made_of(calibration: Path) -> None:
    kept = yaml.safe_load(calibration.read_text())["components"]
    assert {(c["kind"], c["name"]) for c in kept} >= {
        ("core", "arm"),
        ("model", "mdh"),
        ("effect", "torsional_spring"),
        ("measurement", "tip_position"),
    }
    assert all(c["distribution"] and c["version"] and len(c["source"]) == 16 for c in kept)


@pytest.mark.slow
def test_other_versions_whose_predictions_agree_are_said_once(
    calibration: Path, upgraded: Callable[[], None], tmp_path: Path
) -> None:
    assert "warning" not in predicted(calibration).stderr
    upgraded()
    out = str(tmp_path / "arm.json")
    for used in (
        predicted(calibration),
        armcal("export", str(calibration), "--format", "json", "--out", out),
        armcal(*recalibrate(calibration, tmp_path / "kept")),
    ):
        assert used.exit_code == 0, used.output
        said = [line for line in used.stderr.splitlines() if "99.1" in line]
        assert len(said) == 1 and "predictions at its 8 check poses agree" in said[0], used.stderr
    with pytest.warns(CalibrationWarning, match="now armcal 99.1"):
        Calibration.load(calibration)


@pytest.mark.slow
def test_other_physics_under_the_calibrated_values_is_refused_by_every_command(
    calibration: Path, upgraded: Callable[[], None], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Predictions that moved by millimetres beside a stated 0.9 mm went without a word."""
    commands = np.deg2rad([[10, -20, 30, 40, -50, 60]])
    before = Calibration.load(calibration).forward(commands)
    upgraded()
    softer(monkeypatch, 2.0)
    out = str(tmp_path / "out")
    for command in (
        ("predict", str(calibration), "--poses", POSES, "--out", out),
        ("export", str(calibration), "--format", "urdf", "--out", out),
        ("compensate", str(calibration), "--targets", str(ROOT / "configs/lrm_arm/targets.csv"), "--out", out),
        recalibrate(calibration, tmp_path / "kept"),
    ):
        refused = armcal(*command)
        assert refused.exit_code == 2, (command, refused.output)
        for words in ("the physics is another", "mm", "now armcal 99.1", "calibration accept"):
            assert words in refused.output, (command, refused.output)
    assert not Path(out).exists()
    copy = tmp_path / "copy.yaml"
    copy.write_bytes(calibration.read_bytes())
    done = armcal("calibration", "accept", str(copy))
    assert done.exit_code == 0, done.output
    assert "made with other versions and accepted" in predicted(copy).stderr
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        after = Calibration.load(copy).forward(commands)
    assert np.linalg.norm(after[0, :3, 3] - before[0, :3, 3]) > 1e-3


def test_a_change_far_below_the_stated_accuracy_is_no_other_physics(
    calibration: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    softer(monkeypatch, 1 + 1e-5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Calibration.load(calibration)


def test_a_source_that_was_changed_under_the_same_version_is_named(calibration: Path) -> None:
    registry: PluginRegistry = discover()
    content = yaml.safe_load(calibration.read_text())
    for component in content["components"]:
        if component["name"] == "mdh":
            component["source"] = "0" * 16
    path = calibration.with_name("other_source.yaml")
    path.write_text(sealed(content))
    with pytest.warns(CalibrationWarning, match="the model mdh of armcal .* with another source"):
        Calibration.load(path, registry)


@pytest.mark.slow
def test_a_calibration_of_many_free_parameters_is_read(tmp_path: Path) -> None:
    """Covariance and information of 200 free parameters, such as many sockets bring: more than a mebibyte."""
    square = np.random.default_rng(1).normal(size=(200, 200))
    covariance = [row[: i + 1] for i, row in enumerate(square.tolist())]
    information = {"square_root": square.tolist()}
    path = tmp_path / "calibration.yaml"
    path.write_text(sealed({"armcal_calibration": 1, "prediction": covariance, "information": information}))
    assert path.stat().st_size > 1 << 20
    source, whole = read_record(path)
    assert whole and source.data["information"] == information


@pytest.mark.parametrize("text", ["78850542e9104225", "1e5", "-.inf", "1_000", "017", "0o17", "12:30", "off", "7", ""])
def test_texts_that_look_like_something_else_are_written_so_that_they_are_read_as_text(
    text: str, tmp_path: Path
) -> None:
    """A digest of sixteen hexadecimal digits may have digits around one e; a pose may be called so too."""
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    content = {"digest": text, "ids": [text, "a"], "of": {text or "an empty key is refused": "b"}}
    first.write_text(dump(content))
    read = load_config(first).data
    assert read == content
    second.write_text(yaml.safe_dump({"ids": read["ids"]}))
    assert load_config(second).data == {"ids": [text, "a"]}
