"""Whether measured positions fit the model far better with axes or joints exchanged or reversed, or in other units.

Single changes are tried first; where none explains the data, the base elsewhere, then several at once. Each reading of
the data is given the same chance: where the base may stand anywhere, it and the target are found anew, and what counts
is what is left of its residuals once all free parameters have adapted to first order. The likeliest are then fitted: a
right reading leaves little, a wrong one cannot be mended by any parameters.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.arm.assembly import Arm
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.units import digits
from armcal.diagnose.readings import (
    LEFT_HANDED,
    Adapting,
    Wires,
    apart_in_groups,
    coupled_joints,
    is_place,
    kept_spread,
    rewired,
    scaled_positions,
    several_joints,
    single_joints,
    turned_axes,
    two_frames,
)
from armcal.errors import NotConvergedError
from armcal.estimate.polish import descended
from armcal.estimate.start import Placing, placings
from armcal.problem.problem import FactorRecords, PosedProblem, Problem
from armcal.problem.records import subset
from armcal.problem.rigid_alignment import (
    Sighting,
    Tools,
    nearest,
    rigid_fit,
    shown_instead,
    sighting_of,
    spread_of,
    tools,
    tools_of,
)

MUCH_BETTER = 3.0  # A permutation leaves so many times less than the data as they stand
FITS, MISSES = 0.15, 0.01
"""Of the spread of the positions: what a right reading leaves at most to first order, what is worth a look."""
_NOISE, _EXPLAINS = 3.0, (0.05, MUCH_BETTER)
"""What it leaves at most once fitted: times the noise; of the spread, and so many times less than the data as given."""
_HOPELESS, _EXPLAINS_HOPELESS = 0.1, (0.08, 1.8)
"""The same where no parameters mend what is given, of the spread: a model that lacks much may leave half of that."""
_FITTED, _FIT_STEPS, _FIT_DAMPING, _FARTHEST, _DETERMINED = 5, 25, 1e-3, 8.0, 1e-3
_MOST_RECORDS = 300
_EQUATIONS = 2.0  # So many numbers a parameter are needed to separate readings
_ALIKE = 1.5
_SMALLEST = 1e-9
_ROUGHLY = 2.0
_SEVERAL_RECORDS, _MOST_NAMED = 100, 3
_MM = 1000.0


@dataclass(frozen=True)
class PermutedAxes:
    """A reading of the data that fits much better than the data as they stand."""

    measurement: str  # whose positions
    readings: tuple[str, ...]  # those that fit about as well as the best one, in words
    as_given_mm: float  # what the data leave as they stand (root mean square, free parameters adapted)
    left_mm: float  # what the best reading leaves
    of_joints: bool  # whether it is joints that it reads otherwise; else axes
    adapted: bool = True  # whether free parameters were; else the arm is the nominal one


@dataclass(frozen=True)
class _Reading:
    """What is left of one reading (m), how channels and positions (3 x n) are read; None where nothing is fitted."""

    left: float
    words: str
    of_joints: bool
    read_as: Wires = field(default_factory=dict)
    measured: Array | None = None


@dataclass(frozen=True)
class _Seen:
    """Positions of one measurement."""

    sighting: Sighting  # what was measured
    records: FactorRecords  # of its kernel alone, their noise as declared
    rows: tuple[tuple[str, Array], ...]  # what was measured a row before and a row after, in words (3 x n each, m)
    placing: Placing | None  # what places the arm; None where its base may not stand anywhere
    noise: Array  # declared, of each axis (3, m)
    ids: tuple[str, ...] = ()  # of the records (n)

    @property
    def measured(self) -> Array:
        """Positions (3 x n, m)."""
        return self.sighting.measured

    def thinned(self, most: int) -> Self:
        every = np.arange(0, self.records.count, max(1, -(-self.records.count // most)))
        rows = tuple((words, positions[:, every]) for words, positions in self.rows)
        (records,) = subset([self.records], every)
        return replace(self, sighting=self.sighting.subset(every), records=records, rows=rows)


def find_permuted_axes(problem: Problem, dataset: Dataset) -> PermutedAxes | None:
    """The first measurement whose positions, as they stand, do not fit, but do with one exchange undone.

    The problem is of the dataset, its noise as declared.
    """
    for number, kernel in enumerate(problem.kernels):
        try:
            seen = _seen(problem, dataset, number)
            arms = [problem.blueprint.arms[name] for name in problem.blueprint.measurements[kernel.factor.name].arms]
            permuted = _of_contact(problem, number, arms) if seen is None else _of(problem, seen, arms[0])
        except NotConvergedError:
            continue
        if permuted is not None:
            return permuted
    return None


def _of_contact(problem: Problem, number: int, arms: Sequence[Arm]) -> PermutedAxes | None:
    """Of a contact: how far apart single records put what they touch together, by the nominal arm, however read."""
    kernel, own, nominal = problem.kernels[number], problem.records[number], problem.blueprint.parameters.nominal()
    if kernel.factor.output_channels or not is_place(kernel.factor.nuisance_names):
        return None

    def left(read_as: Wires) -> float:
        try:
            wired = rewired(kernel.factor.channels, own, read_as)
            return apart_in_groups(problem.with_record(number, wired), number, nominal)
        except NotConvergedError:
            return np.inf

    reach = spread_of(tools(problem, nominal)[0][0])
    if not MISSES * reach < (as_given := left({})) < np.inf:
        return None
    # Another unit of angles would put all tools near one place, whatever they touch.
    readings = [
        _Reading(left(wires), words if len(arms) == 1 else f"{words} ({arm.name})", True)
        for arm in arms
        for words, wires in [*single_joints(arm), *coupled_joints(arm)]
        if all(abs(factor) == 1 for channels, _ in wires.values() for factor in channels.values())
    ]
    best, *others = sorted(readings, key=lambda reading: reading.left)
    if best.left > min(FITS * reach, as_given / MUCH_BETTER):
        return None
    words = (best.words, *(other.words for other in others[: _MOST_NAMED - 1] if other.left <= _ALIKE * best.left))
    return PermutedAxes(kernel.factor.name, words, as_given * _MM, best.left * _MM, True, adapted=False)


def _seen(problem: Problem, dataset: Dataset, number: int) -> _Seen | None:
    """A measurement that gives positions in the base frame, at most so many records of it; None of another.

    Records without both neighbours are left out, unless these are most.
    """
    sighting = sighting_of(problem, dataset, number, _MOST_RECORDS)
    if sighting is None:
        return None
    every, rows = _neighbours(problem, dataset, sighting)
    sighting = sighting.subset(every)
    if 3 * len(sighting.chosen) < _EQUATIONS * max(problem.increments, 6):
        return None
    own = replace(problem.subset(sighting.chosen).records[number], whitening=None, correlation=None)
    noise = np.array(problem.kernels[number].factor.noise[:3])
    return _Seen(sighting, own, rows, None, noise, tuple(dataset.ids[i] for i in sighting.chosen))


def _neighbours(
    problem: Problem, dataset: Dataset, sighting: Sighting
) -> tuple[Indices, tuple[tuple[str, Array], ...]]:
    """Which of the records to look at, and what was measured one row before and after each of these (3 x n each)."""
    channels = problem.kernels[sighting.kernel].factor.position_channels
    lines = np.array(dataset.rows or range(len(dataset)))
    whole = np.flatnonzero(problem.records[sighting.kernel].measured)
    place, positions = {line: i for i, line in zip(whole, lines[whole], strict=True)}, dataset.stacked(channels)
    beside = np.array([[place.get(lines[i] + step, -1) for i in sighting.chosen] for step in (-1, 1)])
    both = np.flatnonzero((beside >= 0).all(axis=0))
    if 2 * len(both) < len(sighting.chosen):
        return np.arange(len(sighting.chosen)), ()
    words = ("positions of the row before", "positions of the row after")
    rows = ((w, positions[:, of[both]]) for w, of in zip(words, beside, strict=True))
    return both, tuple((f"the {w} taken for each row's", moved) for w, moved in rows)


def _of(problem: Problem, seen: _Seen, arm: Arm) -> PermutedAxes | None:
    straight = _positions(problem, seen, {}, problem.parameters.nominal())
    if straight is None:
        return None
    spread = max(spread_of(seen.measured), spread_of(straight.predicted))
    as_given = straight.left(seen.measured)
    if as_given > MISSES * spread:
        placing = placings(problem, seen.sighting)[0]
        seen = replace(seen, placing=placing if placing.stands_anywhere else None)
        as_given = min(as_given, _left(problem, seen, {}, seen.measured, np.inf))
    if as_given <= MISSES * spread:
        return None
    enough = min(FITS * spread, as_given / MUCH_BETTER)
    readings = [*_single(problem, seen, arm, straight, enough), *_in_two_frames(problem, seen)]
    explained = _explained(problem, seen, readings, enough)
    if not explained:
        if seen.placing is None:
            turn, shift = rigid_fit(straight.predicted, seen.measured)
            angle = float(np.rad2deg(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec())))
            apart = f"{digits(float(np.linalg.norm(shift)) * _MM)} mm and {digits(angle, 2)} deg"
            words = f"the arm's base elsewhere by {apart}"
            left = straight.left(turn.T @ (seen.measured - shift[:, None]))
            read = _Reading(left, words, False, {}, turn.T @ (seen.measured - shift[:, None]))
            explained = _explained(problem, seen, [read], enough)
            if explained and straight.can_move(turn, shift):
                return None  # the fit moves the base there by itself
        if not explained:
            few = seen.thinned(_SEVERAL_RECORDS)
            if _left(problem, few, {}, few.measured, np.inf) <= MISSES * spread:
                return None  # as they stand, the records that are looked at fit: a few others are off
            explained = _explained(problem, few, list(_several(problem, few, arm, enough)), enough)
    if not explained:
        return None
    (best, left), name = explained[0], problem.kernels[seen.sighting.kernel].factor.name
    alike = [r.words for r, _ in explained if r.left <= _ALIKE * best.left and r.of_joints == best.of_joints]
    return PermutedAxes(name, tuple(alike[:_MOST_NAMED]), as_given * _MM, left * _MM, best.of_joints)


def _explained(
    problem: Problem, seen: _Seen, readings: Sequence[_Reading], enough: float
) -> list[tuple[_Reading, float]]:
    """Readings that explain the records once they are fitted, the likeliest first, and what each then leaves (m).

    Where a fit of the data as given comes nearly as near, none is needed.
    """
    likely = sorted((r for r in readings if r.left <= enough), key=lambda reading: reading.left)[:_FITTED]
    if not likely:
        return []
    noise, explained = float(np.linalg.norm(seen.noise)), []
    worse = _fitted(problem, seen, {}, seen.measured) / spread_of(seen.measured)
    for reading in likely:
        measured = reading.measured
        left = reading.left if measured is None else _fitted(problem, seen, reading.read_as, measured)
        spread = kept_spread(seen.measured if measured is None else measured, seen.measured)
        share, better = _EXPLAINS if worse <= _HOPELESS else _EXPLAINS_HOPELESS
        if left <= min(max(_NOISE * noise, share * spread), spread * worse / better):
            explained.append((reading, left))
    return explained


def _fitted(problem: Problem, seen: _Seen, read_as: Wires, measured: Array) -> float:
    """What a short fit of a reading typically leaves (median, m); infinite where it leads far from the nominal arm."""
    number = seen.sighting.kernel
    values, measured, _ = _placed(problem, seen, read_as, measured)
    some = [*problem.subset(seen.sighting.chosen).records]
    some = [replace(one, weight=0 * one.weight, whitening=None, correlation=None) for one in some]
    own = rewired(problem.kernels[number].factor.channels, seen.records, read_as)
    rows, unturned = np.zeros(len(problem.kernels[number].factor.noise)), np.tile(np.eye(3), (own.count, 1, 1))
    rows[:3] = 1 / seen.noise
    whitening = np.tile(np.diag(rows)[:, :, None], len(own.weight))
    some[number] = replace(own, whitening=whitening)
    problem = shown_instead(problem.with_records(some), number, Tools(measured, unturned))
    posed = PosedProblem(problem)
    try:
        if problem.increments:
            matters = np.diag(posed.model(posed.x(values)).hessian)
            x = descended(posed, posed.x(values), _FIT_STEPS, _FIT_DAMPING, 1e-3)
            if np.abs(x - posed.x(values))[matters > _DETERMINED * matters.max()].max(initial=0.0) > _FARTHEST:
                return np.inf
            values = posed.values(x)
        return float(np.median(np.linalg.norm(problem.residuals(values)[number][:3], axis=0)))
    except NotConvergedError:
        return np.inf


def _positions(problem: Problem, seen: _Seen, read_as: Wires, values: Array) -> Adapting | None:
    """At these values, channels read as others, times a factor; None where a record has no equilibrium."""
    number, parameters = seen.sighting.kernel, problem.parameters
    records = rewired(problem.kernels[number].factor.channels, seen.records, read_as)
    try:
        blocks = list(problem.grouped[number].linearised(values, records))
    except NotConvergedError:
        return None
    noise, count = seen.noise[:, None], records.count
    slopes, residual = (np.concatenate(parts, axis=-1)[:3, ..., :count] for parts in zip(*blocks, strict=True))
    rows = (slopes * noise[:, :, None]).transpose(2, 0, 1).reshape(3 * count, -1)
    rows = rows @ parameters.entries_jacobian(values) * parameters.scales()
    basis, triangle = np.linalg.qr(rows)
    ways, sizes, _ = np.linalg.svd(triangle, full_matrices=False)
    kept = sizes > _SMALLEST * sizes.max(initial=0.0)
    return Adapting(seen.measured - residual * noise, basis @ ways[:, kept], sizes[kept])


def _placed(problem: Problem, seen: _Seen, read_as: Wires, measured: Array) -> tuple[Array, Array, float]:
    """Values and positions in the base frame (3 x n) of a reading, base and target found anew, and what is left (m)."""
    # As configured: where records that are mixed up put base and target says nothing of another reading of them.
    placing, number, nominal = seen.placing, seen.sighting.kernel, problem.blueprint.parameters.nominal()
    if placing is None:
        return nominal, measured, 0.0
    as_read = rewired(problem.kernels[number].factor.channels, seen.records, read_as)
    alignment = nearest(tools_of(problem.with_record(number, as_read), nominal, number), measured, placing.basis)
    values = placing.with_target(problem.parameters, nominal, alignment.offset)
    return values, alignment.back(measured), alignment.left


def _left(problem: Problem, seen: _Seen, read_as: Wires, measured: Array, enough: float) -> float:
    """What a reading leaves where base and target are found anew: roughly, if that is far more than enough (m)."""
    values, measured, left = _placed(problem, seen, read_as, measured)
    if left > _ROUGHLY * enough:
        return left
    positions = _positions(problem, seen, read_as, values)
    return np.inf if positions is None else positions.left(measured, enough)


def _of_axes(seen: _Seen, straight: Adapting) -> Iterator[tuple[str, Array]]:
    if seen.placing is not None:
        yield LEFT_HANDED, np.diag([1.0, 1.0, -1.0]) @ seen.measured
    else:
        for words, turn in turned_axes():
            if np.linalg.det(turn) < 0 or not straight.can_move(turn, np.zeros(3)):
                yield words, turn @ seen.measured
    for words, scale in scaled_positions():
        yield words, scale @ seen.measured
    yield from seen.rows


def _single(problem: Problem, seen: _Seen, arm: Arm, straight: Adapting, enough: float = np.inf) -> Iterator[_Reading]:
    smaller = _Smaller(spread_of(straight.predicted))
    for words, measured in _of_axes(seen, straight):
        left = straight.left(measured) if seen.placing is None else _left(problem, seen, {}, measured, enough)
        yield _Reading(smaller.left(left, kept_spread(measured, seen.measured)), words, False, {}, measured)
    spread = spread_of(seen.measured)
    for words, read_as in [*single_joints(arm), *coupled_joints(arm)]:
        left = _left(problem, seen, read_as, seen.measured, enough)
        yield _Reading(smaller.left(left, spread), words, True, read_as, seen.measured)


def _in_two_frames(problem: Problem, seen: _Seen) -> Iterator[_Reading]:
    """The records from one on in another frame, where base and target are found for each part by itself."""
    if seen.placing is None:
        return
    nominal = problem.blueprint.parameters.nominal()
    number = seen.sighting.kernel
    tools = tools_of(problem.with_record(number, seen.records), nominal, number)
    apart = two_frames(tools, seen.measured, seen.placing.basis)
    if apart is not None:
        words = f"the positions from record {seen.ids[apart.begins]} on taken for those in another frame"
        yield _Reading(apart.left, f"{words} (something moved there: calibrate both parts by themselves)", False)


def _several(problem: Problem, seen: _Seen, arm: Arm, enough: float) -> Iterator[_Reading]:
    """Signs of several joints, joints in another order, and either or one joint's permutation beside one of axes."""
    straight = _positions(problem, seen, {}, problem.parameters.nominal())
    if straight is None:
        return
    axes = [("", seen.measured), *((f" and {own}", moved) for own, moved in _of_axes(seen, straight))]
    axes = axes if seen.placing is None else axes[:2]
    smaller, measured = _Smaller(spread_of(straight.predicted)), np.array([moved for _, moved in axes])
    spreads = [kept_spread(moved, seen.measured) for moved in measured]
    for words, read_as in [*single_joints(arm), *several_joints(arm)]:
        if seen.placing is not None:
            lefts = [_left(problem, seen, read_as, moved, enough) for moved in measured]
        else:
            positions = _positions(problem, seen, read_as, problem.parameters.nominal())
            lefts = [] if positions is None else positions.left_of_each(measured, enough).tolist()
        for left, spread, (own, moved) in zip(lefts, spreads, axes, strict=False):
            yield _Reading(smaller.left(left, spread), f"{words}{own}", True, read_as, moved)


@dataclass(frozen=True)
class _Smaller:
    """How far the arm's positions are spread (m): measured ones near one point are near those of any arm."""

    size: float

    def left(self, left: float, spread: float) -> float:
        """What a reading leaves, as many times more as its positions are spread less; infinite where it is no fit."""
        spread = max(spread, _SMALLEST)
        return np.inf if left > FITS * spread else left * max(1.0, self.size / spread)
