"""What is grossly wrong with a calibration, and what no data can show, in sentences of the verdict."""

from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from armcal.base.arrays import Array
from armcal.base.units import digits
from armcal.diagnose.evidence import Evidence
from armcal.diagnose.gross import AS_MUCH, BEYOND, BY_SHARES, FAR_BEYOND, Displaced, Figure
from armcal.diagnose.majority import Minority
from armcal.diagnose.noise_findings import Finding, Grade, first_few
from armcal.diagnose.residual_structure import ResidualStructure
from armcal.diagnose.rounded import rounding_findings
from armcal.estimate.estimator import CHECK_THE_DATA, Estimate

OF_REACH = 0.03
"""An error beyond this share of the arm's reach is gross, whatever the arm."""
UNEXPLAINED_OF_REACH, EXPLAINED_OF_REACH, TIMES_NOISE, EXPLAINED = 0.005, 0.02, 5.0, 1 / 3
"""An error so many times the declared noise is gross where nothing explains a third of it; beyond the first share of
the reach where other poses predict a third of it, but no cause is known; beyond the second one even where a structure
in the residuals makes up a third of it, as gravity does of a printed arm whose base is rigid."""
OVERFITTED = 3.0
"""Times the noise that training records show, from which on errors of records that did not train are the fit's."""
FEWEST_JUDGED = 10
_NO_EXCUSE = frozenset({"order", "step", "slip", "scale"})
"""Kinds of structure that explain no gross error: something may have moved, or a frame be wrong."""
_MOVED = (
    "The error depends on when a record was measured: the base, the tracker or the target moved or drifted. Measure "
    "again what differs, or calibrate the records before and after by themselves. parameters.drift models a slow drift."
)
SIZE, GROSS_SIZE = 0.02, 0.05
"""How far the calibrated arm may be larger or smaller than the nominal one: worth a look, and gross."""
EXACT = 1e-5
"""Of the reach, 10 um a metre: no arm follows a model so closely, and no instrument measures it so well."""
MOST_NAMED = 3


def gross_error(
    judged_mm: Array,
    figure: Figure,
    estimate: Estimate,
    evidence: Evidence,
    whitened: Array,
) -> list[Finding]:
    """Errors of records that did not train (N; nan where not judged) beside the reach and the noise.

    ``whitened`` are residuals in units of the noise, nan outside of training: where some records alone are far off, and
    named for it, the others are as the noise has it.

    Where nothing measured is a length, angles stand beside a radian (what the reach is at the distance of the reach),
    pixels beside a thousand. Forces and torques have no such size, and are not judged here.
    """
    seen, left, unit = judged_mm[np.isfinite(judged_mm)], evidence.structure, evidence.unit
    reach = (figure.reach_mm, "the arm's reach")
    wholes = {"mm": reach, "mrad": (1000.0, "a radian"), "px": (1000.0, "a thousand px")}
    if not len(seen) or figure.reach_mm <= 0 or unit not in wholes:
        return []
    mean, scale, (whole, name) = float(np.mean(seen)), estimate.noise_scale, wholes[unit]
    share = mean / whole
    error = f"The mean error of records that did not train is {digits(mean)} {unit}, {100 * share:.2g} % of {name}"
    if share > OF_REACH:
        test = f"mean, limit {100 * OF_REACH:g} % of {whole:.0f} {unit}"
        return [Finding("bad", f"{error}: the values do not describe this arm.", test, CHECK_THE_DATA)]
    explained, predicted = _explained(left)
    limit = EXPLAINED_OF_REACH if explained >= EXPLAINED else UNEXPLAINED_OF_REACH if predicted >= EXPLAINED else 0.0
    typical = _typical_size(whitened)
    if share <= limit or min(scale, typical if limit == 0 else np.inf) <= TIMES_NOISE:
        return []
    rounded = rounding_findings(evidence.rounding, unit)
    why = (
        "rounding of the recorded joints would leave as much"
        if rounded
        else "what was found in the residuals does not explain it"
    )
    text = f"{error} and {scale:.0f} times the declared noise; {why}."
    test = (
        f"limits {100 * limit:g} % and {TIMES_NOISE:g} times; one cause explains at most {100 * explained:.0f} % of "
        f"it, other poses predict {100 * predicted:.0f} %"
    )
    action = f"The cause is not known: is the stated noise the instrument's? {CHECK_THE_DATA}"
    action = _MOVED if _by_time(left) else action
    return [Finding("bad", text, test, rounded[0].action if rounded else action)]


