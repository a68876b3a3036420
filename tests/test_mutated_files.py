"""Mutated files of other programs: each is refused with its place and a hint, or read as its numbers stand there."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from armcal.errors import EXIT_BAD_INPUT, ArmcalError
from armcal.plugins import discover
from armcal.scaffold.robot import read_rows
from armcal_camera.board import read_board
from armcal_camera.intrinsics import read_intrinsics
from armcal_lerobot.motor_files import read_motors

MUTANTS = 200
SEED = 1
NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")
ABSURD = (
    "nan",
    "inf",
    "-.inf",
    ".nan",
    "1e999",
    "1e300",
    "0",
    "-1",
    "1,5",
    "0x10",
    "1_0",
    "''",
    "~",
    "true",
    "abc",
    "[1, 2]",
)
ABSURD += (
    "1 2",
    "{a: 1}",
    "-",
    "1e-400",
    "9" * 400,
    "\u0661",
    "&a 1",
    "*a",
    "!!python/object:os.system 1",
    "2001-01-01",
)
INSERTED = (
    "",
    "---",
    "abc",
    ": :",
    "\t- 1",
    "a: &a [*a]",
    "{",
    "]",
    '"',
    "%YAML 1.2",
    "1,2,3",
    "# x",
    "\0",
    "cam1: {}",
)


def mutated(text: str, random: np.random.Generator) -> bytes:
    data, lines = text.encode(), text.splitlines(keepends=True)
    at, line = int(random.integers(len(data))), int(random.integers(len(lines)))
    kind = int(random.integers(11))
    if kind == 0:
        return data[:at] + bytes([data[at] ^ (1 << int(random.integers(8)))]) + data[at + 1 :]
    if kind == 1:
        return data[:at]
    if kind == 2:
        return data[:at] + data[at + int(random.integers(1, 30)) :]
    if kind == 3:
        return "".join(lines[:line] + lines[line + 1 :]).encode()
    if kind == 4:
        return "".join(lines[: line + 1] + lines[line:]).encode()
    if kind == 5:
        other = int(random.integers(len(lines)))
        lines[line], lines[other] = lines[other], lines[line]
        return "".join(lines).encode()
    if kind == 6:
        return "".join([*lines[:line], INSERTED[random.integers(len(INSERTED))] + "\n", *lines[line:]]).encode()
    if kind == 7:
        encoding = ("utf-16", "utf-8-sig", "utf-32")[random.integers(3)]
        return text.encode(encoding)
    numbers = [match.span() for match in NUMBER.finditer(text)]
    start, end = numbers[random.integers(len(numbers))]
    return (text[:start] + ABSURD[random.integers(len(ABSURD))] + text[end:]).encode()


def plain_yaml(text: str) -> Any:
    lines = "\n".join(line for line in text.splitlines() if not line.startswith("%YAML"))
    return next(filter(None, yaml.safe_load_all(lines.replace("!!opencv-matrix", ""))), None)


def of_camera(path: Path) -> list[float]:
    found = read_intrinsics(path)
    thousands = (found.fx, found.fy, found.cx, found.cy)
    return [*(1000 * x for x in thousands), *found.distortion, *(1000 * x for x in found.image or ())]


def stated(size: Any) -> list[float]:
    """An image's size; empty where it is none."""
    numbers = [float(x) for side in size for x in np.ravel(side)]
    return numbers if len(numbers) == 2 and min(numbers) > 0 else []


def camera_info(text: str) -> list[float]:
    content = plain_yaml(text)
    given = [content[key] for key in ("camera_matrix", "distortion_coefficients")]
    k, d = (np.ravel(x["data"] if isinstance(x, dict) else x) for x in given)
    sides = [content[key] for key in ("image_width", "image_height") if key in content]
    return [k[0], k[4], k[2], k[5], *d, *stated(sides)]


def camchain(text: str) -> list[float]:
    content = plain_yaml(text)
    content = content.get("cam0", content)
    return [*content["intrinsics"], *content["distortion_coeffs"], *stated(content.get("resolution", ()))]


def of_board(path: Path) -> list[float]:
    found = read_board(path)
    return [found.columns, found.rows, found.tag, found.spacing]


