"""What the last records mean: whether something has changed, what, and since when."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from armcal_online.tracking import sentences
from armcal_online.tracking.belief import Belief, widened
from armcal_online.tracking.directions import Steps
from armcal_online.tracking.health import improbability, many_outliers, nis_limit
from armcal_online.tracking.hypotheses import Candidate, Explanation, Hypothesis, HypothesisFilter, Recent
from armcal_online.tracking.sentences import Decision
from armcal_online.tracking.settings import RecalibrateSettings
from armcal_online.tracking.state import State
from armcal_online.tracking.state_space import StateSpace

_SURPRISING = 0.01
"""A record with an NIS as large as this is one in a hundred: two of them near each other are looked into."""
_MOST_ONSETS = 5
"""So many of the last records with a large NIS are tried as the first after a change."""
_MOST_WIDENING = 3.0
_UNEXPLAINED = 3
"""So many changes that nothing explains, or windows of too large NIS: the model no longer fits."""
_LONGEST_NAMING = 100
"""After so many records joints that could not be told apart are left so."""


class Judge:
    """Judges the last records of a recalibration."""

    def __init__(
        self,
        space: StateSpace,
        steps: Steps,
        hypothesis_filter: HypothesisFilter,
        changes: Sequence[Hypothesis],
        settings: RecalibrateSettings,
    ) -> None:
        self._space, self._steps, self._filter = space, steps, hypothesis_filter
        self._changes, self._settings = changes, settings

    def after(self, state: State) -> tuple[State, tuple[Decision, ...]]:
        """What is decided after a record, the last of ``state.recent``; the state follows it."""
        state, named = self._named(state)
        state, changed = self._changed(state)
        if changed is None and state.recent and not state.recent[-1].rejected:
            state, changed = self._drifted(state)
        return state, tuple(decision for decision in (named, changed) if decision is not None)

    def _changed(self, state: State) -> tuple[State, Decision | None]:
        """Whether the last records tell of a change."""
        odd = [i for i, recent in enumerate(state.recent) if self._improbable(recent)]
        if len(odd) < 2 or not (state.wary or odd[-1] == len(state.recent) - 1):
            return (replace(state, wary=False) if len(odd) < 2 else state), None
        found = self._filter.compare(state.recent, odd[-_MOST_ONSETS:], self._changes)
        if not found:
            return state, None
        best = found[0]
        alike = self._alike(found)
        others = [
            explanation
            for explanation in found
            if explanation.hypothesis.subject not in {a.hypothesis.subject for a in alike}
        ]
        total = float(logsumexp([explanation.log_odds for explanation in alike]))
        margin = best.log_odds - others[0].log_odds if others else math.inf
        full = len(odd) >= self._settings.gate.window - 1
        told = total > math.log(self._settings.changes.odds)
        if told and (full or margin >= math.log(self._settings.changes.naming_odds)):
            return self._followed(state, alike, margin, found)
        state = replace(state, wary=bool(best.log_odds > 0))
        return state, self._unexplained(state, found)

    def _alike(self, found: Sequence[Explanation]) -> list[Explanation]:
        """The likeliest, and if it is a joint's the other joints that these records cannot tell from it."""
        best = found[0]
        if not best.hypothesis.kind.startswith("joint"):
            return [best]
        near: dict[str, Explanation] = {}
        for explanation in found:
            close = best.log_odds - explanation.log_odds < math.log(self._settings.changes.naming_odds)
            if close and explanation.hypothesis.kind.startswith("joint"):
                # A slip is the simpler tale; a new servo is told from it later, if it is one.
                known = near.setdefault(explanation.hypothesis.subject, explanation)
                if known.hypothesis.kind == "joint_replaced" and explanation.hypothesis.kind == "joint_slipped":
                    near[explanation.hypothesis.subject] = explanation
        return list(near.values())

    def _improbable(self, record: Recent) -> bool:
        limit = nis_limit(record.dof, 1 - _SURPRISING, self._filter.freedom(record))
        return record.rejected or record.nis > limit

    def _kinds(self, joints: Sequence[Explanation]) -> list[Hypothesis]:
        """Of each joint, that it slipped, and that its servo was replaced."""
        names = [joint.hypothesis.subject for joint in joints]
        kinds = ("joint_slipped", "joint_replaced")
        return [h for h in self._changes if h.subject in names and h.kind in kinds and h.scale == 1.0]

    def _followed(
        self, state: State, alike: Sequence[Explanation], margin: float, found: Sequence[Explanation]
    ) -> tuple[State, Decision]:
        """The state with what a change reopens, from before it on."""
        best = alike[0]
        others = [
            explanation
            for explanation in found
            if explanation.hypothesis.subject not in {a.hypothesis.subject for a in alike}
        ]
        since = state.recent[best.onset :]
        directions = np.hstack([explanation.hypothesis.directions for explanation in alike])
        _, belief = self._filter.follow(since, directions, best.hypothesis.factor)
        suspects: tuple[Candidate, ...] = ()
        if best.hypothesis.kind.startswith("joint"):
            kinds = self._kinds(alike)
            followed = [(self._place(kind), *self._filter.follow(since, kind.directions, 1.0)) for kind in kinds]
            suspects = tuple(Candidate(*each) for each in followed)
        after = replace(
            state,
            belief=belief,
            anchor=belief,
            held=(),
            recent=(),
            nis_window=(),
            drifted=0,
            wary=False,
            suspects=suspects,
            suspected=state.sequence,
            before_change=since[0].before if suspects else None,
        )
        size = self._size(since[0].before, belief, best.hypothesis)
        decision = sentences.change(state, self._steps, alike, margin, others, size)
        if best.hypothesis.kind != "general_change":
            return after, decision
        late = tuple(s for s in state.changes if state.sequence - s < 10 * self._settings.gate.window)
        after = replace(after, changes=(*late, state.sequence)[-_UNEXPLAINED:])
        if len(after.changes) >= _UNEXPLAINED:
            text = f"{len(after.changes)} changes that nothing explains came within a short time"
            return after, sentences.no_longer_fits(state, self._steps, text)
        return after, decision

    def _place(self, hypothesis: Hypothesis) -> int:
        return next(i for i, change in enumerate(self._changes) if change is hypothesis)

    def _named(self, state: State) -> tuple[State, Decision | None]:
        """Which of several joints it was, and whether its servo is another one, once the records tell."""
        if not state.suspects or not state.recent:
            return state, None
        followed = sorted((self._stepped(suspect, state.recent[-1]) for suspect in state.suspects), key=_evidence)
        best, subject = followed[0], self._changes[followed[0].place].subject
        others = [candidate for candidate in followed if self._changes[candidate.place].subject != subject]
        odds = math.log(self._settings.changes.naming_odds)
        if state.sequence - state.suspected > _LONGEST_NAMING:
            return replace(state, suspects=(), before_change=None), None
        if others:
            margin = best.log_evidence - others[0].log_evidence
            if margin < odds:
                return replace(state, suspects=tuple(followed)), None
            names = tuple(dict.fromkeys(self._changes[other.place].subject for other in others))
            left = tuple(candidate for candidate in followed if candidate not in others)
            after = self._taken(state, best, left if len(left) > 1 else ())
            return after, self._told(state, best, names, margin)
        margin = best.log_evidence - followed[1].log_evidence if len(followed) > 1 else math.inf
        if margin < odds:
            return replace(state, suspects=tuple(followed)), None
        if self._changes[best.place].kind == "joint_slipped":
            return replace(state, suspects=(), before_change=None), None
        return self._taken(state, best, ()), self._told(state, best, (), margin)

    def _stepped(self, each: Candidate, record: Recent) -> Candidate:
        gained, belief = self._filter.step(self._filter.fade(each.belief, record), record)
        return Candidate(each.place, each.log_evidence + gained, belief)

    def _taken(self, state: State, best: Candidate, left: tuple[Candidate, ...]) -> State:
        """The state with what a hypothesis believes."""
        before = state.before_change if left else None
        after = replace(state, belief=best.belief, anchor=best.belief, held=(), recent=(), wary=False)
        return replace(after, suspects=left, before_change=before)

    def _told(self, state: State, best: Candidate, others: tuple[str, ...], margin: float) -> Decision:
        hypothesis = self._changes[best.place]
        size = self._size(state.before_change or best.belief, best.belief, hypothesis)
        if others:
            return sentences.named(state, self._steps, hypothesis, others, margin, size)
        return sentences.replaced(state, self._steps, hypothesis, margin, size)

    def _drifted(self, state: State) -> tuple[State, Decision | None]:
        """Whether the NIS as a whole is too large, though no record's is."""
        settings = self._settings.levels
        if len(state.nis_window) < settings.window:
            return state, None
        known = min(map(self._filter.freedom, state.recent), default=math.inf)
        if improbability(state.nis_window, known) >= settings.probability:
            return replace(state, drifted=0, nis_window=state.nis_window[settings.window // 2 :]), None
        total, freedom = (float(sum(column)) for column in zip(*state.nis_window, strict=True))
        ratio, count = total / freedom, len(state.nis_window)
        state = replace(state, nis_window=(), drifted=state.drifted + 1)
        if state.drifted >= _UNEXPLAINED:
            text = f"the NIS of {count} records is {ratio:.1f} times what chance makes it, again and again"
            return state, sentences.no_longer_fits(state, self._steps, text)
        factor = min(math.sqrt(ratio), _MOST_WIDENING)
        belief = widened(state.belief, len(self._space.scales), factor)
        return replace(state, belief=belief, anchor=belief, held=()), sentences.drift(state, count, ratio, factor)

    def _unexplained(self, state: State, found: Sequence[Explanation]) -> Decision | None:
        rejected, gate = sum(recent.rejected for recent in state.recent), self._settings.gate
        if rejected >= gate.window - 1 and len(state.recent) >= gate.window:
            text = f"{rejected} of the last {len(state.recent)} records do not fit"
            return sentences.no_longer_fits(state, self._steps, text)
        if rejected < gate.rejected or self._by_chance(rejected) >= self._settings.changes.probability:
            return None
        return sentences.unexplained(state, rejected, found[0])

    def _by_chance(self, rejected: int) -> float:
        """How probable so many outliers among the last records are, or more."""
        return many_outliers(rejected, self._settings.gate.window, self._settings.outliers.fraction)

    def _size(self, before: Belief, after: Belief, hypothesis: Hypothesis) -> tuple[float, float]:
        """How far a joint stepped (rad or m), and its standard deviation."""
        step, n = hypothesis.step, len(self._space.scales)
        if not step.any():
            return 0.0, 0.0
        moved = self._space.between(before.values(self._space), after.values(self._space))
        along = step / float(step @ step)
        covariance = after.gaussian.covariance[:n, :n]
        return float(along @ moved), math.sqrt(max(float(along @ covariance @ along), 0.0))


def _evidence(candidate: Candidate) -> float:
    """The likeliest first."""
    return -candidate.log_evidence
