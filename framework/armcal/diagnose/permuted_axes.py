"""Whether measured positions fit the model far better with axes or joints exchanged or reversed, or in other units.

Single exchanges and sign changes are tried first; where none explains the data, the base elsewhere, then several at
once. Each reading of the data is given the same chance: what is left of its residuals once all free parameters have
adapted to first order. A right reading leaves little, a wrong one cannot be mended by any parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.diagnose.gross import thinned
from armcal.errors import NotConvergedError
from armcal.measure.partners import OTHER
from armcal.problem.factor_records import subset
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.tool_motion import rigid_fit, spread_of

Wires = Mapping[str, tuple[str, float]]
"""Channels, each read as another one times a factor."""
_DEGREES = 180 / np.pi
_MOST_SIGNS = 8

MUCH_BETTER = 3.0
"""A permutation leaves so many times less than the data as they stand."""
FITS, MISSES = 0.1, 0.03
"""Of the spread of the positions: what a right reading leaves at most, what is worth a look."""
_MOST_RECORDS = 300
_EQUATIONS = 2.0
"""So many numbers a parameter are needed to separate readings."""
_ALIKE = 1.5
_TURNED = 0.05
_SMALLEST, _SAME_M = 1e-9, 1e-6
_FAR, _HALVINGS = 3.0, 60
_AXES = "xyz"
_LENGTHS = (10.0, 0.1)
"""What a length is off by that was read in cm for mm; what is off by more shows in how far the arm reaches."""
_AXIS_LENGTHS = (*_LENGTHS, 1000.0, 0.001)
_SEVERAL_RECORDS, _MOST_NAMED = 100, 3
_MM = 1000.0


def single_joints(arm: Arm) -> list[tuple[str, Wires]]:
    """Each joint's sign, each two joints of a kind exchanged, and all angles in another unit."""
    joints = tuple(arm.commanded)
    angles = {joint: joint for joint, dimension in arm.commanded.items() if dimension == "angle"}
    readings: list[tuple[str, Wires]] = [
        (f"the sign of {joint} reversed", _wires(arm, {joint: joint}, -1.0)) for joint in joints
    ]
    for one, other in combinations(joints, 2):
        if arm.commanded[one] == arm.commanded[other]:
            readings.append((f"{one} and {other} exchanged", _wires(arm, {one: other, other: one}, 1.0)))
    for factor in (_DEGREES, 1 / _DEGREES):
        readings.append((f"joint angles {factor:.3g} times as large", _wires(arm, angles, factor)))
    return readings


def several_joints(arm: Arm) -> Iterator[tuple[str, Wires]]:
    """The signs of several joints, and joints in reverse order or shifted."""
    joints = tuple(arm.commanded)
    for size in range(2, len(joints) + 1) if len(joints) <= _MOST_SIGNS else ():
        for chosen in combinations(joints, size):
            words = f"the signs of {', '.join(chosen[:-1])} and {chosen[-1]} reversed"
            yield words, _wires(arm, {joint: joint for joint in chosen}, -1.0)
    if len(set(arm.commanded.values())) == 1:
        orders = [joints[::-1], *(joints[step:] + joints[:step] for step in range(1, len(joints)))]
        for order in orders if len(joints) > 2 else ():
            yield (
                f"({', '.join(order)}) taken for ({', '.join(joints)})",
                _wires(arm, dict(zip(joints, order, strict=True)), 1.0),
            )


def axes_words(order: Sequence[int], signs: Sequence[float]) -> str:
    """Axes in this order, with these signs."""
    moved = [i for i in range(3) if order[i] != i]
    negative = [_AXES[order[i]] for i in range(3) if signs[i] < 0]
    if len(moved) == 2 and not negative:
        return f"{_AXES[moved[0]]} and {_AXES[moved[1]]} exchanged"
    if not moved:
        return f"the sign{'s' * (len(negative) > 1)} of {' and '.join(negative)} reversed"
    taken = (f"{'-' if sign < 0 else ''}{_AXES[axis]}" for axis, sign in zip(order, signs, strict=True))
    return f"({', '.join(taken)}) taken for (x, y, z)"


def _wires(arm: Arm, joints: Mapping[str, str], factor: float) -> dict[str, tuple[str, float]]:
    """Commands and approaches of some joints read as those of others, times a factor; of approaches, times its sign."""
    return {
        f"{arm.name}.{part}{joint}": (f"{arm.name}.{part}{other}", scale)
        for joint, other in joints.items()
        for part, scale in (("", factor), ("approach.", float(np.sign(factor))))
    }


