"""Bytes of a URDF file to text and back, so that no byte is lost: the byte order mark stays in the text."""

import codecs
import re
from pathlib import Path
from typing import Literal, get_args

from armcal.errors import ConfigError, Location
from armcal.io.plain_files import input_bytes

Encoding = Literal["utf-8", "utf-16-le", "utf-16-be", "iso-8859-1", "us-ascii"]

MAX_BYTES = 256 * 1024
"""Of a URDF: a calibration holds it whole, and may have four times as many itself."""
_MOST = 1 << 26
"""Read at all, so that what is too large is refused with the reason."""
_MARKS: tuple[tuple[bytes, Encoding], ...] = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
    (b"<\0", "utf-16-le"),
    (b"\0<", "utf-16-be"),
)
_DECLARED = re.compile(r"""\ufeff?<\?xml\s[^>]*?encoding\s*=\s*["']([^"'>]*)["']""")
_OTHER_NAMES: dict[str, Encoding] = {
    "utf8": "utf-8",
    "ascii": "us-ascii",
    "latin-1": "iso-8859-1",
    "latin1": "iso-8859-1",
}


def read_text(path: Path) -> tuple[str, Encoding]:
    """The text of a file and its encoding.

    Raises:
        ConfigError: it cannot be read, is too large, or is not in the encoding that it declares.
    """
    return decode(input_bytes(path, _MOST, "a URDF file", ConfigError), str(path))


def decode(data: bytes, label: str) -> tuple[str, Encoding]:
    """Text and encoding; ``encode`` gives the same bytes back.

    Raises:
        ConfigError: too large, of an encoding that is not known, or not in the one it declares.
    """
    if len(data) > MAX_BYTES:
        raise ConfigError(
            f"the file is larger than {MAX_BYTES // 1024} KiB, which a calibration could not hold.",
            where=Location(label),
            hint="Keep meshes in files of their own, and leave out what is not the arm.",
        )
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), None)
    encoding = encoding or declared(data[:200].decode("iso-8859-1"), label) or "utf-8"
    try:
        return data.decode(encoding), encoding
    except UnicodeDecodeError as fault:
        line = data.count(b"\n", 0, fault.start) + 1
        raise ConfigError(
            f"the bytes at offset {fault.start} are not {encoding}.",
            where=Location(label, line),
            hint="Save the file as UTF-8, or declare its encoding in the first line.",
        ) from fault


def declared(text: str, label: str) -> Encoding | None:
    """The encoding that the text's first line declares, None if it declares none.

    UTF-16 cannot be recognised by the declaration alone, and a declaration of it in another encoding is wrong.

    Raises:
        ConfigError: it is not one of those known.
    """
    match = _DECLARED.match(text)
    if match is None:
        return None
    name = match[1].lower()
    name = _OTHER_NAMES.get(name, name)
    known = {encoding: encoding for encoding in get_args(Encoding)}
    if name not in known or name.startswith("utf-16"):
        raise ConfigError(
            f"found the encoding {match[1]!r}, expected UTF-8, UTF-16, ISO-8859-1 or US-ASCII and a text in it.",
            where=Location(label, 1),
            hint="Save the file as UTF-8.",
        )
    result: Encoding = known[name]
    return result


def encode(text: str, encoding: Encoding) -> bytes:
    """The bytes of a text.

    Raises:
        ValueError: it holds a character that the encoding has not.
    """
    try:
        return text.encode(encoding)
    except UnicodeEncodeError as fault:
        line = text.count("\n", 0, fault.start) + 1
        raise ValueError(f"line {line} of the URDF holds {text[fault.start]!r}, which {encoding} has not") from fault
