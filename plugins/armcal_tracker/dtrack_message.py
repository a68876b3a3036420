"""What stands in a datagram of DTrack's ASCII output. [DTrack2]

    fr 21753                            frame counter; always the first line
    ts 39596.024831                     seconds since midnight UTC, by the controller's clock
    6dcal 3                             how many bodies are calibrated; passed over, as all other lines are
    6d 1 [0 1.000][x y z η θ φ][b0 ... b8]      bodies that are seen: number, quality; mm, degrees; a matrix
    6di 1 [0 2 0.000][x y z][b0 ... b8]         all bodies: number, state, drift

Matrices stand column by column. The angles are not used: the matrix says it all.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from armcal.base.domains import Array

from armcal_tracker.unreadable import UnreadableError

NOT_A_ROTATION = 1e-3
"""A matrix may be so far from a rotation, in any entry of R^T R: six decimals are printed."""
FARTHEST_MM = 1e6
MOST_BODIES = 1000

_OPTICAL, _BOTH = 2, 3
"""States of ``6di`` in which the cameras see the body; by its gyroscopes alone (1) its place is a guess."""
_SHAPES = {"6d": (2, 6, 9), "6di": (3, 3, 9)}
_BLOCK = re.compile(r"\[([^\[\]]*)\]")
_COUNTER = re.compile(r"[0-9]{1,10}")


@dataclass(frozen=True)
class Message:
    """One frame as it stands in a datagram.

    Attributes:
        counter: of frames.
        of_day: when it was taken (s since midnight UTC), where it says so.
        bodies: ``world_T_body`` (4 x 4, m) by number; None where it is listed as lost.
        wrong: why bodies that are listed as seen count as lost, with how many.
    """

    counter: int
    of_day: float | None = None
    bodies: Mapping[str, Array | None] = field(default_factory=dict)
    wrong: Mapping[str, int] = field(default_factory=dict)


def messages(data: bytes) -> list[Message]:
    """The frames in a datagram: one, unless somebody has put several into it.

    Raises:
        UnreadableError: any of it cannot be read, or tells nothing of bodies.
    """
    try:
        text = data.rstrip(b"\0").decode("ascii")
    except UnicodeDecodeError:
        raise UnreadableError("not ASCII text") from None
    lines = [line.strip() for line in text.replace("\r", "\n").split("\n")]
    lines = [line for line in lines if line]
    if not lines or not lines[0].startswith("fr "):
        raise UnreadableError("no frame counter in the first line (fr)")
    starts = [i for i, line in enumerate(lines) if line.startswith("fr ")]
    return [_message(lines[a:b]) for a, b in zip(starts, [*starts[1:], len(lines)], strict=True)]


def _message(lines: list[str]) -> Message:
    by_name: dict[str, str] = {}
    for line in lines:
        name, _, rest = line.partition(" ")
        if name in ("fr", "ts", "6d", "6di"):
            if name in by_name:
                raise UnreadableError(f"two lines {name} in a frame")
            by_name[name] = rest
    if "6d" not in by_name and "6di" not in by_name:
        raise UnreadableError("no line of bodies (6d or 6di): switch it on in DTrack's output settings")
    wrong: dict[str, int] = {}
    bodies: dict[str, Array | None] = {}
    for name in ("6d", "6di"):  # 6di stands above: it knows a body's state
        if name in by_name:
            bodies |= _bodies(by_name[name], name, wrong)
    return Message(_counter(by_name["fr"]), _of_day(by_name.get("ts")), bodies, wrong)


def _counter(text: str) -> int:
    text = text.strip()
    if _COUNTER.fullmatch(text) is None:
        raise UnreadableError("a frame counter that is no number")
    return int(text)


def _of_day(text: str | None) -> float | None:
    if text is None:
        return None
    found = _numbers(text, 1, "ts")[0]
    if not 0 <= found <= 86401:  # a leap second
        raise UnreadableError("a time stamp that is no time of day")
    return found


def _bodies(text: str, name: str, wrong: dict[str, int]) -> dict[str, Array | None]:
    """Of a line ``6d`` or ``6di``; counts what is ``wrong``."""
    count, _, rest = text.partition(" ")
    if _COUNTER.fullmatch(count) is None or int(count) > MOST_BODIES:
        raise UnreadableError(f"a line {name} without its number of bodies")
    blocks = _BLOCK.findall(rest)
    if len(blocks) != 3 * int(count) or _BLOCK.sub("", rest).strip():
        raise UnreadableError(f"a line {name} with another number of bodies than it says: cut?")
    found: dict[str, Array | None] = {}
    for i in range(0, len(blocks), 3):
        head, place, turn = (_numbers(blocks[i + k], _SHAPES[name][k], name) for k in range(3))
        number = str(int(head[0]))
        if head[0] != int(head[0]) or not 0 <= head[0] <= 1e6 or number in found:
            raise UnreadableError(f"a line {name} with a body twice, or without its number")
        found[number] = _pose(place, turn, wrong) if _is_seen(name, head[1], wrong) else None
    return found


def _is_seen(name: str, said: float, wrong: dict[str, int]) -> bool:
    """By the quality of ``6d`` (-1: lost), or the state of ``6di``."""
    if name == "6d":
        return said >= 0
    if said == 1:
        _count(wrong, "a body tracked by its gyroscopes alone")
    return said in (_OPTICAL, _BOTH)


def _pose(place: list[float], turn: list[float], wrong: dict[str, int]) -> Array | None:
    if max(map(abs, place[:3])) > FARTHEST_MM:
        _count(wrong, "a body more than 1 km away")
        return None
    a, b, c = turn[:3], turn[3:6], turn[6:]
    squares = (_dot(a, a) - 1, _dot(b, b) - 1, _dot(c, c) - 1, _dot(a, b), _dot(b, c), _dot(c, a))
    cross = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    if max(map(abs, squares)) > NOT_A_ROTATION or _dot(cross, c) < 0:
        _count(wrong, "a matrix that is no rotation")
        return None
    x, y, z = place[:3]
    return np.array(
        [[a[0], b[0], c[0], x / 1000], [a[1], b[1], c[1], y / 1000], [a[2], b[2], c[2], z / 1000], [0.0, 0.0, 0.0, 1.0]]
    )


def _dot(a: tuple[float, ...] | list[float], b: list[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _numbers(text: str, count: int, name: str) -> list[float]:
    """So many finite numbers.

    Raises:
        UnreadableError: there are others, or none.
    """
    try:
        found = [float(part) for part in text.split()]
    except ValueError:
        raise UnreadableError(f"a line {name} with something that is no number") from None
    if len(found) != count or "_" in text:
        raise UnreadableError(f"a line {name} with another number of values than it has")
    if not all(map(math.isfinite, found)):
        raise UnreadableError(f"a line {name} with a number that is not finite")
    return found


def _count(wrong: dict[str, int], reason: str) -> None:
    wrong[reason] = wrong.get(reason, 0) + 1