@dataclass(frozen=True)
class PermutedAxes:
    """A reading of the data that fits much better than the data as they stand.

    Attributes:
        measurement: whose positions.
        readings: those that fit about as well as the best one, in words.
        as_given_mm: what the data leave as they stand (root mean square, free parameters adapted).
        left_mm: what the best reading leaves.
        of_joints: whether it is joints that it reads otherwise; else axes.
    """

    measurement: str
    readings: tuple[str, ...]
    as_given_mm: float
    left_mm: float
    of_joints: bool


@dataclass(frozen=True)
class _Reading:
    """What is left of one reading (m)."""

    left: float
    words: str
    of_joints: bool


@dataclass(frozen=True)
class _Seen:
    """Positions of one measurement: which kernel, its records, and what was measured (3 x N, m)."""

    kernel: int
    records: FactorRecords
    measured: Array

    def thinned(self, most: int) -> _Seen:
        """At most so many of the records, evenly."""
        chosen = thinned(np.arange(self.records.count), most)
        return _Seen(self.kernel, subset([self.records], chosen)[0], self.measured[:, chosen])


@dataclass(frozen=True)
class _Positions:
    """Predicted positions (3 x N, m), and how the free parameters, in typical scales, move them: U S V' (3N x n)."""

    predicted: Array
    ways: Array
    sizes: Array

    def left(self, measured: Array, enough: float = np.inf) -> float:
        """Root mean square distance once the free parameters have adapted to first order, not too far (m).

        Where more than ``enough`` is left however far they adapt, that is given.
        """
        off = (measured - self.predicted).T.ravel()
        along, unit = self.ways.T @ off, 3 / max(1, len(off) - len(self.sizes))
        left = float(off @ off - along @ along)
        if unit * left <= enough**2:
            fitted = self.sizes * _within(along, self.sizes, _FAR * np.sqrt(len(self.sizes)))
            left += float((along - fitted) @ (along - fitted))
        return float(np.sqrt(unit * max(left, 0.0)))

    def can_move(self, turn: Array, shift: Array) -> bool:
        """Whether the free parameters move all positions as the beginning of a motion of the base would."""
        moved = (np.cross(Rotation.from_matrix(turn).as_rotvec(), self.predicted.T) + shift).ravel()
        along = self.ways.T @ moved
        return float(moved @ moved - along @ along) <= _TURNED**2 * float(moved @ moved)


def _within(along: Array, sizes: Array, radius: float) -> Array:
    """The steps (n) that come nearest to ``along`` times ``sizes``, no longer than a radius. [Nocedal2006]"""
    steps = along / sizes
    if np.linalg.norm(steps) <= radius:
        return np.asarray(steps)
    low, high = 0.0, float(np.linalg.norm(along * sizes)) / radius
    for _ in range(_HALVINGS):
        damping = (low + high) / 2
        steps = along * sizes / (sizes**2 + damping)
        low, high = (damping, high) if np.linalg.norm(steps) > radius else (low, damping)
    return np.asarray(steps)


def find_permuted_axes(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> PermutedAxes | None:
    """The first measurement whose positions, as they stand, do not fit, but do with one exchange undone.

    ``records`` are those of the dataset, their noise as declared.
    """
    for number, kernel in enumerate(problem.kernels):
        seen = _seen(problem, records, dataset, number)
        arms = problem.blueprint.measurements[kernel.factor.name].arms
        permuted_axes = None if seen is None or len(arms) != 1 else _of(problem, seen, problem.blueprint.arms[arms[0]])
        if permuted_axes is not None:
            return permuted_axes
    return None


def _seen(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, number: int) -> _Seen | None:
    """A measurement that gives positions in the base frame, at most so many records of it; None of another."""
    factor = problem.kernels[number].factor
    channels = factor.position_channels
    if not channels or factor.dimensions[:3] != ("length",) * 3 or not all(map(dataset.has, channels)):
        return None
    if any(OTHER in name for name in factor.channels):
        return None
    chosen = thinned(np.flatnonzero(records[number].measured), _MOST_RECORDS)
    if 3 * len(chosen) < _EQUATIONS * max(problem.increments, 6):
        return None
    own = replace(problem.subset(records, chosen)[number], whitening=None, correlation=None)
    measured = dataset.stacked(channels)[:, chosen]
    shown = problem.predict(problem.parameters.nominal(), problem.subset(records, chosen))[number][:3]
    residual = problem.residuals(problem.parameters.nominal(), problem.subset(records, chosen))[number][:3]
    return _Seen(number, own, measured) if np.allclose(residual, measured - shown, atol=_SAME_M) else None


def _of(problem: Problem, seen: _Seen, arm: Arm) -> PermutedAxes | None:
    straight = _positions(problem, seen, {})
    if straight is None:
        return None
    as_given = straight.left(seen.measured)
    spread = max(spread_of(seen.measured), spread_of(straight.predicted))
    if as_given <= MISSES * spread:
        return None
    enough = min(FITS * spread, as_given / MUCH_BETTER)
    readings = list(_single(problem, seen, arm, straight))
    if min(reading.left for reading in readings) > enough:
        turn, shift = rigid_fit(straight.predicted, seen.measured)
        angle = np.rad2deg(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec()))
        words = f"the arm's base elsewhere by {np.linalg.norm(shift) * _MM:.3g} mm and {angle:.2g} deg"
        elsewhere = _Reading(straight.left(turn.T @ (seen.measured - shift[:, None])), words, False)
        if elsewhere.left <= enough and straight.can_move(turn, shift):
            return None
        readings = [elsewhere] if elsewhere.left <= enough else list(_several(problem, seen, arm, enough))
    best = min(readings, key=lambda reading: reading.left, default=None)
    if best is None or best.left > enough:
        return None
    alike = [r for r in readings if r.left <= _ALIKE * best.left and r.of_joints == best.of_joints]
    likeliest = tuple(reading.words for reading in sorted(alike, key=lambda reading: reading.left)[:_MOST_NAMED])
    name = problem.kernels[seen.kernel].factor.name
    return PermutedAxes(name, likeliest, as_given * _MM, best.left * _MM, best.of_joints)


