"""Other origins in a URDF, in place: every byte that is not a changed number stays as it was."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from operator import itemgetter

from armcal_urdf.elements import UTF8, Three, words_of
from armcal_urdf.robot import UrdfJoint

_ROUNDING = 1e-13
"""m or rad: what a solver leaves of a number that nothing moved."""
_WHITE = b" \t\r\n"
_ATTRIBUTE = re.compile(rb"""\s+(?P<name>[^\s=/>]+)\s*=\s*(?P<value>"[^"]*"|'[^']*')""")
_START_TAG = re.compile(rb"""(?P<name><[^\s/>]+)(?:\s+[^\s=/>]+\s*=\s*(?:"[^"]*"|'[^']*'))*\s*/?>""")


@dataclass(frozen=True)
class Placed:
    """A joint and where it stands now: xyz (m) and rpy (rad)."""

    joint: UrdfJoint
    xyz: Three
    rpy: Three

    @property
    def changed(self) -> Mapping[str, Three]:
        pairs = {"xyz": (self.joint.xyz, self.xyz), "rpy": (self.joint.rpy, self.rpy)}
        return {name: now for name, (before, now) in pairs.items() if before != now}


Edit = tuple[int, int, bytes]
"""Bytes from an offset to before another become new ones."""


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
        _, _, end = _start_tag(data, element.start)
        inside = data[end:]
        lead = inside[: len(inside) - len(inside.lstrip(_WHITE))].decode(UTF8)
        attributes = " ".join(f'{name}="{_written(numbers, [])}"' for name, numbers in changed.items())
        return [(end, end, f"{lead}<origin {attributes}/>".encode())]
    name_end, values, _ = _start_tag(data, origin.start)
    edits = []
    for name, numbers in changed.items():
        if name in values:
            edits.append((*values[name], _written(numbers, words_of(origin.attributes[name])).encode()))
        else:
            edits.append((name_end, name_end, f' {name}="{_written(numbers, [])}"'.encode()))
    return edits


def _written(numbers: Three, before: list[str]) -> str:
    """Numbers that read back to the last bit; one that did not change, but for rounding, keeps its digits."""
    known = before if len(before) == len(numbers) else ["nan"] * len(numbers)
    pairs = zip(numbers, known, strict=True)
    return " ".join(word if abs(float(word) - now) <= _ROUNDING else repr(now) for now, word in pairs)


def _start_tag(data: bytes, start: int) -> tuple[int, dict[str, tuple[int, int]], int]:
    """Of the start tag at an offset: where its name ends, where each attribute's value stands, and where it ends."""
    match = _START_TAG.match(data, start)
    assert match is not None, "the text is well-formed"
    attributes = _ATTRIBUTE.finditer(data, match.end("name"), match.end())
    values = {m["name"].decode(UTF8): (m.start("value") + 1, m.end("value") - 1) for m in attributes}
    return match.end("name"), values, match.end()
