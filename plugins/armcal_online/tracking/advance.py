"""What a good record makes of a state."""

from __future__ import annotations

from dataclasses import replace

from armcal.base.domains import Array
from armcal.estimate.online import OnlineEstimator, kalman_update

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.hypotheses import Recent
from armcal_online.tracking.observer import Reading, Seen
from armcal_online.tracking.projection import most_likely
from armcal_online.tracking.start import FilterSetup
from armcal_online.tracking.state import State

_REFRESHED = 25
"""After so many good records the origin is put where it is most likely within the bounds."""


class Advance:
    """Takes good records in, by an estimator.

    Args:
        setup: what it stands on.
        estimator: that is asked.
        nis_window: how many are kept.
    """

    def __init__(self, setup: FilterSetup, estimator: OnlineEstimator, nis_window: int) -> None:
        self._setup, self._estimator, self._nis_window = setup, estimator, nis_window

    def seen(self, belief: Belief, readings: tuple[Reading, ...], noise: tuple[Array | None, ...]) -> Seen:
        """A record as a belief looks at it."""
        return Seen(self._setup.observer, belief.origin, belief.gaussian.mean, readings, noise)

    def after(self, state: State, recent: Recent) -> State:
        """The state with a record in it.

        Raises:
            NotConvergedError: the arm has no elastic equilibrium near what is believed.
            ProblemError: the numbers of the belief are no longer sound.
        """
        nis_window = (*state.nis_window, (recent.nis, recent.dof))[-self._nis_window :]
        state = replace(state, nis_window=nis_window)
        after = self._filtered(state, recent) if self._estimator.window == 1 else self._held(state, recent)
        return self._refreshed(after) if state.counts["accepted"] % _REFRESHED == _REFRESHED - 1 else after

    def _filtered(self, state: State, recent: Recent) -> State:
        prior = recent.before
        update = self._estimator.update(prior.gaussian, [self.seen(prior, recent.readings, recent.joint_noise)])
        belief = prior.updated(self._setup.space, update.posterior)
        return replace(state, belief=belief, anchor=belief)

    def _held(self, state: State, recent: Recent) -> State:
        """With the last records held back; one that leaves them is taken for good, as it looks from where they led."""
        space, believed, held = self._setup.space, state.belief, (*state.held, recent)
        prior = state.anchor.about(space, believed.origin).gaussian
        observations = [self.seen(believed, each.readings, each.joint_noise) for each in held]
        update = self._estimator.update(prior, observations, believed.gaussian.mean)
        belief, anchor = believed.updated(space, update.posterior), Belief(believed.origin, prior)
        if len(held) >= self._estimator.window:
            place = update.posterior.mean
            anchor, held = Belief(believed.origin, kalman_update(prior, observations[0].at(place), place)), held[1:]
        return replace(state, belief=belief, anchor=anchor, held=held)

    def _refreshed(self, state: State) -> State:
        """The same beliefs about the most likely origin: where bounds hold, steps of the mean lead it astray slowly."""
        space = self._setup.space
        belief = state.belief.about(space, most_likely(space, state.belief))
        return replace(state, belief=belief, anchor=state.anchor if state.held else belief)
