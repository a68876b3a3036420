"""What structure is left in the residuals of a calibration, how much of the error it is, and what would show it.

Dependences are tested all at once (family-wise 5 %). The one that explains most for its size [Schwarz1978] is taken
into the model, to first order, and the others are tested again on what is left: so each is named for what the ones
before it do not explain. Residuals are those of training, less the drift that was found; what the parameters can take
up, each dependence is freed of first. Of those that were found, each is then set against all the others and against
what is not among them: it is named alone only where it is clearly the likeliest.

Which of several causes residuals speak for: odds among all that were tried, and something that was not.

A cause is a set of columns; the logarithm of its odds against noise is that of the Schwarz criterion [Schwarz1978]. A
smooth function of the pose, or of time, stands for what is not among the causes, with the odds of its marginal
likelihood, and is as likely as a cause that leaves more than the declared noise. Several causes at once are judged one
by one, each in the presence of the others.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from armcal.base.arrays import Array, Indices, Mask
from armcal.base.units import SMALLEST_SHOWN, digits, readable
from armcal.diagnose.checks import Finding, Grade
from armcal.diagnose.dependences import (
    TIMES_REPEATS,
    Dependence,
    NoiseTrend,
    Records,
    Repeats,
    dependences,
    noise_trend,
    outside,
    predicted_positions,
    repeats_of,
)
from armcal.diagnose.fit import Fit
from armcal.diagnose.held import moves_of, with_contradicted
from armcal.diagnose.predictable import (
    CLEAR,
    FEWEST_POSES,
    IMITATED,
    MOST_OF_MEDIAN,
    Kernels,
    Predictable,
    TimeOrPose,
    left_out,
    pose_kernels,
    predictable,
    smooth,
    time_kernels,
)
from armcal.diagnose.predictable import LEVEL as PREDICTED_LEVEL
from armcal.diagnose.score_tests import FamilyTest, FitRows, LinearFit, family_test, linear_fit, own_basis
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import Measure, candidates
from armcal.estimate.uncertainty import automatic_block_length
from armcal.measure.groups import pose_numbers
from armcal.problem.problem import Problem

UNLISTED = "something that is none of these"
CHANCE = "nothing: it may be chance"
NOISE_LEVEL = 0.05
NEGLIGIBLE = 0.1  # Of what causes take up: less than this may be what is not linear in them
CHANGING = "something that changes with time and is none of these"


@dataclass(frozen=True)
class Odds:
    share: float  # of the odds of all causes, of what is not among them, and of chance, the cause's own
    alternatives: tuple[str, ...]  # in words, those that it does not beat 20 to 1, the most likely first
    chance: float  # the share of nothing at all


@dataclass(frozen=True)
class Contest:
    """All causes for the residuals of a fit.

    Attributes:
        pose, time: correlations of the records.
    """

    causes: Sequence[Dependence]  # that were tried
    columns: Sequence[Array]  # of each (rows x k)
    residual: Array  # of the fit (rows)
    basis: Array  # of what the fit takes up (rows x n), orthonormal
    by_record: Indices  # the data's rows as (records x rows a record), in recorded order
    fold: Indices  # of each row, which part of the recording judges it
    pose: Kernels
    time: Kernels

    @cached_property
    def names(self) -> tuple[str, ...]:
        """What stands for one cause: a jump is one wherever it is, a drift of the whole any function of time."""
        names = []
        for cause in self.causes:
            once = f"{cause.kind} {cause.subject}" if cause.jumps else cause.words
            names.append(CHANGING if cause.kind == "order" and not cause.subject else once)
        return tuple(names)

    def beside(self, others: Sequence[int]) -> tuple[Array, Array]:
        basis = self.basis
        for other in others:
            basis = np.hstack([basis, own_basis(self.columns[other], basis)[0]])
        added = basis[:, self.basis.shape[1] :]
        return self.residual - added @ (added.T @ self.residual), basis

    def time_imitated(self) -> float:
        over_time = smooth(self.residual, self.basis, self.by_record, self.time).function
        return self.pose.imitate(over_time[self.by_record])

    def likeliest(self, others: Sequence[int], independence: float) -> int:
        return int(np.argmax(self._gains(*self.beside(others), others, independence)))

    def odds(self, cause: int, others: Sequence[int], independence: float) -> Odds:
        """Of a cause beside others in the model; ``independence`` is how much of a record each record is worth."""
        residual, basis = self.beside(others)
        gains = self._gains(residual, basis, others, independence)
        shown = dict.fromkeys(self.names, -np.inf)
        for name, gain in zip(self.names, gains, strict=True):
            shown[name] = float(np.logaddexp(shown[name], gain - np.log(self.names.count(name))))
        mine = self.names[cause]
        for words, kernels in ((UNLISTED, self.pose), (CHANGING, self.time)):
            evidence = independence * smooth(residual, basis, self.by_record, kernels).evidence
            shown[words] = max(shown.get(words, -np.inf), evidence)
        # What is none of the causes cannot be excluded where what is left is far from noise or follows the pose, or
        # poses were in order.
        after, whole = self.beside([*others, cause])
        beyond = float(after @ after) - chdtri(len(after) - whole.shape[1], NOISE_LEVEL)
        left = beyond > NEGLIGIBLE * float(residual @ residual - after @ after)
        left = left or smooth(after, whole, self.by_record, self.pose).evidence * independence > CLEAR
        timely = self.causes[cause].jumps or self.causes[cause].kind == "order"
        if left or (timely and self.pose.imitate((residual - after)[self.by_record]) > IMITATED):
            shown[UNLISTED] = max(shown[UNLISTED], shown[mine])
        shown[CHANCE] = float(np.log(len(self.causes)))  # nothing is as likely beforehand as all causes together
        total = float(np.logaddexp.reduce(list(shown.values())))
        close = [name for name, gain in shown.items() if gain > shown[mine] - CLEAR and name != mine]
        of_name = dict(zip(reversed(self.names), [c.words for c in reversed(self.causes)], strict=True))
        alternatives = tuple(of_name.get(name, name) for name in sorted(close, key=lambda name: -shown[name]))
        return Odds(float(np.exp(shown[mine] - total)), alternatives, float(np.exp(shown[CHANCE] - total)))

    def _gains(self, residual: Array, basis: Array, others: Sequence[int], independence: float) -> Array:
        total, freedom = max(float(residual @ residual), 1e-300), len(residual) - basis.shape[1]
        gains = np.full(len(self.causes), -np.inf)
        for i in set(range(len(self.causes))) - set(others):
            own = own_basis(self.columns[i], basis)[0]
            if own.shape[1]:
                left = max(1 - float(np.sum((own.T @ residual) ** 2)) / total, 1e-12)
                gains[i] = -0.5 * independence * freedom * np.log(left)
                gains[i] -= 0.5 * own.shape[1] * np.log(max(freedom * independence, 2.0))
        return gains


LEVEL = 0.05
MOST_FOUND = 5
WORTHWHILE = 0.01
MOST_RECORDS = 1000
FEWEST_RECORDS = 30
_MOST_BLOCKS, _FEWEST_BLOCKS = 60, 30
_FOLDS = 5
_MM = 1000.0
_SAME = 0.999  # Cosine from which on two causes are one
_IN_ORDER = 0.5  # share of the order of records from which on poses tell the time
_LIKELIER = 0.5  # Where chance has more of the odds, a cause is none


@dataclass(frozen=True)
class Structure:
    """A dependence that was found.

    Attributes:
        kind, subject, words, effect, measure: as in ``Dependence``.
    """

    kind: str
    subject: str
    words: str
    effect: str
    measure: str
    p_value: float  # that the residuals do not depend on it, family-wise
    share: float  # of the squared residuals left by the ones before it
    falls_mm: float  # by how much the mean error would fall if it were modelled, judged on records left out
    size: str  # how large it is, in words; empty if its coefficients have no unit
    odds: float  # its share of the odds of everything that was tried, and of what was not
    alternatives: tuple[str, ...]  # what it does not beat 20 to 1, the most likely first; only a measurement can decide


@dataclass(frozen=True)
class ResidualStructure:
    """What the residuals of a fit still depend on.

    Attributes:
        lag_after, lag_after_p: the same once the structures found are modelled.
        predictable: what other records predict of them, whatever the cause; None where poses are too few.
    """

    structures: tuple[Structure, ...]  # in the order in which they were taken into the model
    more: bool  # whether something was significant still when the search ended
    lag_one: float  # correlation of neighbouring residuals, less what the fit itself makes of it
    lag_p: float  # its p-value, in the same family
    lag_after: float
    lag_after_p: float
    alike: TimeOrPose | None  # why neighbours resemble each other even then; None if they do not
    predictable: Predictable | None
    noise: NoiseTrend | None  # what their scatter depends on; None if on nothing
    repeats: Repeats | None  # what records of one pose say of noise; None where too few are
    mean_mm: float  # mean residual of the training records
    tested: int  # how many dependences were tested
    records: int  # how many records were looked at
    block: int  # how many neighbours count as one observation
    level: float = LEVEL  # family-wise

    @property
    def is_predictable(self) -> bool:
        return self.predictable is not None and self.predictable.above_chance

    @property
    def worthwhile(self) -> tuple[Structure, ...]:
        least = max(WORTHWHILE * self.mean_mm, SMALLEST_SHOWN)
        return tuple(s for s in self.structures if s.falls_mm >= least)


def structure(fit: Fit) -> ResidualStructure | None:
    """Test the residuals of a fit to records, with the weights they had; None where there are too few to judge."""
    if not fit.converged:
        return None
    problem, estimate = with_contradicted(fit, fit.few_acting), fit.estimate
    dataset, position = fit.ready.trained, fit.position[fit.split.train]
    taking_part = np.any([record.weight[: record.count] > 0 for record in problem.records], axis=0)
    chosen = _looked_at(np.flatnonzero(taking_part), position)
    if len(chosen) < FEWEST_RECORDS:
        return None
    problem, dataset, position = problem.subset(chosen), dataset.subset(chosen), position[chosen]
    rows, read = FitRows.of(problem, estimate), predicted_positions(problem, estimate.values, dataset)
    linear, basis, block = _fit_of(rows, len(dataset), np.diff(position) == 1)
    motion = fit.motion.subset(fit.split.train[chosen])
    place = next((own for own in read if len(own)), np.zeros((0, len(dataset))))
    moves = moves_of(problem, estimate.values, candidates(problem.parameters))
    causes = [*dependences(problem, motion, dataset, moves), *outside(problem, motion, dataset, read, moves)]
    causes, columns = _named_once(problem, causes, [rows.columns(one.columns) for one in causes])
    kernels = pose_kernels(problem, dataset), time_kernels(len(dataset))
    contest = Contest(
        causes, columns, linear.residual, basis, rows.by_record, linear.block * _FOLDS // linear.blocks, *kernels
    )
    structures, first, last = _search(rows, linear, contest, _modelled(fit))
    residual, whole = contest.beside(tuple(structures))
    predicted = predictable(problem, rows, basis, motion, dataset)
    lags = first.lag_one, first.lag_adjusted, last.lag_one, last.lag_adjusted
    return ResidualStructure(
        tuple(structures.values()),
        bool(np.any(last.adjusted <= LEVEL)),
        *lags,
        _alike(residual, whole, rows, contest) if last.lag_adjusted <= LEVEL else None,
        predicted and replace(predicted, imitated=contest.time_imitated()),
        noise_trend(residual, whole, rows.by_record, Records(dataset, motion), place),
        repeats_of(linear.residual, basis, rows, pose_numbers(dataset, motion.channels), contest.pose),
        rows.mean_error(linear.residual) * _MM,
        *(len(first.adjusted), len(dataset), block),
    )


def _modelled(fit: Fit) -> frozenset[str]:
    arms = fit.system.description.get("arms") or {}
    effects = [effect for arm in arms.values() for effect in (arm.get("effects") or {}).values()]
    return frozenset(str(effect.get("type")) for effect in effects)


def _named_once(
    problem: Problem, causes: Sequence[Dependence], columns: Sequence[Array]
) -> tuple[list[Dependence], list[Array]]:
    """Without what a held parameter of a joint's effect does as well, a spring's or a gear's: that one is named."""
    effects = {f"{name}.{effect}" for name, arm in problem.blueprint.arms.items() for effect in arm.effects}
    unit = [column / max(float(np.linalg.norm(column)), 1e-300) for column in columns]
    held = [u for c, u in zip(causes, unit, strict=True) if c.subject.rpartition(".")[0] in effects and u.shape[1] == 1]
    kept = [
        i
        for i, own in enumerate(unit)
        if causes[i].kind == "held" or own.shape[1] > 1 or all(abs(float(np.sum(one * own))) < _SAME for one in held)
    ]
    return [causes[i] for i in kept], [columns[i] for i in kept]


