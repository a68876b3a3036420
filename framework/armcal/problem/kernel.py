"""Compiled functions of one factor: residuals and Jacobians of many records in elastic equilibrium.

CasADi's interpreter, always there, or generated C evaluates blocks of records. Both give the same numbers, which is
checked on a random block before a library is used. Arrays are stored channel by channel, (channels x records).

Records may be in groups: one kernel serves any number of them, values are gathered for each and Jacobians scattered
back, a block of records at a time, so that memory does not grow with the records.
"""

import ctypes
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib import resources
from typing import Any, Protocol

import casadi as ca
import numpy as np
from typing_extensions import override

from armcal.arm.evaluator import MOST_DEFLECTION, MOST_PASSES, NEAR_REST_RAD, REST_RAD, Evaluator, by_passes
from armcal.base.arrays import Array, Indices
from armcal.functions import c_source, compiler
from armcal.functions.batch_function import EvaluatorChoice, InterpretedFunction, agree_within
from armcal.functions.c_source import LANES
from armcal.problem.factor import Factor
from armcal.problem.records import FactorRecords, PointRecords, declared, mean_shares, transformed

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
        def following() -> Array:
            following_state, residual[:] = self._pass(values, record, state)
            return following_state

        return int(by_passes(following, state, rest).sum())

    @override
    def linearise(
        self, values: Array, record: Array, state: Array, residual: Array, jacobian: Array, rest: float = NEAR_REST_RAD
    ) -> int:
        unsettled = self.residuals(values, record, state, residual, rest) if self._has_state else 0
        state[:], residual[:], jacobian[:] = self._linearise(values, record, state)
        return unsettled


class Compiled(Backend):
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


def agree(factor: Factor, interpreter: Backend, compiled: Backend) -> bool:
    """Whether a library gives the interpreter's numbers; one that was compiled wrong is not used."""
    results = zip(_sample(factor, interpreter), _sample(factor, compiled), strict=True)
    return all(agree_within(*both, _AGREEMENT) for both in results)


def _sample(factor: Factor, backend: Backend) -> tuple[Array, Array]:
    """What a backend makes of a random block of records: residual and Jacobian."""
    random, count, rows = np.random.default_rng(0), c_source.LANES, factor.residual.numel()
    record = random.uniform(-1, 1, (factor.record.numel(), count))
    values = random.uniform(0.01, 0.02, factor.values.numel())
    state, residual = np.zeros((factor.state.numel(), count)), np.zeros((rows, count))
    jacobian = np.zeros((rows * factor.values.numel(), count))
    backend.linearise(values, record, state, residual, jacobian)
    return residual, jacobian


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


