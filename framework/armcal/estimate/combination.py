"""A direction in parameter space, in words."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array
from armcal.base.units import shown_unit

MOST_NAMES = 6
"""A longer combination is cut when it is shown; ``terms`` has all of it."""


@dataclass(frozen=True)
class Measure:
    """How one parameter is shown: its SI unit, and its typical scale in it."""

    unit: str
    scale: float

    def shown(self, coefficient: float) -> tuple[float, str]:
        factor, unit = shown_unit(self.unit)
        return coefficient * self.scale * factor, unit


@dataclass(frozen=True)
class Combination:
    """A direction in parameter space.

    Attributes:
        terms: (name, coefficient in typical scales of the parameter), the largest first.
        measures: one a term; empty to show coefficients in typical scales.
    """

    terms: tuple[tuple[str, float], ...]
    measures: tuple[Measure, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.terms)

    @property
    def amounts(self) -> tuple[str, ...]:
        """What each term moves by when the first moves by one unit: ``+1 mm``, ``-0.5 deg``."""
        if not self.measures:
            return tuple(f"{weight / self.terms[0][1]:+.3g}" for _, weight in self.terms)
        shown = [m.shown(weight) for m, (_, weight) in zip(self.measures, self.terms, strict=True)]
        return tuple(f"{amount / shown[0][0]:+.3g} {unit}".rstrip() for amount, unit in shown)

    def __str__(self) -> str:
        if not self.terms:
            return "nothing"
        if len(self.terms) == 1:
            return f"{self.terms[0][0]} alone"
        more = len(self.terms) - MOST_NAMES
        others, amounts = self.names[1:MOST_NAMES], self.amounts[:MOST_NAMES]
        tail = f" and {more} more" if more > 0 else ""
        listed = f"{', '.join(others)}{tail}" if tail else _listed(others)
        return f"{self.names[0]} trades with {listed} ({amounts[0]} with {_listed(amounts[1:])})"


def named(vector: Array, names: Sequence[str], measures: Sequence[Measure], at_least: float) -> Combination:
    """A vector in typical scales (n) as a combination, entries below ``at_least`` times the largest left out.

    The first term is positive: the vector's own sign means nothing.
    """
    largest = float(np.abs(vector).max(initial=0.0)) or 1.0
    # Rounded, so that equal shares stay in the order of the parameters whatever their last digits.
    order = np.argsort(-np.round(np.abs(vector) / largest, 6), kind="stable")
    kept = [int(i) for i in order if abs(vector[i]) > at_least * largest]
    size = float(np.copysign(largest, vector[kept[0]])) if kept else largest
    terms = tuple((names[i], float(vector[i] / size)) for i in kept)
    return Combination(terms, tuple(measures[i] for i in kept) if measures else ())


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
