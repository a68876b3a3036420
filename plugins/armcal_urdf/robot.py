"""A URDF, checked: links with their masses, and joints that make one tree of them. [URDF]"""

import difflib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from armcal.arm.model import Mimic

from armcal_urdf.elements import Element, Three, number, read_elements, three, unit_axis

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
    """A link: its mass (kg, 0 where none is stated) and the mass's centre in the link's frame (m)."""

    name: str
    mass: float
    com: Three
    element: Element


@dataclass(frozen=True)
class UrdfJoint:
    """A joint.

    Attributes:
        name: as written.
        kind: ``revolute``, ``continuous``, ``prismatic``, ``fixed``, ``floating`` or ``planar``.
        parent: link it stands on.
        child: link it carries.
        xyz: where it stands in the parent's frame (m).
        rpy: how it is turned there: Rz(yaw) Ry(pitch) Rx(roll) (rad).
        axis: unit vector in the joint's own frame.
        limits: of its displacement (rad or m); None where there are none.
        mimic: the joint that it follows, if it does.
        element: where it was written.
    """

    name: str
    kind: str
    parent: str
    child: str
    xyz: Three
    rpy: Three
    axis: Three
    limits: tuple[float, float] | None
    mimic: Mimic | None
    element: Element


@dataclass(frozen=True)
class Robot:
    """Links and joints by name; the joints make one tree of all links."""

    links: Mapping[str, UrdfLink]
    joints: Mapping[str, UrdfJoint]

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
    """The links and joints of a URDF.

    Args:
        text: the URDF.
        label: the file's name, for messages.

    Raises:
        ConfigError: it is no URDF, or describes what cannot be; with file and line.
    """
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
    robot = Robot(links, joints)
    _require_tree(robot, top)
    return robot


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
        axis=unit_axis(_only(element.one("axis"), ("xyz",))) if kind in MOVING else (1.0, 0.0, 0.0),
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
    for attribute in element.attributes:
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
    unknown = sorted(set(element.attributes) - set(known)) if element else []
    if element is not None and unknown:
        element.refuse(f"found the attribute {unknown[0]!r} in <{element.tag}>.", f"Write {' and '.join(known)}.")
    return element


def _refuse_misspelt(element: Element, known: tuple[str, ...]) -> None:
    for child in element.children:
        _refuse_alike(child, f"<{child.tag}>", child.tag, known)


def _refuse_alike(element: Element, text: str, name: str, known: tuple[str, ...]) -> None:
    near = [] if name in known else difflib.get_close_matches(name.lower(), known, n=1, cutoff=_ALIKE)
    if near:
        element.refuse(f"found {text}, which nothing reads.", f"Did you mean {near[0]}?")


def _require_tree(robot: Robot, top: Element) -> None:
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
    _refuse_circle(robot, roots[0] if roots else None, top)


def _refuse_circle(robot: Robot, root: str | None, top: Element) -> None:
    reached: set[str] = set()
    waiting = [root] if root is not None else []
    while waiting:
        link = waiting.pop()
        reached.add(link)
        waiting += [joint.child for joint in robot.below[link]]
    beyond = [joint for joint in robot.joints.values() if joint.child not in reached]
    if beyond:
        circle = [beyond[0].name]
        here = robot.above[beyond[0].parent]
        while here.name not in circle:
            circle.append(here.name)
            here = robot.above[here.parent]
        beyond[0].element.refuse(
            f"joints go round in a circle: {', '.join(reversed(circle))}.", "A URDF is a tree; remove one of them."
        )
