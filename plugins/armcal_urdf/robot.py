"""A URDF, checked: links with their masses, and joints that make one tree of them. [URDF]

Strict XML: elements with their lines, places and numbers; nothing in a file can name another file or grow.

Document types are refused, and with them every entity but the five of XML itself. Processing instructions and
comments are passed over.
"""

from __future__ import annotations

import difflib
import math
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Literal, NoReturn
from xml.parsers import expat

from armcal.arm.model import Mimic
from armcal.errors import ConfigError, Location
from armcal.io.plain_files import input_bytes

Encoding = Literal["utf-8", "iso-8859-1"]

MAX_BYTES = 256 * 1024  # Of a URDF: a calibration holds it whole, and may have four times as many itself
_MOST = 1 << 26  # Read at all, so that what is too large is refused with the reason


def read_text(path: Path) -> tuple[str, Encoding]:
    return decode(input_bytes(path, _MOST, "a URDF file", ConfigError), str(path))


def decode(data: bytes, label: str) -> tuple[str, Encoding]:
    """Text and encoding: UTF-8, or Latin-1 where it is none, whatever the first line declares."""
    if len(data) > MAX_BYTES:
        raise ConfigError(
            f"the file is larger than {MAX_BYTES // 1024} KiB, which a calibration could not hold.",
            where=Location(label),
            hint="Keep meshes in files of their own, and leave out what is not the arm.",
        )
    try:
        return data.decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        return data.decode("iso-8859-1"), "iso-8859-1"


UTF8 = "utf-8"
Three = tuple[float, float, float]

LARGEST = 1e6  # m, rad or kg: no arm is that far off, and sums with larger numbers lose the micrometres
SHORTEST_AXIS = 1e-9
_WHITE = re.compile(r"[ \t\r\n]+")
_PROPERTY = "xacro:property"  # which nothing uses where there is no ${...}
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class Element:
    tag: str  # its name
    attributes: Mapping[str, str]  # values by name, references expanded
    line: int  # of its start tag, from 1
    start: int  # offset of its start tag in the text as UTF-8
    label: str  # the file's name for people
    children: list[Element] = field(default_factory=list)  # elements in it

    def all(self, tag: str) -> Iterator[Element]:
        return (child for child in self.children if child.tag == tag)

    def one(self, tag: str) -> Element | None:
        elements = list(self.all(tag))
        if len(elements) > 1:
            elements[1].refuse(f"found <{tag}> twice in one <{self.tag}>.", f"The first is at line {elements[0].line}.")
        return elements[0] if elements else None

    def text(self, name: str) -> str:
        """An attribute that has to be there and hold something."""
        value = self.attributes.get(name, "")
        if not value.strip():
            which = "an empty" if name in self.attributes else "no"
            self.refuse(f"found {which} attribute {name!r} in <{self.tag}>.", f'Write <{self.tag} {name}="..."/>.')
        return value

    def refuse(self, message: str, hint: str) -> NoReturn:
        raise ConfigError(message, where=Location(self.label or None, self.line), hint=hint)


def read_elements(text: str, label: str) -> Element:
    parser = expat.ParserCreate(UTF8)
    builder = _Builder(parser, label, is_expanded="${" not in text)
    try:
        parser.Parse(text.encode(UTF8), True)
    except expat.ExpatError as fault:
        raise ConfigError(
            f"this is not well-formed XML: {expat.ErrorString(fault.code)}.",
            where=Location(label or None, fault.lineno),
            hint="Check tags, quotes and < > & on this line and the ones before it.",
        ) from fault
    return builder.root[0]


class _Builder:
    """Builds elements out of the parser's events."""

    def __init__(self, parser: expat.XMLParserType, label: str, is_expanded: bool) -> None:
        self.root: list[Element] = []
        self._parser, self._label, self._is_expanded = parser, label, is_expanded
        self._open: list[Element] = []
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.StartDoctypeDeclHandler = self._doctype

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        line, start = self._parser.CurrentLineNumber, self._parser.CurrentByteIndex
        element = Element(tag, attributes, line, start, self._label)
        if tag.startswith("xacro:") and not (tag == _PROPERTY and self._is_expanded):
            element.refuse(f"found <{tag}>: this is xacro, not yet a URDF.", "Run it through xacro first.")
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
    return numbers(element, name, (default,), largest)[0]


def three(element: Element | None, name: str, default: Three = (0.0, 0.0, 0.0)) -> Three:
    if element is None:
        return default
    x, y, z = numbers(element, name, default, LARGEST)
    return x, y, z


def numbers(element: Element, name: str, default: tuple[float, ...], largest: float) -> tuple[float, ...]:
    """As many numbers as the default has."""
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
    """The direction of an <axis>, of length one; x where there is none, by the format."""
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


