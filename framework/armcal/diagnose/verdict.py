"""The verdict: what a person should conclude, each sentence from a check; and the checks of an estimate itself."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy.special import bdtr, chdtri, ndtri

from armcal.arm.joints import Limits, joint_limits
from armcal.base.arrays import Array
from armcal.base.domains import Semidefinite, symmetric
from armcal.base.parameters import ParameterBlock
from armcal.base.units import digits, readable
from armcal.diagnose.causes import contradictions
from armcal.diagnose.checks import FIT_CHECKS, Finding, first_few, plugin_checks
from armcal.diagnose.coverage import predictions
from armcal.diagnose.data import still_joints
from armcal.diagnose.fit import Fit
from armcal.diagnose.gross import by_halves
from armcal.diagnose.outliers import MOST_TOLD, component_findings, large_errors
from armcal.diagnose.residual_structure import structure
from armcal.diagnose.unseen import Elsewhere, elsewhere, hidden_payload, priors_alone, rounding
from armcal.estimate.estimator import AT_BOUND, CHECK_THE_DATA, Estimate
from armcal.estimate.identifiability import POOR_CONDITION, bound_together, correlated_pairs
from armcal.estimate.identifiability import deviations as deviations_of
from armcal.estimate.prediction import NewRecording
from armcal.estimate.validation import Halves, pose_size, summarise
from armcal.measure.measurement import Placed
from armcal.planning.exchange import CANDIDATES, Suggestion, in_words, is_worth_measuring, suggest
from armcal.plugins import PluginRegistry
from armcal.problem.problem import Problem

LEVEL = 0.05
SURE = 0.005
"""Level of a warning: those of all checks add up to at most 5 % of sound runs."""
SHARE = 0.95
FEWEST_FREEDOM = 10
DO_NOT_USE = "Do not use this calibration"
NOTICEABLE_SD = 0.3  # A shift by less than so many standard deviations is not reported
_NORMAL_95 = 1.96
_ORDER = {"bad": 0, "warning": 1, "note": 2, "good": 3}


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
    findings = [finding for check in checks for finding in check.findings(fit)]
    return in_all(fit, sorted(findings, key=lambda finding: _ORDER[finding.grade]))


def in_all(fit: Fit, ranked: Sequence[Finding]) -> Verdict:
    judged_mm, held = fit.judged_mm[np.isfinite(fit.judged_mm)], len(fit.split.holdout)
    judged_on = f"{held} held-out records" if held else "cross-validation"
    judged_on += ", as in a new recording (its drift not known)" if fit.drifts else ""
    headline = _errors_text(fit, judged_mm, judged_on)
    claim = _good_for(judged_mm, judged_on, fit.unit, fit.of(new_recording), fit.of(elsewhere))
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
    """Poses to measure next, joints that stood still elsewhere; none after a fit that did not converge."""
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
    still = {channel: limits[channel] for channel in still_joints(fit.system, dataset)}
    return suggest(problem, dataset, estimate, joints, still=still)


def evidence(fit: Fit) -> dict[str, Any]:
    analyses = (structure, large_errors, priors_alone, elsewhere, hidden_payload, rounding)
    names = ("residual_structure", "large_errors", "priors_alone", "elsewhere", "hidden_payload", "rounding")
    content = {name: own and asdict(own) for name, own in zip(names, map(fit.of, analyses), strict=True)}
    return {**content, "contradictions": [asdict(one) for one in fit.of(contradictions)]}


def _errors_text(fit: Fit, judged_mm: Array, judged_on: str) -> str:
    if not len(judged_mm):
        return "No record was held out: how good the model is on new poses is not known."
    mean, p95, unit = float(np.mean(judged_mm)), summarise(judged_mm).p95, fit.unit
    most, below = ("all of them", float(np.max(judged_mm))) if p95 is None else ("95 % of poses", p95)
    return (
        f"{fit.name} error {readable(mean)} {unit} on average, {most} below {readable(below)} {unit}, judged on "
        f"{judged_on}."
    )


def _good_for(
    judged_mm: Array,
    judged_on: str,
    unit: str = "mm",
    new: NewRecording | None = None,
    elsewhere: Elsewhere | None = None,
) -> str:
    """Below what 95 % of unseen poses lie, with 95 % confidence, by order statistics. [Wilks1941]

    In a new recording a drift is another one: errors are scaled to it, and the limit is as much wider as an upper
    limit of the mean square is for so many fewer degrees of freedom.
    """
    if not len(judged_mm):
        return "How good the model is on unseen poses is not known: hold records out, or cross-validate."
    below = np.arange(len(judged_mm))
    enough = np.flatnonzero(bdtr(below, len(judged_mm), SHARE) >= 1 - LEVEL)
    if not len(enough):
        largest = float(np.max(judged_mm))
        return (
            f"The largest error on {judged_on} is {readable(largest)} {unit}; {len(judged_mm)} are too few to say more."
        )
    limit = float(np.sort(judged_mm if new is None else judged_mm * new.ratio)[enough[0]])
    if new is not None:
        correlated, independent = (freedom / chdtri(freedom, 1 - LEVEL) for freedom in (new.freedom, new.independent))
        limit *= float(np.sqrt(correlated / independent))
    claim = "Good for" if elsewhere is None else f"{elsewhere.in_words}. Postures at one place agree within"
    return (
        f"{claim} +- {readable(limit)} {unit} on unseen poses like these: 95 % of them, with 95 % confidence "
        f"({judged_on})."
    )


def _is_beyond_noise(estimate: Estimate) -> bool:
    freedom = max(1, estimate.degrees_of_freedom)
    return bool(estimate.noise_scale**2 * freedom > chdtri(freedom, SURE))


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
    estimate = fit.estimate
    limit = ndtri(1 - SURE / max(len(estimate.at_bound), 1))
    agreeing: list[str] = []
    pushing: list[str] = []
    for i, name in enumerate(estimate.names):
        if name not in estimate.at_bound:
            continue
        value, sd = estimate.values[estimate.free_entries[i]], estimate.deviations[i]
        beyond = abs(float(estimate.unconstrained[i] - value)) / sd if sd > 0 else 0.0
        (pushing if beyond > limit else agreeing).append(f"{name} ({beyond:.1f} sd beyond)")
    findings, test = [], f"step without bounds, one-sided, {100 * SURE:g} % over all bounds that hold"
    if pushing:
        text = f"The data pushes against a bound: {first_few(pushing)}. Something else in the model is missing."
        findings.append(Finding("warning", text, test, "Check loads, masses and signs; look for a missing effect."))
    if agreeing:
        text = f"At a bound, and the data agrees: {first_few(agreeing)}. The data limits it to one side only."
        findings.append(Finding("note", text, test))
    return findings


def noise(fit: Fit) -> list[Finding]:
    return component_findings(fit.fitted.components) if fit.fitted.components else [_size(fit)]


def _size(fit: Fit) -> Finding:
    """Are the residuals as large as the declared noise? By chi-square."""
    estimate, left, contradicted = fit.estimate, fit.of(structure), fit.of(contradictions)
    freedom, ratio = max(1, estimate.degrees_of_freedom), estimate.noise_scale
    total, test = ratio**2 * freedom, f"chi-square, {100 * SURE:g} %"
    if _is_beyond_noise(estimate):
        why = "the model's error or the instrument's, which this test cannot separate"
        if fit.of(rounding) is not None:
            why = "rounding of the recorded joints would leave as much, see below"
        elif left is not None or contradicted:
            known = "some of it is the model's: what residuals depend on is named below"
            is_seen = contradicted or (left is not None and left.shows)
            why += f"; {known if is_seen else 'none of the causes that were tested is in it'}"
        mean = f"{readable(float(np.nanmean(fit.errors.calibrated_mm[fit.split.train])))} {fit.unit} on average"
        text = f"Residuals are {ratio:.1f} times the declared noise, {mean}: {why}. "
        text += "Intervals are widened to the residuals."
        action = (
            "Repeat some poses, each from elsewhere: the spread of the repeats is noise, the rest the model's error."
        )
        return Finding("warning", text, test, action)
    if ratio < 0.5 and total < chdtri(freedom, 1 - SURE):
        text = f"Residuals are only {readable(ratio)} times the declared noise: was it stated too large?"
        return Finding("note", text, f"ratio below 0.5, {test}", "State the noise as the instrument's data sheet does.")
    explained = not contradicted and (left is None or not left.shows)
    text = f"Residuals are as large as the declared noise{': the model explains the data' if explained else ''}."
    return Finding("good", text, test)


def freedom(fit: Fit) -> list[Finding]:
    freedom = fit.estimate.degrees_of_freedom
    if freedom >= FEWEST_FREEDOM:
        return []
    text = (
        f"Only {freedom:.2g} degrees of freedom are left beside the free parameters: small residuals are no evidence "
        "that the model is right."
    )
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
    """The parameter whose uncertainty is largest in its own typical scale, and the poses that would add most."""
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
    return shift_findings(fit.estimate)


def shift_findings(estimate: Estimate) -> list[Finding]:
    """Which estimates are moved by bounds and cones that hold others, and by how many standard deviations."""
    blocks = {block.name for block in estimate.parameters.free if _at_its_edge(estimate, block)}
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


def _at_its_edge(estimate: Estimate, block: ParameterBlock) -> bool:
    if isinstance(block.domain, Semidefinite):
        sizes = np.linalg.eigvalsh(symmetric(estimate.values[estimate.parameters.entries_of(block.name)]))
        return bool(sizes.min() <= AT_BOUND * block.scale)
    return not set(block.entry_names).isdisjoint(estimate.at_bound)


def places(fit: Fit) -> list[Finding]:
    estimate, problem = fit.estimate, fit.problem
    if not fit.converged or not estimate.names:
        return []
    return [Finding("note", text) for text in known_accuracies(problem, estimate, fit.of(by_halves))]


def known_accuracies(problem: Problem, estimate: Estimate, parts: Halves | None = None) -> list[str]:
    texts = []
    for name, measurement in problem.blueprint.measurements.items():
        if not isinstance(measurement, Placed):
            continue
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
