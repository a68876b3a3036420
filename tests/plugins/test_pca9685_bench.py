"""A test-bench for drivers: it passes the true one, and catches every bug that drivers of this chip are known for.

What counts is the pulse at the pin, from the registers and the true oscillator; the driver's own sums are not asked.
"""

from __future__ import annotations

from itertools import pairwise

import armcal_pca9685.device
import pytest
from armcal.arm.servo import PulseClock
from armcal.config.servo_file import CalibratedServo
from armcal.devices.device import DeviceError
from armcal_pca9685.device import Channel, Chip, Pca9685Device, channel_register
from board_bench import JOINTS, LRM_PULSES_US, Clock, ModelLink, servo_file, written

OSCILLATORS = (24.1e6, 26.9e6)
RATE_HZ = 50.0
SLACK_S = 1e-7
ANGLES_DEG = (-100.0, -63.0, -20.0, -1.0, 0.0, 0.4, 33.3, 70.0, 100.0)


def asked_pulse_s(joint: str, angle_deg: float) -> float:
    low, middle, high = LRM_PULSES_US[joint]
    slope = (middle - low) if angle_deg < 0 else (high - middle)
    return (middle + slope * angle_deg / 100) * 1e-6


def complaints(folder) -> set[str]:
    """What is wrong with the driver as it stands, by name; anything that it raises is wrong too."""
    bench = _Bench(folder)
    try:
        bench.from_power_up()
        bench.over_the_tables()
        bench.opened_again()
        bench.released()
        bench.from_a_sleep_that_can_be_restarted()
        bench.from_always_on()
    except Exception as raised:  # the bench says what, whatever a planted bug may raise
        bench.found.add(f"raised {type(raised).__name__}")
    for chip in bench.link.chips:
        bench.found |= {f"rule: {violation.rule}" for violation in chip.violations}
    return bench.found


class _Bench:
    def __init__(self, folder) -> None:
        self.found: set[str] = set()
        self.clock = Clock()
        self.link = ModelLink(self.clock, OSCILLATORS)
        settings = Pca9685Device.Settings(servos=written(folder, servo_file(OSCILLATORS, RATE_HZ)))
        self.device = Pca9685Device(settings, JOINTS, self.link)

    def from_power_up(self) -> None:
        self.device.open(self.clock)
        self.expect(not self._commits(), "pulses began when it was opened")
        for joint in JOINTS:
            self.device.energise(joint, 0.0)
            self.pulse(joint, 0.0)
        rises = sorted(self._rise(joint) for joint in JOINTS)
        self.expect(all(b - a > 1e-4 for a, b in pairwise(rises)), "pulses rise at once")

    def over_the_tables(self) -> None:
        told = 0.0
        for angle in ANGLES_DEG:
            self._forget()
            self.device.command(dict.fromkeys(JOINTS, angle * 0.017453292519943295))
            for joint in JOINTS:
                self.pulse(joint, angle)
                self.no_glitch(joint, told, angle)
            told = angle

    def opened_again(self) -> None:
        self._forget()
        self.device.close()
        self.device.open(self.clock)
        self.expect(not self._commits(), "pulses changed when it was opened again")
        self.expect(set(self.device.state().angles) == set(JOINTS), "pulses were not seen when it was opened again")

    def released(self) -> None:
        for joint in JOINTS:
            self.device.release(joint)
            self.expect(self._pin(joint) is None, "pulses went on when they were released")

    def from_a_sleep_that_can_be_restarted(self) -> None:
        """Another program put it to sleep while it had pulses: they must not come back by themselves."""
        self.device.energise("q1", 0.1)
        self.device.close()
        for chip in self.link.chips:
            chip.transaction(chip.address, bytes((0x00, 0x31)))
        self.clock.sleep(0.1)
        self._forget()
        self.device.open(self.clock)
        self.expect(self._pin("q1") is None, "pulses began when it was opened")
        self.device.energise("q1", 0.0)
        self.pulse("q1", 0.0)

    def from_always_on(self) -> None:
        """A channel that stands at always on, or at always off with counts beside it, is set like any other."""
        for joint, registers in {"q2": (0x1000, 0), "q3": (0, 0x1100)}.items():
            data = registers[0].to_bytes(2, "little") + registers[1].to_bytes(2, "little")
            self._chip(joint).transaction(self._chip(joint).address, bytes((6 + 4 * JOINTS.index(joint),)) + data)
            self.device.energise(joint, 0.0)
            self.pulse(joint, 0.0)

    def pulse(self, joint: str, angle_deg: float) -> None:
        pin, tick = self._pin(joint), self._chip(joint).period_s / 4096
        if pin is None:
            self.found.add("no pulse")
        elif abs(pin - asked_pulse_s(joint, angle_deg)) > tick / 2 + SLACK_S:
            self.found.add("wrong pulse")
        self.expect(abs(self._chip(joint).period_s * RATE_HZ - 1) < 0.005, "wrong rate")

    def no_glitch(self, joint: str, before_deg: float, after_deg: float) -> None:
        """Every pulse on the way is between the one before and the one after."""
        ends = sorted(asked_pulse_s(joint, angle) for angle in (before_deg, after_deg))
        for commit in self._chip(joint).commits:
            if commit.channel == JOINTS.index(joint):
                inside = commit.after is not None and ends[0] - 5e-6 <= commit.after <= ends[1] + 5e-6
                self.expect(inside, "a glitch")

    def expect(self, held: bool, otherwise: str) -> None:
        if not held:
            self.found.add(otherwise)

    def _chip(self, joint: str):
        return self.link.chips[JOINTS.index(joint) % len(OSCILLATORS)]

    def _pin(self, joint: str) -> float | None:
        return self._chip(joint).pulse_s(JOINTS.index(joint))

    def _rise(self, joint: str) -> float:
        chip = self._chip(joint)
        data = chip.read(chip.address, 6 + 4 * JOINTS.index(joint), 2)
        return (int.from_bytes(data, "little") & 0x0FFF) / 4096 * chip.period_s

    def _commits(self) -> list:
        return [commit for chip in self.link.chips for commit in chip.commits]

    def _forget(self) -> None:
        for chip in self.link.chips:
            chip.commits.clear()


