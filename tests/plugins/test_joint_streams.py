"""Live joint readings: JSON lines in their forms, logs of two arms, the sources they come from, and what is refused."""

from __future__ import annotations

import json
import math
import os
import socket
from pathlib import Path

import numpy as np
import pytest
from armcal.arm.assembly import Arm
from armcal.devices.live import RestStream
from armcal.errors import ConfigError, InputError
from armcal.measure.reader import ReadRequest, requested_channels
from armcal.measure.rests import LiveRests, Rows, StillSettings, rests
from armcal_contact.json_joints import JsonLinesJoints, JsonLinesJointSettings
from armcal_dualarm.closure import ClosedChain, ClosedChainSettings
from armcal_dualarm.live import TwoArmLogStream, TwoArmStreamSettings
from armcal_dualarm.log_reader import TwoArmLogReader, TwoArmLogSettings
from armcal_mdh.model import MdhModel, MdhSettings

CHANNELS = ("arm.j1", "arm.j2")
ORDER, RATIOS = [1, 2, 7, 3, 4, 5, 6], [100, 100, -100, 100, -101, 100, 100]


class Stopped:
    """A clock that stands."""

    def now(self) -> float:
        return 7.0

    def wall(self) -> float:
        return 0.0

    def sleep(self, seconds: float) -> None:
        raise AssertionError("a stream never waits")


def opened(path: Path, channels=CHANNELS, **settings):
    stream = JsonLinesJoints(JsonLinesJointSettings(source=str(path), **settings))
    path.touch()
    stream.open(Stopped(), channels)
    return stream


def append(path: Path, *messages) -> None:
    with path.open("a") as file:
        for message in messages:
            file.write((message if isinstance(message, str) else json.dumps(message)) + "\n")


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
def test_forms_of_a_message(tmp_path, settings, message):
    stream = opened(tmp_path / "q.jsonl", **settings)
    append(tmp_path / "q.jsonl", message)
    (sample,) = stream.samples()
    assert sample.angles == pytest.approx({"arm.j1": 0.25, "arm.j2": math.pi / 2}, rel=1e-15)
    assert sample.arrived == 7.0 and sample.stamp is None and stream.samples() == []


def test_times_and_labels(tmp_path):
    stream = opened(tmp_path / "q.jsonl", time="at_ms", unit="rad")
    append(tmp_path / "q.jsonl", {"j1": 1, "j2": 2, "at_ms": 1500, "socket": " hole_0 ", "n": 4, "empty": ""})
    ros = {"header": {"stamp": {"sec": 3, "nanosec": 500_000_000}}, "name": ["j1", "j2"], "position": [1, 2]}
    append(tmp_path / "q.jsonl", ros)
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
        ("[" * 100_000, "it is too long"),
        ("[" * 10_000, "it is not JSON"),
        ("\xff\x00", "it is not JSON"),
    ],
)
def test_lines_that_say_nothing_of_use_are_counted_by_reason(tmp_path, message, why):
    stream = opened(tmp_path / "q.jsonl")
    append(tmp_path / "q.jsonl", message, {"j1_rad": 1, "j2_rad": 2})
    assert len(stream.samples()) == 1 and stream.refused == {why: 1}


def test_a_list_of_another_length_is_refused_with_both_counts(tmp_path):
    stream = opened(tmp_path / "q.jsonl", values="q")
    append(tmp_path / "q.jsonl", {"q": [1, 2, 3]}, {"p": [1, 2]})
    assert stream.samples() == []
    assert stream.refused == {"it has 3 joints, expected 2": 1, "it has no list q": 1}


def test_a_source_that_repeats_itself_is_not_live(tmp_path):
    stream = opened(tmp_path / "q.jsonl", unit="rad")
    append(tmp_path / "q.jsonl", *[{"j1": 1, "j2": 2, "time_s": t} for t in (1, 2, 2, 2, 1)])
    assert [sample.stamp for sample in stream.samples()] == [1, 2, 1]
    assert list(stream.refused.values()) == [2]


def test_joints_of_two_arms_are_told_apart(tmp_path):
    stream = opened(tmp_path / "q.jsonl", ("left.q1", "right.q1"))
    append(tmp_path / "q.jsonl", {"left.q1_rad": 1, "right.q1_rad": 2}, {"q1_rad": 1})
    (sample,) = stream.samples()
    assert sample.angles == {"left.q1": 1, "right.q1": 2} and "it has 0 joints" in next(iter(stream.refused))


@pytest.mark.parametrize("joints", [{"j9": "x"}, {"j1": "x", "arm.j1": "y"}, {"j1": "x", "j2": "x"}])
def test_names_that_fit_no_joint_are_refused_at_once(tmp_path, joints):
    with pytest.raises(ConfigError):
        opened(tmp_path / "q.jsonl", joints=joints)


