"""Whether a factor's compiled library gives the interpreter's numbers: on a random block of records."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from armcal.base.domains import Array
from armcal.functions import c_source, compiler
from armcal.problem.factor import Factor

_AGREEMENT = 1e-12


class Linearise(Protocol):
    """Fills residuals and Jacobians; see ``Backend.linearise``."""

    def __call__(self, values: Array, record: Array, state: Array, residual: Array, jacobian: Array, /) -> int:
        """Give how many records did not settle."""


@dataclass(frozen=True)
class _Sample:
    """A random block of records, and its residuals and Jacobians."""

    values: Array
    record: Array
    residual: Array
    jacobian: Array


def trial(factor: Factor, linearise: Linearise, settling: tuple[float, int]) -> compiler.Trial:
    """What a new library's ``armcal_linearise`` has to give; ``settling`` is its tolerance (rad) and most passes."""
    made, count = _sample(factor, linearise), c_source.LANES
    state = np.zeros((factor.state.numel(), count))
    arrays = (made.values, made.record, state, np.zeros_like(made.residual), count, np.zeros_like(made.jacobian))
    arguments = (count, count, *arrays, count, *settling)
    return compiler.Trial("armcal_linearise", arguments, {5: made.residual, 7: made.jacobian}, _AGREEMENT)


def agree(factor: Factor, interpreted: Linearise, compiled: Linearise) -> bool:
    """Whether a library gives the same; one that was compiled wrong is not used."""
    one, two = _sample(factor, interpreted), _sample(factor, compiled)
    for mine, other in ((one.residual, two.residual), (one.jacobian, two.jacobian)):
        scale = max(1.0, float(np.nanmax(np.abs(mine), initial=0.0)))
        if not np.isfinite(scale) or not np.allclose(mine, other, rtol=0, atol=_AGREEMENT * scale, equal_nan=True):
            return np.array_equal(mine, other, equal_nan=True)
    return True


def _sample(factor: Factor, linearise: Linearise) -> _Sample:
    random = np.random.default_rng(0)
    count = c_source.LANES
    record = random.uniform(-1, 1, (factor.record.numel(), count))
    values = random.uniform(0.01, 0.02, factor.values.numel())
    state = np.zeros((factor.state.numel(), count))
    residual = np.zeros((factor.residual.numel(), count))
    jacobian = np.zeros((factor.residual.numel() * factor.values.numel(), count))
    linearise(values, record, state, residual, jacobian)
    return _Sample(values, record, residual, jacobian)
