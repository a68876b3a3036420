"""What was decided, in words: a clause of what happened, and one of the evidence."""

from __future__ import annotations

import math
from collections.abc import Sequence

from scipy.special import logsumexp

from armcal_online.tracking.decisions import Decision, log_odds_of, per_cent
from armcal_online.tracking.directions import Steps
from armcal_online.tracking.hypotheses import Explanation, Hypothesis
from armcal_online.tracking.state import State


def change(
    state: State,
    steps: Steps,
    alike: Sequence[Explanation],
    others: Sequence[Explanation],
    size: tuple[float, float],
) -> Decision:
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
    if kind == "sensor_moved":
        return Decision(kind, f"The frame of {subject} has moved", why, log_odds, onset, subject)
    names = tuple(explanation.hypothesis.subject for explanation in alike)
    dimension = next(joint.dimension for joint in steps.joints if joint.joint == subject)
    if len(names) > 1:
        what = f"Joint {' or '.join(names)} has stepped"
        why += "; poses since do not distinguish them, and the variance of their offsets is open until one does"
        return Decision("joint_stepped", what, why, log_odds, onset, names[0], names, None, dimension)
    shown = _shown(size, dimension)
    what = f"slipped by {shown}" if kind == "joint_slipped" else f"acts like a new servo, {shown} off"
    return Decision(kind, f"Joint {subject} {what}", why, log_odds, onset, subject, names, size[0], dimension)


def together(
    state: State,
    steps: Steps,
    alike: Sequence[Explanation],
    others: Sequence[Explanation],
    sizes: Sequence[tuple[float, float]],
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
        joints = tuple(name for name in names if any(joint.joint == name for joint in steps.joints)) or names
        what = f"Two of {', '.join(names)} have changed at once"
        why += "; poses since do not distinguish them, and the variance of their offsets is open"
        return (Decision("joint_stepped", what, why, log_odds, onset, joints[0], joints),)
    decisions = []
    for part, other, size in zip(parts, reversed(parts), sizes, strict=True):
        dimension = next((joint.dimension for joint in steps.joints if joint.joint == part.subject), "")
        beside = f"; {_named(other)} changed at the same time"
        if part.kind == "sensor_moved":
            what = f"The frame of {part.subject} has moved{beside}"
            decisions.append(Decision(part.kind, what, why, log_odds, onset, part.subject))
        else:
            what = f"Joint {part.subject} slipped by {_shown(size, dimension)}{beside}"
            names = (part.subject,)
            decisions.append(Decision(part.kind, what, why, log_odds, onset, part.subject, names, size[0], dimension))
    return tuple(decisions)


def named(
    state: State,
    steps: Steps,
    hypothesis: Hypothesis,
    others: Sequence[str],
    margin: float,
    size: tuple[float, float],
) -> Decision:
    """Which joint it was."""
    joint = hypothesis.subject
    dimension = next(joint_step.dimension for joint_step in steps.joints if joint_step.joint == joint)
    what = f"It was joint {joint} that stepped, by {_shown(size, dimension)}"
    why = f"the records since do not fit a step of {' or '.join(others)} as well, whose offsets are as before"
    return Decision("joint_named", what, why, margin, state.suspected, joint, (joint,), size[0], dimension)


def replaced(state: State, steps: Steps, hypothesis: Hypothesis, margin: float, size: tuple[float, float]) -> Decision:
    """A joint that stepped acts like a new servo."""
    joint = hypothesis.subject
    dimension = next(joint_step.dimension for joint_step in steps.joints if joint_step.joint == joint)
    what = f"Joint {joint} acts like a new servo, {_shown(size, dimension)} off"
    why = "the records since fit this better than a slip alone"
    return Decision("joint_replaced", what, why, margin, state.suspected, joint, (joint,), size[0], dimension)


def drift(state: State, count: int, ratio: float, by_chance: float, factor: float) -> Decision:
    """The NIS as a whole is too large."""
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
    """No change that is followed here explains the records."""
    unfollowed = f"; steps of {', '.join(steps.unfollowed)} cannot be followed" if steps.unfollowed else ""
    first = _first_rejected(state) if since is None else since
    return Decision("model_no_longer_fits", "The model no longer fits the records", why + unfollowed, log_odds, first)


def _against(alike: Sequence[Explanation], others: Sequence[Explanation]) -> float:
    """Log odds of some hypotheses together against no change and all others."""
    rest = [0.0, *(explanation.log_odds for explanation in others)]
    return float(logsumexp([explanation.log_odds for explanation in alike]) - logsumexp(rest))


def _first_rejected(state: State) -> int:
    return next((record.sequence for record in state.recent if record.rejected), state.sequence)


def first_of(state: State, count: int) -> int:
    """The number of the first of the last records, as far as they are remembered."""
    return state.ids[-min(count, len(state.ids))].sequence if state.ids else state.sequence


def _named(hypothesis: Hypothesis) -> str:
    if hypothesis.parts:
        return " with ".join(_named(part) for part in hypothesis.parts)
    if hypothesis.kind == "general_change":
        return "a change of everything"
    return f"joint {hypothesis.subject}" if hypothesis.kind.startswith("joint") else f"a moved {hypothesis.subject}"


def _shown(size: tuple[float, float], dimension: str) -> str:
    if dimension == "length":
        return f"{1000 * size[0]:+.2f} mm (sd {1000 * size[1]:.2f} mm)"
    return f"{math.degrees(size[0]):+.2f} deg (sd {math.degrees(size[1]):.2f} deg)"
