"""Pulse tables, the board's clock, and the angles it can set, against whole numbers worked out here."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from armcal.arm.servo import PulseClock, PulseTable, quantised
from hypothesis import given, settings
from hypothesis import strategies as st

US = 1e-6
FALLING = PulseTable((-1.7, -0.4, 0.5, 1.9), (2400 * US, 1700 * US, 1400 * US, 600 * US))
RISING = PulseTable(tuple(np.radians([-100, 0, 100])), (620 * US, 1540 * US, 2460 * US))
KINKED = PulseTable((-1.0, 0.0, 0.2, 1.5), (500 * US, 1400 * US, 1500 * US, 2500 * US))
TABLES = {"rising": RISING, "falling": FALLING, "kinked": KINKED}
every_table = pytest.mark.parametrize("name", TABLES)
BOARD = PulseClock(25e6, 121)
checked = settings(max_examples=100, deadline=None, derandomize=True)


def number(expression):
    """A constant expression as a number."""
    return float(ca.DM(ca.SX(expression)))


def by_numpy(x, at, values):
    """Linear between the points; the first and last pieces go on."""
    order = np.argsort(at)
    at, values = np.array(at)[order], np.array(values)[order]
    if x < at[0] or x > at[-1]:
        one, other = (0, 1) if x < at[0] else (-2, -1)
        return values[one] + (x - at[one]) * (values[other] - values[one]) / (at[other] - at[one])
    return float(np.interp(x, at, values))


@pytest.mark.parametrize(
    ("oscillator", "rate", "prescale"),
    [(25e6, 50, 121), (25e6, 1526, 3), (25e6, 24, 253), (26.4e6, 50, 128), (27e6, 60, 109), (25e6, 200, 30)],
)
def test_the_prescale_is_the_data_sheets_rounded_and_less_one(oscillator, rate, prescale):
    assert PulseClock.prescale_for(oscillator, rate) == prescale


def test_fifty_hertz_is_really_a_little_more_and_a_count_about_half_a_degree():
    assert 1 / (4096 * BOARD.tick) == pytest.approx(50.03, abs=0.003)
    assert pytest.approx(4.88 * US) == BOARD.tick
    per_degree = (2460 - 1540) / 100 * US
    assert BOARD.tick / per_degree == pytest.approx(0.53, abs=0.001)


@pytest.mark.parametrize("prescale", [-1, 0, 2, 256, 304])
def test_a_prescale_that_no_board_has_is_refused(prescale):
    with pytest.raises(ValueError, match=f"prescale is {prescale}.*3 to 255"):
        PulseClock(25e6, prescale)


def test_a_clock_error_moves_every_pulse_by_its_part():
    """The counts were worked out for 25 MHz; a board of 26.4 MHz makes them shorter."""
    fast = PulseClock(26.4e6, 121)
    assert fast.tick * 26.4 == pytest.approx(BOARD.tick * 25.0, rel=1e-15)


@checked
@given(pulse=st.floats(1e-5, 0.015))
def test_counts_are_the_nearest_whole_number(pulse):
    counts = number(BOARD.counts(pulse))
    assert counts == int(counts)
    assert abs(counts * BOARD.tick - pulse) <= BOARD.tick / 2 * (1 + 1e-9)


def test_half_a_count_goes_up():
    clock = PulseClock(2.0**20 * 4, 3)
    assert clock.tick == 2.0**-20
    assert [number(clock.counts(half * clock.tick)) for half in (0.5, 1.5, 2.5)] == [1, 2, 3]


@every_table
@checked
@given(angle=st.floats(-4, 4))
def test_pulses_are_linear_between_the_points_and_beyond_them(name, angle):
    table = TABLES[name]
    expected = by_numpy(angle, table.angles, table.pulses)
    assert number(table.pulse(angle)) == pytest.approx(expected, abs=1e-15)


@every_table
@checked
@given(angle=st.floats(-4, 4))
def test_the_angle_of_its_pulse_is_the_angle_itself(name, angle):
    table = TABLES[name]
    assert number(table.angle(table.pulse(angle))) == pytest.approx(angle, abs=1e-12)


@every_table
def test_tables_hold_at_their_own_points(name):
    table = TABLES[name]
    for angle, pulse in zip(table.angles, table.pulses, strict=True):
        assert number(table.pulse(angle)) == pytest.approx(pulse, rel=1e-13)
        assert number(table.angle(pulse)) == pytest.approx(angle, abs=1e-12)


@every_table
@checked
@given(angle=st.floats(-1.6, 1.6))
def test_the_angle_set_is_the_nearest_that_a_whole_count_sets(name, angle):
    table = TABLES[name]
    near = round(by_numpy(angle, table.angles, table.pulses) / BOARD.tick)
    choices = [by_numpy(n * BOARD.tick, table.pulses, table.angles) for n in range(near - 2, near + 3)]
    stands = number(quantised(angle, table, BOARD))
    assert min(abs(stands - choice) for choice in choices) < 1e-11
    asked, made = (by_numpy(a, table.angles, table.pulses) for a in (angle, stands))
    assert abs(made - asked) <= BOARD.tick / 2 * (1 + 1e-6)


@every_table
@checked
@given(angle=st.floats(-1.6, 1.6))
def test_what_a_board_can_set_stays_as_it_is(name, angle):
    once = number(quantised(angle, TABLES[name], BOARD))
    assert number(quantised(once, TABLES[name], BOARD)) == pytest.approx(once, abs=1e-11)


def test_half_a_count_is_a_millimetre_and_a_half_at_the_arms_reach():
    angles = np.linspace(-1.7, 1.7, 4001)
    off = [number(quantised(angle, RISING, BOARD)) - angle for angle in angles]
    assert np.abs(off).max() * 370 == pytest.approx(1.7, abs=0.1)
    assert np.std(off) == pytest.approx(np.radians(100) / (920 * US) * BOARD.tick / math.sqrt(12), rel=0.02)


def test_a_falling_table_is_the_rising_one_mirrored():
    mirrored = PulseTable(tuple(-a for a in reversed(FALLING.angles)), tuple(reversed(FALLING.pulses)))
    for angle in np.linspace(-2, 2, 41):
        assert number(FALLING.pulse(angle)) == pytest.approx(number(mirrored.pulse(-angle)), abs=1e-15)


def test_expressions_and_numbers_give_the_same():
    angle = ca.SX.sym("angle")
    function = ca.Function("stands", [angle], [quantised(angle, KINKED, BOARD)])
    for value in np.linspace(-1.5, 2.0, 57):
        assert float(function(value)) == pytest.approx(number(quantised(value, KINKED, BOARD)), abs=1e-14)


@pytest.mark.parametrize(
    ("angles", "pulses", "words"),
    [
        ((0.0,), (1e-3,), "two at least"),
        ((), (), "two at least"),
        ((0.0, 1.0), (1e-3, 2e-3, 3e-3), "2 angles and 3 pulses"),
        ((0.0, 0.0), (1e-3, 2e-3), "rise"),
        ((1.0, 0.0), (1e-3, 2e-3), "rise"),
        ((0.0, math.nan), (1e-3, 2e-3), "rise"),
        ((0.0, 1.0), (1e-3, math.inf), "turn back"),
        ((0.0, 1.0, 2.0), (1e-3, 2e-3, 1.5e-3), "turn back"),
        ((0.0, 1.0), (1e-3, 1e-3), "turn back"),
        ((0.0, 1.0), (0.0, 1e-3), "not above zero"),
        ((0.0, 1.0), (1e-3, -1e-3), "not above zero"),
    ],
)
def test_a_table_that_no_servo_has_is_refused(angles, pulses, words):
    with pytest.raises(ValueError, match=words):
        PulseTable(angles, pulses)
