"""Other origins in a URDF, in place: every byte that is not a changed number stays as it was."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from operator import itemgetter

from armcal_urdf.elements import UTF8, Three, words_of
from armcal_urdf.robot import UrdfJoint

_ROUNDING = 1e-13
"""m or rad: what a solver leaves of a number that nothing moved."""
_WHITE = b" \t\r\n"


@dataclass(frozen=True)
class Placed:
    """A joint and where it stands now: xyz (m) and rpy (rad)."""

    joint: UrdfJoint
    xyz: Three
    rpy: Three

    @property
    def changed(self) -> Mapping[str, Three]:
        """The attributes of which a number changed."""
        pairs = {"xyz": (self.joint.xyz, self.xyz), "rpy": (self.joint.rpy, self.rpy)}
        return {name: now for name, (before, now) in pairs.items() if before != now}


Edit = tuple[int, int, bytes]
"""Bytes from an offset to before another become new ones."""


@dataclass(frozen=True)
class _StartTag:
    """Where a start tag's name ends, where each attribute's value stands, and where the tag ends."""

    name_end: int
    values: Mapping[str, tuple[int, int]]
    end: int


def with_origins(text: str, placed: Iterable[Placed]) -> str:
    """The text with other origins of joints; ``placed`` has joints that were read from this very text."""
    data = text.encode(UTF8)
    edits = sorted((edit for joint in placed for edit in _edits(data, joint)), key=itemgetter(0))
    parts, here = [], 0
    for start, end, new in edits:
        parts += [data[here:start], new]
        here = end
    return b"".join([*parts, data[here:]]).decode(UTF8)


def _edits(data: bytes, placed: Placed) -> list[Edit]:
    element, changed = placed.joint.element, placed.changed
    origin = element.one("origin")
    if not changed:
        return []
    if origin is None:
        # as the joint's first element, on a line of its own if the next thing in it stands on one
        end = _start_tag(data, element.start).end
        inside = data[end:]
        lead = inside[: len(inside) - len(inside.lstrip(_WHITE))].decode(UTF8)
        attributes = " ".join(f'{name}="{_written(numbers, [])}"' for name, numbers in changed.items())
        return [(end, end, f"{lead}<origin {attributes}/>".encode())]
    tag = _start_tag(data, origin.start)
    edits = []
    for name, numbers in changed.items():
        if name in tag.values:
            edits.append((*tag.values[name], _written(numbers, words_of(origin.attributes[name])).encode()))
        else:
            edits.append((tag.name_end, tag.name_end, f' {name}="{_written(numbers, [])}"'.encode()))
    return edits


def _written(numbers: Three, before: list[str]) -> str:
    """Numbers that read back to the last bit; one that did not change, but for rounding, keeps its digits."""
    known = before if len(before) == len(numbers) else ["nan"] * len(numbers)
    pairs = zip(numbers, known, strict=True)
    return " ".join(word if abs(float(word) - now) <= _ROUNDING else repr(now) for now, word in pairs)


def _start_tag(data: bytes, start: int) -> _StartTag:
    """Walk through the start tag at an offset of a text that is known to be well-formed."""
    here = start + 1
    while data[here] not in b" \t\r\n/>":
        here += 1
    name_end = here
    values: dict[str, tuple[int, int]] = {}
    while True:
        while data[here] in _WHITE:
            here += 1
        if data[here] in b"/>":
            return _StartTag(name_end, values, data.index(b">", here) + 1)
        equals = data.index(b"=", here)
        name = data[here:equals].strip(_WHITE).decode(UTF8)
        here = equals + 1
        while data[here] in _WHITE:
            here += 1
        close = data.index(data[here : here + 1], here + 1)
        values[name] = (here + 1, close)
        here = close + 1
