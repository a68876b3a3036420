"""The servo file: read, refused with its place, and written back to the last bit."""

from __future__ import annotations

import math
import struct

import pytest
from armcal.arm.servo import PulseClock, PulseTable
from armcal.config.servo_file import (
    BoardSettings,
    ServoFile,
    ServoFileError,
    ServoSettings,
    digest,
    load_servo_file,
    servo_file_text,
)
from armcal.errors import ConfigError
from armcal_bench.servo_fit import write_servo_file
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

TEXT = """boards:
  front: {address: 0x40, oscillator_hz: 25300000, rate_hz: 50, id: "A5069RR4"}
  back: {address: 0x41, oscillator_hz: 26.1e+6}
servos:
  q1: {board: front, channel: 0, angles_deg: [-100, 0, 100], pulses_us: [620, 1540, 2460]}
  q2: {board: back, channel: 0, angles_deg: [-90, 90], pulses_us: [2400, 600]}
"""
WIDE = {"pulse_range": (1e-6, 0.0195)}
"""Of no servo, so that any number can be written."""


def load(folder, text=TEXT):
    path = folder / "servos.yaml"
    path.write_text(text, encoding="utf-8")
    return load_servo_file(path)


def test_what_it_says(tmp_path):
    file = load(tmp_path)
    q1, q2 = file.calibrated("q1"), file.calibrated("q2")
    assert (q1.board_id, q1.address, q1.channel) == ("A5069RR4", 0x40, 0)
    assert q1.clock == PulseClock(25.3e6, 123)  # 25.3e6 / (4096 * 50) = 123.54, so 124 - 1
    assert q2.clock == PulseClock(26.1e6, 126)  # 127.44, so 127 - 1
    assert q1.table == PulseTable((math.radians(-100), 0.0, math.radians(100)), (620 / 1e6, 1540 / 1e6, 2460 / 1e6))
    assert q2.table.pulses == (2400 / 1e6, 600 / 1e6)


