"""How much of the residuals the pose, time, load, approach or temperature still predicts, whatever the cause.

Residuals of a fit are regressed on functions of what was recorded: of each joint's angle, along the joint's own motion
and along the residual's entries; of pairs of joints; of time, payload, direction of approach, temperature. Functions
are harmonics whose coefficients shrink as those of a smooth random function would [Rasmussen2006]. Records are
predicted by the poses of other folds. The same regression of the same residuals with random signs, one a pose, taken
through the same fit, is what chance predicts: signs keep how large each record's error is, and what neighbours share
in a pose, so that neither outliers nor uneven noise pass for a dependence [Liu1988].

Whether residuals follow a smooth function of the pose, or of time, that no named cause is: Gaussian processes.

Residuals of a fit, freed of what the fit and some causes take up, are noise plus a process over the records with a
kernel of a few length scales, each entry of a record's residual for itself [Rasmussen2006]. Two explanations are
compared by their marginal likelihoods, by how well other records predict each record, and by whether one can imitate
the other: where poses were visited in order, a function of time is a function of the pose, and no test separates them.
"""

from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Self

import numpy as np
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dposv

from armcal.arm.assembly import command_channels, shown_joint
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.diagnose.score_tests import FitRows
from armcal.measure.groups import PairedMeasurement, pose_numbers
from armcal.problem.motion import Motion, recorded_order
from armcal.problem.problem import Problem

CLEAR = 3.0  # Logarithm of the odds, 20 to 1, from which on one explanation is preferred
IMITATED = 0.1  # An explanation of which another predicts this share cannot be distinguished from it
_POSE_LENGTHS = (1.0, 2.0, 4.0)
_TIME_LENGTHS = (3.0, 10.0, 30.0, 100.0)
_MOST_FEATURES = 180
_SMALLEST = 1e-4
_RATIOS = np.logspace(-4, 3, 29)
_RIDGE = 0.05


@dataclass(frozen=True)
class Smooth:
    evidence: float  # logarithm of its odds against noise alone, two hyperparameters paid for
    function: Array  # what it takes up (rows)
    hat: Array  # a root of the matrix that gives it from the residual (rows x n)


@dataclass(frozen=True)
class Kernels:
    """Correlations of records (N x N each), one a length scale, and their features (N x r each)."""

    kernels: tuple[Array, ...]

    @cached_property
    def features(self) -> tuple[Array, ...]:
        features = []
        for kernel in self.kernels:
            values, vectors = np.linalg.eigh(kernel)
            kept = values > _SMALLEST * values[-1]
            features.append(np.asarray(vectors[:, kept] * np.sqrt(values[kept]))[:, ::-1])
        return tuple(features)

    def imitate(self, function: Array) -> float:
        """Which share of a function (N x n_r) they predict of a record from the others."""
        centred = function - function.mean(axis=0)
        total, shares = float(np.sum(centred**2)), [0.0]
        for kernel in self.kernels if total > 0 else ():
            inverse = np.linalg.inv(kernel + _RIDGE * np.eye(len(kernel)))
            left = inverse @ centred / np.diag(inverse)[:, None]
            shares.append(1 - float(np.sum(left**2)) / total)
        return max(shares)


def time_kernels(count: int) -> Kernels:
    """Of so many records in recorded order: correlations fall by e over some records, up to a third of them."""
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    return Kernels(tuple(np.exp(-apart / length) for length in _TIME_LENGTHS if 3 * length <= count))


def pose_kernels(problem: Problem, dataset: Dataset) -> Kernels:
    """Of poses: squared exponentials of the chords between joint angles, and of travels in shares of their range.

    Of all joints at several lengths; and sums of functions of one joint, of two, and of three [Duvenaud2011].
    """
    squares = []
    for channel, dimension in command_channels(problem.blueprint.arms).items():
        command = np.nan_to_num(dataset.column(channel))
        apart = command[:, None] - command
        travel = 2 * apart / max(float(np.ptp(command)), 1e-12)
        squares.append((2 * np.sin(apart / 2) if dimension == "angle" else travel) ** 2)
    whole = np.sum(squares, axis=0)
    powers = [np.sum([np.exp(-i * square / 2) for square in squares], axis=0) for i in (1, 2, 3)]
    sums = [powers[0], powers[0] ** 2 - powers[1], powers[0] ** 3 - 3 * powers[0] * powers[1] + 2 * powers[2]]
    own = [kernel / kernel[0, 0] for kernel in sums[: len(squares)]]
    return Kernels((*(np.exp(-whole / (2 * length**2)) for length in _POSE_LENGTHS), *own))


