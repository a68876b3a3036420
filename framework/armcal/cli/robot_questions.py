"""Questions for ``armcal new robot``: the rows of an arm, each number with its unit."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import click

from armcal.base.units import from_unit, parse_quantity
from armcal.errors import ConfigError
from armcal.io.cells import is_number
from armcal.scaffold.robot import (
    ASSUMED_TRAVEL,
    ASSUMED_TURN,
    FEWEST_JOINTS,
    MOST,
    MOST_JOINTS,
    Convention,
    Mass,
    RobotJoint,
    Row,
)

_UNKNOWN = "unknown"


def ask_rows(conventions: Mapping[str, Convention]) -> tuple[Convention, tuple[Row, ...]]:
    """The convention and the rows, from the terminal or standard input.

    Raises:
        ConfigError: the answers end early.
    """
    try:
        chosen = click.prompt("Denavit-Hartenberg rows", type=click.Choice(tuple(conventions)), default="standard")
        count = click.prompt("joints", type=click.IntRange(FEWEST_JOINTS, MOST_JOINTS))
        return conventions[chosen], tuple(_row(number) for number in range(1, count + 1))
    except click.Abort as fault:
        raise ConfigError(
            "the answers ended before the last question.",
            hint="Answer all of them, or give --dh FILE or --urdf FILE.",
        ) from fault


def ask_up() -> str:
    """Which way is up, as ``direction`` takes it; empty if not known."""
    words = "up in the tracker's base frame (x, y, z, -x, -y, -z, three numbers, or unknown)"
    answer = click.prompt(
        words, default=_UNKNOWN, value_proc=lambda text: text if text == _UNKNOWN else _checked(direction, text)
    )
    return "" if answer == _UNKNOWN else str(answer)


def direction(text: str) -> tuple[float, float, float]:
    """A unit vector from ``z``, ``-y`` or ``0.1,0,0.99``.

    Raises:
        ConfigError: it is neither.
    """
    sign, axis = (-1.0, text[1:]) if text.startswith("-") else (1.0, text)
    if axis in ("x", "y", "z"):
        return sign * (axis == "x"), sign * (axis == "y"), sign * (axis == "z")
    parts = [part.strip() for part in text.split(",")]
    numbers = [float(part) for part in parts if is_number(part)]
    length = math.hypot(*numbers)
    if len(numbers) != len("xyz") or len(parts) != len("xyz") or not 0 < length < math.inf:
        raise ConfigError(
            f"found {text!r} for up, expected x, y, z, -x, -y, -z or three numbers such as 0.02,0,0.9998.",
            hint="Give the direction in the tracker's base frame that points away from the ground.",
        )
    x, y, z = (number / length for number in numbers)
    return x, y, z


def _checked(read: Callable[[str], object], text: str) -> str:
    """A text that can be read; else click asks again."""
    try:
        read(text)
    except ConfigError as fault:
        raise click.BadParameter(fault.message) from fault
    return text


def place(text: str) -> tuple[float, float, float]:
    """A point (m) from ``30,0,12.5`` in mm, or with units: ``3 cm, 0, 12.5 mm``.

    Raises:
        ConfigError: it is none.
    """
    try:
        x, y, z = (_quantity(part.strip(), "mm", "length") for part in text.split(","))
    except (ValueError, click.BadParameter) as fault:
        raise ConfigError(
            f"found {text!r} for the target, expected three lengths such as 30,0,12.5 (mm) or 3 cm,0,0.",
            hint="Give the target's place in the frame of the last row, or of the URDF's tip.",
        ) from fault
    return x, y, z


def _row(number: int) -> Row:
    name = f"q{number}"
    click.echo(f"joint {number}, {name}:", err=True)
    turns = click.prompt("  it is", type=click.Choice(("revolute", "prismatic")), default="revolute") == "revolute"
    alpha, a = _ask("  alpha", "deg", "angle"), _ask("  a", "mm", "length")
    theta, d = _ask("  theta", "deg", "angle"), _ask("  d", "mm", "length")
    unit, dimension = ("deg", "angle") if turns else ("mm", "length")
    low, high = (round(end / from_unit(1.0, unit)) for end in (ASSUMED_TURN if turns else ASSUMED_TRAVEL))
    lower = _ask("  lower limit", unit, dimension, default=low)
    upper = _ask("  upper limit", unit, dimension, default=high, above=lower)
    mass = _ask("  mass of its link, 0 if not known", "g", "mass", lowest=0.0)
    com = [_ask(f"  its centre, {axis} in the row's frame", "mm", "length") for axis in "xyz"] if mass else []
    known = Mass(mass, (com[0], com[1], com[2])) if mass else None
    return Row(RobotJoint(name, turns, (lower, upper)), alpha, a, theta, d, known)


def _ask(
    words: str, unit: str, dimension: str, default: float = 0, lowest: float = -math.inf, above: float | None = None
) -> float:
    """A number, in SI; asked in ``unit``, and taken in another one that is written behind it."""

    def read(text: Any) -> float:
        quantity = _quantity(str(text), unit, dimension)
        if quantity < lowest or (above is not None and quantity <= above):
            raise click.BadParameter(f"found {text}, expected more.")
        return quantity

    return float(click.prompt(f"{words}, {unit}", default=str(default), value_proc=read))


def _quantity(text: str, unit: str, dimension: str) -> float:
    if is_number(text):
        value = from_unit(float(text), unit)
    else:
        try:
            value = parse_quantity(text, dimension)
        except ValueError as fault:
            raise click.BadParameter(str(fault)) from fault
    if not abs(value) <= MOST[dimension]:
        raise click.BadParameter(f"found {text}, expected an arm's {dimension}.")
    return value
