"""What lines of the record must be: one that was damaged must not become a table."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from armcal.arm.servo import COUNTS, PulseClock, PulseTable

BEGUN, POSE, ANGLE, LEFT_OUT = "begun", "pose", "angle", "left_out"
"""Kinds of lines."""

_ROTATION_OFF = 1e-6


def fault_of(entry: Any, is_first: bool) -> str:
    """Why a line cannot be what was written; empty if it can. Only the first says by what it was begun."""
    if not isinstance(entry, dict) or not isinstance(entry.get("kind"), str) or entry["kind"] not in _CHECKS:
        return "a line that is not an observation"
    if is_first != (entry["kind"] == BEGUN):
        return "a first line that does not say by which tables it was begun" if is_first else "a second beginning"
    try:
        good = _CHECKS[entry["kind"]](entry)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError):
        good = False
    return "" if good else "a damaged observation"


def _is_begun(entry: Mapping[str, Any]) -> bool:
    for servo in entry["servos"].values():
        PulseTable(tuple(_numbers(servo["angles"])), tuple(_numbers(servo["pulses"])))
        PulseClock(_number(servo["oscillator_hz"]), _whole(servo["prescale"]))
        if not isinstance(servo["board"], str) or not servo["oscillator_hz"] > 0:
            return False
        _whole(servo["channel"])
    _numbers(entry["base"].values())
    return bool(entry["servos"])


def _is_pose(entry: Mapping[str, Any]) -> bool:
    place = _is_place(entry) and 0 < _whole(entry["counts"]) < COUNTS
    deviations = [d for d in entry["deviations"] if d is not None]
    _numbers(entry["told"].values())
    sizes = len(_numbers(entry["position"])) == 3 and len(entry["deviations"]) == 6
    return place and sizes and all(d >= 0 for d in _numbers(deviations)) and _is_rotation(entry["rotation"])


def _is_rotation(rows: Any) -> bool:
    if rows is None:
        return True
    matrix = np.array([_numbers(row) for row in rows])
    if matrix.shape != (3, 3) or np.linalg.det(matrix) < 0:
        return False
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < _ROTATION_OFF)


def _is_angle(entry: Mapping[str, Any]) -> bool:
    _numbers((entry["angle"], entry["target"]))
    return _is_place(entry) and 0 < _whole(entry["counts"]) < COUNTS and _number(entry["sd"]) > 0


def _is_left_out(entry: Mapping[str, Any]) -> bool:
    about = _whole(entry["counts"]) if "counts" in entry else _number(entry["target"])
    return _is_place(entry) and math.isfinite(about)


def _is_place(entry: Mapping[str, Any]) -> bool:
    _number(entry["at"])
    warm = all(len(_numbers(parts)) == 2 for parts in entry.get("warmth", {}).values())
    return warm and isinstance(entry["joint"], str) and entry["came"] in (-1, 1)


def _numbers(values: Sequence[Any] | Any) -> list[float]:
    return [_number(value) for value in values]


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError("no number")
    return float(value)


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError("no whole number")
    return value


_CHECKS: Mapping[str, Callable[[Mapping[str, Any]], bool]] = {
    BEGUN: _is_begun,
    POSE: _is_pose,
    ANGLE: _is_angle,
    LEFT_OUT: _is_left_out,
}
