"""The strict YAML reader: text to nodes that know their line.

It works on the stream of parser events, not on recursive loading, so that depth and size are checked before
anything is built and no tag can construct an object.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import yaml

from armcal.errors import ConfigError, Location

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
    _refuse_surprises(text)
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


def _refuse_surprises(text: str) -> None:
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
        mend = f"Write a number with its unit, for example 90 s, {quoted}."
        raise ScalarError(f"YAML reads {text} in base 60", mend)
    if _OCTAL.fullmatch(text):
        digits = text.lstrip("+-0").replace("_", "")
        sign = "-" if text.startswith("-") else ""
        decimal = f"{sign}{digits}" if digits.isdecimal() else "a decimal number"
        mend = f"Write {decimal}, {quoted}."
        raise ScalarError(f"YAML reads {text} as an octal, binary or hexadecimal number", mend)
    if "_" in text and _UNDERSCORE.fullmatch(text):
        raise ScalarError(f"{text} is a number with underscores", f"Write {text.replace('_', '')}, {quoted}.")


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
    """What a text was read from."""

    label: str  # the file's name for people, or the command line's argument
    base_dir: Path  # what relative paths in it are relative to
    root: Path | None = None  # the directory that paths in it may not leave; None: anywhere
    numbered: bool = True  # whether its lines mean anything to the user
    prefix: tuple[Step, ...] = ()  # the path below which the text's root value stands

    def at(self, line: int | None, path: tuple[Step, ...] | None = None) -> Location:
        shown = dotted(self.prefix if path is None else path)
        return Location(self.label, line if self.numbered else None, shown or None)


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
        raise ConfigError(
            f"found the control character U+{ord(match.group()):04X}, expected text.",
            where=origin.at(text.count("\n", 0, match.start()) + 1),
            hint="Delete it, or save the file as UTF-8 text.",
        )
    if match := _TAB_INDENT.search(text):
        raise ConfigError(
            "this line is indented with a tab, expected spaces.",
            where=origin.at(text.count("\n", 0, match.start()) + 1),
            hint="Replace the tab by spaces.",
        )
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
        raise ConfigError(message, where=self._origin.at(line, (*self._origin.prefix, *self._path)), hint=hint)

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
    """The tree after one ``a.b=value``."""
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
