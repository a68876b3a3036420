"""What is left in residuals, which records are missed, and what priors alone hold, in sentences of the verdict."""

from collections.abc import Iterator

import numpy as np
from scipy.special import stdtrit

from armcal.base.arrays import Array
from armcal.base.domains import Semidefinite, symmetric
from armcal.base.parameters import ParameterBlock
from armcal.base.units import digits, readable
from armcal.diagnose.dependences import TIMES_REPEATS
from armcal.diagnose.evidence import PriorsAlone
from armcal.diagnose.large_errors import BY_CHANCE, Finding, Grade, LargeErrors, first_few
from armcal.diagnose.predictable import FEWEST_POSES, IMITATED, MOST_OF_MEDIAN, Predictable
from armcal.diagnose.predictable import LEVEL as PREDICTED_LEVEL
from armcal.diagnose.residual_structure import FEWEST_RECORDS, WORTHWHILE, ResidualStructure, Structure
from armcal.estimate.estimator import AT_BOUND, Estimate
from armcal.estimate.validation import Halves

MOST_TOLD = 5
FEW_NAMED = 2  # So many combinations that only priors hold are named in the verdict; armcal identify names all
_LIKELY = 0.05  # A cause with less of the odds is not named first
NEGLIGIBLE_SHARE = 0.1  # Of the typical error: what moves the tip by less than this does not matter to it
_NO_NOISE = 0.01
"""Of the declared noise: residuals below it are a simulation's without noise, and how they vary means nothing."""
NOTICEABLE_SD = 0.3  # A shift by less than so many standard deviations is not reported
WORSE, POWER = 0.01, 0.9
"""Level of a loss against the nominal arm, and which share of losses of the size stated is found."""
_MM = "mm"
_VALUES_BY_DECLARED = "Leave out noise.estimate for the values, and use it to learn where the noise comes from."


def determined_finding(estimate: Estimate, alone: PriorsAlone | None, typical_mm: float | None) -> Finding:
    """What the data determines, and whether what it does not matters to the tip."""
    known = estimate.identifiability
    test = "rank of the Jacobian in typical scales"
    if not len(known):
        text = "No parameter was free: the nominal model was judged, nothing was calibrated."
        return Finding("warning", text, test, "Free parameters: parameters.free.")
    count = len(known.undetermined)
    if not count:
        return Finding("good", f"The data determines all {known.rank} free parameters.", test)
    listed = "; ".join(str(combination) for combination in known.undetermined[:MOST_TOLD])
    more = f"; and {count - MOST_TOLD} more" if count > MOST_TOLD else ""
    if alone is None:
        text = f"Not determined by the data, only by priors: {listed}{more}."
        return Finding("bad", text, test, "Free fewer parameters, or measure what armcal identify asks for.")
    held = f"{_plural(count, 'combination is', 'combinations are')} determined by priors alone"
    held += f" ({listed})" if count <= FEW_NAMED else ""
    test = f"{test}; the tip at {alone.poses} poses of recorded joint positions, and at as many between them"
    test += f"; positions, not orientations, up to {alone.up_to}, which nothing measured shows" if alone.up_to else ""
    negligible = np.inf if typical_mm is None else NEGLIGIBLE_SHARE * typical_mm
    if alone.between_mm <= negligible:
        most = f"{alone.between_mm:.2g}" if alone.between_mm >= 0.001 else "0.001"
        text = f"{held}; the tip at unseen poses does not depend on them (at most {most} {_MM}, 1 sd)."
        return Finding("note", text, test, "Nothing for the tip; armcal identify names them.")
    if alone.worst_mm <= negligible:
        text = f"{held}. The tip depends on them by up to {alone.between_mm:.2g} {_MM} (1 sd) where a joint stands "
        text += "between its recorded positions, or is approached from another side there; elsewhere it does not."
        advice = "Measure each joint between its recorded positions too, from both sides; armcal identify names them."
        return Finding("warning", text, test, advice)
    text = f"{held}, and the tip at unseen poses depends on them, by up to {alone.between_mm:.2g} {_MM} (1 sd)."
    return Finding(
        "warning", text, test, "armcal identify names them, and armcal plan finds the poses that determine them."
    )


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


