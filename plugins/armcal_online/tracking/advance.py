"""The state after an accepted record."""

from __future__ import annotations

from dataclasses import replace

from armcal.estimate.online import OnlineEstimator, kalman_update

from armcal_online.tracking.belief import Belief, most_likely
from armcal_online.tracking.hypotheses import Recent
from armcal_online.tracking.start import FilterSetup
from armcal_online.tracking.state import State

_REFRESHED = 25
"""After so many accepted records the origin is put where it is most likely within the bounds."""


def advanced(state: State, recent: Recent, setup: FilterSetup, estimator: OnlineEstimator, nis_window: int) -> State:
    """The state with a record taken in by an estimator.

    Args:
        state: before it, with belief and anchor at its time.
        recent: the record.
        setup: of the recalibration.
        estimator: a filter, or one that holds the last records back.
        nis_window: how many NIS the state keeps.

    Raises:
        NotConvergedError: the arm has no elastic equilibrium near the belief.
        ProblemError: the numbers of the belief are no longer sound.
    """
    space, observer, before = setup.space, setup.observer, state.belief
    if estimator.window == 1:
        observation = observer.observation(before, recent.readings, recent.joint_noise)
        belief = before.updated(space, estimator.update(before.gaussian, [observation]).posterior)
        anchor, held = belief, state.held
    else:
        # A record that leaves the window is taken for good, linearised where the records after it lead.
        held = (*state.held, recent)
        prior = state.anchor.about(space, before.origin).gaussian
        observations = [observer.observation(before, record.readings, record.joint_noise) for record in held]
        update = estimator.update(prior, observations, before.gaussian.mean)
        belief = before.updated(space, update.posterior)
        if len(held) >= estimator.window:
            point = update.posterior.mean
            prior, held = kalman_update(prior, observations[0].at(point), point), held[1:]
        anchor = Belief(before.origin, prior)
    if state.counts["accepted"] % _REFRESHED == _REFRESHED - 1:
        # Where bounds hold, steps of the mean lead the origin astray slowly.
        belief = belief.about(space, most_likely(space, belief))
        anchor = anchor if held else belief
    nis = (*state.nis_window, (recent.nis, recent.dof))[-nis_window:]
    return replace(state, belief=belief, anchor=anchor, held=held, nis_window=nis)
