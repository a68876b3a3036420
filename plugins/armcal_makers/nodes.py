"""Numbers of a YAML file with the line of each: makers' tools write exponents that configurations refuse."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from armcal.config.yaml_nodes import Node, Origin, read_nodes
from armcal.config.yaml_tree import entries_of
from armcal.errors import DataError
from armcal.io.plain_files import refuse

AGAIN = "Extract the file from the robot again."


@dataclass(frozen=True)
class Entry:
    """Something in a file, and the keys that it stands under."""

    node: Node
    keys: tuple[str, ...] = ()

    def refuse(self, message: str, hint: str = AGAIN) -> NoReturn:
        raise DataError(message, where=self.node.origin.at(self.node.line, self.keys), hint=hint)

    @property
    def text(self) -> str | None:
        """A text; None of keys or a list."""
        return self.node.value if isinstance(self.node.value, str) else None

    @property
    def entries(self) -> dict[str, Entry]:
        return {key: Entry(node, (*self.keys, key)) for key, node in entries_of(self.node).items()}

    @property
    def number(self) -> float:
        """As a finite number.

        Raises:
            DataError: it is none.
        """
        try:
            value = math.nan if self.text is None else float(self.text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            shown = "a list or keys" if self.text is None else repr(self.text[:40])
            self.refuse(f"found {shown}, expected a number.")
        return value

    def section(self, key: str) -> Entry:
        """The section under a key.

        Raises:
            DataError: there is none.
        """
        entries = self.entries
        if key not in entries or not entries[key].entries:
            own = ", ".join(list(entries)[:12]) or "nothing"
            self.refuse(f"found {own}, expected {key}: and numbers under it.", "Check which file this is.")
        return entries[key]

    def numbers(self, keys: tuple[str, ...]) -> list[float]:
        """The numbers of exactly these keys.

        Raises:
            DataError: one is missing, too many, or not a number.
        """
        entries = self.entries
        if set(entries) != set(keys):
            self.refuse(f"found {', '.join(entries) or 'nothing'}, expected {', '.join(keys)}.")
        return [entries[key].number for key in keys]


def read_section(text: str, path: Path) -> Entry:
    """A YAML text as keys and texts.

    Raises:
        InputError: it is empty or no plain YAML.
    """
    root = read_nodes(text, Origin(str(path), path.parent), plain=str)
    if root is None or not entries_of(root):
        hint = "Give the kinematics YAML of ur_calibration or xarm_ros2, or calibration.conf of a UR."
        refuse(path, "it holds no keys, expected a maker's calibration.", hint)
    return Entry(root)
