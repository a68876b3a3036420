"""Trackers that speak JSON: datagrams, and what is refused."""

from __future__ import annotations

import json
import random
import socket

import numpy as np
import pytest
from armcal.devices.clock import RealClock
from armcal.devices.device import DeviceRefusedError
from armcal_tracker.trackers import JsonLinesSettings, JsonLinesTracker, UnreadableError, json_frame
from pydantic import ValidationError
from scipy.spatial.transform import Rotation


def line(counter: int, **bodies: object) -> bytes:
    content = {"frame": counter, "t": 0.1 * counter, "bodies": bodies or {"tool": {"p_mm": [1, 2, 3]}}}
    return json.dumps(content).encode() + b"\n"


def test_a_frame_of_json() -> None:
    quaternion = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_quat(scalar_first=True)
    found = json_frame(line(7, tool={"p_mm": [1, 2.5, -3], "q": quaternion.tolist()}, base={"p_m": [1, 2, 3]}, x=None))
    assert (found.counter, found.stamp, found.wrong) == (7, pytest.approx(0.7), ())
    tool, base = found.bodies["tool"], found.bodies["base"]
    assert tool is not None and base is not None and found.bodies["x"] is None
    np.testing.assert_allclose(tool[:3, 3], [0.001, 0.0025, -0.003], atol=1e-15)
    np.testing.assert_allclose(Rotation.from_matrix(tool[:3, :3]).as_rotvec(), [0.1, -0.2, 0.3], atol=1e-12)
    np.testing.assert_array_equal(base[:3, 3], [1, 2, 3])
    assert np.isnan(base[:3, :3]).all()


def test_a_frame_without_time() -> None:
    assert json_frame(b'{"frame": 0, "bodies": {}}').stamp is None


@pytest.mark.parametrize("body", [{"p_mm": [1, 2, 3], "q": [0, 0, 0, 0]}, {"p_m": [1, 2, 3], "q": [1, 1, 0, 0]}])
def test_a_quaternion_that_is_none_loses_the_body(body: object) -> None:
    found = json_frame(line(1, tool=body))
    assert found.bodies == {"tool": None} and len(found.wrong) == 1


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "null",
        "{}",
        "nonsense",
        '{"frame": 1}',
        '{"frame": 1, "bodies": {}, "more": 1}',
        '{"frame": 1.5, "bodies": {}}',
        '{"frame": true, "bodies": {}}',
        '{"frame": -1, "bodies": {}}',
        '{"frame": 99999999999999999999999999, "bodies": {}}',
        '{"frame": 1, "frame": 2, "bodies": {}}',
        '{"frame": 1, "t": "now", "bodies": {}}',
        '{"frame": 1, "bodies": []}',
        '{"frame": 1, "bodies": {"tool": {}}}',
        '{"frame": 1, "bodies": {"tool": 3}}',
        '{"frame": 1, "bodies": {"tool": "p_mm"}}',
        '{"frame": 1, "bodies": {"tool": ["p_mm"]}}',
        '{"frame": 1, "bodies": {"tool": {"p_mm": [1, 2]}}}',
        '{"frame": 1, "bodies": {"tool": {"p_mm": [1, 2, "3"]}}}',
        '{"frame": 1, "bodies": {"tool": {"p_mm": [1, 2, true]}}}',
        '{"frame": 1, "bodies": {"tool": {"p_mm": [1, 2, NaN]}}}',
        '{"frame": 1, "bodies": {"tool": {"p_mm": [1, 2, 1e999]}}}',
        '{"frame": 1, "bodies": {"tool": {"p_mm": [1, 2, 3], "p_m": [1, 2, 3]}}}',
        '{"frame": 1, "bodies": {"tool": {"p_mm": [1, 2, 3], "q": [1, 0, 0]}}}',
        '{"frame": 1, "bodies": {"tool": {"p_mm": [1, 2, 3], "r": 1}}}',
        '{"frame": 1, "bodies": ' + '{"a":' * 9000 + "1" + "}" * 9000 + "}",
        "[" * 60000,
    ],
)
def test_what_is_no_frame(text: str) -> None:
    with pytest.raises(UnreadableError):
        json_frame(text.encode())


def test_no_line_is_an_exception_and_reasons_are_few() -> None:
    source = random.Random(1)
    good, reasons = line(3, tool={"p_mm": [1, 2, 3], "q": [1, 0, 0, 0]}), set()
    for _ in range(10_000):
        data = bytearray(good)
        for _ in range(source.randrange(1, 5)):
            at = source.randrange(len(data) + 1)
            data[at : at + source.randrange(4)] = source.choice((b"", b"9e99", b'"', b"{", source.randbytes(2)))
        try:
            json_frame(bytes(data))
        except UnreadableError as fault:
            reasons.add(str(fault))
    assert len(reasons) < 30


def test_datagrams_of_lines() -> None:
    tracker = JsonLinesTracker(JsonLinesSettings(port=0))
    tracker.open(RealClock())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for data in (line(1), line(2).strip(), line(3) + line(4), b"x\n" + line(5), line(5), line(9)):
            sender.sendto(data, tracker.address)
    assert [f.counter for f in tracker.frames()] == [1, 2, 3, 4, 5, 9]
    assert sum(tracker.refused.values()) == 2
    with pytest.raises(DeviceRefusedError):
        JsonLinesTracker(JsonLinesSettings(port=tracker.address[1])).open(RealClock())
    tracker.close()
    assert tracker.frames() == []


@pytest.mark.parametrize(
    "settings", [{}, {"port": 5, "path": "/a"}, {"path": "/a"}, {"port": -1}, {"port": 5, "host": "x"}]
)
def test_bad_settings(settings: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        JsonLinesSettings.model_validate(settings)