def _typical_size(whitened: Array) -> float:
    """That of the middle record, as a multiple of the noise: all its numbers count, for one axis alone may be off."""
    trained, rows = np.isfinite(whitened).any(axis=0), len(whitened)
    sizes = np.sqrt(np.nanmean(whitened[:, trained] ** 2, axis=0))
    return float(np.median(sizes) / np.sqrt(chdtri(rows, 0.5) / rows))


def _by_time(left: ResidualStructure | None) -> bool:
    """Whether time is what predicts most of the residuals."""
    seen = None if left is None or not left.is_predictable else left.predictable
    return seen is not None and [carrier.kind for carrier in seen.carriers[:1]] == ["time"]


def _explained(left: ResidualStructure | None) -> tuple[float, float]:
    """Which shares of the error one cause makes up at most, and other poses predict, whatever the cause."""
    if left is None:
        return 0.0, 0.0
    causes = [s.falls_mm for s in left.worthwhile if s.kind not in _NO_EXCUSE]
    predicted = left.predictable.falls_beside_time if left.predictable is not None and left.is_predictable else 0.0
    return max(causes, default=0.0) / max(left.mean_mm, 1e-12), predicted


def overfitted(trained_mm: Array, judged_mm: Array, equations: int, freedom: float, unit: str = "mm") -> list[Finding]:
    """Errors of records that did not train beside those that did (nan where unknown), parameters counted.

    A fit that spends p of m equations leaves sqrt(1 - p/m) of the noise in the records that train it, so that their
    errors by sqrt(m / (m - p)) are the noise. Records that did not train have sqrt(1 + p / (m - p - 1)) times that
    where poses are alike [Breiman1983]: three times only if p is eight ninths of m, or if poses are not alike.
    """
    judged, trained = judged_mm[np.isfinite(judged_mm)], trained_mm[np.isfinite(trained_mm)]
    if min(len(judged), len(trained)) < FEWEST_JUDGED or freedom <= 0:
        return []
    noise = float(np.median(trained)) * float(np.sqrt(max(equations, freedom) / freedom))
    after = float(np.median(judged))
    if after <= OVERFITTED * noise:
        return []
    text = (
        f"Overfitted: records that did not train have an error of {after:.3g} {unit}, {after / noise:.1f} times what "
        f"the training records lead one to expect ({noise:.3g} {unit})."
    )
    test = f"medians; {equations - freedom:.0f} of {equations} equations are spent on parameters; limit {OVERFITTED:g}"
    return [
        Finding("bad", text, test, "Measure more poses, more different ones; free fewer parameters; or give priors.")
    ]


def contradicting(minority: Minority | None, ids: Sequence[str]) -> list[Finding]:
    """Records that contradict the others; ``ids`` are those of the records looked at, in the order of the fit."""
    if minority is None:
        return []
    count, total = len(minority.far), len(ids)
    text = (
        f"{count} of {total} training records ({100 * count / total:.0f} %) contradict the others: a fit to the "
        f"majority is off by {digits(minority.typical_mm, 2)} mm there, and by {digits(minority.far_mm)} mm in these"
    )
    listed = f"{', '.join(ids[i] for i in minority.far[:MOST_NAMED])}{', ...' if count > MOST_NAMED else ''}"
    test = "sum of residual lengths minimised; far is beyond 8 times the lower quartile"
    if minority.since is None:
        action = f"Find out what is different about them ({listed}): units, joints, the target, reflections."
        return [Finding("bad", f"{text}.", test, action)]
    text += f": nearly all from record {ids[minority.far[0]]} on"
    action = "Something moved there, or slipped: the base, the tracker, the target or a joint. Measure again, or split."
    return [Finding("bad", f"{text}.", test, action)]


