"""Checked settings from ``key=value`` texts of the command line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from armcal.base.settings import Settings
from armcal.config.validate import validate
from armcal.config.yaml_nodes import Node, Origin, read_nodes
from armcal.config.yaml_source import Reader, as_source
from armcal.config.yaml_tree import set_at, steps_of
from armcal.errors import ConfigError, Location

S = TypeVar("S", bound=Settings)


def settings_from(settings_class: type[S], texts: Sequence[str], option: str) -> S:
    """Settings from ``key=value`` texts, whose values are YAML; a dotted key is a key of a mapping.

    Args:
        settings_class: what they must make.
        texts: in the order given.
        option: by which they were given, such as ``--option``, for messages.

    Raises:
        ConfigError: a text is not of that form, or the settings are refused.
    """
    here = Path.cwd()
    tree = Node(Origin(option, here, numbered=False), 1, {})
    for text in texts:
        tree = _with(tree, text, option, here, settings_class)
    return validate(settings_class, as_source(tree, Path(option), Reader(here)))


def _with(tree: Node, text: str, option: str, here: Path, settings_class: type[Settings]) -> Node:
    name, equals, written = text.partition("=")
    steps = steps_of(name.strip())
    if not equals or steps is None or not written.strip():
        keys = ", ".join(settings_class.keys())
        raise ConfigError(
            f"found {text!r}, expected a key, '=' and a value.",
            where=Location(option),
            hint=f"The keys are {keys}." if keys else "There is nothing to set.",
        )
    origin = Origin(f"command line ({option} {name.strip()})", here, numbered=False, prefix=steps)
    return set_at(tree, steps, read_nodes(written, origin) or Node(origin, 1, None))
