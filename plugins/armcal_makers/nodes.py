"""Numbers of a YAML file with the line of each: makers' tools write exponents that configurations refuse."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import yaml
from armcal.errors import DataError, Location
from armcal.io.plain_files import refuse

DEEPEST = 4
AGAIN = "Extract the file from the robot again."


@dataclass(frozen=True)
class Node:
    """Something in a file: where it stands."""

    path: Path
    line: int
    field: str

    def refuse(self, message: str, hint: str = AGAIN) -> NoReturn:
        """Raise a DataError here."""
        refuse(self.path, message, hint, self.line, self.field or None)


@dataclass(frozen=True)
class Scalar(Node):
    """A text."""

    text: str

    @property
    def number(self) -> float:
        """As a finite number.

        Raises:
            DataError: it is none.
        """
        try:
            value = float(self.text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            self.refuse(f"found {self.text[:40]!r}, expected a number.")
        return value


@dataclass(frozen=True)
class Section(Node):
    """Keys with what they hold."""

    entries: Mapping[str, Section | Scalar]

    @property
    def number(self) -> float:
        """None: keys stand where a number should; raises DataError."""
        self.refuse("found keys, expected a number.")

    def section(self, key: str) -> Section:
        """The section under a key.

        Raises:
            DataError: there is none.
        """
        entry = self.entries.get(key)
        if not isinstance(entry, Section):
            keys = ", ".join(list(self.entries)[:12]) or "nothing"
            self.refuse(f"found {keys}, expected {key}: and numbers under it.", "Check which file this is.")
        return entry

    def numbers(self, keys: tuple[str, ...]) -> list[float]:
        """The numbers of exactly these keys.

        Raises:
            DataError: one is missing, too many, or not a number.
        """
        if set(self.entries) != set(keys):
            own = ", ".join(self.entries) or "nothing"
            self.refuse(f"found {own}, expected {', '.join(keys)}.")
        return [self.entries[key].number for key in keys]


def read_section(text: str, path: Path) -> Section:
    """A YAML text as keys and scalars.

    Raises:
        DataError: it is empty, is not YAML, or has lists.
    """
    try:
        aliases = [e for e in yaml.parse(text, yaml.SafeLoader) if isinstance(e, yaml.AliasEvent)]
        if aliases:  # nested ones make billions of a few lines
            text = f"found the alias *{aliases[0].anchor}, expected a number."
            mark = aliases[0].start_mark
            refuse(path, text, AGAIN, None if mark is None else mark.line + 1)
        root = yaml.compose(text, yaml.SafeLoader)
    except (yaml.YAMLError, RecursionError) as fault:
        mark = getattr(fault, "problem_mark", None)
        reason = f"it is not YAML ({getattr(fault, 'problem', None) or type(fault).__name__})."
        where = Location(str(path), line=None if mark is None else mark.line + 1)
        raise DataError(reason, where=where, hint=AGAIN) from fault
    if not isinstance(root, yaml.MappingNode) or not root.value:
        hint = "Give the kinematics YAML of ur_calibration or xarm_ros2, or calibration.conf of a UR."
        refuse(path, "it holds no keys, expected a maker's calibration.", hint)
    return _section(root, path, "", 1)


def _section(node: yaml.MappingNode, path: Path, field: str, depth: int) -> Section:
    entries: dict[str, Section | Scalar] = {}
    for key, value in node.value:
        name = str(key.value)
        here = Node(path, key.start_mark.line + 1, f"{field}.{name}".lstrip("."))
        if name in entries:
            here.refuse("found this key a second time.", "Remove one of them.")
        if isinstance(value, yaml.MappingNode) and depth < DEEPEST:
            entries[name] = _section(value, path, here.field, depth + 1)
        elif isinstance(value, yaml.ScalarNode):
            entries[name] = Scalar(here.path, here.line, here.field, value.value)
        else:
            here.refuse("found a list or deeper keys, expected a number.", "Check which file this is.")
    return Section(path, node.start_mark.line + 1, field, entries)
