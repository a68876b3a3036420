"""Everything that a recalibration knows between two records, also as JSON to the last bit; how a record moves it."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from armcal.base.domains import Array
from armcal.errors import DataError
from armcal.estimate.online import Gaussian, OnlineEstimator, kalman_update

from armcal_online.tracking.belief import Belief, most_likely
from armcal_online.tracking.clock import Clock
from armcal_online.tracking.health import Health
from armcal_online.tracking.hypotheses import Candidate, Recent
from armcal_online.tracking.observer import Reading
from armcal_online.tracking.start import FilterSetup

REMEMBERED = 64
"""So many ids are remembered, to know a record that comes twice."""

_REFRESHED = 25
"""After so many accepted records the origin is put where it is most likely within the bounds."""


@dataclass(frozen=True)
class State:
    """Between two records; with it and the records after, everything comes out again.

    Attributes:
        belief: about parameters and Gauss-Markov states.
        anchor: the belief before the records that the estimator still holds.
        held: those records; none for a filter.
        recent: the last records, for judgement.
        clock: by records.
        place: the last record's ``sequence``; None before the first.
        health: and why.
        nis_window: NIS and degrees of freedom of the last accepted records.
        counts: of accepted, rejected and ignored records.
        ids: of the last records, with a hash of their content.
        wary: whether the last records look like a change, which is not certain yet.
        suspects: joints that could not be distinguished when one of them stepped, each followed by itself.
        suspected: the record at which that was decided.
        before_change: the belief before it.
        drifted: how often in a row the NIS as a whole was too large.
        changes: sequence numbers of the last changes that nothing explained.
        sequence: of the last entry.
        at: time of the last record (unix seconds, or as records count it).
    """

    belief: Belief
    anchor: Belief
    held: tuple[Recent, ...] = ()
    recent: tuple[Recent, ...] = ()
    clock: Clock = field(default_factory=Clock)
    place: float | None = None
    health: Health = field(default_factory=Health)
    nis_window: tuple[tuple[float, int], ...] = ()
    counts: Mapping[str, int] = field(default_factory=lambda: {"accepted": 0, "rejected": 0, "ignored": 0})
    ids: tuple[tuple[str, str], ...] = ()
    wary: bool = False
    suspects: tuple[Candidate, ...] = ()
    suspected: int = 0
    before_change: Belief | None = None
    drifted: int = 0
    changes: tuple[int, ...] = ()
    sequence: int = 0
    at: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """As JSON, to the last bit."""
        return {
            "belief": _belief_dict(self.belief),
            "anchor": _belief_dict(self.anchor) if self.held else None,
            "held": [_recent_dict(recent) for recent in self.held],
            "recent": [_recent_dict(recent) for recent in self.recent],
            "clock": asdict(self.clock),
            "place": self.place,
            "health": asdict(self.health),
            "nis": [list(pair) for pair in self.nis_window],
            "counts": dict(self.counts),
            "ids": [list(pair) for pair in self.ids],
            "wary": self.wary,
            "suspects": [
                {"place": s.place, "log_evidence": s.log_evidence, "belief": _belief_dict(s.belief)}
                for s in self.suspects
            ],
            "suspected": self.suspected,
            "before_change": None if self.before_change is None else _belief_dict(self.before_change),
            "drifted": self.drifted,
            "changes": list(self.changes),
            "sequence": self.sequence,
            "at": self.at,
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> State:
        """What ``as_dict`` wrote.

        Raises:
            DataError: an array is not whole.
            KeyError, TypeError, ValueError, AttributeError, IndexError: it is no state.
        """
        belief, before_change = _belief_of(content["belief"]), content["before_change"]
        return cls(
            belief=belief,
            anchor=belief if content["anchor"] is None else _belief_of(content["anchor"]),
            held=tuple(_recent_of(recent) for recent in content["held"]),
            recent=tuple(_recent_of(recent) for recent in content["recent"]),
            clock=Clock.of(**content["clock"]),
            place=None if content["place"] is None else float(content["place"]),
            health=Health.of(**content["health"]),
            nis_window=tuple((float(nis), int(dof)) for nis, dof in content["nis"]),
            counts={what: int(content["counts"][what]) for what in ("accepted", "rejected", "ignored")},
            ids=tuple((str(name), str(content_hash)) for name, content_hash in content["ids"]),
            wary=bool(content["wary"]),
            suspects=tuple(
                Candidate(int(s["place"]), float(s["log_evidence"]), _belief_of(s["belief"]))
                for s in content["suspects"]
            ),
            suspected=int(content["suspected"]),
            before_change=None if before_change is None else _belief_of(before_change),
            drifted=int(content["drifted"]),
            changes=tuple(int(sequence) for sequence in content["changes"]),
            sequence=int(content["sequence"]),
            at=float(content["at"]),
        )

    def digest(self) -> str:
        """A hash of the belief and how it is judged, to the last bit."""
        gaussian = self.belief.gaussian
        hashed = hashlib.sha256()
        for array in (self.belief.origin, gaussian.mean, gaussian.covariance):
            hashed.update(array.astype("<f8").tobytes())
        rest = [asdict(self.health), dict(self.counts), asdict(self.clock), self.sequence, self.drifted]
        hashed.update(json.dumps(rest, sort_keys=True).encode())
        return hashed.hexdigest()[:16]


def _encoded(array: Array) -> dict[str, Any]:
    """An array of numbers: shape, and its bytes in base64 (little-endian doubles)."""
    raw = np.ascontiguousarray(array, dtype="<f8").tobytes()
    return {"shape": list(array.shape), "float64": base64.b64encode(raw).decode("ascii")}


def _decoded(content: Mapping[str, Any]) -> Array:
    raw = np.frombuffer(base64.b64decode(content["float64"]), dtype="<f8")
    if raw.size != int(np.prod(content["shape"])):
        raise DataError("an array in the journal is not whole.", hint="Start again from the last calibration.yaml.")
    return np.array(raw.reshape(content["shape"]), dtype=float)


def _belief_dict(belief: Belief) -> dict[str, Any]:
    """A belief; of its covariance, which is symmetric, the lower triangle."""
    mean, covariance = belief.gaussian.mean, belief.gaussian.covariance
    triangle = covariance[np.tril_indices(len(covariance))]
    return {"origin": _encoded(belief.origin), "mean": _encoded(mean), "covariance": _encoded(triangle)}


def _belief_of(content: Mapping[str, Any]) -> Belief:
    mean = _decoded(content["mean"])
    covariance = np.zeros((len(mean), len(mean)))
    rows, columns = np.tril_indices(len(mean))
    covariance[rows, columns] = covariance[columns, rows] = _decoded(content["covariance"])
    return Belief(_decoded(content["origin"]), Gaussian(mean, covariance))


def _recent_dict(recent: Recent) -> dict[str, Any]:
    return {
        "sequence": recent.sequence,
        "readings": [
            {"factor": r.factor, "group": r.group, "record": _encoded(r.record), "noise": _encoded(r.noise)}
            for r in recent.readings
        ],
        "joint_noise": [None if noise is None else _encoded(noise) for noise in recent.joint_noise],
        "passed": dict(recent.passed),
        "before": _belief_dict(recent.before),
        "rejected": recent.rejected,
        "nis": recent.nis,
        "dof": recent.dof,
    }


def _recent_of(content: Mapping[str, Any]) -> Recent:
    return Recent(
        sequence=int(content["sequence"]),
        readings=tuple(
            Reading(int(r["factor"]), _decoded(r["record"]), int(r["group"]), _decoded(r["noise"]))
            for r in content["readings"]
        ),
        joint_noise=tuple(None if noise is None else _decoded(noise) for noise in content["joint_noise"]),
        passed={str(channel): float(distance) for channel, distance in content["passed"].items()},
        before=_belief_of(content["before"]),
        rejected=bool(content["rejected"]),
        nis=float(content["nis"]),
        dof=int(content["dof"]),
    )


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
