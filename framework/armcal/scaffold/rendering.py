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
    """Every template of a folder, by the path of what it makes."""
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
