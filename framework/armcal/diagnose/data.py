"""Checks of data: what is mixed up, in another unit, too heavy, or stood still.

Do measured positions fit the model far better with axes or joints exchanged or reversed, or in other units? Single
changes are tried first; where none explains the data, the base elsewhere, then several at once. Each reading of the
data is given the same chance: where the base may stand anywhere, it and the target are found anew, and what counts is
what is left of its residuals once all free parameters have adapted to first order. The likeliest are then fitted: a
right reading leaves little, a wrong one fits by no parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations, product
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.arm.assembly import Arm, command_channels, shown_joint
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.units import digits, to_unit
from armcal.diagnose.checks import Finding, Grade, first_few
from armcal.diagnose.fit import Fit, Prepared, thinned
from armcal.errors import DataError, Location, NotConvergedError
from armcal.estimate.polish import descended
from armcal.estimate.start import Placing, placings
from armcal.measure.groups import first_of_pose
from armcal.problem import rigid_alignment as rigid
from armcal.problem.problem import FactorRecords, PosedProblem, Problem
from armcal.problem.records import subset
from armcal.problem.rigid_alignment import spread_of

Wires = Mapping[str, tuple[Mapping[str, float], float]]
"""Channels, each read as a sum of channels times factors, and a summand."""
_DEGREES, _TURN, _MRAD = 180 / np.pi, 360.0, 1000 * np.pi / 180
_ZEROS_DEG = (180, 90, -90)  # Of a joint's zero: half the counts of a servo, or where another convention has it
_MOST_SIGNS = 8
_AXES = "xyz"
_INCH = 25.4
_ROUNDED = 1e-6
_REACH_RATIO, _ONE_UNIT = 10.0, 3.0  # times as far, and as wide around their middle
_ALIKE = 0.35  # In powers of ten: so alike are two distances of one unit
_FEWEST_ROWS, _NEARLY_ALL, _NEAREST = 3, 0.95, 1e-6
_NEAR = 0.2  # Of their distance from the base: so near are positions to where the nominal arm has them
_TURNED = 0.05
_FAR, _HALVINGS = 3.0, 60
FEWEST_IN_PART = 8  # Records in a part: an alignment has nine numbers
_PARTS, _ROUNDS = (0.25, 0.5, 0.75), 3
_UNITS = {"millimetres": 0.001, "centimetres": 0.01, "metres": 1.0, "inches": _INCH / 1000}
LENGTHS = (10.0, 0.1, 1000.0, 0.001, _INCH, 1 / _INCH, 1000 / _INCH, _INCH / 1000)  # Of one of these read as another
_AXIS_LENGTHS = (10.0, 0.1, 1000.0, 0.001)
LEFT_HANDED = "a left-handed frame made right-handed (one axis reversed, or two exchanged)"


def single_joints(arm: Arm) -> list[tuple[str, Wires]]:
    joints = tuple(arm.commanded)
    angles = {joint: joint for joint, dimension in arm.commanded.items() if dimension == "angle"}
    readings = [(f"the sign of {joint} reversed", _wires(arm, {joint: joint}, -1.0)) for joint in joints]
    for one, other in combinations(joints, 2):
        if arm.commanded[one] == arm.commanded[other]:
            readings.append((f"{one} and {other} exchanged", _wires(arm, {one: other, other: one}, 1.0)))
    for factor in (_DEGREES, 1 / _DEGREES, _TURN, _MRAD, 1 / _MRAD):
        readings.append((f"joint angles {factor:.4g} times as large", _wires(arm, angles, factor)))
    for joint in joints:
        units = LENGTHS if joint not in angles else (_DEGREES,) if len(angles) > 1 else ()
        readings += [(f"{joint} {factor:.4g} times as large", _wires(arm, {joint: joint}, factor)) for factor in units]
    for joint, turn in product(angles, _ZEROS_DEG):
        readings.append((f"{turn} deg added to {joint}", _wires(arm, {joint: joint}, 1.0, np.radians(turn))))
    return readings


def coupled_joints(arm: Arm) -> Iterator[tuple[str, Wires]]:
    for joint, other in permutations(arm.commanded, 2):
        for sign in (1.0, -1.0) if arm.commanded[joint] == arm.commanded[other] else ():
            factor = arm.couplings.get(joint, {}).get(other, 0.0) + sign
            stated = f"state couplings: {{{joint}: {{{other}: {factor:g}}}}}" if factor else f"do not couple {joint}"
            words = f"{joint} {'+' if sign > 0 else '-'} {other} taken for {joint}"
            why = "(coupled joints, as the pendant of a Fanuc and the links of a palletiser have them: "
            channels = {f"{arm.name}.{joint}": 1.0, f"{arm.name}.{other}": sign}
            yield f"{words} {why}{stated})", {f"{arm.name}.{joint}": (channels, 0.0)}


def several_joints(arm: Arm) -> Iterator[tuple[str, Wires]]:
    joints = tuple(arm.commanded)
    for size in range(2, len(joints) + 1) if len(joints) <= _MOST_SIGNS else ():
        for chosen in combinations(joints, size):
            words = f"the signs of {', '.join(chosen[:-1])} and {chosen[-1]} reversed"
            yield words, _wires(arm, {joint: joint for joint in chosen}, -1.0)
    if len(set(arm.commanded.values())) == 1:
        orders = [joints[::-1], *(joints[step:] + joints[:step] for step in range(1, len(joints)))]
        for order in orders if len(joints) > 2 else ():
            words = f"({', '.join(order)}) taken for ({', '.join(joints)})"
            yield words, _wires(arm, dict(zip(joints, order, strict=True)), 1.0)


def _wires(arm: Arm, joints: Mapping[str, str], factor: float, added: float = 0.0) -> Wires:
    return {
        f"{arm.name}.{part}{joint}": ({f"{arm.name}.{part}{other}": scale}, summand)
        for joint, other in joints.items()
        for part, scale, summand in (("", factor, added), ("approach.", float(np.sign(factor)), 0.0))
    }


def turned_axes() -> Iterator[tuple[str, Array]]:
    """All exchanges and signs of axes but none (3 x 3), in words."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        moved, negative = [i for i in range(3) if order[i] != i], [_AXES[order[i]] for i in range(3) if signs[i] < 0]
        if not moved and not negative:
            continue
        taken = (f"{'-' if sign < 0 else ''}{_AXES[axis]}" for axis, sign in zip(order, signs, strict=True))
        words = f"({', '.join(taken)}) taken for (x, y, z)"
        if len(moved) == 2 and not negative:
            words = f"{_AXES[moved[0]]} and {_AXES[moved[1]]} exchanged"
        elif not moved:
            words = f"the sign{'s' * (len(negative) > 1)} of {' and '.join(negative)} reversed"
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        yield words, turn


