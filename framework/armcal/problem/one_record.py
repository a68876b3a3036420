"""One record at a time: a factor's residual and Jacobian without the arrangements for many.

The compiled functions work on a whole vector of records, so all its places hold the same one. Without a compiler
CasADi's virtual machine evaluates a single record. The elastic equilibrium starts from rest each time: what comes out
is a function of values and record alone, to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import casadi as ca
import numpy as np

from armcal.base.domains import Array
from armcal.problem.c_source import LANES
from armcal.problem.kernel import Compiled, Kernel, direct_access
from armcal.problem.stability import MOST_DEFLECTION, MOST_PASSES, NEAR_REST_RAD


class OneRecord:
    """Buffers of one kernel for one record; not to be shared between threads."""

    def __init__(self, kernel: Kernel) -> None:
        factor = kernel.factor
        self._kernel = kernel
        self._sizes = (factor.residual.numel(), factor.values.numel())
        width = LANES if isinstance(kernel.backend, Compiled) else 1
        self._values = np.zeros(self._sizes[1])
        self._record = np.zeros((factor.record.numel(), width))
        self._state = np.zeros((factor.state.numel(), width))
        self._residual = np.zeros((self._sizes[0], width))
        self._jacobian = np.zeros((self._sizes[0] * self._sizes[1], width))
        self._evaluate: Callable[[], int] = self._interpreted
        if isinstance(kernel.backend, Compiled):
            arrays = self._values, self._record, self._state, self._residual, self._jacobian
            self._evaluate = kernel.backend.prepared(*arrays)

    def linearise(self, values: Array, record: Array) -> tuple[Array, Array]:
        """Residual (n_r) and its Jacobian by the kernel's values (n_r x n_v), in equilibrium.

        Args:
            values: of the kernel (n_v).
            record: its channels (n_c).

        Raises:
            NotConvergedError: the record has no equilibrium.
        """
        self._values[:] = values
        self._record[:] = record[:, None]
        self._state[:] = 0.0
        if self._evaluate() or not np.abs(self._state).max(initial=0.0) <= MOST_DEFLECTION:
            # The rare way: Newton, arranged for many records.
            self._state[:] = 0.0
            self._kernel.linearise(self._values, self._record, self._state, self._residual, self._jacobian)
        return self._residual[:, 0].copy(), self._jacobian[:, 0].reshape(self._sizes).copy()

    def _interpreted(self) -> int:
        """As a compiled function does it: how many records did not settle."""
        record, state = self._record[:, 0], self._state[:, 0]
        if len(state) and not self._settled(self._values, record, state):
            return 1
        _, residual, jacobian = self._linearise(self._values, record, state)
        self._residual[:, 0], self._jacobian[:, 0] = residual, jacobian
        return 0

    def _settled(self, values: Array, record: Array, state: Array) -> bool:
        for _ in range(MOST_PASSES):
            following, _ = self._pass(values, record, state)
            moved = np.abs(following - state).max()
            state[:] = following
            if moved <= NEAR_REST_RAD:
                return True
        return False

    @cached_property
    def _pass(self) -> _Single:
        return _Single(self._kernel.factor.pass_function())

    @cached_property
    def _linearise(self) -> _Single:
        return _Single(self._kernel.factor.linearise_function())


class _Single:
    """A CasADi function with its memory: no conversion for each number."""

    def __init__(self, function: ca.Function) -> None:
        buffer, self._evaluate = direct_access(function)
        self._buffer = buffer
        self._given = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        self._taken = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
        for position, array in enumerate(self._given):
            if array.size:
                buffer.set_arg(position, array.data)
        for position, array in enumerate(self._taken):
            if array.size:
                buffer.set_res(position, array.data)

    def __call__(self, *inputs: Array) -> list[Array]:
        """The outputs, valid until the next call."""
        for target, source in zip(self._given, inputs, strict=True):
            target[:] = source
        self._evaluate()
        return self._taken
