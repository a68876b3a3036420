"""Which postures agree with the others, judged anew with each posture that comes.

A posture is compared with what a fit without it expects there; it disagrees where chance would make it lie so far off
once in ten thousand postures (F, the noise being estimated). In a group where more postures disagree than agree the
majority is right. What disagrees takes no part in the fits that judge the others.

A quick fit of the postures so far, whatever they determine, and what it predicts of a posture that it did not see.

Weak priors about the nominal values stand in for what the postures do not determine: an unknown that is not determined
yet makes the expected error large, not the answer impossible.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Self

import numpy as np
from armcal.base.arrays import Array, Mask
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
from armcal.estimate.start import Start, with_proposals
from armcal.estimate.validation import hold_out
from armcal.measure.instrument import Proposing
from armcal.measure.measurement import Measurement
from armcal.planning.suggestion import suggest
from armcal.problem.problem import PosedProblem, Problem
from armcal.problem.records import declared
from armcal.problem.variants import as_seen, factor_at_zero, with_joint_noise
from armcal.run.experiment import Experiment
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import fdtri

from armcal_bench.recording.recording_log import Posture, dataset_of
from armcal_bench.recording.window import JointKinds

_FAR = 100.0  # Ordinary sizes within which a group (a socket) is looked for
_MOST_STEPS = 30
_DAMPING = 1e-9
_AT_REST = 1e-5  # A step that lowers half the sum of squares by less than this part of it is the last
_LEAST_LEFT = 1e-6
_POSE_NUMBERS = 6
"""Points of an image err alike, by an arm's error or a lens: they say no more of noise than the pose of the board."""
_DECLARED_COUNTS = 2.0  # The declared noise counts as so many numbers when the real one is estimated
_LEAST_SCALE = 0.05


@dataclass(frozen=True)
class PredictedResidual:
    """What a fit predicts of one posture that it did not see."""

    residual: Array  # raw (n; SI)
    covariance: Array  # of it, parameters and noise together (n x n)
    distance: float  # squared, in units of it, of so many ``numbers``: the entries, or fewer where these err alike
    numbers: int
    dimensions: NDArray[np.str_]  # of each entry (n): ``length``, ``angle``, ``image``


@dataclass(frozen=True)
class Fitted:
    """Values, how sure their coordinates are, and the noise found in units of the declared one."""

    values: Array
    half: Array  # a root of the covariance by coordinates (n x k)
    scale: float
    freedom: float  # how many numbers the noise was estimated from
    used: Mask  # which postures were fitted (N)


