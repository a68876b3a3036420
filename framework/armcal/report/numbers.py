"""Numbers as people read them: few digits, a true minus sign, the units of the workshop."""

import math
from collections.abc import Iterable

NONE = "\u2013"
MINUS = "\u2212"
_MOST_DECIMALS = 9
_ASCII = {MINUS: "-", NONE: "-", "\u202f": " ", "\u2007": " ", "\u2008": " "}


def fixed(value: float | None, decimals: int, signed: bool = False) -> str:
    """A number with so many decimals; scientific where too large to read; a dash for none."""
    if value is None or math.isnan(value):
        return NONE
    if math.isinf(value):
        return "∞" if value > 0 else f"{MINUS}∞"
    if abs(value) >= 1e7:
        return f"{value:{'+' if signed else ''}.2e}".replace("-", MINUS)
    text = f"{value:{'+' if signed else ''}.{decimals}f}"
    if not any(digit in text for digit in "123456789"):
        return text.lstrip("+-")
    return text.replace("-", MINUS)


def significant(value: float, digits: int = 3) -> str:
    if not math.isfinite(value):
        return fixed(value, 0)
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}".replace("-", MINUS)
    if abs(value) >= 1000:
        return count(int(float(f"{value:.{digits - 1}e}"))).replace("-", MINUS)
    return fixed(value, decimals_for(value, digits))


def decimals_for(size: float, digits: int = 2) -> int:
    """How many decimals show so many significant digits of ``size``."""
    if not math.isfinite(size) or size == 0:
        return 0
    return min(max(digits - 1 - math.floor(math.log10(abs(size))), 0), _MOST_DECIMALS)


def common_decimals(values: Iterable[float | None], most: int = 4) -> int:
    sizes = [abs(v) for v in values if v is not None and math.isfinite(v) and v != 0]
    return min(max(decimals_for(min(sizes)), 2), most) if sizes else 2


def count(number: int) -> str:
    return f"{number:,}".replace(",", "\u202f")


def plural(number: int, noun: str) -> str:
    """``1 record``, ``2 records``."""
    return f"{count(number)} {noun}{'' if number == 1 else 's'}"


def in_ascii(text: str) -> str:
    """The same for terminals that have no more than letters."""
    for sign, word in _ASCII.items():
        text = text.replace(sign, word)
    return text.strip()
