"""Whether measured positions fit the model far better with axes or joints exchanged or reversed, or in other units.

Single changes are tried first; where none explains the data, the base elsewhere, then several at once. Each reading of
the data is given the same chance: where the base may stand anywhere, it and the target are found anew, and what counts
is what is left of its residuals once all free parameters have adapted to first order. A right reading leaves little, a
wrong one cannot be mended by any parameters.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.arm.assembly import Arm
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.units import digits
from armcal.diagnose.readings import (
    LEFT_HANDED,
    Wires,
    apart_in_groups,
    is_place,
    rewired,
    scaled_positions,
    several_joints,
    single_joints,
    turned_axes,
    two_frames,
)
from armcal.errors import NotConvergedError
from armcal.estimate.placing import Placing, placings
from armcal.problem.factor_records import subset
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.rigid_alignment import nearest
from armcal.problem.sighting import Sighting, sighting_of, tools_of
from armcal.problem.tool_motion import rigid_fit, spread_of, tools

MUCH_BETTER = 3.0
"""A permutation leaves so many times less than the data as they stand."""
FITS, MISSES = 0.1, 0.01
"""Of the spread of the positions: what a right reading leaves at most, what is worth a look."""
_ROUGHLY_FITS, _FAR_BETTER = 0.15, 6.0
"""Where none does: what a single one leaves at most of a poor arm, and how many times less than the data as given."""
_MOST_RECORDS = 300
_EQUATIONS = 2.0
"""So many numbers a parameter are needed to separate readings."""
_ALIKE = 1.5
_TURNED = 0.05
_SMALLEST = 1e-9
_FAR, _HALVINGS = 3.0, 60
_ROUGHLY = 2.0
_SEVERAL_RECORDS, _MOST_NAMED = 100, 3
_MM = 1000.0


@dataclass(frozen=True)
class PermutedAxes:
    """A reading of the data that fits much better than the data as they stand.

    Attributes:
        measurement: whose positions.
        readings: those that fit about as well as the best one, in words.
        as_given_mm: what the data leave as they stand (root mean square, free parameters adapted).
        left_mm: what the best reading leaves.
        of_joints: whether it is joints that it reads otherwise; else axes.
        adapted: whether free parameters were; else the arm is the nominal one.
    """

    measurement: str
    readings: tuple[str, ...]
    as_given_mm: float
    left_mm: float
    of_joints: bool
    adapted: bool = True


@dataclass(frozen=True)
class _Reading:
    """What is left of one reading (m)."""

    left: float
    words: str
    of_joints: bool


@dataclass(frozen=True)
class _Seen:
    """Positions of one measurement.

    Attributes:
        sighting: what was measured.
        records: of its kernel alone, their noise as declared.
        rows: what was measured a row before and a row after, in words (3 x n each, m).
        placing: what places the arm; None where its base may not stand anywhere.
        ids: of the records (n).
    """

    sighting: Sighting
    records: FactorRecords
    rows: tuple[tuple[str, Array], ...]
    placing: Placing | None
    ids: tuple[str, ...] = ()

    @property
    def measured(self) -> Array:
        """Positions (3 x n, m)."""
        return self.sighting.measured

    def thinned(self, most: int) -> Self:
        """At most so many of the records, evenly."""
        every = np.arange(0, self.records.count, max(1, -(-self.records.count // most)))
        rows = tuple((words, positions[:, every]) for words, positions in self.rows)
        (records,) = subset([self.records], every)
        return replace(self, sighting=self.sighting.subset(every), records=records, rows=rows)


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
        return float(self.left_of_each(measured[None], enough)[0])

    def left_of_each(self, measured: Array, enough: float) -> Array:
        """The same of several readings (k x 3 x N) of what was measured (k)."""
        off = (measured - self.predicted).transpose(0, 2, 1).reshape(len(measured), -1)
        along, unit = off @ self.ways, 3 / max(1, off.shape[1] - len(self.sizes))
        left = np.sum(off**2, axis=1) - np.sum(along**2, axis=1)
        for i in np.flatnonzero(unit * left <= enough**2):
            fitted = self.sizes * _within(along[i], self.sizes, _FAR * np.sqrt(len(self.sizes)))
            left[i] += np.sum((along[i] - fitted) ** 2)
        return np.asarray(np.sqrt(unit * np.maximum(left, 0.0)))

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
        try:
            seen = _seen(problem, records, dataset, number)
            arms = [problem.blueprint.arms[name] for name in problem.blueprint.measurements[kernel.factor.name].arms]
            if seen is None:
                permuted = _of_contact(problem, records, number, arms)
            else:
                permuted = _of(problem, records, seen, arms[0])
        except NotConvergedError:
            continue
        if permuted is not None:
            return permuted
    return None


def _of_contact(
    problem: Problem, records: Sequence[FactorRecords], number: int, arms: Sequence[Arm]
) -> PermutedAxes | None:
    """Of a contact: how far apart single records put what they touch together, by the nominal arm, however read."""
    kernel, own, nominal = problem.kernels[number], records[number], problem.blueprint.parameters.nominal()
    if kernel.factor.output_channels or not is_place(kernel.factor.nuisance_names):
        return None

    def left(read_as: Wires) -> float:
        """A reading's."""
        try:
            return apart_in_groups(problem, number, rewired(kernel.factor.channels, own, read_as), nominal)
        except NotConvergedError:
            return np.inf

    reach, as_given = spread_of(tools(problem, nominal, records)[0][0]), left({})
    if not MISSES * reach < as_given < np.inf:
        return None
    # Another unit of angles would put all tools near one place, whatever they touch.
    readings = [
        _Reading(left(wires), words if len(arms) == 1 else f"{words} ({arm.name})", True)
        for arm in arms
        for words, wires in single_joints(arm)
        if all(abs(factor) == 1 for _, factor, _ in wires.values())
    ]
    best, *others = sorted(readings, key=lambda reading: reading.left)
    if best.left > min(FITS * reach, as_given / MUCH_BETTER):
        return None
    words = (best.words, *(other.words for other in others[: _MOST_NAMED - 1] if other.left <= _ALIKE * best.left))
    return PermutedAxes(kernel.factor.name, words, as_given * _MM, best.left * _MM, True, adapted=False)


