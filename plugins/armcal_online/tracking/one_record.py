"""One record or a few at a time: a factor's residuals and Jacobians without the arrangements for many.

The compiled functions work on a whole vector of records; where there are fewer, its last places hold the last one.
Without a compiler CasADi's interpreter evaluates a single record. The elastic equilibrium starts from rest each time:
what comes out is a function of values and records alone, to the last bit.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from armcal.arm.evaluator import MOST_DEFLECTION
from armcal.base.arrays import Array
from armcal.functions.c_source import LANES
from armcal.problem.kernel import Compiled, Kernel


class OneRecord:
    """Buffers of one kernel for one record or a few; not to be shared between threads."""

    def __init__(self, kernel: Kernel) -> None:
        factor = kernel.factor
        self._kernel = kernel
        self._sizes = (factor.rows, factor.values.numel())
        width = LANES if isinstance(kernel.backend, Compiled) else 1
        self._values = np.zeros(self._sizes[1])
        self._record = np.zeros((len(factor.channels), width))
        self._state = np.zeros((factor.state.numel(), width))
        self._residual = np.zeros((self._sizes[0], width))
        self._jacobian = np.zeros((self._sizes[0] * self._sizes[1], width))
        arrays, backend = (self._values, self._record, self._state, self._residual, self._jacobian), kernel.backend
        # Evaluates these buffers again and again, and gives how many records did not settle.
        self._evaluate: Callable[[], int] = partial(backend.linearise, *arrays)

        def over_points() -> int:
            kernel.linearise(*arrays)
            return 0

        if kernel.points is not None:
            self._evaluate = over_points
        elif isinstance(backend, Compiled):
            self._evaluate = backend.prepared(*arrays)

    def linearise(self, values: Array, record: Array) -> tuple[Array, Array]:
        """Residual (n_r) and its Jacobian by the kernel's values (n_r x n_v), in equilibrium.

        Args:
            values: of the kernel (n_v).
            record: its channels (n_c).
        """
        residuals, jacobians = self.linearise_several(values, record[None])
        return residuals[0], jacobians[0]

    def linearise_several(self, values: Array, records: Array) -> tuple[Array, Array]:
        """Residuals (k x n_r) and their Jacobians (k x n_r x n_v) of records (k x n_c), in equilibrium."""
        count, width = len(records), self._record.shape[1]
        residuals, jacobians = np.empty((count, self._sizes[0])), np.empty((count, *self._sizes))
        self._values[:] = values
        for start in range(0, count, width):
            part = records[start : start + width]
            self._record[:] = part[-1][:, None]
            self._record[:, : len(part)] = part.T
            self._state[:] = 0.0
            if self._evaluate() or not np.abs(self._state).max(initial=0.0) <= MOST_DEFLECTION:
                # The rare way: Newton, arranged for many records.
                self._state[:] = 0.0
                self._kernel.linearise(self._values, self._record, self._state, self._residual, self._jacobian)
            done = slice(start, start + len(part))
            residuals[done] = self._residual.T[: len(part)]
            jacobians[done] = self._jacobian.T[: len(part)].reshape(-1, *self._sizes)
        return residuals, jacobians
