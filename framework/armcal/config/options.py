"""Checked settings from ``key=value`` texts of the command line."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from armcal.base.settings import Settings
from armcal.config.validate import validate
from armcal.config.yaml_nodes import Node, Origin
from armcal.config.yaml_source import Reader, as_source
from armcal.config.yaml_tree import assignment, set_at
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
        assigned = assignment(text, option)
        if assigned is None:
            keys = ", ".join(settings_class.keys())
            raise ConfigError(
                f"found {text!r}, expected a key, '=' and a value.",
                where=Location(option),
                hint=f"The keys are {keys}." if keys else "There is nothing to set.",
            )
        tree = set_at(tree, *assigned)
    return validate(settings_class, as_source(tree, Path(option), Reader(here)))
