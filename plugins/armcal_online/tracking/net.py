"""A net under the filter: robust refits of the last records, which take over where they predict the next ones better.

Windows of several lengths are refitted beside the filter, a bounded piece of work with each record. Each window, and
the filter, predict a record before it is used. Where the records are likelier by a window's predictions, by more than
chance makes in a long mission, the belief becomes that window's. Everything is a function of the records.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import ArmcalError
from armcal.estimate.online import Gaussian
from armcal.estimate.robust import median_norm, tuned

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.decisions import Decision
from armcal_online.tracking.hypotheses import Hypothesis
from armcal_online.tracking.refit import NetRecord, NetState, Prediction, Prior, Refit, Refitter
from armcal_online.tracking.start import FilterSetup
from armcal_online.tracking.state import State

WINDOWS = (10, 20, 40, 80)  # lengths of the windows: which of them counts is decided by what they predict
_REMEMBERED = 64  # so many predictions are compared
_MOST_GAIN = 4.0  # what one record can say for a window or against it, in log odds: no outlier decides alone
_ODDS = float(np.log(1e8))
"""Log odds at which a window takes over: neighbours that resemble each other say less than as many that do not."""
_ALERT = 2.0  # log odds from which on all windows are refitted with each record
_ROUNDS = 2
_LARGE = 3.0  # a prediction so many times farther off than its median under the stated noise is one that fails
_LOOKED_AT = 10
_NUMBERS = 3  # predictions of all measurements are compared by the loss of so many numbers
_FARTHEST = 1e9


class Net:
    """Refits and predictions of one recalibration; it keeps no state. A window's prior allows each of ``changes``."""

    def __init__(self, setup: FilterSetup, changes: Sequence[Hypothesis]) -> None:
        self._setup, self._refitter = setup, Refitter(setup.observer)
        n = len(setup.space.scales)
        self._beside = setup.observer.size - n
        # Of a link any number may have changed: the prior is widened where records ask for it.
        directions = [c.directions[:n] for c in changes if c.scale == 1.0 and c.kind != "link_bent"]
        reopened = np.hstack([np.zeros((n, 0)), *directions])
        gaussian = setup.belief.gaussian
        self._mean, self._covariance = gaussian.mean[:n], gaussian.covariance[:n, :n] + reopened @ reopened.T

    def after(
        self, state: State, record: NetRecord, before: Belief, passed: Mapping[str, float], corrected: bool
    ) -> tuple[State, tuple[Decision, ...]]:
        """With a record in the windows, and the refit that takes over, if one does.

        ``before`` is the filter's belief when the record came, ``state`` what it and its judgement made of it.

        Args:
            passed: the distance from the record before, by channel.
            corrected: whether the judgement corrected the filter: the one that failed is no longer there, and what
                it has become is compared anew.
        """
        net = self._predicted(state.net, record, before)
        if corrected:
            net = replace(net, predictions=())
        net = self._taken(net, record, passed.get("time", 0.0), state.belief)
        over = self._take_over(net, state.belief)
        if over is None:
            return replace(state, net=net), ()
        belief, decision = over
        after = state.following(
            belief,
            recent=(),
            nis_window=(),
            wary=False,
            suspects=(),
            before_change=None,
            drifted=0,
            net=replace(net, predictions=()),
            slow=replace(state.slow, tracks=()),
        )
        return after, (decision,)

    def _predicted(self, state: NetState, record: NetRecord, filtered: Belief) -> NetState:
        beside = np.zeros(self._beside)
        points = [(refit.origin, np.concatenate([refit.mean, beside])) for refit in state.refits]
        errors = [self._miss(*point, record) for point in ((filtered.origin, filtered.gaussian.mean), *points)]
        relative, distances = zip(*errors, strict=True)
        prediction = Prediction(record.sequence, relative, distances)
        return replace(state, predictions=(*state.predictions, prediction)[-_REMEMBERED:])

    def _miss(self, origin: Array, point: Array, record: NetRecord) -> tuple[float, float]:
        """How far off a record is predicted; where the arm has no equilibrium, as far as counts."""
        try:
            relative, distance = self._refitter.predicted(origin, point, record)
        except ArmcalError:
            return _FARTHEST, _FARTHEST
        return min(relative, _FARTHEST), distance

    def _taken(self, state: NetState, record: NetRecord, seconds: float, filtered: Belief) -> NetState:
        """With a record in the windows, and some of them refitted: one in turn, or all where the filter may fail."""
        records = (*state.records, record)[-WINDOWS[-1] :]
        state = replace(state, records=records, seconds=state.seconds + max(seconds, 0.0), taken=state.taken + 1)
        n, refits = len(self._mean), list(state.refits)
        start = Refit(filtered.origin, filtered.gaussian.mean[:n])
        while len(refits) < len(WINDOWS) and len(records) >= WINDOWS[len(refits)]:
            refits.append(start)
        if not refits:
            return state
        failing = sum(p.relative[0] > _LARGE for p in state.predictions[-_LOOKED_AT:])
        gains = [self._gain(state.predictions, place)[0] for place in range(len(refits))]
        # The filter may be failing.
        alert, prior = failing >= 2 or max(gains) > _ALERT, self._prior(state.seconds)
        for place in range(len(refits)) if alert else (state.taken % len(refits),):
            window = records[-WINDOWS[place] :]
            if alert:
                others = [replace(refits[place], origin=r.origin, mean=r.mean) for r in (start, *refits[:place])]
                refits[place] = self._refitter.started([refits[place], *others], window)
            refits[place] = self._refitter.refitted(refits[place], prior, window, _ROUNDS)
        return replace(state, refits=tuple(refits))

    def _take_over(self, state: NetState, filtered: Belief) -> tuple[Belief, Decision] | None:
        """The belief of the window that predicts better than the filter beyond chance, the likeliest if several do."""
        gains = [self._gain(state.predictions, place) for place in range(len(state.refits))]
        place = max(range(len(gains)), key=lambda i: gains[i][0], default=None)
        if place is None or gains[place][0] <= _ODDS:
            return None
        log_odds, count = gains[place]
        compared, window = state.predictions[-count:], state.records[-WINDOWS[place] :]
        try:
            belief = self._refitter.belief(state.refits[place], self._prior(state.seconds), window, self._beside)
        except (ArmcalError, np.linalg.LinAlgError):
            return None
        before, after = (1000 * float(np.median([p.distance[i] for p in compared])) for i in (0, place + 1))
        space = self._setup.space
        moved = space.between(filtered.values(space), belief.values(space))
        deviations = np.sqrt(np.diag(belief.gaussian.covariance)[: len(space.scales)])
        most = space.names[int(np.argmax(np.abs(moved) / deviations))]
        what = f"A robust refit of the last {WINDOWS[place]} records took over from the filter"
        why = (
            f"it predicted the last {count} records {after:.2f} mm off in the median, the filter {before:.2f} mm; "
            f"{most} moved most"
        )
        return belief, Decision("refit_took_over", what, why, log_odds, compared[0].sequence)

    def _gain(self, predictions: Sequence[Prediction], place: int) -> tuple[float, int]:
        """Log odds of a window against the filter over the last predictions, as many as speak for it most."""
        known = [(p.relative[0], p.relative[place + 1]) for p in predictions if len(p.relative) > place + 1]
        if not known:
            return 0.0, 0
        errors = np.array(known)
        scale = max(1.0, float(np.median(errors.min(axis=1)[-_LOOKED_AT:])))
        losses = tuned("cauchy", _NUMBERS).rho(errors * median_norm(_NUMBERS) / scale)
        gains = np.clip(losses[:, 0] - losses[:, 1], -_MOST_GAIN, _MOST_GAIN)
        sums = np.cumsum(gains[::-1])
        best = int(np.argmax(sums))
        # A filter that is right to within the stated noise does not fail, though a window may fit a corner better.
        is_right = float(np.median(errors[-best - 1 :, 0])) <= 1.0
        return (0.0 if is_right else float(sums[best])), best + 1

    def _prior(self, seconds: float) -> Prior:
        """What is known without the filter: the calibration, and that anything may have changed since."""
        covariance = self._covariance + np.diag(self._setup.process_noise.rates * seconds)
        return Prior.of(Belief(self._setup.belief.origin, Gaussian(self._mean, covariance)))
