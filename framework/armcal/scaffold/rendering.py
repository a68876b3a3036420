"""Texts from the templates beside this file, and folders that appear whole or not at all."""

import json
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from armcal.errors import InputError, Location
from armcal.io.plain_files import writing

TEMPLATES = Path(__file__).with_name("templates")
SUFFIX = ".j2"
_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_YAML_WORDS = frozenset({"y", "n", "yes", "no", "on", "off", "true", "false", "null"})
_DIGITS = 12


def rendered(folder: str, context: Mapping[str, Any]) -> dict[str, str]:
    root = TEMPLATES / folder
    names = [path.relative_to(root).as_posix() for path in sorted(root.rglob(f"*{SUFFIX}"))]
    return {name.removesuffix(SUFFIX): rendered_file(f"{folder}/{name}", context) for name in names}


def rendered_file(template: str, context: Mapping[str, Any]) -> str:
    """One template, by its path below all."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.filters |= {"word": word, "number": number}
    return environment.get_template(template).render(context)


def word(text: str) -> str:
    """A text as a YAML scalar: plain where YAML reads it as text, else in double quotes."""
    plain = _PLAIN.fullmatch(text) and text.lower() not in _YAML_WORDS
    return text if plain else json.dumps(text, ensure_ascii=False)


def number(value: float) -> str:
    """A number as YAML 1.1 and people read it: no exponent, 12 digits."""
    text = np.format_float_positional(float(f"{value:.{_DIGITS}g}"), trim="-")
    return "0" if text == "-0" else text


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """A folder beside ``folder`` that takes its place at the end; on any fault nothing is left of it.

    Raises:
        InputError: something is there already, or the place cannot be written.
    """
    if folder.exists() or folder.is_symlink():
        hint = "Give another --out, or move it away."
        raise InputError("it is there already.", where=Location(str(folder)), hint=hint)
    with writing(folder, "Give --out a place that can be written."):
        folder.parent.mkdir(parents=True, exist_ok=True)
        place = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            yield place
            place.chmod(0o755)
            place.rename(folder)
        finally:
            shutil.rmtree(place, ignore_errors=True)


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Texts by their path in a folder, in UTF-8 with plain line ends."""
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="\n")