def _positions(problem: Problem, seen: _Seen, read_as: Wires) -> _Positions | None:
    """At the nominal values, channels read as others, times a factor; None where a record has no equilibrium."""
    kernel, own, parameters = problem.kernels[seen.kernel], seen.records, problem.parameters
    rewired, channels = own.record.copy(), kernel.factor.channels
    for channel, (other, factor) in read_as.items():
        if channel in channels and other in channels:
            rewired[channels.index(channel)] = factor * own.record[channels.index(other)]
    records = replace(own, record=rewired, state=np.zeros_like(own.state))
    try:
        blocks = list(problem.grouped[seen.kernel].linearised(parameters.nominal(), records))
    except NotConvergedError:
        return None
    noise = np.array(kernel.factor.noise[:3])[:, None]
    slopes, residual = (np.concatenate(parts, axis=-1)[:3, ..., : own.count] for parts in zip(*blocks, strict=True))
    rows = (slopes * noise[:, :, None]).transpose(2, 0, 1).reshape(3 * own.count, -1)
    rows = rows @ parameters.entries_jacobian(parameters.nominal()) * parameters.scales()
    basis, triangle = np.linalg.qr(rows)
    ways, sizes, _ = np.linalg.svd(triangle, full_matrices=False)
    kept = sizes > _SMALLEST * sizes.max(initial=0.0)
    return _Positions(seen.measured - residual * noise, basis @ ways[:, kept], sizes[kept])


def _of_axes(straight: _Positions, measured: Array) -> list[tuple[str, Array]]:
    """All exchanges and signs of axes, but turns that the free parameters make by themselves; and other units."""
    readings = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            proper = np.linalg.det(turn) > 0
            if not np.array_equal(turn, np.eye(3)) and not (proper and straight.can_move(turn, np.zeros(3))):
                readings.append((axes_words(order, signs), turn @ measured))
    readings += [(f"positions {factor:.3g} times as large", factor * measured) for factor in _LENGTHS]
    for axis, factor in product(range(3), _AXIS_LENGTHS):
        scaled = np.diag([factor if i == axis else 1.0 for i in range(3)]) @ measured
        readings.append((f"{_AXES[axis]} {factor:.3g} times as large", scaled))
    return readings


def _several(problem: Problem, seen: _Seen, arm: Arm, enough: float) -> Iterator[_Reading]:
    """Signs of several joints, joints in another order, and either or one joint's permutation beside one of axes."""
    seen = seen.thinned(_SEVERAL_RECORDS)
    straight = _positions(problem, seen, {})
    axes = [] if straight is None else _of_axes(straight, seen.measured)
    for words, read_as in [*single_joints(arm), *several_joints(arm)]:
        positions = _positions(problem, seen, read_as)
        if positions is not None:
            yield _Reading(positions.left(seen.measured, enough), words, True)
            yield from (_Reading(positions.left(moved, enough), f"{words} and {own}", True) for own, moved in axes)


def _single(problem: Problem, seen: _Seen, arm: Arm, straight: _Positions) -> Iterator[_Reading]:
    for words, measured in _of_axes(straight, seen.measured):
        yield _Reading(straight.left(measured), words, False)
    for words, read_as in single_joints(arm):
        positions = _positions(problem, seen, read_as)
        if positions is not None:
            yield _Reading(positions.left(seen.measured), words, True)
