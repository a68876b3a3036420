"""A CasADi function over many records at once: generated C where a compiler is found, the interpreter elsewhere.

Arrays are stored channel by channel, (entries x records).
"""

import ctypes
import threading
from collections.abc import Callable, Sequence
from functools import partial
from itertools import accumulate
from typing import Any, Literal

import casadi as ca
import numpy as np

from armcal.base.arrays import Array
from armcal.functions import c_source, compiler

EvaluatorChoice = Literal["auto", "compiled", "interpreted"]

_ENTRY, _VECTOR, _ITERATE = "armcal_evaluate", "armcal_evaluate_vector", "armcal_iterate"
_AGREEMENT = 1e-9
_BLOCKS = (64, 8, 1)  # Records that are interpreted together; what does not fill a block goes to smaller ones
_WORTH_COMPILING = 100_000  # Records that the interpreter takes longer for than the compiler takes to make a library


class BoundFunction:
    """A CasADi function with memory of its own; not to be shared between threads.

    ``evaluate`` reads ``inputs`` and writes ``outputs`` (records x entries each; the first ``shared`` inputs: entries).
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


class BatchFunction:
    """A function of column vectors (SX, dense inputs and outputs), to be called for many records."""

    def __init__(
        self, function: ca.Function, sample: Sequence[Array], choice: EvaluatorChoice = "auto", iterated: bool = False
    ) -> None:
        """Build it; ``sample`` are inputs (entries x 8 each) on which C must agree with the interpreter.

        ``auto`` takes what was compiled before, and else lets the compiler work for the next time once so many records
        were asked for that it would have paid; ``compiled`` waits for it; ``interpreted`` does without. A function of
        one output that follows on its last input can be ``iterated``.
        """
        self.function, self.interpreted = function, InterpretedFunction(function)
        self._sizes_out = [function.numel_out(i) for i in range(function.n_out())]
        self.places = list(zip(self._sizes_out, accumulate(self._sizes_out), strict=True))
        self._all_in = sum(function.numel_in(i) for i in range(function.n_in()))
        self._library: Any = None
        self._asked = 0
        self._compile_later: Callable[[], None] | None = None
        if choice != "interpreted" and compiler.find_compiler() is not None:
            library, self._compile_later = _library(function, choice, iterated)
            self._library = _agreeing(self, library, sample)

    @property
    def compiled(self) -> bool:
        return self._library is not None

    def __call__(self, *inputs: Array) -> list[Array]:
        """The outputs (entries x N each) for inputs (entries x N each)."""
        count = inputs[0].shape[1]
        if self._library is None:
            self._asked += count
            if self._asked > _WORTH_COMPILING and self._compile_later is not None:
                later, self._compile_later = self._compile_later, None
                later()
            return self.interpreted(*inputs)
        whole = count - count % c_source.LANES
        if not whole and count:
            return self._rest(inputs, 0)
        outputs = [np.empty((size, count)) for size in self._sizes_out]
        _evaluate(self._library.armcal_evaluate, [_rows(array) for array in inputs], outputs, whole)
        if whole < count:
            for target, source in zip(outputs, self._rest(inputs, whole), strict=True):
                target[:, whole:] = source
        return outputs

    def iterate(self, progress: Array, *inputs: Array) -> None:
        """Put the output in the place of ``progress`` (entries x N) until its last entry is not zero, record by record.

        ``inputs`` (entries x N each; entries alone where all records share them) come before it among the function's
        inputs. C would read beyond other shapes.
        """
        if self._library is not None:
            given = [*(np.asarray(array, dtype=float) for array in inputs), progress]
            pointers = (ctypes.c_void_p * len(given))(*(array.ctypes.data for array in given))
            steps = [step // 8 for array in given for step in (*array.strides, 0)[:2]]
            strides = (ctypes.c_long * len(steps))(*steps)
            self._library.armcal_iterate(ctypes.c_long(progress.shape[1]), pointers, strides)
            return
        active, now = np.arange(progress.shape[1]), progress
        rest = [np.repeat(array[:, None], len(active), axis=1) if array.ndim == 1 else array for array in inputs]
        while active.size:
            (now,) = self(*rest, now)
            ended = now[-1] != 0
            if ended.any():
                progress[:, active[ended]] = now[:, ended]
                # not by plain indexing, which would turn the storage round
                now, *rest = (np.compress(~ended, array, axis=1) for array in (now, *rest))
                active = active[~ended]

    def _rest(self, inputs: Sequence[Array], start: int) -> list[Array]:
        """Records from ``start`` on, fewer than one vector of them: the last one fills it up."""
        count, row = inputs[0].shape[1] - start, 0
        given = np.empty((self._all_in, c_source.LANES))
        for array in inputs:
            given[row : row + len(array), :count] = array[:, start:]
            row += len(array)
        given[:, count:] = given[:, count - 1 : count]
        taken = np.empty((sum(self._sizes_out), c_source.LANES))
        self._library.armcal_evaluate_vector(given.ctypes.data, taken.ctypes.data)
        return [taken[end - size : end, :count] for size, end in self.places]


def _library(
    function: ca.Function, choice: EvaluatorChoice, iterated: bool
) -> tuple[ctypes.CDLL | None, Callable[[], None]]:
    """The library if there is one by now, and what has it compiled for the next time."""
    driver = _driver(function) + (_iteration(function) if iterated else "")
    entries = (_ENTRY, _VECTOR, *([_ITERATE] if iterated else []))
    text = function.serialize() + c_source.support_source() + c_source.generator_source() + driver
    key = compiler.library_key(f"{_ENTRY} {c_source.LANES} lanes {text}")

    def source() -> str:
        written = c_source.write_function(function, "evaluate", 0)
        defines = f"#define LANES {c_source.LANES}\n#define HOISTED {written.hoisted}\n"
        return defines + c_source.support_source() + written.source + driver

    library = compiler.load_cached(key, entries)
    if library is None and choice == "compiled":
        library = compiler.compile_now(key, source, entries)
    return library, partial(compiler.compile_in_background, key, source)


def _driver(function: ca.Function) -> str:
    """The loop over vectors of records."""
    ins = [function.numel_in(i) for i in range(function.n_in())]
    outs = [function.numel_out(i) for i in range(function.n_out())]
    vectors = [f"V in{i}[{max(1, n)}];" for i, n in enumerate(ins)]
    vectors += [f"V out{i}[{max(1, n)}];" for i, n in enumerate(outs)]
    gathered = [f"gather(in{i}, in[{i}] + r, in_stride[{i}], {n});" for i, n in enumerate(ins)]
    scattered = [f"scatter(out[{i}] + r, out{i}, out_stride[{i}], {n});" for i, n in enumerate(outs)]
    names = [*(f"in{i}" for i in range(len(ins))), *(f"out{i}" for i in range(len(outs)))]
    lines = [*vectors, *gathered, f"evaluate(c, {', '.join(names)});", *scattered]
    body = "\n    ".join(lines)
    return (
        f"void {_ENTRY}(long n, const double **in, const long *in_stride, double **out, const long *out_stride) {{\n"
        "  double c[HOISTED];\n  evaluate_hoist(c);\n"
        f"  for (long r = 0; r < n; r += LANES) {{\n    {body}\n  }}\n}}\n"
        f"void {_VECTOR}(const double *in, double *out) {{\n"
        f"  const double *from[] = {{{', '.join(_addresses('in', ins))}}};\n"
        f"  double *onto[] = {{{', '.join(_addresses('out', outs))}}};\n"
        f"  long step[{max(len(ins), len(outs))}];\n"
        f"  for (int i = 0; i < {max(len(ins), len(outs))}; ++i) step[i] = LANES;\n"
        f"  {_ENTRY}(LANES, from, step, onto, step);\n}}\n"
    )


def _iteration(function: ca.Function) -> str:
    """The loop over iterations: LANES records side by side, where one that ends makes room for the next.

    Of each input follow its two strides, from entry to entry and from record to record.
    """
    sizes = [function.numel_in(i) for i in range(function.n_in())]
    names, last = [f"in{i}" for i in range(len(sizes))], len(sizes) - 1
    vectors = [f"V in{i}[{max(1, n)}]; memset(in{i}, 0, sizeof in{i});" for i, n in enumerate(sizes)]
    loads = [
        f"for (int k = 0; k < {n}; ++k) in{i}[k][l] = in[{i}][k * stride[{2 * i}] + at[l] * stride[{2 * i + 1}]];"
        for i, n in enumerate(sizes)
    ]
    return f"""
