"""What authors of boards, trackers and streams do wrong while an arm is measured: the arm is safe, nothing is lost."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from armcal import plugins
from armcal.cli.main import cli
from armcal.io.journal import KeptJournal, has_journal
from armcal_bench.bench import Bench

from tests.bench_fakes import FakeClock

PLUGIN = '''"""A bench whose arm is kept by the clock, since it outlives each program."""

import math

import numpy as np
from armcal import Settings, hookimpl
from armcal.devices.device import DeviceIdentity, DeviceState
from armcal.devices.live import JointSample, Shot, TrackerFrame


class D:
    Settings = Settings
    joint_names = ("a", "b")

    def __init__(self, settings, joint_names, link):
        self.clock = None

    def open(self, clock):
        self.clock = clock
        return DeviceIdentity("mine", "d1")

    def state(self):
        return DeviceState(dict(self.clock.arm))

    def standing(self, angles):
        return dict(angles)

    def energise(self, joint, angle):
        self.clock.arm[joint] = angle

    def command(self, angles):
        self.clock.arm.update(angles)

    def keep_alive(self):
        pass

    def guard(self, waypoints, rate, after_s):
        return True

    def measured(self):
        return {joint: self.clock.arm.get(joint, 0.0) for joint in self.joint_names}

    def set_pulse(self, joint, pulse):
        self.clock.arm[joint] = (pulse - 1.5e-3) * math.radians(100) / 0.9e-3
        return pulse

    def release(self, joint):
        self.clock.let_go.append(self.clock.arm.pop(joint))

    def close(self):
        pass


class T:
    Settings = Settings
    refused = {}

    def __init__(self, settings):
        self.clock, self.count = None, 0

    def open(self, clock):
        self.clock, self.next = clock, clock.now()

    def frames(self):
        frames = []
        while self.next <= self.clock.now():
            self.count, self.next = self.count + 1, self.next + 0.05
            frames.append(TrackerFrame(self.count, self.next - 0.05, None, {"tool": self.seen()}))
        return frames

    def seen(self):
        a, b = (self.clock.arm.get(joint, 0.0) for joint in "ab")
        pose, turn = np.eye(4), a + b
        pose[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
        pose[:2, 3] = 0.3 * math.cos(a) + 0.2 * math.cos(turn), 0.3 * math.sin(a) + 0.2 * math.sin(turn)
        pose[2, 3] = 1e-6 * math.sin(self.count)
        return pose

    def close(self):
        pass


class J:
    Settings = Settings
    refused = {}

    def __init__(self, settings):
        self.clock = None

    def open(self, clock, channels):
        self.clock, self.channels = clock, channels

    @property
    def ended(self):
        return self.clock.now() > 20

    def samples(self):
        angles = {name: 0.2 * (self.clock.now() // 4) for name in self.channels}
        return [JointSample(self.clock.now(), None, angles, {"plane": "table"})]

    def close(self):
        pass


class C:
    Settings = Settings
    measurement, gives_shots = "touch", False

    def __init__(self, settings):
        self.clock = None

    def open(self, clock, measurements):
        self.clock = clock

    def shots(self):
        return []

    def shoot(self):
        return Shot(b"image", ".png", "a board")

    def close(self):
        pass


def late(part):
    return part.clock is not None and part.clock.now() > part.clock.late


@hookimpl
def armcal_register_devices(register):
    register("mine", D, "")


@hookimpl
def armcal_register_trackers(register):
    register("mine", T, "")


@hookimpl
def armcal_register_joint_streams(register):
    register("mine", J, "")


@hookimpl
def armcal_register_cameras(register):
    register("mine", C, "")
'''
CONFIG = """
arms: {arm: {model: {type: mdh, joints: [a, b], convention: standard, rows: [{a_mm: 300}, {a_mm: 200}]}}}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
measurements: {%s}
plan: {limits: {a: [-80 deg, 80 deg], b: [-80 deg, 80 deg]}}
bench:
  device: {type: mine}
  tracker: {type: mine}
  joints: {type: mine}
  camera: {type: mine}
  acquisition: {period_s: 0.05, rate_deg_per_s: 40, settle: {longest_s: 5}}
  servo: {servos: servos.yaml, joints: [a], period_s: 0.05, step_deg: 30, ranges: {a: [-30 deg, 30 deg]}}
