"""Names for what is scaffolded: usable as identifiers and file names, and not taken."""

from __future__ import annotations

import importlib.util
import keyword
import re

from armcal.errors import InputError
from armcal.plugins import PluginRegistry

LONGEST = 20
"""Characters; lines with a longer name would no longer fit the width that the plugin's own linter asks for."""
PREFIX = "armcal_"
_PLUGIN = re.compile(r"[a-z][a-z0-9_]*")
_ROBOT = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


def plugin_name(text: str, registry: PluginRegistry) -> str:
    """The name of a new plugin and its component, hyphens made underscores.

    Raises:
        InputError: it is no name for a Python module, or is taken.
    """
    name = text.replace("-", "_")
    _check_length(text, name)
    if name.startswith(PREFIX):
        mend = f"Leave {PREFIX} out: the package gets it by itself."
        raise InputError(f"found the name {text!r}, expected what comes after {PREFIX}.", hint=mend)
    if not _PLUGIN.fullmatch(name) or keyword.iskeyword(name):
        raise InputError(
            f"found the name {text!r}, expected a Python name of small letters, digits, - and _.",
            hint="Begin with a letter, as in draw-wire.",
        )
    _check_free(name, registry)
    return name


def robot_name(text: str) -> str:
    """The name of a new robot: of its folder and its experiments.

    Raises:
        InputError: it is no name for both.
    """
    _check_length(text, text)
    if not _ROBOT.fullmatch(text):
        raise InputError(
            f"found the name {text!r}, expected letters, digits, - and _.", hint="Begin with a letter, as in arm5."
        )
    return text


def _check_length(text: str, name: str) -> None:
    if len(name) > LONGEST:
        shown = text if len(text) <= 2 * LONGEST else f"{text[: 2 * LONGEST]}..."
        raise InputError(
            f"found the name {shown!r} of {len(name)} characters, expected at most {LONGEST}.", hint="Shorten it."
        )


def _check_free(name: str, registry: PluginRegistry) -> None:
    """Neither a plugin nor a component, of whatever kind, nor a package has the name."""
    taken = ""
    if any(plugin.name == name for plugin in registry.plugins):
        taken = f"a plugin is called {name!r} already"
    for component in registry.components:
        if component.name == name:
            taken = f"the plugin {component.plugin!r} offers the {component.kind} {name!r} already"
    if not taken and importlib.util.find_spec(PREFIX + name) is not None:
        taken = f"a package {PREFIX}{name} is installed already"
    if taken:
        raise InputError(f"{taken}.", hint="Choose another name; `armcal plugins list` shows those that are taken.")