MOVING = ("revolute", "continuous", "prismatic")
FREE = ("floating", "planar")
_KINDS = (*MOVING, "fixed", *FREE)
_IN_JOINT = ("origin", "parent", "child", "axis", "calibration", "dynamics", "limit", "mimic", "safety_controller")
_IN_LINK = ("inertial", "visual", "collision")
_ORIGIN = ("xyz", "rpy")
_MIMIC = ("joint", "multiplier", "offset")
_LIMIT = ("lower", "upper", "effort", "velocity", "acceleration", "deceleration", "jerk")
_ALIKE = 0.8
_ANY = sys.float_info.max


@dataclass(frozen=True)
class UrdfLink:
    name: str
    mass: float  # kg, 0 where none is stated
    com: Three  # the mass's centre in the link's frame (m)
    element: Element


@dataclass(frozen=True)
class UrdfJoint:
    name: str  # as written
    kind: str  # ``revolute``, ``continuous``, ``prismatic``, ``fixed``, ``floating`` or ``planar``
    parent: str  # link it stands on
    child: str  # link it carries
    xyz: Three  # where it stands in the parent's frame (m)
    rpy: Three  # how it is turned there: Rz(yaw) Ry(pitch) Rx(roll) (rad)
    axis: Three  # unit vector in the joint's own frame
    limits: tuple[float, float] | None  # of its displacement (rad or m); None where there are none
    mimic: Mimic | None  # the joint that it follows, if it does
    element: Element  # where it was written


@dataclass(frozen=True)
class Robot:
    """Links and joints by name; the joints make one tree of all links."""

    links: Mapping[str, UrdfLink]
    joints: Mapping[str, UrdfJoint]
    ignored: tuple[str, ...] = ()  # what other programs read, and a property of xacro that nothing uses

    @cached_property
    def above(self) -> Mapping[str, UrdfJoint]:
        return {joint.child: joint for joint in self.joints.values()}

    @cached_property
    def below(self) -> Mapping[str, tuple[UrdfJoint, ...]]:
        children: dict[str, list[UrdfJoint]] = {name: [] for name in self.links}
        for joint in self.joints.values():
            children[joint.parent].append(joint)
        return {name: tuple(joints) for name, joints in children.items()}

    @property
    def root(self) -> str:
        return next(name for name in self.links if name not in self.above)

    def path(self, root: str, tip: str) -> tuple[UrdfJoint, ...] | None:
        """The joints from one link out to another; None if the path is not outward all along."""
        joints: list[UrdfJoint] = []
        here = tip
        while here != root:
            if here not in self.above:
                return None
            joints.append(self.above[here])
            here = joints[-1].parent
        return tuple(reversed(joints))

    def leaves(self, root: str) -> tuple[str, ...]:
        leaves, waiting = [], [root]
        while waiting:
            link = waiting.pop(0)
            waiting += [joint.child for joint in self.below[link]]
            leaves += [] if self.below[link] else [link]
        return tuple(leaves)


def read_robot(text: str, label: str) -> Robot:
    """The links and joints of a URDF; ``label`` is the file's name, for messages."""
    top = read_elements(text, label)
    if top.tag != "robot":
        top.refuse(f"found <{top.tag}> at the top, expected <robot>.", "Give a URDF file.")
    links: dict[str, UrdfLink] = {}
    joints: dict[str, UrdfJoint] = {}
    for element in top.all("link"):
        link = _link(element)
        _refuse_second(element, links.setdefault(link.name, link))
    for element in top.all("joint"):
        joint = _joint(element)
        _refuse_second(element, joints.setdefault(joint.name, joint))
    if not links:
        top.refuse("found no <link> in <robot>, expected links and joints.", "Give a whole URDF.")
    robot = Robot(links, joints, tuple(dict.fromkeys(_ignored(top))))
    _require_tree(robot)
    return robot


def _ignored(top: Element) -> Iterator[str]:
    for element in top.children:
        if element.tag == _PROPERTY:
            yield f"<{_PROPERTY}>"
        for inner in (element, *element.children):
            yield from sorted(set(inner.attributes) - _plain(inner))
            if inner.tag == "axis" and "rpy" in inner.attributes:
                yield "rpy of <axis>"


def _refuse_second(element: Element, first: UrdfLink | UrdfJoint) -> None:
    if first.element is not element:
        hint = f"The first is at line {first.element.line}; rename one."
        element.refuse(f"the {element.tag} {first.name!r} stands twice.", hint)


def _link(element: Element) -> UrdfLink:
    _refuse_misspelt(element, _IN_LINK)
    name, inertial = element.text("name"), element.one("inertial")
    if inertial is None:
        return UrdfLink(name, 0.0, (0.0, 0.0, 0.0), element)
    stated = inertial.one("mass")
    if stated is None:
        inertial.refuse(f"found no <mass> in the <inertial> of link {name!r}.", 'Write <mass value="1.2"/> (kg).')
    stated.text("value")
    mass = number(stated, "value", 0.0)
    if mass < 0:
        stated.refuse(f"found a mass of {mass:g} kg.", "Give the mass, 0 for none.")
    return UrdfLink(name, mass, three(_only(inertial.one("origin"), _ORIGIN), "xyz"), element)


