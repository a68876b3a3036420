"""Variants of one configuration: each the whole of it, with other files over it and values set or added."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from armcal.config.yaml_nodes import Node
from armcal.config.yaml_source import ConfigSource, Reader, as_source, parents_of, root_of
from armcal.config.yaml_tree import entries_of, merge, override, set_at, steps_of
from armcal.errors import ConfigError

SECTION = "study"
"""Says which variants there are, and is no part of any."""
_KEYS = ("extends", "set", "add")


@dataclass(frozen=True)
class Variants:
    """A configuration with its variants' section, and every variant without it, in the order written."""

    base: ConfigSource
    variants: dict[str, ConfigSource]


def load_variants(path: str | Path, overrides: Sequence[str] = (), root: Path | None = None) -> Variants:
    """Read ``study.variants`` of a YAML config; without any, the config itself is the only one, called as the file.

    A variant is the rest of the config, then what it ``extends`` (an earlier variant by its name, files), then the
    overrides, then the values that it sets (``set: {a.b: value}``) and the entries that it adds to lists
    (``add: {parameters.free: [name]}``).

    Raises:
        ConfigError: what was found, where, and the mend.
    """
    path = Path(path)
    reader = Reader(root_of(path, root))
    tree = reader.tree(path, ())
    for text in overrides:
        tree = override(tree, text)
    outside = [text for text in overrides if text.strip().partition("=")[0].partition(".")[0].strip() != SECTION]
    section = entries_of(tree).get(SECTION)
    listed = entries_of(section).get("variants") if section else None
    made: dict[str, Node] = {}
    for name, node in entries_of(listed).items() if listed else ():
        made[str(name)] = _variant(name, node, _without_section(tree), made, reader, outside)
    made = made or {path.stem: _without_section(tree)}
    sources = {name: as_source(made[name], path, reader) for name in made}
    return Variants(as_source(tree, path, reader), sources)


def _variant(
    name: str, node: Node, base: Node, earlier: dict[str, Node], reader: Reader, overrides: Sequence[str]
) -> Node:
    at = (SECTION, "variants", name)
    entries = entries_of(node)
    unknown = sorted(set(entries) - set(_KEYS))
    if unknown or not (isinstance(node.value, dict) or node.value is None):
        raise ConfigError(
            f"found {', '.join(unknown) or str(node.value)[:60]!r} in a variant, expected extends, set or add.",
            where=node.origin.at(node.line, at),
            hint=f"Write for example {name}: {{extends: FILE, set: {{parameters.bounds: none}}}}.",
        )
    tree, files = base, False
    for place, parent in enumerate(parents_of(node)):
        if str(parent) in earlier:
            tree = merge(tree, earlier[str(parent)]) if place else earlier[str(parent)]
            continue
        tree, files = merge(tree, _without_section(reader.parent(parent, ()))), True
    for text in overrides if files else ():
        tree = override(tree, text)
    for steps, value in _by_path(entries.get("set"), (*at, "set")):
        if value.value is None and _at(tree, steps) is None:
            raise ConfigError(
                f"found nothing at {'.'.join(steps)} to remove.",
                where=value.origin.at(value.line, (*at, "set")),
                hint="A key that itself holds dots stands in double quotes: 'a.\"b.c\"': null.",
            )
        tree = set_at(tree, steps, _with_prefix(value, steps))
    for steps, value in _by_path(entries.get("add"), (*at, "add")):
        tree = _added(tree, steps, value)
    return tree


def _without_section(tree: Node) -> Node:
    return replace(tree, value={key: node for key, node in entries_of(tree).items() if key != SECTION})


def _by_path(node: Node | None, at: tuple[str, ...]) -> list[tuple[tuple[str, ...], Node]]:
    """The values of a mapping whose keys are dotted names."""
    if node is None or node.value is None:
        return []
    variants = []
    for name, value in entries_of(node).items():
        steps = steps_of(str(name))
        if steps is None or steps[0] in ("extends", SECTION):
            raise ConfigError(
                f"found {str(name)!r}, expected the dotted name of a value.",
                where=value.origin.at(value.line, at),
                hint="Write for example parameters.bounds: none.",
            )
        variants.append((steps, value))
    if not isinstance(node.value, dict):
        where = node.origin.at(node.line, at)
        raise ConfigError("expected dotted names with values.", where=where, hint="Write NAME: value lines below it.")
    return variants


def _added(tree: Node, steps: tuple[str, ...], value: Node) -> Node:
    """The tree with more entries in a list, which is made if it is not there."""
    there = _at(tree, steps)
    more = value.value if isinstance(value.value, tuple) else (value,)
    if there is not None and there.value is not None and not isinstance(there.value, tuple):
        raise ConfigError(
            f"found {str(there.value)[:60]!r} at {'.'.join(steps)}, expected a list to add to.",
            where=value.origin.at(value.line),
            hint="Use set: to replace it.",
        )
    kept = there.value if there is not None and isinstance(there.value, tuple) else ()
    return set_at(tree, steps, _with_prefix(replace(value, value=(*kept, *more)), steps))


def _at(tree: Node, steps: tuple[str, ...]) -> Node | None:
    """The node at a path; list entries count from 0."""
    there: Node | None = tree
    for step in steps:
        if there is not None and isinstance(there.value, tuple):
            there = dict(zip(map(str, range(len(there.value))), there.value, strict=True)).get(step)
        else:
            there = entries_of(there).get(step) if there else None
    return there


def _with_prefix(node: Node, steps: tuple[str, ...]) -> Node:
    return replace(node, origin=replace(node.origin, prefix=steps))
