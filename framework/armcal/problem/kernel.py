"""Compiled functions of one factor: residuals and Jacobians of many records in elastic equilibrium.

Two backends give the same numbers: CasADi's interpreter, always there, and generated C, where a
compiler is found. Arrays are stored channel by channel, (channels x records).
"""

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import resources
from typing import Any, Protocol

import casadi as ca
import numpy as np
from typing_extensions import override

from armcal.arm.equilibrium import MOST_DEFLECTION, MOST_PASSES, NEAR_REST_RAD, REST_RAD, by_passes
from armcal.arm.evaluator import Evaluator
from armcal.base.domains import Array
from armcal.functions import c_source, compiler
from armcal.functions.batch_function import EvaluatorChoice, quietly
from armcal.functions.interpreted import InterpretedFunction
from armcal.problem import kernel_trial
from armcal.problem.factor import Factor
from armcal.problem.point_records import PointRecords

AS_IT_STANDS = 1e300
"""Any state is at rest: take the one given, to which repeated passes might not lead."""
WORTH_COMPILING_RECORDS = 5000
"""From this many records on, waiting for the compiler costs less than the interpreter does."""


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
        return InterpretedFunction(self._factor.pass_function(), 1)

    @cached_property
    def _linearise(self) -> InterpretedFunction:
        return InterpretedFunction(self._factor.linearise_function(), 1)

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