def _alike(residual: Array, basis: Array, rows: FitRows, contest: Contest) -> TimeOrPose:
    time, pose = (smooth(residual, basis, rows.by_record, k) for k in (contest.time, contest.pose))
    left = (left_out(one, residual, basis, rows.by_record) for one in (time, pose))
    time_mm, pose_mm = (rows.mean_error(one) * _MM for one in left)
    by_time, by_pose = (one.function[rows.by_record] for one in (time, pose))
    imitated, order = contest.pose.imitate(by_time), np.arange(len(by_time), dtype=float)[:, None]
    if imitated < IMITATED and (of_order := contest.pose.imitate(order)) > _IN_ORDER:
        imitated = of_order
    return TimeOrPose(time.evidence, pose.evidence, time_mm, pose_mm, imitated, contest.time.imitate(by_pose))


def _looked_at(candidates: Indices, position: Indices) -> Indices:
    order = candidates[np.argsort(position[candidates], kind="stable")]
    if len(order) <= MOST_RECORDS:
        return order
    runs = np.array_split(order, 2 * len(order) // MOST_RECORDS)
    most = MOST_RECORDS // len(runs)
    return np.concatenate([run[:most] for run in runs])


def _fit_of(rows: FitRows, count: int, consecutive: Mask) -> tuple[LinearFit, Array, int]:
    """The linear fit, an orthonormal basis of its slopes, and how many records a block has.

    Blocks are as long as errors resemble their neighbours', and neither too many nor too few. The rows of priors and
    drifts are dealt out to them in turn.
    """
    length = min(automatic_block_length(rows.residual[rows.by_record].T), max(1, count // _FEWEST_BLOCKS))
    length = max(length, -(-count // _MOST_BLOCKS))
    block = np.arange(count) // length
    extra = np.arange(len(rows.residual) - len(rows.record_of)) % (block.max() + 1)
    row_block = np.concatenate([block[rows.record_of], extra]).astype(np.intp)
    fit, basis = linear_fit(rows.slopes, rows.residual, row_block, rows.by_record, consecutive)
    return fit, basis, int(np.bincount(block).max())


def _search(
    rows: FitRows, fit: LinearFit, contest: Contest, modelled: frozenset[str]
) -> tuple[dict[int, Structure], FamilyTest, FamilyTest]:
    """Causes one after another as long as one is significant, then each set against all others and chance.

    Also the test of the family before any cause was in the model, and that of what is left.
    """
    left = [
        (i, own) for i, column in enumerate(contest.columns) if (own := own_basis(column, contest.basis)[0]).shape[1]
    ]
    first = test = family_test(fit, [own for _, own in left])
    chosen, p_values, whole = list[int](), list[float](), float(fit.residual @ fit.residual)
    while len(chosen) < MOST_FOUND:
        now, significant = float(fit.residual @ fit.residual), np.flatnonzero(test.adjusted <= LEVEL)
        if not len(significant):
            break
        # The least Bayesian information criterion, blocks counting as one.
        sizes = np.array([own.shape[1] for _, own in left])[significant]
        count = fit.blocks * fit.records.shape[1]
        unexplained = np.maximum(1 - test.share[significant], 1e-12)
        best = int(significant[np.argmin(count * np.log(unexplained) + sizes * np.log(count))])
        if test.share[best] * now < NEGLIGIBLE * (whole - now):
            break
        chosen.append(left[best][0])
        p_values.append(float(test.adjusted[best]))
        fit = fit.with_fewer_draws().without(left[best][1])
        basis = contest.beside(chosen)[1]
        left = [(i, own) for i, _ in left if (own := own_basis(contest.columns[i], basis)[0]).shape[1]]
        test = family_test(fit, [own for _, own in left])
    worth = (1 - max(test.lag_one, 0.0)) / (1 + max(test.lag_one, 0.0))
    settled = _settled(contest, dict(zip(chosen, p_values, strict=True)), worth)
    structures = {
        i: _structure(rows, contest, i, [j for j in settled if j != i], modelled, p, odds)
        for i, (p, odds) in settled.items()
    }
    return structures, first, test


def _settled(contest: Contest, falls: Mapping[int, float], worth: float) -> dict[int, tuple[float, Odds]]:
    """Causes with p-values and odds, each beside the others: the likeliest in its place, none that chance beats.

    Something is significant in one of twenty recordings of nothing but noise; odds say which of them are chance.
    """
    settled, p_values = list(falls), list(falls.values())
    for _ in range(len(settled)):
        before = list(settled)
        for place in range(len(settled)):
            others = settled[:place] + settled[place + 1 :]
            settled[place] = contest.likeliest(others, worth)
        if settled == before:
            break
    odds = [contest.odds(cause, [o for o in settled if o != cause], worth) for cause in settled]
    whole = {i: (p, odd) for i, p, odd in zip(settled, p_values, odds, strict=True)}
    least = max(whole, key=lambda i: whole[i][1].chance, default=None)
    if least is None or whole[least][1].chance <= _LIKELIER:
        return whole
    return _settled(contest, {i: p for i, (p, _) in whole.items() if i != least}, worth)


def _structure(
    rows: FitRows,
    contest: Contest,
    cause: int,
    others: Sequence[int],
    modelled: frozenset[str],
    p_value: float,
    odds: Odds,
) -> Structure:
    one, (residual, basis) = contest.causes[cause], contest.beside(others)
    own, coefficients = own_basis(contest.columns[cause], basis)
    present = one.effect.split(" ")[0] in modelled
    effect = f"{one.effect} (it is in the model: free it, or loosen its prior)" if present else one.effect
    share = float(np.sum((own.T @ residual) ** 2) / max(float(residual @ residual), 1e-300))
    left = residual.copy()  # less what it takes up, coefficients found without the records that are judged
    for number in range(_FOLDS):
        judged = contest.fold == number
        gram = own[~judged].T @ own[~judged]
        ridge = 1e-9 * max(float(np.trace(gram)), 1e-300) * np.eye(len(gram))
        taken = np.linalg.solve(gram + ridge, own[~judged].T @ residual[~judged])
        left[judged] -= own[judged] @ taken
    falls = rows.mean_error(residual) - rows.mean_error(left)
    size = _size(one, -coefficients @ (own.T @ residual))
    named = (one.kind, one.subject, one.words, effect, one.measure)
    return Structure(*named, p_value, share, max(0.0, falls) * _MM, size, odds.share, odds.alternatives)


def _size(one: Dependence, coefficients: Array) -> str:
    """Its coefficients in a customary unit, of levels the largest."""
    if not one.labels or not one.unit:
        return ""
    numbers = coefficients[: len(one.labels)]

    def shown(number: float) -> str:
        value, unit = (100 * number, "%") if one.unit == "1" else Measure(one.unit, 1.0).shown(number)
        return f"{value:.2g} {unit}"

    if one.kind == "level":
        largest = int(np.argmax(np.abs(numbers)))
        return f"{shown(float(numbers[largest]))} off at {one.labels[largest]}, beside its other levels"
    if one.kind == "delay":
        late_ms = float(f"{1000 * numbers[0]:.2g}")
        return f"joints {'late' if late_ms > 0 else 'early'} by about {abs(late_ms):g} ms, to first order"
    return ", ".join(f"{label}: {shown(float(n))}" for label, n in zip(one.labels, numbers, strict=True))


_MOST_TOLD = 5
_LIKELY = 0.05  # A cause with less of the odds is not named first
_NO_NOISE = 0.01
"""Of the declared noise: residuals below it are a simulation's without noise, and how they vary means nothing."""


def depends(fit: Fit) -> list[Finding]:
    return structure_findings(fit.of(structure), fit.unit) if fit.converged else []


def neighbours(fit: Fit) -> list[Finding]:
    return neighbour_findings(fit.of(structure), fit.estimate, fit.unit)


def structure_findings(structure: ResidualStructure | None, unit: str = "mm") -> list[Finding]:
    if structure is None:
        text = "The training records are too few to tell whether the model lacks anything."
        return [Finding("note", text, f"at least {FEWEST_RECORDS} records", "Measure more poses.")]
    blocks = f", blocks of {structure.block} records" if structure.block > 1 else ""
    level = f"{100 * structure.level:g} % over all {structure.tested} dependences{blocks}"
    test, kept = f"score test, {level}, and likelier than chance", structure.worthwhile
    findings = [_structure_finding(s, structure, unit, test) for s in kept]
    if not findings and not structure.is_predictable:
        text = f"None of the {structure.tested} causes that were tested explains the remaining error."
        if structure.structures:
            few = len(structure.structures)
            text += f" {few} {'would' if few == 1 else 'would each'} lower it by less than 1 %."
        findings.append(Finding("good", text, test))
    if kept and structure.more:
        text = "Residuals depend on more than these; model them first, then look again."
        findings.append(Finding("note", text, test))
    return [_predictable_finding(structure), *findings, *_scatter(structure), *repeat_findings(structure, unit)]


def _predictable_finding(structure: ResidualStructure) -> Finding:
    """What other records predict of the residuals, whatever its cause is."""
    predicted = structure.predictable
    if predicted is None:
        text = "There are too few distinct poses to test whether the pose still predicts the residuals."
        return Finding("note", text, f"at least {FEWEST_POSES} distinct poses", "Measure more poses.")
    test = (
        f"{predicted.records} records of {predicted.poses} poses, each predicted by the poses of other folds; "
        f"residuals with random signs, {100 * PREDICTED_LEVEL:g} %; errors beyond {MOST_OF_MEDIAN:g} times the median "
        "are cut"
    )
    if not predicted.above_chance:
        return Finding("good", "Other poses predict no more of the residuals than chance does.", test)
    grade: Grade = "warning" if predicted.falls >= WORTHWHILE else "note"
    listed = ", ".join(f"{carrier.words} ({percent(carrier.share)})" for carrier in predicted.carriers)
    text = f"{predicted_in_short(predicted)} Of it: {listed}."
    if predicted.is_in_order:
        text += f" The poses were visited in an order, and time alone predicts {percent(predicted.by_time)}: these data"
        text += " do not show which of them is the cause."
    named = sum(s.falls_mm for s in structure.worthwhile) / max(structure.mean_mm, 1e-12)
    first = "Model what is named beside this, then look again. " if named > predicted.falls / 2 else ""
    return Finding(grade, text, test, first + " ".join(_remedies(predicted)))


def predicted_in_short(predicted: Predictable) -> str:
    share = f"{percent(predicted.share)} of the variance of the residuals is not noise"
    names = [carrier.words for carrier in predicted.carriers]
    listed = " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
    return f"{share}: other records predict it, mostly from {listed} (chance: below {percent(predicted.chance)})."


def _remedies(predicted: Predictable) -> Iterator[str]:
    kinds = {carrier.kind for carrier in predicted.carriers}
    if predicted.is_in_order:
        yield _TELL_APART["open"]
        return
    if "joint" in kinds and predicted.learnable:
        yield "Learn it: arms.NAME.residual: {type: gaussian_process}; or free what armcal identify --fixed recommends."
    elif "joint" in kinds:
        if predicted.learnable is False:
            yield "A pose residual cannot learn it from these records: that takes positions or poses of the tool."
        yield "Free what armcal identify --fixed recommends, or add effects to these joints; more poses show more."
    if "time" in kinds:
        yield "Let the base drift (parameters.drift); record the temperature, and repeat one pose from time to time."
    if "temperature" in kinds:
        yield "Add thermal_length, or measure at one temperature."
    if "payload" in kinds:
        yield "Weigh the payload; add or free compliance."
    if "approach" in kinds:
        yield "Add or free approach_backlash on these joints."


def percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.095 else f"{100 * share:.1g} %" if share > 0.0005 else "0.1 %"


def _structure_finding(s: Structure, structure: ResidualStructure, unit: str, test: str) -> Finding:
    """One cause if it is clearly the likeliest, else all that it does not beat."""
    falls = f"would fall by {readable(s.falls_mm)} {unit}"
    falls = f"the mean training residual of {readable(structure.mean_mm)} {unit} {falls}"
    what = s.words + (f" ({s.size})" if s.size else "")
    test = f"p {_p(s.p_value)}, {test}; odds among all of them and what is none of them"
    if not s.alternatives:
        model = f"Model it: {s.effect}. " if s.effect else "No effect of armcal models this. "
        text = f"Residuals still depend on {what}: modelled, {falls}. It has {_share(s.odds)} of the odds."
        return Finding("warning", text, test, f"{model}To be sure: {s.measure}.")
    named = [what, *s.alternatives] if s.odds >= _LIKELY else [s.alternatives[0], what, *s.alternatives[1:]]
    more = len(named) - _MOST_TOLD
    text = f"Residuals still depend on {'; or on '.join(named[:_MOST_TOLD])}"
    text += f"; or on {more} more (metrics.json). " if more > 0 else ". "
    text += f"These data do not identify which. Modelled as {s.words}, which has {_share(s.odds)} of the odds, {falls}."
    model = f" Then model it: {s.effect}." if s.effect and s.kind not in ("order", "step") else ""
    return Finding("warning", text, test, f"To find out: {s.measure}.{model}")


def _share(odds: float) -> str:
    return "over 99 %" if odds > 0.99 else "less than 1 %" if odds < 0.01 else f"{100 * odds:.0f} %"


def _scatter(structure: ResidualStructure) -> list[Finding]:
    noise = structure.noise
    if noise is None or noise.high < _NO_NOISE:
        return []
    text = f"The spread of the residuals depends on {'; or on '.join([noise.words, *noise.alternatives[:_MOST_TOLD]])}:"
    text += f" from {digits(noise.low, 2)} to {digits(noise.high, 2)} times the declared noise, in the thirds of the"
    text += " records with the least and the most of it. Either the noise varies, or the model errs more there."
    test = f"regression of squared residuals, p {_p(noise.p_value)} over everything looked at"
    action = (
        "Repeat a pose at both ends of it: if repeats spread equally, the model is the cause; else state noise by "
        "record."
    )
    return [Finding("warning", text, test, action)]


def repeat_findings(structure: ResidualStructure, unit: str) -> list[Finding]:
    repeats = structure.repeats
    if repeats is None or not repeats.exceeded:
        return []
    text = (
        f"Repeats of a pose scatter by {readable(repeats.scatter_mm)} {unit}, residuals are "
        f"{readable(repeats.left_mm)} {unit} (root mean squares): "
    )
    test = f"lack of fit, F over {repeats.records} records of {repeats.poses} poses, p {_p(repeats.p_value)}, and "
    test += f"{TIMES_REPEATS:g} times"
    if repeats.shared or structure.is_predictable or structure.worthwhile:
        text += "the model lacks something, which poses nearby share."
        action = "Free what armcal identify --fixed recommends, add effects, and state masses for what sags."
    else:
        text += "the rest is no noise of the instrument, but the model's error, or what differs from stop to stop."
        action = "Drive to some poses again, from elsewhere: what then differs is the arm's."
    return [Finding("warning", text, test, action)]


def neighbour_findings(structure: ResidualStructure | None, estimate: Estimate, unit: str = "mm") -> list[Finding]:
    """Whether records that follow one another miss alike, why, and whether that made intervals wider."""
    if structure is None:
        return []
    test = f"lag-one correlation, {100 * structure.level:g} % over all dependences and this"
    if structure.lag_p > structure.level:
        return [Finding("good", "Residuals of neighbouring records do not correlate.", test)]
    text = f"Residuals of neighbouring records correlate by {structure.lag_one:.2f}"
    if structure.lag_after_p > structure.level:
        return [Finding("note", f"{text}; what was found above explains it.", test)]
    after = f", by {structure.lag_after:.2f} still beside what was found" if structure.structures else ""
    text += f"{after}: they are not noise. {_what_neighbours_cost(estimate)}"
    alike = structure.alike
    if alike is None:
        return [Finding("warning", text, test, _TELL_APART["open"])]
    text += (
        f" {_WHY[alike.cause]}predicted from the other records, a smooth function of time has an error of "
        f"{readable(alike.time_mm)} {unit} and one of the pose {readable(alike.pose_mm)} {unit} (log odds against "
        f"noise {alike.time:.0f} and {alike.pose:.0f})"
    )
    if max(alike.time_imitated, alike.pose_imitated) > IMITATED:
        shares = f"the pose predicts {_share(alike.time_imitated)} of the first, time {_share(alike.pose_imitated)} of "
        text += f"; as the poses were visited in an order, {shares}the second"
    return [Finding("warning", f"{text}.", test, _TELL_APART[alike.cause])]


def _what_neighbours_cost(estimate: Estimate) -> str:
    factors = estimate.widened
    if not factors:
        return "In the order in which these poses were measured that does not widen the intervals of the parameters."
    widest = int(np.argmax(factors))
    return (
        "Intervals that assume independent errors would be too narrow; those of the parameters are wider, by a factor "
        f"of {float(np.median(factors)):.1f} (median), at most {max(factors):.1f} ({estimate.names[widest]})."
    )


_WHY = {
    "time": "It goes with time, not with the pose: ",
    "pose": "It goes with the pose, not with time: ",
    "open": "Whether time or the pose is the cause is not known: ",
}
_TELL_APART = {
    "time": "Let the base drift (parameters.drift); repeat one pose at the start, in the middle and at the end.",
    "pose": "The model lacks an effect of pose; visiting the poses in random order would show it plainly.",
    "open": "Repeat some of the first poses at the end: only time changes them. Visit others in random order.",
}


def _p(p: float) -> str:
    return f"{p:.3f}" if p >= 0.01 else f"below {0.005 if p < 0.005 else 0.01:g}"