"""
SERVOS = """
boards: {only: {address: 0x40, oscillator_hz: 25000000.0, rate_hz: 50.0}}
servos:
  a: {board: only, channel: 0, angles_deg: [-100.0, 0.0, 100.0], pulses_us: [600.0, 1500.0, 2400.0]}
  b: {board: only, channel: 1, angles_deg: [-100.0, 0.0, 100.0], pulses_us: [600.0, 1500.0, 2400.0]}
"""
TIP, TOUCH = "tip: {type: tip_position, noise_mm: 0.1}", "touch: {type: plane_contact, noise_mm: 0.1}"
PLAN = "pose_id,a_deg,b_deg\np1,20,10\np2,-20,30\np3,10,-40\n"
FRAME = "TrackerFrame(1, 0.0, None, {'tool': %s})"
SAMPLE = "return [JointSample(%s)]"

ACQUIRE = {  # the method, what it does from the second pose on, and what the sentence says
    "no state": ("D.state", "pass; return", "returned None, expected a DeviceState"),
    "a mapping": ("D.state", "return self.clock.arm", "returned .'a': .*, expected a DeviceState"),
    "no angles": ("D.state", "return DeviceState(None)", "returned None, expected finite angles .rad. of some of a, b"),
    "NaN": ("D.state", "return DeviceState({'a': math.nan})", "returned ..a.: nan., expected finite angles"),
    "other joints": ("D.state", "return DeviceState({'x': 0.0})", "returned ..x.: 0.0., expected finite angles .rad. "),
    "a fault": ("D.state", "return self.nothing", "raised AttributeError: 'D' object has no attribute 'nothing'"),
    "no angle": ("D.standing", "return", "returned None, expected finite angles .rad. of all of a, b"),
    "a list": ("D.standing", "return [0.0, 0.0]", "returned .0.0, 0.0., expected finite angles"),
    "texts": ("D.standing", "return {'a': '1', 'b': '2'}", "returned ..a.: .1., 'b': '2'., expected finite"),
    "one joint": ("D.standing", "return {'a': 0.0}", "returned ..a.: 0.0., expected finite angles .rad. of all of a, "),
    "division": ("D.command", "1 / 0", "raised ZeroDivisionError: division by zero. To check it by itself"),
    "an exit": ("D.command", "exit('bye')", "raised SystemExit: bye. To check it by itself"),
    "a key": ("D.keep_alive", "self.clock.arm['x']", "raised KeyError: 'x'"),
    "an end": ("D.keep_alive", "raise SystemExit(0)", "raised SystemExit: 0"),
    "a guard": ("D.guard", "len(rate)", "raised TypeError: object of type 'float' has no len"),
    "encoders": ("D.measured", "return {'a': 0.0}", "returned ..a.: 0.0., expected finite angles .rad. of all of a, b"),
    "no encoder": ("D.measured", "return", "returned None, expected finite angles .rad. of all of a, b"),
    "let go": ("D.release", "int('x')", "raised ValueError: invalid literal for int.. with base 10: 'x'"),
    "close": ("D.close", "self.port.close()", "raised AttributeError: 'D' object has no attribute 'port'"),
    "no frames": ("T.frames", "return", "returned None, expected a list of TrackerFrame"),
    "one frame": ("T.frames", f"return {FRAME % None}", "returned TrackerFrame.*, expected a list of TrackerFrame"),
    "tuples": ("T.frames", "return [(1, 2)]", "returned ..1, 2.., expected a list of TrackerF"),
    "positions": ("T.frames", f"return [{FRAME % 'np.zeros(3)'}]", "returned 'tool' of the shape .3,.: .*, expected w"),
    "rows": ("T.frames", f"return [{FRAME % 'np.eye(4).tolist()'}]", "returned list .*'shape'., expected a list of Tr"),
    "unseen": ("T.frames", f"return [{FRAME % 'np.full((4, 4), np.nan)'}]", "returned 'tool' of the shape .4, 4.: ..n"),
    "no time": ("T.frames", "return [TrackerFrame(1, None, None)]", "returned .*arrived=None, .*, expected a list of "),
    "no bodies": ("T.frames", "return [TrackerFrame(1, 0.0, None, [])]", "returned .*bodies=...., expected a list of "),
    "a counter": ("T.frames", "return [TrackerFrame('1', 0.0, None)]", "returned .*counter='1', .*, expected a list o"),
    "a socket": ("T.frames", "self.socket.recv()", "raised AttributeError: 'T' object has no attribute 'sock"),
    "its end": ("T.frames", "exit()", "raised SystemExit"),
    "inside": ("T.seen", "return self.count['x']", "raised TypeError: 'int' object is not subscriptable"),
    "its close": ("T.close", "1 / 0", "raised ZeroDivisionError: division by zero"),
}  # fmt: skip
SERVO = {
    "a pulse": ("D.set_pulse", "pulse + 'us'", "raised TypeError: unsupported operand"),
    "an exit": ("D.set_pulse", "exit()", "raised SystemExit"),
    "alive": ("D.keep_alive", "self.x()", "raised AttributeError: 'D' object has no attribute 'x'"),
    "no frames": ("T.frames", "return", "returned None, expected a list of TrackerFrame"),
    "a socket": ("T.frames", "self.socket.recv()", "raised AttributeError: 'T' object has no attribute 'sock"),
    "its close": ("T.close", "1 / 0", "raised ZeroDivisionError: division by zero"),
}
RECORD = {
    "none": ("J.samples", "return", "returned None, expected a list of JointSample"),
    "one": ("J.samples", "return JointSample(0.0, None, {})", "returned JointSample.*, expected a list of JointSam"),
    "lists": ("J.samples", SAMPLE % "0.0, None, [1, 2]", "returned .*angles=.1, 2.,.*, expected a list of Jo"),
    "texts": ("J.samples", SAMPLE % "0.0, None, {'arm.a': '1'}", "returned .*'1'.*, expected a list of JointSample"),
    "no time": ("J.samples", SAMPLE % "None, None, {}", "returned .*arrived=None, .*, expected a list of "),
    "a label": ("J.samples", SAMPLE % "0.0, None, {}, {'plane': 1}", "returned .*'plane': 1.*, expected a list of Jo"),
    "a fault": ("J.samples", "1 / 0", "raised ZeroDivisionError"),
    "an exit": ("J.samples", "exit()", "raised SystemExit"),
    "ended": ("J.ended", "return self.x", "raised AttributeError: 'J' object has no attribute 'x'"),
    "no shot": ("C.shoot", "return", "returned None, expected a Shot"),
    "a file": ("C.shoot", "return Shot('a.png', '.png', '')", "returned Shot.content='a.png',.*, expected a Shot of b"),
    "unseen": ("C.shoot", "return Shot(b'', '.png', '', {'u': math.nan})", "returned Shot.values ..u.: nan., exp"),
    "a lens": ("C.shoot", "self.lens.focus()", "raised AttributeError: 'C' object has no attribute 'lens'"),
    "close": ("J.close", "self.x.close()", "raised AttributeError: 'J' object has no attribute 'x'"),
}
COMMANDS: dict[str, tuple[dict[str, tuple[str, str, str]], float, tuple[str, ...], str]] = {
    "acquire": (ACQUIRE, 4.0, ("--plan", "plan.csv", "--yes", "--unchecked"), TIP),
    "servo": (SERVO, 6.0, ("--yes",), TIP),
    "record": (RECORD, 7.0, ("--capture", "still"), TOUCH),
}
"""Mistakes, when they begin (s), options, and what is measured."""


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The bench's, which keeps the arm: the angles of joints that get pulses, and those at which they were let go."""
    clock: Any = FakeClock()
    clock.arm, clock.let_go, clock.late = {}, [], float("inf")

    @contextmanager
    def fake(self: Bench) -> Iterator[Any]:
        yield clock

    monkeypatch.setattr(Bench, "clock", fake)
    for variable in (plugins.CHOSEN, plugins.DISABLED):
        monkeypatch.setenv(variable, "")
    with Path(os.devnull).open() as nobody:  # exit() closes it
        nothing = SimpleNamespace(fileno=nobody.fileno, isatty=lambda: False, close=lambda: None)
        monkeypatch.setattr("sys.stdin", nothing)
        yield clock


