"""Designs of an arm: one configuration, with other values set in each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from armcal.config.yaml_nodes import Node
from armcal.config.yaml_source import ConfigSource, Reader, as_source, root_of
from armcal.config.yaml_tree import entries_of, override, set_at, steps_of
from armcal.errors import ConfigError

SECTION, DESIGNS = "capability", "designs"


def load_designs(path: str | Path, overrides: Sequence[str] = ()) -> dict[str, ConfigSource]:
    """The designs that ``capability.designs`` of a configuration lists, each a whole configuration.

    A design is a mapping of dotted names to values (``{arms.arm.model.base.4.ry_deg: 45}``), as after ``--set``.

    Raises:
        ConfigError: a name leads nowhere, with its place.
    """
    path = Path(path)
    reader = Reader(root_of(path, None))
    tree = reader.tree(path, ())
    for text in overrides:
        tree = override(tree, text)
    section = entries_of(tree).get(SECTION)
    listed = entries_of(section).get(DESIGNS) if section else None
    config_sources = {}
    for name, node in entries_of(listed).items() if listed else ():
        made = tree
        for steps, value in _values(node, (SECTION, DESIGNS, str(name)), tree):
            made = set_at(made, steps, value)
        config_sources[str(name)] = as_source(made, path, reader)
    return config_sources


def _values(node: Node, at: tuple[str, ...], tree: Node) -> Iterator[tuple[tuple[str, ...], Node]]:
    if not (isinstance(node.value, dict) or node.value is None):
        raise ConfigError(
            f"found {str(node.value)[:60]!r} for a design, expected names with values.",
            where=node.origin.at(node.line, at),
            hint="Write for example {arms.arm.model.rows.1.d_mm: 10}, or {} for the arm as it is.",
        )
    for name, value in entries_of(node).items():
        steps = steps_of(str(name))
        if steps is None or steps[0] == SECTION or steps[0] not in entries_of(tree):
            raise ConfigError(
                f"found {str(name)!r}, expected the dotted name of a value of the arm.",
                where=value.origin.at(value.line, at),
                hint="Write for example arms.arm.model.rows.1.d_mm: 10; entries of a list count from 0.",
            )
        yield steps, replace(value, origin=replace(value.origin, prefix=steps))