class QuickFitter:
    """A problem of some postures, compiled; fits of any of them are solved one after the other.

    Args:
        experiment: with the parameters that the groups of the postures bring.
        contacts: the measurements that joints alone make.
        dataset: the postures.
        known: values of an earlier fit, by parameter, where it begins; those that are not named begin where they are.

    Raises:
        NotConvergedError: a posture has no elastic equilibrium.
        ProblemError: the postures leave open what an instrument finds by itself.
    """

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
        self._x = parameters.local(start) / parameters.increment_scales()

    def free_values(self, fitted: Fitted) -> dict[str, tuple[float, ...]]:
        parameters = self._weak.parameters
        return {b.name: tuple(fitted.values[parameters.entries_of(b.name)].tolist()) for b in parameters.free}

    def fit(self, used: Mask) -> Fitted:
        """Fit some of the postures (N), from where the last fit ended."""
        parameters = self._weak.parameters
        problem = _used(self._weak, used)
        posed = PosedProblem(problem)
        self._x = descended(posed, self._x, _MOST_STEPS, _DAMPING, _AT_REST)
        values = posed.values(self._x)
        triangle = problem.triangular_factor(values)
        spent, equations = InverseInformation.of(triangle, parameters).spent, problem.equations()
        freedom = max(equations - spent, 0.0) + _DECLARED_COUNTS
        squares = 2 * problem.cost(values)
        scale = max(float(np.sqrt((squares + _DECLARED_COUNTS) / freedom)), _LEAST_SCALE)
        independent = sum(self._numbers(one) for one in np.flatnonzero(used).tolist()) / max(equations, 1)
        root = InverseInformation.of(triangle / scale, parameters).root
        return Fitted(values, root, scale, freedom * min(independent, 1.0), used)

    def predicted(self, fitted: Fitted, one: int) -> PredictedResidual:
        """Of a posture that was not fitted."""
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
        distance, numbers = float(whitened @ np.linalg.solve(covariance, whitened)), self._numbers(one)
        back = np.linalg.inv(block_diag(*whitenings))
        distance *= numbers / len(whitened)
        return PredictedResidual(back @ whitened, back @ covariance @ back.T, distance, numbers, np.array(dimensions))

    def _numbers(self, one: int) -> int:
        count = 0
        for kernel, record in zip(self._weak.kernels, self._weak.records, strict=True):
            if record.weight[one] > 0:
                rows = kernel.factor.rows if record.present is None else int(record.present[:, one].sum())
                count += rows if kernel.points is None else min(rows, _POSE_NUMBERS)
        return count

    def left_out(self, fitted: Fitted) -> dict[int, tuple[float, int]]:
        """Of each fitted posture how far it lies from a fit without it, to first order: the square in units of what is
        expected, and how many numbers that are."""
        to_half = self._weak.parameters.entries_jacobian(fitted.values) @ fitted.half / fitted.scale
        residuals, jacobians = self._weak.whitened_residuals(fitted.values), self._weak.jacobians(fitted.values)
        rows: dict[int, list[tuple[Array, Array]]] = {}
        for record, residual, jacobian in zip(self._weak.records, residuals, jacobians, strict=True):
            reach = np.einsum("rvb,vc->brc", jacobian, to_half)
            for one in np.flatnonzero(fitted.used & (record.weight[: record.count] > 0)).tolist():
                rows.setdefault(one, []).append((residual[:, one], reach[one]))
        distances = {}
        for one, parts in rows.items():
            whitened, taken_up = (np.concatenate(part) for part in zip(*parts, strict=True))
            remaining, directions = np.linalg.eigh(np.eye(len(whitened)) - taken_up @ taken_up.T)
            squares = (directions.T @ whitened) ** 2 / np.maximum(remaining, _LEAST_LEFT)
            numbers, there = self._numbers(one), max(int(np.sum(np.any(taken_up != 0, axis=1))), 1)
            distances[one] = float(squares.sum()) / fitted.scale**2 * numbers / there, numbers
        return distances


def _used(problem: Problem, used: Mask) -> Problem:
    """With nothing but some of the postures counted (N)."""
    return problem.weighted([used.astype(float)] * len(problem.records))


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


FEW = 6  # So many undetermined combinations are named at most
_TURN = np.radians(25.0)
_SLIDE = 0.05
_ABOUT = 6  # So many of the newest postures are varied, joint by joint
_RIDGE = 1e-6
_WORTH = 0.7  # Joints that add nearly as much as the best one are named too
_MOST_NAMED = 3
_QUICK = SolverVerdict("quick fit", "ended", True, 0, 0.0)


@dataclass(frozen=True)
class Knowledge:
    """What is known, counted as ``armcal identify`` counts.

    Attributes:
        rank, free: determined combinations, of so many numbers.
        missing: the undetermined combinations, once they are few: to name many takes long, and helps little.
    """

    rank: int
    free: int
    records: int  # how many postures train
    missing: tuple[str, ...]
    vary: tuple[str, ...]  # joints that would add most if they were moved more, the best first


def knowledge(experiment: Experiment, problem: Problem, dataset: Dataset) -> Knowledge:
    """Judge a dataset's postures, those that would train a run.

    Raises:
        ArmcalError: it cannot be judged.
    """
    train = _training(experiment, dataset)
    problem = restricted(problem.subset(train))
    if not problem.parameters.free:
        return Knowledge(0, 0, len(train), (), ())
    triangle = factor_at_zero(problem, problem.parameters.nominal())
    scaled = triangle * problem.parameters.scales()
    rank, free = numerical_rank(scaled), scaled.shape[1]
    missing: tuple[str, ...] = ()
    if free - rank <= FEW:
        missing = tuple(map(str, identify_from(triangle, problem.parameters).undetermined))
    return Knowledge(rank, free, len(train), missing, _joints_to_vary(problem, dataset.subset(train), scaled, rank))


