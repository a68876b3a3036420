"""Datagrams as DTrack prints them: millimetres, degrees, and matrices column by column. [DTrack2]"""

from __future__ import annotations

import math
from collections.abc import Mapping

from armcal.base.domains import Array

_DAY_S = 86400.0
_LOST = "0 0.000][0.000 0.000 0.000][" + " ".join(["0.000000"] * 9) + "]"


def datagram(counter: int, stamp: float, bodies: Mapping[int, Array | None], lines: str) -> bytes:
    """One frame.

    Args:
        counter: its number.
        stamp: seconds of the tracker's clock; what is sent counts from midnight.
        bodies: ``world_T_body`` (4 x 4, m) by number; None where it is not seen: ``6d`` leaves it out, ``6di`` says so.
        lines: ``6d`` or ``6di``.
    """
    sorted_bodies = sorted(bodies.items(), key=lambda entry: entry[0])
    if lines == "6di":
        blocks = [_block_6di(number, pose) for number, pose in sorted_bodies]
    else:
        blocks = [_block_6d(number, pose) for number, pose in sorted_bodies if pose is not None]
    # the clock shows microseconds: rounding must not make it show 86400.000000
    of_day = math.floor((stamp % _DAY_S) * 1e6) / 1e6
    head = f"fr {counter}\r\nts {of_day:.6f}\r\n6dcal {len(bodies)}\r\n"
    return f"{head}{lines} {len(blocks)} {' '.join(blocks)}\r\n".encode("ascii")


def angles_deg(rotation: list[list[float]]) -> tuple[float, float, float]:
    """Of R = Rx(first) Ry(second) Rz(third) (degrees). [DTrack2]"""
    second = math.asin(min(max(rotation[0][2], -1.0), 1.0))
    first = math.atan2(-rotation[1][2], rotation[2][2])
    third = math.atan2(-rotation[0][1], rotation[0][0])
    return math.degrees(first), math.degrees(second), math.degrees(third)


def _block_6d(number: int, pose: Array) -> str:
    rows = pose.tolist()
    place = " ".join(f"{1000 * row[3]:.3f}" for row in rows[:3])
    turn = " ".join(f"{angle:.4f}" for angle in angles_deg(rows))
    return f"[{number} 1.000][{place} {turn}][{_columns(rows)}]"


def _block_6di(number: int, pose: Array | None) -> str:
    if pose is None:
        return f"[{number} {_LOST}"
    rows = pose.tolist()
    place = " ".join(f"{1000 * row[3]:.3f}" for row in rows[:3])
    return f"[{number} 2 0.000][{place}][{_columns(rows)}]"


def _columns(rows: list[list[float]]) -> str:
    return " ".join(f"{rows[row][column]:.6f}" for column in range(3) for row in range(3))