AS_IT_STANDS = 1e300  # Any state is at rest: take the one given, to which repeated passes might not lead
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

    ``auto`` takes a cached library, else waits for the compiler only where that pays, else interprets and lets the
    compiler work for the next run. ``compiled`` waits; without a compiler it interprets.
    """
    own = factor.expressed
    interpreter = Interpreter(own)
    if choice == "interpreted" or compiler.find_compiler() is None:
        return Kernel(factor, interpreter)
    functions = (own.pass_function, own.linearise_function)
    text = "".join(f.serialize() for f in functions) + c_source.support_source() + driver_source()
    text += f"{c_source.LANES} lanes" + c_source.generator_source()
    key = compiler.library_key(text)

    source = partial(kernel_source, own)
    library = compiler.load_cached(key)
    if library is None:
        if choice == "auto" and records < WORTH_COMPILING_RECORDS:
            compiler.compile_in_background(key, source)
            return Kernel(factor, interpreter)
        library = compiler.compile_now(key, source)
    if library is not None and agree(own, interpreter, compiled := Compiled(library)):
        return Kernel(factor, compiled, key)
    return Kernel(factor, interpreter)


def kernel_source(factor: Factor) -> str:
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


HELD = -1
BLOCK_RECORDS = 1024
_THREADS = 2

Block = tuple[Array, Array]  # Whitened, weighted Jacobian by the free entries (n_r x n_v x B) and residual (n_r x B)


@dataclass(frozen=True)
class Shown:
    outputs: Array  # what the instrument would read (n_o x N)
    tools: Array  # base_T_tool of each arm, column by column: three axes, then the place (arms x 4 x 3 x N, m)


@dataclass(frozen=True)
class GroupedKernel:
    """A kernel, where its values come from, and where its Jacobian goes.

    Results cover the records' whole width; their states are left in equilibrium. ``entries`` are positions in a value
    vector, a row a group (groups x n_values); one row without groups, or while none is known: then -1 stands where the
    spare values do.
    """

    kernel: Kernel
    entries: Indices
    free: Indices  # positions among the free entries, -1 where an entry is held (the same shape)
    width: int  # how many free entries there are
    spare: Array  # values for the group's own slots while no group is known

    @property
    def _block_records(self) -> int:
        points = 1 if self.kernel.points is None else self.kernel.points.count
        return max(LANES, BLOCK_RECORDS // points // LANES * LANES)

    @property
    def is_plain(self) -> bool:
        return len(self.free) == 1 and np.array_equal(self.free[0], np.arange(self.width))

    def values(self, values: Array, group: int) -> Array:
        entries = self.entries[group]
        if len(entries) and entries[-1] == HELD:
            return np.concatenate([values[entries[entries != HELD]], self.spare])
        return np.ascontiguousarray(values[entries])

    def residuals(self, values: Array, records: FactorRecords) -> Array:
        residual = np.empty((self.kernel.factor.rows, records.record.shape[1]))
        self._evaluate(self.kernel.residuals, values, records, residual)
        return residual if records.present is None else np.where(records.present, residual, 0.0)

    def require_held(self, values: Array, records: FactorRecords) -> None:
        self._evaluate(self.kernel.require_held, values, records)

    def channel_slopes(self, values: Array, records: FactorRecords, channels: Sequence[str]) -> Array:
        """d raw residual / d channels at states that are in equilibrium already (n_r x channels x width)."""
        shape = (self.kernel.factor.rows, len(channels), records.record.shape[1])
        slopes = np.empty((shape[0] * shape[1], shape[2]))
        self._evaluate(partial(self.kernel.channel_slopes, channels=channels), values, records, slopes)
        slopes = slopes.reshape(shape)
        return slopes if records.present is None else np.where(records.present[:, None], slopes, 0.0)

    def predict(self, values: Array, records: FactorRecords) -> Shown:
        factor = self.kernel.factor
        count = len(factor.output_channels)
        shown = np.empty((count + factor.tools.numel(), records.record.shape[1]))
        self._evaluate(self.kernel.predict, values, records, shown)
        shown = shown[:, : records.count]
        return Shown(shown[:count], shown[count:].reshape(factor.tools.numel() // 12, 4, 3, records.count))

    def nuisance_starts(self, values: Array, records: FactorRecords) -> Array:
        starts = np.empty((len(self.kernel.factor.nuisance_names), records.record.shape[1]))
        if len(starts):
            self._evaluate(self.kernel.nuisance_starts, values, records, starts)
        return starts

    def exact_hessian(self, values: Array, records: FactorRecords) -> Array:
        """Of half the squared whitened residuals (n x n), in equilibrium; of many points the Gauss-Newton one."""
        if self.kernel.points is not None:
            blocks = (jacobian for jacobian, _ in self.linearised(values, records))
            return sum((np.einsum("rvn,rwn->vw", b, b, optimize=True) for b in blocks), np.zeros((self.width,) * 2))
        total, noise = np.zeros((self.width, self.width)), declared(self.kernel.factor.noise)
        for number, columns in self._parts(records.group, records.count):
            own, free = self.values(values, number), self.free[number]
            seen = np.flatnonzero(free != HELD)
            for i in columns:
                whitening = noise if records.whitening is None else records.whitening[:, :, i]
                one = self.kernel.hessian(own, records.record[:, i], records.state[:, i], whitening)
                total[np.ix_(free[seen], free[seen])] += records.weight[i] * np.asarray(one)[np.ix_(seen, seen)]
        return total

    def linearised(self, values: Array, records: FactorRecords) -> Iterator[Block]:
        """Blocks of records in order, computed two at a time in threads; only a few are alive at once."""
        starts = range(0, records.record.shape[1], self._block_records)
        work = partial(self._block, values, records)
        if len(starts) <= _THREADS or self.kernel.backend.name != "compiled":
            yield from map(work, starts)
            return
        with ThreadPoolExecutor(_THREADS) as pool:
            pending = [pool.submit(work, start) for start in starts[: 2 * _THREADS]]
            for start in [*starts[2 * _THREADS :], *[None] * len(pending)]:
                yield pending.pop(0).result()
                if start is not None:
                    pending.append(pool.submit(work, start))

    def linearised_means(self, values: Array, records: FactorRecords) -> list[Block]:
        """Jacobian (n_r x n_v) and residual (n_r) of each group whose mean weighs more than its records say."""
        shares = mean_shares(self.kernel.factor, records)
        if not shares:
            return []
        alike = replace(records, whitening=None, weight=np.ones_like(records.weight))
        jacobian, residual = (np.concatenate(p, axis=-1) for p in zip(*self.linearised(values, alike), strict=True))
        return [(jacobian @ share, residual @ share) for share in shares]

    def _block(self, values: Array, records: FactorRecords, start: int) -> Block:
        part = slice(start, start + self._block_records)
        group = None if records.group is None else records.group[part]
        # Views: the states of the records are left in equilibrium.
        some = replace(records, record=records.record[:, part], state=records.state[:, part], group=group)
        n_residual, n_values, width = self.kernel.factor.rows, self.entries.shape[1], some.record.shape[1]
        jacobian, residual = np.empty((n_residual * n_values, width)), np.empty((n_residual, width))
        self._evaluate(self.kernel.linearise, values, some, residual, jacobian)
        scattered = jacobian.reshape(n_residual, n_values, width)
        if not self.is_plain:
            own, every = scattered, np.arange(n_residual)
            scattered = np.zeros((n_residual, self.width, width))
            for number, columns in self._parts(group, width):
                seen = np.flatnonzero(self.free[number] != HELD)
                scattered[np.ix_(every, self.free[number][seen], columns)] = own[np.ix_(every, seen, columns)]
        if records.present is not None:
            residual *= records.present[:, part]
            scattered *= records.present[:, None, part]
        weight = np.sqrt(records.weight[part])
        if records.whitening is not None:
            whitening = records.whitening[:, :, part] * weight
            return transformed(whitening, scattered), transformed(whitening, residual)
        scale = weight / np.array(self.kernel.factor.noise)[:, None]
        scattered *= scale[:, None, :]
        return scattered, residual * scale

    def _parts(self, group: Indices | None, width: int) -> Iterator[tuple[int, Indices]]:
        if group is None or len(self.entries) <= 1:
            yield 0, np.arange(width)
            return
        own = np.maximum(group, 0)
        for number in np.unique(own):
            yield int(number), np.flatnonzero(own == number)

    def _evaluate(self, evaluate: Callable[..., Any], values: Array, records: FactorRecords, *outputs: Array) -> None:
        """Call ``evaluate(values, record, state, *outputs)`` for each group on its own records; fills the outputs."""
        record, width = records.record, records.record.shape[1]
        for number, columns in self._parts(records.group, width):
            free, written = self.values(values, number), (records.state, *outputs)
            if len(columns) == width:
                evaluate(free, record, *written)
                continue
            # Whole vectors: the last record fills up, and is written once.
            fill = np.concatenate([columns, np.full(-len(columns) % LANES, columns[-1])])
            own = [np.ascontiguousarray(array[:, fill]) for array in (record, *written)]
            evaluate(free, *own)
            for target, part in zip(written, own[1:], strict=True):
                target[:, columns] = part[:, : len(columns)]
