"""Configurations: the strict YAML reader, files that extend others, overrides, and the place of every value.

The reader works on the stream of parser events, not on recursive loading, so that depth and size are checked before
anything is built and no tag can construct an object.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import Any, NoReturn

import yaml

from armcal.base.config_text import ConfigText, resolve_path
from armcal.base.units import split_suffix
from armcal.errors import ConfigError, Location
from armcal.io.plain_files import input_bytes

Scalar = bool | int | float | str | None

_LONGEST_INTEGER = 300

_NULL = frozenset(("", "~", "null", "Null", "NULL"))
_TRUE = frozenset(w for base in ("yes", "true", "on") for w in (base, base.capitalize(), base.upper()))
_FALSE = frozenset(w for base in ("no", "false", "off") for w in (base, base.capitalize(), base.upper()))

_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_HEX = re.compile(r"[-+]?0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+][0-9]+)?")
_LOOSE_EXPONENT = re.compile(r"([-+]?)([0-9]+\.?[0-9]*|\.[0-9]+)[eE]([-+]?)([0-9]+)")
_WORD = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_NOT_FINITE = re.compile(r"[-+]?\.(inf|Inf|INF|nan|NaN|NAN)")
_CLOCK = re.compile(r"[-+]?[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?")
_OCTAL = re.compile(r"[-+]?(0[0-9_]+|0o[0-7_]+|0b[01_]+|0x[0-9a-fA-F_]*_[0-9a-fA-F_]*)")
_UNDERSCORE = re.compile(r"[-+]?[0-9][0-9_]*\.?[0-9_]*([eE][-+]?[0-9_]+)?")


class ScalarError(ValueError):
    """A bare word that YAML would read as something surprising; ``hint`` is what to write instead."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


def read_plain(text: str) -> Scalar:
    """The value of an unquoted scalar.

    Null, booleans (yes, no, on and off too), decimal and 0x integers and decimal fractions are read as YAML
    1.1 does; everything else is text, dates included. A ScalarError refuses a number that is not finite, or in a
    spelling that YAML reads otherwise than it looks.
    """
    if text in _NULL:
        return None
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    if _INTEGER.fullmatch(text):
        if len(text) > _LONGEST_INTEGER:
            raise ScalarError(f"found a number of {len(text)} digits", "Quote it if it is text.")
        return int(text)
    if _HEX.fullmatch(text) and len(text) <= _LONGEST_INTEGER:
        return int(text, 16)
    if _FLOAT.fullmatch(text):
        if not math.isfinite(float(text)):
            raise ScalarError(f"{text} is too large to be a number", "Write a finite number.")
        return float(text)
    quoted = f'or "{text}" if it is text'
    if _NOT_FINITE.fullmatch(text):
        raise ScalarError(f"{text} is not a finite number", f"Write a finite number, leave the key out, {quoted}.")
    if match := _LOOSE_EXPONENT.fullmatch(text):
        sign, digits, exponent_sign, exponent = match.groups()
        digits = digits if "." in digits else f"{digits}.0"
        digits = f"0{digits}" if digits.startswith(".") else digits
        clear = f"{sign}{digits}e{exponent_sign or '+'}{exponent}"
        raise ScalarError(f"{text} is text to YAML, not a number", f"Write {clear}, {quoted}.")
    if _CLOCK.fullmatch(text):
        raise ScalarError(f"YAML reads {text} in base 60", f"Write a number with its unit, for example 90 s, {quoted}.")
    if _OCTAL.fullmatch(text):
        digits = text.lstrip("+-0").replace("_", "")
        decimal = f"{'-' if text.startswith('-') else ''}{digits}" if digits.isdecimal() else "a decimal number"
        fault = f"YAML reads {text} as an octal, binary or hexadecimal number"
        raise ScalarError(fault, f"Write {decimal}, {quoted}.")
    if "_" in text and _UNDERSCORE.fullmatch(text):
        raise ScalarError(f"{text} is a number with underscores", f"Write {text.replace('_', '')}, {quoted}.")
    return text


def needs_quotes(text: str) -> bool:
    """Whether a text is refused where it stands bare, as ``1e5`` is, which YAML itself takes for text and writes so."""
    try:
        read_plain(text)
    except ScalarError:
        return True
    return False


