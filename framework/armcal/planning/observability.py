"""Observability indices: one number each for how well a set of poses determines the parameters."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from armcal.base.domains import Array


@dataclass(frozen=True)
class Observability:
    """The five indices; larger is better, 0 where a combination is undetermined.

    With s_1 >= ... >= s_n > 0 the singular values of the scaled whitened Jacobian of m equations:

    Attributes:
        o1: geometric mean over sqrt(m), (s_1 ... s_n)^(1/n) / sqrt(m). [Borm1989] [Borm1991]
        o2: inverse condition, s_n / s_1. [Driels1990]
        o3: smallest singular value, s_n. [Nahvi1994]
        o4: noise amplification, s_n^2 / s_1. [Nahvi1996]
        o5: harmonic mean, n / (1/s_1 + ... + 1/s_n). [Sun2008]
    """

    o1: float
    o2: float
    o3: float
    o4: float
    o5: float

    def as_dict(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)


def observability(singular_values: Array, equations: int) -> Observability:
    """The indices of a pose set.

    Args:
        singular_values: of its Jacobian (n), in any order; one a parameter, zeros included.
        equations: how many rows the Jacobian has, m.

    Raises:
        ValueError: no singular value, no equation, or a value that is negative or not finite.
    """
    values = np.asarray(singular_values, dtype=float)
    if not values.size or equations < 1:
        raise ValueError(f"{values.size} singular values of {equations} equations have no observability")
    if not np.isfinite(values).all() or values.min() < 0:
        raise ValueError("singular values must be finite and not negative")
    smallest, largest = float(values.min()), float(values.max())
    # Fewer rows than columns: the missing singular values are zero.
    if smallest == 0 or equations < values.size:
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0)
    # By logarithms and ratios: a product of many singular values overflows.
    return Observability(
        o1=float(np.exp(np.mean(np.log(values))) / np.sqrt(equations)),
        o2=smallest / largest,
        o3=smallest,
        o4=smallest * (smallest / largest),
        o5=float(values.size / np.sum(1 / values)),
    )
