"""Tables from a tracked record of an arm that sags, whose axes are not where its model has them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from armcal.arm.servo import PulseClock, PulseTable
from armcal.config.servo_file import load_servo_file
from armcal.config.yaml_source import load_config
from armcal.run.experiment import Experiment
from armcal_bench.servo_fit import findings, improved, outcome_of, results, write_servo_file
from armcal_bench.servo_setup import KnownServo, ServoCalibrationSettings
from scipy.spatial.transform import Rotation

from tests.servo_fakes import CONFIGS
from tests.servo_records import ElasticArm, pose_line

US = 1e-6
CLOCK = PulseClock(25e6, 121)
REACH = {"q1": 90, "q2": 46, "q3": 90, "q4": 90, "q5": 90, "q6": 46}
LAG = math.radians(0.15)
STATED = load_servo_file(CONFIGS / "servos.yaml")
SLOPES = {
    "q1": (1.006, 0.992),
    "q2": (0.99, 1.004),
    "q3": (1, 1.01),
    "q4": (0.985, 1),
    "q5": (1, 0.99),
    "q6": (1.01, 1),
}
TRUE = {
    joint: (p[1] - SLOPES[joint][0] * (p[1] - p[0]), p[1], p[1] + SLOPES[joint][1] * (p[2] - p[1]))
    for joint, p in ((joint, servo.pulses) for joint, servo in STATED.servos.items())
}


def arm_with(values):
    return ElasticArm(Experiment.load(CONFIGS / "option1.yaml", values))


@pytest.fixture(scope="module")
def nominal():
    return arm_with([])


@pytest.fixture(scope="module")
def truth():
    values = {name: str(text) for name, text in load_config(CONFIGS / "truth.yaml").data.items()}
    return arm_with([f'parameters.values."{name}"={text}' for name, text in values.items()])


def record_of(arm, seen="rotation", noise_deg=0.01, joints=REACH, step=23):
    """What a tracker sees of sweeps up and down, with play that a joint stands in, and a body that sits askew."""
    rng, lines = np.random.default_rng(11), []
    seat = Rotation.from_rotvec([0.05, -0.1, 0.02]).as_matrix()
    for joint in joints:
        table = PulseTable(tuple(np.radians([-100, 0, 100])), TRUE[joint])
        stand = {other: rng.normal(0, math.radians(0.05)) for other in REACH}
        for came in (1, -1):
            for angle in np.arange(-REACH[joint], REACH[joint] + 1, step)[::came]:
                counts = round(float(table.pulse(math.radians(angle))) / CLOCK.tick)
                true = float(table.angle(counts * CLOCK.tick)) - came * LAG
                pose = arm.tools([{**stand, joint: true}])[0]
                shake = Rotation.from_rotvec(rng.normal(0, math.radians(noise_deg), 3)).as_matrix()
                at = pose[:3, 3] + rng.normal(0, 1e-4, 3)
                pose[:3, 3], pose[:3, :3] = at, shake @ pose[:3, :3] @ seat if seen == "rotation" else np.nan
                lines.append(pose_line(joint, counts, came, pose, dict.fromkeys(REACH, 0.0)))
    return lines


def evaluated(record, nominal, joints=REACH, **settings):
    known = [KnownServo(joint, "front", STATED.servos[joint].table, CLOCK) for joint in joints]
    return outcome_of(record, known, nominal.experiment, nominal.arm, ServoCalibrationSettings.si(**settings))


def worst_us(outcome):
    """The largest difference of a pulse at the ends of what was measured, where tables matter."""
    off = []
    for joint, servo in outcome.servos.items():
        for angle in (-REACH[joint], REACH[joint]):
            found, true = (np.interp(angle, [-100, 0, 100], pulses) for pulses in (servo.pulses, TRUE[joint]))
            off.append(abs(found - true) / US)
    return max(off)


@pytest.fixture(scope="module")
def whole(truth, nominal):
    return evaluated(record_of(truth), nominal)


@pytest.fixture(scope="module")
def part(truth, nominal):
    """The same of one joint alone."""
    return evaluated(record_of(truth, joints=("q3",)), nominal, ("q3",))


@pytest.mark.slow
def test_tables_come_back_though_nobody_knew_springs_or_axes(whole):
    assert worst_us(whole) < 3.0
    for servo in whole.servos.values():
        assert servo.lag == pytest.approx(LAG, abs=math.radians(0.03))
        assert not servo.outliers


@pytest.mark.slow
def test_the_springs_that_matter_are_found_with_them(whole, truth):
    for name in ("arm.spring.k2", "arm.spring.k4"):
        value, sd = whole.compliances[name]
        assert abs(value - truth.compliance(name)) < max(4 * sd, 0.1 * truth.compliance(name))


def test_what_is_taken_for_stiff_is_far_off_and_that_is_said(truth, nominal):
    stiff = evaluated(record_of(truth, joints=("q4",)), nominal, ("q4",), sag="none")
    assert worst_us(stiff) > 10
    assert any("has no deflection of the arm under its weight" in sentence for sentence in findings(stiff))


def test_positions_alone_do_where_the_arm_is_stiff(nominal):
    found = evaluated(record_of(nominal, seen="position", joints=("q2",)), nominal, ("q2",), sag="none")
    assert found.servos["q2"].by == "position"
    assert worst_us(found) < 4.0


def test_a_joint_that_positions_do_not_show_is_left_as_it_was(nominal):
    found = evaluated(record_of(nominal, seen="position", joints=("q5",)), nominal, ("q5",), sag="none")
    assert not found.servos
    assert "circle" in found.silent["q5"]
    changed = improved(STATED, found)
    assert changed == STATED
    assert any("left as it was" in sentence for sentence in results(found, changed)["findings"])


def test_writing_keeps_every_file_before_and_the_numbers_that_were_found(part, tmp_path):
    path = tmp_path / "servos.yaml"
    path.write_bytes((CONFIGS / "servos.yaml").read_bytes())
    changed = improved(STATED, part)
    assert write_servo_file(path, changed) == tmp_path / "servos.yaml.before-1"
    assert load_servo_file(path) == changed
    assert write_servo_file(path, changed) is None
    assert write_servo_file(path, STATED) == tmp_path / "servos.yaml.before-2"
    assert (tmp_path / "servos.yaml.before-1").read_bytes() == (CONFIGS / "servos.yaml").read_bytes()


@pytest.mark.slow
def test_a_servo_that_lets_go_is_left_out_and_spoils_no_other(truth, nominal):
    record = record_of(truth, joints=("q3", "q5"))
    dropped = [i for i, line in enumerate(record) if line["joint"] == "q5"][8:]
    limp = record[dropped[0]]
    for i in dropped:
        record[i] = {**limp, "counts": record[i]["counts"], "came": record[i]["came"]}
    both = evaluated(record, nominal, ("q3", "q5"))
    alone = evaluated([line for line in record if line["joint"] == "q3"], nominal, ("q3",))
    assert "let go" in both.silent["q5"] and set(both.servos) == {"q3"}
    assert both.servos["q3"].pulses == alone.servos["q3"].pulses


def test_a_board_without_an_id_gets_the_one_it_was_measured_on_and_others_keep_theirs(part):
    board = STATED.boards["front"]
    nameless = replace(STATED, boards={"front": type(board).si(**{**board.model_dump(), "id": ""})})
    assert improved(nameless, part, "A5069RR4").boards["front"].id == "A5069RR4"
    assert improved(STATED, part, "A5069RR4").boards["front"].id == "LRM-1"
