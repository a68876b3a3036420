"""Live joint readings: JSON lines in their forms, the sources they come from, and what is refused."""

from __future__ import annotations

import json
import math
import socket

import pytest
from armcal.errors import ConfigError, InputError
from armcal_contact.json_joints import JsonLinesJoints, JsonLinesJointSettings, _Messages, _RefusedLine

CHANNELS = ("arm.j1", "arm.j2")


class Stopped:
    """A clock that stands."""

    def now(self) -> float:
        return 7.0

    def wall(self) -> float:
        return 0.0

    def sleep(self, seconds: float) -> None:
        raise AssertionError("a stream never waits")


def opened(channels=CHANNELS, **settings):
    stream = JsonLinesJoints(JsonLinesJointSettings(source="udp:0", **settings))
    stream.open(Stopped(), channels)
    return stream


def send(stream: JsonLinesJoints, *messages) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for message in messages:
            text = message if isinstance(message, str) else json.dumps(message)
            sender.sendto(text.encode(), stream.address)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, {"j1_rad": 0.25, "j2_deg": 90}),
        ({}, {"arm.j1_mrad": 250, "j2_deg": 90, "force": 3, "on": True, "none": None}),
        ({"unit": "rad"}, {"j1": 0.25, "j2_deg": 90}),
        ({"joints": {"j1": "a", "arm.j2": "b_deg"}}, {"a_rad": 0.25, "b_deg": 90}),
        ({"values": "q"}, {"q": [0.25, math.pi / 2]}),
        ({"values": "q", "unit": "deg"}, {"q": [math.degrees(0.25), 90]}),
        ({}, {"name": ["grip", "j2", "j1"], "position": [9.0, math.pi / 2, 0.25], "velocity": []}),
        ({"joints": {"j1": "a", "j2": "b"}}, {"name": ["b", "a"], "position": [math.pi / 2, 0.25]}),
    ],
)
def test_forms_of_a_message(settings, message):
    stream = opened(**settings)
    send(stream, message)
    (sample,) = stream.samples()
    assert sample.angles == pytest.approx({"arm.j1": 0.25, "arm.j2": math.pi / 2}, rel=1e-15)
    assert sample.arrived == 7.0 and sample.stamp is None and stream.samples() == []


def test_times_and_labels():
    stream = opened(time="at_ms", unit="rad")
    send(stream, {"j1": 1, "j2": 2, "at_ms": 1500, "socket": " hole_0 ", "n": 4, "empty": ""})
    ros = {"header": {"stamp": {"sec": 3, "nanosec": 500_000_000}}, "name": ["j1", "j2"], "position": [1, 2]}
    send(stream, ros)
    first, second = stream.samples()
    assert (first.stamp, first.labels) == (1.5, {"socket": "hole_0"})
    assert (second.stamp, second.labels) == (3.5, {})


@pytest.mark.parametrize(
    ("message", "why"),
    [
        ({"j1_rad": 1}, "it has 1 joints, expected 2: found no j2"),
        (
            {"j1_rad": 1, "j2_rad": 1, "j3_rad": 1},
            "it has 3 joints, expected 2: found j3_rad, which is none of the arm's",
        ),
        ({"j1": 1, "j2": 1}, "j1 has no unit: call it j1_rad, or give unit: rad"),
        ({"j1_rad": 1, "j1_deg": 1, "j2_rad": 1}, "it has both j1_rad and j1_deg"),
        ({"j1_rad": math.nan, "j2_rad": 1}, "arm.j1 is not finite"),
        ({"j1_rad": 10**400, "j2_rad": 1}, "arm.j1 is not finite"),
        ({"j1_rad": "1", "j2_rad": 1}, "arm.j1 is no number"),
        ({"j1_rad": True, "j2_rad": 1}, "arm.j1 is no number"),
        ({"name": ["j1"], "position": [1]}, "it has 1 joints and none called j2, expected 2"),
        ({"name": ["j1", "j2"], "position": [1]}, "it has not as many positions as names"),
        ("[1, 2]", "it is no JSON object"),
        ("{", "it is not JSON"),
        ("[" * 10_000, "it is not JSON"),
        ("\xff\x00", "it is not JSON"),
    ],
)
def test_lines_that_say_nothing_of_use_are_counted_by_reason(message, why):
    stream = opened()
    send(stream, message, {"j1_rad": 1, "j2_rad": 2})
    assert len(stream.samples()) == 1 and stream.refused == {why: 1}


def test_a_list_of_another_length_is_refused_with_both_counts():
    stream = opened(values="q")
    send(stream, {"q": [1, 2, 3]}, {"p": [1, 2]})
    assert stream.samples() == []
    assert stream.refused == {"it has 3 joints, expected 2": 1, "it has no list q": 1}


def test_a_source_that_repeats_itself_is_not_live():
    stream = opened(unit="rad")
    send(stream, *[{"j1": 1, "j2": 2, "time_s": t} for t in (1, 2, 2, 2, 1)])
    assert [sample.stamp for sample in stream.samples()] == [1, 2, 1]
    assert list(stream.refused.values()) == [2]


def test_joints_of_two_arms_are_told_apart():
    stream = opened(("left.q1", "right.q1"))
    send(stream, {"left.q1_rad": 1, "right.q1_rad": 2}, {"q1_rad": 1})
    (sample,) = stream.samples()
    assert sample.angles == {"left.q1": 1, "right.q1": 2} and "it has 0 joints" in next(iter(stream.refused))


@pytest.mark.parametrize("joints", [{"j9": "x"}, {"j1": "x", "arm.j1": "y"}, {"j1": "x", "j2": "x"}])
def test_names_that_fit_no_joint_are_refused_at_once(joints):
    with pytest.raises(ConfigError):
        opened(joints=joints)


def test_datagrams_and_a_port_that_is_taken():
    stream = JsonLinesJoints(JsonLinesJointSettings(source="udp:0", unit="rad"))
    stream.open(Stopped(), CHANNELS)
    port = stream.address[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b'{"j1": 1, "j2": 2}\n{"j1": 3, "j2": 4}', ("127.0.0.1", port))
        sender.sendto(b"x" * 65_000, ("127.0.0.1", port))
        assert [sample.angles["arm.j1"] for sample in stream.samples()] == [1, 3]
    with pytest.raises(InputError, match="the socket cannot be opened"):
        JsonLinesJoints(JsonLinesJointSettings(source=f"udp:{port}")).open(Stopped(), CHANNELS)
    stream.close()
    stream.close()
    assert stream.samples() == [] and stream.ended


@pytest.mark.parametrize("source", ["/no/such/file", "/", "udp:x", "udp:70000"])
def test_a_source_that_is_none_is_refused(source):
    with pytest.raises(ValueError, match=r"expected - .standard input. or udp:PORT"):
        JsonLinesJointSettings(source=source)


def test_a_line_that_is_too_long_is_refused():
    with pytest.raises(_RefusedLine, match="it is too long"):
        _Messages(JsonLinesJointSettings(source="-"), CHANNELS).read(None, 0.0)
