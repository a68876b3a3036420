"""CasADi functions by its interpreter, without a conversion for each number."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from armcal.base.arrays import Array

_BLOCKS = (64, 8, 1)  # Records that are evaluated together; what does not fill a block goes to smaller ones


class BoundFunction:
    """A CasADi function with memory of its own; not to be shared between threads.

    Attributes:
        inputs: read by ``evaluate`` (records x entries each); the first ``shared`` of them one for all (entries).
        outputs: written by it (records x entries each).
    """

    def __init__(self, function: ca.Function, records: int = 1, shared: int = 0) -> None:
        ins = [function.numel_in(i) for i in range(function.n_in())]
        outs = [function.numel_out(i) for i in range(function.n_out())]
        if records > 1:
            function = function.map(f"{function.name()}_block", "serial", records, list(range(shared)), [])
        self.inputs = [np.zeros(size if i < shared else (records, size)) for i, size in enumerate(ins)]
        self.outputs = [np.zeros((records, size)) for size in outs]
        self._buffer: Any  # keeps the memory that ``evaluate`` works on
        self.evaluate: Callable[[], None]
        self._buffer, self.evaluate = function.buffer()
        for arrays, bind in ((self.inputs, self._buffer.set_arg), (self.outputs, self._buffer.set_res)):
            for place, array in enumerate(arrays):
                if array.size:
                    bind(place, array.data)


class InterpretedFunction:
    """A CasADi function of column vectors (dense inputs and outputs) over many records.

    Its first ``shared`` inputs are the same for all of them.
    """

    def __init__(self, function: ca.Function, shared: int = 0) -> None:
        self.function, self._shared = function, shared
        self._memory = threading.local()
        self._sizes_out = [function.numel_out(i) for i in range(function.n_out())]

    def __call__(self, *inputs: Array) -> list[Array]:
        """The outputs (entries x N each) for inputs (entries x N each; shared ones: entries)."""
        start, count = 0, inputs[self._shared].shape[1]
        if count in _BLOCKS:
            return [array.T.copy() for array in self._evaluated(inputs, count)]
        outputs = [np.empty((size, count)) for size in self._sizes_out]
        for block in _BLOCKS:
            while count - start >= block:
                part = slice(start, start + block)
                columns = (source[:, part] for source in inputs[self._shared :])
                arrays = self._evaluated((*inputs[: self._shared], *columns), block)
                for target, array in zip(outputs, arrays, strict=True):
                    target[:, part] = array.T
                start += block
        return outputs

    def _evaluated(self, inputs: Sequence[Array], records: int) -> list[Array]:
        own: Any = self._memory.__dict__  # each thread's, by the number of records at once
        bound: BoundFunction | None = own.get(records)
        if bound is None:
            bound = own[records] = BoundFunction(self.function, records, self._shared)
        for array, source in zip(bound.inputs, inputs, strict=True):
            array[...] = source.T
        bound.evaluate()
        return bound.outputs
