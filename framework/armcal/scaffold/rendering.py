"""Texts from the templates beside this file. Jinja is imported when it is needed."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

TEMPLATES = Path(__file__).with_name("templates")
SUFFIX = ".j2"
_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_YAML_WORDS = frozenset({"y", "n", "yes", "no", "on", "off", "true", "false", "null"})
_DIGITS = 12


def rendered(folder: str, context: Mapping[str, Any]) -> dict[str, str]:
    """Every template below a folder, by the path of what it makes.

    In paths ``PACKAGE`` stands for the context's package, and ``DOT`` for a dot, for hidden files may not be shipped.
    """
    import jinja2

    root = TEMPLATES / folder
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(root),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.filters |= {"word": word, "number": number}
    found = {}
    for path in sorted(root.rglob(f"*{SUFFIX}")):
        source = path.relative_to(root).as_posix()
        target = source.removesuffix(SUFFIX).replace("PACKAGE", str(context.get("package"))).replace("DOT", ".")
        found[target] = environment.get_template(source).render(context)
    return found


def word(text: str) -> str:
    """A text as a YAML scalar: plain where YAML reads it as text, else in double quotes."""
    plain = _PLAIN.fullmatch(text) and text.lower() not in _YAML_WORDS
    return text if plain else json.dumps(text, ensure_ascii=False)


def number(value: float) -> str:
    """A number as YAML 1.1 and people read it: no exponent, 12 digits."""
    text = np.format_float_positional(float(f"{value:.{_DIGITS}g}"), trim="-")
    return "0" if text == "-0" else text