def _seen(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, number: int) -> _Seen | None:
    """A measurement that gives positions in the base frame, at most so many records of it; None of another.

    Records without both neighbours are left out, unless these are most.
    """
    sighting = sighting_of(problem, records, dataset, number, _MOST_RECORDS)
    if sighting is None:
        return None
    every, rows = _neighbours(dataset, records[number], problem.kernels[number].factor.position_channels, sighting)
    sighting = sighting.subset(every)
    if 3 * len(sighting.chosen) < _EQUATIONS * max(problem.increments, 6):
        return None
    own = replace(problem.subset(records, sighting.chosen)[number], whitening=None, correlation=None)
    return _Seen(sighting, own, rows, None, tuple(dataset.ids[i] for i in sighting.chosen))


def _neighbours(
    dataset: Dataset, record: FactorRecords, channels: Sequence[str], sighting: Sighting
) -> tuple[Indices, tuple[tuple[str, Array], ...]]:
    """Which of the records to look at, and what was measured one row before and after each of these (3 x n each)."""
    lines = np.array(dataset.rows or range(len(dataset)))
    whole = np.flatnonzero(record.measured)
    place, positions = {line: i for i, line in zip(whole, lines[whole], strict=True)}, dataset.stacked(channels)
    beside = np.array([[place.get(lines[i] + step, -1) for i in sighting.chosen] for step in (-1, 1)])
    both = np.flatnonzero((beside >= 0).all(axis=0))
    if 2 * len(both) < len(sighting.chosen):
        return np.arange(len(sighting.chosen)), ()
    words = ("positions of the row before", "positions of the row after")
    rows = ((w, positions[:, of[both]]) for w, of in zip(words, beside, strict=True))
    return both, tuple((f"the {w} taken for each row's", moved) for w, moved in rows)