def word(text: str) -> str:
    """A text as a scalar of a file: bare where every YAML reader takes it for text, else in double quotes."""
    is_plain = _WORD.fullmatch(text) and text.lower() not in ("y", "n") and read_plain(text) == text
    return str(text) if is_plain else json.dumps(str(text), ensure_ascii=False)


MAX_DEPTH = 50
MAX_NODES = 1_000_000

Step = str | int

# The parser of libyaml where PyYAML was built with it: the same events and marks, some ten times faster.
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

_PLAIN_TAGS = frozenset((None, "tag:yaml.org,2002:map", "tag:yaml.org,2002:seq"))
_TEXT_TAGS = frozenset((None, "!", "tag:yaml.org,2002:str"))
_TAB_INDENT = re.compile(r"^ *\t[ \t]*[^\s#]", re.MULTILINE)
_UNPRINTABLE = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def dotted(path: tuple[Step, ...]) -> str:
    """A path as people write it, ``rows.2.d_mm``; a key that itself holds a dot is quoted."""
    return ".".join(f'"{step}"' if "." in str(step) else str(step) for step in path)


@dataclass(frozen=True)
class Origin:
    label: str  # of what a text was read from: the file's name for people, or the command line's argument
    base_dir: Path  # what relative paths in it are relative to
    root: Path | None = None  # the directory that paths in it may not leave; None: anywhere
    numbered: bool = True  # whether its lines mean anything to the user
    prefix: tuple[Step, ...] = ()  # the path below which the text's root value stands

    def at(self, line: int | None, path: tuple[Step, ...] | None = None) -> Location:
        shown = dotted(self.prefix if path is None else path)
        return Location(self.label, line if self.numbered else None, shown or None)

    def refuse(self, message: str, hint: str, line: int | None, path: tuple[Step, ...] | None = None) -> NoReturn:
        raise ConfigError(message, where=self.at(line, path), hint=hint)


@dataclass(frozen=True, slots=True)
class Node:
    """A value, where it was written, and how large it is once aliases are expanded.

    ``value`` is a scalar, a ``tuple`` of nodes, or a ``dict`` of nodes that is never changed once built.
    """

    origin: Origin
    line: int
    value: Scalar | tuple[Node, ...] | dict[str, Node]
    size: int = 1
    height: int = 0


def read_nodes(
    text: str, origin: Origin, loader: Any = LOADER, plain: Callable[[str], Scalar] = read_plain
) -> Node | None:
    """Parse one YAML document strictly; None if it holds nothing. ``plain`` reads a value without quotes.

    A ConfigError refuses, with line and field: invalid YAML, tab indentation, duplicate or unclear keys, tags, merge
    keys, several documents, surprising scalars, and what is too deep or too large.
    """
    if match := _UNPRINTABLE.search(text):
        message = f"found the control character U+{ord(match.group()):04X}, expected text."
        line = text.count("\n", 0, match.start()) + 1
        origin.refuse(message, "Delete it, or save the file as UTF-8 text.", line)
    if match := _TAB_INDENT.search(text):
        line = text.count("\n", 0, match.start()) + 1
        origin.refuse("this line is indented with a tab, expected spaces.", "Replace the tab by spaces.", line)
    reader = _Reader(yaml.parse(text, Loader=loader), origin, plain)
    try:
        return reader.document()
    except yaml.MarkedYAMLError as fault:
        mark = fault.problem_mark or fault.context_mark
        context = f" {fault.context}" if fault.context else ""
        reader.refuse(
            f"this is not valid YAML: {fault.problem}{context}.",
            "Check indentation, colons, brackets and quotes on this line and the ones before it.",
            None if mark is None else mark.line + 1,
        )
    except (yaml.YAMLError, ValueError, OverflowError) as fault:
        reader.refuse(f"this is not valid YAML: {fault}.", "Check quotes and escapes.", None)