def explained(experiment: Experiment, problem: Problem, dataset: Dataset) -> tuple[str, ...]:
    """Everything that is not determined, or hardly, with why: gauges too, which no posture would determine.

    Raises:
        ArmcalError: it cannot be judged.
    """
    problem = restricted(problem.subset(_training(experiment, dataset)))
    if not problem.parameters.free:
        return ()
    values = problem.parameters.nominal()
    known = identify_from(factor_at_zero(problem, values), problem.parameters)
    lines = [str(undetermined) for undetermined in explain(problem, values, known)]
    if scale_is_unseen(problem, values, known):
        lines.insert(0, f"{UNSEEN_SCALE}; {GIVE_A_LENGTH}")
    hardly = [f"{combination}: hardly determined (sd {sd:.2g} typical scales)" for combination, sd in known.hardly]
    return (*lines, *hardly)


def _training(experiment: Experiment, dataset: Dataset) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    settings, chosen = experiment.settings.validation, np.arange(len(dataset), dtype=np.intp)
    if settings.train_groups:
        labels = experiment.labels(dataset)
        chosen = np.flatnonzero([label in settings.train_groups for label in labels])
    elif settings.holdout and settings.train_ids is None and len(dataset) > 2:
        chosen = hold_out(len(dataset), settings.holdout, settings.seed, experiment.poses(dataset)).train
    return chosen if len(chosen) else np.arange(len(dataset), dtype=np.intp)


def _joints_to_vary(problem: Problem, dataset: Dataset, scaled: Array, rank: int) -> tuple[str, ...]:
    """Joints whose motion from the newest postures, the contact kept, adds most information (log determinant)."""
    joints = {
        f"{name}.{joint}": _TURN if kind == "angle" else _SLIDE
        for name, arm in problem.blueprint.arms.items()
        for joint, kind in arm.commanded.items()
    }
    newest = range(max(0, len(dataset) - _ABOUT), len(dataset))
    both = replace(dataset.subset([*newest, *newest]), ids=tuple(str(i) for i in range(2 * len(newest))))
    signs = np.repeat([1.0, -1.0], len(newest))
    scales, values = problem.parameters.scales(), problem.parameters.nominal()
    base = scaled.T @ scaled
    base += np.eye(len(scales)) * _RIDGE * max(float(np.trace(base)) / max(rank, 1), 1e-300)
    gains: dict[str, float] = {}
    for channel, step in joints.items():
        try:
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
class Advice:
    """What is known, and what would help.

    Attributes:
        deviations: standard deviations of the instruments' own coordinates (SI); finite ones alone.
    """

    accuracy: tuple[str, ...] = ()  # how well what a user wants to know is known, a sentence a measurement
    deviations: Mapping[str, float] = field(default_factory=dict)
    next: str = ""  # the posture that would help most, for people; empty where none is better than others
    commands: Mapping[str, float] = field(default_factory=dict)  # it, by channel (rad or m)
    shrink: float = 1.0  # what it would multiply standard deviations by, on average

    def fell_by(self, before: Self) -> float | None:
        """The share by which the instruments' standard deviations fell; None while nothing can be compared."""
        ratios = [sd / before.deviations[name] for name, sd in self.deviations.items() if name in before.deviations]
        return 1 - float(np.median(ratios)) if ratios else None


def advice(fitter: QuickFitter, fitted: Fitted, dataset: Dataset, joints: Mapping[str, str]) -> Advice:
    """What a fit says of postures that an instrument read; nothing of contacts, which only few postures can make.

    Raises:
        ArmcalError: it cannot be judged.
    """
    problem = fitter.problem
    if not all(kernel.factor.output_channels for kernel in problem.kernels) or not problem.parameters.free:
        return Advice()
    acting = _used(problem, fitted.used)
    made = estimate(acting, Solution(fitted.values, _QUICK))
    made = widened(acting, made, np.arange(len(dataset)))
    best = suggest(problem, dataset.subset(np.flatnonzero(fitted.used)), made, joints, 1)
    own = {f"{n}.{local}": sd for n in problem.blueprint.measurements for local, sd in own_deviations(made, n).items()}
    finite = {name: sd for name, sd in own.items() if np.isfinite(sd) and sd > 0}
    known = Advice(tuple(known_accuracies(problem, made)), finite)
    return replace(known, next=best[0].text, commands=best[0].commands, shrink=best[0].shrink) if best else known


