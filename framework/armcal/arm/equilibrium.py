"""Elastic equilibria d = F(d) that springs hold, found by Newton's method; others are distinguished from them.

With the compliance C and the loads g, F = C g(d), and the Hessian of the potential energy is C^-1 (I - S), S = dF/dd:
the springs hold the arm where every eigenvalue of I - S is positive, and where one is negative the load grows faster
than its spring answers [Thompson1973]. Repeated passes lead to an equilibrium only where all eigenvalues of S are
smaller than one, so what they find is held, unless they start exactly where the load is balanced.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array, Indices, Mask
from armcal.errors import NotConvergedError

REST_RAD = 1e-13
"""A residual is taken when no deflection moves more than this in a pass: below 1e-6 mm on any arm."""
NEAR_REST_RAD = 1e-10
"""The linearisation corrects to second order, so it may start from here."""
MOST_DEFLECTION = 1.0
"""rad, or m: a spring that gives more does not hold the arm, and more than one equilibrium may be near."""
LONGEST_STEP = 0.3
"""rad, or m: of Newton's method."""
MOST_PASSES = 100
_SHIFTED_TO = 0.1
"""Where the potential is not convex, its lowest eigenvalue is taken for this: the step goes down."""

Evaluate = Callable[[Indices], tuple[Array, Array]]
"""F (n_d x k) and S (k x n_d x n_d) of some records at their states."""


@dataclass(frozen=True)
class Settled:
    """Where states came to rest.

    Attributes:
        at_rest: whether each did, within what springs may give (N).
        held: whether the springs hold the arm there (N).
    """

    at_rest: Mask
    held: Mask

    @property
    def sound(self) -> Mask:
        """Both (N)."""
        return self.at_rest & self.held


def by_passes(following: Callable[[], Array], state: Array, rest: float = REST_RAD) -> Mask:
    """Replace states (n_d x N), in place, by what ``following`` gives of them until none moves more than ``rest``.

    Returns:
        which still move (N).
    """
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


def refusal(which: str, springs: Sequence[str], state: Array, slope: Array, far: bool) -> NotConvergedError:
    """What to say of a record without an equilibrium that springs hold.

    Args:
        which: the record, and its pose.
        springs: of each number of the state, what gives.
        state: where the search ended (n_d).
        slope: S there (n_d x n_d).
        far: whether nothing came to rest within what springs may give; else the springs do not hold what did.
    """
    if np.isnan(slope).any():
        names = [name for name, row in zip(springs, slope, strict=True) if np.isnan(row).any()]
        text = f"is no number (NaN): the law of the spring of {' or '.join(names)} gives none under its load."
        return NotConvergedError(f"the elastic equilibrium of {which} {text}", hint="Correct that law.")
    if far:
        name = springs[int(np.argmax(np.abs(state)))]
        text = f"did not settle: {name} would give by more than {MOST_DEFLECTION:g} rad (or m) under its load."
    else:
        values, vectors = np.linalg.eig(slope)
        name = springs[int(np.argmax(np.abs(vectors[:, np.argmax(values.real)])))]
        text = f"is not stable: the load on {name} grows faster than its spring answers, so that the arm would fall."
    hint = f"Bound the compliance of {name}, check masses, units and gravity, or take another pose or a smaller load."
    return NotConvergedError(f"the elastic equilibrium of {which} {text}", hint=hint)


def settle(evaluate: Evaluate, state: Array) -> Settled:
    """Bring states (n_d x N) to equilibria that the springs hold, in place, and say of which this came true.

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
    return Settled(at_rest, held)
