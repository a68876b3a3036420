"""Strict XML: elements with their lines, places and numbers; nothing in a file can name another file or grow.

Document types are refused, and with them every entity but the five of XML itself. Processing instructions and
comments are passed over.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NoReturn
from xml.parsers import expat

from armcal.errors import ConfigError, Location

MAX_DEPTH = 50
UTF8 = "utf-8"
Three = tuple[float, float, float]

LARGEST = 1e6
"""m, rad or kg: no arm is that far off, and sums with larger numbers lose the micrometres."""
SHORTEST_AXIS = 1e-9
_WHITE = re.compile(r"[ \t\r\n]+")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class Element:
    """One element.

    Attributes:
        tag: its name.
        attributes: values by name, references expanded.
        line: of its start tag, from 1.
        start: offset of its start tag in the text as UTF-8.
        label: the file's name for people.
        children: elements in it.
    """

    tag: str
    attributes: Mapping[str, str]
    line: int
    start: int
    label: str
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str) -> Iterator[Element]:
        return (child for child in self.children if child.tag == tag)

    def one(self, tag: str) -> Element | None:
        """The child of a name; None if there is none.

        Raises:
            ConfigError: it stands twice.
        """
        elements = list(self.all(tag))
        if len(elements) > 1:
            elements[1].refuse(f"found <{tag}> twice in one <{self.tag}>.", f"The first is at line {elements[0].line}.")
        return elements[0] if elements else None

    def text(self, name: str) -> str:
        """An attribute that has to be there and hold something.

        Raises:
            ConfigError: it is missing or empty.
        """
        value = self.attributes.get(name, "")
        if not value.strip():
            which = "an empty" if name in self.attributes else "no"
            self.refuse(f"found {which} attribute {name!r} in <{self.tag}>.", f'Write <{self.tag} {name}="..."/>.')
        return value

    def refuse(self, message: str, hint: str) -> NoReturn:
        raise ConfigError(message, where=Location(self.label or None, self.line), hint=hint)


def read_elements(text: str, label: str) -> Element:
    """The root element of a text.

    Raises:
        ConfigError: not well-formed, a document type, or nested too deeply; with file and line.
    """
    try:
        data = text.encode(UTF8)
    except UnicodeEncodeError as fault:
        line = text.count("\n", 0, fault.start) + 1
        hint = "Delete it."
        raise ConfigError("found half a surrogate pair.", where=Location(label or None, line), hint=hint) from fault
    parser = expat.ParserCreate(UTF8)
    builder = _Builder(parser, label)
    try:
        parser.Parse(data, True)
    except expat.ExpatError as fault:
        raise ConfigError(
            f"this is not well-formed XML: {expat.ErrorString(fault.code)}.",
            where=Location(label or None, fault.lineno),
            hint="Check tags, quotes and < > & on this line and the ones before it.",
        ) from fault
    return builder.root[0]


class _Builder:
    """Builds elements out of the parser's events."""

    def __init__(self, parser: expat.XMLParserType, label: str) -> None:
        self.root: list[Element] = []
        self._parser, self._label = parser, label
        self._open: list[Element] = []
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.StartDoctypeDeclHandler = self._doctype

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        line, start = self._parser.CurrentLineNumber, self._parser.CurrentByteIndex
        element = Element(tag, attributes, line, start, self._label)
        if tag.startswith("xacro:"):
            element.refuse(f"found <{tag}>: this is xacro, not yet a URDF.", "Run it through xacro first.")
        if len(self._open) >= MAX_DEPTH:
            element.refuse(f"elements are nested deeper than {MAX_DEPTH} levels.", "A URDF needs five.")
        (self._open[-1].children if self._open else self.root).append(element)
        self._open.append(element)

    def _end(self, tag: str) -> None:
        self._open.pop()

    def _doctype(self, name: str, *_: object) -> None:
        raise ConfigError(
            f"found a document type (<!DOCTYPE {name}>), which could name files and entities.",
            where=Location(self._label or None, self._parser.CurrentLineNumber),
            hint="Delete it: a URDF has none.",
        )


def words_of(value: str) -> list[str]:
    return [word for word in _WHITE.split(value) if word]


def number(element: Element, name: str, default: float, largest: float = LARGEST) -> float:
    """One number; the default where there is no such attribute.

    Raises:
        ConfigError: not one number.
    """
    return numbers(element, name, (default,), largest)[0]


def three(element: Element | None, name: str, default: Three = (0.0, 0.0, 0.0)) -> Three:
    """Three numbers; the default where there is no such element or attribute.

    Raises:
        ConfigError: not three numbers.
    """
    if element is None:
        return default
    x, y, z = numbers(element, name, default, LARGEST)
    return x, y, z


def numbers(element: Element, name: str, default: tuple[float, ...], largest: float) -> tuple[float, ...]:
    """As many numbers as the default has.

    Raises:
        ConfigError: another count, or what is no finite decimal number of typical size.
    """
    if name not in element.attributes:
        return default
    words = words_of(element.attributes[name])
    if len(words) != len(default):
        count = f"{len(default)} number" + ("s" if len(default) > 1 else "")
        element.refuse(
            f"found {len(words)} in {_shown(element, name)}, expected {count}.", "Separate them by single spaces."
        )
    for word in words:
        if not (word.isascii() and _NUMBER.fullmatch(word)):
            xacro = "${" in element.attributes[name]
            hint = "Run the file through xacro first." if xacro else "Write a decimal number with a point: 0.25."
            element.refuse(f"found {word[:40]!r} in {_shown(element, name)}, expected a number.", hint)
        if not abs(float(word)) <= largest:
            element.refuse(
                f"found {word[:40]} in {_shown(element, name)}, expected a number of size {largest:g} at most.",
                "Lengths are in m, angles in rad, masses in kg.",
            )
    return tuple(map(float, words))


def unit_axis(element: Element | None) -> Three:
    """The direction of an <axis>, of length one; x where there is none, by the format.

    Raises:
        ConfigError: there are none in it, not three, or all zero.
    """
    if element is not None:
        element.text("xyz")
    x, y, z = three(element, "xyz", (1.0, 0.0, 0.0))
    length = math.hypot(x, y, z)
    if element is not None and length < SHORTEST_AXIS:
        element.refuse(
            f"found an axis of length {length:g} in {_shown(element, 'xyz')}.", 'Give a direction, xyz="0 0 1".'
        )
    return x / length, y / length, z / length


def _shown(element: Element, name: str) -> str:
    value = element.attributes[name]
    return f'<{element.tag} {name}="{value if len(value) <= 40 else value[:37] + "..."}">'
