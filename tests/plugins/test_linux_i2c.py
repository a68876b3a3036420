"""The link ``linux_i2c``, on a stand-in for its library that does what smbus2 documents."""

from __future__ import annotations

import errno
import os
import sys
import types

import pytest
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError
from armcal.errors import PluginError
from armcal_pca9685.device import Pca9685Device
from armcal_pca9685.links import LinuxI2cLink
from board_bench import JOINTS, Clock, ModelLink, servo_file, written


class Message:
    def __init__(self, address, data, count) -> None:
        self.address, self.data, self.count = address, bytes(data), count

    @staticmethod
    def write(address, data):
        return Message(address, data, None)

    @staticmethod
    def read(address, count):
        return Message(address, b"", count)

    def __iter__(self):
        return iter(self.data)


@pytest.fixture
def library(monkeypatch, tmp_path):
    """smbus2 with a model behind it; ``fault`` is raised once for each errno in it."""
    made = types.ModuleType("smbus2")
    made.clock, made.faults, made.files = Clock(), [], tmp_path
    made.link = ModelLink(made.clock)

    class SMBus:
        def __init__(self, path) -> None:
            if made.faults and made.faults[0] in (errno.ENOENT, errno.EACCES):
                raise OSError(made.faults.pop(0), "cannot open")
            made.path = path
            self.fd = os.open(tmp_path / "bus", os.O_RDWR | os.O_CREAT)

        def i2c_rdwr(self, *messages) -> None:
            if made.faults:
                raise OSError(made.faults.pop(0), "failed")
            if len(messages) == 1:
                made.link.write(messages[0].address, messages[0].data)
            else:
                register, wanted = messages
                wanted.data = made.link.read(wanted.address, register.data[0], wanted.count)

        def close(self) -> None:
            os.close(self.fd)

    made.SMBus, made.i2c_msg = SMBus, Message
    monkeypatch.setitem(sys.modules, "smbus2", made)
    return made


def test_the_driver_works_over_it(library, tmp_path):
    link = LinuxI2cLink(LinuxI2cLink.Settings(bus=7))
    device = Pca9685Device(Pca9685Device.Settings(servos=written(tmp_path, servo_file())), JOINTS, link)
    device.open(library.clock)
    device.energise("q1", 0.0)
    assert library.path == "/dev/i2c-7"
    assert library.link.chips[0].pulse_s(0) == pytest.approx(1540e-6, abs=2.6e-6)
    assert not device.guard([{"q1": 0.0}], 0.3, 1.0)
    device.close()


def test_faults_become_sentences(library):
    link = LinuxI2cLink(LinuxI2cLink.Settings())
    with pytest.raises(DeviceLostError, match="not open"):
        link.read(0x40, 0, 1)
    link.open(library.clock)
    library.faults = [errno.EREMOTEIO, errno.EREMOTEIO]
    assert link.read(0x40, 0, 1) == b"\x11"
    library.faults = [errno.EREMOTEIO] * 3
    with pytest.raises(DeviceError, match="0x41 does not answer"):
        link.write(0x41, b"\0\0")
    library.faults = [errno.ENODEV]
    with pytest.raises(DeviceLostError, match="gone"):
        link.write(0x40, b"\0\0")
    library.faults = [errno.ENOENT]
    with pytest.raises(DeviceRefusedError, match="no such I2C bus"):
        link.open(library.clock)
    library.faults = [errno.EACCES]
    with pytest.raises(DeviceRefusedError, match="may not be opened"):
        link.open(library.clock)


def test_one_program_at_a_time(library):
    first, second = (LinuxI2cLink(LinuxI2cLink.Settings()) for _ in range(2))
    first.open(library.clock)
    with pytest.raises(DeviceRefusedError, match="another program"):
        second.open(library.clock)
    first.close()
    first.close()
    second.open(library.clock)
    second.close()


def test_a_missing_library_is_a_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "smbus2", None)
    with pytest.raises(PluginError, match=r"armcal\[i2c\]") as raised:
        LinuxI2cLink(LinuxI2cLink.Settings()).open(Clock())
    assert raised.value.exit_code == 2
