"""Servo fits against planted tables, lags and oscillators."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from armcal.arm.servo import PulseClock, PulseTable
from armcal_bench.servo.problem import FitTask, KnownBoard, KnownServo, MeasuredPulse, Observation, fit_servos

US = 1e-6
KNOTS = tuple(math.radians(a) for a in (-100, 0, 100))
STATED = PulseTable(KNOTS, (620 * US, 1540 * US, 2460 * US))
TRUE = PulseTable(KNOTS, (604 * US, 1540 * US, 2491 * US))
REVERSED = PulseTable(KNOTS, (2440 * US, 1535 * US, 640 * US))
CLOCK = PulseClock(25e6, 121)
ONE = (KnownServo("q1", "front", STATED),)


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


def observed(table=TRUE, joint="q1", seed=0, sd_deg=0.05, lag_deg=0.4, shift_deg=0.0, clock=CLOCK, reach=100, sag=None):
    """Counts stepped up and down, and the angles of a planted servo; the board's true clock may differ."""
    rng = np.random.default_rng(seed)
    found = []
    for approach in (1, -1):
        for told in np.arange(-reach, reach + 1, 10.0)[::approach]:
            counts = round(angle_pulse(table, math.radians(told)) / CLOCK.tick)
            true = angle_at(table, counts * clock.tick) - approach * math.radians(lag_deg)
            slopes = {} if sag is None else {"arm.spring.k1": sag[1](true)}
            bent = 0.0 if sag is None else sag[0] * sag[1](true)
            angle = true + bent + math.radians(shift_deg) + rng.normal(0, math.radians(sd_deg))
            found.append(Observation(joint, counts, approach, angle, math.radians(sd_deg), 0.0, slopes))
    return found


def angle_pulse(table, angle):
    return float(np.interp(angle, table.angles, table.pulses))


def task(observations, zero="measured", servos=ONE, measured=(), clock=CLOCK):
    servos = tuple(replace(servo, knots=KNOTS) for servo in servos)
    return FitTask(servos, {"front": KnownBoard(clock, tuple(measured))}, tuple(observations), zero)


def test_a_planted_table_and_lag_come_back() -> None:
    found = fit_servos(task(observed())).servos["q1"]
    for pulse, sd, true in zip(found.pulses, found.pulse_sds, TRUE.pulses, strict=True):
        assert abs(pulse - true) < 4 * sd < 4 * US
    assert abs(math.degrees(found.lag) - 0.4) < 4 * math.degrees(found.lag_sd) < 0.1
    assert found.outliers == () and 0.6 < found.scale < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [12, pytest.param(40, marks=pytest.mark.slow)])
def test_deviations_are_right_over_seeds(seeds: int) -> None:
    off = []
    for seed in range(seeds):
        found = fit_servos(task(observed(seed=seed))).servos["q1"]
        off += [(p - t) / sd for p, sd, t in zip(found.pulses, found.pulse_sds, TRUE.pulses, strict=True)]
        off.append((found.lag - math.radians(0.4)) / found.lag_sd)
    assert 0.75 < np.std(off) < 1.15
    assert 0.9 < np.mean(np.abs(off) < 1.96) <= 1.0


def test_the_stated_zero_is_kept_whatever_the_angles_count_from() -> None:
    results = [fit_servos(task(observed(shift_deg=shift), zero="kept")).servos["q1"] for shift in (-30, 0, 7)]
    for found, shift in zip(results, (-30, 0, 7), strict=True):
        assert abs(found.pulses[1] - STATED.pulses[1]) < 0.02 * US
        assert math.degrees(found.zero) == pytest.approx(shift, abs=0.1)
        assert found.pulses == pytest.approx(results[1].pulses, abs=0.01 * US)


def test_a_reversed_servo_is_found_from_a_table_that_rises() -> None:
    for zero in ("measured", "kept"):
        found = fit_servos(task(observed(table=replace(REVERSED, pulses=(2440 * US, 1540 * US, 640 * US))), zero=zero))
        assert found.servos["q1"].pulses == pytest.approx((2440 * US, 1540 * US, 640 * US), abs=1.5 * US)
        assert found.servos["q1"].lag == pytest.approx(math.radians(0.4), abs=math.radians(0.1))


