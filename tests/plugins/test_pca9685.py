"""The device ``pca9685`` on a link that loses nothing: pulses at the pins, identity, what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from armcal.arm.servo import PulseClock, PulseTable, quantised
from armcal.config.servo_file import ServoFile
from armcal.devices.device import (
    DeviceError,
    DeviceLostError,
    DeviceRefusedError,
    DeviceResetError,
    JointDevice,
    PulseDevice,
)
from armcal.errors import ConfigError, PluginError
from armcal_pca9685.device import Pca9685Device
from board_bench import JOINTS, LRM_PULSES_US, Clock, ModelLink, servo_file, written


def opened(folder, oscillators=(25e6,), rate_hz=50.0, true=None, **settings):
    clock = Clock()
    link = ModelLink(clock, true or oscillators)
    file = written(folder, servo_file(oscillators, rate_hz))
    device = Pca9685Device(Pca9685Device.Settings(servos=file, **settings), JOINTS, link)
    device.open(clock)
    return device, link, clock


def test_a_link_that_returns_too_few_bytes_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(ModelLink, "read", lambda self, *given: b"")
    with pytest.raises(PluginError, match=r"test_pca9685.py:\d+: .*returned 0 bytes, expected 1 bytes"):
        opened(tmp_path)


def test_it_is_what_it_says(tmp_path):
    device, _, _ = opened(tmp_path)
    for protocol in (JointDevice, PulseDevice):
        for name in [n for n in vars(protocol) if not n.startswith("_")]:
            assert hasattr(device, name), name


@pytest.mark.parametrize("oscillator_hz", np.linspace(23e6, 27e6, 9).tolist())
@pytest.mark.parametrize("rate_hz", [50.0, 60.0])
def test_pulses_at_the_pins_over_whole_tables(tmp_path, oscillator_hz, rate_hz):
    """Within half a count and 0.1 us of what was asked, by the true oscillator."""
    device, link, _ = opened(tmp_path, (oscillator_hz,), rate_hz)
    chip = link.chips[0]
    count = chip.period_s / 4096
    worst = 0.0
    for joint in JOINTS:
        device.energise(joint, 0.0)
    for degrees in np.linspace(-100, 100, 81):
        device.command(dict.fromkeys(JOINTS, math.radians(degrees)))
        for channel, joint in enumerate(JOINTS):
            asked = np.interp(degrees, [-100, 0, 100], LRM_PULSES_US[joint]) * 1e-6
            worst = max(worst, abs(chip.pulse_s(channel) - asked))
    assert worst <= count / 2 + 1e-7
    assert worst > 0.4 * count  # it was looked at closely enough to see the rounding
    assert not chip.violations


def test_any_pulse_that_the_servo_bears_can_be_set_and_no_other(tmp_path):
    device, link, _ = opened(tmp_path, (26.3e6,))
    chip = link.chips[0]
    for pulse in (0.303e-3, 0.5e-3, 1.5e-3, 2.1e-3, 2.797e-3):
        for channel, joint in enumerate(JOINTS):
            told = device.set_pulse(joint, pulse)
            assert told == pytest.approx(chip.pulse_s(channel), rel=1e-12)
            assert abs(told - pulse) <= chip.period_s / 8192 + 1e-7
    assert not chip.violations
    for pulse in (0.0, -1e-3, 172.7e-6, 0.297e-3, 2.803e-3, 0.0201, math.nan, math.inf):
        with pytest.raises(DeviceRefusedError, match="pulse"):
            device.set_pulse("q1", pulse)


def test_angles_are_those_of_the_quantised_model(tmp_path):
    oscillators = (24.3e6, 25.9e6)
    device, _, _ = opened(tmp_path, oscillators)
    for joint in JOINTS:
        device.energise(joint, 0.0)
    random = np.random.default_rng(3)
    for _ in range(50):
        angles = {joint: float(random.uniform(-1.7, 1.7)) for joint in JOINTS}
        device.command(angles)
        state = device.state().angles
        assert state == device.standing(angles)
        for i, (joint, angle) in enumerate(angles.items()):
            hz = oscillators[i % 2]
            clock = PulseClock(hz, round(hz / 204800) - 1)
            table = PulseTable(
                tuple(math.radians(a) for a in (-100, 0, 100)), tuple(p / 1e6 for p in LRM_PULSES_US[joint])
            )
            assert state[joint] == pytest.approx(float(quantised(angle, table, clock)), abs=1e-13)


def test_what_stands_can_be_commanded_again_at_the_ends_too(tmp_path):
    device, link, _ = opened(tmp_path, (25.37e6,))
    ends = dict.fromkeys(JOINTS, math.radians(100))
    for joint in JOINTS:
        device.energise(joint, ends[joint])
    for sign in (1, -1):
        standing = device.standing({joint: sign * angle for joint, angle in ends.items()})
        device.command(standing)
        before = [link.chips[0].pulse_s(i) for i in range(len(JOINTS))]
        device.command(device.standing(standing))
        assert [link.chips[0].pulse_s(i) for i in range(len(JOINTS))] == before


@pytest.mark.parametrize("oscillator_hz", [23.7e6, 25e6, 26.3e6])
def test_the_nearest_count_is_never_one_that_the_servo_does_not_bear(tmp_path, oscillator_hz):
    """Tables that end where the range does: half a count beyond is beyond."""
    file = servo_file((oscillator_hz,))
    ends = {joint: (servo.pulses[0], servo.pulses[-1]) for joint, servo in file.servos.items()}
    borne = {j: type(s).si(**{**s.model_dump(), "pulse_range": ends[j]}) for j, s in file.servos.items()}
    clock = Clock()
    link = ModelLink(clock, (oscillator_hz,))
    settings = Pca9685Device.Settings(servos=written(tmp_path, ServoFile(file.boards, borne)))
    device = Pca9685Device(settings, JOINTS, link)
    device.open(clock)
    for angle in np.radians([-100, 100]):
        for channel, joint in enumerate(JOINTS):
            device.energise(joint, float(angle))
            assert ends[joint][0] - 1e-12 <= link.chips[0].pulse_s(channel) <= ends[joint][1] + 1e-12
            with pytest.raises(DeviceRefusedError, match=f"pulse of .* for {joint}, .* the pulse range of its servo"):
                device.set_pulse(joint, ends[joint][1] + 5e-6)


def test_outside_a_table_is_refused_and_nothing_moves(tmp_path):
    device, link, _ = opened(tmp_path)
    for joint in JOINTS:
        device.energise(joint, 0.0)
    before = len(link.written)
    for angle in (1.8, -1.8, math.nan, math.inf):
        with pytest.raises(DeviceRefusedError, match=r"q3.*-100 to 100 deg"):
            device.command({"q1": 0.1, "q3": angle})
        with pytest.raises(DeviceRefusedError):
            device.standing({"q3": angle})
    assert len(link.written) == before


def test_a_joint_that_hangs_free_is_not_commanded(tmp_path):
    device, link, _ = opened(tmp_path)
    device.energise("q1", 0.0)
    before = len(link.written)
    with pytest.raises(DeviceRefusedError, match=r"q2.*hang free"):
        device.command({"q1": 0.1, "q2": 0.1})
    assert len(link.written) == before
    device.release("q1")
    assert device.state().angles == {}
    with pytest.raises(DeviceRefusedError, match="hang free"):
        device.command({"q1": 0.1})


def test_a_host_that_comes_back_changes_nothing(tmp_path):
    device, link, clock = opened(tmp_path)
    for joint in JOINTS:
        device.energise(joint, 0.3)
    standing, link.written = device.state().angles, []
    again = Pca9685Device(Pca9685Device.Settings(servos=tmp_path / "servos.yaml"), JOINTS, link)
    again.open(clock)
    assert link.written == []
    assert again.state().angles == standing
    again.command(dict.fromkeys(JOINTS, 0.31))  # energised before, so it may be commanded at once


def test_pulses_of_another_set_up_are_refused_unless_they_may_be_ended(tmp_path):
    device, link, clock = opened(tmp_path)
    device.energise("q1", 0.3)
    other = written(tmp_path, servo_file((27e6,)))
    before = link.chips[0].pulse_s(0)
    with pytest.raises(DeviceRefusedError, match="expected prescale 131"):
        Pca9685Device(Pca9685Device.Settings(servos=other), JOINTS, link).open(clock)
    assert link.chips[0].pulse_s(0) == before
    ends = Pca9685Device(Pca9685Device.Settings(servos=other, foreign_pulses="end"), JOINTS, link)
    ends.open(clock)
    assert link.chips[0].pulse_s(0) is None and ends.state().angles == {}
    assert link.chips[0].period_s == pytest.approx(4096 * 132 / 25e6)
    assert not link.chips[0].violations


@pytest.mark.parametrize("mode1", range(0x00, 0x40, 0x05))
@pytest.mark.parametrize("mode2", [0x00, 0x04, 0x0C, 0x14])
def test_it_is_set_up_from_whatever_state_it_is_in(tmp_path, mode1, mode2):
    clock = Clock()
    link = ModelLink(clock)
    chip = link.chips[0]
    chip.transaction(0x40, bytes((0x00, 0x10)))
    chip.transaction(0x40, bytes((0xFE, 200)))
    chip.transaction(0x40, bytes((0x01, mode2)))
    chip.transaction(0x40, bytes((0x00, mode1)))
    clock.sleep(0.1)
    device = Pca9685Device(Pca9685Device.Settings(servos=written(tmp_path, servo_file())), JOINTS, link)
    device.open(clock)
    device.energise("q2", 0.0)
    assert chip.pulse_s(1) == pytest.approx(1550e-6, abs=2.6e-6)
    assert chip.read(0x40, 0x00, 2) == b"\x20\x04" and not chip.violations


def test_an_external_clock_is_refused(tmp_path):
    clock = Clock()
    link = ModelLink(clock)
    link.chips[0].transaction(0x40, bytes((0x00, 0x10)))
    link.chips[0].transaction(0x40, bytes((0x00, 0x50)))
    device = Pca9685Device(Pca9685Device.Settings(servos=written(tmp_path, servo_file())), JOINTS, link)
    with pytest.raises(DeviceRefusedError, match="external clock"):
        device.open(clock)


def test_a_brown_out_is_noticed(tmp_path):
    device, link, clock = opened(tmp_path)
    device.energise("q1", 0.0)
    device.keep_alive()
    link.chips[0].power_cycle()
    with pytest.raises(DeviceResetError, match="forgotten"):
        device.keep_alive()
    device.open(clock)
    assert device.state().angles == {}
    device.energise("q1", 0.0)
    assert link.chips[0].pulse_s(0) == pytest.approx(1540e-6, abs=2.6e-6)


@pytest.mark.parametrize("kept", ["", "A5069RR4"])
@pytest.mark.parametrize("found", ["", "A5069RR4", "OTHER"])
def test_another_board_is_refused_before_anything_is_written(tmp_path, kept, found):
    clock = Clock()
    link = ModelLink(clock, adapter=found)
    file = written(tmp_path, servo_file(ids=(kept,)))
    device = Pca9685Device(Pca9685Device.Settings(servos=file), JOINTS, link)
    if kept and found and kept != found:
        with pytest.raises(DeviceRefusedError, match=r"boards\.b0\.id.*'OTHER'.*'A5069RR4'"):
            device.open(clock)
        assert link.written == []
    else:
        assert device.open(clock).digest


def test_the_digest_changes_with_all_that_a_calibration_hangs_on(tmp_path):
    digests = set()
    files = [
        servo_file(),
        servo_file((25.0001e6,)),
        servo_file(rate_hz=60.0),
        servo_file(ids=("A",)),
        servo_file((25e6, 25e6)),
    ]
    for file in files:
        clock = Clock()
        device = Pca9685Device(
            Pca9685Device.Settings(servos=written(tmp_path, file)), JOINTS, ModelLink(clock, (25e6,) * len(file.boards))
        )
        digests.add(device.open(clock).digest)
        assert device.open(clock).digest in digests
    assert len(digests) == len(files)


def test_a_joint_without_a_servo_is_refused(tmp_path):
    file = written(tmp_path, servo_file())
    with pytest.raises(ValueError, match=r"no servo elbow; it has q1"):
        Pca9685Device(Pca9685Device.Settings(servos=file), ("q1", "elbow"), ModelLink(Clock()))
    with pytest.raises(ConfigError):
        Pca9685Device(Pca9685Device.Settings(servos=tmp_path / "none.yaml"), JOINTS, ModelLink(Clock()))


def test_a_closed_device_does_nothing(tmp_path):
    device, _, _ = opened(tmp_path)
    device.energise("q1", 0.0)
    device.close()
    device.close()
    for call in (device.state, device.keep_alive, lambda: device.energise("q1", 0.0), lambda: device.release("q1")):
        with pytest.raises(DeviceLostError):
            call()


def test_readings_that_differ_are_read_again(tmp_path):
    device, link, _ = opened(tmp_path)
    device.energise("q1", 0.2)
    standing, read, harmed = device.state().angles, link.read, []

    def once(address, register, count):
        data = read(address, register, count)
        if not harmed:
            harmed.append(data)
            return bytes((data[0], data[1], data[2] ^ 0x40, *data[3:]))
        return data

    link.read = once
    assert device.state().angles == standing
    random = np.random.default_rng(0)
    link.read = lambda address, register, count: random.bytes(count)
    with pytest.raises(DeviceError, match="differently each time"):
        device.state()
