"""Whether servos hang on each other's channels, by what was measured of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from armcal.base.domains import Array

from armcal_bench.servo.entries import BEGUN, POSE
from armcal_bench.servo.nominal import NominalArm
from armcal_bench.servo.trial import Move, exchanged

_TURN = math.radians(10.0)
"""Of which a joint's move is taken: more shows more of what springs give."""


def mixed_up(entries: Sequence[Mapping[str, Any]], joints: Sequence[str], nominal: NominalArm) -> dict[str, str]:
    """Why the tables of some joints cannot be what was measured under their names, by joint."""
    begun = next((entry for entry in entries if entry["kind"] == BEGUN), None)
    moves = [move for joint in joints if (move := _move(entries, joint)) is not None]
    if begun is None or not moves:
        return {}
    base = {joint: float(angle) for joint, angle in begun["base"].items() if joint in nominal.joints}
    return {
        joint: f"what turned is {other}: exchange their channels in the servo file, or their plugs, and measure anew"
        for joint, other in exchanged(moves, base, nominal).items()
    }


def _move(entries: Sequence[Mapping[str, Any]], joint: str) -> Move | None:
    """Of two lines that came from the same side, the two that lie the usual turn apart."""
    lines = [e for e in entries if e["kind"] == POSE and e["joint"] == joint and joint in e["told"]]
    pairs = [(a, b) for i, a in enumerate(lines) for b in lines[i + 1 :] if a["came"] == b["came"]]
    turned = [(float(b["told"][joint] - a["told"][joint]), a, b) for a, b in pairs]
    turned = [each for each in turned if abs(each[0]) >= _TURN / 2]
    if not turned:
        return None
    told, before, after = min(turned, key=lambda each: abs(abs(each[0]) - _TURN))
    return Move(joint, told, _pose(before), _pose(after))


def _pose(line: Mapping[str, Any]) -> Array:
    pose = np.eye(4)
    pose[:3, :3] = np.nan if line["rotation"] is None else np.array(line["rotation"])
    pose[:3, 3] = line["position"]
    return pose
