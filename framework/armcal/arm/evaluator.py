"""Where springs come to rest: the one evaluator of expressions in elastic equilibrium.

An elastic pass F leads from a deflection d to the one that springs answer with; in equilibrium d = F(d). Its value is
iterated, from wherever the caller has it already: passes while these lead to rest, Newton's method where they do not.
Its derivatives follow from one pass, by the implicit function theorem [Griewank2008].

With the compliance C and the loads g, F = C g(d), and the Hessian of the potential energy is C^-1 (I - S), S = dF/dd:
the springs hold the arm where every eigenvalue of I - S is positive, and where one is negative the load grows faster
than its spring answers [Thompson1973]. Repeated passes lead to an equilibrium only where all eigenvalues of S are
smaller than one, so what they find is held, unless they start exactly where the load is balanced.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np

from armcal.base import se3
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.se3 import Expression
from armcal.errors import NotConvergedError
from armcal.functions.batch_function import InterpretedFunction

REST_RAD = 1e-13  # A residual is taken when no deflection moves more than this in a pass: below 1e-6 mm on any arm
NEAR_REST_RAD = 1e-10  # The linearisation corrects to second order, so it may start from here
MOST_DEFLECTION = 1.0
"""rad, or m: a spring that gives more does not hold the arm, and more than one equilibrium may be near."""
LONGEST_STEP = 0.3  # rad, or m: of Newton's method
MOST_PASSES = 100
_SHIFTED_TO = 0.1  # Where the potential is not convex, its lowest eigenvalue is taken for this: the step goes down

Evaluate = Callable[[Indices], tuple[Array, Array]]  # F (n_d x k) and S (k x n_d x n_d) of some records at their states


def by_passes(following: Callable[[], Array], state: Array, rest: float = REST_RAD) -> Mask:
    """Replace states (n_d x N) by what ``following`` gives until none moves more than ``rest``; which still do (N)."""
    for _ in range(MOST_PASSES):
        after = following()
        moved = np.abs(after - state)
        state[:] = after
        if moved.max(initial=0.0) <= rest:
            break
    return np.asarray(~(moved.max(axis=0, initial=0.0) <= rest))


def lowest(slopes: Array) -> Array:
    """The smallest real part of the eigenvalues of I - S (N), one without springs; S is (N x n_d x n_d).

    A bound by the sums of rows serves where it says enough: most arms need no eigenvalue.
    """
    low = np.asarray(1.0 - np.abs(slopes).sum(axis=2).max(axis=1, initial=0.0))
    unsure = ~(low > 0)
    if unsure.any():
        finite = unsure & np.isfinite(slopes).all(axis=(1, 2))
        low[unsure] = -np.inf
        low[finite] = 1.0 - np.linalg.eigvals(slopes[finite]).real.max(axis=1)
    return low


def settle(evaluate: Evaluate, state: Array) -> Mask:
    """Bring states (n_d x N) to equilibria that the springs hold, in place, and say of which this came true (N).

    Newton's method where I - S is positive. Elsewhere its lowest eigenvalue is shifted above zero, so that a step leads
    down the potential energy and away from equilibria that are not held [Nocedal2006], as an arm that is let go would.
    """
    count = state.shape[1]
    lengths, held = np.full(count, np.inf), np.zeros(count, dtype=bool)
    moving = np.arange(count)
    for _ in range(MOST_PASSES):
        following, slopes = evaluate(moving)
        sound = np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(following).all(axis=0)
        moving, left, slopes = moving[sound], (following - state[:, moving])[:, sound], slopes[sound]
        if not len(moving):
            break
        low = lowest(slopes)
        shift = np.where(low > 0, 0.0, _SHIFTED_TO - low)
        matrix = (1 + shift)[:, None, None] * np.eye(len(state)) - slopes
        step = np.linalg.solve(matrix, left.T[:, :, None])[:, :, 0].T
        length = np.abs(step).max(axis=0, initial=0.0)
        state[:, moving] += step * np.minimum(1.0, LONGEST_STEP / np.maximum(length, LONGEST_STEP))
        lengths[moving], held[moving] = length, low > 0
        moving = moving[
            (length >= REST_RAD) & (np.abs(state[:, moving]).max(axis=0, initial=0.0) <= 2 * MOST_DEFLECTION)
        ]
        if not len(moving):
            break
    at_rest = (lengths < NEAR_REST_RAD) & (np.abs(state).max(axis=0, initial=0.0) <= MOST_DEFLECTION)
    return np.asarray(at_rest & held)


ManyRecords = Callable[..., list[Array]]  # A CasADi function over columns: ``InterpretedFunction`` or ``BatchFunction``
_TOGETHER = 4096  # Records whose slopes are in memory at once


@dataclass(frozen=True, kw_only=True)
class ElasticPass:
    """One elastic pass of a record, as an expression."""

    record: Expression  # symbols of what differs from record to record (n_c)
    state: Expression  # symbols of the deflections of all springs (n_d; rad or m)
    next_state: Expression  # what the springs answer with; equal to ``state`` in equilibrium
    values: Expression = field(default_factory=lambda: ca.SX(0, 1))  # symbols of what all records share (n_v)
    springs: tuple[str, ...] = ()  # of each number of the state, what gives, in words

    def described(self, index: int, record: Array) -> str:
        """What messages call a record (n_c) at a place among others."""
        return f"record {index + 1}"

    def slope(self) -> Expression:
        """S = d next_state / d state (n_d x n_d)."""
        return ca.densify(ca.jacobian(self.next_state, self.state))

    def to_equilibrium(self, *right: Expression) -> list[Expression]:
        """(I - S)^-1 of each right hand side (n_d rows): how the equilibrium follows what moves ``next_state``."""
        if not self.state.numel():
            return list(right)
        solved = se3.solve_near_identity(self._one_minus_slope, ca.densify(ca.horzcat(*right)))
        widths = np.cumsum([0, *(side.size2() for side in right)])
        return [solved[:, int(a) : int(b)] for a, b in pairwise(widths)]

    def adjoint(self, rows: Expression) -> Expression:
        """Rows (n_d columns) times (I - S)^-1, for derivatives by many numbers at once."""
        return se3.solve_near_identity(self._one_minus_slope.T, ca.densify(rows).T).T

    @property
    def _one_minus_slope(self) -> Expression:
        return ca.SX.eye(self.state.numel()) - self.slope()


class Evaluator:
    """Outputs of records whose springs are in equilibrium.

    Everywhere ``values`` (n_v) are shared by all records (n_c x N); ``state`` (n_d x N) is where the search for the
    equilibrium starts, and is left there.
    """

    def __init__(
        self, elastic: ElasticPass, outputs: Expression, many: Callable[[ca.Function], ManyRecords] | None = None
    ) -> None:
        """``many`` makes functions of many records (compiled, where there are no shared values).

        Without it they are made for few calls, so that common subexpressions of the slope are not searched for: that
        takes 20 times as long as all else about it, holds Python's lock (GIL), and saves a sixth of an evaluation.
        """
        self._elastic = elastic
        self._shared = [elastic.values] if elastic.values.numel() else []
        self._many = many or (lambda function: InterpretedFunction(function, len(self._shared)))
        self._slope_cse = many is not None
        self._outputs = outputs

    def __call__(self, values: Array, record: Array, state: Array) -> Array:
        """Outputs (n_o x N) in equilibrium; where springs hold none, an error that leaves all states as they were."""
        before = state.copy()
        outputs, sound = self.settle(values, record, state)
        self._require(sound, values, record, state, before)
        return outputs

    def settle(self, values: Array, record: Array, state: Array, rest: float = REST_RAD) -> tuple[Array, Mask]:
        """The same, and which records have an equilibrium that their springs hold (N), instead of an error.

        Passes end where no deflection moves more than ``rest``.
        """
        before, outputs = state.copy(), np.empty((self._outputs.numel(), record.shape[1]))

        def following() -> Array:
            following_state, outputs[:] = self._pass(*self._inputs(values, record, state))
            return following_state

        by_passes(following, state, rest)
        passed = state.copy()
        sound = self._hold(values, record, state, before)
        if (state != passed).any():
            following()
        return outputs, sound

    def recover(self, values: Array, record: Array, state: Array, before: Array) -> None:
        """Bring records, to which passes from ``before`` led, to equilibria that the springs hold, as in a call."""
        self._require(self._hold(values, record, state, before), values, record, state, before)

    def require_held(self, values: Array, record: Array, state: Array) -> None:
        """Refuse states in equilibrium that springs do not hold, such as a load balanced upright on a soft joint."""
        if len(state):
            held = lowest(self._slopes(values, record, state)(np.arange(state.shape[1]))[1]) > 0
            self._require(held, values, record, state, np.zeros_like(state))

    def _hold(self, values: Array, record: Array, state: Array, before: Array) -> Mask:
        """Which records (N) have come to rest where springs hold them, by Newton's method where passes did not.

        Records that are at rest stay there; others start anew from ``before``, or from no deflection if that is much.
        """
        sound = np.ones(state.shape[1], dtype=bool)
        for start in range(0, state.shape[1] if len(state) else 0, _TOGETHER):
            part = slice(start, start + _TOGETHER)
            here, own = state[:, part], record[:, part]
            far = ~(np.abs(here).max(axis=0) <= MOST_DEFLECTION)
            here[:, far] = 0.0
            following, slopes = self._slopes(values, own, here)(np.arange(here.shape[1]))
            at_rest = (np.abs(following - here).max(axis=0) < NEAR_REST_RAD) & (lowest(slopes) > 0) & ~far
            if not at_rest.all():
                moving = np.flatnonzero(~at_rest)
                begun = before[:, part][:, moving]
                begun[:, ~(np.abs(begun).max(axis=0) <= MOST_DEFLECTION)] = 0.0
                at_rest[moving] = settle(self._slopes(values, own[:, moving], begun), begun)
                here[:, moving] = begun
            sound[part] = at_rest
        return sound

    def _require(self, sound: Mask, values: Array, record: Array, state: Array, before: Array) -> None:
        if sound.all():
            return
        bad = int(np.argmin(sound))
        own, at = record[:, [bad]], state[:, [bad]]
        following, slopes = self._slopes(values, own, at)(np.arange(1))
        far = not (np.abs(following - at).max() < NEAR_REST_RAD and np.abs(at).max() <= MOST_DEFLECTION)
        state[:] = before
        which, springs, slope = self._elastic.described(bad, own[:, 0]), self._elastic.springs, slopes[0]
        hint = "Correct that law."
        if np.isnan(slope).any():
            names = [name for name, row in zip(springs, slope, strict=True) if np.isnan(row).any()]
            text = f"is no number (NaN): the law of the spring of {' or '.join(names)} gives none under its load."
        else:
            if far:
                name = springs[int(np.argmax(np.abs(at[:, 0])))]
                text = f"did not settle: {name} would give by more than {MOST_DEFLECTION:g} rad (or m) under its load."
            else:
                eigenvalues, vectors = np.linalg.eig(slope)
                name = springs[int(np.argmax(np.abs(vectors[:, np.argmax(eigenvalues.real)])))]
                text = f"is not stable: the load on {name} grows faster than its spring answers: the arm would fall."
            hint = (
                f"Bound the compliance of {name}, check masses, units and gravity, or take another pose or less load."
            )
        raise NotConvergedError(f"the elastic equilibrium of {which} {text}", hint=hint)

    def _slopes(self, values: Array, record: Array, state: Array) -> Evaluate:
        size = len(state)

        def evaluate(places: Indices) -> tuple[Array, Array]:
            following, slopes = self._slope(*self._inputs(values, record[:, places], state[:, places]))
            return following, slopes.reshape(size, size, -1).transpose(2, 1, 0)

        return evaluate

    def _inputs(self, values: Array, record: Array, state: Array) -> Sequence[Array]:
        return (values, record, state) if self._shared else (record, state)

    @cached_property
    def _pass(self) -> ManyRecords:
        return self._function("elastic_pass", self._outputs, True)

    @cached_property
    def _slope(self) -> ManyRecords:
        return self._function("elastic_slope", self._elastic.slope(), self._slope_cse)

    def _function(self, name: str, outputs: Expression, cse: bool) -> ManyRecords:
        """(shared values, record, state) -> (next state, outputs column by column)."""
        inputs = [*self._shared, self._elastic.record, self._elastic.state]
        shown = [ca.densify(self._elastic.next_state), ca.densify(ca.vec(outputs))]
        return self._many(ca.Function(name, inputs, shown, {"cse": cse}))
