"""Slow and small changes, of which no single record is odd: a creeping joint, a drifting instrument, a light load.

If such a change began before some record, the mean of the filter has been off since by a known multiple of its size,
and so is each innovation: the two-stage filter of [Friedland1969] carries both along beside the filter. The size's
likelihood under all records since is Gaussian, and its evidence against no change is known in closed form, at the cost
of a few small products a record. Changes are taken to begin where a track begins; a new track begins again and again.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from armcal.base.arrays import Array
from armcal.estimate.online import Gaussian, Linearised

from armcal_online.tracking.belief import Belief, ProcessNoise
from armcal_online.tracking.hypotheses import GRADUAL, Hypothesis


@dataclass(frozen=True)
class SlowEvidence:
    """What the records since one speak for, of all slow changes (m columns) together."""

    since: int  # the number of the record before which the changes would have begun
    records: int  # how many have been used since
    seconds: float  # since then
    effect: Array  # how far the belief's mean would be off now, by change (N x m)
    information: Array  # of the records about the changes (m x m)
    score: Array  # their weighted innovations along the changes (m)


@dataclass(frozen=True)
class SlowState:
    """Evidence from two beginnings, the older first, and the trends that were found.

    ``trend`` is how far the parameters move in a second, ``wander`` the variance that they gain in one (n; scaled).
    """

    tracks: tuple[SlowEvidence, ...] = ()
    trend: Array | None = None
    wander: Array | None = None


_LONGEST = 200  # records of a track; at half of them the next begins
_FEWEST = 24
_DAY_S = 86400.0
_ROUNDING = 1e-6
_WANDERS = 0.25  # a trend may become as much faster or slower in the time that it took to be weighing


@dataclass(frozen=True)
class Weighing:
    """A slow change: weighed by a track, its size (k; standard deviations) and the covariance of that (k x k)."""

    change: Hypothesis
    track: SlowEvidence
    columns: slice
    log_odds: float
    size: Array
    covariance: Array


class SlowChanges:
    """Evidence for some changes; it keeps no state.

    Args:
        changes: whose directions are reopened at once, or, of the kinds that are gradual, gained in a day.
        process_noise: of the beliefs.
        probability: of any change before one record.
    """

    def __init__(self, changes: Sequence[Hypothesis], process_noise: ProcessNoise, probability: float) -> None:
        self._changes, self._process_noise, self._probability = changes, process_noise, probability
        self._ends = np.cumsum([0, *(change.directions.shape[1] for change in changes)]).tolist()
        n = len(process_noise.rates) + len(process_noise.gauss_markov)
        whole = np.hstack([np.zeros((n, 0)), *(c.directions for c in changes)])
        is_gradual = np.repeat(np.array([c.kind in GRADUAL for c in changes], dtype=bool), np.diff(self._ends))
        self._at_once = whole * ~is_gradual
        self._in_a_second = whole * is_gradual / _DAY_S

    def passed(self, state: SlowState, passed: Mapping[str, float]) -> SlowState:
        """After some distance in each channel: gradual changes have gone on."""
        n, seconds = len(self._process_noise.rates), max(passed.get("time", 0.0), 0.0)
        kept = np.ones(len(self._at_once))
        kept[n:] = self._process_noise.gauss_markov.kept(passed)
        tracks = tuple(
            replace(t, seconds=t.seconds + seconds, effect=t.effect * kept[:, None] + seconds * self._in_a_second)
            for t in state.tracks
        )
        return replace(state, tracks=tracks)

    def carried(self, state: SlowState, belief: Belief, seconds: float) -> Belief:
        if state.trend is None or state.wander is None or seconds <= 0:
            return belief
        n, mean, covariance = len(state.trend), belief.gaussian.mean.copy(), belief.gaussian.covariance.copy()
        mean[:n] += seconds * state.trend
        covariance[np.arange(n), np.arange(n)] += seconds * state.wander
        return Belief(belief.origin, Gaussian(mean, covariance))

    def after(
        self, state: SlowState, sequence: int, prior: Gaussian, record: Linearised, covariance: Array
    ) -> SlowState:
        """With a record that the filter takes: linearised at its prior mean, its innovation's covariance (m x m)."""
        if not self._changes:
            return state
        tracks = tuple(track for track in state.tracks if track.records < _LONGEST)
        if not tracks or (len(tracks) == 1 and tracks[0].records >= _LONGEST // 2):
            m = self._ends[-1]
            tracks = (*tracks, SlowEvidence(sequence, 0, 0.0, self._at_once, np.zeros((m, m)), np.zeros(m)))
        both = np.column_stack([record.slope @ prior.covariance, record.innovation])
        weighted = np.asarray(np.linalg.solve(covariance, both), dtype=np.float64)
        gain, innovation = weighted[:, :-1].T, weighted[:, -1]
        used = []
        for track in tracks:
            seen = record.slope @ track.effect
            effect, score = track.effect - gain @ seen, track.score + seen.T @ innovation
            information = track.information + seen.T @ np.linalg.solve(covariance, seen)
            used.append(SlowEvidence(track.since, track.records + 1, track.seconds, effect, information, score))
        return replace(state, tracks=tuple(used))

    def weighed(self, state: SlowState) -> list[Weighing]:
        """All changes by the track that speaks for them most, the likeliest first."""
        best: dict[str, Weighing] = {}
        for track in state.tracks:
            if track.records < _FEWEST:
                continue
            prior = math.log(self._probability * track.records / len(self._changes))
            for change, start, stop in zip(self._changes, self._ends[:-1], self._ends[1:], strict=True):
                own = slice(start, stop)
                precision = np.eye(stop - start) + track.information[own, own]
                covariance = np.asarray(np.linalg.inv(precision), dtype=np.float64)
                size = covariance @ track.score[own]
                evidence = 0.5 * float(track.score[own] @ size) - 0.5 * float(np.linalg.slogdet(precision)[1])
                known = best.get(change.subject)
                if known is None or evidence + prior > known.log_odds:
                    best[change.subject] = Weighing(change, track, own, evidence + prior, size, covariance)
        return sorted(best.values(), key=lambda one: -one.log_odds)

    def slowest(self, days: float, odds: float) -> dict[str, float]:
        """The rate (rad or m a day) below which a gradual change is not named within some days, by its subject.

        The walk that ``process_noise`` states, of variance q a day, makes a rate r in T days as likely as the rate
        itself until r^2 T / 2q exceeds the log odds needed and what the prior of the rate costs. The noise of records
        comes on top. Nothing hides a change of which no walk is stated: it is left out.
        """
        n, least = len(self._process_noise.rates), {}
        needed = math.log(odds) - math.log(self._probability * 0.5 * _LONGEST / max(len(self._changes), 1))
        for change in self._changes:
            gained, walk = change.directions[:n], self._process_noise.rates * _DAY_S
            gained = np.where(np.abs(gained) > _ROUNDING * np.abs(gained).max(), gained, 0.0)
            if change.kind not in GRADUAL or not walk[gained.any(axis=1)].all():
                continue
            precision = days * gained.T @ (gained / np.where(walk > 0, walk, 1.0)[:, None])
            cost = 0.5 * float(np.linalg.slogdet(np.eye(len(precision)) + precision)[1])
            least_known = float(np.linalg.eigvalsh(precision)[0])
            hidden = math.sqrt(2 * (needed + cost) * (1 + least_known)) / least_known
            least[change.subject] = hidden * max(change.rates)
        return least

    def is_due(self, weighing: Weighing) -> bool:
        """Whether the track of a change ends, so that it is to be decided now."""
        return weighing.track.records >= _LONGEST - 1

    def followed(self, state: SlowState, weighing: Weighing, belief: Belief) -> tuple[SlowState, Belief]:
        """The belief with a change in it; where that is gradual, it goes on from now on."""
        effect = weighing.track.effect[:, weighing.columns]
        gaussian, n = belief.gaussian, len(self._process_noise.rates)
        covariance = gaussian.covariance + effect @ weighing.covariance @ effect.T
        after = Belief(belief.origin, Gaussian(gaussian.mean + effect @ weighing.size, covariance))
        if weighing.change.kind not in GRADUAL:
            return replace(state, tracks=()), after
        directions = self._in_a_second[:n, weighing.columns]
        rate = directions @ weighing.size
        # What moves unforeseen may turn, and others move too, of whichever kind: none of them stays known exactly.
        alike = np.repeat([c.kind in GRADUAL for c in self._changes], np.diff(self._ends))
        moved = np.linalg.norm(self._in_a_second[:n, alike], axis=1) * np.linalg.norm(weighing.size)
        wander = _WANDERS**2 * moved**2 * weighing.track.seconds
        before = (state.trend, state.wander) if state.trend is not None and state.wander is not None else (0.0, 0.0)
        return SlowState((), before[0] + rate, before[1] + wander), after
