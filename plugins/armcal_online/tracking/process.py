"""How parameters wander between records: random walks, stated as a person would."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Mapping

import numpy as np
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.base.units import parse_quantity
from armcal.config.selection import quantity
from armcal.errors import ConfigError, Location

_RATE = re.compile(r"(?P<amount>.+?)\s+in\s+(?:(?P<count>[0-9.]+)\s*)?(?:an?\s+)?(?P<unit>[A-Za-z]+)\s*")
_SECONDS = {"day": 86400.0, "week": 7 * 86400.0, "month": 30 * 86400.0, "year": 365.25 * 86400.0, "hour": 3600.0}
_SHORT = {"d": "day", "h": "hour", "minute": "min", "second": "s"}


def variance_rates(parameters: Parameters, stated: Mapping[str, str]) -> Array:
    """Variance that each free coordinate gains, in its scaled unit squared per s (n).

    Args:
        parameters: with the free ones.
        stated: by glob, a standard deviation and the time in which it comes about: ``0.05 deg in 30 d``.

    Raises:
        ConfigError: a glob matches nothing, or nothing free; a text is no such rate.
    """
    rates = {block.name: 0.0 for block in parameters.free}
    for glob, text in stated.items():
        where = Location(f"process_noise.{glob}")
        names = [name for name in fnmatch.filter(parameters.names, glob) if name in rates]
        if not names:
            raise ConfigError(
                f"{glob!r} matches no parameter that the calibration found.",
                where=where,
                hint="armcal check -v lists the names; list others under free to let them move.",
            )
        for name in names:
            block = parameters[name]
            amount, seconds = _rate(text, where)
            deviation = quantity(block, _number(amount) if block.unit == "1" else amount, None, ())
            rates[name] = (deviation / block.scale) ** 2 / seconds
    return np.array([rates[block.name] for block in parameters.free for _ in range(block.domain.dof)])


def _rate(text: str, where: Location) -> tuple[str, float]:
    """A text's amount, and its time in s."""
    match = _RATE.fullmatch(str(text))
    unit = "" if match is None else match["unit"].lower()
    unit = _SHORT.get(unit, unit)
    if match is not None:
        single = unit.removesuffix("s") if len(unit) > 1 else unit
        single = _SHORT.get(single, single)
        try:
            count = float(match["count"] or 1.0)
            seconds = count * (_SECONDS[single] if single in _SECONDS else parse_quantity(f"1 {single}", "time"))
        except ValueError:
            seconds = 0.0
        if seconds > 0 and math.isfinite(seconds):
            return match["amount"], seconds
    raise ConfigError(
        f"found {text!r}, expected how far a parameter may wander in which time.",
        where=where,
        hint='Write for example "0.05 deg in 30 d", "0.1 mm in a week" or "0.02 in 1 month".',
    )


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