def size_findings(figure: Figure) -> list[Finding]:
    """Is the calibrated arm as large as the nominal one?"""
    off, lengths = abs(figure.size - 1), figure.proportion
    action = "Check the units and values of known distances and positions, and the tracker's scale."
    if off > SIZE:
        text = f"The calibrated arm is {figure.size:.3g} times as large as the nominal one."
        test = f"extent of the tool's positions by lengths, limits {100 * SIZE:g} and {100 * GROSS_SIZE:g} %"
        return [Finding("bad" if off > GROSS_SIZE else "warning", text, test, action)]
    if lengths is None or not lengths.is_clear:
        return []
    share, sd = 100 * abs(lengths.share), 100 * lengths.sd
    text = (
        f"The {lengths.count} free lengths of the arm are {share:.2g} % (sd {sd:.1g} %) "
        f"{'longer' if lengths.share > 0 else 'shorter'} than nominal, in proportion: a known distance or an "
        "instrument's scale that is off by as much shows in nothing else."
    )
    levels = f"{100 * AS_MUCH:g} % against lengths off by as much, {100 * BY_SHARES:g} % by shares of their own"
    return [Finding("warning", text, f"regression on the nominal lengths, t, {levels}", action)]


def computed_findings(nominal_mm: Array, judged_mm: Array, figure: Figure) -> list[Finding]:
    """Tips that are computed from the joints: errors of the nominal arm and judged ones (N; nan where there are none).

    Those of the nominal arm leave nothing to calibrate. Those of another model, a controller's, give that.
    """
    limit = EXACT * figure.reach_mm
    medians = [
        np.median(errors[known]) if (known := np.isfinite(errors)).any() else limit
        for errors in (nominal_mm, judged_mm)
    ]
    if not min(medians) < limit:
        return []
    grade: Grade = "bad" if medians[0] < limit else "warning"
    text = (
        f"The measured tips follow the {'nominal' if grade == 'bad' else 'calibrated'} arm to "
        f"{digits(float(min(medians)))} mm, as no measured tip of an arm does: they seem to be computed from the "
        "joints, by the controller, robot_state_publisher or a simulation."
    )
    test = f"median, limit {limit:.2g} mm, {EXACT:g} of the arm's reach"
    return [Finding(grade, text, test, "Give what an instrument measured, not the pose that the robot reports.")]


def displacement_findings(figure: Figure) -> list[Finding]:
    """Parameters that contradict their priors, or are implausibly far from their nominal values."""
    geometry = [displaced for displaced in figure.displaced if displaced.by_prior or not displaced.placement]
    gross = [displaced for displaced in geometry if displaced.by_prior or displaced.times > FAR_BEYOND]
    beyond = [displaced for displaced in geometry if displaced not in gross]
    elsewhere = [
        displaced for displaced in figure.displaced if displaced not in geometry and displaced.times > FAR_BEYOND
    ]
    test = f"limit {BEYOND:g} sd of the prior; without a prior {BEYOND:g} and {FAR_BEYOND:g} typical corrections"
    action = "If the arm is so, correct the nominal values or the prior; else look for a joint's zero, sign, or unit."
    findings = []
    if gross:
        findings.append(Finding("bad", f"Far from the nominal values: {_listed(gross)}.", test, action))
    if beyond:
        findings.append(Finding("warning", f"Far from the nominal values: {_listed(beyond)}.", test, action))
    if elsewhere:
        text = (
            f"The base or the tool's point is far from where the configuration has it: {_listed(elsewhere)}. These "
            "data do not determine whether it is there, or the instrument's frame or target is elsewhere: it has "
            "no prior."
        )
        action = "If the configuration's frame is meant, look for an offset or a unit; else correct the nominal values."
        findings.append(Finding("warning", text, test, action))
    return findings


def _listed(group: Sequence[Displaced]) -> str:
    measures = ["its prior" if displaced.by_prior else "a typical correction" for displaced in group]
    return first_few(
        [
            f"{d.name} by {digits(d.amount)} {d.unit} ({d.times:.0f} times {m})"
            for d, m in zip(group, measures, strict=True)
        ],
        MOST_NAMED,
    )
