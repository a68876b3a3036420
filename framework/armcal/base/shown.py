"""Names and texts from outside as they may be shown: what steers a terminal or breaks a file is written out."""

import unicodedata

_STEERING = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Controls, marks of direction and width, lone surrogates, separators of lines and paragraphs."""


def shown(text: str, keep: str = "\n\t") -> str:
    """A text without characters that steer whatever shows it: ``\\x1b`` stands for an escape character.

    Names, cells and messages of files are data, and whoever wrote them must not move a cursor, colour a line, hide a
    name or end an XML file. ``keep`` are the characters that stay as they are.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character if character in keep or unicodedata.category(character) not in _STEERING else _written(ord(character))
        for character in text
    )


def _written(code: int) -> str:
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
