"""What armcal's installed metadata asks for, and whether an installed version is in the range."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import metadata
from itertools import zip_longest

DISTRIBUTION = "armcal"
_REQUIREMENT = re.compile(
    r"^\s*(?P<name>[A-Za-z0-9._-]+)\s*(?:\[[^\]]*\])?\s*\(?(?P<range>[^;)]*)\)?\s*(?:;(?P<marker>.*))?$"
)
_EXTRA = re.compile(r"extra\s*==\s*['\"]([^'\"]+)['\"]")
_CLAUSE = re.compile(r"^\s*(>=|<=|==|!=|~=|>|<)\s*([0-9][0-9.]*)")


@dataclass(frozen=True)
class Requirement:
    """A distribution that is asked for; ``extra`` is empty for what armcal always needs."""

    name: str
    range: str
    extra: str = ""

    @property
    def key(self) -> str:
        """The name as one compares names: lower case, with hyphens."""
        return re.sub(r"[-_.]+", "-", self.name).lower()

    def admits(self, version: str) -> bool:
        """Whether a version is in the range; clauses that are not understood admit everything."""
        return all(_admits(clause, version) for clause in self.range.split(",") if clause.strip())


def declared() -> tuple[Requirement, ...]:
    """Everything armcal's metadata declares, extras included.

    Raises:
        PackageNotFoundError: armcal is not installed, only importable.
    """
    return tuple(parse(text) for text in metadata.requires(DISTRIBUTION) or [])


def parse(text: str) -> Requirement:
    """A requirement as metadata writes it: ``name[parts]>=1.2; extra == "x"``."""
    match = _REQUIREMENT.match(text)
    if match is None:
        return Requirement(text.strip(), "")
    extra = _EXTRA.search(match["marker"] or "")
    return Requirement(match["name"], match["range"].strip(), extra[1] if extra else "")


def installed(name: str) -> str | None:
    """The installed version of a distribution, or None."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _admits(clause: str, version: str) -> bool:
    match = _CLAUSE.match(clause)
    if match is None:
        return True
    installed, required = _release(version), _release(match[2])
    pairs = zip_longest(installed, required, fillvalue=0)
    order = next((a - b for a, b in pairs if a != b), 0)
    same_series = installed[: len(required) - 1] == required[:-1]
    return {
        ">=": order >= 0,
        "<=": order <= 0,
        "==": order == 0,
        "!=": order != 0,
        ">": order > 0,
        "<": order < 0,
        "~=": order >= 0 and same_series,
    }[match[1]]


def _release(version: str) -> tuple[int, ...]:
    match = re.match(r"\D*(\d+(?:\.\d+)*)", version)
    return tuple(int(part) for part in match[1].split(".")) if match else ()