def test_an_oscillator_that_nothing_tells_stays_where_it_was_stated() -> None:
    found = fit_servos(task(observed(clock=PulseClock(26e6, 121))))
    assert found.clocks["front"] == CLOCK and found.oscillator_sds == {}


@pytest.mark.parametrize("seed", range(3))
def test_a_measured_pulse_tells_the_oscillator(seed: int) -> None:
    true = PulseClock(26.1e6, 121)
    length = 400 * true.tick + np.random.default_rng(seed).normal(0, 0.2 * US)
    measured = MeasuredPulse(400, length, 0.2 * US)
    found = fit_servos(task(observed(clock=true, seed=seed), measured=[measured]))
    sd = found.oscillator_sds["front"]
    assert abs(found.clocks["front"].oscillator_hz - 26.1e6) < 4 * sd < 20e3
    for pulse, pulse_sd, planted in zip(
        found.servos["q1"].pulses, found.servos["q1"].pulse_sds, TRUE.pulses, strict=True
    ):
        assert abs(pulse - planted) < 4 * pulse_sd


def test_a_trusted_table_tells_the_oscillator_and_with_it_the_other_tables() -> None:
    true = PulseClock(24.4e6, 121)
    trusted = KnownServo("q2", "front", STATED, trusted_sd=1 * US)
    seen = observed(clock=true) + observed(table=STATED, joint="q2", clock=true, seed=5)
    found = fit_servos(task(seen, servos=(KnownServo("q1", "front", STATED), trusted)))
    assert abs(found.clocks["front"].oscillator_hz - 24.4e6) < 4 * found.oscillator_sds["front"]
    assert found.servos["q1"].pulses == pytest.approx(TRUE.pulses, abs=4 * max(found.servos["q1"].pulse_sds))


def test_the_order_of_observations_changes_no_bit() -> None:
    seen = observed()
    mixed = [seen[i] for i in np.random.default_rng(3).permutation(len(seen))]
    assert fit_servos(task(seen)) == fit_servos(task(mixed))


def test_a_wrong_angle_is_set_aside_and_told() -> None:
    seen = observed()
    seen[7] = replace(seen[7], angle=seen[7].angle + math.radians(5))
    found = fit_servos(task(seen)).servos["q1"]
    assert found.outliers == (seen[7],)
    assert found.pulses == pytest.approx(TRUE.pulses, abs=2 * US)


def test_a_knot_that_nothing_tells_keeps_its_stated_pulse() -> None:
    seen = [o for o in observed() if o.angle > 0.2]
    found = fit_servos(task(seen)).servos["q1"]
    assert found.determined == (False, True, True)
    assert found.pulses[0] == STATED.pulses[0]
    assert math.isnan(found.pulse_sds[0])


def test_from_one_side_no_lag_is_told() -> None:
    found = fit_servos(task([o for o in observed(lag_deg=0) if o.approach == 1])).servos["q1"]
    assert found.lag is None
    assert found.pulses == pytest.approx(TRUE.pulses, abs=2 * US)


def test_more_scatter_than_stated_widens_the_deviations() -> None:
    stated = [replace(o, sd=o.sd / 4) for o in observed(sd_deg=0.2)]
    wide, narrow = fit_servos(task(stated)).servos["q1"], fit_servos(task(observed(sd_deg=0.2))).servos["q1"]
    assert wide.scale > 3 and max(wide.pulse_sds) == pytest.approx(max(narrow.pulse_sds), rel=0.3)


def test_what_a_spring_gives_is_told_apart_from_the_table() -> None:
    def effort(angle):
        return 0.6 * math.sin(angle + 0.8)

    found = fit_servos(task(observed(sag=(0.08, effort)), zero="kept"))
    value, sd = found.compliances["arm.spring.k1"]
    assert abs(value - 0.08) < 4 * sd < 0.04
    for pulse, sd, true in zip(found.servos["q1"].pulses, found.servos["q1"].pulse_sds, TRUE.pulses, strict=True):
        assert abs(pulse - true) < 4 * sd + 0.01 * US