void {_ITERATE}(long n, double **in, const long *stride) {{
  double c[HOISTED];
  V after[{sizes[last]}];
  long at[LANES], next = 0;
  {" ".join(vectors)}
  evaluate_hoist(c);
  for (int l = 0; l < LANES; ++l) at[l] = -1;
  for (;;) {{
    long busy = 0;
    for (int l = 0; l < LANES; ++l) {{
      if (at[l] >= 0 && in{last}[{sizes[last] - 1}][l] != 0) {{
        for (int k = 0; k < {sizes[last]}; ++k)
          in[{last}][k * stride[{2 * last}] + at[l] * stride[{2 * last + 1}]] = in{last}[k][l];
        at[l] = -1;
      }}
      if (at[l] < 0 && next < n) {{
        at[l] = next++;
        {" ".join(loads)}
      }}
      busy += at[l] >= 0;
    }}
    if (!busy) return;
    evaluate(c, {", ".join(names)}, after);
    memcpy(in{last}, after, sizeof after);
  }}
}}
"""


def _addresses(name: str, sizes: Sequence[int]) -> list[str]:
    return [f"{name} + {start} * LANES" for start in accumulate([0, *sizes[:-1]])]


def _agreeing(batch: BatchFunction, library: ctypes.CDLL | None, sample: Sequence[Array]) -> Any:
    """The library, if it gives the interpreter's numbers; a miscompiled one is not used."""
    if library is None:
        return None
    library.armcal_evaluate_vector.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    given = [np.ascontiguousarray(array[:, : c_source.LANES]) for array in sample]
    mine = [np.empty((size, c_source.LANES)) for size, _ in batch.places]
    _evaluate(library.armcal_evaluate, given, mine, c_source.LANES)
    agreeing = all(agree_within(*both, _AGREEMENT) for both in zip(batch(*given), mine, strict=True))
    return library if agreeing else None


