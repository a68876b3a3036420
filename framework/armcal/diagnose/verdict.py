"""The verdict: what a person should conclude, each sentence from a check; and the checks of an estimate itself."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy.special import bdtr, chdtri, ndtri

from armcal.arm.assembly import command_channels
from armcal.arm.joints import Limits, joint_limits
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.domains import Semidefinite, symmetric
from armcal.base.units import digits, readable
from armcal.diagnose.causes import contradictions
from armcal.diagnose.checks import FIT_CHECKS, Finding, first_few, plugin_checks
from armcal.diagnose.data import still_joints
from armcal.diagnose.fit import Fit
from armcal.diagnose.gross import by_halves, hidden_payload, rounding
from armcal.diagnose.record_checks import MOST_TOLD, component_findings, large_errors, predictions
from armcal.diagnose.residual_structure import structure
from armcal.estimate.estimator import AT_BOUND, CHECK_THE_DATA, Estimate
from armcal.estimate.identifiability import (
    OF_PRIOR,
    POOR_CONDITION,
    bound_together,
    correlated_pairs,
    determined_in_words,
)
from armcal.estimate.identifiability import deviations as deviations_of
from armcal.estimate.prediction import NewRecording
from armcal.estimate.validation import Halves, pose_size, summarise
from armcal.measure.measurement import Placed
from armcal.planning.candidates import whitened_rows
from armcal.planning.exchange import CANDIDATES, Suggestion, in_words, is_worth_measuring, suggest
from armcal.plugins import PluginRegistry
from armcal.problem.problem import Problem
from armcal.problem.rigid_alignment import along, apart_from, tools, unseen_motions

LEVEL = 0.05
SURE = 0.005  # Level of a warning: those of all checks add up to at most 5 % of sound runs
SHARE = 0.95
FEWEST_FREEDOM = 10
DO_NOT_USE = "Do not use this calibration"
NOTICEABLE_SD = 0.3  # A shift by less than so many standard deviations is not reported
UNSEEN_POSES = 400  # That are looked at, of each kind
UP_TO_FRAMES = "where the base stands and which point of the tool is meant"
FEW_NAMED = 2  # So many combinations that only priors hold are named in the verdict; armcal identify names all
NEGLIGIBLE_SHARE = 0.1  # Of the typical error: what moves the tip by less than this does not matter to it
_MM = 1000.0
_NORMAL_95 = 1.96
_ORDER = {"bad": 0, "warning": 1, "note": 2, "good": 3}


@dataclass(frozen=True)
class Elsewhere:
    rms_mm: float  # root mean square of the tool's distance from where it is predicted, for the parameters' uncertainty
    poses: int  # how many unseen poses were looked at
    up_to: str  # motions that were left out, because nothing that was measured sees them; empty where none were

    @property
    def in_words(self) -> str:
        return f"Away from the contacts the tool is known to {readable(self.rms_mm)} mm (root mean square)"


def away(fit: Fit) -> list[Finding]:
    away = fit.of(elsewhere)
    if away is None:
        return []
    text = f"{away.in_words}: the error of contacts is only by how much postures at one place disagree."
    test = f"from the parameters' covariance, at {away.poses} poses of recorded joint positions"
    test += f", up to {away.up_to}" if away.up_to else ""
    action = "If that is too little: train on more places, farther apart, with the joints turned as far as they go."
    return [Finding("note", text, test, action)]


@dataclass(frozen=True)
class PriorsAlone:
    worst_mm: float  # the largest standard deviation of the tip that what only priors hold leaves, over unseen poses
    between_mm: float  # the same where joints stand between recorded positions too, approached from any recorded side
    poses: int  # how many unseen poses of each kind were looked at


def unseen_poses(dataset: Dataset, channels: Sequence[str], between: bool = False) -> Dataset:
    """Poses that combine what single joints did in the records: a joint's command and approach are of one of them.
    ``between``: it stands anywhere between its recorded ends instead, approached as in any of its records."""
    random = np.random.default_rng(0)
    together = random.integers(0, len(dataset), UNSEEN_POSES)
    values = {name: column[together] for name, column in dataset.channels.items()}
    for channel in channels:
        arm, _, joint = channel.partition(".")
        known = np.flatnonzero(np.isfinite(dataset.column(channel)))  # of two arms one may not be recorded
        if not len(known):
            continue
        drawn = known[random.integers(0, len(known), UNSEEN_POSES)]
        for own in (channel, f"{arm}.approach.{joint}"):
            if dataset.has(own):
                values[own] = dataset.column(own)[drawn]
        if between:
            recorded = dataset.column(channel)[known]
            values[channel] = random.uniform(recorded.min(), recorded.max(), UNSEEN_POSES)
    return Dataset(tuple(str(i) for i in range(UNSEEN_POSES)), values)


def priors_alone(fit: Fit) -> PriorsAlone | None:
    """How far the tip at both kinds of ``unseen_poses`` depends on what priors hold; None where they hold nothing, or
    where nothing holds a parameter."""
    if not fit.converged or {*fit.estimate.sources.values()} in ({"data"}, set()):
        return None
    channels = [*command_channels(fit.problem.blueprint.arms)]
    at, between = (tip_by_priors(fit, unseen_poses(fit.ready.trained, channels, own)) for own in (False, True))
    if at is None or between is None:
        return None
    return PriorsAlone(at, max(at, between), UNSEEN_POSES)


def tip_by_priors(fit: Fit, poses: Dataset) -> float | None:
    """The largest standard deviation (mm) of the tip that is left by what priors hold; None: nothing holds a parameter.
    By the directions in which data and priors are independent that keep as much of their prior's standard deviation as
    a parameter that it holds: undetermined ones, and those of which the data says hardly more."""
    estimate = fit.estimate
    information, prior = estimate.square_root_information, estimate.parameters.prior_information()
    if "nothing" in estimate.sources.values():
        return None
    root = np.linalg.inv(information)
    share, directions = np.linalg.eigh(root.T @ (prior[:, None] * root))  # of what is known in each direction
    alone = (root @ directions[:, share > OF_PRIOR**2]).T / estimate.parameters.scales()
    if not len(alone):
        return 0.0
    moved = _tip_motions(fit.problem, estimate.values, poses, alone)
    return float(np.sqrt(np.max(np.einsum("trnk,trnk->tn", moved, moved)))) * _MM


def elsewhere(fit: Fit) -> Elsewhere | None:
    if not fit.converged or not fit.problem.blueprint.groups:
        return None
    poses = unseen_poses(fit.ready.trained, [*command_channels(fit.problem.blueprint.arms)])
    return away_from_contacts(fit.problem, fit.estimate, poses)


def away_from_contacts(problem: Problem, estimate: Estimate, poses: Dataset) -> Elsewhere | None:
    scales = estimate.parameters.scales()
    of_arm = np.array([not block.nuisance for block in estimate.parameters.coordinate_blocks], dtype=bool)
    root = np.linalg.pinv(estimate.parameters.entries_jacobian(estimate.values) * scales)
    covariance = (root @ estimate.covariance @ root.T)[np.ix_(of_arm, of_arm)]
    sizes, vectors = np.linalg.eigh(covariance)
    kept = sizes > np.finfo(float).eps * sizes.max(initial=0.0)
    if not kept.any():
        return None
    directions = np.zeros((int(kept.sum()), len(scales)))
    directions[:, of_arm] = (vectors[:, kept] * np.sqrt(sizes[kept])).T
    moved = _tip_motions(problem, estimate.values, poses, directions)
    rms = float(np.sqrt(np.mean(np.sum(moved**2, axis=(1, 3))))) * _MM
    return Elsewhere(rms, len(poses), "" if _position_rows(problem) else UP_TO_FRAMES)


def _tip_motions(problem: Problem, values: Array, poses: Dataset, null: Array) -> Array:
    """How the tips (T, or the one position that is read) move along the directions (T x 3 x N x K; m)."""
    if rows := _position_rows(problem):
        noise = np.concatenate([kernel.factor.noise for kernel in problem.kernels])
        return np.asarray((whitened_rows(problem, values, poses)[rows] * noise[rows, None, None] @ null.T)[None])
    problem = problem.of(poses)  # nothing reads a position: of the tools, up to what no contact could see
    at, axes = tools(problem, values)
    moves = np.array([along(problem, values, direction).ravel() for direction in null]).T
    return apart_from(np.array(unseen_motions(at, axes)).T, moves).reshape(len(at), 3, -1, moves.shape[1])


def _position_rows(problem: Problem) -> list[int]:
    start = 0
    for kernel in problem.kernels:
        factor = kernel.factor
        if factor.position_channels and factor.dimensions[:3] == ("length",) * 3:
            return list(range(start, start + 3))
        start += len(factor.noise)
    return []


def determined(fit: Fit) -> list[Finding]:
    plain = fit.before or fit  # a pose residual determines nothing
    estimate, alone, judged = plain.estimate, plain.of(priors_alone), fit.judged_mm[np.isfinite(fit.judged_mm)]
    sources, combinations = estimate.sources, estimate.identifiability.undetermined
    test = "rank of the Jacobian in typical scales"
    if not sources:
        text = "No parameter was free: the nominal model was judged, nothing was calibrated."
        return [Finding("warning", text, test, "Free parameters: parameters.free.")]
    text = determined_in_words(sources)
    if {*sources.values()} == {"data"}:
        return [Finding("good", f"{text}.", test)]
    test += f", and standard deviations of {100 * OF_PRIOR:g} % of the priors'"
    if combinations and (alone is None or len(combinations) <= FEW_NAMED):
        text += f" ({'; '.join(map(str, combinations[:MOST_TOLD]))})"
    if alone is None:
        return [Finding("bad", f"{text}.", test, "Free fewer parameters, or measure what armcal identify asks for.")]
    test = f"{test}; the tip at {alone.poses} poses of recorded joint positions, and at as many between them"
    if not _position_rows(fit.problem):
        test += f"; positions, not orientations, up to {UP_TO_FRAMES}, which nothing measured shows"
    negligible = NEGLIGIBLE_SHARE * float(np.median(judged)) if len(judged) else np.inf
    if alone.between_mm <= negligible:
        most = f"{alone.between_mm:.2g}" if alone.between_mm >= 0.001 else "0.001"
        text += f". The tip at unseen poses does not depend on them (at most {most} mm, 1 sd)."
        return [Finding("note", text, test, "Nothing for the tip; armcal identify names them.")]
    text += f". The tip at unseen poses depends on them, by up to {alone.between_mm:.2g} mm (1 sd)"
    action = "armcal identify names them, and armcal plan finds the poses that determine them."
    if alone.worst_mm <= negligible:
        text += ", where a joint stands between its recorded positions, or is approached from another side there"
        action = "Measure each joint between its recorded positions too, from both sides; armcal identify names them."
    return [Finding("warning", f"{text}.", test, action)]


@dataclass(frozen=True)
class Verdict:
    """The findings, the worst first, and sentences that sum them up."""

    headline: str
    findings: tuple[Finding, ...]
    claim: str = ""  # how good the model is on unseen poses
    next_poses: str = ""  # which to measure next; empty where more would not help much

    @property
    def paragraph(self) -> str:
        """The claim, or why there is none; what is bad or a warning; what to measure next."""
        urgent = [finding.text for finding in self.findings if finding.grade in ("bad", "warning")]
        first = f"{DO_NOT_USE}:" if self.bad else self.claim
        return " ".join(filter(None, (first, *urgent, self.next_poses)))

    @property
    def grade(self) -> Literal["good", "usable with care", "bad"]:
        """Of the calibration as a whole, by its worst finding: a note does not count."""
        grades = {finding.grade for finding in self.findings}
        return "bad" if "bad" in grades else "usable with care" if "warning" in grades else "good"

    @property
    def bad(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.grade == "bad")


def verdict_of(fit: Fit, registry: PluginRegistry) -> Verdict:
    """What the checks say of a fit, armcal's own and those of plugins, the worst first; a headline; a paragraph.

    Raises:
        NotConvergedError: a record has no elastic equilibrium at the estimate.
    """
    checks = (*FIT_CHECKS, *plugin_checks(registry, before_fit=False))
    return in_all(fit, [finding for check in checks for finding in check.findings(fit)])


def in_all(fit: Fit, findings: Iterable[Finding]) -> Verdict:
    ranked = sorted(findings, key=lambda finding: _ORDER[finding.grade])
    judged_mm, held, unit = fit.judged_mm[np.isfinite(fit.judged_mm)], len(fit.split.holdout), fit.unit
    judged_on = f"{held} held-out records" if held else "cross-validation"
    judged_on += ", as in a new recording (its drift not known)" if fit.drifts else ""
    headline = "No record was held out: how good the model is on new poses is not known."
    if len(judged_mm):
        mean, p95 = float(np.mean(judged_mm)), summarise(judged_mm).p95
        most, below = ("all of them", float(np.max(judged_mm))) if p95 is None else ("95 % of poses", p95)
        headline = f"{fit.name} error {readable(mean)} {unit} on average, {most} below {readable(below)} {unit}, "
        headline += f"judged on {judged_on}."
    claim = _good_for(judged_mm, judged_on, unit, fit.of(new_recording), fit.of(elsewhere))
    if ranked[0].grade == "bad":
        headline = f"{DO_NOT_USE}. {headline}"
    poses = fit.of(suggestions)
    further = f"Measure these poses next: {in_words(poses)}." if is_worth_measuring(poses) else ""
    return Verdict(headline, tuple(ranked), claim, further)


def new_recording(fit: Fit) -> NewRecording | None:
    if not fit.converged:
        return None
    return fit.of(predictions).new_recording(fit.problem, np.flatnonzero(np.isfinite(fit.judged_mm)))


def suggestions(fit: Fit) -> tuple[Suggestion, ...]:
    problem, estimate, dataset = fit.problem, fit.estimate, fit.ready.trained
    # In a contact no pose can be chosen that does not touch.
    chosen = all(kernel.factor.output_channels for kernel in problem.kernels)
    if not (fit.converged and estimate.names and chosen):
        return ()
    joints, limits = dict[str, str](), dict[str, Limits | None]()
    stated, arms = fit.ready.limits, fit.system.arms
    for name, arm in arms.items():
        own = joint_limits(arm.nominal_chain)
        for joint, kind in arm.commanded.items():
            channel = f"{name}.{joint}"
            joints[channel] = kind
            limits[channel] = stated.get(joint if len(arms) == 1 else channel, own[joint])
    still = {channel: limits[channel] for channel in fit.of(still_joints)}
    return suggest(problem, dataset, estimate, joints, still=still)


def evidence(fit: Fit) -> dict[str, Any]:
    analyses = (structure, large_errors, priors_alone, elsewhere, hidden_payload, rounding)
    names = ("residual_structure", "large_errors", "priors_alone", "elsewhere", "hidden_payload", "rounding")
    content = {name: own and asdict(own) for name, own in zip(names, map(fit.of, analyses), strict=True)}
    return {**content, "contradictions": [asdict(one) for one in fit.of(contradictions)]}


def _good_for(
    judged_mm: Array, judged_on: str, unit: str = "mm", new: NewRecording | None = None, away: Elsewhere | None = None
) -> str:
    """Below what 95 % of unseen poses lie, with 95 % confidence, by order statistics [Wilks1941]; of a new recording,
    whose drift is another one, as much wider as an upper limit of the mean square is for fewer degrees of freedom."""
    count = len(judged_mm)
    if not count:
        return "How good the model is on unseen poses is not known: hold records out, or cross-validate."
    enough = np.flatnonzero(bdtr(np.arange(count), count, SHARE) >= 1 - LEVEL)
    if not len(enough):
        largest = readable(float(np.max(judged_mm)))
        return f"The largest error on {judged_on} is {largest} {unit}; {count} are too few to say more."
    limit = float(np.sort(judged_mm if new is None else judged_mm * new.ratio)[enough[0]])
    if new is not None:
        correlated, independent = (freedom / chdtri(freedom, 1 - LEVEL) for freedom in (new.freedom, new.independent))
        limit *= float(np.sqrt(correlated / independent))
    claim = "Good for" if away is None else f"{away.in_words}. Postures at one place agree within"
    within = f"{claim} +- {readable(limit)} {unit} on unseen poses like these"
    return f"{within}: 95 % of them, with 95 % confidence ({judged_on})."


def converged(fit: Fit) -> list[Finding]:
    solver = fit.estimate.verdict
    if not solver.converged:
        text = f"{solver.name} did not converge ({solver.status}): these values are no calibration."
        return [Finding("bad", text, "the solver's own", CHECK_THE_DATA)]
    text = f"{solver.name} converged in {solver.iterations} iterations"
    if solver.starts > 1:
        text += f"; {solver.agreeing_starts} of {solver.starts} starts came to the same answer"
    return [Finding("good", text + ".", "the solver's own")]


def conditioned(fit: Fit) -> list[Finding]:
    estimate = fit.estimate
    known = estimate.identifiability
    if known.condition <= POOR_CONDITION:
        return []
    direction = known.directions[known.rank - 1] * estimate.parameters.scales()
    by_priors = float(direction**2 @ estimate.parameters.prior_information())
    held = by_priors >= float(known.singular_values[known.rank - 1]) ** 2
    test = f"scaled condition {known.condition:.1e}, limit {POOR_CONDITION:.0e}"
    action = "Their priors hold them." if held else "Measure what armcal plan asks for, or give them priors."
    return [Finding("note" if held else "warning", f"Hardly determined: {known.weakest}.", test, action)]


def bounds(fit: Fit) -> list[Finding]:
    """Is a bound that holds compatible with the data? One-sided, by the step that ignores bounds, over all of them."""
    estimate, findings = fit.estimate, []
    limit = ndtri(1 - SURE / max(len(estimate.at_bound), 1))
    agreeing, pushing = list[str](), list[str]()
    for i, name in enumerate(estimate.names):
        if name in estimate.at_bound:
            value, sd = estimate.values[estimate.free_entries[i]], estimate.deviations[i]
            beyond = abs(float(estimate.unconstrained[i] - value)) / sd if sd > 0 else 0.0
            (pushing if beyond > limit else agreeing).append(f"{name} ({beyond:.1f} sd beyond)")
    test = f"step without bounds, one-sided, {100 * SURE:g} % over all bounds that hold"
    if pushing:
        text = f"The data pushes against a bound: {first_few(pushing)}. Something else in the model is missing."
        findings.append(Finding("warning", text, test, "Check loads, masses and signs; look for a missing effect."))
    if agreeing:
        text = f"At a bound, and the data agrees: {first_few(agreeing)}. The data limits it to one side only."
        findings.append(Finding("note", text, test))
    return findings


def noise(fit: Fit) -> list[Finding]:
    """Are the residuals as large as the declared noise? By chi-square; else what the estimated variances are."""
    if fit.fitted.components:
        return component_findings(fit.fitted.components)
    estimate, left, contradicted = fit.estimate, fit.of(structure), fit.of(contradictions)
    freedom, ratio = max(1, estimate.degrees_of_freedom), estimate.noise_scale
    total, test = ratio**2 * freedom, f"chi-square, {100 * SURE:g} %"
    shows = bool(contradicted) or (left is not None and left.shows)
    if total > chdtri(freedom, SURE):
        why = "the model's error or the instrument's, which this test cannot separate"
        if fit.of(rounding) is not None:
            why = "rounding of the recorded joints would leave as much, see below"
        elif left is not None or contradicted:
            known = "some of it is the model's: what residuals depend on is named below"
            why += f"; {known if shows else 'none of the causes that were tested is in it'}"
        mean = f"{readable(float(np.nanmean(fit.errors.calibrated_mm[fit.split.train])))} {fit.unit} on average"
        text = f"Residuals are {ratio:.1f} times the declared noise, {mean}: {why}. "
        text += "Intervals are widened to the residuals."
        action = "Repeat some poses, each from elsewhere: the spread of the repeats is noise, the rest the model's "
        return [Finding("warning", text, test, f"{action}error.")]
    if ratio < 0.5 and total < chdtri(freedom, 1 - SURE):
        text, test = f"Residuals are only {readable(ratio)} times the declared noise", f"ratio below 0.5, {test}"
        action = "State the noise as the instrument's data sheet does."
        return [Finding("note", f"{text}: was it stated too large?", test, action)]
    text = f"Residuals are as large as the declared noise{'' if shows else ': the model explains the data'}."
    return [Finding("good", text, test)]


def freedom(fit: Fit) -> list[Finding]:
    freedom = fit.estimate.degrees_of_freedom
    if freedom >= FEWEST_FREEDOM:
        return []
    text = f"Only {freedom:.2g} degrees of freedom are left beside the free parameters: small residuals are no "
    text += "evidence that the model is right."
    action = "Measure more poses: three to five times as many numbers as free parameters; or free fewer parameters."
    return [Finding("warning", text, f"equations less parameters, at least {FEWEST_FREEDOM}", action)]


def correlated(fit: Fit) -> list[Finding]:
    estimate = fit.estimate
    pairs = correlated_pairs(estimate.covariance, estimate.names, bound=bound_together(estimate.parameters))
    if not pairs:
        return []
    listed = first_few([f"{a} with {b} ({value:+.3f})" for a, b, value in pairs])
    return [Finding("note", f"Strongly correlated: {listed}.", "correlation of estimates above 0.95")]


def next_poses(fit: Fit) -> list[Finding]:
    estimate, suggested = fit.estimate, fit.of(suggestions)
    if not estimate.names:
        return []
    scales = [b.scale for b in estimate.parameters.free for _ in range(b.size)]
    relative = np.nan_to_num(estimate.deviations / np.array(scales), nan=np.inf)
    text = f"Least certain, in its typical scale: {estimate.names[int(np.argmax(relative))]}."
    if not suggested:
        return [Finding("note", text)]
    shrink = digits(100 * (1 - suggested[-1].shrink), 2)
    text += f" {len(suggested)} poses more would shrink standard deviations by {shrink} % on average."
    test = f"determinant of the information, {CANDIDATES} poses like the recorded ones; clearance was not checked"
    action = f"Measure next: {in_words(suggested)}." if is_worth_measuring(suggested) else ""
    return [Finding("note", text, test, action)]


def found_before(fit: Fit) -> list[Finding]:
    return list(fit.ready.findings)


def shifts(fit: Fit) -> list[Finding]:
    estimate, blocks = fit.estimate, set[str]()
    for block in estimate.parameters.free:
        at_edge = not set(block.entry_names).isdisjoint(estimate.at_bound)
        if isinstance(block.domain, Semidefinite):
            sizes = np.linalg.eigvalsh(symmetric(estimate.values[estimate.parameters.entries_of(block.name)]))
            at_edge = bool(sizes.min() <= AT_BOUND * block.scale)
        blocks |= {block.name} if at_edge else set()
    sd = np.where(estimate.deviations > 0, estimate.deviations, np.inf)
    moved = np.nan_to_num((estimate.free_values - estimate.unconstrained) / sd)
    seen = [i for i, name in enumerate(estimate.names) if name.partition("[")[0] not in blocks]
    seen = [i for i in seen if abs(moved[i]) > NOTICEABLE_SD] if blocks else []
    if not seen:
        return []
    worst = sorted(seen, key=lambda i: -abs(moved[i]))
    listed = first_few([f"{estimate.names[i]} ({moved[i]:+.1f} sd)" for i in worst], MOST_TOLD)
    held = ", ".join(sorted(blocks)[:MOST_TOLD]) + (" and others" if len(blocks) > MOST_TOLD else "")
    text = f"Bounds that hold {held} shift other estimates: {listed}. Their intervals do not count this shift."
    return [Finding("note", text, f"step without bounds, more than {NOTICEABLE_SD:g} sd")]


def places(fit: Fit) -> list[Finding]:
    estimate, problem = fit.estimate, fit.problem
    if not fit.converged or not estimate.names:
        return []
    return [Finding("note", text) for text in known_accuracies(problem, estimate, fit.of(by_halves))]


def known_accuracies(problem: Problem, estimate: Estimate, parts: Halves | None = None) -> list[str]:
    texts = []
    for name, measurement in problem.blueprint.measurements.items():
        if isinstance(measurement, Placed):
            pose, where = measurement.place
            mm, deg = (_NORMAL_95 * size for size in pose_size(own_deviations(estimate, name), pose))
            if np.isnan(mm + deg):
                continue
            text = f"{name}: its place {where} is known to {mm:.2g} mm and {deg:.2g} deg (95 %)"
            if parts is not None and np.isfinite(parts.apart[name]).any():
                mm, deg = np.nanmean(parts.apart[name], axis=0)
                text += f", and differs by {mm:.2g} mm and {deg:.2g} deg between halves of the records"
            texts.append(f"{text}.")
    return texts


def own_deviations(estimate: Estimate, instance: str) -> dict[str, float]:
    """Standard deviations of the free coordinates of one instance by local name; infinite where undetermined."""
    names = estimate.parameters.coordinate_names
    deviations = zip(names, deviations_of(estimate.square_root_information), strict=True)
    return {n.removeprefix(f"{instance}."): float(sd) for n, sd in deviations if n.startswith(f"{instance}.")}