def smooth(residual: Array, basis: Array, by_record: Indices, kernels: Kernels) -> Smooth:
    """The best process in a residual (rows) that is freed of an orthonormal basis (rows x n)."""
    rows, entries = len(residual), by_record.shape[1]
    best = Smooth(-np.inf, np.zeros_like(residual), np.zeros((rows, 0)))
    total, freedom = float(residual @ residual), rows - basis.shape[1]
    for features in kernels.features:
        features = features[:, : max(1, _MOST_FEATURES // entries)]
        size = features.shape[1]
        spread = np.zeros((rows, size * entries))
        for entry, own in enumerate(by_record.T):
            spread[own, entry * size : (entry + 1) * size] = features * (residual[own] != 0)[:, None]
        spread -= basis @ (basis.T @ spread)
        values, vectors = np.linalg.eigh(spread.T @ spread)
        kept = values > 1e-9 * max(float(values[-1]), 1e-300)
        values, axes = values[kept], spread @ (vectors[:, kept] / np.sqrt(values[kept]))
        along = axes.T @ residual
        taken = _RATIOS[:, None] * values / (1 + _RATIOS[:, None] * values)
        left = np.maximum(total - taken @ along**2, 1e-12 * total)
        gained = -0.5 * (freedom * np.log(left / total) + np.sum(np.log1p(_RATIOS[:, None] * values), axis=1))
        i = int(np.argmax(gained))
        evidence = float(gained[i]) - float(np.log(freedom))
        if evidence > best.evidence:
            best = Smooth(evidence, axes @ (taken[i] * along), axes * np.sqrt(taken[i]))
    return best


def left_out(of: Smooth, residual: Array, basis: Array, by_record: Indices) -> Array:
    """Residuals of each record, predicted by the others (rows): those of a linear smoother, without its own hat."""
    held = residual - of.function
    for own in by_record:
        kept = (1 + 1e-9) * np.eye(len(own)) - basis[own] @ basis[own].T - of.hat[own] @ of.hat[own].T
        held[own] = np.linalg.solve(kept, held[own])
    return held


@dataclass(frozen=True)
class TimeOrPose:
    """Why neighbours miss alike.

    Attributes:
        time, pose: logarithms of the odds of a function of time, and of the pose, against noise alone.
        time_mm, pose_mm: mean residual of a record that the others predict by either.
        time_imitated, pose_imitated: which share of the one's function the other predicts, or of the records' order.
    """

    time: float
    pose: float
    time_mm: float
    pose_mm: float
    time_imitated: float
    pose_imitated: float

    @property
    def cause(self) -> str:
        """``time`` or ``pose`` where that wins by odds, by records left out, and is not imitated; else ``open``."""
        if self.time - max(self.pose, 0.0) > CLEAR and self.time_mm < self.pose_mm and self.time_imitated < IMITATED:
            return "time"
        if self.pose - max(self.time, 0.0) > CLEAR and self.pose_mm < self.time_mm and self.pose_imitated < IMITATED:
            return "pose"
        return "open"


LEVEL = 0.02
FEWEST_POSES = 40  # Distinct poses below which nothing is said
MOST_CARRIERS = 3
_DRAWS = 99
_FOLDS = 5
_FINE, _COARSE, _SLOW = 30, 3, 6  # Highest harmonics: of a joint along its own motion, of anything else, of time
_RECORDS_PER_HARMONIC = 6
_SIZES = (0.03, 0.1, 0.3, 1.0)  # Standard deviations of one function, in those of the residuals
MOST_OF_MEDIAN = 3.0  # A record farther off than so many medians counts as one that is as far off
_OF_PLACE = 3  # So many numbers a record place a tool
_NEXT_CARRIER = 0.1  # Of the whole share: what predicts less beside the ones before it is not named


@dataclass(frozen=True)
class Carrier:
    kind: str  # ``joint``, ``time``, ``payload``, ``approach`` or ``temperature``
    name: str  # of the joint, with its arm where there are several; empty where it is none
    share: float  # of the residual variance, beside the carriers before it

    @property
    def words(self) -> str:
        of = {"joint": f"the angle of {self.name}", "approach": f"the side {self.name} was approached from"}
        return of.get(self.kind, f"the {self.kind}" if self.kind != "time" else "time")


@dataclass(frozen=True)
class Predictable:
    """What other records predict of a record's residual.

    Attributes:
        carriers: what it is predicted by, the most important first; empty where the share is not above chance.
        learnable: whether a pose residual could learn most of it from what is measured; None where one was asked for.
    """

    share: float  # of the squared residuals of records held out; below 0 where predictions are worse than none
    chance: float  # below what 98 % of the shares of residuals without any dependence lie
    p_value: float  # of the share, by chance
    carriers: tuple[Carrier, ...]
    records: int  # how many were looked at
    poses: int  # how many distinct ones
    by_time: float  # share that time alone predicts
    learnable: bool | None
    imitated: float = 0.0  # which share of the function of time that residuals follow the pose predicts

    @property
    def above_chance(self) -> bool:
        """At 2 %."""
        return self.share > 0 and self.p_value <= LEVEL

    @property
    def is_in_order(self) -> bool:
        """Whether time or the pose may be the cause, as poses were visited in an order: the pose tells the time."""
        by_time = self.by_time > self.share / 2 or any(carrier.kind == "time" for carrier in self.carriers)
        return by_time and self.imitated > IMITATED

    @property
    def falls(self) -> float:
        """By which share the root mean square error would fall without what is predicted."""
        return 1 - float(np.sqrt(max(0.0, 1 - max(self.share, 0.0))))


@dataclass(frozen=True)
class _Block:
    """Columns of some functions: which inputs they are of, their spectrum, whether along a joint's own motion."""

    inputs: frozenset[int]
    columns: Array
    order: Array
    along: bool = False

    @cached_property
    def deviations(self) -> Array:
        """Of the coefficients: the variance of a harmonic falls as 1/order, as if any length scale were as likely."""
        return np.asarray(np.sqrt(1 / (self.order * np.sum(1 / np.unique(self.order)))))


@dataclass(frozen=True)
class _Input:
    kind: str
    name: str
    channel: str
    angle: Array  # On a circle, or on half of one where it does not close (N; rad)


def predictable(problem: Problem, rows: FitRows, basis: Array, motion: Motion, dataset: Dataset) -> Predictable | None:
    """Of the residuals of a fit, free of what it takes up (``basis``); None where the poses are too few to judge."""
    pose = pose_numbers(dataset, motion.channels)
    count = int(pose.max(initial=-1)) + 1
    if count < FEWEST_POSES:
        return None
    inputs = list(_inputs(problem, motion, dataset))
    blocks = list(_blocks(rows, motion, inputs))
    random = np.random.default_rng(0)
    fold = np.argsort(random.permutation(count))[pose] * _FOLDS // count
    signs = random.choice((-1.0, 1.0), (count, _DRAWS))[pose]
    members = [np.flatnonzero(fold[rows.record_of] == f) for f in range(_FOLDS)]
    # Residuals, outliers bounded, and the same with random signs of their records, through the same fit.
    data, lengths = len(rows.record_of), np.linalg.norm(rows.residual[rows.by_record], axis=1)
    limit = MOST_OF_MEDIAN * float(np.median(lengths[lengths > 0])) if np.any(lengths) else 1.0
    bounded = np.minimum(1.0, limit / np.maximum(lengths, 1e-300))
    both = np.repeat(rows.residual[:, None], 1 + signs.shape[1], axis=1)
    both[:data] *= bounded[rows.record_of][:, None]
    both[:data, 1:] *= signs[rows.record_of]
    whole = _Regression(blocks, members, np.asarray((both - basis @ (basis.T @ both))[:data]))
    shares = np.concatenate([whole.shares(_SIZES, parts) for parts in (None, *({i} for i in range(len(inputs))))])
    size, highest = _SIZES[int(np.argmax(shares[:, 0])) % len(_SIZES)], shares.max(axis=0)
    p = (1 + np.count_nonzero(highest[1:] >= highest[0])) / (1 + _DRAWS)
    chance = float(np.quantile(highest[1:], 1 - LEVEL))
    predicted = Predictable(float(highest[0]), chance, float(p), (), len(dataset), count, 0.0, False)
    if not predicted.above_chance:
        return predicted
    first = whole.of_first()
    return replace(_carried(predicted, first, inputs, size), learnable=_learnable(problem, rows, first, predicted))


def _inputs(problem: Problem, motion: Motion, dataset: Dataset) -> Iterator[_Input]:
    def on_circle(values: Array, closed: bool = False) -> Array:
        low, high = np.nanmin(values), np.nanmax(values)
        return np.nan_to_num(values if closed else np.pi * (values - low) / (high - low))

    arms = problem.blueprint.arms
    for channel in motion.channels:
        arm, _, joint = channel.partition(".")
        shown, command = shown_joint(channel, arms), dataset.column(channel)
        if np.nanmax(command) > np.nanmin(command):
            yield _Input("joint", shown, channel, on_circle(command, arms[arm].commanded[joint] == "angle"))
        side = f"{arm}.approach.{joint}"
        if dataset.has(side) and np.nanmax(dataset.column(side)) > np.nanmin(dataset.column(side)):
            yield _Input("approach", shown, channel, on_circle(dataset.column(side)))
    yield _Input("time", "", "", on_circle(recorded_order(dataset)))
    for kind in ("payload", "temperature"):
        if dataset.has(kind) and np.ptp(dataset.column(kind)) > 0:
            yield _Input(kind, "", "", on_circle(dataset.column(kind)))


def _blocks(rows: FitRows, motion: Motion, inputs: Sequence[_Input]) -> Iterator[_Block]:
    typical = np.sqrt(np.mean([np.mean(_along(rows, motion, c) ** 2) for c in motion.channels])) or 1.0
    finest = min(_FINE, max(_COARSE, len(inputs[0].angle) // _RECORDS_PER_HARMONIC))
    acting = np.abs(rows.columns([np.ones((len(w), w.shape[2], 1)) for w in rows.whitening])[:, 0]) > 0
    for i, own in enumerate(inputs):
        highest = min({"joint": finest, "time": _SLOW}.get(own.kind, _COARSE), len(np.unique(np.round(own.angle, 9))))
        features, order = _harmonics(own.angle, highest)
        if own.channel:
            along = _along(rows, motion, own.channel) / typical
            yield _Block(frozenset({i}), along[:, None] * features[rows.record_of], order, True)
        coarse = order <= (_SLOW if own.kind == "time" else _COARSE)
        yield _entries(rows, frozenset({i}), features[:, coarse], order[coarse], acting)
    joints = [i for i, own in enumerate(inputs) if own.kind == "joint"]
    for i, j in combinations(joints, 2):
        if inputs[i].channel.partition(".")[0] == inputs[j].channel.partition(".")[0]:
            first, second = (_harmonics(inputs[k].angle, 1)[0] for k in (i, j))
            features = np.einsum("nk,nl->nkl", first, second).reshape(len(first), -1)
            yield _entries(rows, frozenset({i, j}), features, np.full(4, np.sqrt(2)), acting)


def _along(rows: FitRows, motion: Motion, channel: str) -> Array:
    return rows.columns([slope[:, :, None] for slope in motion.along(channel)])[: len(rows.record_of), 0]


def _harmonics(angle: Array, highest: int) -> tuple[Array, Array]:
    """Cosines and sines of multiples of an angle (N x 2 highest), and which multiples."""
    order = np.arange(1, highest + 1)
    turned = angle[:, None] * order
    return np.hstack([np.cos(turned), np.sin(turned)]), np.tile(order, 2).astype(float)


def _entries(rows: FitRows, inputs: frozenset[int], features: Array, order: Array, acting: Mask) -> _Block:
    """Functions of each entry of a record's residual for itself; none of an entry that did not take part."""
    entries, size = rows.by_record.shape[1], features.shape[1]
    columns = np.zeros((len(rows.record_of), entries * size))
    for entry, own in enumerate(rows.by_record.T):
        columns[own, entry * size : (entry + 1) * size] = features * acting[own, None]
    return _Block(inputs, columns, np.tile(order, entries))


@dataclass(frozen=True)
class _Regression:
    """On columns of blocks, of which each fold is predicted by the others.

    Columns are not freed of what the fit takes up: the residuals of a fold would then follow from those of the others.
    """

    blocks: Sequence[_Block]  # whose columns
    members: Sequence[Indices]  # which rows each fold has
    values: Array  # rows x m

    def of_first(self) -> Self:
        return replace(self, values=self.values[:, :1])

    def shares(self, sizes: Sequence[float], inputs: AbstractSet[int] | None = None) -> Array:
        """Of the squares of values, which functions of each size of some inputs, or of all, predict (sizes x m)."""
        used = [block for block in self.blocks if inputs is None or block.inputs <= inputs]
        columns = np.hstack([block.columns * block.deviations for block in used])
        explained = np.zeros((len(sizes), self.values.shape[1]))
        for own, (matrix, known, onto) in zip(self.members, self._systems(columns), strict=True):
            for i, size in enumerate(sizes):
                _, solved, failed = dposv(matrix + np.eye(len(matrix)) / size**2, known)
                if failed:
                    raise LinAlgError("the equations of the coefficients are not positive definite")
                predicted = onto @ solved
                explained[i] += np.sum(predicted * (2 * self.values[own] - predicted), axis=0)
        return np.asarray(explained / np.maximum(np.sum(self.values**2, axis=0), 1e-300))

    def _systems(self, columns: Array) -> Iterator[tuple[Array, Array, Array]]:
        """Of each fold: the equations of the others, by coefficients or by rows, the fewer; and what predicts it."""
        if columns.shape[1] <= len(columns):
            parts = [columns[own] for own in self.members]
            grams = [part.T @ part for part in parts]
            alongs = [part.T @ self.values[own] for part, own in zip(parts, self.members, strict=True)]
            gram, along = sum(grams), sum(alongs)
            yield from ((gram - g, along - a, part) for g, a, part in zip(grams, alongs, parts, strict=True))
            return
        kernel = columns @ columns.T
        for own in self.members:
            others = np.delete(np.arange(len(columns)), own)
            yield kernel[np.ix_(others, others)], self.values[others], kernel[np.ix_(own, others)]


def _carried(predicted: Predictable, whole: _Regression, inputs: Sequence[_Input], size: float) -> Predictable:
    """With the inputs that carry it, one after another, each that which predicts most beside the ones before it.

    Time is one of them only where it predicts what all others do not: of poses visited in an order it predicts much.
    """

    def share(used: set[int]) -> float:
        return float(whole.shares([size], used)[0, 0])

    least = _NEXT_CARRIER * predicted.share
    time = next(i for i, own in enumerate(inputs) if own.kind == "time")
    possible, carriers, taken, so_far = set(range(len(inputs))), list[Carrier](), set[int](), 0.0
    if share(possible) - share(possible - {time}) < least and share(possible - {time}) > share({time}):
        possible.discard(time)
    while len(carriers) < min(MOST_CARRIERS, len(possible)):
        best, reached = max(((i, share(taken | {i})) for i in sorted(possible - taken)), key=lambda pair: pair[1])
        if carriers and reached - so_far < least:
            break
        carriers.append(Carrier(inputs[best].kind, inputs[best].name, reached - so_far))
        taken, so_far = taken | {best}, reached
    return replace(predicted, by_time=share({time}), carriers=tuple(carriers))


def _learnable(problem: Problem, rows: FitRows, whole: _Regression, predicted: Predictable) -> bool | None:
    """Whether a pose residual can learn most of it; of records that do not place the tool, joints' own motion alone."""
    plan = problem.blueprint
    if any(arm.residual for arm in plan.arms.values()):
        return None
    paired = any(isinstance(measurement, PairedMeasurement) for measurement in plan.measurements.values())
    if paired or not all(kernel.factor.output_channels for kernel in problem.kernels):
        return False
    own = replace(whole, blocks=[block for block in whole.blocks if block.along])
    return rows.by_record.shape[1] >= _OF_PLACE or bool(own.shares(_SIZES).max() > predicted.share / 2)
