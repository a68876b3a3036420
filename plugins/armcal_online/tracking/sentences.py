"""Decisions, each explained in a sentence or two."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from armcal_online.tracking.directions import Steps
from armcal_online.tracking.health import Level
from armcal_online.tracking.hypotheses import Explanation, Hypothesis
from armcal_online.tracking.state import State

EXPLAINED = ("joint_slipped", "joint_replaced", "joint_stepped", "joint_named", "sensor_moved", "drift")
"""Decisions after which what did not fit is explained."""


@dataclass(frozen=True)
class Decision:
    """Something that was decided.

    Attributes:
        kind: in a word.
        sentence: what and why.
        level: of health that it means.
        subject: a joint's channel, or a measurement.
        candidates: joints that these records cannot distinguish, the likeliest first.
        size: of a step (rad or m).
        dimension: of that.
        since: the first record after the change.
    """

    kind: str
    sentence: str
    level: Level
    subject: str = ""
    candidates: tuple[str, ...] = ()
    size: float | None = None
    dimension: str = ""
    since: int = 0


def change(
    state: State,
    steps: Steps,
    alike: Sequence[Explanation],
    margin: float,
    others: Sequence[Explanation],
    size: tuple[float, float],
) -> Decision:
    """A change that is followed from now on."""
    best = alike[0]
    hypothesis, onset = best.hypothesis, state.recent[best.onset]
    since = state.recent[best.onset :]
    rival = f", {margin:.0f} above {_named(others[0].hypothesis)}" if others else ""
    because = (
        f"{sum(record.rejected for record in since)} of the {len(since)} records since do not fit the estimate before; "
        f"it explains {100 * best.share:.0f} % of their misfit (log odds {best.log_odds:.1f}{rival})"
    )
    at = f"record {onset.sequence}"
    if hypothesis.kind == "general_change":
        text = f"Something changed at {at} that no single joint or instrument explains: {because}."
        text += f" All standard deviations are made {hypothesis.factor:g} times larger."
        return Decision("general_change", text, "suspect", since=onset.sequence)
    if hypothesis.kind == "sensor_moved":
        text = f"The frame of {hypothesis.subject} has moved at {at}: {because}. Its placement is found anew."
        return Decision("sensor_moved", text, "watch", hypothesis.subject, since=onset.sequence)
    names = tuple(explanation.hypothesis.subject for explanation in alike)
    dimension = next(joint.dimension for joint in steps.joints if joint.joint == hypothesis.subject)
    if len(names) > 1:
        text = f"Joint {' or '.join(names)} has stepped at {at}: {because}. Poses since do not distinguish them; "
        text += "the variance of their offsets alone is open until a pose does."
        return Decision("joint_stepped", text, "watch", names[0], names, None, dimension, onset.sequence)
    shown = _shown(size, dimension)
    what = f"slipped by {shown}" if hypothesis.kind == "joint_slipped" else f"acts like a new servo, {shown} off,"
    text = f"Joint {names[0]} {what} at {at}: {because}. Its variance alone was reopened."
    return Decision(hypothesis.kind, text, "watch", names[0], names, size[0], dimension, onset.sequence)


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
    text = (
        f"It was joint {joint}, by {_shown(size, dimension)}: its step makes the records since {margin:.1f} in log "
        f"odds likelier than one of {' or '.join(others)}, whose offsets are as before. Its variance alone stays open."
    )
    return Decision("joint_named", text, "watch", joint, (joint,), size[0], dimension, state.suspected)


def replaced(state: State, steps: Steps, hypothesis: Hypothesis, margin: float, size: tuple[float, float]) -> Decision:
    """A joint that stepped acts like a new servo."""
    joint = hypothesis.subject
    dimension = next(joint_step.dimension for joint_step in steps.joints if joint_step.joint == joint)
    text = (
        f"Joint {joint}, {_shown(size, dimension)} off since record {state.suspected}, acts like a new servo: that "
        f"makes the records since {margin:.1f} in log odds likelier than a slip alone. All of it was reopened."
    )
    return Decision("joint_replaced", text, "watch", joint, (joint,), size[0], dimension, state.suspected)


def drift(state: State, count: int, ratio: float, factor: float) -> Decision:
    """The NIS as a whole is too large."""
    text = (
        f"The normalised innovation squared of the last {count} records is {ratio:.1f} times what chance makes it: "
        f"parameters move faster than stated, or the instrument is worse. "
        f"All standard deviations are made {factor:.1f} times larger."
    )
    return Decision("drift", text, "watch", since=state.sequence)


def unexplained(state: State, rejected: int, best: Explanation) -> Decision:
    """Records do not fit, and nothing is decided yet."""
    text = (
        f"{rejected} of the last {len(state.recent)} records do not fit, and nothing explains them yet; the likeliest "
        f"is {_named(best.hypothesis)} (log odds {best.log_odds:.1f})."
    )
    return Decision("unexplained", text, "suspect", since=state.sequence)


def no_longer_fits(state: State, steps: Steps, why: str) -> Decision:
    """No change that is followed here explains the records."""
    unfollowed = f" Steps of {', '.join(steps.unfollowed)} cannot be followed." if steps.unfollowed else ""
    text = f"The model no longer fits: {why}. Calibrate again on a bench, or roll back.{unfollowed}"
    return Decision("model_no_longer_fits", text, "lost", since=state.sequence)


def _named(hypothesis: Hypothesis) -> str:
    if hypothesis.kind == "general_change":
        return "a change of everything"
    return f"joint {hypothesis.subject}" if hypothesis.kind.startswith("joint") else f"a moved {hypothesis.subject}"


def _shown(size: tuple[float, float], dimension: str) -> str:
    if dimension == "length":
        return f"{1000 * size[0]:+.2f} +- {1000 * size[1]:.2f} mm"
    return f"{math.degrees(size[0]):+.2f} +- {math.degrees(size[1]):.2f} deg"