def test_a_file_is_followed_from_its_end_through_cuts_and_replacements(tmp_path):
    path = tmp_path / "q.jsonl"
    append(path, {"j1": 0, "j2": 0})
    with path.open("a") as file:
        file.write('{"j1": 1, ')
    stream = opened(path, unit="rad")
    assert stream.samples() == []
    append(path, '"j2": 1}', {"j1": 2, "j2": 2})
    assert [sample.angles["arm.j1"] for sample in stream.samples()] == [1, 2]
    path.write_text("")
    stream.samples()
    append(path, {"j1": 3, "j2": 3})
    assert [sample.angles["arm.j1"] for sample in stream.samples()] == [3]
    other = tmp_path / "other"
    append(other, {"j1": 4, "j2": 4})
    other.rename(path)
    assert [sample.angles["arm.j1"] for sample in stream.samples()] == [4]
    path.unlink()
    assert stream.samples() == [] and not stream.ended
    again = opened(path, unit="rad", begin="start")
    append(path, {"j1": 5, "j2": 5})
    assert len(again.samples()) == 1


def test_a_pipe_that_has_a_name_may_be_written_again_and_again(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    stream = JsonLinesJoints(JsonLinesJointSettings(source=str(path), unit="rad"))
    stream.open(Stopped(), CHANNELS)
    for number in (1, 2):
        append(path, {"j1": number, "j2": 0})
        assert [sample.angles["arm.j1"] for sample in stream.samples()] == [number]
        assert stream.samples() == [] and not stream.ended
    stream.close()


def test_datagrams_and_a_port_that_is_taken(tmp_path):
    stream = JsonLinesJoints(JsonLinesJointSettings(source="udp:0", unit="rad"))
    stream.open(Stopped(), CHANNELS)
    port = stream._source.port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b'{"j1": 1, "j2": 2}\n{"j1": 3, "j2": 4}', ("127.0.0.1", port))
        sender.sendto(b"x" * 65_000, ("127.0.0.1", port))
        assert [sample.angles["arm.j1"] for sample in stream.samples()] == [1, 3]
    with pytest.raises(InputError, match="the socket cannot be opened"):
        JsonLinesJoints(JsonLinesJointSettings(source=f"udp:{port}")).open(Stopped(), CHANNELS)
    stream.close()
    stream.close()
    assert stream.samples() == [] and stream.ended


@pytest.mark.parametrize("source", ["/no/such/file", "/", "/no\0"])
def test_a_source_that_is_not_there_is_refused(source):
    with pytest.raises((InputError, ValueError)) as caught:
        JsonLinesJoints(JsonLinesJointSettings(source=source)).open(Stopped(), CHANNELS)
    assert "cannot" in str(caught.value) or "read line by line" in str(caught.value) or "path" in str(caught.value)


def sides(**more):
    columns = {"left": list(range(1, 8)), "right": list(range(8, 15))}
    return {side: {"columns": own, "order": ORDER, "gear_ratios": RATIOS, **more} for side, own in columns.items()}


BOTH = tuple(f"{side}.q{i}" for side in ("left", "right") for i in range(1, 8))


def motors(angles):
    table = np.empty_like(angles)
    for side in (0, 7):
        for from_base, (own, ratio) in enumerate(zip(ORDER, RATIOS, strict=True)):
            table[:, side + own - 1] = angles[:, side + from_base] * ratio
    return table


def guided_log(rests_count, seed):
    """Rows of a log (time ms, 14 motors, clamp) with rests of various lengths, motions, pauses and changes of label."""
    random = np.random.default_rng(seed)
    stand, rows, at = random.uniform(-1.5, 1.5, 14), [], 0.0
    for number in range(rests_count):
        for _ in range(int(random.integers(5, 60))):
            at += 20.0
            rows.append((at, stand + 1e-5 * random.uniform(-1, 1, 14), f"c{number // 3}"))
        at += 3000.0 * (random.uniform() < 0.2)
        to = random.uniform(-1.5, 1.5, 14)
        count = int(random.integers(1, 20))
        for step in range(1, count):
            at += 20.0
            rows.append((at, stand + (to - stand) * step / count, f"c{number // 3}"))
        stand = to
    angles = motors(np.array([row[1] for row in rows]))
    return [
        ";".join([repr(row[0]), *(repr(float(x)) for x in own), row[2]]) for row, own in zip(rows, angles, strict=True)
    ]


def two_arms():
    model = MdhSettings.si(convention="standard", rows=[{"a": 0.1, "alpha": 1.0}] * 7)
    arms = {name: Arm(name, "mdh", MdhModel(model), {}, ()) for name in ("left", "right")}
    clamp = {"clamp": ClosedChain(ClosedChainSettings.si(noise=1e-4, orientation_noise=1e-3), tuple(arms))}
    return ReadRequest(arms, clamp, requested_channels(arms, clamp, measured=True))


