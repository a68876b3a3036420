"""Serial ports over real ptys: alone on it, unplugged, plugged in under another name, full, and what cannot be set."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import termios
import tty

import pytest
import serial
from armcal.base.config_text import ConfigText
from armcal.devices.device import DeviceLostError, DeviceRefusedError
from armcal.devices.serial_port import SerialPort, SerialPortSettings
from pydantic import ValidationError
from serial.tools import list_ports


class Pty:
    """A pty under a symlink, which moves when it is plugged in anew."""

    def __init__(self, folder) -> None:
        self.path = folder / "board"
        self.master = -1
        self.plug()

    def plug(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.name = os.ttyname(slave)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(self.name)
        self.slave = slave

    def unplug(self) -> None:
        os.close(self.slave)
        os.close(self.master)


@pytest.fixture
def pty(tmp_path):
    return Pty(tmp_path)


def port_at(path, **more) -> SerialPort:
    return SerialPort(SerialPortSettings(port=path, **more))


def test_bytes_go_both_ways_at_any_baud(pty):
    for baud in (57_600, 115_200, 921_600):
        port = port_at(pty.path, baud=baud)
        assert port.open() == ""
        everything = bytes(range(256))
        port.write(everything)
        assert os.read(pty.master, 1000) == everything
        os.write(pty.master, everything)
        assert port.read(1.0) == everything
        assert port.read(0.0) == b""
        port.close()


def test_a_second_opener_is_told_who_and_what_to_do(pty):
    first, second = port_at(pty.path), port_at(pty.name)
    first.open()
    with pytest.raises(DeviceRefusedError, match=r"another program has this serial port.*fuser") as raised:
        second.open()
    assert raised.value.exit_code == 2
    code = f"import serial; serial.Serial({str(pty.path)!r}, exclusive=True)"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert other.returncode and "exclusively lock" in other.stderr
    first.close()
    second.open()


def test_a_port_that_another_program_has_is_refused(pty):
    holder = serial.Serial(pty.name, exclusive=True)
    with pytest.raises(DeviceRefusedError, match="another program"):
        port_at(pty.path).open()
    holder.close()
    port_at(pty.path).open()


def test_unplugged_while_it_reads_or_writes(pty):
    port = port_at(pty.path)
    port.open()
    pty.unplug()
    with pytest.raises(DeviceLostError):
        port.read(1.0)
    with pytest.raises(DeviceLostError, match="not open"):
        port.write(b"x")
    pty.plug()
    port.open()
    pty.unplug()
    with pytest.raises(DeviceLostError):
        for _ in range(3):
            port.write(b"x" * 100)


def test_plugged_in_again_under_another_name(pty):
    port = port_at(pty.path)
    port.open()
    before = pty.name
    taken = os.openpty()  # so that the next one has another number
    pty.unplug()
    with pytest.raises(DeviceLostError):
        port.open()  # the link leads to what is gone
    pty.path.unlink()
    with pytest.raises(DeviceLostError):
        port.open()  # and now there is none
    other = os.openpty()
    pty.plug()
    assert pty.name != before or other
    port.open()
    port.write(b"again")
    assert os.read(pty.master, 10) == b"again"
    for handle in (*taken, *other):
        os.close(handle)


@pytest.mark.slow
def test_a_full_port_is_lost_and_does_not_block_for_ever(pty):
    port = port_at(pty.path)
    port.open()
    with pytest.raises(DeviceLostError, match="takes no more"):
        port.write(b"x" * (1 << 20))


def test_much_is_written_when_somebody_reads(pty, tmp_path):
    port = port_at(pty.path)
    port.open()
    reader = "import os, sys\nn = 0\nwhile n < 1 << 20:\n    n += len(os.read(0, 1 << 16))"
    with subprocess.Popen([sys.executable, "-c", reader], stdin=pty.master) as process:
        port.write(b"x" * (1 << 20))
        assert process.wait(30) == 0


@pytest.mark.parametrize("number", [errno.ENOTTY, errno.EINVAL])
def test_what_a_pty_cannot_do_is_survived(pty, monkeypatch, number):
    """Modem lines are no business of a pty: kernels say ENOTTY or EINVAL."""
    real, modem = fcntl.ioctl, (termios.TIOCMBIS, termios.TIOCMBIC, termios.TIOCMGET, termios.TIOCMSET)
    seen = []

    def refusing(handle, request, *more):
        if request in modem:
            seen.append(request)
            raise OSError(number, os.strerror(number))
        return real(handle, request, *more)

    monkeypatch.setattr(fcntl, "ioctl", refusing)
    port = port_at(pty.path)
    port.open()
    port.write(b"x")
    assert os.read(pty.master, 10) == b"x"


def test_parity_is_left_alone(pty):
    before = termios.tcgetattr(pty.slave)[2] & (termios.PARENB | termios.PARODD)
    port_at(pty.path).open()
    assert termios.tcgetattr(pty.slave)[2] & (termios.PARENB | termios.PARODD) == before == 0


def test_ports_that_are_none(tmp_path):
    with pytest.raises(DeviceRefusedError, match="no such serial port"):
        port_at(tmp_path / "none").open()
    (tmp_path / "file").write_text("x")
    for path in (tmp_path, tmp_path / "file", "/dev/null"):
        with pytest.raises(DeviceRefusedError, match="cannot be opened"):
            port_at(path).open()


class Listed:
    def __init__(self, device, serial_number) -> None:
        self.device, self.serial_number = device, serial_number


def test_the_serial_number_of_a_port_by_path(pty, monkeypatch):
    monkeypatch.setattr(list_ports, "comports", lambda: [Listed(pty.name, "A1")])
    assert port_at(pty.path).open() == "A1"


def test_settings():
    for bad in (
        {},
        {"port": " "},
        {"port": "loop://"},
        {"port": "a", "baud": 1},
    ):
        with pytest.raises(ValidationError):
            SerialPortSettings.model_validate(bad)
    kept = SerialPortSettings.model_validate({"port": "/dev/ttyACM0"})
    assert SerialPortSettings.model_validate(kept.to_config()) == kept


def test_a_relative_path_is_the_config_files_and_links_stay(pty):
    text = ConfigText("board", None, pty.path.parent, pty.path.parent)
    assert SerialPortSettings.model_validate({"port": text}).port == pty.path
