"""Units: exact factors, names that declare a unit, and quantities written as text."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from armcal.base.units import (
    UNITS,
    Unit,
    amount_in_time,
    digits,
    display_unit,
    from_unit,
    parse_quantity,
    readable,
    si_unit,
    split_suffix,
    to_unit,
    units_of,
)


@pytest.mark.parametrize(
    ("value", "unit", "si"),
    [
        (46.9, "mm", 0.0469),
        (37.32, "mm", 0.03732),
        (5, "cm", 0.05),
        (7, "um", 7e-6),
        (60, "deg", math.radians(60)),
        (3, "mrad", 0.003),
        (69.9, "g", 0.0699),
        (20, "ms", 0.02),
        (2, "min", 120.0),
        (1.5, "h", 5400.0),
        (9.81, "m_s2", 9.81),
        (0.05, "rad_per_Nm", 0.05),
        (1, "deg_per_Nm", math.radians(1)),
        (20.5, "C", 20.5),
        (3, "1", 3.0),
    ],
)
def test_a_value_comes_in_as_the_float_its_si_spelling_has(value: float, unit: str, si: float) -> None:
    assert from_unit(value, unit) == si
    assert to_unit(si, unit) == pytest.approx(value, rel=1e-15, abs=0)


def test_millimetres_and_metres_make_the_same_float_where_a_multiplication_would_not() -> None:
    assert all(from_unit(n, "mm") == float(f"{n}e-3") for n in range(5000))
    assert any(n * 1e-3 != float(f"{n}e-3") for n in range(5000))  # the trap is real


@pytest.mark.parametrize(
    ("value", "count", "text"),
    [(1984.4, 3, "1980"), (139.9, 2, "140"), (0.00012345, 3, "0.000123"), (378123.0, 3, "378000"), (0.5, 3, "0.5")],
)
def test_significant_digits_are_written_without_an_exponent(value: float, count: int, text: str) -> None:
    assert digits(value, count) == text
    assert digits(math.inf) == "inf" and digits(-12.34) == "-12.3" and digits(0.0) == "0"


def test_no_error_is_shown_as_nothing() -> None:
    shown = [readable(size) for size in (12.345, 0.1, 0.0949, 0.0042, 3e-5, 0.0)]
    assert shown == ["12.35", "0.10", "0.095", "0.0042", "0.0001", "0.0001"]


def test_arrays_are_converted_like_numbers() -> None:
    np.testing.assert_array_equal(from_unit(np.array([1.0, 46.9]), "mm"), [0.001, 0.0469])
    np.testing.assert_array_equal(to_unit(np.array([0.5]), "mm"), [500.0])


@pytest.mark.parametrize(
    ("name", "stem", "unit"),
    [
        ("x_mm", "x", "mm"),
        ("noise_mm", "noise", "mm"),
        ("compliance_rad_per_Nm", "compliance", "rad_per_Nm"),
        ("gravity_m_s2", "gravity", "m_s2"),
        ("torque_Nm", "torque", "Nm"),
        ("a_b_deg", "a_b", "deg"),
        ("joint_m", "joint", "m"),
    ],
)
def test_a_name_is_split_at_its_longest_unit(name: str, stem: str, unit: str) -> None:
    assert split_suffix(name) == (stem, UNITS[unit])
    assert split_suffix(name, UNITS[unit].dimension) == (stem, UNITS[unit])


@pytest.mark.parametrize("name", ["x", "mm", "_mm", "x_MM", "x_1", "xmm", "x_mm2", ""])
def test_a_name_without_a_unit_is_not_split(name: str) -> None:
    assert split_suffix(name) is None


def test_a_shorter_unit_never_wins_because_its_dimension_was_asked_for() -> None:
    assert split_suffix("compliance_rad_per_Nm", "torque") is None
    assert split_suffix("x_mm", "angle") is None


@pytest.mark.parametrize(
    ("text", "dimension", "si"),
    [
        ("5 mm", "length", 0.005),
        ("5mm", "length", 0.005),
        (" -1.5e-1 cm ", "length", -0.0015),
        (".5 m", "length", 0.5),
        ("12 µm", "length", 1.2e-5),
        ("60 deg", "angle", math.radians(60)),
        ("60°", "angle", math.radians(60)),
        ("9.81 m/s^2", "acceleration", 9.81),
        ("9.81 m_s2", "acceleration", 9.81),
        ("9.81 m/s²", "acceleration", 9.81),
        ("0.05 rad/Nm", "compliance", 0.05),
        ("0.05 rad/(N m)", "compliance", 0.05),
        ("2 N m", "torque", 2.0),
        ("0.5", "dimensionless", 0.5),
        ("21 °C", "temperature", 21.0),
    ],
)
def test_a_quantity_is_read(text: str, dimension: str, si: float) -> None:
    assert parse_quantity(text, dimension) == si


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("5", "has no unit"),
        ("5 deg", "has a unit of angle"),
        ("5 furlong", "unknown unit 'furlong'"),
        ("mm", "not a number with a unit"),
        ("", "not a number with a unit"),
        ("1,5 mm", "decimal comma"),
        ("nan mm", "not a number with a unit"),
        ("1e999 mm", "too large"),
        ("1e308 mm x", "unknown unit"),
        ("٣ mm", "not a number with a unit"),
    ],
)
def test_a_refused_quantity_says_why_and_lists_the_units(text: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint) as caught:
        parse_quantity(text, "length")
    assert 'one of m, cm, mm, um, inch, for example "5 mm"' in str(caught.value)


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'furlong' is not known; expected one of m, cm, mm"):
        from_unit(1.0, "furlong")
    with pytest.raises(ValueError, match=r"'furlong' is not known"):
        to_unit(1.0, "furlong")
    with pytest.raises(ValueError, match=r"'size' is not known; expected one of length, angle"):
        units_of("size")


def test_every_dimension_has_an_si_unit_and_one_to_show() -> None:
    shown = {u.dimension: (si_unit(u.dimension).name, display_unit(u.dimension).name) for u in UNITS.values()}
    assert shown["length"] == ("m", "mm")
    assert shown["angle"] == ("rad", "deg")
    assert shown["mass"] == ("kg", "g")
    assert shown["compliance"] == ("rad_per_Nm", "rad_per_Nm")
    assert all(UNITS[si].factor == 1.0 for si, _ in shown.values())


def test_the_table_of_units_cannot_be_changed() -> None:
    with pytest.raises(TypeError):
        UNITS["furlong"] = Unit("furlong", "length", 0.0254)  # type: ignore[index]


def test_units_import_nothing_heavy() -> None:
    code = "import sys, armcal.base.units; print({'numpy', 'pydantic', 'yaml'} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "set()"


def test_an_inch_is_25_4_mm_to_the_last_bit() -> None:
    assert parse_quantity("10 inch", "length") == 0.254
    assert split_suffix("x_inch") == ("x", UNITS["inch"])


@pytest.mark.parametrize(
    ("text", "amount", "seconds"),
    [
        ("0.05 deg in 30 d", "0.05 deg", 30 * 86400.0),
        ("0.1 mm in a week", "0.1 mm", 7 * 86400.0),
        ("0.02 in 2 months", "0.02", 60 * 86400.0),
        ("1 rad in 12h", "1 rad", 12 * 3600.0),
        ("1 rad in 90 minutes", "1 rad", 5400.0),
    ],
)
def test_an_amount_in_a_time(text: str, amount: str, seconds: float) -> None:
    assert amount_in_time(text) == (amount, seconds)


@pytest.mark.parametrize("text", ["0.05 deg", "0.05 deg in 0 d", "in 3 d", "1 mm in 3 furlongs", "1 mm in 1.2.3 d"])
def test_what_is_no_amount_in_a_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"such as 0\.05 deg in 30 d"):
        amount_in_time(text)
