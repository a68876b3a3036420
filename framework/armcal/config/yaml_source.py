"""A configuration as it was written: files that extend others, overrides, and the place of every value."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import yaml

from armcal.base.config_text import ConfigText, resolve_path
from armcal.base.units import split_suffix
from armcal.config.yaml_nodes import (
    Node,
    Origin,
    Step,
    dotted,
    entries_of,
    merge,
    needs_quotes,
    override,
    read_nodes,
    set_at,
    steps_of,
)
from armcal.errors import ConfigError, Location
from armcal.io.plain_files import input_bytes

MAX_BYTES = 16 << 20  # A calibration with 600 free parameters, or with 50 000 records of a drift, is smaller
MAX_FILES = 32


def _as_plain_text(dumper: Any, text: ConfigText) -> Any:
    style = '"' if needs_quotes(text) else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", str(text), style=style)


# PyYAML looks a class up exactly, so a subclass of str must be made known to both families of dumpers.
yaml.representer.SafeRepresenter.add_representer(ConfigText, _as_plain_text)
yaml.representer.Representer.add_representer(ConfigText, _as_plain_text)


@dataclass(frozen=True)
class ConfigSource:
    """A merged configuration and where each value was written."""

    data: dict[str, Any]  # plain nested dicts, lists and scalars; every text is a `ConfigText`
    marks: Mapping[tuple[Step, ...], Location]  # of the value at each path (``("rows", 2, "d_mm")``); ``()``: the whole
    path: Path  # the config that was asked for
    root: Path  # the directory that no path in it may leave
    files: tuple[Path, ...]  # every file read, the one asked for first

    def where(self, path: tuple[Step, ...]) -> Location:
        """The place of a path, or of its nearest parent that was written; ``("d",)`` also finds ``d_mm``."""
        steps: list[Step] = []
        value: Any = self.data
        for step in path:
            key = find_key(value, step)
            if key is None or (*steps, key) not in self.marks:
                break
            steps.append(key)
            value = value[key]
        return replace(self.marks[tuple(steps)], field=dotted((*steps, *path[len(steps) :])) or None)

    def refuse(self, path: tuple[Step, ...], message: str, hint: str = "") -> NoReturn:
        raise ConfigError(message, where=self.where(path), hint=hint)


def find_key(value: Any, step: Step) -> Step | None:
    """The key or index of a config value that a step means: itself, or that name with a unit after it."""
    if isinstance(value, list):
        return step if isinstance(step, int) and 0 <= step < len(value) else None
    if not isinstance(value, dict):
        return None
    if step in value:
        return step
    for key in value:
        split = split_suffix(key)
        if split is not None and split[0] == step:
            return str(key)
    return None


def load_config(
    path: str | Path,
    overrides: Sequence[str] = (),
    check: Callable[[str], object] | None = None,
    content: bytes | None = None,
) -> ConfigSource:
    """Read a YAML config with all that it extends, and apply overrides, ``a.b=value`` each.

    A value is YAML, a list is indexed (``rows.2.d_mm=3``), null removes a key, and a key that holds a dot is put in
    double quotes. ``check`` is given the text of the config before anything is made of it, and may raise. ``content``
    is what the config holds, where its file need not be there; such a config names no other file.
    """
    path = Path(path)
    # A path below a file leads nowhere.
    reader = Reader(_root_of(path if content is None else path / path.name), check, content)
    tree = reader.tree(path, ())
    for text in overrides:
        tree = override(tree, text)
    return as_source(tree, path, reader)


def _root_of(path: Path) -> Path:
    try:
        return path.parent.resolve()
    except (OSError, RuntimeError, ValueError) as fault:
        _refuse_file(path, f"this path cannot be followed ({fault}).", "Check its spelling and its symbolic links.")


def as_source(tree: Node, path: Path, reader: Reader) -> ConfigSource:
    marks: dict[tuple[Step, ...], Location] = {}

    def build(node: Node, at: tuple[Step, ...]) -> Any:
        marks[at] = node.origin.at(node.line, ())
        if isinstance(node.value, dict):
            return {key: build(entry, (*at, key)) for key, entry in node.value.items()}
        if isinstance(node.value, tuple):
            return [build(entry, (*at, index)) for index, entry in enumerate(node.value)]
        return _scalar(node, at)

    return ConfigSource(build(tree, ()), marks, path, reader.root, tuple(reader.files))


def _refuse_file(path: Path, message: str, hint: str) -> NoReturn:
    raise ConfigError(message, where=Location(str(path)), hint=hint)


def _read_text(path: Path, content: bytes | None = None) -> str:
    try:
        raw = input_bytes(path, MAX_BYTES, "a YAML file", ConfigError) if content is None else content
    except ConfigError as fault:
        near = difflib.get_close_matches(path.name, sorted(p.name for p in path.parent.glob("*.y*ml")), n=1)
        if near and isinstance(fault.__cause__, FileNotFoundError):
            _refuse_file(path, fault.message, f"Did you mean {path.parent / near[0]}?")
        raise
    try:
        return raw.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as fault:
        line = raw.count(b"\n", 0, fault.start) + 1
        message = f"the byte 0x{raw[fault.start]:02x} at offset {fault.start} is not UTF-8."
        raise ConfigError(message, where=Location(str(path), line), hint="Save the file as UTF-8.") from fault


@dataclass
class Reader:
    """Reads a config and what it extends, each file once."""

    root: Path
    check: Callable[[str], object] | None = None
    content: bytes | None = None
    files: list[Path] = field(default_factory=list)
    done: dict[Path, Node] = field(default_factory=dict)

    def tree(self, path: Path, chain: tuple[Path, ...]) -> Node:
        """The merged tree of a file; ``chain`` is who extends it, resolved."""
        text = _read_text(path, None if chain else self.content)
        if self.check and not chain:
            self.check(text)
        resolved = path.resolve()
        if resolved in self.done:
            return self.done[resolved]
        if len(self.files) >= MAX_FILES:
            _refuse_file(path, f"more than {MAX_FILES} files extend one another.", "Merge some of them.")
        self.files.append(path)
        origin = Origin(str(path), path.parent, self.root)
        own = _mapping(read_nodes(text, origin), origin)
        merged: Node | None = None
        for parent in parents_of(own):
            base = self.parent(parent, (*chain, resolved))
            merged = base if merged is None else merge(merged, base)
        entries = {key: node for key, node in entries_of(own).items() if key != "extends"}
        own = replace(own, value=entries)
        self.done[resolved] = own if merged is None else merge(merged, own)
        return self.done[resolved]

    def parent(self, text: ConfigText, chain: tuple[Path, ...]) -> Node:
        """The merged tree of a file that ``extends`` names."""
        resolved = resolve_path(text)
        if resolved in chain:
            circle = " -> ".join(p.name for p in (*chain[chain.index(resolved) :], resolved))
            raise ConfigError(
                f"the files extend one another in a circle: {circle}.",
                where=text.location,
                hint="Remove one of these 'extends'.",
            )
        try:
            return self.tree(text.base_dir / text, chain)
        except ConfigError as fault:
            if fault.where is not None and fault.where.line is None and text.location.file != fault.where.file:
                hint = f"{fault.hint} It is named by 'extends' in {text.location.file}:{text.location.line}."
                raise ConfigError(fault.message, where=fault.where, hint=hint) from fault
            raise


def _mapping(node: Node | None, origin: Origin) -> Node:
    if node is None or node.value is None:
        hint = "Write at least one 'key: value' line."
        raise ConfigError("the file is empty, expected keys and values.", where=origin.at(None), hint=hint)
    if not isinstance(node.value, dict):
        kind = "a list" if isinstance(node.value, tuple) else f"the value {str(node.value)[:60]!r}"
        raise ConfigError(
            f"found {kind} at the top, expected keys and values.",
            where=origin.at(node.line),
            hint="Write 'key: value' lines; put a space after each colon.",
        )
    return node


def parents_of(node: Node) -> list[ConfigText]:
    """The names under ``extends``."""
    named = entries_of(node).get("extends")
    if named is None:
        return []
    nodes = named.value if isinstance(named.value, tuple) else (named,)
    texts = [_scalar(n, ("extends",)) for n in nodes]
    if not all(isinstance(t, ConfigText) for t in texts) or len(set(texts)) < len(texts):
        raise ConfigError(
            "'extends' is neither a file name nor a list of different file names.",
            where=named.origin.at(named.line, ("extends",)),
            hint="Write for example 'extends: base.yaml'.",
        )
    return texts


def _scalar(node: Node, path: tuple[Step, ...]) -> Any:
    if isinstance(node.value, str):
        return ConfigText(node.value, node.origin.at(node.line, path), node.origin.base_dir, node.origin.root)
    return node.value


VARIANTS = ("study", "variants")  # Where a study lists its variants; the section is no part of any
_KEYS = ("extends", "set", "add")


@dataclass(frozen=True)
class Variants:
    """A configuration with its variants' section, and every variant without it, in the order written."""

    base: ConfigSource
    variants: dict[str, ConfigSource]


