"""Which postures agree with the others, what they determine, and what would help: judged anew with each that comes.

A quick fit takes all postures, whatever they determine: weak priors about the nominal values stand in for what they do
not, so that an unknown that is not determined yet makes the expected error large, not the answer impossible. A posture
is compared with what a fit without it expects there; it disagrees where chance would make it lie so far off once in a
hundred thousand postures (F, the noise being estimated). What disagrees takes no part in the fits that judge others.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.base.units import to_unit
from armcal.devices.live import LiveCamera
from armcal.diagnose.fit import widened
from armcal.diagnose.verdict import known_accuracies, own_deviations
from armcal.errors import ArmcalError, ConfigError, ProblemError
from armcal.estimate.estimator import Solution, SolverVerdict, estimate
from armcal.estimate.identifiability import (
    GIVE_A_LENGTH,
    UNSEEN_SCALE,
    InverseInformation,
    explain,
    identify_from,
    numerical_rank,
    scale_is_unseen,
)
from armcal.estimate.polish import descended, restricted, started
from armcal.estimate.robust import EFFICIENCY_OF_MEDIAN, studentised_distances
from armcal.estimate.start import Start, with_proposals
from armcal.measure.measurement import Measurement, Proposing
from armcal.planning.exchange import Suggestion, suggest
from armcal.problem.problem import PosedProblem, Problem
from armcal.problem.records import declared
from armcal.problem.variants import as_seen, factor_at_zero, with_joint_noise
from armcal.run.experiment import Experiment
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import fdtri

from armcal_bench.postures import Posture, dataset_of

_FAR = 100.0  # Ordinary sizes within which a group (a socket) is looked for
_MOST_STEPS, _DAMPING = 30, 1e-9
_AT_REST = 1e-5  # A step that lowers half the sum of squares by less than this part of it is the last
_POSE_NUMBERS = 6
"""Points of an image err alike, by an arm's error or a lens: they say no more of noise than the pose of the board."""
_DECLARED_COUNTS = 2.0  # The declared noise counts as so many numbers when the real one is estimated
_LEAST_SCALE = 0.05
_CHANCE = 1e-5  # For each posture is judged again and again
_LOOKED_AT = 1e-2  # A posture this unlikely is fitted without, to see
_MOST_DROPPED = 3  # Of few postures; of many a third


@dataclass(frozen=True)
class Offset:
    """How far a posture lies from where the others expect it, and its typical size; turns of free contacts are 0."""

    off_mm: float
    expected_mm: float
    off_deg: float = 0.0
    expected_deg: float = 0.0
    off_px: float = 0.0
    expected_px: float = 0.0

    def __str__(self) -> str:
        kinds = [("mm", self.off_mm, self.expected_mm), ("deg", self.off_deg, self.expected_deg)]
        kinds = [*kinds, ("px", self.off_px, self.expected_px)]
        parts = [f"{_short(off)} {unit} (expected {_short(known)})" for unit, off, known in kinds if known > 0]
        return " and ".join(parts) or "nothing"


def _short(number: float) -> str:
    return f"{number:.2g}" if number < 10 else f"{number:.0f}"


@dataclass(frozen=True)
class Fitted:
    values: Array
    half: Array  # a root of the covariance by coordinates (n x k)
    scale: float
    freedom: float  # how many numbers the noise was estimated from
    used: Mask  # which postures were fitted (N)


