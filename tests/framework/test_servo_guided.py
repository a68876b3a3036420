"""Guided servo calibration: keys of a real terminal, lines from a pipe, resuming, and what may not be set."""

from __future__ import annotations

import os
import termios
import threading
from contextlib import nullcontext
from itertools import pairwise

import numpy as np
import pytest
from armcal.errors import InputError
from armcal_bench.keys import QUIT, SERVO_KEYS, OperatorInput, operator_input
from armcal_bench.servo_fit import improved
from armcal_bench.servo_session import evaluated, measure
from armcal_bench.servo_setup import Record
from armcal_bench.session import Conversation
from armcal_bench.tracker_monitor import StopRequested

from tests.servo_fakes import config_in, setup_on

SERVO = "bench:\n  servo: {joints: [q1, q3], approach: 4 deg}\n"
TRUE_US = {"q1": (604.0, 1533.0, 2491.0), "q3": (650.0, 1560.0, 2420.0)}
KNOTS = (-100.0, 0.0, 100.0)
STATED = {"board": "front", "channel": 0, "oscillator_hz": 25e6, "prescale": 121}
STATED |= {"angles": [-1.0, 1.0], "pulses": [1e-3, 2e-3]}


class Person:
    """Somebody who knows the true tables, and steps by 10 us and then 1 us until the joint is nearest to its mark."""

    def __init__(self, device, quit_after=None):
        self.device, self.target, self.asked, self.stops = device, None, None, quit_after

    def say(self, text):
        words = text.split()
        if words[0] == "put":
            joint, angle = words[1], float(words[3])
            self.target = joint, np.interp(angle, KNOTS, TRUE_US[joint])
        else:
            self.asked = float(words[1])

    def next(self, seconds):
        if self.stops == 0:
            return QUIT
        left = self.target[1] - self.asked
        if abs(left) < 0.5:
            if self.stops is not None:
                self.stops -= 1
            return "ok"
        return f"{10 if abs(left) > 6 else 1:+d}" if left > 0 else f"-{10 if abs(left) > 6 else 1}"


def talk(person, stop=lambda: False):
    return Conversation(stop, lambda joints: True, lambda *told: None, person.say, lambda: nullcontext(person))


def observed(folder):
    """What matters of a record's angles."""
    entries = [e for e in Record(folder).entries if e["kind"] == "angle"]
    return [(e["joint"], e["target"], e["came"], e["counts"]) for e in entries]


@pytest.mark.slow
def test_somebody_who_knows_the_angles_finds_the_tables(tmp_path, monkeypatch):
    setup, device, _ = setup_on(monkeypatch, config_in(tmp_path, SERVO))
    measure(setup, tmp_path / "out", talk(Person(device)), "guided")
    outcome = evaluated(setup, tmp_path / "out")
    assert not outcome.keeps_zero
    for joint, pulses in TRUE_US.items():
        found = outcome.servos[joint]
        assert 1e6 * np.array(found.pulses) == pytest.approx(pulses, abs=3.7)  # half a count, and on to the end
    changed = improved(setup.file, outcome)
    assert changed.servos["q2"].pulses == setup.file.servos["q2"].pulses


def test_pulses_change_slowly_one_joint_at_a_time_and_each_side_is_come_to_from_aside(tmp_path, monkeypatch):
    setup, device, _ = setup_on(monkeypatch, config_in(tmp_path, SERVO))
    measure(setup, tmp_path / "out", talk(Person(device)), "guided")
    first: dict[str, float] = {}
    steepest = 0.0
    by_joint: dict[str, list[tuple[int, float]]] = {}
    for joint, counts, at in device.log:
        first.setdefault(joint, at)
        by_joint.setdefault(joint, []).append((counts, at))
    assert np.diff(sorted(first.values())).min() >= 0.5 - 1e-9
    for rows in by_joint.values():
        counts, times = np.array(rows).T
        assert np.abs(np.diff(counts)).max(initial=0) <= 1
        for width in (10, 20, 40):
            if len(counts) > width:
                passed = np.abs(counts[width:] - counts[:-width]) / (times[width:] - times[:-width])
                steepest = max(steepest, float(passed.max()))
    assert 4.88 * steepest / 9.2 <= 20.0 * (1 + 2 / 10)  # deg/s, with a count of slack over the shortest window
    for joint, target, came, counts in observed(tmp_path / "out"):
        rows = [c for c, _ in by_joint[joint]]
        assert any(a * came < counts * came and b == counts for a, b in pairwise(rows)), target


@pytest.mark.slow
def test_stopped_after_any_angle_and_given_again_it_finds_the_same(tmp_path, monkeypatch):
    config = config_in(tmp_path, SERVO)
    setup, device, _ = setup_on(monkeypatch, config)
    measure(setup, tmp_path / "whole", talk(Person(device)), "guided")
    whole = observed(tmp_path / "whole")
    for cut in range(len(whole)):
        setup, device, _ = setup_on(monkeypatch, config)
        folder = tmp_path / f"cut{cut}"
        with pytest.raises(StopRequested):
            measure(setup, folder, talk(Person(device, quit_after=cut)), "guided")
        assert observed(folder) == whole[:cut]
        measure(setup, folder, talk(Person(device)), "guided")
        assert observed(folder) == whole
        assert evaluated(setup, folder).servos["q1"].pulses == evaluated(setup, tmp_path / "whole").servos["q1"].pulses


