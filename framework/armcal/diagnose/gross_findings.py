"""What is grossly wrong with a calibration, and what no data can show, in sentences of the verdict."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation as Turns

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.domains import Rotation
from armcal.base.units import digits
from armcal.diagnose.evidence import Evidence
from armcal.diagnose.gross import AS_MUCH, BEYOND, BY_SHARES, FAR_BEYOND, MOST_RECORDS, Displaced, Figure
from armcal.diagnose.large_errors import Finding, Grade, first_few
from armcal.diagnose.majority import FAR, Minority
from armcal.diagnose.residual_structure import ResidualStructure, Structure
from armcal.estimate.start import BETTER
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.rigid_alignment import FEWEST, hand_eye, sighting_of, tools_of

OF_REACH = 0.03
"""An error beyond this share of the arm's reach, or of a radian, is gross, whatever the arm and its instrument."""
PREDICTED_OF_REACH, EXPLAINED_OF_REACH, EXPLAINED = 0.01, 0.02, 1 / 3
"""Where other poses predict a third of the variance of the residuals, the model lacks what noise does not make: gross
beyond the first share of the reach, or beyond the second where one structure makes up a third of the error, as gravity
does of a printed arm whose base is rigid. A jump that makes up a third of the error is gross, however small."""
OVERFITTED = 3.0
"""Times the noise that training records show, from which on errors of records that did not train are the fit's."""
FEWEST_JUDGED = 10
_JUMPS = frozenset({"step", "slip", "bump"})
_OVER_TIME = _JUMPS | {"order"}
_NO_EXCUSE = _OVER_TIME | {"scale", "held"}
"""Kinds of structure that explain no gross error: something may have moved, a frame or what is held be wrong."""
_LOOK = (
    "Look at what is configured and held (armcal identify --fixed), and at how records and joints were paired: armcal "
    "check says how well the nominal arm fits."
)
_MOVED = (
    "The error depends on when a record was measured: the base, the tracker or the target moved or drifted. Measure "
    "again what differs, or calibrate the records before and after by themselves. parameters.drift models a slow drift."
)
SIZE, GROSS_SIZE = 0.02, 0.05
"""How far the calibrated arm may be larger or smaller than the nominal one: worth a look, and gross."""
EXACT = 1e-5  # Of the reach, 10 um a metre: no arm follows a model so closely, and no instrument measures it so well
MOST_NAMED = 3


def gross_error(judged_mm: Array, figure: Figure, evidence: Evidence) -> list[Finding]:
    """Errors of records that did not train (N; nan where not judged) beside the reach, whatever noise was stated.

    Where nothing measured is a length, angles stand beside a radian (what the reach is at the distance of the reach),
    pixels beside a thousand. Forces and torques have no such size, and are not judged here.
    """
    seen, left, unit = judged_mm[np.isfinite(judged_mm)], evidence.structure, evidence.unit
    reach = (figure.reach_mm, "the arm's reach")
    wholes = {"mm": reach, "mrad": (1000.0, "a radian"), "px": (1000.0, "a thousand px")}
    if not len(seen) or figure.reach_mm <= 0 or unit not in wholes:
        return []
    mean, (whole, name) = float(np.mean(seen)), wholes[unit]
    share = mean / whole
    error = f"The mean error of records that did not train is {digits(mean)} {unit}, {100 * share:.2g} % of {name}"
    if share > OF_REACH:
        test = f"mean, limit {100 * OF_REACH:g} % of {whole:.0f} {unit}"
        return [Finding("bad", f"{error}: the values do not describe this arm.", test, _LOOK)]
    predicted = left.predictable if left is not None and left.is_predictable else None
    if left is None or predicted is None or predicted.share < EXPLAINED:
        return []
    explained = max((_share(s, left) for s in left.worthwhile if s.kind not in _NO_EXCUSE), default=0.0)
    limit = EXPLAINED_OF_REACH if explained >= EXPLAINED else PREDICTED_OF_REACH
    if share <= limit:
        return []
    text = f"{error}, and other records predict {100 * predicted.share:.0f} % of its variance: the model misses it."
    test = (
        f"limits {100 * limit:g} % and {100 * EXPLAINED:.0f} %; one cause explains {100 * explained:.0f} % of the error"
    )
    by_time = not predicted.is_in_order and [carrier.kind for carrier in predicted.carriers[:1]] == ["time"]
    return [Finding("bad", text, test, _MOVED if by_time else _LOOK)]