class _Reader:
    """Builds nodes out of the parser's events, from the top down: no deeper than ``MAX_DEPTH``."""

    def __init__(self, events: Iterator[Any], origin: Origin, plain: Callable[[str], Scalar]) -> None:
        self._events, self._origin, self._plain = events, origin, plain
        self._path: list[Step] = []  # to what is read
        self._anchors: dict[str, Node | None] = {}  # None: still open

    def refuse(self, message: str, hint: str, line: int | None) -> NoReturn:
        self._origin.refuse(message, hint, line, (*self._origin.prefix, *self._path))

    def document(self) -> Node | None:
        root: Node | None = None
        for event in self._events:
            if isinstance(event, yaml.DocumentStartEvent) and root is not None:
                mark: Any = event.start_mark
                line = mark.line + 1
                self.refuse("a second document starts here, expected one.", "Remove the line '---'.", line)
            elif isinstance(event, yaml.NodeEvent):
                root = self._node(event)
        return root

    def _node(self, event: Any) -> Node:
        line, anchor = event.start_mark.line + 1, event.anchor
        if isinstance(event, yaml.AliasEvent):
            if anchor not in self._anchors:
                hint = f"Write &{anchor} before the value it means."
                self.refuse(f"the alias *{anchor} names no anchor.", hint, line)
            if (node := self._anchors[anchor]) is None:
                self.refuse(f"the alias *{anchor} stands inside what it names.", "Write the value out.", line)
            return replace(node, line=line)
        if isinstance(event, yaml.ScalarEvent):
            try:
                node = Node(self._origin, line, self._plain(event.value) if self._is_plain(event) else event.value)
            except ScalarError as fault:
                self.refuse(f"{fault}.", fault.hint, line)
        else:
            self._check_tag(event, _PLAIN_TAGS)
            self._check_depth(len(self._path) + 1, line)
            if anchor is not None:
                self._anchors[anchor] = None
            node = self._collection(event, line)
        if anchor is not None:
            self._anchors[anchor] = node
        return node

    def _collection(self, opening: Any, line: int) -> Node:
        is_mapping = isinstance(opening, yaml.MappingStartEvent)
        entries, items, size, height = dict[str, Node](), list[Node](), 1, 1
        while True:
            if not is_mapping:
                self._path.append(len(items))
            event = next(self._events)
            if isinstance(event, yaml.CollectionEndEvent):
                break
            key_line = event.start_mark.line + 1
            if is_mapping:
                self._path.append(self._key(event, entries, key_line))
                event = next(self._events)
            node = self._node(event)
            size, height = size + node.size, max(height, node.height + 1)
            self._check_depth(len(self._path) + node.height, node.line)
            if size > MAX_NODES:
                hint = "Expand no aliases of aliases; keep measured data in a CSV file."
                self.refuse(f"the file holds more than {MAX_NODES} values with its aliases expanded.", hint, node.line)
            step = self._path.pop()
            if is_mapping:
                entries[str(step)] = replace(node, line=key_line)
            else:
                items.append(node)
        if not is_mapping:
            self._path.pop()
        return Node(self._origin, line, entries if is_mapping else tuple(items), size, height)

    def _key(self, event: Any, entries: Mapping[str, Node], line: int) -> str:
        if not isinstance(event, yaml.ScalarEvent):
            self._check_tag(event, _PLAIN_TAGS)
            self.refuse("found a list, mapping or alias as a key, expected text.", "Write a plain name.", line)
        text, is_plain = str(event.value), self._is_plain(event)
        if is_plain and text == "<<":
            hint = "Write the keys out, or put the shared part into a file named under 'extends'."
            self.refuse("merge keys (<<) are not read.", hint, line)
        if is_plain:
            try:
                read = read_plain(text)
            except ScalarError as fault:
                self.refuse(f"the key {text} is not plain text: {fault}.", f'Quote it: "{text}".', line)
            if not isinstance(read, str):
                meaning = "nothing" if read is None else f"the {type(read).__name__} {read}"
                self.refuse(f"the key {text!r} is read as {meaning}, expected text.", f'Quote it: "{text}".', line)
        if not text:
            self.refuse("found an empty key, expected a name.", "Name the key.", line)
        if text in entries:
            first = entries[text].line
            self._path.append(text)  # so that the refusal names it
            stands = f"the key {text!r} stands here and at line {first}, expected once."
            self.refuse(stands, "Remove or rename one.", line)
        return text

    def _is_plain(self, event: Any) -> bool:
        """Whether a scalar is bare; text otherwise."""
        self._check_tag(event, _TEXT_TAGS)
        return event.tag is None and bool(event.implicit[0])

    def _check_tag(self, event: Any, known: Collection[str | None]) -> None:
        tag: Any = getattr(event, "tag", None)
        if tag not in known:
            shown = tag.replace("tag:yaml.org,2002:", "!!")
            hint = "Remove it: a config holds plain values only."
            self.refuse(f"found the tag {shown}, expected no tag.", hint, event.start_mark.line + 1)

    def _check_depth(self, depth: int, line: int) -> None:
        if depth > MAX_DEPTH:
            self.refuse(f"values are nested deeper than {MAX_DEPTH} levels.", "Flatten the config.", line)


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
    assigned = assignment(text, "--set")
    if assigned is None:
        hint = "Write for example --set parameters.bounds=none; null as the value removes a key."
        where = Location(f"command line (--set {text})")
        raise ConfigError(f"found {text!r}, expected a dotted name, '=' and a value.", where=where, hint=hint)
    steps, value = assigned
    if steps[0] == "extends":
        value.origin.refuse("'extends' is read from files only.", "Write it in the config.", None)
    return set_at(tree, steps, value)