def scaled_positions() -> Iterator[tuple[str, Array]]:
    """Positions, or one axis of them, in another unit (3 x 3), in words."""
    for factor in LENGTHS:
        yield f"positions {factor:.4g} times as large", factor * np.eye(3)
    for axis, factor in product(range(3), _AXIS_LENGTHS):
        scale = np.diag([factor if i == axis else 1.0 for i in range(3)])
        yield f"{_AXES[axis]} {factor:.4g} times as large", scale


def check_reach(problem: Problem, dataset: Dataset) -> None:
    """Positions ten times farther out, or nearer, than the model's: a unit is wrong, of all records or of some.

    Raises:
        DataError: which, and as which unit they are read.
    """
    shown = problem.predict(problem.parameters.nominal())
    for number, (kernel, own) in enumerate(zip(problem.kernels, shown, strict=True)):
        channels = kernel.factor.output_channels
        if [channel.rpartition(".")[2] for channel in channels] != ["x", "y", "z"]:
            continue
        name, measured, where = kernel.factor.name, dataset.stacked(channels), Location(dataset.source)
        factor, wrong = _in_another_unit(measured, own.outputs[:3])
        if wrong.any():
            first, count = int(np.argmax(wrong)), int(wrong.sum())
            which, more = f"the position of record {dataset.ids[first]} is", ""
            if count > 1:
                which, more = f"{count} of {len(dataset)} positions are", f" (the first: record {dataset.ids[first]})"
            units = ((a, b) for a, b in product(_UNITS, repeat=2) if np.isclose(_UNITS[b] / _UNITS[a], factor))
            raise DataError(
                f"{name}: {which} about {digits(factor)} times as far from the base frame as the model's tip, the "
                f"others as far{more}: {' among '.join(next(units))}?",
                where=replace(where, row=dataset.rows[first] if dataset.rows else None),
                hint="Write all rows in the unit of the column names.",
            )
        read = np.isfinite(measured).all(axis=0)
        both = own.outputs[:3, read], measured[:, read]
        far, distances = (float(np.median(np.linalg.norm(x, axis=0))) if read.any() else 0.0 for x in both)
        if far <= _REACH_RATIO * distances and distances <= _REACH_RATIO * far:
            continue
        text = f"{name}: positions are typically {distances:.4g} m from the base frame, the model's tip {far:.4g} m"
        hint = "Check the unit in the column names (x_mm or x_m) and the frame of the measurements."
        modelled, spread = (
            float(np.median(np.linalg.norm(x - np.median(x, axis=1, keepdims=True), axis=0))) for x in both
        )
        if modelled and 1 / _ONE_UNIT < spread / modelled < _ONE_UNIT:
            if _can_be_placed(problem, number):
                continue
            text = f"{text}; around their middle they spread alike, by {spread:.4g} and {modelled:.4g} m"
            hint = "The unit is right, the frame is another: free where the base stands in it, or state that."
        raise DataError(f"{text}.", where=where, hint=hint)


