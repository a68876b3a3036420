"""What makes a set of poses good: functions of the information matrix's eigenvalues, and observability indices.

``D`` maximises the determinant, ``A`` minimises the mean variance, ``E`` maximises the information of the
least determined direction [Pukelsheim2006]; ``O1`` to ``O5`` are the observability indices [Sun2008]. The
information is by coordinates in their typical scales, so that metres and radians can be compared.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Literal, get_args

import numpy as np

from armcal.base.arrays import Array

Goal = Literal["D", "A", "E", "O1", "O2", "O3", "O4", "O5"]
GOALS: tuple[Goal, ...] = get_args(Goal)
FLOOR = 1e-300  # Eigenvalues are kept above it, so that a singular matrix is very bad and not an error
_SAME = 1e-6


@dataclass(frozen=True)
class Criterion:
    """A goal as something to maximise, a function of eigenvalues (... x n, smallest first).

    Attributes:
        trace: where the criterion is a concave sum over eigenvalues, its derivative and second derivative by one.
    """

    name: str  # ``D``, ``A``, ``E``, ``O2``, ``O4`` or ``O5``; O1 is D and O3 is E
    value: Callable[[Array], Array]  # what is maximised
    trace: tuple[Callable[[Array], Array], Callable[[Array], Array]] | None

    def of(self, information: Array) -> Array:
        return self.value(np.maximum(np.linalg.eigvalsh(information), FLOOR))

    def efficiency(self, value: float, bound: float, size: int) -> float:
        """How good a plan for D, A or O5 is beside the best there could be, between 0 and 1.

        For D by the determinant's n-th root: 0.99 means that 1 % more measurements would make up for it.
        """
        if self.name == "D":
            return float(np.exp((value - bound) / size))
        return bound / value


def _power(p: float) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    return (lambda x: p * x ** (-p - 1)), (lambda x: -p * (p + 1) * x ** (-p - 2))


_D = Criterion("D", lambda x: np.sum(np.log(x), axis=-1), ((lambda x: 1 / x), (lambda x: -1 / x**2)))
_E = Criterion("E", lambda x: x[..., 0], None)
_CRITERIA: dict[str, Criterion] = {
    "D": _D,
    "O1": _D,
    "A": Criterion("A", lambda x: -np.sum(1 / x, axis=-1), _power(1.0)),
    "E": _E,
    "O3": _E,
    "O2": Criterion("O2", lambda x: np.sqrt(x[..., 0] / x[..., -1]), None),
    "O4": Criterion("O4", lambda x: x[..., 0] / np.sqrt(x[..., -1]), None),
    "O5": Criterion("O5", lambda x: -np.sum(x**-0.5, axis=-1), _power(0.5)),
}


def criterion(goal: Goal) -> Criterion:
    """The criterion of a goal; O1 and D, and O3 and E, order plans of equal size alike."""
    return _CRITERIA[goal]


def spread(slope: Callable[[Array], Array], curvature: Callable[[Array], Array], eigenvalues: Array) -> Array:
    """First divided differences of ``slope`` between all pairs of eigenvalues (n x n); the derivative of a trace
    function's gradient in the eigenbasis [Higham2008]."""
    a, b = eigenvalues[:, None], eigenvalues[None, :]
    near = np.abs(a - b) <= _SAME * np.maximum(a, b)
    difference = (slope(a) - slope(b)) / np.where(near, 1.0, a - b)
    return np.asarray(np.where(near, curvature((a + b) / 2), difference))


@dataclass(frozen=True)
class Observability:
    """The five indices; larger is better, 0 where a combination is undetermined.

    With s_1 >= ... >= s_n > 0 the singular values of the scaled whitened Jacobian of m equations:
    """

    o1: float  # geometric mean over sqrt(m), (s_1 ... s_n)^(1/n) / sqrt(m). [Borm1989] [Borm1991]
    o2: float  # inverse condition, s_n / s_1. [Driels1990]
    o3: float  # smallest singular value, s_n. [Nahvi1994]
    o4: float  # noise amplification, s_n^2 / s_1. [Nahvi1996]
    o5: float  # harmonic mean, n / (1/s_1 + ... + 1/s_n). [Sun2008]

    def as_dict(self) -> dict[str, float]:
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
