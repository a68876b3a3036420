"""Training records that lie farther from the fit than the others: which, how many, and what to do about them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armcal.base.arrays import Array
from armcal.diagnose.noise_findings import Finding, first_few, suspect_findings
from armcal.estimate.weighing import WeighedFit

DEVIATIONS = 5.0
MOST_SUSPICIOUS = 0.2
"""Of the training records; more of them are no outliers."""
_SMALLEST_SPREAD_MM = 1e-6
_MOST_NAMED = 5
_TOO_MANY = "their noise is larger than the others', or the model lacks something where they are"


def suspicious_records(errors_mm: Array, ids: Sequence[str], fitted: WeighedFit | None) -> list[str]:
    """Ids of training records beyond their limit, the farthest first."""
    if fitted is not None and fitted.loss != "none":
        return list(dict.fromkeys(ids[suspect.record] for suspect in fitted.suspects))
    middle = float(np.median(errors_mm))
    spread = 1.4826 * float(np.median(np.abs(errors_mm - middle)))
    beyond = np.flatnonzero(errors_mm > middle + DEVIATIONS * max(spread, _SMALLEST_SPREAD_MM))
    return [ids[i] for i in beyond[np.argsort(-errors_mm[beyond], kind="stable")]]


def outlier_findings(suspicious: Sequence[str], ids: Sequence[str], fitted: WeighedFit | None) -> list[Finding]:
    """Records beyond their limits if the loss sought them, else beyond five robust deviations of the errors."""
    if fitted is not None and fitted.loss != "none":
        action = "Look at them in residuals.csv, and measure them again."
        return [replace(f, action=action) if f.grade == "warning" else f for f in suspect_findings(fitted, ids)]
    if not suspicious:
        return []
    listed = ", ".join(suspicious[:_MOST_NAMED])
    text = f"Beyond five robust deviations of the training errors: {len(suspicious)} records, the worst {listed}."
    test = "median and median absolute deviation"
    if len(suspicious) > MOST_SUSPICIOUS * len(ids):
        action = "Look in residuals.csv at what they have in common, and state their noise if it is known."
        return [Finding("warning", f"{text} So many are no outliers: {_TOO_MANY}.", test, action)]
    return [Finding("warning", text, test, "Measure them again, or set noise.loss: reject; residuals.csv has all.")]


def suspicious_in_short(ids: Sequence[str], records: int) -> str:
    """How many of the training records, and which: an id alone, such as 2020, would read as their number."""
    if not ids:
        return "No training record is suspicious."
    if len(ids) > MOST_SUSPICIOUS * records:
        return f"{len(ids)} of {records} training records lie beyond the limit for outliers: {_TOO_MANY}."
    verb = "is" if len(ids) == 1 else "are"
    return f"{len(ids)} of {records} training records {verb} suspicious, by id: {first_few(ids)}."
