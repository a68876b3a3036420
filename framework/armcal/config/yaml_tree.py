"""Trees of configuration nodes: merged, and changed at a path; every value keeps the place where it was written."""

import re
from dataclasses import replace
from pathlib import Path

from armcal.config.yaml_nodes import MAX_DEPTH, Node, Origin, read_nodes
from armcal.errors import ConfigError, Location

_STEPS = re.compile(r'(?:"([^"]+)"|([^."\s]+))(?:\.|$)')


def entries_of(node: Node) -> dict[str, Node]:
    return node.value if isinstance(node.value, dict) else {}


def merge(parent: Node, child: Node) -> Node:
    """The child over the parent: mappings merge, null removes the parent's key, anything else replaces."""
    if not (isinstance(parent.value, dict) and isinstance(child.value, dict)):
        return child
    entries = dict(parent.value)
    for key, node in child.value.items():
        if key not in entries:
            entries[key] = node
        elif node.value is None:
            del entries[key]
        else:
            entries[key] = merge(entries[key], node)
    return replace(child, value=entries)


def steps_of(name: str) -> tuple[str, ...] | None:
    """The keys of a dotted name, of which one that holds a dot stands in double quotes; None if it is not one."""
    matches = list(_STEPS.finditer(name))
    steps = tuple(match[1] or match[2] for match in matches)
    whole = "".join(match[0] for match in matches) == name and not name.endswith(".")
    return steps if whole and steps and len(steps) <= MAX_DEPTH else None


def override(tree: Node, text: str) -> Node:
    """The tree after one ``a.b=value``.

    Raises:
        ConfigError: the text is not of that form, or does not fit the tree.
    """
    assigned = assignment(text, "--set")
    if assigned is None:
        hint = "Write for example --set parameters.bounds=none; null as the value removes a key."
        where = Location(f"command line (--set {text})")
        raise ConfigError(f"found {text!r}, expected a dotted name, '=' and a value.", where=where, hint=hint)
    steps, value = assigned
    if steps[0] == "extends":
        hint = "Write it in the config."
        raise ConfigError("'extends' is read from files only.", where=value.origin.at(None), hint=hint)
    return set_at(tree, steps, value)


def assignment(text: str, option: str) -> tuple[tuple[str, ...], Node] | None:
    """The keys and the value of ``a.b=value`` from the command line; None if it is not of that form.

    Raises:
        ConfigError: the value is not YAML.
    """
    name, equals, written = text.partition("=")
    steps = steps_of(name.strip())
    if not equals or steps is None or not written.strip():
        return None
    origin = Origin(f"command line ({option} {name.strip()})", Path.cwd(), numbered=False, prefix=steps)
    return steps, read_nodes(written, origin) or Node(origin, 1, None)


def set_at(node: Node, steps: tuple[str, ...], value: Node) -> Node:
    """The tree with another value at a path; null removes.

    Raises:
        ConfigError: the path leads into a number or text, or to an index that a list has not.
    """
    if not steps:
        return value
    step, rest = steps[0], steps[1:]
    if isinstance(node.value, tuple):
        items = list(node.value)
        if not (step.isascii() and step.isdecimal() and len(step) < 10 and int(step) < len(items)):
            raise ConfigError(
                f"found the index {step!r} into a list of {len(items)} values.",
                where=value.origin.at(None),
                hint=f"Write an index from 0 to {len(items) - 1}." if items else "Override the whole list.",
            )
        items[int(step)] = set_at(items[int(step)], rest, value)
        return replace(node, value=tuple(items))
    if node.value is not None and not isinstance(node.value, dict):
        raise ConfigError(
            f"the key above {step!r} holds {str(node.value)[:60]!r}, expected a mapping or a list.",
            where=value.origin.at(None),
            hint="Override that key itself, or correct the name.",
        )
    entries = dict(entries_of(node))
    if not rest and value.value is None and step in entries:
        del entries[step]
    else:
        entries[step] = set_at(entries.get(step, Node(value.origin, 1, None)), rest, value)
    return replace(node, value=entries)