def load_variants(path: str | Path, overrides: Sequence[str] = (), listed: tuple[str, str] = VARIANTS) -> Variants:
    """Read the variants that a YAML config lists; without any, the config itself is the only one, called as the file.

    A variant is the rest of the config, then what it ``extends`` (an earlier variant by its name, files), then the
    overrides, then the values that it sets (``set: {a.b: value}``) and the entries that it adds to lists
    (``add: {parameters.free: [name]}``).
    """
    path = Path(path)
    reader = Reader(_root_of(path))
    tree = reader.tree(path, ())
    for text in overrides:
        tree = override(tree, text)
    outside = [text for text in overrides if text.strip().partition("=")[0].partition(".")[0].strip() != listed[0]]
    section = entries_of(tree).get(listed[0])
    variants = entries_of(section).get(listed[1]) if section else None
    made: dict[str, Node] = {}
    for name, node in entries_of(variants).items() if variants else ():
        made[str(name)] = _variant((*listed, str(name)), node, _without(tree, listed[0]), made, reader, outside)
    made = made or {path.stem: _without(tree, listed[0])}
    sources = {name: as_source(made[name], path, reader) for name in made}
    return Variants(as_source(tree, path, reader), sources)


def _variant(
    at: tuple[str, str, str], node: Node, base: Node, earlier: dict[str, Node], reader: Reader, overrides: Sequence[str]
) -> Node:
    entries = entries_of(node)
    unknown = sorted(set(entries) - set(_KEYS))
    if unknown or not (isinstance(node.value, dict) or node.value is None):
        raise ConfigError(
            f"found {', '.join(unknown) or str(node.value)[:60]!r} in a variant, expected extends, set or add.",
            where=node.origin.at(node.line, at),
            hint=f"Write for example {at[2]}: {{extends: FILE, set: {{parameters.bounds: none}}}}.",
        )
    tree, files = base, False
    for place, parent in enumerate(parents_of(node)):
        if str(parent) in earlier:
            tree = merge(tree, earlier[str(parent)]) if place else earlier[str(parent)]
            continue
        tree, files = merge(tree, _without(reader.parent(parent, ()), at[0])), True
    for text in overrides if files else ():
        tree = override(tree, text)
    for steps, value in _by_path(entries.get("set"), (*at, "set")):
        if value.value is None and _at(tree, steps) is None:
            raise ConfigError(
                f"found nothing at {'.'.join(steps)} to remove.",
                where=value.origin.at(value.line, (*at, "set")),
                hint="A key that itself holds dots stands in double quotes: 'a.\"b.c\"': null.",
            )
        tree = set_at(tree, steps, replace(value, origin=replace(value.origin, prefix=steps)))
    for steps, value in _by_path(entries.get("add"), (*at, "add")):
        tree = _added(tree, steps, value)
    return tree


def _without(tree: Node, section: str) -> Node:
    return replace(tree, value={key: node for key, node in entries_of(tree).items() if key != section})


def _by_path(node: Node | None, at: tuple[str, ...]) -> list[tuple[tuple[str, ...], Node]]:
    """The values of a mapping whose keys are dotted names."""
    if node is None or node.value is None:
        return []
    variants = []
    for name, value in entries_of(node).items():
        steps = steps_of(str(name))
        if steps is None or steps[0] in ("extends", at[0]):
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
    return set_at(tree, steps, replace(value, value=(*kept, *more), origin=replace(value.origin, prefix=steps)))


def _at(tree: Node, steps: tuple[str, ...]) -> Node | None:
    """The node at a path; list entries count from 0."""
    there: Node | None = tree
    for step in steps:
        if there is not None and isinstance(there.value, tuple):
            there = dict(zip(map(str, range(len(there.value))), there.value, strict=True)).get(step)
        else:
            there = entries_of(there).get(step) if there else None
    return there
