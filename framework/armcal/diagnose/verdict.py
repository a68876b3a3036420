"""The verdict: what a person should conclude, each sentence from a test with a stated level."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import bdtr, chdtri, ndtri

from armcal.base.arrays import Array, Indices
from armcal.base.units import digits, readable
from armcal.diagnose.evidence import Evidence
from armcal.diagnose.evidence_findings import (
    MOST_TOLD,
    determined_finding,
    large_error_findings,
    neighbour_findings,
    predicted_in_short,
    repeat_findings,
    shift_findings,
    structure_findings,
)
from armcal.diagnose.held import contradiction_findings
from armcal.diagnose.large_errors import (
    Finding,
    component_findings,
    first_few,
    outlier_findings,
    suspicious_in_short,
    suspicious_records,
)
from armcal.diagnose.unseen import Elsewhere, rounding_findings
from armcal.estimate.estimator import CHECK_THE_DATA, Estimate
from armcal.estimate.identifiability import POOR_CONDITION, bound_together, correlated_pairs
from armcal.estimate.prediction import NewRecording
from armcal.estimate.robust import WeighedFit
from armcal.estimate.validation import summarise
from armcal.planning.suggestion import CANDIDATES, Suggestion, in_words, is_worth_measuring

LEVEL = 0.05
SHARE = 0.95
FEWEST_FREEDOM = 10
DO_NOT_USE = "Do not use this calibration"
_ORDER = {"bad": 0, "warning": 1, "note": 2, "good": 3}


@dataclass(frozen=True)
class Verdict:
    """The findings, the worst first, one line that sums them up, and a paragraph that a technician can act on."""

    headline: str
    findings: tuple[Finding, ...]
    paragraph: str = ""

    @property
    def grade(self) -> Literal["good", "usable with care", "bad"]:
        """Of the calibration as a whole, by its worst finding: a note does not count."""
        grades = {finding.grade for finding in self.findings}
        return "bad" if "bad" in grades else "usable with care" if "warning" in grades else "good"

    @property
    def bad(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.grade == "bad")


def judge(
    estimate: Estimate,
    errors_mm: Array,
    train: Indices,
    judged_mm: Array,
    judged_on: str,
    ids: Sequence[str],
    suggestions: Sequence[Suggestion] = (),
    fitted: WeighedFit | None = None,
    predicted: Sequence[Finding] = (),
    evidence: Evidence | None = None,
) -> Verdict:
    """Judge a calibration.

    Args:
        estimate: what was found.
        errors_mm: calibrated error of each record (N).
        train: which records trained.
        judged_mm: errors of records that did not train, or of cross-validation (``judged_on``, in words); or empty.
        ids: of all records (N).
        suggestions: poses that would add most information.
        fitted: how the training records weighed; None for plain least squares.
        predicted: whether prediction intervals cover their share.
        evidence: what residuals depend on, which records are missed, what priors alone hold; none unless given.
    """
    seen = evidence or Evidence()
    determined = determined_finding(estimate, seen.priors_alone, np.median(judged_mm) if len(judged_mm) else None)
    own, trained = [ids[i] for i in train], errors_mm[train]
    sizes, numbers = seen.noise or (np.ones(len(errors_mm)), 3.0)
    suspicious = suspicious_records(trained / sizes[train], numbers, own, fitted)
    noise = component_findings(fitted.components) if fitted and fitted.components else [_size(estimate, trained, seen)]
    findings = [_convergence(estimate), determined, *_condition(estimate), *_bounds(estimate)]
    findings += [*shift_findings(estimate), *noise, *_freedom(estimate), *_causes(seen)]
    findings += structure_findings(seen.structure, seen.unit) if estimate.verdict.converged else []
    findings += neighbour_findings(seen.structure, estimate, seen.unit)
    findings += [*_correlated(estimate), *predicted, *large_error_findings(seen.large_errors, seen.unit)]
    findings += [*outlier_findings(suspicious, own, fitted), *_next(estimate, suggestions)]
    ranked = tuple(sorted(findings, key=lambda finding: _ORDER[finding.grade]))
    headline = _errors_text(judged_mm, judged_on, seen)
    first = _good_for(judged_mm, judged_on, seen.unit, seen.new_recording, seen.elsewhere)
    if ranked[0].grade == "bad":
        headline, first = f"{DO_NOT_USE}. {headline}", f"{DO_NOT_USE}: {ranked[0].text}"
    short = _in_short(first, estimate, determined, seen, suspicious_in_short(suspicious, len(own)), suggestions)
    return Verdict(headline, ranked, " ".join(short))


def _errors_text(judged_mm: Array, judged_on: str, seen: Evidence) -> str:
    if not len(judged_mm):
        return "No record was held out: how good the model is on new poses is not known."
    mean, p95, unit = float(np.mean(judged_mm)), summarise(judged_mm).p95, seen.unit
    most, below = ("all of them", float(np.max(judged_mm))) if p95 is None else ("95 % of poses", p95)
    return (
        f"{seen.name} error {readable(mean)} {unit} on average, {most} below {readable(below)} {unit}, judged on "
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


def _in_short(
    first: str,
    estimate: Estimate,
    determined: Finding,
    seen: Evidence,
    suspicious: str,
    suggestions: Sequence[Suggestion],
) -> list[str]:
    """What it is good for, what is not determined, suspicious, left over, and to be measured next; a sentence each."""
    if not estimate.verdict.converged:
        return ["The solver did not converge: these values are no calibration."]
    sentences = [first]
    if estimate.identifiability.undetermined:
        sentences.append(f"Not determined: {determined.text[:1].lower()}{determined.text[1:]}")
    missed = seen.large_errors
    if missed is not None and missed.beyond:
        ids = ", ".join(miss.record_id for miss in missed.explained[:MOST_TOLD])
        more = f" and {missed.beyond - MOST_TOLD} more" if missed.beyond > MOST_TOLD else ""
        named = "the record" if missed.beyond == 1 else f"{missed.beyond} records"
        sentences.append(f"Error {missed.in_words(seen.unit)} in {named}, by id: {ids}{more}.")
    sentences.append(suspicious)
    sentences += _left(seen, estimate)
    if is_worth_measuring(suggestions):
        sentences.append(f"Measure these poses next: {in_words(suggestions)}.")
    return sentences


def _causes(seen: Evidence) -> list[Finding]:
    return [*contradiction_findings(seen.contradictions), *rounding_findings(seen.rounding, seen.unit)]


def _left(seen: Evidence, estimate: Estimate) -> list[str]:
    """What is left in the residuals; that nothing was found only where all that was looked at says so."""
    left, sentences = seen.structure, [finding.text for finding in _causes(seen)]
    if left is None:
        return sentences or ["Whether the model lacks anything is not known: the training records are too few."]
    sentences += [finding.text for finding in repeat_findings(left, seen.unit)]
    if left.predictable is not None and left.is_predictable:
        sentences.append(predicted_in_short(left.predictable))
    if left.worthwhile:
        listed = "; ".join(
            f"{s.words}{', or on another cause' if s.alternatives else ''} ({readable(s.falls_mm)} {seen.unit})"
            for s in left.worthwhile
        )
        sentences.append(f"Residuals still depend on {listed}.")
    elif not sentences and left.lag_after_p <= left.level:
        text = "None of the tested causes explains the residuals, yet neighbours correlate by "
        sentences.append(f"{text}{left.lag_after:.2f}.")
    elif left.predictable is None:
        sentences.append("None of the tested causes explains the residuals; for others the poses are too few.")
    elif not sentences and _is_beyond_noise(estimate):
        text = "Nothing that was recorded predicts the residuals, yet they are "
        sentences.append(f"{text}{estimate.noise_scale:.1f} times the declared noise.")
    elif not sentences:
        sentences.append("The residuals look like noise: nothing that was recorded predicts them.")
    return sentences


def _is_beyond_noise(estimate: Estimate) -> bool:
    freedom = max(1, estimate.degrees_of_freedom)
    return bool(estimate.noise_scale**2 * freedom > chdtri(freedom, LEVEL / 2))


def _convergence(estimate: Estimate) -> Finding:
    solver = estimate.verdict
    if not solver.converged:
        text = f"{solver.name} did not converge ({solver.status}): these values are no calibration."
        return Finding("bad", text, "the solver's own", CHECK_THE_DATA)
    text = f"{solver.name} converged in {solver.iterations} iterations"
    if solver.starts > 1:
        text += f"; {solver.agreeing_starts} of {solver.starts} starts came to the same answer"
    return Finding("good", text + ".", "the solver's own")


def _condition(estimate: Estimate) -> list[Finding]:
    known = estimate.identifiability
    if known.condition <= POOR_CONDITION:
        return []
    direction = known.directions[known.rank - 1] * estimate.parameters.scales()
    by_priors = float(direction**2 @ estimate.parameters.prior_information())
    held = by_priors >= float(known.singular_values[known.rank - 1]) ** 2
    test = f"scaled condition {known.condition:.1e}, limit {POOR_CONDITION:.0e}"
    action = "Their priors hold them." if held else "Measure what armcal plan asks for, or give them priors."
    return [Finding("note" if held else "warning", f"Hardly determined: {known.weakest}.", test, action)]


def _bounds(estimate: Estimate) -> list[Finding]:
    """Is a bound that holds compatible with the data? One-sided, at 5 %, by the step that ignores bounds."""
    agreeing: list[str] = []
    pushing: list[str] = []
    for i, name in enumerate(estimate.names):
        if name not in estimate.at_bound:
            continue
        value, sd = estimate.values[estimate.free_entries[i]], estimate.deviations[i]
        beyond = abs(float(estimate.unconstrained[i] - value)) / sd if sd > 0 else 0.0
        (pushing if beyond > ndtri(1 - LEVEL) else agreeing).append(f"{name} ({beyond:.1f} sd beyond)")
    findings, test = [], "step without bounds, one-sided, 5 %"
    if pushing:
        text = f"The data pushes against a bound: {first_few(pushing)}. Something else in the model is missing."
        findings.append(Finding("warning", text, test, "Check loads, masses and signs; look for a missing effect."))
    if agreeing:
        text = f"At a bound, and the data agrees: {first_few(agreeing)}. The data limits it to one side only."
        findings.append(Finding("note", text, test))
    return findings


def _size(estimate: Estimate, trained_mm: Array, seen: Evidence) -> Finding:
    """Are the residuals as large as the declared noise? Chi-square, two-sided, at 5 %."""
    freedom, ratio = max(1, estimate.degrees_of_freedom), estimate.noise_scale
    total, test = ratio**2 * freedom, "chi-square, 5 %"
    if _is_beyond_noise(estimate):
        why = "the model's error or the instrument's, which this test cannot separate"
        if seen.rounding is not None:
            why = "rounding of the recorded joints would leave as much, see below"
        elif seen.structure is not None or seen.contradictions:
            known = "some of it is the model's: what residuals depend on is named below"
            left = seen.structure
            is_seen = seen.contradictions or (left is not None and (left.structures or left.is_predictable))
            why += f"; {known if is_seen else 'none of the causes that were tested is in it'}"
        mean = f"{readable(float(np.nanmean(trained_mm)))} {seen.unit} on average"
        text = f"Residuals are {ratio:.1f} times the declared noise, {mean}: {why}. "
        text += "Intervals are widened to the residuals."
        action = (
            "Repeat some poses, each from elsewhere: the spread of the repeats is noise, the rest the model's error."
        )
        return Finding("warning", text, test, action)
    if ratio < 0.5 and total < chdtri(freedom, 1 - LEVEL / 2):
        text = f"Residuals are only {readable(ratio)} times the declared noise: was it stated too large?"
        return Finding("note", text, f"ratio below 0.5, {test}", "State the noise as the instrument's data sheet does.")
    explained = not seen.contradictions and (seen.structure is None or not seen.structure.is_predictable)
    text = f"Residuals are as large as the declared noise{': the model explains the data' if explained else ''}."
    return Finding("good", text, test)


def _freedom(estimate: Estimate) -> list[Finding]:
    freedom = estimate.degrees_of_freedom
    if freedom >= FEWEST_FREEDOM:
        return []
    text = (
        f"Only {freedom:.2g} degrees of freedom are left beside the free parameters: small residuals are no evidence "
        "that the model is right."
    )
    action = "Measure more poses: three to five times as many numbers as free parameters; or free fewer parameters."
    return [Finding("warning", text, f"equations less parameters, at least {FEWEST_FREEDOM}", action)]


def _correlated(estimate: Estimate) -> list[Finding]:
    pairs = correlated_pairs(estimate.covariance, estimate.names, bound=bound_together(estimate.parameters))
    if not pairs:
        return []
    listed = first_few([f"{a} with {b} ({value:+.3f})" for a, b, value in pairs])
    return [Finding("note", f"Strongly correlated: {listed}.", "correlation of estimates above 0.95")]


def _next(estimate: Estimate, suggestions: Sequence[Suggestion]) -> list[Finding]:
    """The parameter whose uncertainty is largest in its own typical scale, and the poses that would add most."""
    if not estimate.names:
        return []
    scales = [b.scale for b in estimate.parameters.free for _ in range(b.size)]
    relative = np.nan_to_num(estimate.deviations / np.array(scales), nan=np.inf)
    text = f"Least certain, in its typical scale: {estimate.names[int(np.argmax(relative))]}."
    if not suggestions:
        return [Finding("note", text)]
    shrink = digits(100 * (1 - suggestions[-1].shrink), 2)
    text += f" {len(suggestions)} poses more would shrink standard deviations by {shrink} % on average."
    test = f"determinant of the information, {CANDIDATES} poses like the recorded ones; clearance was not checked"
    action = f"Measure next: {in_words(suggestions)}." if is_worth_measuring(suggestions) else ""
    return [Finding("note", text, test, action)]
