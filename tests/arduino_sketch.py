"""The Arduino sketch of the docs, compiled against a stand-in for Arduino's libraries: a board at a simulated bus."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

from tests.simulated_lines.pca9685_model import BusStuckError, I2cBus

PAGE = Path(__file__).resolve().parents[1] / "docs" / "arduino.md"
STAND_IN = r"""
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <string>
using std::abs; using std::lround;
#define LOW 0
#define SDA 18
#define SCL 19
typedef int (*Write)(int, const uint8_t *, int);
typedef int (*Read)(int, int, int, uint8_t *);
typedef int (*Line)();
static Write busWrite; static Read busRead; static Line busStuck;
static unsigned long nowMs; static uint32_t kept;
static std::string sent; static std::deque<uint8_t> waiting;
uint32_t millis() { return uint32_t(nowMs); }
int digitalRead(int) { return !busStuck(); }
struct {
  void begin(uint32_t) {}
  int available() { return int(waiting.size()); }
  int read() { int byte = waiting.front(); waiting.pop_front(); return byte; }
  void write(uint8_t byte) { sent.push_back(char(byte)); }
  void write(const uint8_t *data, size_t count) { sent.append((const char *)data, count); }
} Serial;
struct {
  int address, first, place; std::string data; uint8_t read_[32];
  void begin() {}
  void beginTransmission(int to) { address = to; data.clear(); }
  void write(uint8_t byte) { data.push_back(char(byte)); }
  void write(const uint8_t *from, size_t count) { data.append((const char *)from, count); }
  uint8_t endTransmission(bool stop = true) {
    if (stop) return uint8_t(busWrite(address, (const uint8_t *)data.data(), int(data.size())));
    first = uint8_t(data[0]);
    return 0;
  }
  uint8_t requestFrom(int from, int count) { place = 0; return uint8_t(busRead(from, first, count, read_)); }
  int read() { return read_[place++]; }
} Wire;
struct {
  void get(int, uint32_t &value) { value = kept; }
  void put(int, const uint32_t &value) { kept = value; }
} EEPROM;
"""
INTERFACE = r"""
extern "C" void start(Write write, Read read, Line line, uint32_t boots) {
  busWrite = write; busRead = read; busStuck = line; kept = boots; setup();
}
extern "C" int turn(unsigned long now, const uint8_t *data, int count, uint8_t *out) {
  nowMs = now; sent.clear(); waiting.insert(waiting.end(), data, data + count); loop();
  std::memcpy(out, sent.data(), sent.size());
  return int(sent.size());
}
"""
_WRITE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.POINTER(ctypes.c_uint8), ctypes.c_int)
_READ = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.POINTER(ctypes.c_uint8))
_LINE = ctypes.CFUNCTYPE(ctypes.c_int)


def compiled(folder: Path) -> Path | None:
    """A library of the page's sketch with the identity of the test vectors; None without a compiler."""
    compiler = shutil.which("g++")
    if compiler is None:
        return None
    (sketch,) = re.findall(r"```text\n(#include .*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    identity = {'"ARM-1"': '"LRM-1"', '"armcal sketch 1"': '"test"', "OSCILLATOR_HZ = 0": "OSCILLATOR_HZ = 25000000"}
    for a, b in identity.items():
        assert a in sketch
        sketch = sketch.replace(a, b)
    sketch = re.sub(r"#include <\w+\.h>\n", "", sketch)
    source, library = folder / "sketch.cpp", folder / "sketch.so"
    source.write_text(STAND_IN + sketch + INTERFACE, encoding="utf-8")
    flags = ("-std=c++11", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC")
    subprocess.run([compiler, *flags, str(source), "-o", str(library)], check=True)
    return library


class SketchBoard:
    """As ``FramedBoard``; each start is a fresh copy of the library, whose memory is empty."""

    delimiter = 0
    _copies = 0

    def __init__(
        self, library: Path, clock: Callable[[], float], bus: I2cBus, send: Callable[[bytes], None], boots: int = 0
    ) -> None:
        self.boots = boots
        self._library, self._clock, self._bus, self._send = library, clock, bus, send
        self._calls = (_WRITE(self._written), _READ(self._read), _LINE(lambda: int(bus.stuck)))
        self._out = (ctypes.c_uint8 * 4096)()

    def boot(self) -> None:
        SketchBoard._copies += 1
        copy = self._library.with_name(f"copy{SketchBoard._copies}.so")
        shutil.copy(self._library, copy)
        self._running = ctypes.CDLL(str(copy))
        copy.unlink()
        self._running.start(*self._calls, self.boots)
        self.boots += 1

    def receive(self, data: bytes) -> None:
        count = self._running.turn(self._ms(), data, len(data), self._out)
        if count:
            self._send(bytes(self._out[:count]))

    def next_event(self) -> float:
        return (self._ms() + 1) / 1000

    def run_timers(self) -> None:
        self.receive(b"")

    def _ms(self) -> int:
        return int(1000 * self._clock() + 1e-6)

    def _written(self, address: int, data: ctypes._Pointer[ctypes.c_uint8], count: int) -> int:
        try:
            acknowledged = self._bus.write(address, bytes(data[:count]))
        except BusStuckError:
            return 4
        return 2 if acknowledged == 0 else 3 if acknowledged <= count else 0

    def _read(self, address: int, register: int, count: int, out: ctypes._Pointer[ctypes.c_uint8]) -> int:
        try:
            data = self._bus.read(address, register, count) or b""
        except BusStuckError:
            data = b""
        for i, byte in enumerate(data):
            out[i] = byte
        return len(data)