@pytest.mark.quick("0-still1")
@pytest.mark.parametrize("still", [{"samples": 15}, {"window_s": 0.3, "spread_deg": 0.01}])
@pytest.mark.parametrize("seed", range(4))
def test_a_log_streamed_live_gives_the_records_that_reading_it_gives(tmp_path, still, seed):
    lines = guided_log(25, seed)
    header = ";".join(["ms", *(f"m{i}" for i in range(14)), "clamp"])
    named = {"left": [f"m{i}" for i in range(7)], "right": [f"m{i}" for i in range(7, 14)]}
    arms = {side: {**own, "columns": named[side]} for side, own in sides().items()}
    settings = {"arms": arms, "time": "ms", "time_unit": "ms", "labels": {"clamp": "clamp"}, "still": still}
    whole = tmp_path / "whole.log"
    whole.write_text("\n".join([header, *lines]) + "\n")
    read = TwoArmLogReader(TwoArmLogSettings(path=whole, **settings)).read(two_arms())
    growing = tmp_path / "growing.log"
    growing.touch()
    stream = TwoArmLogStream(TwoArmStreamSettings(source=str(growing), begin="start", **settings))
    assert isinstance(stream, RestStream) and stream.gives_rests
    stream.open(Stopped(), BOTH)
    random, samples, data, at = np.random.default_rng(seed), [], whole.read_bytes(), 0
    while at < len(data):
        size = int(random.integers(1, 40_000))
        with growing.open("ab") as file:
            file.write(data[at : at + size])
        at += size
        samples += stream.samples()
    samples += [*stream.lasting(), *stream.lasting()]
    assert len(samples) == len(read) > 10 and stream.refused == {}
    for i, sample in enumerate(samples):
        assert [sample.angles[c] for c in BOTH] == pytest.approx([read.column(c)[i] for c in BOTH], rel=1e-12)
        assert sample.stamp == pytest.approx(read.column("time")[i], rel=1e-12)
        assert sample.labels == {"clamp": read.extra["clamp"][i]}


@pytest.mark.parametrize("seed", range(30))
def test_rests_found_in_pieces_are_those_of_the_whole(seed):
    random = np.random.default_rng(seed)
    steps = random.normal(size=(3, 300)) * random.choice([0.0, 0.02, 1.0], 300, p=[0.7, 0.25, 0.05])
    log = np.cumsum(steps, axis=1)
    log[1, random.uniform(size=300) < 0.01] = np.nan
    labels = tuple("ab"[int(i)] for i in np.cumsum(random.uniform(size=300) < 0.02) % 2)
    time = np.cumsum(random.choice([0.01, 0.0, 0.5, -0.2], 300, p=[0.9, 0.06, 0.02, 0.02]))
    by_samples = StillSettings.si(samples=int(random.integers(2, 20)), spread=0.1)
    for settings in (by_samples, StillSettings.si(window=0.08, spread=0.1)):
        live, found, at = LiveRests(settings), [], 0
        while at < 300:
            stop = min(300, at + int(random.integers(1, 40)))
            found += live.add(Rows(log[:, at:stop], time[at:stop], (labels[at:stop],)))
            at = stop
        found += live.lasting()
        expected = [log[:, rest.start : rest.stop] for rest in rests(log, (labels,), time, settings)]
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one.joints, other)


def test_without_still_each_row_is_a_reading_whatever_parts_the_cells(tmp_path):
    path = tmp_path / "log"
    angles = np.random.default_rng(1).uniform(-2, 2, (5, 14))
    path.write_text("m " * 13 + "m\n")  # its header; what is in the file already is not live
    stream = TwoArmLogStream(TwoArmStreamSettings(source=str(path), arms=sides()))
    stream.open(Stopped(), BOTH)
    for row in motors(angles):
        append(path, "  ".join(map(repr, row.tolist())))
    append(path, "1 2 3", "x " * 14, " ".join(["1"] * 13 + ["nan"]), "m " * 14)
    samples = stream.samples()
    assert np.array([list(s.angles.values()) for s in samples]) == pytest.approx(angles)
    reasons = stream.refused
    assert reasons["found 3 cells, expected 14 as in the first row"] == 1
    assert any("expected a number" in reason for reason in reasons)
    assert reasons["it has no reading of right.q3"] == 1 and sum(reasons.values()) == 3


def test_other_arms_or_counts_are_refused_when_it_is_opened(tmp_path):
    path = tmp_path / "log"
    path.touch()
    for arms, said in (
        ({"left": {"columns": [1, 2]}}, "found 2 columns for the arm left, which has 7 joints"),
        ({"left": sides()["left"]}, "found 0 columns for the arm right, which has 7 joints"),
        ({**sides(), "middle": {"columns": [20]}}, "no arm is called 'middle'; the arms are left, right"),
    ):
        with pytest.raises(ConfigError, match=said):
            TwoArmLogStream(TwoArmStreamSettings(source=str(path), arms=arms)).open(Stopped(), BOTH)