def target(text: str) -> list[float]:
    content = plain_yaml(text)
    tag = float(content["tagSize"])
    return [content["tagCols"], content["tagRows"], tag, tag * float(content["tagSpacing"])]


def of_motors(path: Path) -> list[float]:
    motors = read_motors(path).motors.values()
    return [x for m in motors for x in (m.id, m.drive_mode, m.homing_offset, m.range_min, m.range_max)]


def motors(text: str) -> list[float]:
    keys = ("id", "drive_mode", "homing_offset", "range_min", "range_max")
    return [motor[key] for motor in json.loads(text).values() for key in keys]


def of_rows(path: Path) -> list[float]:
    rows = read_rows(path, discover())
    return [x for row in rows for x in (*np.degrees([row.alpha, row.theta]), 1000 * row.a, 1000 * row.d)]


def rows(text: str) -> list[float]:
    table = csv.DictReader(io.StringIO(text.lstrip()))
    return [float(row[key] or 0) for row in table for key in ("alpha_deg", "theta_deg", "a_mm", "d_mm")]


CAMERA_INFO = """image_width: 640
image_height: 480
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [612.5, 0.0, 318.25, 0.0, 611.75, 243.5, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.125, -0.25, 0.001, -0.002, 0.0625]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 612.5, 0., 318.25, 0., 611.75, 243.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.125, -0.25, 1.0e-03, -2.0e-03, 0.0625 ]
"""
CAMCHAIN = """cam0:
  camera_model: pinhole
  intrinsics: [612.5, 611.75, 318.25, 243.5]
  distortion_model: radtan
  distortion_coeffs: [0.125, -0.25, 0.001, -0.002]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""
TARGET = """target_type: 'aprilgrid'
tagCols: 6
tagRows: 5
tagSize: 0.025
tagSpacing: 0.3
"""
MOTORS = """{
    "shoulder_pan": {"id": 1, "drive_mode": 0, "homing_offset": -137, "range_min": 755, "range_max": 3329},
    "elbow_flex": {"id": 3, "drive_mode": 0, "homing_offset": -954, "range_min": 861, "range_max": 3060},
    "gripper": {"id": 6, "drive_mode": 0, "homing_offset": 588, "range_min": 1903, "range_max": 3355}
}
"""
ROWS = """alpha_deg,a_mm,theta_deg,d_mm,name,lower_deg,upper_deg
0,0,0,333.5,q1,-160,160
-90,25,10,0,q2,-100,100
0,400,-5,12.5,q3,-120,120
90,0,0,420,q4,-180,180
"""
FORMATS: dict[str, tuple[str, Callable[[Path], list[float]], Callable[[str], list[float]]]] = {
    "camera_info.yaml": (CAMERA_INFO, of_camera, camera_info),
    "opencv.yaml": (OPENCV, of_camera, camera_info),
    "camchain.yaml": (CAMCHAIN, of_camera, camchain),
    "target.yaml": (TARGET, of_board, target),
    "motors.json": (MOTORS, of_motors, motors),
    "rows.csv": (ROWS, of_rows, rows),
}


@pytest.mark.parametrize("name", FORMATS)
def test_two_hundred_mutants_are_refused_or_read_as_they_stand(name: str, tmp_path: Path) -> None:
    text, read, plain = FORMATS[name]
    path, random, refused, taken = tmp_path / name, np.random.default_rng(SEED), 0, 0
    path.write_text(text)
    np.testing.assert_allclose(read(path), plain(text), rtol=1e-12)
    for _ in range(MUTANTS):
        data = mutated(text, random)
        path.write_bytes(data)
        try:
            found = read(path)
        except ArmcalError as fault:
            assert fault.exit_code == EXIT_BAD_INPUT
            assert name in str(fault), fault
            assert fault.hint or "write" in str(fault) or "Correct" in str(fault), fault
            refused += 1
            continue
        taken += 1
        assert np.isfinite(found).all(), data
        expected = np.array(plain(data.decode("utf-8-sig", "replace")), dtype=float)
        np.testing.assert_allclose(found, expected, rtol=1e-12, err_msg=str(data))
    assert refused > MUTANTS / 5
    assert taken > MUTANTS / 10
