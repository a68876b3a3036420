"""Servo fits against planted tables, lags and oscillators, on an arm of three joints whose rotations a tracker sees."""

from __future__ import annotations

import math

import numpy as np
import pytest
from armcal.arm.servo import PulseClock, PulseTable
from armcal_bench.servo_fit import outcome_of
from armcal_bench.servo_setup import KnownServo, ServoCalibrationSettings
from armcal_bench.tracked_body import RigidArm
from scipy.spatial.transform import Rotation

from tests.own_arms import POST, _config
from tests.servo_records import loaded, pose_line

US = 1e-6
KNOTS = tuple(math.radians(a) for a in (-100, 0, 100))
STATED = PulseTable(KNOTS, (620 * US, 1540 * US, 2460 * US))
TRUE = PulseTable(KNOTS, (604 * US, 1540 * US, 2491 * US))
REVERSED = PulseTable(KNOTS, (2440 * US, 1540 * US, 640 * US))
CLOCK = PulseClock(25e6, 121)
BASE = {"a": 0.2, "b": 0.3, "c": -0.4}


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    return loaded(tmp_path_factory.mktemp("post"), _config(POST))


def angle_at(table, pulse):
    """By numpy alone."""
    order = np.argsort(table.pulses)
    pulses, angles = np.array(table.pulses)[order], np.array(table.angles)[order]
    slope = np.diff(angles) / np.diff(pulses)
    if pulse < pulses[0]:
        return angles[0] + slope[0] * (pulse - pulses[0])
    if pulse > pulses[-1]:
        return angles[-1] + slope[-1] * (pulse - pulses[-1])
    return float(np.interp(pulse, pulses, angles))


def observed(
    experiment, table=TRUE, joint="b", seed=0, sd_deg=0.05, lag_deg=0.4, shift_deg=0.0, clock=CLOCK, stated_sd=None
):
    """Counts stepped up and down, and the rotations of a planted servo; the board's true clock may differ."""
    rng = np.random.default_rng(seed)
    (arm,) = experiment.system.arms.values()
    rigid, lines = RigidArm(arm, experiment.parameters), []
    for came in (1, -1):
        for commanded in np.arange(-100, 101, 10.0)[::came]:
            counts = round(angle_pulse(table, math.radians(commanded)) / CLOCK.tick)
            approach = came if table.pulses[0] < table.pulses[-1] else -came
            true = angle_at(table, counts * clock.tick) - approach * math.radians(lag_deg)
            pose = rigid.tool({**BASE, joint: true + math.radians(shift_deg)})
            noise = Rotation.from_rotvec(rng.normal(0, math.radians(sd_deg), 3)).as_matrix()
            pose[:3, :3] = pose[:3, :3] @ noise
            deviations = [1e-4] * 3 + [math.radians(stated_sd or sd_deg)] * 3
            lines.append(pose_line(joint, counts, came, pose, {**BASE, joint: 0.0}, deviations=deviations))
    return lines


def angle_pulse(table, angle):
    return float(np.interp(angle, table.angles, table.pulses))


def fitted(experiment, lines, zero="model"):
    (arm,) = experiment.system.arms.values()
    known = [KnownServo("b", "only", STATED, CLOCK, KNOTS)]
    begun = {"kind": "begun", "servos": {}, "base": BASE}
    settings = ServoCalibrationSettings.si(zero=zero, sag="none", rotation_sd=1e-5)
    return outcome_of([begun, *lines], known, experiment, arm, settings)


def test_a_planted_table_and_lag_come_back(experiment) -> None:
    found = fitted(experiment, observed(experiment)).servos["b"]
    for pulse, sd, true in zip(found.pulses, found.pulse_sds, TRUE.pulses, strict=True):
        assert abs(pulse - true) < 4 * sd < 4 * US
    assert abs(math.degrees(found.lag) - 0.4) < 4 * math.degrees(found.lag_sd) < 0.1
    assert found.outliers == () and 0.6 < found.scale < 1.5


@pytest.mark.slow
def test_deviations_are_right_over_seeds(experiment) -> None:
    off = []
    for seed in range(40):
        found = fitted(experiment, observed(experiment, seed=seed), zero="kept").servos["b"]
        ends = [(found.pulses[k], found.pulse_sds[k], TRUE.pulses[k]) for k in (0, 2)]
        off += [(pulse - true) / sd for pulse, sd, true in ends]
        off.append((found.lag - math.radians(0.4)) / found.lag_sd)
    assert 0.75 < np.std(off) < 1.15
    assert 0.9 < np.mean(np.abs(off) < 1.96) <= 1.0


def test_the_stated_zero_is_kept_whatever_the_angles_count_from(experiment) -> None:
    shifts = (-3, 0, 7)
    results = [fitted(experiment, observed(experiment, shift_deg=s), zero="kept").servos["b"] for s in shifts]
    for found in results:
        assert abs(found.pulses[1] - STATED.pulses[1]) < 0.02 * US
        assert found.pulses == pytest.approx(results[1].pulses, abs=0.05 * US)


def test_a_reversed_servo_is_found_from_a_table_that_rises(experiment) -> None:
    for zero in ("model", "kept"):
        found = fitted(experiment, observed(experiment, table=REVERSED), zero=zero).servos["b"]
        assert found.pulses == pytest.approx((2440 * US, 1540 * US, 640 * US), abs=1.5 * US)
        assert found.lag == pytest.approx(math.radians(0.4), abs=math.radians(0.1))


def test_an_oscillator_that_is_off_makes_tables_longer_and_angles_no_worse(experiment) -> None:
    true = PulseClock(26e6, 121)
    found = fitted(experiment, observed(experiment, clock=true)).servos["b"]
    longer = CLOCK.tick / true.tick
    assert found.pulses == pytest.approx([pulse * longer for pulse in TRUE.pulses], abs=2 * US)


def test_a_wrong_angle_is_set_aside_and_told(experiment) -> None:
    seen = observed(experiment)
    pose = np.array(seen[7]["rotation"]) @ Rotation.from_rotvec([0, 0, math.radians(5)]).as_matrix()
    seen[7] = {**seen[7], "rotation": pose.tolist()}
    found = fitted(experiment, seen).servos["b"]
    assert [counts for counts, _ in found.outliers] == [seen[7]["counts"]]
    assert found.pulses == pytest.approx(TRUE.pulses, abs=2 * US)


def test_a_knot_that_nothing_tells_keeps_its_stated_pulse(experiment) -> None:
    seen = [line for line in observed(experiment) if line["counts"] * CLOCK.tick > 1.6e-3]
    found = fitted(experiment, seen).servos["b"]
    assert found.determined == (False, True, True)
    assert found.pulses[0] == STATED.pulses[0]
    assert math.isnan(found.pulse_sds[0])


def test_from_one_side_no_lag_is_told(experiment) -> None:
    found = fitted(experiment, [line for line in observed(experiment, lag_deg=0) if line["came"] == 1]).servos["b"]
    assert found.lag is None
    assert found.pulses == pytest.approx(TRUE.pulses, abs=2 * US)


def test_more_scatter_than_stated_widens_the_deviations(experiment) -> None:
    wide = fitted(experiment, observed(experiment, sd_deg=0.2, stated_sd=0.05)).servos["b"]
    narrow = fitted(experiment, observed(experiment, sd_deg=0.2)).servos["b"]
    assert wide.scale > 3 and max(wide.pulse_sds) == pytest.approx(max(narrow.pulse_sds), rel=0.3)