def ended(folder: Path, plugin: str, command: str, *more: str, measurement: str = TIP) -> int:
    """How a command ends with a plugin file."""
    texts = {"mine.py": plugin, "bench.yaml": CONFIG % measurement, "servos.yaml": SERVOS, "plan.csv": PLAN}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    os.chdir(folder)
    words = [command, "bench.yaml", "--plugin", "mine.py", "--out", "out", *more]
    try:
        done = cli.main(words, "armcal", standalone_mode=False)
    except SystemExit as end:
        done = end.code
    assert isinstance(done, int | None)
    return done or 0


@pytest.mark.parametrize(
    ("command", "right", "wrong", "sentence"),
    [
        ("acquire", '("a", "b")', "None", "D returned None as joint_names, expected .'a', 'b'., as it was given them"),
        ("acquire", '("a", "b")', '("a",)', "D returned .'a',. as joint_names, expected .'a', 'b'., as it was given"),
        ("acquire", "refused = {}", "refused = None", "T returned None, expected refused as a mapping from reasons"),
        ("acquire", "refused = {}", "refused = []", "T returned .., expected refused as a mapping from reasons"),
        ("record", '"touch"', '"board"', "C returned 'board' as measurement, expected one of touch"),
    ],
)
def test_what_is_wrong_from_the_beginning(
    command: str, right: str, wrong: str, sentence: str, tmp_path: Path, clock: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    _, _, options, measurement = COMMANDS[command]
    assert right in PLUGIN
    assert ended(tmp_path, PLUGIN.replace(right, wrong, 1), command, *options, measurement=measurement) == 2
    shown = capsys.readouterr().err
    assert re.search(rf"armcal: .*mine.py: {sentence}", shown) and "Traceback" not in shown, shown


def mistaken(method: str, statement: str) -> str:
    """The plugin with a method that does that, once it is late."""
    kind, _, name = method.partition(".")
    before, body = PLUGIN.split(f"class {kind}:")
    after = re.sub(rf"(def {name}\(.*\n)", rf"\1        if late(self):\n            {statement}\n", body, count=1)
    assert after != body
    return f"{before}class {kind}:{after}"


def kept(folder: Path) -> list[str]:
    """What a folder holds of what was measured, a line each; of poses and postures their data."""
    if has_journal(folder):
        with KeptJournal(folder) as journal:
            poses = [repr(entry.content) for entry in journal.entries() if entry.kind == "pose"]
        if poses:
            return poses
    data = folder / "dataset.csv"
    return data.read_text().splitlines()[1:] if data.exists() else []


@pytest.mark.parametrize(("command", "mistake"), [(name, own) for name, of in COMMANDS.items() for own in of[0]])
def test_a_mistake(
    command: str,
    mistake: str,
    tmp_path: Path,
    clock: Any,
    capsys: pytest.CaptureFixture[str],
) -> None:
    mistakes, clock.late, options, measurement = COMMANDS[command]
    method, statement, sentence = mistakes[mistake]
    code = ended(tmp_path, mistaken(method, statement), command, *options, measurement=measurement)
    shown = capsys.readouterr().err
    last = [line for line in shown.splitlines() if line.startswith("armcal: ")]
    assert code == 2 and len(last) == 1 and ("Traceback" in shown) == sentence.startswith("raised"), shown
    assert re.search(rf"mine.py:\d+: {method} {sentence}", last[0]), last[0]
    assert clock.arm or all(abs(angle) < 1e-9 for angle in clock.let_go), "let go elsewhere than where it parks"
    before, clock.late = kept(tmp_path / "out"), float("inf")
    assert before
    more = ("--resume",) if command != "servo" else ()
    assert ended(tmp_path, PLUGIN, command, *options, *more, measurement=measurement) == 0
    after = kept(tmp_path / "out")
    assert after[: len(before)] == before and len(after) >= 3
