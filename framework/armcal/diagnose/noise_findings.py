"""Noise of a fit, and records that lie farther from it than noise allows, in sentences of the verdict."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from armcal.base.arrays import Array
from armcal.diagnose.large_errors import BY_CHANCE, noise_limit
from armcal.estimate.variance import VarianceComponents
from armcal.estimate.weighing import WeighedFit

Grade = Literal["good", "note", "warning", "bad"]
MOST_LISTED = 10
MOST_SUSPICIOUS = 0.2
"""Of the training records; more of them are no outliers."""
_SMALLEST = 1e-3
"""Of the noise, in thousandths: smaller errors are a simulation's without noise."""
_MOST_NAMED = 5
_TOO_MANY = "their noise is larger than the others', or the model lacks something where they are"
_SHOWN = {"rad": (180 / np.pi, " deg"), "m": (1000.0, " mm")}


@dataclass(frozen=True)
class Finding:
    """One row of the verdict: how much it matters, what it is, how it was tested at which level, what to do."""

    grade: Grade
    text: str
    test: str = ""
    action: str = ""

    @property
    def whole(self) -> str:
        return self.text + (f" [{self.test}]" if self.test else "") + (f" {self.action}" if self.action else "")


def first_few(texts: Sequence[str], most: int = 5) -> str:
    return ", ".join(texts[:most]) + (f" and {len(texts) - most} more" if len(texts) > most else "")


def suspect_findings(fitted: WeighedFit, ids: Sequence[str]) -> list[Finding]:
    """Which training records lie beyond what noise does, at 1 % over all of them; ``ids`` are theirs."""
    if not fitted.suspects:
        return [Finding("good", "No training record lies farther from the fit than noise allows (1 % over all).")]
    left = "Left in the fit" if fitted.loss == "reject" else f"Weighed less by the loss {fitted.loss}"
    kept = tuple(suspect for suspect in fitted.suspects if suspect.weight > 0)
    findings = []
    for fate, group in (("Set aside", fitted.set_aside), (left, kept)):
        if not group:
            continue
        weights = [f", weight {s.weight:.2g}" if 0 < s.weight < 1 else "" for s in group]
        listed = [f"{ids[s.record]} ({s.distance:.1f} sd{w})" for s, w in zip(group, weights, strict=True)]
        text = (
            f"{fate}, and farther from the fit than noise allows ({group[0].limit:.1f} sd, 1 % over all records): "
            f"{len(group)} records: {first_few(listed, MOST_LISTED)}. Their errors are counted all the same; "
            "residuals.csv has them."
        )
        findings.append(Finding("warning", text))
    return findings


def suspicious_records(errors: Array, rows: float, ids: Sequence[str], fitted: WeighedFit | None) -> list[str]:
    """Ids of training records beyond their limit, the farthest first.

    ``errors`` are in units of each record's noise, of so many numbers each.
    """
    if fitted is not None and fitted.loss != "none":
        return list(dict.fromkeys(ids[suspect.record] for suspect in fitted.suspects))
    beyond = np.flatnonzero(errors > max(noise_limit(errors, rows), _SMALLEST))
    return [ids[i] for i in beyond[np.argsort(-errors[beyond], kind="stable")]]


def outlier_findings(suspicious: Sequence[str], ids: Sequence[str], fitted: WeighedFit | None) -> list[Finding]:
    """Records beyond their limits if the loss sought them, else beyond what noise does to their errors."""
    if fitted is not None and fitted.loss != "none":
        action = "Look at them in residuals.csv, and measure them again."
        return [replace(f, action=action) if f.grade == "warning" else f for f in suspect_findings(fitted, ids)]
    if not suspicious:
        return []
    listed = ", ".join(suspicious[:_MOST_NAMED])
    count = "1 training record lies" if len(suspicious) == 1 else f"{len(suspicious)} training records lie"
    text = f"{count} farther from the fit than noise allows, the worst {listed}."
    test = f"noise of their median size, {100 * BY_CHANCE:g} % over all"
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


def component_findings(components: VarianceComponents) -> list[Finding]:
    """Is it the tracker or the model?"""
    joints = components.share("joint")
    parts = sorted(components.components, key=lambda c: -c.share)
    texts = []
    for c in parts:
        factor, unit = _SHOWN.get(c.unit, (1.0, " times the declared noise"))
        sd = f"{factor * c.sd:.2g}{unit}, 95 % {factor * c.lower:.2g} to {factor * c.upper:.2g}"
        texts.append(f"{c.name} {100 * c.share:.0f} % ({sd})")
    listed = "; ".join(texts)
    if not components.unseen and all(c.kind == "instrument" for c in parts):
        text = f"The noise is not stated but estimated from the residuals, and priors are weighed against it: {listed}."
        action = "State it once you know it: only then do residuals show that the model lacks something."
        return [Finding("note", text, "restricted maximum likelihood", action)]
    mostly = components.mostly_joints
    whose, share = ("the joints", joints) if mostly else ("the instruments", 1 - joints)
    meaning = (
        " A joint's part is what acts like an angle that is off, repeatable or not: an effect that the model lacks "
        "looks the same. Poses measured twice would separate the two."
    )
    text = f"Most of the residual variance comes from {whose} ({100 * share:.0f} %): {listed}."
    findings = [Finding("note", text + (meaning if mostly else ""))]
    if components.inseparable:
        pairs = ", ".join(f"{a} and {b} ({r:+.2f})" for a, b, r in components.inseparable)
        findings.append(Finding("warning", f"These poses hardly separate some variances: {pairs}."))
    if components.unseen:
        findings.append(Finding("note", f"No residual shows what these joints do: {', '.join(components.unseen)}."))
    return findings