def _of(problem: Problem, records: Sequence[FactorRecords], seen: _Seen, arm: Arm) -> PermutedAxes | None:
    straight = _positions(problem, seen, {}, problem.parameters.nominal())
    if straight is None:
        return None
    spread = max(spread_of(seen.measured), spread_of(straight.predicted))
    as_given = straight.left(seen.measured)
    if as_given > MISSES * spread:
        placing = placings(problem, records, seen.sighting)[0]
        seen = replace(seen, placing=placing if placing.stands_anywhere else None)
        as_given = min(as_given, _left(problem, seen, {}, seen.measured, np.inf))
    if as_given <= MISSES * spread:
        return None
    enough = min(FITS * spread, as_given / MUCH_BETTER)
    readings = [*_single(problem, seen, arm, straight, enough), *_in_two_frames(problem, seen)]
    if min(reading.left for reading in readings) > enough:
        if seen.placing is None:
            turn, shift = rigid_fit(straight.predicted, seen.measured)
            angle = float(np.rad2deg(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec())))
            apart = f"{digits(float(np.linalg.norm(shift)) * _MM)} mm and {digits(angle, 2)} deg"
            words = f"the arm's base elsewhere by {apart}"
            left = straight.left(turn.T @ (seen.measured - shift[:, None]))
            if left <= enough and straight.can_move(turn, shift):
                return None  # the fit moves the base there by itself
            readings = [_Reading(left, words, False)] if left <= enough else []
        if seen.placing is not None or not readings:
            few = seen.thinned(_SEVERAL_RECORDS)
            if _left(problem, few, {}, few.measured, np.inf) <= MISSES * spread:
                return None  # as they stand, the records that are looked at fit: a few others are off
            readings = list(_several(problem, seen, arm, enough))
    if min((reading.left for reading in readings), default=np.inf) > enough:
        enough = min(_ROUGHLY_FITS * spread, as_given / _FAR_BETTER)
        readings = list(_single(problem, seen, arm, straight, enough, _ROUGHLY_FITS))
    best = min(readings, key=lambda reading: reading.left, default=None)
    if best is None or best.left > enough:
        return None
    alike = [r for r in readings if r.left <= _ALIKE * best.left and r.of_joints == best.of_joints]
    likeliest = tuple(reading.words for reading in sorted(alike, key=lambda reading: reading.left)[:_MOST_NAMED])
    name = problem.kernels[seen.sighting.kernel].factor.name
    return PermutedAxes(name, likeliest, as_given * _MM, best.left * _MM, best.of_joints)


def _positions(problem: Problem, seen: _Seen, read_as: Wires, values: Array) -> _Positions | None:
    """At these values, channels read as others, times a factor; None where a record has no equilibrium."""
    number, parameters = seen.sighting.kernel, problem.parameters
    records = rewired(problem.kernels[number].factor.channels, seen.records, read_as)
    try:
        blocks = list(problem.grouped[number].linearised(values, records))
    except NotConvergedError:
        return None
    noise, count = np.array(problem.kernels[number].factor.noise[:3])[:, None], records.count
    slopes, residual = (np.concatenate(parts, axis=-1)[:3, ..., :count] for parts in zip(*blocks, strict=True))
    rows = (slopes * noise[:, :, None]).transpose(2, 0, 1).reshape(3 * count, -1)
    rows = rows @ parameters.entries_jacobian(values) * parameters.scales()
    basis, triangle = np.linalg.qr(rows)
    ways, sizes, _ = np.linalg.svd(triangle, full_matrices=False)
    kept = sizes > _SMALLEST * sizes.max(initial=0.0)
    return _Positions(seen.measured - residual * noise, basis @ ways[:, kept], sizes[kept])


