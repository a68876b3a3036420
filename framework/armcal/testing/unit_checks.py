"""Whether numbers are in the units that they say: a parameter in degrees or millimetres shows in what it moves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from armcal.base.domains import Array, Interval
from armcal.base.parameters import ParameterBlock
from armcal.testing.results import expect

_LEAST_GAIN: Mapping[str, float] = MappingProxyType({"m": 5e-3, "rad": 0.05})
_MOST_GAIN = 20.0
"""What a unit of a parameter moves, in the same unit: about one. A degree is 0.017 rad, a millimetre 0.001 m."""
_NOTHING = 1e-9
_DIMENSIONS: Mapping[str, str] = MappingProxyType({"m": "length", "rad": "angle"})
_LARGEST: Mapping[str, tuple[float, float]] = MappingProxyType({"m": (100.0, 1.0), "rad": (4 * math.pi, math.pi)})
"""By unit: the largest nominal value, and the largest ordinary correction, that any arm could mean."""
_NOISIEST: Mapping[str, float] = MappingProxyType({"length": 0.1, "angle": 0.5})
"""By dimension: the largest standard deviation (m, rad) of an example that is worth calibrating with."""


def expect_plausible(blocks: Sequence[ParameterBlock]) -> None:
    """Raise ContractError if a length or an angle is of a size that only another unit explains."""
    for block in blocks:
        if block.unit not in _LARGEST or not isinstance(block.domain, Interval):
            continue
        largest, widest = _LARGEST[block.unit]
        worst = max((abs(number) for number in block.nominal), default=0.0)
        other = "mm" if block.unit == "m" else "deg"
        expect(
            worst <= largest and block.scale <= widest,
            f"{block.name}: found the nominal value {worst:g} and the scale {block.scale:g} {block.unit}, expected up "
            f"to {largest:.3g} and {widest:.3g}: is it in {other}?",
        )


def expect_small_noise(noise: Sequence[float], dimensions: Sequence[str]) -> None:
    """Raise ContractError if the example's noise (m or rad) is of a size that only another unit explains."""
    for number, dimension in zip(noise, dimensions, strict=False):
        largest = _NOISIEST.get(dimension, math.inf)
        unit, other = ("m", "mm") if dimension == "length" else ("rad", "deg")
        expect(
            number <= largest,
            f"found a noise of {number:g} {unit}, expected up to {largest:g} {unit} in an example: is it in {other}?",
        )


def scalars(blocks: Sequence[ParameterBlock], *units: str) -> list[tuple[int, ParameterBlock]]:
    """Blocks of one number in one of these units, each with the place of its entry among all entries."""
    scalars, place = [], 0
    for block in blocks:
        if isinstance(block.domain, Interval) and block.unit in units:
            scalars.append((place, block))
        place += block.size
    return scalars


def dimension_of(block: ParameterBlock) -> str:
    """``length`` or ``angle``; empty for any other."""
    return _DIMENSIONS.get(block.unit, "")


def expect_gain(gain: float, what: str, of: str, unit: str) -> None:
    """Raise ContractError if something moves by far more or less than about one for each unit of something else.

    Args:
        gain: how far it moves at most; none at all is no fault here.
        what: moves.
        of: by which.
        unit: of both.
    """
    expect(
        gain <= _NOTHING or _LEAST_GAIN[unit] <= gain <= _MOST_GAIN,
        f"found that {what} changes by {gain:.4g} {unit} for each {unit} of {of}, expected about 1: "
        "is one of them in another unit?",
    )


def size_of(part: Array) -> float:
    """The Euclidean length of a piece of a Jacobian; zero of an empty one."""
    return float(np.linalg.norm(part)) if part.size else 0.0
