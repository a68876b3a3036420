"""The PCA9685 model against its data sheet, rule by rule: raw transactions, and what stands at the pins."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.simulated_lines.pca9685_model import ADDRESS_ONLY, BusStuckError, I2cBus, Pca9685Model

A = 0x40
TICK = 122 / 25e6  # prescale 121


class Chip:
    """A chip with a clock that a test sets."""

    def __init__(self, **given: object) -> None:
        self.now = 0.0
        self.model = Pca9685Model(lambda: self.now, **given)  # type: ignore[arg-type]

    def write(self, *data: int, to: int = A) -> int:
        return self.model.transaction(to, bytes(data))

    def read(self, register: int, count: int = 1) -> bytes:
        found = self.model.read(A, register, count)
        assert found is not None
        return found

    def awake(self) -> Chip:
        """50 Hz, auto-increment, oscillator running."""
        self.write(0x00, 0x31)
        self.write(0xFE, 121)
        self.write(0x00, 0x21)
        self.now += 0.0005
        return self

    def channel(self, number: int, on: int, off: int) -> int:
        return self.write(0x06 + 4 * number, on & 0xFF, on >> 8, off & 0xFF, off >> 8)

    @property
    def rules(self) -> list[str]:
        return [violation.rule for violation in self.model.violations]


def test_it_wakes_up_asleep_with_all_outputs_off() -> None:
    chip = Chip()
    assert chip.read(0x00) == b"\x11" and chip.read(0x01) == b"\x04" and chip.read(0xFE) == b"\x1e"
    assert [chip.read(r)[0] for r in (2, 3, 4, 5)] == [0xE2, 0xE4, 0xE8, 0xE0]
    assert all(chip.read(0x09 + 4 * channel) == b"\x10" for channel in range(16))
    assert all(chip.model.pulse_s(channel) is None for channel in range(16))


def test_the_prescale_is_set_in_sleep_only_and_no_lower_than_three() -> None:
    chip = Chip()
    chip.write(0xFE, 121)
    assert chip.read(0xFE) == bytes([121])
    chip.write(0xFE, 1)
    assert chip.read(0xFE) == b"\x03"
    chip.write(0x00, 0x01)
    chip.write(0xFE, 50)
    assert chip.read(0xFE) == b"\x03" and "PRE_SCALE" in chip.rules[0]


@pytest.mark.parametrize("oscillator_hz", [23e6, 25e6, 25.3e6, 27e6])
def test_a_pulse_lasts_its_counts_by_the_true_oscillator(oscillator_hz: float) -> None:
    chip = Chip(oscillator_hz=oscillator_hz).awake()
    chip.channel(3, 200, 515)
    assert chip.model.pulse_s(3) == pytest.approx(315 * 122 / oscillator_hz, rel=1e-12)
    assert chip.model.period_s == pytest.approx(4096 * 122 / oscillator_hz)


def test_a_pulse_may_reach_over_the_end_of_the_period() -> None:
    chip = Chip().awake()
    chip.channel(0, 4000, 219)
    assert chip.model.pulse_s(0) == pytest.approx(315 * TICK)


def test_full_off_wins_over_full_on_which_wins_over_counts() -> None:
    chip = Chip().awake()
    chip.channel(0, 0x1000, 300)
    assert chip.model.pulse_s(0) == pytest.approx(chip.model.period_s)
    chip.channel(0, 0x1000, 0x1000)
    assert chip.model.pulse_s(0) is None
    chip.channel(0, 0, 0x1000 | 300)
    assert chip.model.pulse_s(0) is None
    chip.channel(0, 0, 300)
    assert chip.model.pulse_s(0) == pytest.approx(300 * TICK)


def test_without_auto_increment_all_bytes_go_to_one_register() -> None:
    chip = Chip()
    chip.write(0x06, 1, 2, 3, 4)
    assert chip.read(0x06) == b"\x04" and chip.read(0x08) == b"\x00"
    assert chip.read(0x06, 3) == b"\x04\x04\x04"


def test_auto_increment_wraps_from_45_and_from_fe_to_00() -> None:
    chip = Chip()
    chip.write(0x00, 0x31)
    assert chip.read(0x45, 3)[1:] == chip.read(0x00, 2)
    assert chip.read(0xFD, 3) == b"\x00\x1e\x31"
    chip.write(0xFE, 77, 0x31)  # PRE_SCALE, then MODE1
    assert chip.read(0xFE) == bytes([77])
    assert chip.read(0x00) == b"\x31"


def test_auto_increment_can_begin_within_the_transaction_that_sets_it() -> None:
    chip = Chip()
    chip.write(0x00, 0x31, 0x0C)
    assert chip.read(0x01) == b"\x0c"


def test_outputs_change_on_stop_so_that_one_transaction_makes_no_glitch() -> None:
    chip = Chip().awake()
    chip.channel(0, 0, 255)
    chip.model.commits.clear()
    chip.channel(0, 0, 256)
    assert [(c.before, c.after) for c in chip.model.commits] == [pytest.approx((255 * TICK, 256 * TICK))]


def test_separate_bytes_glitch_where_the_high_byte_changes() -> None:
    chip = Chip().awake()
    chip.channel(0, 0, 255)
    chip.model.commits.clear()
    chip.write(0x08, 0x00)
    chip.write(0x09, 0x01)
    seen = [round((c.after or 0) / TICK) for c in chip.model.commits]
    assert seen == [0, 256]


def test_with_och_outputs_change_when_all_four_bytes_of_a_channel_have_come() -> None:
    chip = Chip().awake()
    chip.write(0x01, 0x0C)
    chip.channel(0, 0, 300)
    chip.model.commits.clear()
    chip.write(0x06, 0, 0, 0x90)
    assert not chip.model.commits
    chip.write(0x09, 0x01)
    assert [round((c.after or 0) / TICK) for c in chip.model.commits] == [400]


def test_all_led_is_written_and_read_as_zero() -> None:
    chip = Chip().awake()
    chip.write(0xFA, 0, 0, 0x2C, 0x01)
    assert chip.read(0xFA, 4) == bytes(4)
    assert all(chip.model.pulse_s(channel) == pytest.approx(300 * TICK) for channel in range(16))


def test_reserved_registers_are_not_acknowledged() -> None:
    chip = Chip()
    assert chip.write(0x46, 1) == 1
    assert chip.model.read(A, 0x80, 1) is None


def test_all_call_and_sub_addresses_answer_while_they_are_enabled() -> None:
    chip = Chip()
    assert chip.write(0x00, 0x11, to=0x70) == 3
    assert chip.write(0x00, 0x11, to=0x71) == 0
    chip.write(0x00, 0x18)
    assert chip.write(0x00, 0x18, to=0x70) == 0
    assert chip.write(0x00, 0x18, to=0x71) == 3
    chip.write(0x02, 0xA2)
    assert chip.write(0x00, 0x18, to=0x51) == 3
    assert chip.write(0x00, 0x18, to=0x41) == 0


def test_software_reset_restores_defaults_and_other_general_calls_do_not() -> None:
    chip = Chip().awake()
    chip.channel(0, 0, 300)
    assert chip.write(0x05, to=0x00) == 1 and chip.model.pulse_s(0) is not None
    assert chip.write(0x06, 0x00, to=0x00) == 2 and chip.model.pulse_s(0) is not None
    assert chip.write(0x06, to=0x00) == 2
    assert chip.model.pulse_s(0) is None and chip.read(0x00) == b"\x11" and chip.read(0xFE) == b"\x1e"


def test_extclk_sticks_until_power_or_software_reset_and_stops_pulses_without_a_clock() -> None:
    chip = Chip().awake()
    chip.channel(0, 0, 300)
    chip.write(0x00, 0x31)
    chip.write(0x00, 0x71)
    chip.write(0x00, 0x21)
    chip.now += 1
    chip.channel(0, 0, 300)
    assert chip.read(0x00)[0] & 0x40 and chip.model.pulse_s(0) is None and not chip.rules
    chip.model.power_cycle()
    assert not chip.read(0x00)[0] & 0x40


def test_extclk_without_sleep_breaks_a_rule() -> None:
    chip = Chip().awake()
    chip.write(0x00, 0x61)
    assert "EXTCLK" in chip.rules[0]


def slept_and_woken(chip: Chip) -> None:
    """Sleep while a channel runs, for longer than a period, and wake."""
    chip.channel(0, 0, 300)
    chip.write(0x00, 0x31)
    assert chip.model.pulse_s(0) is None
    chip.now += 0.021
    assert chip.read(0x00)[0] & 0x80
    chip.write(0x00, 0x21)


def test_restart_brings_back_what_ran_before_sleep() -> None:
    chip = Chip().awake()
    slept_and_woken(chip)
    assert chip.model.pulse_s(0) is None
    chip.now += 0.0005
    chip.write(0x00, 0xA1)
    assert chip.model.pulse_s(0) == pytest.approx(300 * TICK)
    assert not chip.read(0x00)[0] & 0x80 and not chip.rules


def test_restart_is_set_when_the_refresh_cycle_ends_and_not_before() -> None:
    chip = Chip().awake()
    chip.channel(0, 0, 300)
    chip.write(0x00, 0x31)
    assert not chip.read(0x00)[0] & 0x80
    chip.now += chip.model.period_s
    assert chip.read(0x00)[0] & 0x80


def test_restart_is_not_set_after_an_orderly_shutdown() -> None:
    chip = Chip().awake()
    chip.channel(0, 0, 300)
    chip.write(0xFD, 0x10)
    chip.write(0x00, 0x31)
    chip.now += 1
    assert not chip.read(0x00)[0] & 0x80


def test_restart_within_500_us_breaks_a_rule_and_restarts_nothing() -> None:
    chip = Chip().awake()
    slept_and_woken(chip)
    chip.now += 0.0004
    chip.write(0x00, 0xA1)
    assert "500 us" in chip.rules[0] and chip.model.pulse_s(0) is None


def test_restart_that_is_not_set_does_nothing_and_is_noted() -> None:
    chip = Chip().awake()
    chip.write(0x00, 0xA1)
    assert "not set" in chip.rules[0]


def test_a_pwm_write_clears_restart() -> None:
    chip = Chip().awake()
    slept_and_woken(chip)
    chip.now += 0.001
    chip.channel(1, 0, 200)
    assert not chip.read(0x00)[0] & 0x80
    assert chip.model.pulse_s(1) == pytest.approx(200 * TICK) and chip.model.pulse_s(0) is None


def test_pwm_registers_within_500_us_of_waking_give_an_undefined_pulse() -> None:
    chip = Chip()
    chip.write(0x00, 0x31)
    chip.write(0xFE, 121)
    chip.write(0x00, 0x21)
    chip.channel(0, 0, 300)
    assert "500 us" in chip.rules[0] and chip.model.pulse_s(0) != pytest.approx(300 * TICK)
    chip.now += 0.0005
    chip.channel(0, 0, 300)
    assert chip.model.pulse_s(0) == pytest.approx(300 * TICK)


def test_equal_counts_break_a_rule() -> None:
    chip = Chip().awake()
    chip.channel(0, 100, 100)
    assert "equal" in chip.rules[0]


def test_inverted_outputs_are_high_for_the_rest_of_the_period() -> None:
    chip = Chip().awake()
    chip.channel(0, 0, 300)
    chip.write(0x01, 0x14)
    assert chip.model.pulse_s(0) == pytest.approx((4096 - 300) * TICK)


def test_a_brown_out_ends_all_pulses() -> None:
    chip = Chip().awake()
    chip.channel(0, 0, 300)
    chip.model.power_cycle()
    assert chip.model.commits[-1].after is None


class TestBus:
    def bus(self) -> tuple[Chip, Chip, I2cBus]:
        first, second = Chip(), Chip(address=0x41)
        second.now = first.now
        return first, second, I2cBus(lambda: first.now, [first.model, second.model])

    def test_chips_answer_to_their_own_address(self) -> None:
        first, second, bus = self.bus()
        bus.write(0x41, bytes([0xFE, 99]))
        assert first.read(0xFE) == b"\x1e" and second.model.read(0x41, 0xFE, 1) == bytes([99])
        assert bus.write(0x42, b"\0") == 0 and bus.read(0x42, 0, 1) is None

    def test_all_call_reaches_all(self) -> None:
        first, second, bus = self.bus()
        bus.write(0x70, bytes([0xFE, 99]))
        assert first.read(0xFE) == second.model.read(0x41, 0xFE, 1) == bytes([99])

    def test_a_planned_refusal_cuts_the_write_off_and_happens_once(self) -> None:
        first, _, bus = self.bus()
        first.awake()
        first.channel(0, 0, 255)
        bus.plan_nack(4, after=1)
        whole = bytes([0x06, 0, 0, 0, 1])
        assert bus.write(A, bytes([0x0A, 0, 0, 0, 1])) == 6
        assert bus.write(A, whole) == 5
        assert first.model.pulse_s(0) is None, "the low byte has come and the high one has not: 0 counts"
        assert bus.write(A, whole) == 6
        assert first.model.pulse_s(0) == pytest.approx(256 * TICK)
        bus.plan_nack(ADDRESS_ONLY)
        assert bus.write(A, whole) == 0

    def test_a_line_held_down_stops_everything_until_it_is_let_go(self) -> None:
        first, _, bus = self.bus()
        bus.hold_down(0.03)
        with pytest.raises(BusStuckError):
            bus.write(A, b"\0")
        first.now += 0.03
        assert bus.write(A, b"\0") == 2


@given(st.lists(st.tuples(st.integers(0, 15), st.binary(min_size=4, max_size=4)), max_size=12), st.booleans())
def test_a_channel_at_once_is_what_its_bytes_one_by_one_are(writes: list[tuple[int, bytes]], och: bool) -> None:
    """The short way for the commonest write against the long one, which the data sheet describes."""

    class Plain(Pca9685Model):
        def _is_channel(self, data: bytes) -> bool:
            return False

    found = []
    for kind in (Pca9685Model, Plain):
        chip = Chip().awake()
        chip.model = kind(lambda: 1.0)
        for register, value in ((0, 0x31), (0xFE, 121), (1, 0x0C if och else 4), (0, 0x21)):
            chip.model.transaction(A, bytes((register, value)))
        for channel, data in writes:
            chip.model.transaction(A, bytes((0x06 + 4 * channel,)) + data)
        state = chip.model.read(A, 0, 70), [chip.model.pulse_s(c) for c in range(16)]
        found.append((state, list(chip.model.commits), list(chip.model.violations)))
    assert found[0] == found[1]
