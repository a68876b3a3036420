"""What is left in the residuals of a calibration: one procedure, with one level for all that is tried.

Everything that may be in them is tried at once: causes, sets of columns, by score tests [Rao1948] with a covariance
from blocks of neighbouring records [Liang1986]; smooth functions of the pose, and of time, by their odds
[Rasmussen2006]; likeness of neighbours; what the scatter may depend on, by regression of squares [Koenker1981]. The
residuals themselves with random signs, one a pose, and squares in random order say what chance does [Liu1988], and the
smallest of all p-values keeps the level [Westfall1993].

The cause that explains most for its size [Schwarz1978] is taken into the model, and everything is tried again on what
is left. Each that was found is then set against all others, against a smooth function of pose or time, which stands for
what is not among them, and against chance: it is named alone only where it is clearly the likeliest.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc

from armcal.base.arrays import Array, Indices, Mask
from armcal.base.units import SMALLEST_SHOWN, digits, readable
from armcal.diagnose.causes import WILD, Cause, Functions, Records, Smooth, causes_of, scatter_features
from armcal.diagnose.checks import Finding
from armcal.diagnose.fit import SMALLEST, Fit, FitRows, basis_of, lag_one, own_basis
from armcal.estimate.identifiability import Measure
from armcal.estimate.validation import automatic_block_length
from armcal.measure.groups import PairedMeasurement, pose_numbers

LEVEL = 0.01  # Of everything that is tried together: so often something is said of sound data
_NEAR, _FAR_LESS = 0.05, 0.9  # Of rivals of a significant cause: level beyond which one is none, and what it leaves
CLEAR = 3.0  # Logarithm of the odds, 20 to 1, from which on one explanation is preferred
FEWEST_RECORDS = 30
FEWEST_POSES = 40  # Distinct poses below which nothing is said of functions of the pose
MOST_RECORDS = 1000
WORTHWHILE = 0.01
DRAWS, FEWER_DRAWS = 999, 299  # Of chance: for the test that decides whether anything is named; where fewer show enough
OVER_TIME = ("order", "step", "slip", "bump")  # Kinds of causes
UNLISTED = "something that is none of these"
CHANGING = "something that changes with time and is none of these"
CHANCE = "nothing: it may be chance"
_OUT_OF_QUESTION = 0.1  # A p-value by the fewer draws that all of them would hardly bring to the level
_MOST_CAUSES, _MOST_CARRIERS = 5, 3
_MOST_BLOCKS, _FEWEST_BLOCKS, _FEWEST_SPARE_BLOCKS = 60, 30, 8
_COLUMNS_AT_ONCE = 12  # Their products with the draws, block by block, stay in a processor's cache
_FOLDS = 5
_SAME = 0.999  # Cosine from which on two causes are one
_IMITATED = 0.1  # An explanation of which another predicts this share cannot be distinguished from it
_IN_ORDER = 0.5  # Share of the order of records from which on poses tell the time
_LEAST_LEFT_OVER = 0.02  # Of what a cause takes up: less is what it does beyond first order
_NEGLIGIBLE = 0.1  # Of what causes take up: less than this may be what is not linear in them
_NEXT_CARRIER = 0.1  # Of the whole share: what predicts less beside the ones before it is not named
_BEYOND = 0.05  # Level at which what a cause leaves is more than noise
_LIKELIER = 0.5  # Where chance has more of the odds, a cause is none
_HOPELESS = 0.01  # A cause with less of the odds is none
_LACK, _TIMES_REPEATS, _FEWEST_REPEATS = 0.005, 3.0, 5
_LEAST_LEFT = 0.05  # Of a row, of what a fit takes up most
_MM = 1000.0


@dataclass(frozen=True)
class Structure:
    """A cause that was found; kind, subject, words, effect and measure as in ``Cause``."""

    kind: str
    subject: str
    words: str
    effect: str
    measure: str
    p_value: float  # that the residuals do not depend on it, over everything that was tried
    share: float  # of the squared residuals left by the ones before it
    falls_mm: float  # by how much the mean error would fall if it were modelled, judged on records left out
    size: str  # how large it is, in words; empty if its coefficients have no unit
    odds: float  # its share of the odds of everything that was tried, and of what was not
    alternatives: tuple[str, ...]  # what it does not beat 20 to 1, the most likely first; only a measurement can decide


@dataclass(frozen=True)
class Carrier:
    kind: str  # ``joint``, ``time``, ``payload``, ``approach`` or ``temperature``
    words: str
    share: float  # of the squared residuals, beside the carriers before it


@dataclass(frozen=True)
class Predicted:
    by_pose: float  # share of the squared residuals of records left out, by smooth functions of the pose
    by_time: float  # by those of time
    pose: float  # logarithm of the odds against noise alone
    time: float
    time_imitated: float  # which share of its function the pose predicts, or of the records' order
    pose_imitated: float  # which share of its function time predicts
    carriers: tuple[Carrier, ...] = ()  # the most important first

    @property
    def share(self) -> float:
        return max(self.by_pose, self.by_time, 0.0)

    @property
    def cause(self) -> str:
        """``time`` or ``pose`` where that wins by odds, by records left out, and is not imitated; else ``open``."""
        if self.time - max(self.pose, 0.0) > CLEAR and self.by_time > self.by_pose and self.time_imitated < _IMITATED:
            return "time"
        if self.pose - max(self.time, 0.0) > CLEAR and self.by_pose > self.by_time and self.pose_imitated < _IMITATED:
            return "pose"
        return "open"


@dataclass(frozen=True)
class Scatter:
    words: str  # as the end of a sentence
    p_value: float  # that it does not, over everything that was tried
    low: float  # in units of the declared noise, in the third of the records with the least of it
    high: float  # in that with the most
    alternatives: tuple[str, ...]  # what else may be meant, the most likely first


@dataclass(frozen=True)
class Repeats:
    scatter_mm: float  # of a record about the mean of its pose (root mean square)
    left_mm: float  # of all residuals (root mean square)
    records: int  # that are repeats
    poses: int  # that were repeated
    p_value: float  # that residuals are as repeats have them

    @property
    def exceeded(self) -> bool:
        return self.p_value < _LACK and self.left_mm > _TIMES_REPEATS * self.scatter_mm  # no model is perfect


@dataclass(frozen=True)
class ResidualStructure:
    structures: tuple[Structure, ...]  # in the order in which they were taken into the model
    more: bool  # whether something was significant still when the search ended
    share: float  # of the squared residuals, what is no noise: causes take it up, or other records predict it
    predictable: Predicted | None  # what others predict beside the causes; None if no more than chance does
    in_order: bool  # whether a function of time could be one of the pose, as poses were visited in an order
    lag_one: float  # correlation of neighbouring residuals, less what the fit itself makes of it
    lag_p: float  # its p-value, over everything that was tried
    lag_after: float  # the same once the causes are in the model
    lag_after_p: float
    learnable: bool | None  # whether a pose residual can learn from what is measured; None where the model has one
    noise: Scatter | None  # what it depends on; None if on nothing
    repeats: Repeats | None  # what records of one pose say of noise; None where too few are
    mean_mm: float  # mean residual of the training records
    tested: int  # how much was tried
    records: int  # how many were looked at
    poses: int  # how many of them are distinct
    block: int  # how many neighbours count as one observation
    level: float = LEVEL

    @property
    def worthwhile(self) -> tuple[Structure, ...]:
        least = max(WORTHWHILE * self.mean_mm, SMALLEST_SHOWN)
        return tuple(s for s in self.structures if s.falls_mm >= least)

    @property
    def shows(self) -> bool:
        return bool(self.structures) or self.predictable is not None

    @property
    def goes_with_time(self) -> bool:
        """Whether the largest part of them does, and the pose does not tell the time."""
        largest = max(self.structures, key=lambda s: s.falls_mm, default=None)
        if largest is None:
            return self.predictable is not None and self.predictable.cause == "time"
        return not self.in_order and largest.kind in OVER_TIME


def structure(fit: Fit) -> ResidualStructure | None:
    """Try the residuals of a fit to records, with the weights they had; None where there are too few to judge."""
    if not fit.converged:
        return None
    position, plan = fit.position[fit.split.train], fit.problem.blueprint
    acting = np.flatnonzero(np.any([one.weight[: one.count] > 0 for one in fit.few_acting.records], axis=0))
    chosen = acting[np.argsort(position[acting], kind="stable")]
    if len(chosen) < FEWEST_RECORDS:
        return None
    if len(chosen) > MOST_RECORDS:  # runs of neighbours
        runs = np.array_split(chosen, 2 * len(chosen) // MOST_RECORDS)
        chosen = np.concatenate([run[: MOST_RECORDS // len(runs)] for run in runs])
    here = Records.of(fit, chosen)
    causes = list(causes_of(here))
    columns = [here.rows.columns(one.columns) for one in causes]
    # What a held parameter of a joint's effect does as well, a spring's or a gear's, is named as that parameter.
    effects = {f"{name}.{effect}" for name, arm in plan.arms.items() for effect in arm.effects}
    unit = [column / max(float(np.linalg.norm(column)), 1e-300) for column in columns]
    held = [u for c, u in zip(causes, unit, strict=True) if c.subject.rpartition(".")[0] in effects and u.shape[1] == 1]
    kept = [
        i
        for i, own in enumerate(unit)
        if causes[i].kind == "held" or own.shape[1] > 1 or all(abs(float(np.sum(one * own))) < _SAME for one in held)
    ]
    contest = Contest(
        here,
        [causes[i] for i in kept],
        [columns[i] for i in kept],
        [(words, f) for words, f in scatter_features(here) if np.ptp(f) > 1e-9 * max(1.0, np.abs(f).max())],
        pose_numbers(here.dataset, here.motion.channels),
        np.diff(position[chosen]) == 1,
    )
    described = (fit.system.description.get("arms") or {}).values()
    modelled = {str(effect.get("type")) for arm in described for effect in (arm.get("effects") or {}).values()}
    learnable = None
    if not any(arm.residual for arm in plan.arms.values()):
        paired = any(isinstance(measurement, PairedMeasurement) for measurement in plan.measurements.values())
        learnable = not paired and all(kernel.factor.output_channels for kernel in fit.problem.kernels)
    return contest.outcome(modelled, learnable)


@dataclass(frozen=True)
class Tried:
    left: Sequence[tuple[int, Array]]  # causes that are not in the model, each with its basis
    shares: Array  # of the squared residual, how much each of them would take up
    p_values: Array  # of each of them
    lag: float  # correlation of neighbours, less what the fit makes of it
    lag_p: float
    smooth_p: float  # the smaller one of the functions of pose and of time
    scatter_p: Array  # of each thing on which the scatter may depend


@dataclass(frozen=True)
class Contest:
    recorded: Records
    causes: Sequence[Cause]
    columns: Sequence[Array]  # of each (rows x k)
    scatters: Sequence[tuple[str, Array]]  # on which the scatter may depend (N each)
    pose: Indices  # of each record the number of its pose (N)
    neighbours: Mask  # whether each record but the last is followed by its neighbour in the recording (N - 1)

    @property
    def rows(self) -> FitRows:
        return self.recorded.rows

    @cached_property
    def basis(self) -> Array:
        """Of what the fit takes up (rows x n), orthonormal."""
        return basis_of(self.rows.slopes)

    @cached_property
    def residual(self) -> Array:
        """At the last linear step of the fit (rows)."""
        return self.rows.residual - self.basis @ (self.basis.T @ self.rows.residual)

    @cached_property
    def block(self) -> Indices:
        """The block of each row, as long as errors resemble their neighbours': neither too many nor too few. Rows of
        priors and drifts are dealt out to them in turn."""
        count, data = len(self.rows.by_record), len(self.rows.record_of)
        length = automatic_block_length(self.rows.residual[self.rows.by_record].T)
        length = max(min(length, max(1, count // _FEWEST_BLOCKS)), -(-count // _MOST_BLOCKS))
        block = np.arange(count) // length
        extra = np.arange(len(self.residual) - data) % (block.max() + 1)
        return np.concatenate([block[self.rows.record_of], extra]).astype(np.intp)

    @property
    def blocks(self) -> int:
        return int(self.block.max()) + 1

    @cached_property
    def groups(self) -> list[Indices]:
        """The data's rows of each pose."""
        return [self.rows.by_record[self.pose == number].ravel() for number in range(int(self.pose.max()) + 1)]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """What stands for one cause: a jump is one wherever it is, a drift of the whole any function of time."""
        once = [f"{one.kind} {one.subject}" if one.jumps else one.words for one in self.causes]
        whole = [one.kind == "order" and not one.subject for one in self.causes]
        return tuple(CHANGING if drifts else name for name, drifts in zip(once, whole, strict=True))

    def outcome(self, modelled: Collection[str], learnable: bool | None) -> ResidualStructure:
        chosen, first, last = self._search()
        worth = (1 - max(last.lag, 0.0)) / (1 + max(last.lag, 0.0))
        settled = self._settled(chosen, worth)
        if len(settled) < len(chosen):
            last = self._tried_well([*settled])
        structures = {i: self._structure(i, [j for j in settled if j != i], modelled, *of) for i, of in settled.items()}
        residual, basis = self.beside(list(structures))
        rest = self._predicted(residual, basis) if min(last.lag_p, last.smooth_p) <= LEVEL else None
        share, in_order = 1 - float(residual @ residual) / max(float(self.residual @ self.residual), SMALLEST), False
        if rest is not None:
            rest = replace(rest, carriers=tuple(self._carriers(residual, basis, rest)))
            share = 1 - (1 - share) * (1 - rest.share)
        if structures or rest is not None:
            whole = self._predicted(self.residual, self.basis)
            in_order = whole.by_time > share / 2 and whole.time_imitated > _IMITATED
        if rest is not None and learnable and self.rows.by_record.shape[1] < 3:  # what does not place the tool
            learnable = self._share_of(self.recorded.of_joints, residual, basis) > rest.share / 2
        return ResidualStructure(
            structures=tuple(structures.values()),
            more=bool(np.any(last.p_values <= LEVEL)),
            share=share,
            predictable=rest,
            in_order=in_order,
            lag_one=first.lag,
            lag_p=first.lag_p,
            lag_after=last.lag,
            lag_after_p=last.lag_p,
            learnable=learnable,
            noise=self._scatter(last, residual, basis),
            repeats=self._repeats(),
            mean_mm=float(np.mean(self.rows.errors(self.residual))) * _MM,
            tested=len(first.p_values) + len(first.scatter_p) + 3,
            records=len(self.pose),
            poses=len(self.groups),
            block=int(np.bincount(self.block[self.rows.by_record[:, 0]]).max()),
        )

    def beside(self, others: Sequence[int]) -> tuple[Array, Array]:
        """The residual with other causes in the model, and what the fit takes up then."""
        basis = self.basis
        for other in others:
            basis = np.hstack([basis, own_basis(self.columns[other], basis)[0]])
        added = basis[:, self.basis.shape[1] :]
        return self.residual - added @ (added.T @ self.residual), basis

    def _search(self) -> tuple[dict[int, float], Tried, Tried]:
        """Causes one after another as long as one is significant, with p-values; the first trial and the last."""
        first = tried = self._tried_well([])
        chosen, whole = dict[int, float](), float(self.residual @ self.residual)
        now = whole
        while len(chosen) < _MOST_CAUSES and np.any(tried.p_values <= LEVEL):
            # The least Bayesian information criterion, blocks counting as one.
            sizes, unexplained = np.array([own.shape[1] for _, own in tried.left]), np.maximum(1 - tried.shares, 1e-12)
            count = self.blocks * self.rows.by_record.shape[1]
            criterion = count * np.log(unexplained) + sizes * np.log(count)
            best = int(np.argmin(np.where(tried.p_values <= LEVEL, criterion, np.inf)))
            # A cause of many numbers may fit far better than the one that its few numbers make significant.
            rivals = (tried.p_values <= _NEAR) & (unexplained < _FAR_LESS * unexplained[best])
            best = int(np.argmin(np.where(rivals, criterion, np.inf))) if rivals.any() else best
            if tried.shares[best] * now < _NEGLIGIBLE * (whole - now):
                break
            now *= 1 - float(tried.shares[best])
            chosen[tried.left[best][0]] = float(tried.p_values.min())  # that residuals depend on any of them
            tried = self._tried_well(list(chosen))
        return chosen, first, tried

    def _tried_well(self, others: Sequence[int]) -> Tried:
        """By few draws, and by all where these leave the level of anything, or of a cause, in doubt."""
        tried = self._tried(others, FEWER_DRAWS)
        of_causes = tried.p_values.min(initial=1.0)
        least = min(of_causes, tried.scatter_p.min(initial=1.0), tried.lag_p, tried.smooth_p)
        if any(1 / (1 + FEWER_DRAWS) < p <= _OUT_OF_QUESTION for p in (least, of_causes)):
            return self._tried(others, DRAWS)
        return tried

    def _tried(self, others: Sequence[int], draws: int) -> Tried:
        residual, basis = self.beside(others)
        both = self._with_chance(residual, basis, draws)
        remaining = [i for i in range(len(self.causes)) if i not in others]
        own = [(i, of) for i in remaining if (of := own_basis(self.columns[i], basis)[0]).shape[1]]
        lag, lag_p = lag_one(both, self.rows.by_record, self.neighbours & (np.diff(self.pose) != 0))
        functions = (self.recorded.of_pose, self.recorded.of_time) if len(self.groups) >= FEWEST_POSES else ()
        smooth_p = [np.ones(1 + draws)]
        for gains in (Smooth.of(own, basis).gains(both) for own in functions):
            # By the tail of those of chance (all but the first), which is exponential.
            middle = float(np.median(gains[1:]))
            tail = float(np.mean(gains[1:][gains[1:] >= middle])) - middle
            p = 0.5 * np.exp(-np.maximum(gains - middle, 0.0) / max(tail, 1e-12))
            smooth_p.append(np.maximum(p, SMALLEST))
        p_values = self._score_tests([of for _, of in own], both)
        of_scatter = self._of_scatter(residual, basis, draws)
        least = np.min([p_values.min(axis=0, initial=1.0), lag_p, *smooth_p, of_scatter.min(axis=0, initial=1.0)], 0)
        chance = np.sort(least[1:])

        def over_all(p: Array) -> Array:
            return np.asarray((1 + np.searchsorted(chance, p, side="right")) / (1 + draws))

        total = max(float(residual @ residual), SMALLEST)
        shares = np.array([np.sum((of.T @ residual) ** 2) for _, of in own]) / total
        adjusted = over_all(p_values[:, 0]), over_all(of_scatter[:, 0])
        by_lag, by_smooth = float(over_all(lag_p[0])), float(over_all(min(p[0] for p in smooth_p)))
        return Tried(own, shares, adjusted[0], lag, by_lag, by_smooth, adjusted[1])

    def _with_chance(self, residual: Array, basis: Array, draws: int) -> Array:
        """The residual, wild records bounded, and the same with random signs, through the fit (rows x 1 + draws)."""
        data, random = len(self.rows.record_of), np.random.default_rng(0)
        own = residual / np.sqrt(np.maximum(1 - np.sum(basis**2, axis=1), _LEAST_LEFT))
        lengths = np.linalg.norm(own[self.rows.by_record], axis=1)
        limit = WILD * float(np.median(lengths[lengths > 0])) if np.any(lengths) else 1.0
        bounded = np.ones(len(own))
        bounded[:data] = np.minimum(1.0, limit / np.maximum(lengths, SMALLEST))[self.rows.record_of]
        signs = random.choice((-1.0, 1.0), (len(self.groups), draws))[self.pose][self.rows.record_of]
        below = random.choice((-1.0, 1.0), (len(own) - data, draws))
        both = np.column_stack([residual * bounded, (own * bounded)[:, None] * np.vstack([signs, below])])
        return np.asarray(both - basis @ (basis.T @ both))

    def _score_tests(self, bases: Sequence[Array], both: Array) -> Array:
        """P-values of sums of block products by their own spread (bases x m); 1 where blocks are too few. T =
        s' (sum of s_b s_b')^-1 s is at most the number of blocks B, and (B - k)/k T/(B - T) follows F(k, B - k)."""
        p_values, by_size = np.ones((len(bases), both.shape[1])), dict[int, list[int]]()
        for i, basis in enumerate(bases):
            by_size.setdefault(basis.shape[1], []).append(i)
        rows = self._by_block(both)
        for size, members in by_size.items():
            spare, most = self.blocks - size, max(1, _COLUMNS_AT_ONCE // size)
            for some in (members[i : i + most] for i in range(0, len(members), most) if spare >= _FEWEST_SPARE_BLOCKS):
                columns = self._by_block(np.hstack([bases[i] for i in some]))
                products = (columns.transpose(0, 2, 1) @ rows).reshape(self.blocks, -1, size, both.shape[1])
                statistic = _by_spread(products)
                ratio = spare / size * statistic / np.maximum(self.blocks - statistic, 1e-9)
                p_values[some] = np.maximum(fdtrc(size, spare, ratio), SMALLEST)
        return p_values

    def _by_block(self, columns: Array) -> Array:
        order, sizes = np.argsort(self.block, kind="stable"), np.bincount(self.block)
        place = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        blocks = np.zeros((len(sizes), int(sizes.max()), columns.shape[1]))
        blocks[self.block[order], place] = columns[order]
        return blocks

    def _squares(self, residual: Array, basis: Array) -> Array:
        """Of each record (N), what the fit takes up counted."""
        leverage = np.sum(basis[self.rows.by_record] ** 2, axis=2)
        return np.asarray(np.mean(residual[self.rows.by_record] ** 2 / np.maximum(1 - leverage, _LEAST_LEFT), axis=1))

    def _of_scatter(self, residual: Array, basis: Array, draws: int) -> Array:
        """P-values of what squares of residuals may depend on, and of the same in random order (things x 1 + draws)."""
        squares, random = self._squares(residual, basis), np.random.default_rng(1)
        spread = float(squares.std())
        if not self.scatters or not spread:
            return np.ones((len(self.scatters), 1 + draws))
        orders = np.array([np.arange(len(squares)), *(random.permutation(len(squares)) for _ in range(draws))])
        centred = ((squares - squares.mean()) / spread)[orders]
        things = np.array([(f - f.mean()) / f.std() for _, f in self.scatters])
        return np.asarray(np.maximum(chdtrc(1, (things @ centred.T) ** 2 / len(squares)), SMALLEST))

    def _scatter(self, last: Tried, residual: Array, basis: Array) -> Scatter | None:
        if last.scatter_p.min(initial=1.0) > LEVEL:
            return None
        squares = self._squares(residual, basis)
        explained = np.array([np.corrcoef(squares, f)[0, 1] ** 2 for _, f in self.scatters])
        best, gains = int(np.argmax(explained)), -0.5 * len(squares) * np.log1p(-np.minimum(explained, 1 - 1e-12))
        close = [i for i in np.argsort(-gains) if i != best and gains[i] > gains[best] - CLEAR]
        thirds = np.array_split(np.argsort(self.scatters[best][1], kind="stable"), 3)
        low, high = (float(np.sqrt(np.mean(squares[part]))) for part in (thirds[0], thirds[-1]))
        words = tuple(self.scatters[i][0] for i in (best, *close))
        return Scatter(words[0], float(last.scatter_p[best]), low, high, words[1:])

    def _predicted(self, residual: Array, basis: Array) -> Predicted:
        order = np.arange(len(self.pose), dtype=float)[:, None]
        shares, odds, functions = dict[str, float](), dict[str, float](), dict[str, Array]()
        for name, of in (("pose", self.recorded.of_pose), ("time", self.recorded.of_time)):
            smooth = Smooth.of(of, basis)
            function, shares[name] = smooth.predicted(residual, self.groups)
            odds[name] = smooth.evidence(residual)
            functions[name] = function[self.rows.by_record]
        of_pose, of_time = self.recorded.of_pose[0], self.recorded.of_time[0]
        imitated = of_pose.imitate(functions["time"])
        if imitated < _IMITATED and (of_order := of_pose.imitate(order)) > _IN_ORDER:
            imitated = of_order
        by_pose = of_time.imitate(functions["pose"])
        return Predicted(shares["pose"], shares["time"], odds["pose"], odds["time"], imitated, by_pose)

    def _share_of(self, functions: Functions, residual: Array, basis: Array) -> float:
        return Smooth.of([functions], basis).predicted(residual, self.groups)[1]

    def _carriers(self, residual: Array, basis: Array, whole: Predicted) -> Iterator[Carrier]:
        """What predicts it, one after another, each that which predicts most beside the ones before it. Time is one of
        them only where it predicts more than all others: of poses in an order it predicts much."""
        inputs, taken, so_far = self.recorded.inputs, list[int](), 0.0
        possible = {i for i, own in enumerate(inputs) if own.kind != "time" or whole.by_time > whole.by_pose}
        while possible and len(taken) < _MOST_CARRIERS:
            reached = {i: self._share_of(self.recorded.functions([*taken, i]), residual, basis) for i in possible}
            best = max(reached, key=lambda i: reached[i])
            if taken and reached[best] - so_far < _NEXT_CARRIER * whole.share:
                break
            yield Carrier(inputs[best].kind, inputs[best].words, reached[best] - so_far)
            possible.discard(best)
            taken, so_far = [*taken, best], reached[best]

    def _repeats(self) -> Repeats | None:
        by_record, size = self.rows.by_record, np.bincount(self.pose)
        again = int(np.sum(size - 1))
        if again < _FEWEST_REPEATS:
            return None
        own = np.array([self.residual[by_record[self.pose == number]].mean(axis=0) for number in range(len(size))])
        off = np.zeros_like(self.residual)
        off[by_record] = self.residual[by_record] - own[self.pose]
        acting = int(np.sum(np.any(self.residual[by_record] != 0, axis=0)))
        spare, pure = again * acting, float(off @ off)
        lacking = len(self.pose) * acting - self.basis.shape[1] - spare
        lack = max(float(np.sum(self.residual[by_record] ** 2)) - pure, 0.0)
        ratio = lack / max(lacking, 1) / max(pure / spare, SMALLEST)
        return Repeats(
            float(np.sqrt(np.sum(self.rows.errors(off) ** 2) / again)) * _MM,
            float(np.sqrt(np.mean(self.rows.errors(self.residual) ** 2))) * _MM,
            again + int(np.sum(size > 1)),
            int(np.sum(size > 1)),
            float(fdtrc(lacking, spare, ratio)) if lacking > 0 else 1.0,
        )

    def _settled(self, chosen: Mapping[int, float], worth: float) -> dict[int, tuple[float, float, tuple[str, ...]]]:
        """Causes with p-value, share of the odds and alternatives, each beside the others: the likeliest in its place.

        None that chance beats, and none with less than 1 % of the odds. The best of many causes is significant in some
        recordings of nothing but noise; ``worth`` is how much of a record each is, where neighbours err alike.
        """
        settled, p_values = list(chosen), list(chosen.values())
        while True:
            for _ in range(len(settled)):
                before = list(settled)
                for place in range(len(settled)):
                    others = settled[:place] + settled[place + 1 :]
                    settled[place] = int(np.argmax(self._gains(*self.beside(others), others, worth)))
                if settled == before:
                    break
            odds = [self._odds(cause, [o for o in settled if o != cause], worth) for cause in settled]
            of_chance, shares = [own[2] for own in odds], [own[0] for own in odds]
            if settled and max(of_chance) > _LIKELIER:
                least = int(np.argmax(of_chance))
            elif settled and min(shares) < _HOPELESS:
                least = int(np.argmin(shares))
            else:
                named = zip(settled, p_values, odds, strict=True)
                return {i: (p, share, alternatives) for i, p, (share, alternatives, _) in named}
            del settled[least], p_values[least]

    def _odds(self, cause: int, others: Sequence[int], worth: float) -> tuple[float, tuple[str, ...], float]:
        """A cause's share of the odds of all, beside others in the model; what it does not beat 20 to 1; chance's."""
        residual, basis = self.beside(others)
        gains = self._gains(residual, basis, others, worth)
        shown = dict.fromkeys(self.names, -np.inf)
        for name, gain in zip(self.names, gains, strict=True):
            shown[name] = float(np.logaddexp(shown[name], gain - np.log(self.names.count(name))))
        mine, of_pose = self.names[cause], self.recorded.of_pose
        for words, functions in ((UNLISTED, of_pose), (CHANGING, self.recorded.of_time)):
            shown[words] = max(shown.get(words, -np.inf), worth * Smooth.of(functions, basis).evidence(residual))
        # What is none of the causes cannot be excluded where what is left is far from noise or follows the pose, or
        # poses were in order.
        after, whole = self.beside([*others, cause])
        beyond = float(after @ after) - chdtri(len(after) - whole.shape[1], _BEYOND)
        share = beyond / max(float(residual @ residual - after @ after), SMALLEST)
        left = share > _NEGLIGIBLE
        left = left or (share > _LEAST_LEFT_OVER and Smooth.of(of_pose, whole).evidence(after) * worth > CLEAR)
        timely = self.causes[cause].jumps or self.causes[cause].kind == "order"
        if left or (timely and of_pose[0].imitate((residual - after)[self.rows.by_record]) > _IMITATED):
            shown[UNLISTED] = max(shown[UNLISTED], shown[mine])
        shown[CHANCE] = float(np.log(len(self.causes)))  # nothing is as likely beforehand as all causes together
        total = float(np.logaddexp.reduce(list(shown.values())))
        close = [name for name, gain in shown.items() if gain > shown[mine] - CLEAR and name != mine]
        of_name = dict(zip(reversed(self.names), [c.words for c in reversed(self.causes)], strict=True))
        alternatives = tuple(of_name.get(name, name) for name in sorted(close, key=lambda name: -shown[name]))
        return float(np.exp(shown[mine] - total)), alternatives, float(np.exp(shown[CHANCE] - total))

    def _gains(self, residual: Array, basis: Array, others: Sequence[int], worth: float) -> Array:
        total, freedom = max(float(residual @ residual), SMALLEST), len(residual) - basis.shape[1]
        gains = np.full(len(self.causes), -np.inf)
        for i in set(range(len(self.causes))) - set(others):
            own = own_basis(self.columns[i], basis)[0]
            if own.shape[1]:
                left = max(1 - float(np.sum((own.T @ residual) ** 2)) / total, 1e-12)
                gains[i] = -0.5 * worth * freedom * np.log(left)
                gains[i] -= 0.5 * own.shape[1] * np.log(max(freedom * worth, 2.0))
        return gains

    def _structure(self, cause: int, others: Sequence[int], modelled: Collection[str], *odds: Any) -> Structure:
        one, (residual, basis) = self.causes[cause], self.beside(others)
        own, coefficients = own_basis(self.columns[cause], basis)
        effect = one.effect
        if effect.split(" ")[0] in modelled:
            effect += " (it is in the model: free it, or loosen its prior)"
        share = float(np.sum((own.T @ residual) ** 2) / max(float(residual @ residual), SMALLEST))
        left, fold = residual.copy(), self.block * _FOLDS // self.blocks
        for number in range(_FOLDS):  # coefficients without the part of the recording that is judged
            judged = fold == number
            gram = own[~judged].T @ own[~judged]
            ridge = 1e-9 * max(float(np.trace(gram)), SMALLEST) * np.eye(len(gram))
            left[judged] -= own[judged] @ np.linalg.solve(gram + ridge, own[~judged].T @ residual[~judged])
        falls = float(np.mean(self.rows.errors(residual)) - np.mean(self.rows.errors(left)))
        size = _size(one, -coefficients @ (own.T @ residual))
        named, (p_value, *whose) = (one.kind, one.subject, one.words, effect, one.measure), odds
        return Structure(*named, p_value, share, max(0.0, falls) * _MM, size, *whose)


def _by_spread(products: Array) -> Array:
    """Sums over blocks by their own spread (blocks x bases x k x m; bases x m)."""
    total, size = products.sum(axis=0), products.shape[2]  # bases x k x m
    spread = np.empty((*total[:, 0].shape, size, size))
    for i, j in zip(*np.tril_indices(size), strict=True):
        spread[..., i, j] = spread[..., j, i] = np.einsum("bmd,bmd->md", products[:, :, i], products[:, :, j])
    floor = 1e-12 * np.trace(spread, axis1=2, axis2=3) + SMALLEST
    if size == 1:
        return np.asarray(total[:, 0] ** 2 / (spread[..., 0, 0] + floor))
    sums = total.transpose(0, 2, 1)
    solved = np.linalg.solve(spread + floor[..., None, None] * np.eye(size), sums[..., None])[..., 0]
    return np.asarray(np.sum(sums * solved, axis=2))


def _size(one: Cause, coefficients: Array) -> str:
    """Its coefficients in a customary unit, of levels the largest."""
    if not one.labels or not one.unit:
        return ""
    numbers, shown = [float(number) for number in coefficients[: len(one.labels)]], list[str]()
    if one.kind == "delay":
        late_ms = float(f"{1000 * numbers[0]:.2g}")
        return f"joints {'late' if late_ms > 0 else 'early'} by about {abs(late_ms):g} ms, to first order"
    for number in numbers:
        value, unit = (100 * number, "%") if one.unit == "1" else Measure(one.unit, 1.0).shown(number)
        shown.append(f"{value:.2g} {unit}")
    if one.kind == "level":
        largest = int(np.argmax(np.abs(numbers)))
        return f"{shown[largest]} off at {one.labels[largest]}, beside its other levels"
    return ", ".join(f"{label}: {size}" for label, size in zip(one.labels, shown, strict=True))


_MOST_TOLD = 5
_LIKELY = 0.05  # A cause with less of the odds is not named first
_NO_NOISE = 0.01  # Of the declared noise: residuals below it are a simulation's without noise


def depends(fit: Fit) -> list[Finding]:
    if not fit.converged:
        return []
    outcome, unit = fit.of(structure), fit.unit
    if outcome is None:
        text = "The training records are too few to tell whether the model lacks anything."
        return [Finding("note", text, f"at least {FEWEST_RECORDS} records", "Measure more poses.")]
    blocks = f", blocks of {outcome.block} records" if outcome.block > 1 else ""
    test = f"residuals with random signs, {100 * outcome.level:g} % over all {outcome.tested} causes{blocks}"
    kept = outcome.worthwhile
    findings = [_cause_finding(s, outcome, unit, f"score test, {test}") for s in kept]
    if outcome.predictable is not None:
        findings.append(_rest_finding(outcome.predictable, outcome, test))
    elif not kept:
        text = f"None of the {outcome.tested} causes that were tested explains the remaining error."
        if outcome.structures:
            few = len(outcome.structures)
            text += f" {few} {'would' if few == 1 else 'would each'} lower it by less than 1 %."
        findings.append(Finding("good", text, test))
    if kept and outcome.more:
        text = "Residuals depend on more than these; model them first, then look again."
        findings.append(Finding("note", text, test))
    if outcome.poses < FEWEST_POSES:
        text = "There are too few distinct poses to test whether the pose still predicts the residuals."
        findings.append(Finding("note", text, f"at least {FEWEST_POSES} distinct poses", "Measure more poses."))
    scatter = outcome.noise
    if scatter is not None and scatter.high >= _NO_NOISE:
        on = "; or on ".join([scatter.words, *scatter.alternatives[:_MOST_TOLD]])
        text = f"The spread of the residuals depends on {on}: from {digits(scatter.low, 2)} to "
        text += f"{digits(scatter.high, 2)} times the declared noise, in the thirds of the records with the least and "
        text += "the most of it. Either the noise varies, or the model errs more there."
        test = f"regression of squared residuals, p {_p(scatter.p_value)}; {test}"
        action = "Repeat a pose at both ends of it: if repeats spread equally, the model is the cause; else state noise"
        findings.append(Finding("warning", text, test, f"{action} by record."))
    return findings


def _cause_finding(s: Structure, outcome: ResidualStructure, unit: str, test: str) -> Finding:
    """One cause if it is clearly the likeliest, else all that it does not beat."""
    falls = f"the mean training residual of {readable(outcome.mean_mm)} {unit} would fall by {readable(s.falls_mm)} "
    falls, what = falls + unit, s.words + (f" ({s.size})" if s.size else "")
    test = f"p {_p(s.p_value)}, {test}; odds among all of them and what is none of them"
    odds = "over 99 %" if s.odds > 0.99 else "less than 1 %" if s.odds < 0.01 else f"{100 * s.odds:.0f} %"
    if not s.alternatives:
        model = f"Model it: {s.effect}. " if s.effect else "No effect of armcal models this. "
        text = f"Residuals still depend on {what}: modelled, {falls}. It has {odds} of the odds."
        return Finding("warning", text, test, f"{model}To be sure: {s.measure}.")
    named = [what, *s.alternatives] if s.odds >= _LIKELY else [s.alternatives[0], what, *s.alternatives[1:]]
    more = len(named) - _MOST_TOLD
    text = f"Residuals still depend on {'; or on '.join(named[:_MOST_TOLD])}"
    text += f"; or on {more} more (metrics.json). " if more > 0 else ". "
    text += f"These data do not identify which. Modelled as {s.words}, which has {odds} of the odds, {falls}."
    model = f" Then model it: {s.effect}." if s.effect and s.kind not in ("order", "step") else ""
    return Finding("warning", text, test, f"To find out: {s.measure}.{model}")


def _rest_finding(rest: Predicted, outcome: ResidualStructure, test: str) -> Finding:
    """What neither noise nor a cause explains: whether the pose predicts it, or time, or either."""
    test = f"smooth functions of {outcome.poses} poses, each predicted by the others; {test}"
    test += f"; log odds against noise: pose {rest.pose:.0f}, time {rest.time:.0f}"
    if rest.share <= 0:
        text = f"Residuals of neighbouring records correlate by {outcome.lag_after:.2f}: they are not noise."
    else:
        names = [carrier.words for carrier in rest.carriers]
        listed = " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
        text = f"{percent(outcome.share)} of the variance of the residuals is not noise: other records predict it, "
        if outcome.worthwhile:
            text = f"Beside what is named, other records predict {percent(rest.share)} of the residuals, "
        text += f"mostly from {listed}."
    text += f" {_WHY[rest.cause]} the pose predicts {percent(rest.by_pose)} of them, time {percent(rest.by_time)}."
    if outcome.in_order:
        text += " The poses were visited in an order."
    action = "Model what is named above, then look again. " if outcome.worthwhile else ""
    slight = 1 - float(np.sqrt(max(0.0, 1 - outcome.share))) < WORTHWHILE  # of the root mean square
    return Finding("note" if slight else "warning", text, test, action + " ".join(_remedies(rest, outcome.learnable)))


def _remedies(rest: Predicted, learnable: bool | None) -> Iterator[str]:
    kinds = {carrier.kind for carrier in rest.carriers}
    if rest.cause == "open":
        yield "Repeat some of the first poses at the end: only time changes them. Visit others in random order."
    elif rest.cause == "time":
        yield "Let the base drift (parameters.drift); record the temperature, and repeat one pose from time to time."
    elif "joint" in kinds and learnable:
        yield "Learn it: arms.NAME.residual: {type: gaussian_process}; or free what armcal identify --fixed recommends."
    elif "joint" in kinds:
        if learnable is False:
            yield "A pose residual cannot learn it from these records: that takes positions or poses of the tool."
        yield "Free what armcal identify --fixed recommends, or add effects to these joints; more poses show more."
    others = {
        "temperature": "Add thermal_length, or measure at one temperature.",
        "payload": "Weigh the payload; add or free compliance.",
        "approach": "Add or free approach_backlash on these joints.",
    }
    yield from (text for kind, text in others.items() if kind in kinds)


_WHY = {
    "time": "It goes with time, not with the pose:",
    "pose": "It goes with the pose, not with time:",
    "open": "These data do not show whether the pose or time is the cause:",
}


def percent(share: float) -> str:
    if share <= 0:
        return "0 %"
    return f"{100 * share:.0f} %" if share >= 0.095 else f"{100 * share:.1g} %" if share > 0.0005 else "0.1 %"


def _p(p: float) -> str:
    return f"{p:.3f}" if p >= 0.01 else f"below {0.005 if p < 0.005 else 0.01:g}"


def repeated(fit: Fit) -> list[Finding]:
    outcome, unit = fit.of(structure), fit.unit
    if outcome is None or (repeats := outcome.repeats) is None or not repeats.exceeded:
        return []
    text = f"Repeats of a pose scatter by {readable(repeats.scatter_mm)} {unit}, residuals are "
    text += f"{readable(repeats.left_mm)} {unit} (root mean squares): "
    test = f"lack of fit, F over {repeats.records} records of {repeats.poses} poses, p {_p(repeats.p_value)}, and "
    test += f"{_TIMES_REPEATS:g} times"
    if outcome.shows:
        text += "the model lacks something, which poses nearby share."
        action = "Free what armcal identify --fixed recommends, add effects, and state masses for what sags."
    else:
        text += "the rest is no noise of the instrument, but the model's error, or what differs from stop to stop."
        action = "Drive to some poses again, from elsewhere: what then differs is the arm's."
    return [Finding("warning", text, test, action)]


def neighbours(fit: Fit) -> list[Finding]:
    outcome, estimate = fit.of(structure), fit.estimate
    if outcome is None:
        return []
    test = f"lag-one correlation, {100 * outcome.level:g} % over everything that was tested"
    if outcome.lag_p > outcome.level:
        return [Finding("good", "Residuals of neighbouring records do not correlate.", test)]
    text = f"Residuals of neighbouring records correlate by {outcome.lag_one:.2f}"
    if outcome.lag_after_p > outcome.level:
        return [Finding("note", f"{text}; what was found above explains it.", test)]
    text += f", by {outcome.lag_after:.2f} still beside what was found. " if outcome.structures else ". "
    if factors := estimate.widened:
        text += "Intervals that assume independent errors would be too narrow; those of the parameters are wider, by a "
        text += f"factor of {float(np.median(factors)):.1f} (median), at most {max(factors):.1f} "
        text += f"({estimate.names[int(np.argmax(factors))]})."
    else:
        text += "In the order in which these poses were measured that does not widen the intervals of the parameters."
    return [Finding("note", text, test)]
