"""Numbers in attributes: as many as expected, decimal, finite, of a size that an arm can have."""

from __future__ import annotations

import math
import re

from armcal_urdf.elements import Element

Three = tuple[float, float, float]

LARGEST = 1e6
"""m, rad or kg: no arm is that far off, and sums with larger numbers lose the micrometres."""
SHORTEST_AXIS = 1e-9
_WHITE = re.compile(r"[ \t\r\n]+")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def words_of(value: str) -> list[str]:
    """The words of an attribute, between white space as XML knows it."""
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
    """The direction of an <axis>, of length one; x where there is none, as the format says.

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