def assignment(text: str, option: str) -> tuple[tuple[str, ...], Node] | None:
    """The keys and the value of ``a.b=value`` from the command line; None if it is not of that form."""
    name, equals, written = text.partition("=")
    steps = steps_of(name.strip())
    if not equals or steps is None or not written.strip():
        return None
    origin = Origin(f"command line ({option} {name.strip()})", Path.cwd(), numbered=False, prefix=steps)
    return steps, read_nodes(written, origin) or Node(origin, 1, None)


def set_at(node: Node, steps: tuple[str, ...], value: Node) -> Node:
    """The tree with another value at a path; null removes."""
    if not steps:
        return value
    step, rest = steps[0], steps[1:]
    if isinstance(node.value, tuple):
        items = list(node.value)
        if not (step.isascii() and step.isdecimal() and len(step) < 10 and int(step) < len(items)):
            hint = f"Write an index from 0 to {len(items) - 1}." if items else "Override the whole list."
            value.origin.refuse(f"found the index {step!r} into a list of {len(items)} values.", hint, None)
        items[int(step)] = set_at(items[int(step)], rest, value)
        return replace(node, value=tuple(items))
    if node.value is not None and not isinstance(node.value, dict):
        message = f"the key above {step!r} holds {str(node.value)[:60]!r}, expected a mapping or a list."
        value.origin.refuse(message, "Override that key itself, or correct the name.", None)
    entries = dict(entries_of(node))
    if not rest and value.value is None and step in entries:
        del entries[step]
    else:
        entries[step] = set_at(entries.get(step, Node(value.origin, 1, None)), rest, value)
    return replace(node, value=entries)


# --- files, and what each value of them is ---

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
    return next((str(key) for key in value if (split := split_suffix(key)) is not None and split[0] == step), None)


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
        own = read_nodes(text, origin)
        if own is None or own.value is None:
            hint = "Write at least one 'key: value' line."
            origin.refuse("the file is empty, expected keys and values.", hint, None)
        if not isinstance(own.value, dict):
            kind = "a list" if isinstance(own.value, tuple) else f"the value {str(own.value)[:60]!r}"
            hint = "Write 'key: value' lines; put a space after each colon."
            origin.refuse(f"found {kind} at the top, expected keys and values.", hint, own.line)
        bases = [self.parent(parent, (*chain, resolved)) for parent in parents_of(own)]
        self.done[resolved] = reduce(merge, [*bases, _without(own, "extends")])
        return self.done[resolved]

    def parent(self, text: ConfigText, chain: tuple[Path, ...]) -> Node:
        """The merged tree of a file that ``extends`` names."""
        resolved = resolve_path(text)
        if resolved in chain:
            circle = " -> ".join(p.name for p in (*chain[chain.index(resolved) :], resolved))
            message = f"the files extend one another in a circle: {circle}."
            raise ConfigError(message, where=text.location, hint="Remove one of these 'extends'.")
        try:
            return self.tree(text.base_dir / text, chain)
        except ConfigError as fault:
            if fault.where is not None and fault.where.line is None and text.location.file != fault.where.file:
                hint = f"{fault.hint} It is named by 'extends' in {text.location.file}:{text.location.line}."
                raise ConfigError(fault.message, where=fault.where, hint=hint) from fault
            raise


