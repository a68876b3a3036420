"""Names of plugins, robots and joints: usable as identifiers, file names and columns, and not taken."""

import importlib.util
import keyword
import re
from collections.abc import Sequence

from armcal.base.units import split_suffix
from armcal.errors import DataError, InputError, Location
from armcal.measure.reader import ENVIRONMENT
from armcal.plugins import PluginRegistry

_JOINT = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_TAKEN = frozenset({"x", "y", "z", "id", "pose_id", *(name for name, _ in ENVIRONMENT)})
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


def check_joint_names(names: Sequence[str], places: Sequence[Location]) -> None:
    """Refuse names that stand twice, or that a table has other columns for; ``places`` say where each stands.

    Raises:
        DataError: with the name.
    """
    for index, (name, where) in enumerate(zip(names, places, strict=True)):
        if not _JOINT.fullmatch(name):
            fault = "expected letters, digits, - and _, the first a letter"
        elif name in _TAKEN or name.startswith(("approach", "noise")):
            fault = "which tables of poses have for something else"
        elif split_suffix(name):
            fault = "which ends like a unit"
        elif name in names[:index]:
            fault = "a second time"
        else:
            continue
        raise DataError(f"found the joint name {name[:60]!r}, {fault}.", where=where, hint="Rename the joint.")
