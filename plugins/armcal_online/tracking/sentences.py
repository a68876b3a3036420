"""What was decided, in words: a clause of what happened, and one of the evidence."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from armcal_online.tracking.decisions import Decision, log_odds_of, per_cent
from armcal_online.tracking.hypotheses import CAUSES, Explanation, Hypothesis, Steps, spoken
from armcal_online.tracking.settings import ChangeSettings
from armcal_online.tracking.sizes import Size
from armcal_online.tracking.state import State


def change(state: State, alike: Sequence[Explanation], others: Sequence[Explanation], size: Size) -> Decision:
    """A change that is followed from now on."""
    best = alike[0]
    hypothesis, kind, subject = best.hypothesis, best.hypothesis.kind, best.hypothesis.subject
    since = state.recent[best.onset :]
    log_odds = _against(alike, others)
    why = (
        f"{sum(record.rejected for record in since)} of the {len(since)} records since do not fit the estimate before; "
        f"it explains {100 * best.share:.0f} % of their misfit"
    )
    why += f"; the next likeliest is {_named(others[0].hypothesis)}" if others else ""
    onset = since[0].sequence
    if kind == "general_change":
        what = "Something changed that no single joint or instrument explains"
        why += f"; all standard deviations are made {hypothesis.factor:g} times larger"
        return Decision(kind, what, why, log_odds, onset)
    names = tuple(explanation.hypothesis.subject for explanation in alike)
    if len(names) > 1 and all(explanation.hypothesis.kind.startswith("joint") for explanation in alike):
        what = f"Joint {' or '.join(names)} has stepped"
        why += "; poses since do not distinguish them, and the variance of their offsets is open until one does"
        return Decision("joint_stepped", what, why, log_odds, onset, names[0], names)
    if len(names) > 1:
        what = f"One of these changed: {', '.join(_named(explanation.hypothesis) for explanation in alike)}"
        why += "; records since do not distinguish them, and all of them are open until one does"
        return Decision("one_of_several", what, why, log_odds, onset, "", names)
    what = _happened(hypothesis, size)
    return Decision(kind, what, why, log_odds, onset, subject, names, size)


def together(
    state: State,
    steps: Steps,
    alike: Sequence[Explanation],
    others: Sequence[Explanation],
    sizes: Sequence[Size],
) -> tuple[Decision, ...]:
    """Two changes at once that are followed from now on: a decision each, or one where several pairs are as likely."""
    best, since = alike[0], state.recent[alike[0].onset :]
    log_odds, onset = _against(alike, others), since[0].sequence
    why = (
        f"{sum(record.rejected for record in since)} of the {len(since)} records since do not fit the estimate before; "
        f"two changes together explain {100 * best.share:.0f} % of their misfit, and no single one does"
    )
    parts = best.hypothesis.parts
    if len(alike) > 1:
        names = tuple(dict.fromkeys(part.subject for pair in alike for part in pair.hypothesis.parts))
        joints = tuple(name for name in names if steps.dimension(name)) or names
        what = f"Two of {', '.join(names)} have changed at once"
        why += "; poses since do not distinguish them, and the variance of their offsets is open"
        return (Decision("joint_stepped", what, why, log_odds, onset, joints[0], joints),)
    decisions = []
    for part, other, size in zip(parts, reversed(parts), sizes, strict=True):
        what, names = f"{_happened(part, size)}; {_named(other)} changed at the same time", (part.subject,)
        decisions.append(Decision(part.kind, what, why, log_odds, onset, part.subject, names, size))
    return tuple(decisions)


def slow(change: Hypothesis, size: Size, since: int, records: int, log_odds: float, next_likeliest: str) -> Decision:
    why = f"no single one of the {records} records since shows it, but all of them together do"
    why += f"; the next likeliest is {spoken(next_likeliest)}" if next_likeliest else ""
    return Decision(change.kind, _happened(change, size), why, log_odds, since, change.subject, (change.subject,), size)


def slow_unnamed(candidates: Sequence[str], since: int, records: int, log_odds: float, factor: float) -> Decision:
    """Something moves slowly, and the records do not distinguish what."""
    what = f"Something moves more than stated: {_or(candidates)}"
    why = (
        f"no single one of the {records} records since shows it, but all of them together do, and they fit these about "
        f"equally; all standard deviations are made {factor:g} times larger"
    )
    return Decision("drift", what, why, log_odds, since, "", tuple(candidates))


def named(state: State, change: Hypothesis, others: Sequence[str], margin: float, size: Size) -> Decision:
    """Which of several it was; without others, that a joint which stepped acts like a new servo."""
    about = (margin, state.suspected, change.subject, (change.subject,), size)
    if others and change.kind.startswith("joint"):
        why = f"the records since do not fit a change of {_or(others)} as well, which is as before"
        return Decision("joint_named", f"It was joint {change.subject} that stepped, by {size.shown}", why, *about)
    better = f"a change of {_or(others)}, which is as before" if others else "a slip alone"
    return Decision(change.kind, _happened(change, size), f"the records since fit this better than {better}", *about)


def drift(state: State, count: int, ratio: float, by_chance: float, factor: float) -> Decision:
    what = f"The last {count} records miss by more than stated, although no single one does by much"
    why = (
        f"their mean normalised innovation squared is {ratio:.1f} times what chance makes it; parameters move faster "
        f"than stated, or the instrument is worse; all standard deviations are made {factor:.1f} times larger"
    )
    return Decision("drift", what, why, log_odds_of(by_chance), first_of(state, count))


def unexplained(state: State, rejected: int, by_chance: float, best: Explanation) -> Decision:
    """Records do not fit, and nothing is decided yet."""
    what = f"{rejected} of the last {len(state.recent)} records do not fit, and no change explains them yet"
    why = (
        f"outliers alone are rarely so many; the likeliest change is {_named(best.hypothesis)} "
        f"({per_cent(best.log_odds):.0f} %)"
    )
    return Decision("unexplained", what, why, log_odds_of(by_chance), _first_rejected(state))


def no_longer_fits(state: State, steps: Steps, why: str, log_odds: float, since: int | None = None) -> Decision:
    unfollowed = f"; steps of {', '.join(steps.unfollowed)} cannot be followed" if steps.unfollowed else ""
    first = _first_rejected(state) if since is None else since
    return Decision("model_no_longer_fits", "The model no longer fits the records", why + unfollowed, log_odds, first)


def beside_model_error(decision: Decision, far: float, log_likelihood: float, settings: ChangeSettings) -> Decision:
    """A decision whose odds are over the model's own error too, which is named beside it where it may be that.

    How ``far`` the change moves the readings and the log likelihood of that are of ``sizes.in_model_errors``. The
    model's own error needs no event to be there; a change is as rare as ``settings`` have it.
    """
    log_odds = log_likelihood - math.log(settings.probability)
    if log_odds < -math.log(settings.naming_odds):
        return replace(decision, log_odds=-float(np.logaddexp(-decision.log_odds, log_odds)))
    why = (
        f"it moves the readings by {far:.1f} standard deviations of what the calibration's residuals, which poses near "
        "each other share, and its parameters leave open"
    )
    return replace(decision, what=f"{decision.what}, or the model's own error", why=f"{decision.why}; {why}")


def _against(alike: Sequence[Explanation], others: Sequence[Explanation]) -> float:
    rest = [0.0, *(explanation.log_odds for explanation in others)]
    return float(logsumexp([explanation.log_odds for explanation in alike]) - logsumexp(rest))


def _first_rejected(state: State) -> int:
    return next((record.sequence for record in state.recent if record.rejected), state.sequence)


def first_of(state: State, count: int) -> int:
    return state.ids[-min(count, len(state.ids))].sequence if state.ids else state.sequence


def _named(hypothesis: Hypothesis) -> str:
    if hypothesis.parts:
        return " with ".join(_named(part) for part in hypothesis.parts)
    if hypothesis.kind == "general_change":
        return "a change of everything"
    if hypothesis.kind in CAUSES:
        return spoken(hypothesis.subject)
    return f"joint {hypothesis.subject}" if hypothesis.kind.startswith("joint") else f"a moved {hypothesis.subject}"


def _happened(change: Hypothesis, size: Size) -> str:
    """What happened, as a clause."""
    subject = spoken(change.subject)
    clauses = {
        "joint_slipped": f"Joint {subject} slipped by {size.shown}",
        "joint_replaced": f"Joint {subject} acts like a new servo, {size.shown} off",
        "sensor_moved": f"The frame of {subject} has moved",
        "payload_changed": f"What hangs on the tool changed by {size.shown}, which no record states",
        "gravity_tilted": f"Gravity pulls from another direction than the records state, by {size.shown}",
        "joint_creeping": f"The zero of joint {subject} creeps by {size.shown}",
        "sensor_drifting": f"The readings of {subject} drift by {size.shown}",
        "link_bent": f"{subject[:1].upper()}{subject[1:]} is bent: {size.shown}",
    }
    return clauses[change.kind]


def _or(subjects: Sequence[str]) -> str:
    return " or ".join(map(spoken, subjects))