def _joint(element: Element) -> UrdfJoint:
    name, kind = element.text("name"), element.text("type")
    _refuse_misspelt(element, _IN_JOINT)
    if kind not in _KINDS:
        element.refuse(f"joint {name!r} has the type {kind!r}.", f"The types are {', '.join(_KINDS)}.")
    origin, mimic = _only(element.one("origin"), _ORIGIN), None
    follows = _only(element.one("mimic"), _MIMIC) if kind in MOVING else None
    if follows is not None:
        if follows.text("joint") == name:
            follows.refuse(f"joint {name!r} follows itself.", "Name another joint, or remove <mimic>.")
        multiplier, offset = number(follows, "multiplier", 1.0), number(follows, "offset", 0.0)
        mimic = Mimic(follows.text("joint"), multiplier, offset)
    return UrdfJoint(
        name=name,
        kind=kind,
        parent=_named_link(element, "parent", name),
        child=_named_link(element, "child", name),
        xyz=three(origin, "xyz"),
        rpy=three(origin, "rpy"),
        axis=unit_axis(_only(element.one("axis"), _ORIGIN)) if kind in MOVING else (1.0, 0.0, 0.0),
        limits=_limits(element.one("limit"), name) if kind in ("revolute", "prismatic") else None,
        mimic=mimic,
        element=element,
    )


def _named_link(element: Element, which: str, joint: str) -> str:
    end = element.one(which)
    if end is None:
        element.refuse(f"found no <{which}> in joint {joint!r}.", f'Write <{which} link="NAME"/>.')
    return end.text("link")


def _limits(element: Element | None, joint: str) -> tuple[float, float] | None:
    """Where only one end is written the other is 0, by the format; where neither is, nothing is known."""
    if element is None:
        return None
    for attribute in _plain(element):
        _refuse_alike(element, f"the attribute {attribute!r}", attribute, _LIMIT)
    if not {"lower", "upper"} & set(element.attributes):
        return None
    lower, upper = (number(element, name, 0.0, _ANY) for name in ("lower", "upper"))
    if lower > upper:
        element.refuse(
            f"joint {joint!r} has the limits {lower:g} and {upper:g}, expected the lower one first.", "Swap them."
        )
    return lower, upper


def _only(element: Element | None, known: tuple[str, ...]) -> Element | None:
    """An element without attributes beside the known ones: what it means by others would be passed over."""
    unknown = sorted(_plain(element) - set(known)) if element else []
    if element is not None and unknown:
        element.refuse(f"found the attribute {unknown[0]!r} in <{element.tag}>.", f"Write {' and '.join(known)}.")
    return element


def _plain(element: Element) -> set[str]:
    """Its attributes without those of other programs' namespaces, such as ``drake:acceleration``."""
    return {name for name in element.attributes if ":" not in name}


def _refuse_misspelt(element: Element, known: tuple[str, ...]) -> None:
    for child in element.children:
        _refuse_alike(child, f"<{child.tag}>", child.tag, known)


def _refuse_alike(element: Element, text: str, name: str, known: tuple[str, ...]) -> None:
    near = [] if name in known else difflib.get_close_matches(name.lower(), known, n=1, cutoff=_ALIKE)
    if near:
        element.refuse(f"found {text}, which nothing reads.", f"Did you mean {near[0]}?")


def _require_tree(robot: Robot) -> None:
    carried: dict[str, UrdfJoint] = {}
    for joint in robot.joints.values():
        for which, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in robot.links:
                near = difflib.get_close_matches(link, robot.links, n=1)
                hint = f"Did you mean {near[0]!r}?" if near else f"Write <link name={link!r}/>, or name another."
                joint.element.refuse(f"joint {joint.name!r}: no link is called {link!r} ({which}).", hint)
        if joint.child in carried:
            other = carried[joint.child]
            joint.element.refuse(
                f"the link {joint.child!r} has two parents: joints {other.name!r} and {joint.name!r} carry it.",
                f"The first is at line {other.element.line}; remove one.",
            )
        carried[joint.child] = joint
    roots = [name for name in robot.links if name not in carried]
    if len(roots) > 1:
        second = robot.links[roots[1]].element
        second.refuse(
            f"found {len(roots)} links that no joint carries ({', '.join(roots[:5])}), expected one root.",
            "Join them, or remove what does not belong to the arm.",
        )
    try:
        TopologicalSorter({joint.child: [joint.parent] for joint in robot.joints.values()}).prepare()
    except CycleError as fault:
        circle = [robot.above[link] for link in fault.args[1][1:]]
        names = ", ".join(joint.name for joint in circle)
        first = min(circle, key=lambda joint: joint.element.line).element
        first.refuse(f"joints go round in a circle: {names}.", "A URDF is a tree; remove one of them.")
