"""The files of a new plugin: a package that installs, is checked and tested, with one small component."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from armcal.hooks import KINDS as HOOKS
from armcal.scaffold.folder import staged, write_texts
from armcal.scaffold.naming import PREFIX
from armcal.scaffold.rendering import TEMPLATES, rendered

# What the example of each kind is, and how many checks of the contract run on it and on its registration.
_EXAMPLES: Mapping[str, tuple[str, int]] = MappingProxyType(
    {
        "model": ("an arm whose joints all turn about parallel axes", 28),
        "effect": ("the error of a gear, once a turn of one of its wheels", 26),
        "measurement": ("the distance of the tip from a fixed point, read by a draw wire", 28),
        "estimator": ("least squares by SciPy's trust region method", 22),
        "reader": ("records from a file of JSON objects, one a line", 18),
        "device": ("servos on a board that takes pulses in microseconds", 38),
        "exporter": ("every parameter of a calibrated arm as plain text", 16),
    }
)
KINDS = tuple(_EXAMPLES)


def write_plugin(name: str, kind: str, folder: Path) -> tuple[str, ...]:
    """Write the package of a plugin; gives the files by their place in the folder.

    Args:
        name: of plugin and component, as ``naming.plugin_name`` gives it.
        kind: one of ``KINDS``.
        folder: to be made.

    Raises:
        InputError: it is there already, or cannot be written.
    """
    context = _context(name, kind)
    texts = {**rendered("plugin/common", context), **rendered(f"plugin/{kind}", context)}
    texts[f"{context['package']}/py.typed"] = ""
    with staged(folder) as place:
        write_texts(place, texts)
    return tuple(sorted(texts))


def _context(name: str, kind: str) -> dict[str, Any]:
    title = "".join(part.capitalize() for part in name.split("_"))
    summary, checks = _EXAMPLES[kind]
    example = (TEMPLATES / "plugin" / kind / "example.txt").read_text(encoding="utf-8")
    return {
        "name": name,
        "kind": kind,
        "article": "an" if kind[0] in "aeiou" else "a",
        "package": PREFIX + name,
        "distribution": (PREFIX + name).replace("_", "-"),
        "component": f"{title}{kind.capitalize()}",
        "settings": f"{title}Settings",
        "hook": HOOKS[kind],
        "summary": summary,
        "checks": checks,
        "example": example.replace("{{ name }}", name).rstrip(),
    }