def worse_than_declared(judged_mm: Array, declared_mm: Array, unit: str = _MM) -> list[Finding]:
    """Where held-out records are missed by more than by the fit with the declared noise (N each; nan elsewhere)."""
    seen = np.isfinite(judged_mm) & np.isfinite(declared_mm)
    more, before = judged_mm[seen] - declared_mm[seen], float(np.mean(declared_mm[seen])) if seen.any() else 0.0
    if len(more) < 2 or np.mean(more) <= max(_by_chance(more), WORTHWHILE * before):
        return []
    text = (
        f"Estimated variances make predictions worse: held-out records have an error of "
        f"{readable(before + float(np.mean(more)))} {unit} on average, {readable(before)} {unit} by the declared noise."
    )
    test = "paired differences, one-sided, 5 %, and 1 % of the error"
    return [Finding("note", text, test, _VALUES_BY_DECLARED)]


def steadier_weights(name: str, estimated: Halves, declared: Halves, unit: str) -> list[Finding]:
    """Which weights keep the pose of a measurement nearer between halves of the records, where joints err most.

    Residuals are then the joints' errors, which the pose takes up: smaller ones are no sign of a better pose.
    """
    ours, others = estimated.apart[name], declared.apart[name]
    seen = np.isfinite(ours).all(axis=1) & np.isfinite(others).all(axis=1)
    if seen.sum() < 2:
        return []
    more = ours[seen] - others[seen]
    for sign, action in ((1, _VALUES_BY_DECLARED), (-1, "Keep noise.estimate.")):
        mm, deg = sign * more.T
        if np.mean(mm) <= max(_by_chance(mm), WORTHWHILE * np.mean(others[seen, 0])) or np.mean(deg) <= 0:
            continue
        parts = [
            f"{readable(float(pose[0]))} mm and {readable(float(pose[1]))} deg ({readable(float(error))} {unit})"
            for pose, error in (
                (np.mean(halves.apart[name][seen], axis=0), np.mean(halves.errors[seen]))
                for halves in (estimated, declared)
            )
        ]
        text = (
            f"{name}: its pose differs between halves of the records by {parts[0]} with estimated variances, by "
            f"{parts[1]} with the declared noise; in brackets the error of records by the fit to the other half, "
            "which is the joints' and does not rank poses."
        )
        return [Finding("note", text, f"{seen.sum()} divisions, paired differences, one-sided, 5 %, and 1 %", action)]
    return []


def _by_chance(differences: Array, level: float = 0.05) -> float:
    count = len(differences)
    return float(stdtrit(count - 1, 1 - level) * np.std(differences, ddof=1) / np.sqrt(count))


def worse_than_nominal(judged_mm: Array, nominal_mm: Array, spent: float = 0.0, unit: str = _MM) -> list[Finding]:
    """Where records that did not train are missed by more than by the nominal arm (N each; nan where not judged).

    Parameters that spend p of m equations make errors sqrt(1 + p / (m - p - 1)) times as large [Breiman1983] though
    nothing is wrong: ``spent`` is p / (m - 1). What is more than that, and more than chance, is worse.
    """
    seen = np.isfinite(judged_mm) & np.isfinite(nominal_mm)
    if np.count_nonzero(seen) < 2 or spent >= 1:
        return []
    after, before = float(np.mean(judged_mm[seen])), float(np.mean(nominal_mm[seen]))
    if after <= before:
        return []
    factor = 1 / np.sqrt(1 - spent)
    more = judged_mm[seen] - factor * nominal_mm[seen]
    least = _by_chance(more, WORSE) + _by_chance(more, 1 - POWER)
    which = f"on {len(more)} records that did not train it: {readable(after)} {unit} on average, {readable(before)} of "
    which += "the nominal arm, placed by the records that trained as far as it may move."
    test = (
        f"paired differences, one-sided, {100 * WORSE:g} %, beyond the {percent(factor - 1)} that so many parameters "
        f"make; {100 * POWER:g} % of losses of {readable(least)} {unit} would show"
    )
    if np.mean(more) <= _by_chance(more, WORSE):
        action = "Nothing is gained by it on poses like these: keep the nominal arm, or measure more poses."
        return [Finding("note", f"No better than the nominal arm {which}", test, action)]
    action = "Do not use it. Look at what trained: too few postures, too much alike, or some of them wrong."
    return [Finding("bad", f"Worse than the nominal arm {which}", test, action)]


