"""The effect ``quantisation`` from a servo file: every board's own clock, and settings that need no file."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from armcal.arm.effects import JointCommand
from armcal.arm.servo import PulseClock, PulseTable, quantised
from armcal.base.config_text import ConfigText
from armcal.config.servo_file import digest
from armcal.run.experiment import Experiment
from armcal_joints.effects import Quantisation
from board_bench import JOINTS, LRM_PULSES_US, servo_file, written
from pydantic import ValidationError

OSCILLATORS = (24.1e6, 26.9e6)
ARM = JOINTS[:6]


def settings_from(folder):
    written(folder, servo_file(OSCILLATORS, ids=("A", "B")))
    return Quantisation.Settings.model_validate({"servos": ConfigText("servos.yaml", None, folder, folder)})


def displacement(effect, index, angle):
    fields = {"index": index, "commanded": angle}
    command = object.__new__(JointCommand)
    for name, value in fields.items():
        object.__setattr__(command, name, value)
    return float(effect.displacement(command, {}))


def test_each_joint_is_counted_by_its_boards_clock(tmp_path):
    effect = Quantisation(settings_from(tmp_path), ARM)
    for index, joint in enumerate(ARM):
        hz = OSCILLATORS[index % 2]
        clock = PulseClock(hz, round(hz / (4096 * 50)) - 1)
        table = PulseTable(tuple(map(math.radians, (-100, 0, 100))), tuple(p / 1e6 for p in LRM_PULSES_US[joint]))
        for angle in np.linspace(-1.7, 1.7, 41):
            assert displacement(effect, index, angle) == pytest.approx(
                float(quantised(angle, table, clock)) - angle, abs=1e-13
            )


def test_the_settings_need_no_file(tmp_path):
    settings = settings_from(tmp_path)
    config = settings.to_config()
    (tmp_path / "servos.yaml").unlink()
    again = Quantisation.Settings.model_validate(config)
    assert again == settings
    assert digest(again.servos) == digest(settings.servos)
    assert config["servos"]["q2"]["board_id"] == "B" and config["servos"]["q2"]["address"] == 0x41


def test_what_is_refused(tmp_path):
    settings_from(tmp_path)
    path = str(tmp_path / "servos.yaml")
    tables = {"q1": {"angles_deg": [-100, 100], "pulses_us": [600, 2400]}}
    for bad, word in (
        ({}, "neither servos nor tables"),
        ({"servos": path, "tables": tables}, "both servos and tables"),
        ({"servos": path, "oscillator_hz": 26e6}, "clock beside servos"),
        ({"servos": str(tmp_path / "none.yaml")}, "no such file"),
        ({"servos": 3}, "servos"),
    ):
        with pytest.raises(ValidationError, match=word):
            Quantisation.Settings.model_validate(bad)
    (tmp_path / "servos.yaml").write_text("boards: {}\nservos: {q1: {board: x, channel: 99}}\n")
    with pytest.raises(ValidationError, match=r"servos\.yaml:2, servos\.q1\.channel"):
        Quantisation.Settings.model_validate({"servos": path})


def test_a_joint_that_the_file_lacks_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no servo elbow"):
        Quantisation(settings_from(tmp_path), ("q1", "elbow"))


def test_a_joint_that_is_off_moves_the_tip_whatever_the_counts(lrm):
    """So that a joint's error, its noise or its slip is seen at its own size: as of the arm without a board."""
    steps = ", ".join(f"{joint}: {{angles_deg: [-100, 100], pulses_us: [600, 2400]}}" for joint in ARM)
    stepped = f"arms.arm.effects.steps={{type: quantisation, tables: {{{steps}}}}}"
    q = np.random.default_rng(7).uniform(-1.5, 1.5, (20, 6))
    with_board = lrm.problem(lrm.experiment("option1", stepped), lrm.dataset(q, np.zeros((20, 3))))
    effect = with_board.blueprint.arms["arm"].effects["steps"]
    stood = q + [[displacement(effect, index, angle) for index, angle in enumerate(row)] for row in q]
    assert 1e-4 < np.abs(stood - q).max() < 0.1
    without = lrm.problem(lrm.experiment(), lrm.dataset(stood, np.zeros((20, 3))))
    channels, at_rest = [f"arm.{joint}" for joint in ARM], []
    for problem, angles in ((with_board, q), (without, stood)):
        records, values = problem.of(lrm.dataset(angles, np.zeros((20, 3)))).records, problem.parameters.nominal()
        residuals = problem.with_records(records).residuals(values)
        at_rest.append((residuals[0], problem.with_records(records).channel_slopes(values, channels)[0]))
    (residual, slopes), (same, expected) = at_rest
    assert residual == pytest.approx(same, abs=1e-9) and slopes == pytest.approx(expected, abs=1e-6)
    assert np.abs(expected).max() > 0.1


def test_records_beyond_the_pulse_tables_are_warned_of_and_no_others(tmp_path):
    """Half a count beyond an end is how a board rounds; the shipped records and tables end at the same 100 deg."""
    demo = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "demo.yaml"

    def warned(*angles):
        tables = {joint: {"angles_deg": [*angles], "pulses_us": [620, 1540, 2460]} for joint in ARM}
        sets = [f"arms.arm.effects.counts={json.dumps({'type': 'quantisation', 'tables': tables})}"]
        return Experiment.load(demo, sets).read().warnings

    assert warned(-100, 0, 100) == () and warned(-99.9, 0, 99.9) == ()
    (text,) = warned(0, 90, 180)
    assert "q1 is beyond its pulse table 0 to 180 deg in 66 of 200 records, at worst -100 (-100 to 100 deg)" in text
    assert "q6 is beyond" in text and "middle at 90" in text
