"""What evaluates one factor on blocks of records: CasADi's interpreter, always there, or generated C.

Both give the same numbers, which is checked on a random block before a library is used. Arrays are stored channel by
channel, (channels x records).
"""

import ctypes
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np
from typing_extensions import override

from armcal.arm.equilibrium import MOST_PASSES, NEAR_REST_RAD, REST_RAD, by_passes
from armcal.base.arrays import Array
from armcal.functions import c_source, compiler
from armcal.functions.interpreted import InterpretedFunction
from armcal.problem.factor import Factor

_AGREEMENT = 1e-12


class Backend(Protocol):
    """Evaluates blocks of records; ``state`` is read as the start and left in equilibrium."""

    name: str

    def residuals(self, values: Array, record: Array, state: Array, residual: Array, rest: float = REST_RAD) -> int:
        """Fill ``residual`` once no deflection moves more than ``rest``; give how many records did not settle."""

    def linearise(
        self, values: Array, record: Array, state: Array, residual: Array, jacobian: Array, rest: float = NEAR_REST_RAD
    ) -> int:
        """Fill ``residual``, and ``jacobian`` (n_r * n_v x records, residual entry by residual entry)."""


class Interpreter(Backend):
    """CasADi's interpreter over blocks of records."""

    name = "interpreted"

    def __init__(self, factor: Factor) -> None:
        self._factor = factor
        self._has_state = factor.state.numel() > 0

    @cached_property
    def _pass(self) -> InterpretedFunction:
        return InterpretedFunction(self._factor.pass_function, 1)

    @cached_property
    def _linearise(self) -> InterpretedFunction:
        return InterpretedFunction(self._factor.linearise_function, 1)

    @override
    def residuals(self, values: Array, record: Array, state: Array, residual: Array, rest: float = REST_RAD) -> int:
        return self._settle(values, record, state, residual, rest)

    @override
    def linearise(
        self, values: Array, record: Array, state: Array, residual: Array, jacobian: Array, rest: float = NEAR_REST_RAD
    ) -> int:
        unsettled = 0
        if self._has_state:
            unsettled = self._settle(values, record, state, residual, rest)
        state[:], residual[:], jacobian[:] = self._linearise(values, record, state)
        return unsettled

    def _settle(self, values: Array, record: Array, state: Array, residual: Array, rest: float) -> int:
        def following() -> Array:
            following_state, residual[:] = self._pass(values, record, state)
            return following_state

        return int(by_passes(following, state, rest).sum())


class Compiled(Backend):
    """The same functions in C, several records at once."""

    name = "compiled"

    def __init__(self, library: ctypes.CDLL) -> None:
        self._residuals = _signature(library.armcal_residuals, outputs=1)
        self._linearise = _signature(library.armcal_linearise, outputs=2)

    @override
    def residuals(self, values: Array, record: Array, state: Array, residual: Array, rest: float = REST_RAD) -> int:
        pointers = [*_pointers(values, record, state), residual.ctypes.data, _stride(residual)]
        return int(self._residuals(record.shape[1], _stride(record), *pointers, rest, MOST_PASSES))

    @override
    def linearise(
        self, values: Array, record: Array, state: Array, residual: Array, jacobian: Array, rest: float = NEAR_REST_RAD
    ) -> int:
        return self.prepared(values, record, state, residual, jacobian, rest)()

    def prepared(
        self, values: Array, record: Array, state: Array, residual: Array, jacobian: Array, rest: float = NEAR_REST_RAD
    ) -> Callable[[], int]:
        """``linearise`` again and again, of arrays that the caller keeps: their addresses are taken once."""
        pointers = [*_pointers(values, record, state), residual.ctypes.data, _stride(residual)]
        pointers += [jacobian.ctypes.data, _stride(jacobian)]
        return partial(self._linearise, record.shape[1], _stride(record), *pointers, rest, MOST_PASSES)


def trial(factor: Factor, interpreter: Backend) -> compiler.Trial:
    """What a new library's ``armcal_linearise`` has to give, of a random block of records."""
    (values, record, residual, jacobian), count = _sample(factor, interpreter), c_source.LANES
    state = np.zeros((factor.state.numel(), count))
    arrays = (values, record, state, np.zeros_like(residual), count, np.zeros_like(jacobian))
    arguments = (count, count, *arrays, count, NEAR_REST_RAD, MOST_PASSES)
    return compiler.Trial("armcal_linearise", arguments, {5: residual, 7: jacobian}, _AGREEMENT)


def agree(factor: Factor, interpreter: Backend, compiled: Backend) -> bool:
    """Whether a library gives the interpreter's numbers; one that was compiled wrong is not used."""
    results = zip(_sample(factor, interpreter)[2:], _sample(factor, compiled)[2:], strict=True)
    return all(compiler.agree(*both, _AGREEMENT) for both in results)


def _sample(factor: Factor, backend: Backend) -> tuple[Array, Array, Array, Array]:
    """A random block of records: values, record, and what a backend makes of them, residual and Jacobian."""
    random, count, rows = np.random.default_rng(0), c_source.LANES, factor.residual.numel()
    record = random.uniform(-1, 1, (factor.record.numel(), count))
    values = random.uniform(0.01, 0.02, factor.values.numel())
    state, residual = np.zeros((factor.state.numel(), count)), np.zeros((rows, count))
    jacobian = np.zeros((rows * factor.values.numel(), count))
    backend.linearise(values, record, state, residual, jacobian)
    return values, record, residual, jacobian


def _stride(array: Array) -> int:
    if array.size and array.strides[1] != array.itemsize:
        raise ValueError("the records of a channel must lie side by side")
    return array.strides[0] // array.itemsize


def _pointers(values: Array, *channels: Array) -> list[int]:
    if not values.flags.c_contiguous or len({_stride(array) for array in channels if array.size}) > 1:
        raise ValueError("values must be contiguous, record and state slices of arrays of one width")
    return [values.ctypes.data, *(array.ctypes.data for array in channels)]


def _signature(function: Any, outputs: int) -> Any:
    integer, pointer = ctypes.c_long, ctypes.c_void_p
    shared = [integer, integer, pointer, pointer, pointer]
    function.argtypes = [*shared, *[pointer, integer] * outputs, ctypes.c_double, ctypes.c_int]
    function.restype = integer
    return function
