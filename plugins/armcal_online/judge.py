"""What the last records mean: whether something has changed, what, since when, and how far the estimate is trusted."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from armcal.estimate.online import Linearised
from scipy.special import logsumexp

from armcal_online.belief import Belief, StateSpace
from armcal_online.decisions import EXPLAINED, Decision, log_odds_of, per_cent
from armcal_online.hypotheses import (
    CAUSES,
    GRADUAL,
    LEAST_RECORDS,
    Explanation,
    Hypothesis,
    SlowChanges,
    Steps,
    is_enough,
    pairs,
    spoken,
)
from armcal_online.settings import ChangeSettings, RecalibrateSettings
from armcal_online.state import Health, State, improbability, many_outliers, nis_limit
from armcal_online.window_evidence import HypothesisFilter, Size, rate_of, size_of


def _change_decision(state: State, alike: Sequence[Explanation], others: Sequence[Explanation], size: Size) -> Decision:
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


def _together_decisions(
    state: State,
    steps: Steps,
    alike: Sequence[Explanation],
    others: Sequence[Explanation],
    sizes: Sequence[Size],
) -> tuple[Decision, ...]:
    """A decision for each of two changes at once, or one where several pairs are as likely."""
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


def _unfit_decision(state: State, steps: Steps, why: str, log_odds: float, since: int | None = None) -> Decision:
    unfollowed = f"; steps of {', '.join(steps.unfollowed)} cannot be followed" if steps.unfollowed else ""
    first = _first_rejected(state) if since is None else since
    return Decision("model_no_longer_fits", "The model no longer fits the records", why + unfollowed, log_odds, first)


def beside_model_error(decision: Decision, far: float, log_likelihood: float, settings: ChangeSettings) -> Decision:
    """Its odds are over the model's own error too, which is named beside it where it may be that.

    ``far`` and ``log_likelihood`` are of ``in_model_errors``. That error needs no event to be there; a change is rare.
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


def _first_of(state: State, count: int) -> int:
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


_LARGE = 0.01  # a record with an NIS as large as this is one in a hundred: two of them near each other are looked into
_AGREEING = 2
"""A change explains at least so many of the records that do not fit, and at least this share of the misfit: one wrong
record alone is no evidence of it. Two changes, a load or a bent link fit two records too easily."""
_SHARE = 0.5
_LEFT = 0.01  # what explains the records leaves no more outliers among them than chance makes with this probability
_MOST_WIDENING = 3.0
_UNNAMED = 2.0  # standard deviations are made so many times larger where something slow moves that has no name
_UNEXPLAINED = 3  # so many changes that nothing explains, or windows of too large NIS: the model no longer fits
_LONGEST_NAMING = 100  # after so many records joints that could not be distinguished are left so
_STATED = 40  # the stated share of outliers counts as if it came from so many records
_TOO_MANY = 1e-3  # more outliers than chance makes with this probability are a reason to watch


