"""Texts of configurations, which remember where they were written; JSON; and texts as they may be shown."""

import json
import math
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from armcal.errors import ConfigError, Location


class ConfigText(str):
    """A text scalar of a config, which remembers where it was written."""

    location: Location  # where it was written
    base_dir: Path  # of a relative path in it: that of its file; of a value from the command line the working directory
    root: Path | None  # the directory that a path in it may not leave; None: anywhere (from the command line)

    def __new__(
        cls,
        text: str,
        location: Location | None = None,
        base_dir: Path | None = None,
        root: Path | None = None,
    ) -> Self:
        made = super().__new__(cls, text)
        made.location = location or Location()
        made.base_dir = base_dir or Path.cwd()
        made.root = root
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        return ConfigText, (str(self), self.location, self.base_dir, self.root)


def plain(value: Any) -> Any:
    """A config value with every text turned into an ordinary ``str``, through mappings and lists."""
    if isinstance(value, str):
        return str(value)
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [plain(entry) for entry in value]
    return value


def as_json(content: Any, indent: int | None = 2) -> str:
    """JSON text; null for a number that is not finite, which JSON has no word for."""
    return json.dumps(finite(content), indent=indent, allow_nan=False)


def finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def resolve_path(text: ConfigText | str) -> Path:
    """The absolute path that a config's text names; it need not exist.

    An ordinary ``str`` is relative to the working directory and may name any place.

    Raises:
        ConfigError: not a path, or outside the root once symbolic links are followed.
    """
    where = text.location if isinstance(text, ConfigText) else None
    base = text.base_dir if isinstance(text, ConfigText) else Path.cwd()
    root = text.root if isinstance(text, ConfigText) else None
    if not text.strip() or "\0" in text:
        raise ConfigError(
            f"found {str(text)!r}, expected the path of a file.",
            where=where,
            hint="Name the file, or leave the key out.",
        )
    try:
        path = (base / text).resolve()
        limit = root.resolve() if root is not None else None
    except (OSError, RuntimeError, ValueError) as fault:
        raise ConfigError(
            f"the path {str(text)!r} cannot be followed ({fault}).",
            where=where,
            hint="Check its spelling and its symbolic links.",
        ) from fault
    if limit is not None and not path.is_relative_to(limit):
        raise ConfigError(
            f"the path {str(text)!r} leads to {path}, outside {limit}: what a configuration names lies below "
            "its folder.",
            where=where,
            hint="Copy the file into that folder, or name it on the command line, which may name any place: data by "
            "--data PATH, other files by --set.",
        )
    return path


def as_line(content: Mapping[str, Any]) -> str:
    try:
        return json.dumps(content, allow_nan=False)
    except ValueError:
        return as_json(content, indent=None)


_STEERING = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Controls, marks of direction and width, lone surrogates, separators of lines and paragraphs."""


def shown(text: str, keep: str = "\n\t") -> str:
    """A text without characters that steer whatever shows it: ``\\x1b`` stands for an escape character.

    Names, cells and messages of files are data: they must not move a cursor, colour a line or end an XML file.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character if character in keep or unicodedata.category(character) not in _STEERING else _written(ord(character))
        for character in text
    )


def _written(code: int) -> str:
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
