"""Units at the edges, SI inside: which units a config or a data column may declare."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from armcal.base.arrays import Array

DIMENSIONLESS = "dimensionless"
_Number = TypeVar("_Number", float, "Array")


@dataclass(frozen=True)
class Unit:
    """A unit and its factor to SI, ``numerator / denominator``.

    The two are kept apart because ``value / 1000`` is correctly rounded and ``value * 0.001`` is not: 3 mm is
    then the same float as 0.003 m.
    """

    name: str
    dimension: str
    numerator: float = 1.0
    denominator: float = 1.0

    @property
    def factor(self) -> float:
        return self.numerator / self.denominator


_DEGREE = math.pi / 180.0

_ALL = (
    Unit("m", "length"),
    Unit("cm", "length", 1.0, 100.0),
    Unit("mm", "length", 1.0, 1000.0),
    Unit("um", "length", 1.0, 1e6),
    Unit("inch", "length", 127.0, 5000.0),
    Unit("rad", "angle"),
    Unit("deg", "angle", _DEGREE),
    Unit("mrad", "angle", 1.0, 1000.0),
    Unit("kg", "mass"),
    Unit("g", "mass", 1.0, 1000.0),
    Unit("s", "time"),
    Unit("ms", "time", 1.0, 1000.0),
    Unit("us", "time", 1.0, 1e6),
    Unit("min", "time", 60.0),
    Unit("h", "time", 3600.0),
    Unit("m_s2", "acceleration"),
    Unit("rad_per_Nm", "compliance"),
    Unit("deg_per_Nm", "compliance", _DEGREE),
    Unit("rad_per_Nm3", "cubic compliance"),
    Unit("rad_s", "joint rate"),
    Unit("deg_s", "joint rate", _DEGREE),
    Unit("m_s", "joint rate"),
    Unit("mm_s", "joint rate", 1.0, 1000.0),
    Unit("N", "force"),
    Unit("mN", "force", 1.0, 1000.0),
    Unit("Nm", "torque"),
    Unit("mNm", "torque", 1.0, 1000.0),
    Unit("C", "temperature"),
    Unit("per_K", "expansion"),
    Unit("kpx", "image"),
    Unit("px", "image", 1.0, 1000.0),
    Unit("1", DIMENSIONLESS),
)

UNITS: Mapping[str, Unit] = MappingProxyType({unit.name: unit for unit in _ALL})
"""Every unit by name; within a dimension the SI unit comes first."""

DIMENSIONS = tuple(dict.fromkeys(unit.dimension for unit in _ALL))
SI_UNITS = tuple(next(unit.name for unit in _ALL if unit.dimension == dimension) for dimension in DIMENSIONS)
"""The unit that values of each dimension have inside."""

_DISPLAY: Mapping[str, str] = MappingProxyType({"length": "mm", "angle": "deg", "mass": "g", "image": "px"})
ERROR_UNITS: Mapping[str, str] = MappingProxyType(
    {"length": "mm", "image": "px", "force": "mN", "torque": "mNm", "angle": "mrad"}
)
"""What residuals may measure, and the unit of their errors: a thousandth of the one inside, in every dimension (so that
places in an image are held in thousands of pixels). Of several in one problem, the first here is that of its errors.
"""
ERROR_NAMES: Mapping[str, str] = MappingProxyType(
    {"mm": "Tip", "px": "Reprojection", "mN": "Force", "mNm": "Torque", "mrad": "Angle"}
)
"""What an error in each of these units is an error of."""
_SPELLINGS: Mapping[str, str] = MappingProxyType(
    {
        "µm": "um",
        "μm": "um",
        "°": "deg",
        "m/s^2": "m_s2",
        "m/s2": "m_s2",
        "m/s²": "m_s2",
        "rad/Nm": "rad_per_Nm",
        "rad/(Nm)": "rad_per_Nm",
        "rad/Nm^3": "rad_per_Nm3",
        "deg/Nm": "deg_per_Nm",
        "deg/(Nm)": "deg_per_Nm",
        "°C": "C",
        "1/K": "per_K",
    }
)
_WRITTEN: Mapping[str, str] = MappingProxyType(
    {name: spelling for spelling, name in reversed(tuple(_SPELLINGS.items())) if "_" in name} | {"1": ""}
)
"""Units whose names, made for keys of a file, are not how people write them: their first spelling."""
_NEAR_UNIT = 1.24
"""What sag and play may make of a gain. The nearest two, of inches in metres and in millimetres, are 1.55 apart."""
SMALLEST_SHOWN = 0.0001  # Of sizes in mm, px and other thousandths: no instrument reads less
_LONGEST_FIRST = tuple(sorted((n for n in UNITS if n != "1"), key=len, reverse=True))
_QUANTITY = re.compile(r"\s*([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*(\S.*?)?\s*", re.DOTALL)
_DECIMAL_COMMA = re.compile(r"\s*[+-]?[0-9]+,[0-9]+")


def unit(name: str) -> Unit:
    if name not in UNITS:
        raise ValueError(f"unit {name!r} is not known; expected one of {', '.join(UNITS)}.")
    return UNITS[name]


def units_of(dimension: str) -> tuple[Unit, ...]:
    """The units of a dimension, the SI unit first; ValueError for an unknown dimension."""
    units = tuple(u for u in _ALL if u.dimension == dimension)
    if not units:
        raise ValueError(f"dimension {dimension!r} is not known; expected one of {', '.join(DIMENSIONS)}.")
    return units


def si_unit(dimension: str) -> Unit:
    """The unit in which values of that dimension are held inside (temperature: degrees Celsius)."""
    return units_of(dimension)[0]


def display_unit(dimension: str) -> Unit:
    """The unit in which people are shown values of that dimension: mm, deg, g, otherwise the SI unit."""
    return UNITS[_DISPLAY[dimension]] if dimension in _DISPLAY else si_unit(dimension)


def shown_unit(si_unit_name: str) -> tuple[float, str]:
    """Shown numbers per number in that unit, and what people call the shown unit: (1000, ``mm``) for ``m``.

    A dimensionless unit is called nothing; a unit that is not known is shown as it is.
    """
    known = UNITS.get(si_unit_name)
    if known is None:
        return 1.0, si_unit_name
    shown = display_unit(known.dimension)
    return known.factor / shown.factor, _WRITTEN.get(shown.name, shown.name)


def length_mistake(gain: float) -> tuple[str, str] | None:
    """Which lengths were taken for which others where values came out so many times too large.

    ``("mm", "m")`` for 1000: millimetres for metres. None where no two units of length explain it within a quarter.
    """
    names = ("m", "mm", "inch", "cm", "um")
    for expected in names:
        for given in names:
            ratio = gain * UNITS[given].factor / UNITS[expected].factor
            if given != expected and 1 / _NEAR_UNIT < ratio < _NEAR_UNIT:
                return given, expected
    return None


def split_suffix(name: str, dimension: str | None = None) -> tuple[str, Unit] | None:
    """Split a name that declares its unit, ``"x_mm"`` into ``("x", mm)``; the longest unit wins.

    None if the name ends in no unit, or in one of another dimension than the one asked for.
    """
    for unit_name in _LONGEST_FIRST:
        stem = name.removesuffix(f"_{unit_name}")
        if stem and stem != name:
            unit = UNITS[unit_name]
            return (stem, unit) if dimension in (None, unit.dimension) else None
    return None


_RATE = re.compile(r"(?P<amount>.+?)\s+in\s+(?:(?P<count>[0-9.]+)\s*)?(?:an?\s+)?(?P<unit>[A-Za-z]+)\s*")
_LONG = {"d": 86400.0, "week": 7 * 86400.0, "month": 30 * 86400.0, "year": 365.25 * 86400.0}
_SHORT = {"day": "d", "hour": "h", "minute": "min", "second": "s"}


def amount_in_time(text: str) -> tuple[str, float]:
    """The amount as written, and the time (s), of ``0.05 deg in 30 d``, ``0.1 mm in a week``; else a ValueError."""
    match = _RATE.fullmatch(text)
    if match is not None:
        unit = match["unit"].lower()
        single = unit.removesuffix("s") if len(unit) > 1 else unit
        name = _SHORT.get(single, single)
        try:
            one = _LONG[name] if name in _LONG else parse_quantity(f"1 {name}", "time")
            seconds = float(match["count"] or 1.0) * one
        except ValueError:
            seconds = 0.0
        if seconds > 0 and math.isfinite(seconds):
            return match["amount"], seconds
    raise ValueError(f"found {text!r}, expected an amount and a time, such as 0.05 deg in 30 d")


def parse_quantity(text: str, dimension: str) -> float:
    """The SI value of a number with its unit, ``"5 mm"`` or ``"9.81 m/s^2"``; without one if it is dimensionless.

    A ValueError lists the accepted units.
    """
    if _DECIMAL_COMMA.match(text):
        raise ValueError(_expected(f"{text!r} has a decimal comma, write a point", dimension))
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise ValueError(_expected(f"{text!r} is not a number with a unit", dimension))
    number, written = match.groups()
    if written is None and dimension != DIMENSIONLESS:
        raise ValueError(_expected(f"{text!r} has no unit", dimension))
    name = (written or "1").replace("N m", "Nm").replace("N*m", "Nm").replace("N·m", "Nm")
    unit = UNITS.get(_SPELLINGS.get(name, name))
    if unit is None:
        raise ValueError(_expected(f"{text!r} has an unknown unit {written!r}", dimension))
    if unit.dimension != dimension:
        raise ValueError(_expected(f"{text!r} has a unit of {unit.dimension}", dimension))
    value = from_unit(float(number), unit.name)
    if not math.isfinite(value):
        raise ValueError(_expected(f"{text!r} is too large to be a number", dimension))
    return value


def _expected(text: str, dimension: str) -> str:
    names = [u.name for u in units_of(dimension)]
    if dimension == DIMENSIONLESS:
        return f'{text}; expected a number without a unit, for example "0.5".'
    kind = f"{dimension} in {'one of ' if len(names) > 1 else ''}{', '.join(names)}"
    return f'{text}; expected a number and a unit of {kind}, for example "5 {display_unit(dimension).name}".'


def from_unit(value: _Number, unit_name: str) -> _Number:
    known = unit(unit_name)
    return value * known.numerator / known.denominator


def to_unit(si_value: _Number, unit_name: str) -> _Number:
    known = unit(unit_name)
    return si_value * known.denominator / known.numerator


def readable(value: float) -> str:
    """A size with two decimals, or with two significant digits where two decimals would be too few of them."""
    return f"{value:.2f}" if value >= 0.095 else digits(max(value, SMALLEST_SHOWN), 2)


def digits(value: float, count: int = 3) -> str:
    """A number with so many significant digits, never with an exponent."""
    return format(Decimal(f"{value:.{count - 1}e}").normalize() + 0, "f") if math.isfinite(value) else str(value)
