"""Compiled functions of one factor: residuals and Jacobians of many records in elastic equilibrium.

Arrays are stored channel by channel, (channels x records).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import resources

import casadi as ca
import numpy as np

from armcal.arm.equilibrium import MOST_DEFLECTION, NEAR_REST_RAD, REST_RAD
from armcal.arm.evaluator import Evaluator
from armcal.base.arrays import Array
from armcal.functions import c_source, compiler
from armcal.functions.batch_function import EvaluatorChoice, quietly
from armcal.functions.interpreted import InterpretedFunction
from armcal.problem.backend import Backend, Compiled, Interpreter, agree, trial
from armcal.problem.factor import Factor
from armcal.problem.factor_records import PointRecords

AS_IT_STANDS = 1e300
"""Any state is at rest: take the one given, to which repeated passes might not lead."""
WORTH_COMPILING_RECORDS = 5000
"""From this many records on, waiting for the compiler costs less than the interpreter does."""


@dataclass(frozen=True)
class Kernel:
    """A factor with the backend that evaluates it; ``identity`` names the library (its key) or the interpreter."""

    factor: Factor
    backend: Backend
    identity: str = f"casadi {ca.CasadiMeta.version()}"

    @cached_property
    def _by_channels(self) -> dict[tuple[str, ...], InterpretedFunction]:
        return {}

    @cached_property
    def evaluator(self) -> Evaluator:
        """What the instrument would read (of one point where there are many) and where tools are, in equilibrium."""
        own = self.factor.expressed
        return Evaluator(own, ca.vertcat(own.outputs, own.tools))

    @cached_property
    def hessian(self) -> ca.Function:
        return self.factor.hessian_function()

    @cached_property
    def points(self) -> PointRecords | None:
        """How records of many points are evaluated; None of a factor without points."""
        return None if self.factor.points is None else PointRecords(self.factor.shared, self.factor.points)

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
        self._over_points(self._residuals, values, record, state, residual)

    def linearise(self, values: Array, record: Array, state: Array, residual: Array, jacobian: Array) -> None:
        self._over_points(self._linearise, values, record, state, residual, jacobian)

    def predict(self, values: Array, record: Array, state: Array, shown: Array) -> None:
        """Outputs and tool poses in equilibrium (n_o + 12 an arm x records)."""
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
    functions = (own.pass_function, own.linearise_function)
    text = "".join(f.serialize() for f in functions) + c_source.support_source() + driver_source()
    text += f"{c_source.LANES} lanes" + c_source.generator_source()
    key = compiler.library_key(text)

    source, expected = partial(kernel_source, own), partial(trial, own, interpreter)
    library = compiler.load_cached(key)
    if library is None:
        if choice == "auto" and records < WORTH_COMPILING_RECORDS:
            quietly(lambda: compiler.compile_in_background(key, source, expected))
            return Kernel(factor, interpreter)
        library = quietly(lambda: compiler.compile_now(key, source, trial=expected))
    if library is not None and agree(own, interpreter, compiled := Compiled(library)):
        return Kernel(factor, compiled, key)
    return Kernel(factor, interpreter)


def kernel_source(factor: Factor) -> str:
    """The whole C file of a factor."""
    one = c_source.write_function(factor.pass_function, "pass", 1)
    two = c_source.write_function(factor.linearise_function, "linearise", 1)
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
    return resources.files("armcal.problem").joinpath("kernel_driver.h").read_text(encoding="utf-8")