def parents_of(node: Node) -> list[ConfigText]:
    named = entries_of(node).get("extends")
    if named is None:
        return []
    nodes = named.value if isinstance(named.value, tuple) else (named,)
    texts = [_scalar(n, ("extends",)) for n in nodes]
    if not all(isinstance(t, ConfigText) for t in texts) or len(set(texts)) < len(texts):
        message = "'extends' is neither a file name nor a list of different file names."
        named.origin.refuse(message, "Write for example 'extends: base.yaml'.", named.line, ("extends",))
    return texts


def _scalar(node: Node, path: tuple[Step, ...]) -> Any:
    if isinstance(node.value, str):
        return ConfigText(node.value, node.origin.at(node.line, path), node.origin.base_dir, node.origin.root)
    return node.value


VARIANTS = ("study", "variants")  # Where a study lists its variants; the section is no part of any


def load_variants(
    path: str | Path, overrides: Sequence[str] = (), listed: tuple[str, str] = VARIANTS
) -> tuple[ConfigSource, dict[str, ConfigSource]]:
    """A YAML config, and by name in the order written the variants that it lists, without their section.

    Without any, the config itself is the only one, called as the file.

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
    alone, variants = _without(tree, listed[0]), _at(tree, listed)
    made: dict[str, Node] = {}
    for name, node in entries_of(variants).items() if variants else ():
        made[str(name)] = _variant((*listed, str(name)), node, alone, made, reader, outside)
    made = made or {path.stem: alone}
    return as_source(tree, path, reader), {name: as_source(node, path, reader) for name, node in made.items()}


def _variant(
    at: tuple[str, str, str], node: Node, base: Node, earlier: dict[str, Node], reader: Reader, overrides: Sequence[str]
) -> Node:
    entries = entries_of(node)
    unknown = sorted(entries.keys() - {"extends", "set", "add"})
    if unknown or not (isinstance(node.value, dict) or node.value is None):
        message = f"found {', '.join(unknown) or str(node.value)[:60]!r} in a variant, expected extends, set or add."
        hint = f"Write for example {at[2]}: {{extends: FILE, set: {{parameters.bounds: none}}}}."
        node.origin.refuse(message, hint, node.line, at)
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
            hint = "A key that itself holds dots stands in double quotes: 'a.\"b.c\"': null."
            message = f"found nothing at {'.'.join(steps)} to remove."
            value.origin.refuse(message, hint, value.line, (*at, "set"))
        tree = set_at(tree, steps, replace(value, origin=replace(value.origin, prefix=steps)))
    for steps, value in _by_path(entries.get("add"), (*at, "add")):
        more = value.value if isinstance(value.value, tuple) else (value,)
        there = _at(tree, steps)
        kept = () if there is None or there.value is None else there.value
        if not isinstance(kept, tuple):
            message = f"found {str(kept)[:60]!r} at {'.'.join(steps)}, expected a list to add to."
            value.origin.refuse(message, "Use set: to replace it.", value.line)
        own = replace(value, value=(*kept, *more), origin=replace(value.origin, prefix=steps))
        tree = set_at(tree, steps, own)
    return tree


def _without(tree: Node, left_out: str) -> Node:
    return replace(tree, value={key: node for key, node in entries_of(tree).items() if key != left_out})


def _by_path(node: Node | None, at: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Node]]:
    if node is None or node.value is None:
        return
    for name, value in entries_of(node).items():
        steps = steps_of(str(name))
        if steps is None or steps[0] in ("extends", at[0]):
            hint = "Write for example parameters.bounds: none."
            value.origin.refuse(f"found {name!r}, expected the dotted name of a value.", hint, value.line, at)
        yield steps, value
    if not isinstance(node.value, dict):
        node.origin.refuse("expected dotted names with values.", "Write NAME: value lines below it.", node.line, at)


def _at(tree: Node, steps: tuple[str, ...]) -> Node | None:
    """The node at a path; list entries count from 0."""
    there: Node | None = tree
    for step in steps:
        value = there.value if there else None
        entries = {str(i): node for i, node in enumerate(value)} if isinstance(value, tuple) else value
        there = entries.get(step) if isinstance(entries, dict) else None
    return there
