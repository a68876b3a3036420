"""Compares a replay with its journal: to the last bit where everything is the same, within a bound where it is not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from armcal.io.journal.segment import Entry, Segment

from armcal_online.evaluator import differences
from armcal_online.running.state_replayer import Event, parsing
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.state import State
from armcal_online.tracking.state_space import StateSpace

BOUND = 1e-6
"""Evaluators differ in the last digits: states that are nearer than this (in standard deviations) are the same."""
_COMPARED = ("event", "sequence", "kind", "joint", "from", "to")
"""Keys of a decision that other last digits do not change."""


@dataclass(frozen=True)
class Distance:
    """Between two states.

    Attributes:
        values: the largest difference of a coordinate, in its standard deviation.
        covariance: the largest difference of an entry, by the standard deviations of its row and column.
    """

    values: float = 0.0
    covariance: float = 0.0

    @property
    def is_small(self) -> bool:
        return self.values <= BOUND and self.covariance <= BOUND

    def widest(self, other: Distance) -> Distance:
        return Distance(max(self.values, other.values), max(self.covariance, other.covariance))


def distance(space: StateSpace, one: State, other: State) -> Distance:
    """Between two states of one problem; infinite where they do not have as many coordinates."""
    ours, theirs = one.belief.gaussian, other.belief.gaussian
    if ours.mean.shape != theirs.mean.shape:
        return Distance(np.inf, np.inf)
    moved = theirs.mean - ours.mean
    moved[: len(space.scales)] = space.between(one.belief.values(space), other.belief.values(space))
    deviations = np.sqrt(np.diag(ours.covariance))
    deviations = np.where(deviations > 0, deviations, 1.0)
    changed = (theirs.covariance - ours.covariance) / np.outer(deviations, deviations)
    return Distance(float(np.abs(moved / deviations).max(initial=0.0)), float(np.abs(changed).max(initial=0.0)))


class DiffersError(Exception):
    """The first difference between a replay and its journal.

    Attributes:
        sequence: after which entry.
        sentence: what differs.
    """

    def __init__(self, sequence: int, sentence: str) -> None:
        self.sequence, self.sentence = sequence, sentence
        super().__init__(sentence)


class ReplayVerifier:
    """Compares states and decisions; mutable.

    Attributes:
        states, equal: how many states were noted, and how many of them came out to the last bit.
        measured: how many of the others were noted in full, and so could be measured.
        decisions: how many were noted.
        widest: the largest distance of those that were measured.
        others: in what the journal's evaluators differ from this one's.
    """

    def __init__(self, evaluator: Mapping[str, Any]) -> None:
        self._evaluator = dict(evaluator)
        self._writer: Any = None
        self._is_ours = self._is_new = False
        self.states = self.equal = self.measured = self.decisions = 0
        self.widest = Distance()
        self.others: tuple[str, ...] = ()

    def begin_segment(self, segment: Segment) -> None:
        writer = segment.header.get("evaluator")
        self._is_new = self._writer is not None and writer != self._writer
        self._writer = writer
        texts = differences(self._evaluator, writer)
        self._is_ours = not texts
        self.others = tuple(dict.fromkeys([*self.others, *texts]))

    def compare_checkpoint(self, checkpoint: Entry, session: Recalibrator) -> None:
        """A full state that was noted where the session is now."""
        is_new, self._is_new = self._is_new, False
        self.states += 1
        with parsing(checkpoint.sequence):
            noted = checkpoint.content
            if noted["digest"] == session.digest():
                self.equal += 1
                return
            written = State.from_dict(noted["state"])
        apart = distance(session.setup.space, written, session.state)
        self.measured += 1
        self.widest = self.widest.widest(apart)
        text = f"The state differs by {apart.values:.3g} sd ({apart.covariance:.3g} in its covariance)"
        if self._is_ours and not is_new:
            raise DiffersError(checkpoint.sequence, f"{text}, and the evaluator is the same.")
        if not apart.is_small:
            raise DiffersError(checkpoint.sequence, f"{text}; {BOUND:g} is what another evaluator explains.")
        if _summary(written) != _summary(session.state):
            replayed, noted = _summary(session.state), _summary(written)
            raise DiffersError(checkpoint.sequence, f"Found {replayed}; noted was {noted}.")
        if is_new:
            # Where the journal's evaluator changes, the session goes on from its state.
            session.restore(noted["state"])

    def compare_digest(self, sequence: int, noted: str, session: Recalibrator) -> None:
        """The digest of a state that was noted where the session is now."""
        digest = session.digest()
        self.states += 1
        self.equal += digest == noted
        if self._is_ours and digest != noted:
            raise DiffersError(sequence, f"The state is {digest}, {noted} was noted.")

    def compare_events(self, sequence: int, noted: list[Event], replayed: list[Event]) -> None:
        self.decisions += len(noted)
        compared = (noted, replayed) if self._is_ours else (_without_digits(noted), _without_digits(replayed))
        if compared[0] != compared[1]:
            raise DiffersError(sequence, f"Found {_listed(replayed)}; noted was {_listed(noted)}.")

    def unnoted_events(self, sequence: int, replayed: list[Event]) -> None:
        """Events of a record in the replay, where none was noted though the writer went on."""
        # A full disk takes notes too; where all bits are the same, the states are compared anyway.
        if not self._is_ours:
            raise DiffersError(sequence, f"Found {_listed(replayed)}; noted was nothing.")


def _without_digits(events: Sequence[Event]) -> list[dict[str, Any]]:
    return [{key: event[key] for key in _COMPARED if key in event} for event in events]


def _listed(events: Sequence[Event]) -> str:
    return "; ".join(str(event.get("sentence") or event["event"]) for event in events) or "nothing"


def _summary(state: State) -> str:
    return ", ".join(f"{count} {what}" for what, count in state.counts.items()) + f", level {state.health.level}"