BAD = {
    "all call": ("0x41", "0x70", "servos.yaml:3, boards.back", "0x70"),
    "reserved": ("0x41", "0x78", "servos.yaml:3, boards.back", "0x78"),
    "too low": ("0x41", "0x3f", "servos.yaml:3, boards.back", "0x3f"),
    "same address": ("0x41", "0x40", "servos.yaml:3, boards.back.address", "'front'"),
    "an oscillator of none": ("25300000", "8000000", "servos.yaml:2, boards.front.oscillator_hz", "8000000"),
    "a rate of none": ("rate_hz: 50", "rate_hz: 10", "servos.yaml:2, boards.front.rate_hz", "10"),
    "prescale": ("rate_hz: 50", "rate_hz: 24", "servos.yaml:2, boards.front", "prescale is 256"),
    "too long": ("rate_hz: 50", "rate_hz: 1000", "servos.yaml:5, servos.q1.pulses", "longer"),
    "a pulse that no servo bears": ("[620, 1540", "[172.7, 1540", "servos.yaml:5, servos.q1.pulses", "172.7 us"),
    "a pulse beyond the servo's own range": (
        "pulses_us: [2400, 600]",
        "pulses_us: [2400, 600], pulse_range_us: [500, 2350]",
        "servos.yaml:6, servos.q2.pulses",
        "500 to 2350 us",
    ),
    "a range that falls": (
        "pulses_us: [2400, 600]",
        "pulses_us: [2400, 600], pulse_range_us: [2500, 500]",
        "servos.yaml:6, servos.q2",
        "pulse_range does not rise",
    ),
    "unknown board": ("board: back", "board: rear", "servos.yaml:6, servos.q2.board", "front, back"),
    "same channel": ("board: back", "board: front", "servos.yaml:6, servos.q2.channel", "'q1'"),
    "channel 16": (
        "channel: 0, angles_deg: [-90",
        "channel: 16, angles_deg: [-90",
        "servos.yaml:6, servos.q2.channel",
        "16",
    ),
    "turns back": ("1540, 2460", "1540, 1400", "servos.yaml:5, servos.q1", "turn back"),
    "angles fall": ("[-90, 90]", "[90, -90]", "servos.yaml:6, servos.q2", "rise"),
    "a pulse more": ("[2400, 600]", "[2400, 900, 600]", "servos.yaml:6, servos.q2", "2 angles and 3 pulses"),
    "no length": ("[2400, 600]", "[2400, 0]", "servos.yaml:6, servos.q2", "above zero"),
    "no unit": ("pulses_us: [2400", "pulses: [2400", "servos.yaml:6, servos.q2.pulses", "unit"),
    "unknown key": (
        "channel: 0, angles_deg: [-90",
        "chanel: 0, angles_deg: [-90",
        "servos.yaml:6, servos.q2.chanel",
        "channel",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_refused_with_its_place(tmp_path, case):
    old, new, place, word = BAD[case]
    assert old in TEXT
    with pytest.raises(ConfigError) as raised:
        load(tmp_path, TEXT.replace(old, new))
    assert place in str(raised.value) and word in str(raised.value)
    assert raised.value.exit_code == 2


def test_from_python_it_is_checked_too():
    board = BoardSettings()
    servo = ServoSettings.si(board="a", channel=0, angles=(-1.0, 1.0), pulses=(0.001, 0.002))
    with pytest.raises(ServoFileError):
        ServoFile({"a": board}, {"q1": servo, "q2": servo})


doubles = st.floats(min_value=-3.2, max_value=3.2, allow_subnormal=False)
names = st.one_of(
    st.sampled_from(["q1", "on", "no", "1", "1e-3", "12:30", "null", "a b", 'a"b', "ä", "~", "x.y", "0x10", "<<"]),
    st.text(st.characters(min_codepoint=0x20, max_codepoint=0x17F, exclude_characters="\x7f"), min_size=1).filter(
        lambda text: not any(0x7F <= ord(c) <= 0x9F for c in text)
    ),
)


@pytest.mark.slow
@given(
    st.dictionaries(
        names,
        st.tuples(
            st.lists(doubles, min_size=2, max_size=5, unique=True),
            st.lists(st.floats(1e-6, 0.019), min_size=5, max_size=5, unique=True),
        ),
        min_size=1,
        max_size=4,
    ),
    names,
    names,
    st.floats(23e6, 27e6),
    st.floats(50, 51),
)
@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_written_and_read_to_the_last_bit(tmp_path, tables, board, identity, oscillator_hz, rate_hz):
    servos = {
        joint: ServoSettings.si(
            board=board, channel=i, angles=sorted(angles), pulses=sorted(pulses)[: len(angles)], **WIDE
        )
        for i, (joint, (angles, pulses)) in enumerate(tables.items())
    }
    made = ServoFile({board: BoardSettings(oscillator_hz=oscillator_hz, rate_hz=rate_hz, id=identity)}, servos)
    found = load(tmp_path, servo_file_text(made))
    assert found == made

    def bits(file):
        numbers = [b.oscillator_hz for b in file.boards.values()]
        numbers += [n for s in file.servos.values() for n in (*s.angles, *s.pulses)]
        return [struct.pack("<d", n + 0.0) for n in numbers]

    assert bits(found) == bits(made)
    assert servo_file_text(found) == servo_file_text(made)


def test_customary_units_are_kept_where_they_are_exact(tmp_path):
    text = servo_file_text(load(tmp_path))
    assert "angles_deg: [-100.0, 0.0, 100.0], pulses_us: [620.0, 1540.0, 2460.0]" in text
    assert "address: 0x41" in text


def test_the_digest_hangs_on_every_number(tmp_path):
    def of(text):
        file = load(tmp_path, text)
        return digest({joint: file.calibrated(joint) for joint in file.servos})

    changes = [
        ("25300000", "25300000.1"), ("A5069RR4", "A5069RR5"), ("0x41", "0x42"), ("2460]", "2460.001]"),
        ("rate_hz: 50", "rate_hz: 51"), ("channel: 0, angles_deg: [-100", "channel: 1, angles_deg: [-100"),
        ("-90, 90", "-90.0001, 90"), ("  q1:", "  q9:"),
    ]  # fmt: skip
    found = {of(TEXT), *(of(TEXT.replace(*change)) for change in changes)}
    assert len(found) == len(changes) + 1
    renamed = TEXT.replace("front", "left")
    assert of(renamed) == of(TEXT) == of(TEXT.replace("25300000", "25300000.0"))


BY_HAND = """# mine
boards:
  front:            # first
    address: 0x40
    # measured at a pin
    oscillator_hz: 25.0e+6
  back: {address: 0x41}   # nobody knows its id
servos:
  q1: {board: front, channel: 0, angles_deg: [-100, 0, 100], pulses_ms: [0.62, 1.54, 2.46]}  # shoulder
  q2:
    board: back
    channel: 3   # was 1
    angles_deg: [-135, 0, 135]
    pulses_us:
      - 500
      - 1500
      - 2500
    # trailing
# the end
"""


def changed(file):
    """Other numbers everywhere that armcal servo may change them."""
    boards, servos = {}, {}
    for name, board in file.boards.items():
        boards[name] = BoardSettings.si(**{**board.model_dump(), "id": "A1", "oscillator_hz": 25.1e6})
    for joint, servo in file.servos.items():
        servos[joint] = ServoSettings.si(**{**servo.model_dump(), "pulses": tuple(1.01 * p for p in servo.pulses)})
    return ServoFile(boards, servos)


def test_a_part_on_one_line_is_changed_there_and_comments_stay(tmp_path):
    text = "# mine\n" + TEXT.replace("}\n", "}   # by hand\n") + "# the end\n"
    meant = changed(load(tmp_path, text))
    kept = write_servo_file(tmp_path / "servos.yaml", meant)
    written = (tmp_path / "servos.yaml").read_text()
    assert load_servo_file(tmp_path / "servos.yaml") == meant and kept.read_text() == text
    assert written.count("# by hand") == 4 and written.startswith("# mine\n") and written.endswith("# the end\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["servos.yaml", "servos.yaml.before-1"]


@pytest.mark.parametrize(
    "text",
    [
        BY_HAND,
        BY_HAND.replace("[-100, 0, 100]", "&a [-100, 0, 100]").replace("[-135, 0, 135]", "*a"),
        TEXT.replace("\n", "\r\n"),
        TEXT.replace("[-100, 0, 100]", "&a [-100, 0, 100]"),
        TEXT.replace("front", "q1"),
        "extends: base.yaml\nservos:\n  q1: {channel: 5}   # moved\n",
    ],
)
def test_a_file_that_is_written_otherwise_still_says_what_is_meant(tmp_path, text):
    (tmp_path / "base.yaml").write_text(BY_HAND)
    meant = changed(load(tmp_path, text))
    kept = write_servo_file(tmp_path / "servos.yaml", meant)
    assert load_servo_file(tmp_path / "servos.yaml") == meant and kept.read_bytes() == text.encode()
    assert (tmp_path / "base.yaml").read_text() == BY_HAND