class Judge:
    def __init__(
        self,
        space: StateSpace,
        steps: Steps,
        hypothesis_filter: HypothesisFilter,
        changes: Sequence[Hypothesis],
        slow: SlowChanges,
        settings: RecalibrateSettings,
    ) -> None:
        self._space, self._steps, self._filter, self._slow = space, steps, hypothesis_filter, slow
        self._changes, self._settings = changes, settings

    def after(self, state: State) -> tuple[State, tuple[Decision, ...]]:
        state, naming = self._name_suspect(state)
        state, change = self._detect_change(state)
        if not change and state.recent and not state.recent[-1].rejected:
            state, change = self._detect_drift(state)
            if not change:
                state, change = self._detect_slow(state)
        decisions = (*naming, *change)
        return (replace(state, slow=replace(state.slow, tracks=())) if decisions else state), decisions

    def health(self, state: State, decisions: Sequence[Decision], first: Linearised) -> Health:
        """After a record, the last of ``state.recent`` before the decisions; ``first`` is at its prior mean."""
        health, settings, recent = state.health, self._settings, state.recent[-1]
        for decision in decisions:
            if decision.kind in EXPLAINED and health.level != "lost":
                # What was suspected is explained now.
                unknown = health.best if decision.kind == "drift" else "nominal"
                health = Health(decision.level, 0, decision.sentence, unknown)
            else:
                health = health.troubled(decision.level, decision.sentence)
                if decision.kind == "general_change":
                    health = replace(health, best="watch")
        if decisions:
            return health
        if recent.rejected:
            window, rejected = settings.gate.window, sum(record.rejected for record in state.recent)
            odd = many_outliers(rejected, window, self._outliers(state)) < _TOO_MANY
            return health.troubled(
                "watch" if odd else "nominal", f"{rejected} of the last {window} records do not fit."
            )
        limit = settings.levels.tip_sd
        if limit is not None:
            forecast = first.slope @ recent.before.gaussian.covariance @ first.slope.T
            sd = math.sqrt(max(float(np.linalg.eigvalsh(forecast)[-1]), 0.0))
            if sd > limit:
                text = f"The predicted tip has an sd of {1000 * sd:.2f} mm; {1000 * limit:.2f} mm is tolerable."
                return health.troubled("watch", text)
        return health.calmed(settings.levels.calm)

    def _detect_change(self, state: State) -> tuple[State, tuple[Decision, ...]]:
        large = [
            i
            for i, record in enumerate(state.recent)
            if record.rejected or record.nis > nis_limit(record.dof, 1 - _LARGE, self._filter.freedom(record))
        ]
        if len(large) < 2 or not (state.wary or large[-1] == len(state.recent) - 1):
            return (replace(state, wary=False) if len(large) < 2 else state), ()
        explanations = self._weighed(state, large)
        if not explanations:
            return state, ()
        best, gate, settings = explanations[0], self._settings.gate, self._settings.changes
        alike = self._indistinguishable(explanations)
        others = _others(explanations, alike)
        margin = best.log_odds - others[0].log_odds if others else math.inf
        is_clear, is_due = margin >= math.log(settings.naming_odds), len(large) >= gate.window - 1
        if is_due and not is_clear:
            # It has to be decided now: nothing is named that is hardly likelier than something else.
            alike = self._candidates(explanations)
            best, others = alike[0], _others(explanations, alike)
        total = float(logsumexp([explanation.log_odds for explanation in alike]))
        if total > math.log(settings.odds) and (is_clear or is_due) and self._is_explaining(state, best):
            return self._follow_change(state, alike, others)
        state = replace(state, wary=bool(best.log_odds > 0))
        rejected = sum(record.rejected for record in state.recent)
        by_chance = many_outliers(rejected, gate.window, self._outliers(state))
        if rejected >= gate.window - 1 and len(state.recent) >= gate.window:
            text = f"{rejected} of the last {len(state.recent)} records do not fit"
            return state, (_unfit_decision(state, self._steps, text, log_odds_of(by_chance)),)
        if rejected < gate.rejected or by_chance >= settings.probability:
            return state, ()
        what = f"{rejected} of the last {len(state.recent)} records do not fit, and no change explains them yet"
        why = (
            f"outliers alone are rarely so many; the likeliest change is {_named(best.hypothesis)} "
            f"({per_cent(best.log_odds):.0f} %)"
        )
        return state, (Decision("unexplained", what, why, log_odds_of(by_chance), _first_rejected(state)),)

    def _outliers(self, state: State) -> float:
        """The share of wrong records: as stated, or more where records before the last ones had more."""
        stated, lately = self._settings.outliers.fraction, sum(record.rejected for record in state.recent)
        rejected = state.counts["rejected"] - lately
        earlier = rejected + state.counts["accepted"] - (len(state.recent) - lately)
        return max(stated, (_STATED * stated + rejected) / (_STATED + earlier))

    def _weighed(self, state: State, large: Sequence[int]) -> list[Explanation]:
        """All changes, the likeliest first; two at once where one does not explain what the records say."""
        singles = self._filter.compare(state.recent, large, self._changes)
        if len(large) < LEAST_RECORDS or not singles:
            return singles
        if is_enough(singles[0], sum(i >= singles[0].onset for i in large)):
            return singles
        double = self._filter.compare(state.recent, large, pairs(singles, self._changes), LEAST_RECORDS)
        return sorted([*singles, *double], key=lambda explanation: -explanation.log_odds)

    def _is_explaining(self, state: State, best: Explanation) -> bool:
        # Where the model is slightly wrong, as neighbours that err alike show, large NIS alone are no evidence.
        agreeing = best.rejected if self._filter.is_model_wrong else best.large
        late = state.changes and state.sequence - state.changes[-1] < 2 * self._settings.gate.window
        if late and best.hypothesis.kind != "general_change":
            return False  # what is left of a change that nothing explained is no joint's
        if many_outliers(*best.outliers, self._outliers(state)) < _LEFT:
            return False
        return agreeing >= (_AGREEING if best.hypothesis.is_simple else LEAST_RECORDS) and best.share >= _SHARE

    def _indistinguishable(self, explanations: Sequence[Explanation]) -> list[Explanation]:
        """The likeliest, and if it is a joint's the other joints that these records cannot distinguish from it."""
        best, odds = explanations[0], math.log(self._settings.changes.naming_odds)
        if best.hypothesis.parts:
            return [e for e in explanations if e.hypothesis.parts and best.log_odds - e.log_odds < odds]
        if not best.hypothesis.kind.startswith("joint"):
            return [best]
        near: dict[str, Explanation] = {}
        for explanation in explanations:
            close = best.log_odds - explanation.log_odds < odds
            if close and explanation.hypothesis.kind.startswith("joint"):
                # A slip is the simpler explanation; later records distinguish a new servo from it, if it is one.
                known = near.setdefault(explanation.hypothesis.subject, explanation)
                if known.hypothesis.kind == "joint_replaced" and explanation.hypothesis.kind == "joint_slipped":
                    near[explanation.hypothesis.subject] = explanation
        return list(near.values())

    def _candidates(self, explanations: Sequence[Explanation]) -> list[Explanation]:
        """All that these records cannot distinguish from the likeliest; a change of everything, if that is one."""
        best, odds = explanations[0], math.log(self._settings.changes.naming_odds)
        near = [e for e in explanations if best.log_odds - e.log_odds < odds]
        everything = [e for e in near if e.hypothesis.kind == "general_change"]
        if everything or best.hypothesis.parts:
            return everything[:1] or self._indistinguishable(explanations)
        return list({e.hypothesis.subject: e for e in reversed(near) if not e.hypothesis.parts}.values())[::-1]

    def _follow_change(
        self, state: State, alike: Sequence[Explanation], others: Sequence[Explanation]
    ) -> tuple[State, tuple[Decision, ...]]:
        best, since = alike[0], state.recent[alike[0].onset :]
        reopened = {id(change): change for explanation in alike for change in explanation.hypothesis.singles}
        directions = np.hstack([change.directions for change in reopened.values()])
        belief = self._filter.follow(-1, since, directions, best.hypothesis.factor).belief
        # Of each joint, that it slipped, and that its servo was replaced.
        subjects = [] if best.hypothesis.parts else [explanation.hypothesis.subject for explanation in alike]
        suspects = tuple(
            self._filter.follow(place, since, change.directions)
            for place, change in enumerate(self._changes)
            if change.subject in subjects and change.subject and change.scale == 1.0
        )
        suspects = suspects if len(suspects) > 1 else ()
        after = replace(
            state,
            belief=belief,
            recent=(),
            nis=(),
            drifted=0,
            wary=False,
            suspects=suspects,
            suspected=since[0].sequence,
            before_change=since[0].before if suspects else None,
        )
        sizes = [self._size(since[0].before, belief, change) for change in best.hypothesis.singles]
        if best.hypothesis.parts:
            return after, _together_decisions(state, self._steps, alike, others, sizes)
        decision = _change_decision(state, alike, others, sizes[0])
        if best.hypothesis.kind == "general_change":
            late = tuple(s for s in state.changes if state.sequence - s < 10 * self._settings.gate.window)
            after = replace(after, changes=(*late, state.sequence)[-_UNEXPLAINED:])
            if len(after.changes) >= _UNEXPLAINED:
                text = f"{len(after.changes)} changes that nothing explains came within a short time"
                first = after.changes[0]
                return after, (_unfit_decision(state, self._steps, text, decision.log_odds, first),)
        return after, (decision,)

    def _name_suspect(self, state: State) -> tuple[State, tuple[Decision, ...]]:
        """Which of several joints it was, and whether its servo is another one, once the records determine it."""
        if not state.suspects or not state.recent:
            return state, ()
        followed = [self._filter.step(suspect, state.recent[-1]) for suspect in state.suspects]
        followed.sort(key=lambda candidate: -candidate.log_evidence)
        best, change = followed[0], self._changes[followed[0].place]
        others = [candidate for candidate in followed if self._changes[candidate.place].subject != change.subject]
        rivals = others or followed[1:]
        margin = best.log_evidence - rivals[0].log_evidence if rivals else math.inf
        settled = replace(state, suspects=(), before_change=None)
        if state.sequence - state.suspected > _LONGEST_NAMING:
            return settled, ()
        changes = self._settings.changes
        if margin < math.log(changes.naming_odds if others else changes.odds):
            return replace(state, suspects=tuple(followed)), ()
        if not others and change.kind != "joint_replaced":
            return settled, ()
        left = tuple(candidate for candidate in followed if candidate not in others) if others else ()
        after = replace(settled, belief=best.belief, recent=(), wary=False)
        if len(left) > 1:
            after = replace(after, suspects=left, before_change=state.before_change)
        size = self._size(state.before_change or best.belief, best.belief, change)
        about = (margin, state.suspected, change.subject, (change.subject,), size)
        names = _or(list(dict.fromkeys(self._changes[other.place].subject for other in others)))
        if others and change.kind.startswith("joint"):
            why = f"the records since do not fit a change of {names} as well, which is as before"
            what = f"It was joint {change.subject} that stepped, by {size.shown}"
            return after, (Decision("joint_named", what, why, *about),)
        better = f"a change of {names}, which is as before" if others else "a slip alone"
        why = f"the records since fit this better than {better}"
        return after, (Decision(change.kind, _happened(change, size), why, *about),)

    def _detect_drift(self, state: State) -> tuple[State, tuple[Decision, ...]]:
        settings = self._settings.levels
        if len(state.nis) < settings.window:
            return state, ()
        known = min(map(self._filter.freedom, state.recent), default=math.inf)
        by_chance = improbability(state.nis, known)
        if by_chance >= settings.probability:
            return replace(state, drifted=0, nis=state.nis[settings.window // 2 :]), ()
        total, freedom = (float(sum(column)) for column in zip(*state.nis, strict=True))
        ratio, count = total / freedom, len(state.nis)
        state = replace(state, nis=(), drifted=state.drifted + 1)
        if state.drifted >= _UNEXPLAINED:
            text = f"the NIS of {count} records is {ratio:.1f} times what chance makes it, again and again"
            since = _first_of(state, _UNEXPLAINED * count)
            return state, (_unfit_decision(state, self._steps, text, log_odds_of(by_chance), since),)
        factor = min(math.sqrt(ratio), _MOST_WIDENING)
        belief = state.belief.widened(len(self._space.scales), factor)
        what = f"The last {count} records miss by more than stated, although no single one does by much"
        why = (
            f"their mean normalised innovation squared is {ratio:.1f} times what chance makes it; parameters move "
            "faster than stated, or the instrument is worse; "
            f"all standard deviations are made {factor:.1f} times larger"
        )
        decision = Decision("drift", what, why, log_odds_of(by_chance), _first_of(state, count))
        return replace(state, belief=belief), (decision,)

    def _detect_slow(self, state: State) -> tuple[State, tuple[Decision, ...]]:
        weighings, settings = self._slow.weighed(state.slow), self._settings.changes
        if not weighings or state.suspects or weighings[0].log_odds <= math.log(settings.odds):
            return state, ()
        best, odds = weighings[0], math.log(settings.naming_odds)
        near = [one for one in weighings if best.log_odds - one.log_odds < odds]
        others = [one.log_odds for one in weighings if one not in near]
        log_odds = float(logsumexp([one.log_odds for one in near]) - logsumexp([0.0, *others]))
        why = f"no single one of the {best.track.records} records since shows it, but all of them together do"
        since = best.track.since
        if len(near) > 1 and not self._slow.is_due(best):
            return state, ()
        if len(near) > 1:
            belief = state.belief.widened(len(self._space.scales), _UNNAMED)
            candidates = tuple(one.change.subject for one in near)
            what = f"Something moves more than stated: {_or(candidates)}"
            why += f", and they fit these about equally; all standard deviations are made {_UNNAMED:g} times larger"
            decision = Decision("drift", what, why, log_odds, since, "", candidates)
            return replace(state, belief=belief), (decision,)
        slow, belief = self._slow.followed(state.slow, best, state.belief)
        is_gradual = best.change.kind in GRADUAL
        size = (
            rate_of(self._steps, best.change, best.size, best.covariance)
            if is_gradual
            else self._size(state.belief, belief, best.change)
        )
        why += f"; the next likeliest is {spoken(weighings[1].change.subject)}" if len(weighings) > 1 else ""
        subject = best.change.subject
        decision = Decision(
            best.change.kind, _happened(best.change, size), why, log_odds, since, subject, (subject,), size
        )
        return replace(state, belief=belief, recent=(), nis=(), slow=slow), (decision,)

    def _size(self, before: Belief, after: Belief, change: Hypothesis) -> Size:
        return size_of(self._space, self._steps, before, after, change)


def _others(explanations: Sequence[Explanation], alike: Sequence[Explanation]) -> list[Explanation]:
    subjects = {explanation.hypothesis.subject for explanation in alike}
    return [
        explanation
        for explanation in explanations
        if explanation.hypothesis.subject not in subjects
        and not (explanation.hypothesis.parts and subjects & {part.subject for part in explanation.hypothesis.parts})
    ]