def agree_within(expected: Array, given: Array, tolerance: float) -> bool:
    """Whether numbers differ by no more than a share of the largest, or of 1; exactly where one is not finite."""
    scale = max(1.0, float(np.nanmax(np.abs(expected), initial=0.0)))
    if not np.isfinite(scale):
        return np.array_equal(expected, given, equal_nan=True)
    return np.allclose(expected, given, rtol=0.0, atol=tolerance * scale, equal_nan=True)


def _evaluate(function: Any, inputs: Sequence[Array], outputs: Sequence[Array], count: int) -> None:
    pointers, strides = zip(*[(a.ctypes.data, a.strides[0] // 8) for a in inputs], strict=True)
    targets, steps = zip(*[(a.ctypes.data, a.strides[0] // 8) for a in outputs], strict=True)
    place, stride = ctypes.c_void_p * len(pointers), ctypes.c_long * len(strides)
    onto, step = ctypes.c_void_p * len(targets), ctypes.c_long * len(steps)
    function(ctypes.c_long(count), place(*pointers), stride(*strides), onto(*targets), step(*steps))


def _rows(array: Array) -> Array:
    """As it is if each channel lies in one piece, a copy otherwise."""
    return array if array.dtype == np.float64 and array.strides[-1] == 8 else np.array(array, dtype=float, order="C")