def jumped(left: ResidualStructure | None) -> list[Finding]:
    """Records that contradict one another: a jump makes up a third of the error, and no order of the poses imitates it.

    Of what depends on time the jump is the largest: a drift has a remedy of its own.
    """
    predicted = None if left is None or not left.is_predictable else left.predictable
    if left is None or predicted is None or predicted.is_in_order:
        return []
    over_time = [s for s in left.worthwhile if s.kind in _OVER_TIME]
    most = max(over_time, key=lambda s: s.falls_mm, default=None)
    if most is None or most.kind not in _JUMPS or _share(most, left) < EXPLAINED:
        return []
    text = f"The records contradict one another: the residuals depend on {most.words}"
    text += f"; without it the mean training error would be {100 * _share(most, left):.0f} % less."
    test = f"score test; limit {100 * EXPLAINED:.0f} % of the error, poses in no order"
    return [Finding("bad", text, test, _MOVED)]


def _share(structure: Structure, left: ResidualStructure) -> float:
    return structure.falls_mm / max(left.mean_mm, 1e-12)


def turn_findings(judged_deg: Array, fitted_deg: Array, held: str) -> list[Finding]:
    """Errors of orientations (N; nan where not judged) beside a radian, as those of lengths stand beside the reach.

    Where no record judges, those that trained do (``fitted_deg``). ``held`` says what should have been free.
    """
    seen = judged_deg[np.isfinite(judged_deg)]
    which, seen = ("that did not train", seen) if len(seen) else ("that trained", fitted_deg)
    mean = float(np.mean(seen))
    if not np.radians(mean) > OF_REACH:
        return []
    text = f"The mean orientation error of records {which} is {digits(mean)} deg: the values do not describe this arm."
    test = f"mean, limit {100 * OF_REACH:g} % of a radian, {np.degrees(OF_REACH):.1f} deg"
    return [Finding("bad", text, test, held or _LOOK)]


def held_turn(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> str:
    """What to free where measured bodies are turned on their tools and their rotations are held; empty if none is.

    Bodies so mounted must turn as the nominal arm's tools do.
    """
    nominal = problem.parameters.nominal()
    for number, kernel in enumerate(problem.kernels):
        own = f"{kernel.factor.name}."
        names = [b.name for b in problem.parameters.blocks if b.name.startswith(own) and isinstance(b.domain, Rotation)]
        sighting = sighting_of(problem.with_records(records), dataset, number, MOST_RECORDS)
        if sighting is None or sighting.turned is None or len(sighting.chosen) < FEWEST:
            continue
        if not names or problem.parameters[names[0]].free:
            continue
        tools = tools_of(problem.with_records(records).subset(sighting.chosen), nominal, number)
        base, mounted = hand_eye(tools.rotations, sighting.turned)
        left = np.swapaxes(base @ tools.rotations @ mounted, 1, 2) @ sighting.turned
        turn, scatter = (float(np.median(Turns.from_matrix(t).magnitude())) for t in (mounted, left))
        if turn > max(OF_REACH, BETTER * scatter):
            return (
                f"Free the target's rotation ({names[0]}), or state it: the measured body is turned by "
                f"{digits(float(np.degrees(turn)), 2)} deg on the tool from where the configuration has it."
            )
    return ""


def worse_than_aligned(judged_mm: Array, left_mm: float, spent: float, held: str) -> list[Finding]:
    """Errors of records that did not train (N; nan where not judged) beside what was left before the fit (median).

    Alignment has nine numbers, and parameters that spend p of m equations make errors 1 / sqrt(1 - p / (m - 1)) times
    as large (``spent`` is the quotient).
    """
    seen = judged_mm[np.isfinite(judged_mm)]
    spent += 3 / max(len(seen), 1)
    after = float(np.median(seen)) if len(seen) else 0.0
    if spent >= 1 or after <= BETTER * left_mm / np.sqrt(1 - spent):
        return []
    text = (
        f"Far worse than the nominal arm as it was aligned before the fit: typically {digits(after)} mm on records "
        f"that did not train, {digits(left_mm)} mm aligned."
    )
    test = f"medians, limit {BETTER / np.sqrt(1 - spent):.2g} times"
    action = "Something that places the arm or its target is held, or has a prior, elsewhere: free it, or correct it."
    return [Finding("bad", text, test, held or action)]


def overfitted(
    trained_mm: Array, judged_mm: Array, nominal_mm: Array, equations: int, freedom: float, unit: str = "mm"
) -> list[Finding]:
    """Errors of records that did not train beside those that did (nan where unknown), parameters counted.

    It is bad where the nominal arm, which the same records placed, is as good.

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
    action = "Measure more poses, more different ones; free fewer parameters; or give priors."
    both = np.isfinite(judged_mm) & np.isfinite(nominal_mm)
    gains = both.any() and np.mean(judged_mm[both]) < np.mean(nominal_mm[both])
    return [Finding("warning" if gains else "bad", text, test, action)]


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
    test = f"sum of residual lengths minimised; far is beyond {FAR:g} sd by the lower quartile"
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