def test_a_record_of_another_oscillator_is_refused(tmp_path, monkeypatch):
    config = config_in(tmp_path, SERVO)
    setup, device, _ = setup_on(monkeypatch, config)
    with pytest.raises(StopRequested):
        measure(setup, tmp_path / "out", talk(Person(device, quit_after=1)), "guided")
    servos = tmp_path / "servos.yaml"
    servos.write_text(servos.read_text().replace("oscillator_hz: 25000000.0", "oscillator_hz: 25500000.0"))
    setup, device, _ = setup_on(monkeypatch, config)
    with pytest.raises(InputError, match="another board, channel or oscillator"):
        measure(setup, tmp_path / "out", talk(Person(device)), "guided")


def test_no_pulse_outside_the_allowed_range_is_ever_set(tmp_path, monkeypatch):
    text = "bench:\n  servo: {joints: [q1], pulses_us: [900, 2200]}\n"
    setup, device, _ = setup_on(monkeypatch, config_in(tmp_path, text))
    said: list[str] = []
    wishes = iter(["+5000", "-5000", "banana", "skip"] * 6)

    class Wild:
        def next(self, seconds):
            return next(wishes, QUIT)

    talking = Conversation(
        lambda: False, lambda joints: True, lambda *t: None, said.append, lambda: nullcontext(Wild())
    )
    measure(setup, tmp_path / "out", talking, "guided")
    tick = setup.file.boards["front"].clock.tick
    pulses = [counts * tick for joint, counts, _ in device.log if joint == "q1"]
    assert min(pulses) >= 900e-6 and max(pulses) <= 2200e-6
    assert any("outside 900 to 2200 us" in text for text in said)
    assert any("is not known" in text for text in said)


def test_a_lost_board_loses_nothing_that_was_measured(tmp_path, monkeypatch):
    setup, device, _ = setup_on(monkeypatch, config_in(tmp_path, SERVO))
    person = Person(device)
    device.lost_at = {400}
    with pytest.raises(Exception, match="gone"):
        measure(setup, tmp_path / "out", talk(person), "guided")
    kept = observed(tmp_path / "out")
    measure(setup, tmp_path / "out", talk(Person(device)), "guided")
    assert kept and observed(tmp_path / "out")[: len(kept)] == kept and len(observed(tmp_path / "out")) == 12


def test_keys_of_a_real_terminal_and_its_mode_put_back():
    master, slave = os.openpty()
    try:
        before = termios.tcgetattr(slave)
        with pytest.raises(RuntimeError), operator_input(slave, SERVO_KEYS, QUIT) as wishes:
            assert not termios.tcgetattr(slave)[3] & (termios.ICANON | termios.ECHO)
            os.write(master, b"\x1b[A\x1b[B\x1b[5~x\x1b[6~\rsbq")
            assert [wishes.next(1.0) for _ in range(8)] == ["+1", "-1", "+10", "-10", "ok", "skip", "back", "quit"]
            os.write(master, b"\x1b")
            assert wishes.next(0.05) is None  # an escape alone is no key
            os.write(master, b"\x1b[")
            threading.Timer(0.05, os.write, (master, b"A")).start()
            assert wishes.next(5.0) == "+1"  # a key that comes in pieces
            raise RuntimeError
        assert termios.tcgetattr(slave) == before
        with operator_input(slave, SERVO_KEYS, QUIT) as wishes:
            os.close(master)
            master = -1
            assert wishes.next(1.0) == "quit"  # nobody is there any more
    finally:
        os.close(slave)
        if master >= 0:
            os.close(master)


def test_lines_from_a_pipe_and_its_end():
    reader, writer = os.pipe()
    try:
        lines = OperatorInput(reader, at_end=QUIT)
        assert lines.next(0.01) is None
        os.write(writer, b"+10\n\n  OK \nsk")
        assert [lines.next(1.0) for _ in range(3)] == ["+10", "", "  OK "] and lines.next(0.01) is None
        os.write(writer, b"ip")
        os.close(writer)
        assert [lines.next(1.0), lines.next(1.0), lines.next(1.0)] == ["skip", "quit", "quit"]
    finally:
        os.close(reader)


def test_every_line_of_the_record_is_json_that_says_its_kind(tmp_path, monkeypatch):
    setup, device, _ = setup_on(monkeypatch, config_in(tmp_path, SERVO))
    measure(setup, tmp_path / "out", talk(Person(device)), "guided")
    lines = Record(tmp_path / "out").entries
    assert lines[0]["kind"] == "begun" and {line["kind"] for line in lines[1:]} == {"angle"}


def test_back_asks_again_and_the_later_answer_counts(tmp_path, monkeypatch):
    setup, _, _ = setup_on(monkeypatch, config_in(tmp_path, "bench:\n  servo: {joints: [q1]}\n"))
    wishes = iter(["+20", "ok", "back", "+40", "ok", "skip", "skip", "skip", "skip", "skip"])

    class Undecided:
        def next(self, seconds):
            return next(wishes, QUIT)

    quiet = Conversation(
        lambda: False, lambda j: True, lambda *t: None, lambda t: None, lambda: nullcontext(Undecided())
    )
    measure(setup, tmp_path / "out", quiet, "guided")
    (first, again) = observed(tmp_path / "out")
    assert first[:3] == again[:3] and again[3] - first[3] == 4
    assert evaluated(setup, tmp_path / "out").servos["q1"].used == 1
