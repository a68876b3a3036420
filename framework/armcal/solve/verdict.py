"""The verdict: what a person should conclude, each sentence from a test with a stated level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, ndtri

from armcal.base.domains import Array
from armcal.solve.estimator import Estimate
from armcal.solve.identifiability import POOR_CONDITION, correlated_pairs
from armcal.solve.suggestion import CANDIDATES, Suggestion

LEVEL = 0.05
_SMALLEST_SPREAD_MM = 1e-6
Grade = Literal["good", "note", "warning", "bad"]


@dataclass(frozen=True)
class Finding:
    """One sentence of the verdict, and how much it matters."""

    grade: Grade
    text: str


@dataclass(frozen=True)
class Verdict:
    """The findings, the worst first, and one line that sums them up."""

    headline: str
    findings: tuple[Finding, ...]


def judge(
    estimate: Estimate,
    whitened: Array,
    errors_mm: Array,
    train: NDArray[np.intp],
    judged_mm: Array,
    judged_on: str,
    ids: Sequence[str],
    suggestions: Sequence[Suggestion] = (),
) -> Verdict:
    """Judge a calibration.

    Args:
        estimate: what was found.
        whitened: residuals in units of the declared noise, in recorded order (n_r x N).
        errors_mm: calibrated error of each record (N).
        train: which records trained.
        judged_mm: errors of the records that did not train, or of cross-validation; empty if there are none.
        judged_on: what these are, in words.
        ids: of all records (N).
        suggestions: poses that would tell most next.
    """
    findings = [_convergence(estimate), _determined(estimate), *_condition(estimate), *_bounds(estimate)]
    findings += [_noise(estimate), *_neighbours(whitened, train), *_correlated(estimate)]
    findings += [*_outliers(errors_mm[train], [ids[i] for i in train]), *_next(estimate, suggestions)]
    order = {"bad": 0, "warning": 1, "note": 2, "good": 3}
    if len(judged_mm):
        ninety_five = float(np.percentile(judged_mm, 95))
        headline = (
            f"Tip error {float(np.mean(judged_mm)):.2f} mm on average, 95 % of poses below {ninety_five:.2f} mm, "
            f"judged on {judged_on}."
        )
    else:
        headline = "No record was held out: how good the model is on new poses is not known."
    return Verdict(headline, tuple(sorted(findings, key=lambda finding: order[finding.grade])))


def _convergence(estimate: Estimate) -> Finding:
    told = estimate.verdict
    if not told.converged:
        return Finding("bad", f"{told.name} did not converge ({told.status}): these values are no calibration.")
    text = f"{told.name} converged in {told.iterations} iterations"
    if told.starts > 1:
        text += f"; {told.agreeing_starts} of {told.starts} starts came to the same answer"
    return Finding("good", text + ".")


def _determined(estimate: Estimate) -> Finding:
    known = estimate.identifiability
    if known.undetermined:
        listed = "; ".join(str(combination) for combination in known.undetermined)
        return Finding("bad", f"Not determined by the data, held by priors alone: {listed}.")
    if not len(known):
        return Finding("warning", "No parameter was free: the nominal model was judged, nothing was calibrated.")
    return Finding("good", f"The data determines all {known.rank} free parameters.")


def _condition(estimate: Estimate) -> list[Finding]:
    known = estimate.identifiability
    if known.condition <= POOR_CONDITION:
        return []
    return [Finding("warning", f"Hardly determined (scaled condition {known.condition:.1e}): {known.weakest}.")]


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
    findings = []
    if pushing:
        text = f"The data pushes against a bound: {', '.join(pushing)}. Something else in the model is missing."
        findings.append(Finding("warning", text))
    if agreeing:
        text = f"At a bound, and the data agrees (5 %): {', '.join(agreeing)}. Its upper limit is what was learned."
        findings.append(Finding("note", text))
    return findings


def _noise(estimate: Estimate) -> Finding:
    """Are the residuals as large as the declared noise? Chi-square, two-sided, at 5 %."""
    freedom, ratio = max(1, estimate.degrees_of_freedom), estimate.noise_scale
    total = ratio**2 * freedom
    if total > chdtri(freedom, LEVEL / 2):
        return Finding(
            "warning",
            f"Residuals are {ratio:.1f} times the declared noise (chi-square, 5 %): what is left is the model's "
            "error, not the tracker's. Intervals are widened to the residuals.",
        )
    if ratio < 0.5:
        return Finding("note", f"Residuals are only {ratio:.2f} times the declared noise: was it stated too large?")
    return Finding("good", "Residuals are as large as the declared noise: the model explains the data.")


def _neighbours(whitened: Array, train: NDArray[np.intp]) -> list[Finding]:
    """Do training records that follow one another correlate? Against independence, two-sided, at 5 %."""
    first = train[:-1][np.diff(train) == 1]
    spread = float(np.mean(whitened[:, train] ** 2))
    if len(first) < 10 or not spread:
        return []
    products = whitened[:, first] * whitened[:, first + 1]
    lag_one = float(np.mean(products)) / spread
    if abs(lag_one) < ndtri(1 - LEVEL / 2) / np.sqrt(products.size):
        return [Finding("good", "Residuals of neighbouring records do not correlate (5 %).")]
    return [
        Finding(
            "warning",
            f"Residuals of neighbouring records correlate by {lag_one:.2f} (5 %): they are no noise, so the "
            "intervals are too narrow and errors follow the arm's configuration.",
        )
    ]


def _correlated(estimate: Estimate) -> list[Finding]:
    pairs = correlated_pairs(estimate.covariance, estimate.names)
    if not pairs:
        return []
    listed = ", ".join(f"{a} with {b} ({value:+.3f})" for a, b, value in pairs[:5])
    more = f" and {len(pairs) - 5} more" if len(pairs) > 5 else ""
    return [Finding("note", f"Hard to tell apart (correlation above 0.95): {listed}{more}.")]


def _outliers(errors_mm: Array, ids: Sequence[str]) -> list[Finding]:
    """Records beyond five robust standard deviations of the errors."""
    middle = float(np.median(errors_mm))
    spread = 1.4826 * float(np.median(np.abs(errors_mm - middle)))
    suspicious = np.flatnonzero(errors_mm > middle + 5 * max(spread, _SMALLEST_SPREAD_MM))
    if not len(suspicious):
        return []
    worst = [ids[i] for i in suspicious[np.argsort(-errors_mm[suspicious])][:5]]
    return [
        Finding(
            "warning",
            f"Beyond five robust deviations of the training errors: {len(suspicious)} records, the worst "
            f"{', '.join(worst)}. Look at them, and at residuals.csv.",
        )
    ]


def _next(estimate: Estimate, suggestions: Sequence[Suggestion]) -> list[Finding]:
    """The parameter whose uncertainty is largest in its own ordinary size, and the poses that would tell most."""
    if not estimate.names:
        return []
    scales = [b.scale for b in estimate.parameters.free for _ in range(b.size)]
    relative = np.nan_to_num(estimate.deviations / np.array(scales), nan=np.inf)
    text = f"Least certain, in its ordinary size: {estimate.names[int(np.argmax(relative))]}."
    if suggestions:
        poses = "; ".join(suggestion.text for suggestion in suggestions)
        shrink = 100 * (1 - suggestions[-1].shrink)
        text += (
            f" Of {CANDIDATES} poses like the recorded ones these would tell most (they shrink standard deviations "
            f"by {shrink:.1f} % on average; clearance was not checked): {poses}."
        )
    return [Finding("note", text)]