class QuickFitter:
    """A problem of some postures, compiled; fits of any of them, begun at the ``known`` values of an earlier fit."""

    def __init__(
        self,
        experiment: Experiment,
        contacts: dict[str, Measurement],
        dataset: Dataset,
        known: Mapping[str, tuple[float, ...]] = MappingProxyType({}),
    ) -> None:
        system = experiment.system
        parameters = experiment.parameters
        problem = Problem.build(system.arms, contacts, parameters, system.environment, dataset, "interpreted")
        problem, proposed = _placed(problem, dataset, known)
        problem = started(problem)
        self.problem = with_joint_noise(problem, problem.parameters.nominal())
        weak_priors = {
            block.name: replace(block, prior_sd=block.scale * (_FAR if block.nuisance or block.name in proposed else 1))
            for block in self.problem.parameters.free
            if block.prior_sd is None
        }
        self._weak = self.problem.with_parameters(self.problem.parameters.replaced(weak_priors))
        parameters, start = self._weak.parameters, self._weak.parameters.nominal()
        for block in parameters.free:
            if len(known.get(block.name, ())) == block.size:
                start[parameters.entries_of(block.name)] = known[block.name]
        self._start = start
        self._rows, self._numbers = np.zeros((2, len(dataset)))
        for kernel, record in zip(self._weak.kernels, self._weak.records, strict=True):
            rows = np.full(len(dataset), kernel.factor.rows)
            if record.present is not None:
                rows = record.present[:, : len(dataset)].sum(axis=0)
            rows = rows * (record.weight[: len(dataset)] > 0)
            self._rows += rows
            self._numbers += rows if kernel.points is None else np.minimum(rows, _POSE_NUMBERS)

    def free_values(self, fitted: Fitted) -> dict[str, tuple[float, ...]]:
        parameters = self._weak.parameters
        return {b.name: tuple(fitted.values[parameters.entries_of(b.name)].tolist()) for b in parameters.free}

    def fit(self, used: Mask, before: Fitted | None = None) -> Fitted:
        """Fit some of the postures (N), from where another fit ended."""
        parameters, problem = self._weak.parameters, _used(self._weak, used)
        posed = PosedProblem(problem)
        start = self._start if before is None else before.values
        x = parameters.local(start) / parameters.increment_scales()
        values = posed.values(descended(posed, x, _MOST_STEPS, _DAMPING, _AT_REST))
        triangle = problem.triangular_factor(values)
        spent, equations = InverseInformation.of(triangle, parameters).spent, problem.equations()
        freedom = max(equations - spent, 0.0) + _DECLARED_COUNTS
        squares = 2 * problem.cost(values)
        scale = max(float(np.sqrt((squares + _DECLARED_COUNTS) / freedom)), _LEAST_SCALE)
        independent = float(self._numbers[used].sum()) / max(equations, 1)
        root = InverseInformation.of(triangle / scale, parameters).root
        return Fitted(values, root, scale, freedom * min(independent, 1.0), used)

    def agreeing(self, groups: Sequence[str], doubtful: Collection[int] = ()) -> Fitted:
        """A fit of the postures that agree; of ``groups`` (N) with one posture none can be compared.

        It is begun without the newest and those in doubt before (places), for several wrong ones hide each other; and
        with all, for what once was outvoted may be right.
        """
        names, unlikely = np.array(groups, dtype=object), -np.log(_CHANCE)
        kept, anew = (self._trimmed(names, aside) for aside in ({*doubtful, len(names) - 1}, ()))
        scores = [self._numbers.sum() * np.log(one.scale) + unlikely * np.sum(~one.used) for one in (kept, anew)]
        return anew if scores[1] < scores[0] - 1 else kept

    def _trimmed(self, names: NDArray[np.object_], aside: Collection[int]) -> Fitted:
        places = np.arange(len(names))
        fitted = self.fit(~np.isin(places, list(aside)))
        for _ in range(max(_MOST_DROPPED, len(names) // 3)):
            weights = [fitted.used.astype(float)] * len(self._weak.records)
            far = studentised_distances(self._weak, fitted.values, weights)
            squares = np.sum(np.square(far.studentised), axis=0) * self._numbers / np.maximum(self._rows, 1)
            alike = np.array([np.sum((names == name) & fitted.used) for name in names])
            limits = _limit(self._numbers, EFFICIENCY_OF_MEDIAN * fitted.freedom, _LOOKED_AT)
            ratios = np.where(fitted.used & (alike > 1), squares / limits, 0.0)
            worst = int(np.argmax(ratios))
            if ratios[worst] <= 1:
                break
            fitted = self.fit(fitted.used & (places != worst), fitted)
        back = [one for one in np.flatnonzero(~fitted.used).tolist() if not self.compared(fitted, one)[1]]
        return self.fit(fitted.used | np.isin(places, back), fitted) if back else fitted

    def compared(self, fitted: Fitted, one: int) -> tuple[Offset, bool]:
        """How a posture lies that was not fitted, and whether it disagrees."""
        problem = self._weak.subset(np.array([one], dtype=np.intp))
        to_half = self._weak.parameters.entries_jacobian(fitted.values) @ fitted.half
        factors = zip(
            [kernel.factor for kernel in problem.kernels],
            problem.records,
            problem.whitened_residuals(fitted.values),
            problem.jacobians(fitted.values),
            strict=True,
        )
        residuals, reaches, whitenings = [], [], []
        dimensions: list[str] = []
        for factor, record, residual, jacobian in factors:
            if record.weight[0] > 0:
                there = np.ones(len(residual), dtype=bool) if record.present is None else record.present[:, 0]
                own = declared(factor.noise) if record.whitening is None else record.whitening[:, :, 0]
                residuals.append(residual[there, 0])
                reaches.append(jacobian[there, :, 0] @ to_half)
                whitenings.append(own[np.ix_(there, there)])
                dimensions += list(np.array(factor.dimensions)[there])
        whitened, reach = np.concatenate(residuals), np.concatenate(reaches)
        covariance = fitted.scale**2 * np.eye(len(whitened)) + reach @ reach.T
        square, numbers = float(whitened @ np.linalg.solve(covariance, whitened)), self._numbers[one]
        back = np.linalg.inv(block_diag(*whitenings))
        offset = _offset(back @ whitened, np.diag(back @ covariance @ back.T), np.array(dimensions))
        return offset, bool(square * numbers / len(whitened) > _limit(numbers, fitted.freedom, _CHANCE))


def _used(problem: Problem, used: Mask) -> Problem:
    return problem.weighted([used.astype(float)] * len(problem.records))


def _limit(numbers: Array, freedom: float, chance: float) -> Array:
    """Of the squared distance of so many numbers, in units of what is expected."""
    numbers = np.maximum(numbers, 1.0)
    return np.asarray(numbers * fdtri(numbers, max(freedom, 1.0), 1.0 - chance))


def _offset(residual: Array, variances: Array, dimensions: Array) -> Offset:
    numbers = []
    for dimension, unit in (("length", "mm"), ("angle", "deg"), ("image", "px")):
        own = dimensions == dimension
        points = max(np.sum(own) / 2, 1) if dimension == "image" else 1
        squares = np.sum(residual[own] ** 2) / points, np.sum(variances[own]) / points
        numbers += [to_unit(float(np.sqrt(square)), unit) for square in squares]
    return Offset(*map(float, numbers))


def _placed(
    problem: Problem, dataset: Dataset, known: Mapping[str, tuple[float, ...]]
) -> tuple[Problem, frozenset[str]]:
    """The problem about what instruments find by themselves of their free parameters, and the names of these."""
    finders = [name for name, m in problem.blueprint.measurements.items() if isinstance(m, Proposing)]
    own = [b for b in problem.parameters.free if b.prior_sd is None and b.name.partition(".")[0] in finders]
    if not own:
        return problem, frozenset()
    if all(len(known.get(block.name, ())) == block.size for block in own):
        parameters, nominal = problem.parameters, problem.parameters.nominal()
        for block in own:
            nominal[parameters.entries_of(block.name)] = known[block.name]
        problem = problem.with_parameters(parameters.with_nominal(nominal))
    else:
        start = with_proposals(Start(problem), dataset)
        if not start.taken:
            raise ProblemError(
                "the images are too few to find the camera by.", hint="Take more, each turned otherwise."
            )
        problem = start.problem
    return problem, frozenset(block.name for block in own)


_FEW = 6  # So many undetermined combinations are named at most: to name many takes long, and helps little
_TURN = np.radians(25.0)
_SLIDE = 0.05
_ABOUT = 6  # So many of the newest postures are varied, joint by joint
_RIDGE = 1e-6
_WORTH = 0.7  # Joints that add nearly as much as the best one are named too
_MOST_NAMED = 3
_QUICK = SolverVerdict("quick fit", "ended", True, 0, 0.0)
_UNFIT = (ArmcalError, ArithmeticError, ValueError)  # Faults of postures that no fit can take


@dataclass(frozen=True)
class Knowledge:
    """What is known, counted as ``armcal identify`` counts."""

    rank: int  # determined combinations
    free: int  # of so many numbers
    records: int  # how many postures train
    missing: tuple[str, ...]  # the undetermined combinations, once they are few
    vary: tuple[str, ...]  # joints that would add most if they were moved more, the best first


def _joints_to_vary(problem: Problem, dataset: Dataset, scaled: Array, rank: int) -> tuple[str, ...]:
    """Joints whose motion from the newest postures, the contact kept, adds most information (log determinant)."""
    joints = command_channels(problem.blueprint.arms)
    newest = range(max(0, len(dataset) - _ABOUT), len(dataset))
    both = replace(dataset.subset([*newest, *newest]), ids=tuple(str(i) for i in range(2 * len(newest))))
    signs = np.repeat([1.0, -1.0], len(newest))
    scales, values = problem.parameters.scales(), problem.parameters.nominal()
    base = scaled.T @ scaled
    base += np.eye(len(scales)) * _RIDGE * max(float(np.trace(base)) / max(rank, 1), 1e-300)
    gains: dict[str, float] = {}
    for channel, kind in joints.items():
        try:
            step = _TURN if kind == "angle" else _SLIDE
            channels = {**both.channels, channel: both.column(channel) + step * signs}
            seen, _ = as_seen(problem, values, replace(both, channels=channels))
            rows = factor_at_zero(problem.of(seen), values) * scales
        except ArmcalError:
            continue
        gains[channel] = float(np.linalg.slogdet(base + rows.T @ rows)[1] - np.linalg.slogdet(base)[1])
    best = max(gains.values(), default=0.0)
    ranked = sorted((c for c, gain in gains.items() if gain > _WORTH * best > 0), key=lambda c: -gains[c])
    alone = len(problem.blueprint.arms) == 1
    return tuple(c.partition(".")[2] if alone else c for c in ranked[:_MOST_NAMED])


@dataclass(frozen=True)
class Assessment:
    newest: Offset | None = None  # of the last posture; None where there is nothing to compare it with
    doubts: Mapping[str, Offset] = field(default_factory=dict)  # postures that disagree, by name
    known: Knowledge | None = None  # what is determined; None if that could not be judged
    why_not: str = ""  # why not, a sentence
    accuracy: tuple[str, ...] = ()  # of what an instrument's user wants to know, a sentence a measurement
    deviations: Mapping[str, float] = field(default_factory=dict)  # of the instruments' own coordinates (SI)
    next: Suggestion | None = None  # the posture that would help most; None where none is better than others


def contacts_of(experiment: Experiment, camera: LiveCamera | None) -> dict[str, Measurement]:
    """The measurements for which a posture, and a camera's image of it, is all there is to measure."""
    seen = "" if camera is None else camera.measurement
    measurements = {n: m for n, m in experiment.system.measurements.items() if n == seen or not m.channels()}
    if not measurements:
        raise ConfigError(
            "found no measurement that joint angles alone make.",
            where=experiment.source.where(("measurements",)),
            hint="Configure what the arm touches: ball_in_socket, clamped_tool, plane_contact or closed_chain. "
            "With a camera give --camera. What a tracker measures, armcal acquire measures.",
        )
    return measurements


class Assessor:
    def __init__(self, experiment: Experiment, camera: LiveCamera | None) -> None:
        self._experiment, self._contacts = experiment, contacts_of(experiment, camera)
        self._doubtful: Collection[str] = ()
        self._values: Mapping[str, tuple[float, ...]] = {}

    def assessed(self, postures: Sequence[Posture]) -> Assessment:
        if not postures:
            return Assessment()
        try:
            experiment, dataset, fitter = self._fitter(postures)
            groups = [posture.place for posture in postures]
            known = self._known(experiment, fitter.problem, dataset)
            if len(postures) == 1:
                return Assessment(known=known)
            fitted = fitter.agreeing(groups, [i for i, one in enumerate(postures) if one.name in self._doubtful])
            doubts = {postures[i].name: fitter.compared(fitted, i)[0] for i in np.flatnonzero(~fitted.used).tolist()}
            newest, last, others = doubts.get(postures[-1].name), len(postures) - 1, fitted.used.copy()
            others[last] = False
            if newest is None and groups[-1] in np.array(groups, dtype=object)[others]:
                newest = fitter.compared(fitter.fit(others), last)[0]
            self._doubtful, self._values = tuple(doubts), fitter.free_values(fitted)
            return _advised(Assessment(newest, doubts, known), fitter.problem, fitted, dataset)
        except _UNFIT as fault:  # what was captured is safe, and so is what comes
            return Assessment(why_not=str(fault))

    def explained(self, postures: Sequence[Posture]) -> tuple[str, ...]:
        """Everything that is not determined, or hardly, with why: gauges too, which no posture would determine."""
        if not postures:
            return ()
        try:
            experiment, dataset, fitter = self._fitter(postures)
            problem = restricted(fitter.problem.subset(_training(experiment, dataset)))
            if not problem.parameters.free:
                return ()
            values = problem.parameters.nominal()
            known = identify_from(factor_at_zero(problem, values), problem.parameters)
            lines = [str(undetermined) for undetermined in explain(problem, values, known)]
            if scale_is_unseen(problem, values, known):
                lines.insert(0, f"{UNSEEN_SCALE}; {GIVE_A_LENGTH}")
        except _UNFIT as fault:
            return (str(fault),)
        return (*lines, *(f"{name}: hardly determined (sd {sd:.2g} typical scales)" for name, sd in known.hardly))

    def _known(self, experiment: Experiment, problem: Problem, dataset: Dataset) -> Knowledge:
        train = _training(experiment, dataset)
        problem = restricted(problem.subset(train))
        if not problem.parameters.free:
            return Knowledge(0, 0, len(train), (), ())
        triangle = factor_at_zero(problem, problem.parameters.nominal())
        scaled = triangle * problem.parameters.scales()
        rank, free = numerical_rank(scaled), scaled.shape[1]
        missing: tuple[str, ...] = ()
        if free - rank <= _FEW:
            missing = tuple(map(str, identify_from(triangle, problem.parameters).undetermined))
        return Knowledge(rank, free, len(train), missing, _joints_to_vary(problem, dataset.subset(train), scaled, rank))

    def _fitter(self, postures: Sequence[Posture]) -> tuple[Experiment, Dataset, QuickFitter]:
        dataset = dataset_of(postures)
        experiment = self._experiment.of_records(dataset)
        return experiment, dataset, QuickFitter(experiment, self._contacts, dataset, self._values)


def _training(experiment: Experiment, dataset: Dataset) -> Indices:
    """The postures that would train a run; all, while those that it asks for are not there."""
    try:
        train = experiment.split(dataset).train
    except ArmcalError:
        train = np.arange(0, dtype=np.intp)
    return train if len(train) else np.arange(len(dataset), dtype=np.intp)


def _advised(judged: Assessment, problem: Problem, fitted: Fitted, dataset: Dataset) -> Assessment:
    """With how well an instrument's place is known, and what to take next; nothing of contacts, which only few postures
    can make."""
    if not all(kernel.factor.output_channels for kernel in problem.kernels) or not problem.parameters.free:
        return judged
    acting = _used(problem, fitted.used)
    made = widened(acting, estimate(acting, Solution(fitted.values, _QUICK)), np.arange(len(dataset)))
    joints = command_channels(problem.blueprint.arms)
    best = suggest(problem, dataset.subset(np.flatnonzero(fitted.used)), made, joints, 1)
    own = {f"{n}.{local}": sd for n in problem.blueprint.measurements for local, sd in own_deviations(made, n).items()}
    finite = {name: sd for name, sd in own.items() if np.isfinite(sd) and sd > 0}
    accuracy = tuple(known_accuracies(problem, made))
    return replace(judged, accuracy=accuracy, deviations=finite, next=best[0] if best else None)