def _can_be_placed(problem: Problem, number: int) -> bool:
    """Whether free parameters move all positions of a factor alike, along each axis, to first order."""
    noise = np.array(problem.kernels[number].factor.noise[:3])
    slopes = problem.jacobians(problem.parameters.nominal())[number][:3] * noise[:, None, None]
    if not slopes.shape[1]:
        return False
    rows = slopes.transpose(2, 0, 1).reshape(-1, slopes.shape[1])
    shifts = np.tile(np.eye(3), (slopes.shape[2], 1))
    left = shifts - rows @ np.linalg.lstsq(rows, shifts, rcond=1e-9)[0]
    return bool((np.linalg.norm(left, axis=0) <= _TURNED * np.linalg.norm(shifts, axis=0)).all())


def _in_another_unit(measured: Array, shown: Array) -> tuple[float, Mask]:
    """Positions so many times as far out as the model's (3 x N each, m), where the others are as far; or none. Many are
    known by their distances alone, as where half of them spoil the place of the base; few are where the model has them
    once they are divided by that, and the others are typically where it has them."""
    far, distances, missed = (np.linalg.norm(x, axis=0) for x in (shown, measured, measured - shown))
    far = np.maximum(far, _NEAREST)
    orders = np.log10(np.where(distances > 0, distances, np.nan) / far)
    right = np.abs(orders) < _ALIKE
    # Near the origin any factor comes about by a little that the nominal arm is off.
    far_off = (missed > _NEAR * np.median(far)) & (np.nanmedian(missed / far) < _NEAR)
    best = np.inf, 1.0, np.zeros(len(far), dtype=bool)
    for factor in LENGTHS:
        off = np.abs(orders - np.log10(factor))
        wrong = off < _ALIKE
        if min(right.sum(), wrong.sum()) < _FEWEST_ROWS or np.mean(right | wrong) < _NEARLY_ALL:
            wrong = (np.linalg.norm(measured / factor - shown, axis=0) < _NEAR * far) & far_off
        if wrong.any():
            best = min(best, (float(np.median(off[wrong])), factor, wrong), key=lambda one: one[0])
    return best[1:]


def rewired(channels: Sequence[str], own: FactorRecords, read_as: Wires) -> FactorRecords:
    read = own.record.copy()
    for channel, (others, added) in read_as.items():
        if channel in channels and all(other in channels for other in others):
            parts = (factor * own.record[channels.index(other)] for other, factor in others.items())
            read[channels.index(channel)] = sum(parts, np.asarray(added))
    return replace(own, record=read, state=np.zeros_like(own.state))


def kept_spread(read: Array, measured: Array) -> float:
    """How far positions are spread as they are read (3 x N, m); as in their thinnest direction where that grew thinner:
    a reading that flattens what was measured hides anything in the direction in which it does."""
    own, given = (np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(p, bias=True)), 0.0)) for p in (read, measured))
    flattened = own[0] * np.linalg.norm(given) < (1 - _ROUNDED) * given[0] * np.linalg.norm(own)
    return float(np.sqrt(len(own)) * own[0] if flattened else np.linalg.norm(own))


@dataclass(frozen=True)
class Adapting:
    """Predicted positions, and how the free parameters, in typical scales, move them: U S V'."""

    predicted: Array  # (3 x N, m)
    paths: Array  # (3N x n)
    sizes: Array

    def left(self, measured: Array, enough: float = np.inf) -> Array:
        """Root mean square distance of several readings (k x 3 x N) once the free parameters have adapted (k, m), to
        first order, not too far. Where more than ``enough`` is left however far they adapt, that is given."""
        off = (measured - self.predicted).transpose(0, 2, 1).reshape(len(measured), -1)
        along, unit = off @ self.paths, 3 / max(1, off.shape[1] - len(self.sizes))
        left = np.sum(off**2, axis=1) - np.sum(along**2, axis=1)
        for i in np.flatnonzero(unit * left <= enough**2):
            fitted = self.sizes * within(along[i], self.sizes, _FAR * np.sqrt(len(self.sizes)))
            left[i] += np.sum((along[i] - fitted) ** 2)
        return np.asarray(np.sqrt(unit * np.maximum(left, 0.0)))

    def can_move(self, turn: Array, shift: Array) -> bool:
        moved = (np.cross(Rotation.from_matrix(turn).as_rotvec(), self.predicted.T) + shift).ravel()
        along = self.paths.T @ moved
        return float(moved @ moved - along @ along) <= _TURNED**2 * float(moved @ moved)