@dataclass(frozen=True)
class Kernel:
    """A factor with the backend that evaluates it; ``identity`` names the library (its key) or the interpreter."""

    factor: Factor
    backend: Backend
    identity: str = f"casadi {ca.CasadiMeta.version()}"

    @cached_property
    def _by_channels(self) -> dict[tuple[str, ...], InterpretedFunction]:
        """Slopes by channels, once they were asked for."""
        return {}

    @cached_property
    def evaluator(self) -> Evaluator:
        """What the instrument would read (of one point where there are many) and where tools are, in equilibrium."""
        own = self.factor.expressed
        return Evaluator(own, ca.vertcat(own.outputs, own.tools))

    @cached_property
    def hessian(self) -> ca.Function:
        """The exact Hessian of one record."""
        return self.factor.hessian_function()

    @cached_property
    def points(self) -> PointRecords | None:
        """How records of many points are evaluated; None of a factor without points."""
        factor = self.factor
        if factor.points is None:
            return None
        return PointRecords(factor.shared, factor.points)

    def channel_slopes(
        self, values: Array, record: Array, state: Array, slopes: Array, channels: Sequence[str]
    ) -> None:
        """d residual / d channels (n_r * channels x records) at states in equilibrium."""
        if not slopes.size:
            return
        points, chosen = self.points, tuple(channels)
        if points is None:
            slopes[:] = self._channel_slopes(chosen)(values, record, state)[0]
            return
        # A reading moves its own row, and no other.
        shared = tuple(channel for channel in chosen if channel not in self.factor.output_channels)
        whole = slopes.reshape(self.factor.rows, len(chosen), -1)
        whole[:] = 0.0
        for place, channel in enumerate(chosen):
            if channel not in shared:
                whole[self.factor.output_channels.index(channel), place] = 1.0
        if shared:
            (narrow,) = self._channel_slopes(shared)(values, points.split(record), points.repeated(state))
            places = [chosen.index(channel) for channel in shared]
            whole[:, places] = points.joined(narrow).reshape(self.factor.rows, len(shared), -1)

    def _channel_slopes(self, channels: tuple[str, ...]) -> InterpretedFunction:
        if channels not in self._by_channels:
            self._by_channels[channels] = InterpretedFunction(self.factor.expressed.channel_slope_function(channels), 1)
        return self._by_channels[channels]

    def residuals(self, values: Array, record: Array, state: Array, residual: Array) -> None:
        """Residuals in equilibrium.

        Raises:
            NotConvergedError: a record has none.
        """
        self._over_points(self._residuals, values, record, state, residual)

    def linearise(self, values: Array, record: Array, state: Array, residual: Array, jacobian: Array) -> None:
        """Residuals and Jacobian in equilibrium.

        Raises:
            NotConvergedError: a record has none.
        """
        self._over_points(self._linearise, values, record, state, residual, jacobian)

    def predict(self, values: Array, record: Array, state: Array, shown: Array) -> None:
        """Outputs and tool poses in equilibrium (n_o + 12 an arm x records).

        Raises:
            NotConvergedError: a record has no equilibrium.
        """
        points = self.points
        if points is None:
            shown[:] = self.evaluator(values, record, state)
            return
        here, readings = points.repeated(state), len(self.factor.output_channels)
        narrow, own = self.evaluator(values, points.split(record), here), self.factor.expressed.outputs.numel()
        state[:] = here[:, :: points.count]
        shown[:readings] = points.joined(narrow[:own])
        shown[readings:] = narrow[own:, :: points.count]

    def require_held(self, values: Array, record: Array, state: Array) -> None:
        """Refuse states in equilibrium that springs do not hold (NotConvergedError)."""
        self._over_points(self.evaluator.require_held, values, record, state)

    def nuisance_starts(self, values: Array, record: Array, state: Array, starts: Array) -> None:
        """Where each record alone has its group's parameters start, in equilibrium (entries x records)."""
        starts[:] = Evaluator(self.factor, self.factor.nuisance_starts)(values, record, state)

    def _over_points(
        self, evaluate: Callable[..., None], values: Array, record: Array, state: Array, *outputs: Array
    ) -> None:
        """Call ``evaluate(values, record, state, *outputs)`` on records of one point each where there are many."""
        points = self.points
        if points is None:
            evaluate(values, record, state, *outputs)
            return
        here, wide = points.repeated(state), record.shape[1] * points.count
        own = [np.empty((len(target) // points.count, wide)) for target in outputs]
        evaluate(values, points.split(record), here, *own)
        state[:] = here[:, :: points.count]
        for target, narrow in zip(outputs, own, strict=True):
            target[:] = points.joined(narrow)

    def _residuals(self, values: Array, record: Array, state: Array, residual: Array) -> None:
        before = state.copy()
        if self.backend.residuals(values, record, state, residual, REST_RAD) or _out_of_hand(state):
            self.evaluator.recover(values, record, state, before)
            self.backend.residuals(values, record, state, residual, AS_IT_STANDS)

    def _linearise(self, values: Array, record: Array, state: Array, residual: Array, jacobian: Array) -> None:
        before = state.copy()
        if self.backend.linearise(values, record, state, residual, jacobian, NEAR_REST_RAD) or _out_of_hand(state):
            self.evaluator.recover(values, record, state, before)
            self.backend.linearise(values, record, state, residual, jacobian, AS_IT_STANDS)


def _out_of_hand(state: Array) -> bool:
    return bool(np.abs(state).max(initial=0.0) > MOST_DEFLECTION)


def build_kernel(factor: Factor, records: int, choice: EvaluatorChoice = "auto") -> Kernel:
    """A kernel for about so many records.

    ``auto`` takes a cached library, else waits for the compiler only where that pays, else interprets and lets
    the compiler work for the next run. ``compiled`` waits; without a compiler it interprets.
    """
    own = factor.expressed
    interpreter = Interpreter(own)
    if choice == "interpreted" or compiler.find_compiler() is None:
        return Kernel(factor, interpreter)
    functions = (own.pass_function(), own.linearise_function())
    text = "".join(f.serialize() for f in functions) + c_source.support_source() + driver_source()
    text += f"{c_source.LANES} lanes" + c_source.generator_source()
    key = compiler.library_key(text)

    def source() -> str:
        return kernel_source(own, *functions)

    def trial() -> compiler.Trial:
        return kernel_trial.trial(own, interpreter.linearise, (NEAR_REST_RAD, MOST_PASSES))

    library = compiler.load_cached(key)
    if library is None:
        if choice == "auto" and records < WORTH_COMPILING_RECORDS:
            quietly(lambda: compiler.compile_in_background(key, source, trial))
            return Kernel(factor, interpreter)
        library = quietly(lambda: compiler.compile_now(key, source, trial=trial))
    if library is None:
        return Kernel(factor, interpreter)
    compiled = Compiled(library)
    return (
        Kernel(factor, compiled, key)
        if kernel_trial.agree(own, interpreter.linearise, compiled.linearise)
        else Kernel(factor, interpreter)
    )


def kernel_source(factor: Factor, single_pass: ca.Function, linearise: ca.Function) -> str:
    """The whole C file of a factor."""
    one = c_source.write_function(single_pass, "pass", 1)
    two = c_source.write_function(linearise, "linearise", 1)
    sizes = {
        "LANES": c_source.LANES,
        "N_RECORD": factor.record.numel(),
        "N_STATE": factor.state.numel(),
        "N_RESIDUAL": factor.residual.numel(),
        "N_VALUES": factor.values.numel(),
        "PASS_HOISTED": one.hoisted,
        "LINEARISE_HOISTED": two.hoisted,
    }
    defines = "".join(f"#define {name} {number}\n" for name, number in sizes.items())
    return defines + c_source.support_source() + one.source + two.source + driver_source()


def driver_source() -> str:
    """The loop over records: equilibrium, residual, Jacobian."""
    return resources.files("armcal.problem").joinpath("kernel_driver.h").read_text(encoding="utf-8")


def _stride(array: Array) -> int:
    """Numbers from one channel to the next."""
    if array.size and array.strides[1] != array.itemsize:
        raise ValueError("the records of a channel must lie side by side")
    return array.strides[0] // array.itemsize


def _pointers(values: Array, *channels: Array) -> list[int]:
    """Addresses; the C side takes contiguous values, and one stride for record and state."""
    if not values.flags.c_contiguous or len({_stride(array) for array in channels if array.size}) > 1:
        raise ValueError("values must be contiguous, record and state slices of arrays of one width")
    return [values.ctypes.data, *(array.ctypes.data for array in channels)]


def _signature(function: Any, outputs: int) -> Any:
    """Count and stride, three inputs, then each output with its own stride, tolerance, most passes."""
    integer, pointer = ctypes.c_long, ctypes.c_void_p
    shared = [integer, integer, pointer, pointer, pointer]
    function.argtypes = [*shared, *[pointer, integer] * outputs, ctypes.c_double, ctypes.c_int]
    function.restype = integer
    return function