# ---------------------------------------------------------------- bugs that drivers are known for


class PrescaleOffByOne(Chip):
    def __init__(self, link, clock, address, prescale) -> None:
        super().__init__(link, clock, address, prescale + 1)


class OscillatorSetAfterTheRate(Chip):
    def __init__(self, link, clock, address, prescale) -> None:
        super().__init__(link, clock, address, round(25e6 / (4096 * RATE_HZ)) - 1)


class ThesisFormula(Chip):
    def __init__(self, link, clock, address, prescale) -> None:
        super().__init__(link, clock, address, int(25e6 / (0.948 * (4096 * RATE_HZ - 1))))


class OneClockForAll(Chip):
    def __init__(self, link, clock, address, prescale) -> None:
        super().__init__(link, clock, address, round(OSCILLATORS[0] / (4096 * RATE_HZ)) - 1)


class RestartAssumedSet(Chip):
    def _set_up(self) -> None:
        super()._set_up()
        self._write(0x00, 0xA0)


class RestartWithoutEndingPulses(Chip):
    def _set_up(self) -> None:
        restart = self._read(0x00, 1)[0] & 0x80
        if not restart:
            super()._set_up()
            return
        self._write(0x00, 0x20)
        self._clock.sleep(0.0005)
        self._write(0x00, 0xA0)


class AwakeWhenPrescaled(Chip):
    def _write(self, register, value) -> None:
        if register == 0xFE:
            super()._write(0x00, 0x20)
        super()._write(register, value)


class AwakeWhenPrescaledAndUnchecked(AwakeWhenPrescaled):
    def _check_set_up(self) -> None:
        pass


class NoWaitForTheOscillator(Chip):
    def __init__(self, link, clock, address, prescale) -> None:
        class Hasty:
            def sleep(self, seconds) -> None:
                pass

        super().__init__(link, Hasty(), address, prescale)


class NoAutoIncrement(Chip):
    def _write(self, register, value) -> None:
        super()._write(register, value & ~0x20 if register == 0x00 else value)

    def _check_set_up(self) -> None:
        pass