def within(along: Array, sizes: Array, radius: float) -> Array:
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


MUCH_BETTER = 3.0  # A permutation leaves so many times less than the data as they stand
FITS, MISSES = 0.15, 0.01  # Of the spread of positions: what a right reading leaves to first order, is worth a look
_NOISE, _EXPLAINS = 3.0, (0.05, MUCH_BETTER)
"""What it leaves at most once fitted: times the noise; of the spread, and so many times less than the data as given."""
_HOPELESS, _EXPLAINS_HOPELESS = 0.1, (0.08, 1.8)  # The same where what is given leaves more than this of the spread
_FITTED, _FIT_STEPS, _FIT_DAMPING, _FARTHEST, _DETERMINED = 5, 25, 1e-3, 8.0, 1e-3
_MOST_RECORDS = 300
_EQUATIONS = 2.0  # So many numbers a parameter are needed to separate readings
_AS_GOOD = 1.5
_SMALLEST = 1e-9
_ROUGHLY = 2.0
_SEVERAL_RECORDS, _MOST_NAMED = 100, 3
_MM = 1000.0


@dataclass(frozen=True)
class PermutedAxes:
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
    """A measurement that gives positions in the base frame, and what is left however it is read."""

    problem: Problem
    sighting: rigid.Sighting  # what was measured
    records: FactorRecords  # of its kernel alone, their noise as declared
    rows: tuple[tuple[str, Array], ...]  # what was measured a row before and a row after, in words (3 x n each, m)
    ids: tuple[str, ...]  # of the records (n)
    placing: Placing | None = None  # what places the arm; None where its base may not stand anywhere

    @classmethod
    def of(cls, problem: Problem, dataset: Dataset, number: int) -> Self | None:
        """Of at most so many records; those without both neighbours are left out, unless these are most."""
        sighting, rows = rigid.sighting_of(problem, dataset, number, _MOST_RECORDS), tuple[tuple[str, Array], ...]()
        if sighting is None:
            return None
        positions = dataset.stacked(problem.kernels[number].factor.position_channels)
        lines = np.array(dataset.rows or range(len(dataset)))
        whole = np.flatnonzero(problem.records[number].measured)
        place = {line: i for i, line in zip(whole, lines[whole], strict=True)}
        beside = np.array([[place.get(lines[i] + step, -1) for i in sighting.chosen] for step in (-1, 1)])
        both = np.flatnonzero((beside >= 0).all(axis=0))
        if 2 * len(both) >= len(sighting.chosen):
            sighting, words = sighting.subset(both), "the positions of the row {} taken for each row's"
            rows = tuple((words.format(w), positions[:, beside[i][both]]) for i, w in enumerate(("before", "after")))
        if 3 * len(sighting.chosen) < _EQUATIONS * max(problem.increments, 6):
            return None
        own = replace(problem.subset(sighting.chosen).records[number], whitening=None, correlation=None)
        return cls(problem, sighting, own, rows, tuple(dataset.ids[i] for i in sighting.chosen))

    @property
    def measured(self) -> Array:
        return self.sighting.measured

    @property
    def noise(self) -> Array:
        return np.array(self.problem.kernels[self.sighting.kernel].factor.noise[:3])

    def thinned(self, most: int) -> Self:
        every = np.arange(0, self.records.count, max(1, -(-self.records.count // most)))
        rows = tuple((words, positions[:, every]) for words, positions in self.rows)
        (records,) = subset([self.records], every)
        return replace(self, sighting=self.sighting.subset(every), records=records, rows=rows)

    def read(self, read_as: Wires) -> FactorRecords:
        return rewired(self.problem.kernels[self.sighting.kernel].factor.channels, self.records, read_as)

    def positions(self, read_as: Wires, values: Array) -> Adapting | None:
        """At these values, channels read as others, times a factor; None where a record has no equilibrium."""
        records, parameters = self.read(read_as), self.problem.parameters
        try:
            blocks = list(self.problem.grouped[self.sighting.kernel].linearised(values, records))
        except NotConvergedError:
            return None
        noise, count = self.noise[:, None], records.count
        slopes, residual = (np.concatenate(parts, axis=-1)[:3, ..., :count] for parts in zip(*blocks, strict=True))
        rows = (slopes * noise[:, :, None]).transpose(2, 0, 1).reshape(3 * count, -1)
        rows = rows @ parameters.entries_jacobian(values) * parameters.scales()
        basis, triangle = np.linalg.qr(rows)
        paths, sizes, _ = np.linalg.svd(triangle, full_matrices=False)
        kept = sizes > _SMALLEST * sizes.max(initial=0.0)
        return Adapting(self.measured - residual * noise, basis @ paths[:, kept], sizes[kept])

    def placed(self, read_as: Wires, measured: Array) -> tuple[Array, Array, float]:
        """Values and positions in the base frame (3 x n), base and target found anew, and what is left (m)."""
        # As configured: where records that are mixed up put base and target says nothing of another reading of them.
        placing, number, nominal = self.placing, self.sighting.kernel, self.problem.blueprint.parameters.nominal()
        if placing is None:
            return nominal, measured, 0.0
        tools = rigid.tools_of(self.problem.with_record(number, self.read(read_as)), nominal, number)
        alignment = rigid.nearest(tools, measured, placing.basis)
        values = placing.with_target(self.problem.parameters, nominal, alignment.offset)
        return values, alignment.back(measured), alignment.left

    def left(self, read_as: Wires, measured: Array, enough: float = np.inf) -> float:
        """What a reading leaves where base and target are found anew: roughly, if that is far more than enough (m)."""
        values, measured, left = self.placed(read_as, measured)
        if left > _ROUGHLY * enough:
            return left
        positions = self.positions(read_as, values)
        return np.inf if positions is None else float(positions.left(measured[None], enough)[0])

    def fitted(self, read_as: Wires, measured: Array) -> float:
        """What a short fit of a reading typically leaves (median, m); infinite if it leads far from the nominal arm."""
        number = self.sighting.kernel
        values, measured, _ = self.placed(read_as, measured)
        some = [*self.problem.subset(self.sighting.chosen).records]
        some = [replace(one, weight=0 * one.weight, whitening=None, correlation=None) for one in some]
        own, rows = self.read(read_as), np.zeros(len(self.problem.kernels[number].factor.noise))
        rows[:3] = 1 / self.noise
        some[number] = replace(own, whitening=np.tile(np.diag(rows)[:, :, None], len(own.weight)))
        shown = rigid.Tools(measured, np.tile(np.eye(3), (own.count, 1, 1)))
        problem = rigid.shown_instead(self.problem.with_records(some), number, shown)
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

    def axes(self, straight: Adapting) -> Iterator[tuple[str, Array]]:
        if self.placing is not None:
            yield LEFT_HANDED, np.diag([1.0, 1.0, -1.0]) @ self.measured
        else:
            for words, turn in turned_axes():
                if np.linalg.det(turn) < 0 or not straight.can_move(turn, np.zeros(3)):
                    yield words, turn @ self.measured
        for words, scale in scaled_positions():
            yield words, scale @ self.measured
        yield from self.rows

    def readings(
        self, wirings: Sequence[tuple[str, Wires]], axes: Sequence[tuple[str, Array]], straight: Adapting, enough: float
    ) -> Iterator[_Reading]:
        """Channels read otherwise, each beside each way of reading positions. What one leaves counts as many times more
        as its positions are spread less than the arm's: measured ones near one point are near those of any arm."""
        measured, size = np.array([moved for _, moved in axes]), spread_of(straight.predicted)
        spreads = [max(kept_spread(moved, self.measured), _SMALLEST) for moved in measured]
        for words, read_as in wirings:
            if self.placing is not None:
                lefts = [self.left(read_as, moved, enough) for moved in measured]
            else:
                adapting = self.positions(read_as, self.placed(read_as, self.measured)[0]) if read_as else straight
                lefts = [] if adapting is None else adapting.left(measured, enough).tolist()
            for left, spread, (own, moved) in zip(lefts, spreads, axes, strict=False):
                weighed = np.inf if left > FITS * spread else left * max(1.0, size / spread)
                yield _Reading(weighed, " and ".join(filter(None, (words, own))), bool(read_as), read_as, moved)

    def in_two_frames(self) -> Iterator[_Reading]:
        """The records from one on in another frame: each part is aligned by itself, from a few divisions on, and the
        division put where both alignments leave least, in turn."""
        every, measured, number = np.arange(len(self.sighting.chosen)), self.measured, self.sighting.kernel
        if self.placing is None or len(every) < 2 * FEWEST_IN_PART:
            return
        nominal, basis = self.problem.blueprint.parameters.nominal(), self.placing.basis
        tools, divisions = rigid.tools_of(self.problem.with_record(number, self.records), nominal, number), []
        for part in _PARTS:
            begins = round(part * len(every))
            for _ in range(_ROUNDS):
                begins = min(max(begins, FEWEST_IN_PART), len(every) - FEWEST_IN_PART)
                halves = [
                    rigid.nearest(tools.subset(own), measured[:, own], basis) for own in np.split(every, [begins])
                ]
                squares = [np.sum((measured - alignment.moved(tools)) ** 2, axis=0) for alignment in halves]
                before, after = (np.concatenate([[0.0], np.cumsum(square)]) for square in squares)
                left = before + after[-1] - after
                begins = int(np.argmin(left[FEWEST_IN_PART:-FEWEST_IN_PART])) + FEWEST_IN_PART
                divisions.append((float(np.sqrt(left[begins] / len(every))), begins))
        least, begins = min(divisions)
        words = f"the positions from record {self.ids[begins]} on taken for those in another frame"
        yield _Reading(least, f"{words} (something moved there: calibrate both parts by themselves)", False)

    def explained(self, readings: Sequence[_Reading], enough: float) -> list[tuple[_Reading, float]]:
        """Readings that explain the records once fitted, the likeliest first, and what each then leaves (m): none where
        a fit of the data as given comes nearly as near."""
        likely = sorted((r for r in readings if r.left <= enough), key=lambda reading: reading.left)[:_FITTED]
        if not likely:
            return []
        worse, explained = self.fitted({}, self.measured) / spread_of(self.measured), []
        for reading in likely:
            measured = reading.measured
            left = reading.left if measured is None else self.fitted(reading.read_as, measured)
            spread = kept_spread(self.measured if measured is None else measured, self.measured)
            share, better = _EXPLAINS if worse <= _HOPELESS else _EXPLAINS_HOPELESS
            if left <= min(max(_NOISE * float(np.linalg.norm(self.noise)), share * spread), spread * worse / better):
                explained.append((reading, left))
        return explained

    def permuted(self, arm: Arm) -> PermutedAxes | None:
        nominal = self.problem.parameters.nominal()
        straight, seen, single = self.positions({}, nominal), self, single_joints(arm)
        if straight is None:
            return None
        spread = max(spread_of(self.measured), spread_of(straight.predicted))
        as_given = float(straight.left(self.measured[None])[0])
        if as_given > MISSES * spread:
            placing = placings(self.problem, self.sighting)[0]
            seen = replace(self, placing=placing if placing.stands_anywhere else None)
            as_given = min(as_given, seen.left({}, self.measured))
        if as_given <= MISSES * spread:
            return None
        enough, joints = min(FITS * spread, as_given / MUCH_BETTER), [*single, *coupled_joints(arm)]
        readings = [*seen.readings([("", {})], [*seen.axes(straight)], straight, enough)]
        readings += [*seen.readings(joints, [("", self.measured)], straight, enough), *seen.in_two_frames()]
        explained = seen.explained(readings, enough)
        if not explained and seen.placing is None:
            turn, shift = rigid.rigid_fit(straight.predicted, self.measured)
            angle = float(np.rad2deg(np.linalg.norm(Rotation.from_matrix(turn).as_rotvec())))
            apart = f"{digits(float(np.linalg.norm(shift)) * _MM)} mm and {digits(angle, 2)} deg"
            moved = turn.T @ (self.measured - shift[:, None])
            left = float(straight.left(moved[None])[0])
            read = _Reading(left, f"the arm's base elsewhere by {apart}", False, {}, moved)
            explained = seen.explained([read], enough)
            if explained and straight.can_move(turn, shift):
                return None  # the fit moves the base there by itself
        if not explained:
            seen = seen.thinned(_SEVERAL_RECORDS)
            if seen.left({}, seen.measured) <= MISSES * spread:
                return None  # as they stand, the records that are looked at fit: a few others are off
            if (straight := seen.positions({}, nominal)) is None:
                return None
            axes = [("", seen.measured), *seen.axes(straight)]
            axes = axes if seen.placing is None else axes[:2]
            several = seen.readings([*single, *several_joints(arm)], axes, straight, enough)
            explained = seen.explained([*several], enough)
        if not explained:
            return None
        (best, left), name = explained[0], self.problem.kernels[self.sighting.kernel].factor.name
        alike = [r.words for r, _ in explained if r.left <= _AS_GOOD * best.left and r.of_joints == best.of_joints]
        return PermutedAxes(name, tuple(alike[:_MOST_NAMED]), as_given * _MM, left * _MM, best.of_joints)


def find_permuted_axes(problem: Problem, dataset: Dataset) -> PermutedAxes | None:
    """The first measurement whose positions, as they stand, do not fit, but do with one exchange undone; the problem is
    of the dataset, its noise as declared."""
    for number, kernel in enumerate(problem.kernels):
        try:
            seen = _Seen.of(problem, dataset, number)
            arms = [problem.blueprint.arms[name] for name in problem.blueprint.measurements[kernel.factor.name].arms]
            permuted = _of_contact(problem, number, arms) if seen is None else seen.permuted(arms[0])
        except NotConvergedError:
            continue
        if permuted is not None:
            return permuted
    return None


def _of_contact(problem: Problem, number: int, arms: Sequence[Arm]) -> PermutedAxes | None:
    """Of a contact: how far single records put what they touch from its middle, by the nominal arm, however read."""
    kernel, own, nominal = problem.kernels[number], problem.records[number], problem.blueprint.parameters.nominal()
    if kernel.factor.output_channels or tuple(name[-1:] for name in kernel.factor.nuisance_names[:3]) != tuple(_AXES):
        return None
    groups = np.zeros(own.count) if own.group is None else own.group[: own.count]
    members = [np.flatnonzero(groups == group) for group in np.unique(groups[groups >= 0])]

    def left(read_as: Wires) -> float:
        wired = problem.with_record(number, rewired(kernel.factor.channels, own, read_as))
        try:
            starts = wired.grouped[number].nuisance_starts(nominal, wired.records[number])
        except NotConvergedError:
            return np.inf
        parts = [starts[:3, chosen] for chosen in members]
        away = [np.linalg.norm(part - np.median(part, axis=1, keepdims=True), axis=0) for part in parts]
        return float(np.median(np.concatenate(away))) if away else np.inf

    reach = spread_of(rigid.tools(problem, nominal)[0][0])
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
    words = (best.words, *(other.words for other in others[: _MOST_NAMED - 1] if other.left <= _AS_GOOD * best.left))
    return PermutedAxes(kernel.factor.name, words, as_given * _MM, best.left * _MM, True, adapted=False)


_STILL = {"angle": ("deg", 1.0), "length": ("mm", 1.0)}  # What moved by less stood still, but for noise of its reading
_ODD, _MUCH_LESS, _FAR_LIKELIER = 0.2, 1.4, np.log(1e3)
"""Of gravity: by how much it is another where it is meant in the base frame; how much larger residuals are without."""
_DENSEST, _SHORTEST = 200.0, 0.4
"""kg for each cubic metre of an arm's length (industrial arms and palletisers: 5 to 90); m, what shorter arms count."""


def mixed_up(ready: Prepared) -> list[Finding]:
    reading = find_permuted_axes(ready.problem, ready.dataset)
    if reading is None:
        return []
    adapted = "model, however its free parameters adapt" if reading.adapted else "nominal arm"
    text = f"{reading.measurement}: as they stand, the data are typically {digits(reading.as_given_mm)} mm off the "
    text += f"{adapted}; with {', or with '.join(reading.readings)}, they are {digits(reading.left_mm)} mm off."
    of_model = "the order, the directions or the zeros of the joints in the model"
    of_model = of_model if reading.of_joints else "how the tracker's frame lies"
    hint = f"Check the unit in the column names; mend columns in the file or by data.columns, or {of_model}."
    return [Finding("bad", text, f"limit {MUCH_BETTER:g} times", hint)]


def reach(ready: Prepared) -> list[Finding]:
    check_reach(ready.problem, ready.dataset)
    return []


def masses(ready: Prepared) -> list[Finding]:
    findings = []
    for name, arm in ready.system.arms.items():
        total, size = sum(mass.mass for mass in arm.masses), max(arm.length, _SHORTEST)
        limit = _DENSEST * size**3
        if total > limit:
            worst = max(arm.masses, key=lambda mass: mass.mass)
            text = f"The links of {name} weigh {digits(total)} kg ({worst.name}: {digits(worst.mass)} kg), and the arm "
            text += f"is {digits(arm.length)} m long from joint to joint: no arm of that length weighs more than "
            text += f"{digits(limit)} kg. Are these grams?"
            test = f"limit {_DENSEST:g} kg for each cubic metre of the length, {_SHORTEST:g} m at least"
            findings.append(Finding("warning", text, test, f"Correct the masses: arms.{name}.links, or the URDF's."))
    return findings


def still_joints(fit: Fit) -> dict[str, str]:
    dataset, still = fit.ready.trained, {}
    for channel, dimension in command_channels(fit.system.arms).items():
        unit, least = _STILL[dimension]
        values = dataset.column(channel) if dataset.has(channel) else np.array([])
        known = to_unit(values[np.isfinite(values)], unit)
        if known.size and np.ptp(known) < least:
            still[channel] = f"{np.mean(known):.4g} {unit}"
    return still


def still(fit: Fit) -> list[Finding]:
    stood = fit.of(still_joints)
    if not stood:
        return []
    listed = [f"{shown_joint(c, fit.system.arms)} at {where}" for c, where in stood.items()]
    text = f"Hardly moved in the training records: {first_few(listed)}. Predictions elsewhere rest on nominal values "
    text += "and priors, and no record judges them."
    test = "range, limits " + " and ".join(f"{least:g} {unit}" for unit, least in _STILL.values())
    action = "Move these joints too, or use the calibration only where they stand there."
    return [Finding("warning", text, test, action)]


def same_poses(fit: Fit) -> list[Finding]:
    dataset, split = fit.dataset, fit.split
    pose = first_of_pose(dataset, [*filter(dataset.has, command_channels(fit.system.arms))])
    count, held = int(np.isin(pose[split.holdout], pose[split.train]).sum()), len(split.holdout)
    if not count:
        return []
    text = f"{count} of {held} held-out records are at poses that trained: their errors show how well a pose repeats, "
    text += "not how good the model is elsewhere."
    return [Finding("warning", text, "poses alike in all joints, under the same load", "Hold out other poses.")]


def gravity(ready: Prepared) -> list[Finding]:
    """Where springs bend under weights: whether gravity is stated, and in the frame of the measurements, in which the
    base may stand tilted: then short fits judge whether the vector was meant in the base frame."""
    system, dataset, findings = ready.system, ready.dataset, list[Finding]()
    payload = bool(system.statics.payload) or (dataset.has("payload") and bool(dataset.column("payload").any()))
    bent = [name for name, arm in system.arms.items() if arm.deflection_size and (arm.masses or payload)]
    if not bent or dataset.has("gravity_z"):
        return []
    stated, alignment = np.array(system.environment.gravity), ready.start.alignment
    if system.statics.gravity is None:
        x, y, z = stated
        text = f"The direction of gravity is not stated: for the springs of {', '.join(bent)} it was assumed to be "
        text += f"({x:g}, {y:g}, {z:g}) m/s^2 in the frame of the measurements, z up. If that frame is tilted, "
        action = "State statics.gravity_m_s2 in that frame, or add the columns gravity_x_m_s2, gravity_y_m_s2 and "
        findings += [Finding("warning", f"{text}compliances are wrong.", "", f"{action}gravity_z_m_s2 to the records.")]
    if alignment is None or np.linalg.norm(alignment.turn @ stated - stated) < _ODD * np.linalg.norm(stated):
        return findings
    inside, meant = alignment.turn.T @ stated, alignment.turn @ stated
    # What short fits leave under each, in units of the declared noise.
    few, left, plan = ready.trained.subset(thinned(np.arange(len(ready.trained)))), [], ready.problem.blueprint
    try:
        for vector in (stated, meant):
            column = {f"gravity_{axis}": np.full(len(few), x) for axis, x in zip(_AXES, vector, strict=True)}
            under = replace(few, channels={**few.channels, **column})
            parts = plan.arms, plan.measurements, ready.problem.parameters, plan.environment, under
            problem = Problem.build(*parts, "interpreted")
            posed, freedom = PosedProblem(problem.of(under)), max(problem.equations() - problem.increments, 1)
            x = descended(posed, posed.x(ready.start.values(problem)[0]), _FIT_STEPS, _FIT_DAMPING, 1e-3)
            left.append(float(np.sqrt(2 * posed.cost(x) / freedom)))
    except NotConvergedError:
        return findings
    odds = freedom * np.log(left[0] / left[1])  # of two fits with noise of unknown size, in powers of e
    if odds < -_FAR_LIKELIER:
        return findings
    as_stated, pull, to_state = (", ".join(f"{x:.2f}" for x in np.round(v, 2) + 0.0) for v in (stated, inside, meant))
    text = f"Gravity, ({as_stated}) m/s^2 in the frame of the measurements, pulls along ({pull}) in the arm's base "
    text += f"frame as aligned. Residuals of short fits are {digits(left[0], 2)} times the declared noise so, "
    text += f"{digits(left[1], 2)} times where the vector is meant in the base frame."
    likelier = odds > _FAR_LIKELIER
    grade: Grade = "bad" if likelier and left[0] > _MUCH_LESS * left[1] else "warning" if likelier else "note"
    action = f"{'State' if likelier else 'If it is meant so, state'} statics.gravity_m_s2: [{to_state}]."
    return [*findings, Finding(grade, text, f"limits {_MUCH_LESS:g} times, and a thousand to one", action)]