def _left(problem: Problem, seen: _Seen, read_as: Wires, measured: Array, enough: float) -> float:
    """What a reading leaves where base and target are found anew: roughly, if that is far more than enough (m)."""
    # As configured: where records that are mixed up put base and target says nothing of another reading of them.
    placing, number, nominal = seen.placing, seen.sighting.kernel, problem.blueprint.parameters.nominal()
    if placing is None:
        positions = _positions(problem, seen, read_as, nominal)
        return np.inf if positions is None else positions.left(measured, enough)
    as_read = rewired(problem.kernels[number].factor.channels, seen.records, read_as)
    alignment = nearest(tools_of(problem, nominal, as_read, number), measured, placing.basis)
    if alignment.left > _ROUGHLY * enough:
        return alignment.left
    values = placing.with_target(problem.parameters, nominal, alignment.offset)
    positions = _positions(problem, seen, read_as, values)
    return np.inf if positions is None else positions.left(alignment.back(measured), enough)


def _of_axes(seen: _Seen, straight: _Positions) -> Iterator[tuple[str, Array]]:
    """All exchanges and signs of axes, but turns that the fit makes by itself; other units; a row early or late."""
    if seen.placing is not None:
        yield LEFT_HANDED, np.diag([1.0, 1.0, -1.0]) @ seen.measured
    else:
        for words, turn in turned_axes():
            if np.linalg.det(turn) < 0 or not straight.can_move(turn, np.zeros(3)):
                yield words, turn @ seen.measured
    for words, scale in scaled_positions():
        yield words, scale @ seen.measured
    yield from seen.rows


def _single(
    problem: Problem, seen: _Seen, arm: Arm, straight: _Positions, enough: float = np.inf, fits: float = FITS
) -> Iterator[_Reading]:
    smaller = _Smaller(spread_of(straight.predicted), fits)
    for words, measured in _of_axes(seen, straight):
        left = straight.left(measured) if seen.placing is None else _left(problem, seen, {}, measured, enough)
        yield _Reading(smaller.left(left, spread_of(measured)), words, False)
    spread = spread_of(seen.measured)
    for words, read_as in single_joints(arm):
        left = _left(problem, seen, read_as, seen.measured, enough)
        yield _Reading(smaller.left(left, spread), words, True)


def _in_two_frames(problem: Problem, seen: _Seen) -> Iterator[_Reading]:
    """The records from one on in another frame, where base and target are found for each part by itself."""
    if seen.placing is None:
        return
    nominal = problem.blueprint.parameters.nominal()
    tools = tools_of(problem, nominal, seen.records, seen.sighting.kernel)
    apart = two_frames(tools, seen.measured, seen.placing.basis)
    if apart is not None:
        words = f"the positions from record {seen.ids[apart.begins]} on taken for those in another frame"
        yield _Reading(apart.left, f"{words} (something moved there: calibrate both parts by themselves)", False)


def _several(problem: Problem, seen: _Seen, arm: Arm, enough: float) -> Iterator[_Reading]:
    """Signs of several joints, joints in another order, and either or one joint's permutation beside one of axes."""
    seen = seen.thinned(_SEVERAL_RECORDS)
    straight = _positions(problem, seen, {}, problem.parameters.nominal())
    if straight is None:
        return
    axes = [("", seen.measured), *((f" and {own}", moved) for own, moved in _of_axes(seen, straight))]
    axes = axes if seen.placing is None else axes[:2]
    smaller, measured = _Smaller(spread_of(straight.predicted), FITS), np.array([moved for _, moved in axes])
    spreads = [spread_of(moved) for moved in measured]
    for words, read_as in [*single_joints(arm), *several_joints(arm)]:
        if seen.placing is not None:
            lefts = [_left(problem, seen, read_as, moved, enough) for moved in measured]
        else:
            positions = _positions(problem, seen, read_as, problem.parameters.nominal())
            lefts = [] if positions is None else positions.left_of_each(measured, enough).tolist()
        for left, spread, (own, _) in zip(lefts, spreads, axes, strict=False):
            yield _Reading(smaller.left(left, spread), f"{words}{own}", True)


@dataclass(frozen=True)
class _Smaller:
    """How far the arm's positions are spread (m): measured ones near one point are near those of any arm."""

    size: float
    fits: float

    def left(self, left: float, spread: float) -> float:
        """What a reading leaves, as many times more as its positions are spread less; infinite where it is no fit."""
        spread = max(spread, _SMALLEST)
        return np.inf if left > self.fits * spread else left * max(1.0, self.size / spread)