class SeparateBytes(Chip):
    def set_channel(self, channel, wanted) -> None:
        for i, byte in enumerate(wanted.pack()):
            self._write(channel_register(channel) + i, byte)


class FullOffLeft(Chip):
    def set_channel(self, channel, wanted) -> None:
        stands = self.channels([channel])[channel]
        super().set_channel(channel, Channel(wanted.on, wanted.off | stands.off & 0x1000))


class FullOnLeft(Chip):
    """Off is made by full-off, and full-on is never taken back."""

    def set_channel(self, channel, wanted) -> None:
        stands = self.channels([channel])[channel]
        super().set_channel(channel, Channel(wanted.on | stands.on & 0x1000, wanted.off))


class AllAtOnce(Chip):
    def set_channel(self, channel, wanted) -> None:
        counts = (wanted.off - wanted.on) % 4096
        super().set_channel(channel, wanted if wanted.counts is None else Channel(0, counts))


CHIP_BUGS = {
    PrescaleOffByOne: {"wrong pulse", "wrong rate"},
    OscillatorSetAfterTheRate: {"wrong pulse", "wrong rate"},
    ThesisFormula: {"wrong pulse", "wrong rate"},
    OneClockForAll: {"wrong pulse", "wrong rate"},
    RestartAssumedSet: {"rule: RESTART was written while it is not set: it does nothing"},
    RestartWithoutEndingPulses: {"pulses began when it was opened"},
    AwakeWhenPrescaled: {"raised DeviceError"},
    AwakeWhenPrescaledAndUnchecked: {
        "wrong pulse",
        "rule: PRE_SCALE was written while the oscillator runs: it is ignored",
    },
    NoWaitForTheOscillator: {"rule: PWM registers were written within 500 us of the oscillator's start"},
    NoAutoIncrement: {"raised DeviceError"},
    SeparateBytes: {"a glitch"},
    FullOffLeft: {"no pulse"},
    FullOnLeft: {"wrong pulse"},
    AllAtOnce: {"pulses rise at once"},
}


def test_the_true_driver_passes(tmp_path):
    assert complaints(tmp_path) == set()


@pytest.mark.parametrize("bug", CHIP_BUGS, ids=lambda bug: bug.__name__)
def test_a_bug_of_the_chips_driver_is_caught(bug, tmp_path, monkeypatch):
    monkeypatch.setattr(armcal_pca9685.device, "Chip", bug)
    assert complaints(tmp_path) >= CHIP_BUGS[bug]


def test_pulses_counted_by_the_rate_that_was_asked_for_are_caught(tmp_path, monkeypatch):
    monkeypatch.setattr(PulseClock, "tick", property(lambda clock: 1 / (4096 * RATE_HZ)))
    assert "wrong pulse" in complaints(tmp_path)


def test_pulses_counted_by_another_boards_clock_are_caught(tmp_path, monkeypatch):
    monkeypatch.setattr(CalibratedServo, "clock", property(lambda servo: PulseClock(OSCILLATORS[0], servo.prescale)))
    assert "wrong pulse" in complaints(tmp_path)


def test_writing_what_does_not_read_back_is_an_error(tmp_path, monkeypatch):
    """A bus that loses every write to a channel is found out, not believed."""
    bench = _Bench(tmp_path)
    bench.device.open(bench.clock)
    write = bench.link.write
    bench.link.write = lambda address, data: None if 6 <= data[0] < 0x46 else write(address, data)
    with pytest.raises(DeviceError, match="written twice"):
        bench.device.energise("q1", 0.0)


def test_one_lost_write_is_mended(tmp_path):
    bench = _Bench(tmp_path)
    bench.device.open(bench.clock)
    bench.device.energise("q1", 0.0)
    write, lost = bench.link.write, []

    def lossy(address, data):
        if 6 <= data[0] < 0x46 and not lost:
            lost.append(data)
            return
        write(address, data)

    bench.link.write = lossy
    bench.device.command({"q1": 0.5})
    assert lost
    assert abs(bench._pin("q1") - asked_pulse_s("q1", 28.64788975654116)) < 3e-6