_CHANCE = 1e-4
_CHANCE_LATER = 1e-5  # For postures that agreed when they came: they are judged again and again
_LOOKED_AT = 1e-2  # A posture this unlikely is fitted without, to see
_MOST_DROPPED_AT_ONCE = 3
_UNFIT = (ArmcalError, ArithmeticError, ValueError)  # Faults of postures that no fit can take


@dataclass(frozen=True)
class Offset:
    """How far a posture lies from where the others expect it, and how far was to be expected (root mean square).

    Turns are zero for contacts that turn freely; pixels are a corner's, root mean square over the image.
    """

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


@dataclass(frozen=True)
class Agreement:
    """Which postures agree."""

    doubtful: Mapping[int, Offset] = field(default_factory=dict)  # those that disagree, by place (from 0)
    newest: Offset | None = None  # of the last one; None where there is nothing to compare it with
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # of the last fit, to begin the next one from
    fitted: Fitted | None = None  # the last fit


class AgreementJudge:
    """Judges the postures of a fitter; ``groups`` are their names of groups (N)."""

    def __init__(self, fitter: QuickFitter, groups: Sequence[str]) -> None:
        self._fitter, self._groups = fitter, np.array(groups, dtype=object)
        self._last = len(groups) - 1

    def with_newest(self, doubtful: frozenset[int]) -> Agreement:
        """Judge the last posture, and with it those before, of which some were in doubt.

        Raises:
            NotConvergedError: a posture has no elastic equilibrium.
        """
        before = self._active(doubtful | {self._last})
        if not before.any():
            return Agreement()
        fitted = self._fitter.fit(before)
        newest = self._predicted(fitted, self._last)
        candidates = [*doubtful] if newest is None else [*doubtful, self._last]
        disagreeing = {one for one in candidates if self._disagrees(fitted, one, _CHANCE)}
        own = {int(i) for i in np.flatnonzero(self._groups == self._groups[self._last])}
        majority = own & disagreeing
        if len(majority) > len(own - disagreeing):  # more of the group in doubt than not: they are right if they agree
            others = (disagreeing - majority) | (own - disagreeing)
            fitted = self._fitter.fit(self._active(others))
            left_out = self._fitter.left_out(fitted)
            if not any(_is_beyond(*left_out[one], fitted.freedom, _CHANCE) for one in majority):
                disagreeing = others
        return replace(self._settled(disagreeing), newest=None if newest is None else _offset(newest))

    def anew(self) -> Agreement:
        return self._settled(set())

    def _active(self, doubtful: frozenset[int] | set[int]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        used = np.ones(len(self._groups), dtype=bool)
        used[list(doubtful)] = False
        return used

    def _predicted(self, fitted: Fitted, one: int) -> PredictedResidual | None:
        """None for a posture in whose group nothing was fitted."""
        alike = (self._groups == self._groups[one]) & fitted.used
        return self._fitter.predicted(fitted, one) if alike.any() else None

    def _disagrees(self, fitted: Fitted, one: int, chance: float) -> bool:
        predicted = self._predicted(fitted, one)
        return predicted is not None and _is_beyond(predicted.distance, predicted.numbers, fitted.freedom, chance)

    def _settled(self, doubtful: set[int]) -> Agreement:
        """Drop fitted postures that disagree with the others of their group, the farthest first."""
        rounds = _MOST_DROPPED_AT_ONCE if doubtful or self._last < 0 else max(_MOST_DROPPED_AT_ONCE, self._last // 3)
        fitted = self._fitter.fit(self._active(doubtful))
        for _ in range(rounds):
            ratios = {
                one: distance / _limit(numbers, fitted.freedom, _LOOKED_AT)
                for one, (distance, numbers) in self._fitter.left_out(fitted).items()
                if np.sum((self._groups == self._groups[one]) & fitted.used) >= 2
            }
            worst = max(ratios, key=lambda one: ratios[one], default=None)
            if worst is None or ratios[worst] <= 1:
                break
            without = self._fitter.fit(self._active(doubtful | {worst}))
            if not self._disagrees(without, worst, _CHANCE_LATER):
                break
            doubtful, fitted = doubtful | {worst}, without
        offsets = {one: _offset(self._fitter.predicted(fitted, one)) for one in sorted(doubtful)}
        return Agreement(offsets, values=self._fitter.free_values(fitted), fitted=fitted)


def _is_beyond(distance: float, numbers: int, freedom: float, chance: float) -> bool:
    return distance > _limit(numbers, freedom, chance)


def _limit(numbers: int, freedom: float, chance: float) -> float:
    return float(numbers * fdtri(numbers, max(freedom, 1.0), 1.0 - chance))


def _offset(predicted: PredictedResidual) -> Offset:
    numbers = []
    for dimension, unit in (("length", "mm"), ("angle", "deg"), ("image", "px")):
        own = predicted.dimensions == dimension
        points = max(np.sum(own) / 2, 1) if dimension == "image" else 1
        off = np.sum(predicted.residual[own] ** 2) / points
        expected = np.sum(np.diag(predicted.covariance)[own]) / points
        numbers += [to_unit(float(np.sqrt(square)), unit) for square in (off, expected)]
    return Offset(*map(float, numbers))


def _short(number: float) -> str:
    return f"{number:.2g}" if number < 10 else f"{number:.0f}"


@dataclass(frozen=True)
class Assessment:
    """What the postures determine, and which of them disagree.

    Attributes:
        newest: how the last posture lies to the others; None where there is nothing to compare it with.
        advice: how well an instrument's parameters are known, and what to take next.
    """

    newest: Offset | None = None
    doubts: Mapping[str, Offset] = field(default_factory=dict)  # postures that disagree, by name
    known: Knowledge | None = None  # what is determined; None if that could not be judged
    why_not: str = ""  # why not, a sentence
    advice: Advice = field(default_factory=Advice)


def contacts_of(experiment: Experiment, camera: LiveCamera | None) -> dict[str, Measurement]:
    """The measurements for which a posture, and a camera's image of it, is all there is to measure.

    Raises:
        ConfigError: there are none.
    """
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
    """Judges postures, and remembers which were in doubt and where the last fit ended."""

    def __init__(self, experiment: Experiment, camera: LiveCamera | None) -> None:
        self._experiment, self._contacts = experiment, contacts_of(experiment, camera)
        self._joints = JointKinds.of(experiment.system.arms).dimensions
        self._doubtful: frozenset[str] = frozenset()
        self._values: Mapping[str, tuple[float, ...]] = {}

    def with_newest(self, postures: Sequence[Posture]) -> Assessment:
        places = {p.name: i for i, p in enumerate(postures)}
        doubtful = frozenset(places[name] for name in self._doubtful if name in places)
        return self._assessed(postures, lambda judge: judge.with_newest(doubtful))

    def anew(self, postures: Sequence[Posture]) -> Assessment:
        """Judge all together: when one was taken back, or after a break."""
        return self._assessed(postures, lambda judge: judge.anew())

    def tried(self, postures: Sequence[Posture]) -> Assessment:
        remembered = self._doubtful, self._values
        try:
            return self.with_newest(postures)
        finally:
            self._doubtful, self._values = remembered

    def explained(self, postures: Sequence[Posture]) -> tuple[str, ...]:
        """Everything that is not determined yet, and why; it takes a moment."""
        if not postures:
            return ()
        try:
            experiment, dataset, fitter = self._fitter(postures)
            return explained(experiment, fitter.problem, dataset)
        except _UNFIT as fault:
            return (str(fault),)

    def _assessed(self, postures: Sequence[Posture], judge: Callable[[AgreementJudge], Agreement]) -> Assessment:
        if not postures:
            return Assessment()
        try:
            experiment, dataset, fitter = self._fitter(postures)
            agreement = judge(AgreementJudge(fitter, [p.place for p in postures]))
            known = knowledge(experiment, fitter.problem, dataset)
            outlook = Advice()
            if agreement.fitted is not None:
                outlook = advice(fitter, agreement.fitted, dataset, self._joints)
        except _UNFIT as fault:  # what was captured is safe, and so is what comes
            return Assessment(why_not=str(fault))
        doubts = {postures[place].name: offset for place, offset in agreement.doubtful.items()}
        self._doubtful = frozenset(doubts)
        self._values = agreement.values or self._values
        return Assessment(agreement.newest, doubts, known, advice=outlook)

    def _fitter(self, postures: Sequence[Posture]) -> tuple[Experiment, Dataset, QuickFitter]:
        dataset = dataset_of(postures)
        experiment = self._experiment.of_records(dataset)
        return experiment, dataset, QuickFitter(experiment, self._contacts, dataset, self._values)