def structure_findings(structure: ResidualStructure | None, unit: str = _MM) -> list[Finding]:
    """What residuals still depend on."""
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
            text += f" {_plural(len(structure.structures), 'would', 'would each')} lower it by less than 1 %."
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
    """What takes up what each kind of carrier predicts."""
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
    more = len(named) - MOST_TOLD
    text = f"Residuals still depend on {'; or on '.join(named[:MOST_TOLD])}"
    text += f"; or on {more} more (metrics.json). " if more > 0 else ". "
    text += f"These data do not identify which. Modelled as {s.words}, which has {_share(s.odds)} of the odds, {falls}."
    model = f" Then model it: {s.effect}." if s.effect and s.kind not in ("order", "step") else ""
    return Finding("warning", text, test, f"To find out: {s.measure}.{model}")


def _share(odds: float) -> str:
    return "over 99 %" if odds > 0.99 else "less than 1 %" if odds < 0.01 else f"{100 * odds:.0f} %"


def _scatter(structure: ResidualStructure) -> list[Finding]:
    """What the size of residuals depends on."""
    noise = structure.noise
    if noise is None or noise.high < _NO_NOISE:
        return []
    text = f"The spread of the residuals depends on {'; or on '.join([noise.words, *noise.alternatives[:MOST_TOLD]])}:"
    text += f" from {digits(noise.low, 2)} to {digits(noise.high, 2)} times the declared noise, in the thirds of the"
    text += " records with the least and the most of it. Either the noise varies, or the model errs more there."
    test = f"regression of squared residuals, p {_p(noise.p_value)} over everything looked at"
    action = (
        "Repeat a pose at both ends of it: if repeats spread equally, the model is the cause; else state noise by "
        "record."
    )
    return [Finding("warning", text, test, action)]


def repeat_findings(structure: ResidualStructure, unit: str) -> list[Finding]:
    """What repeats say of the rest."""
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


def neighbour_findings(structure: ResidualStructure | None, estimate: Estimate, unit: str = _MM) -> list[Finding]:
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


def large_error_findings(large_errors: LargeErrors | None, unit: str = _MM) -> list[Finding]:
    """Records beyond the limit, each with what is unusual about it."""
    if large_errors is None:
        return []
    limit = (
        "validation.limit_mm"
        if large_errors.configured
        else f"what noise and uncertain parameters do, {100 * BY_CHANCE:g} % over all"
    )
    test = f"errors of {large_errors.judged} records by fits that did not see them, limit {limit}"
    if not large_errors.beyond:
        return [Finding("good", f"No judged record has an error {large_errors.in_words(unit)}.", test)]
    listed = "; ".join(
        f"{miss.record_id} ({readable(miss.error_mm)} {unit}: {', '.join(miss.reasons)})"
        for miss in large_errors.explained[:MOST_TOLD]
    )
    more = f"; and {large_errors.beyond - MOST_TOLD} more, in the report" if large_errors.beyond > MOST_TOLD else ""
    records = _plural(large_errors.beyond, "record has", "records have")
    text = f"{records} an error {large_errors.in_words(unit)}: "
    advice = "; or ".join(dict.fromkeys(miss.advice for miss in large_errors.explained[:MOST_TOLD]))
    return [Finding("warning", f"{text}{listed}{more}.", test, f"{advice.capitalize()}.")]


def _plural(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


def _p(p: float) -> str:
    return f"{p:.3f}" if p >= 0.01 else f"below {0.005 if p < 0.005 else 0.01:g}"
