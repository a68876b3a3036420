"""Everything that a recalibration knows between two records, also as JSON to the last bit; how a record moves it."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import DataError
from armcal.estimate.online import Gaussian, OnlineEstimator
from scipy.special import bdtrc, chdtrc, chdtri, fdtrc, fdtri

from armcal_online.tracking.belief import Belief, most_likely
from armcal_online.tracking.decisions import LEVELS, Decision, Level
from armcal_online.tracking.hypotheses import Candidate, Recent, SlowState
from armcal_online.tracking.settings import ClockSettings
from armcal_online.tracking.start import FilterSetup


@dataclass(frozen=True)
class Health:
    """A level, the number of records since the last trouble, and the reason of the level.

    It gets no better than ``best`` while a change is unexplained, however well the records fit.
    """

    level: Level = "nominal"
    calm: int = 0
    sentence: str = "The records agree with the calibration."
    best: Level = "nominal"

    def troubled(self, level: Level, sentence: str) -> Health:
        """After trouble: at least that bad, counting anew."""
        if LEVELS.index(level) > LEVELS.index(self.level):
            return replace(self, level=level, calm=0, sentence=sentence)
        return replace(self, calm=0)

    def calmed(self, after: int) -> Health:
        """After a record without trouble: better by a level once ``after`` of them came in a row."""
        if LEVELS.index(self.level) <= LEVELS.index(self.best):
            return self
        if self.calm + 1 < after:
            return replace(self, calm=self.calm + 1)
        level = LEVELS[LEVELS.index(self.level) - 1]
        text = f"{after} records in a row agree with the calibration"
        if level == self.best != "nominal":
            text += "; what changed it is not known"
        return replace(self, level=level, calm=0, sentence=f"{text}.")


def nis_limit(dof: int, probability: float, freedom: float = math.inf) -> float:
    """What NIS stays below with a probability, where all is as believed.

    ``freedom``: degrees of freedom with which the noise is known. Where they are few, NIS by ``dof`` has an F
    distribution, as Hotelling's T-squared [Hotelling1931].
    """
    if math.isinf(freedom):
        return float(chdtri(float(dof), 1 - probability))
    return dof * float(fdtri(float(dof), freedom, probability))


def many_outliers(count: int, records: int, fraction: float) -> float:
    """How probable at least ``count`` outliers among some records are, if ``fraction`` of all are."""
    return float(bdtrc(count - 1, records, fraction)) if count > 0 else 1.0


def improbability(nis_window: Sequence[tuple[float, int]], known: float = math.inf) -> float:
    """How probable NIS (each with its degrees of freedom, in order) at least as large in sum are by chance.

    Neighbours that resemble each other count for less than their number: by their first serial correlation. ``known``:
    degrees of freedom with which the noise is known, which all of them share.
    """
    if len(nis_window) < 3:
        return 1.0
    total, freedom = (float(sum(column)) for column in zip(*nis_window, strict=True))
    relative = np.array([nis / dof for nis, dof in nis_window])
    centred = relative - relative.mean()
    power = float(centred @ centred)
    serial = float(centred[1:] @ centred[:-1]) / power if power > 0 else 0.0
    serial = float(np.clip(serial, 0.0, 0.9))
    shared = (1 + serial) / (1 - serial)
    if math.isinf(known):
        return float(chdtrc(freedom / shared, total / shared))
    return float(fdtrc(freedom / shared, known, total / freedom))


REMEMBERED = 128  # so many records are remembered: to know one that comes twice, and to name the first after a change
_REFRESHED = 25  # after so many accepted records the origin is put where it is most likely within the bounds


@dataclass(frozen=True)
class Clock:
    """The time (s) of the newest record, and how many in a row have been older since, the latest at ``behind``."""

    now: float | None = None
    late: int = 0
    behind: float = 0.0


@dataclass(frozen=True)
class Tick:
    """The clock after a record, the time that parameters had to wander (s), why the record is stale, what was odd."""

    clock: Clock
    passed: float
    stale: str = ""
    note: str = ""


def ticked(clock: Clock, time: float | None, arrived: float, settings: ClockSettings) -> Tick:
    """The clock after a record; one without a time leaves it as it was.

    A clock that jumps ahead counts as its longest step. One that was set back makes records stale until enough of them
    agree on the new time.
    """
    if time is None:
        return Tick(clock, 0.0)
    if settings.longest_age is not None and arrived - time > settings.longest_age:
        return Tick(clock, 0.0, f"it was measured {_span(arrived - time)} before it arrived")
    if clock.now is None:
        return Tick(Clock(time), 0.0)
    step = time - clock.now
    if step < -settings.tolerance:
        late = clock.late + 1 if clock.late and time >= clock.behind else 1
        if late >= settings.reset_after:
            note = f"{late} records in a row are older than one before them: the clock is taken to have been set back"
            return Tick(Clock(time), 0.0, note=note)
        return Tick(replace(clock, late=late, behind=time), 0.0, f"it is {_span(-step)} older than the last record")
    if step > settings.longest_step:
        note = f"the clock went ahead by {_span(step)}; parameters are let wander for {_span(settings.longest_step)}"
        return Tick(Clock(time), settings.longest_step, note=note)
    return Tick(Clock(max(time, clock.now)), max(step, 0.0))


def _span(seconds: float) -> str:
    for size, unit in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if abs(seconds) >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds:.3g} s"


@dataclass(frozen=True)
class Arrival:
    """A record that came."""

    record_id: str  # its own name
    content: str  # a hash of it
    sequence: int  # its number
    at: float  # its time (as ``State.at``)
    is_good: bool = False  # whether it was accepted, nothing was decided, and the level was nominal after it


@dataclass(frozen=True)
class State:
    """Between two records; with it and the records after, everything comes out again.

    Attributes:
        counts: of accepted, rejected and ignored records.
        suspects: joints that could not be distinguished when one of them stepped, each followed by itself.
    """

    belief: Belief  # about parameters and Gauss-Markov states
    recent: tuple[Recent, ...] = ()  # the last records, for judgement
    clock: Clock = field(default_factory=Clock)  # by records
    place: float | None = None  # the last record's ``sequence``; None before the first
    health: Health = field(default_factory=Health)  # and why
    nis_window: tuple[tuple[float, int], ...] = ()  # NIS and degrees of freedom of the last accepted records
    counts: Mapping[str, int] = field(default_factory=lambda: {"accepted": 0, "rejected": 0, "ignored": 0})
    ids: tuple[Arrival, ...] = ()  # the last records, in order
    good: Arrival | None = None  # the last good record of those before
    wary: bool = False  # whether the last records look like a change, which is not certain yet
    suspects: tuple[Candidate, ...] = ()
    suspected: int = 0  # the first record after that
    before_change: Belief | None = None  # the belief before it
    drifted: int = 0  # how often in a row the NIS as a whole was too large
    changes: tuple[int, ...] = ()  # sequence numbers of the last changes that nothing explained
    sequence: int = 0  # of the last entry
    at: float = 0.0  # time of the last record (unix seconds, or as records count it)
    slow: SlowState = field(default_factory=SlowState)  # evidence of slow changes, and trends that were found

    def following(self, belief: Belief, **changes: Any) -> State:
        return replace(self, belief=belief, **changes)

    def known(self, sequence: int) -> Arrival | None:
        return next((arrival for arrival in reversed(self.ids) if arrival.sequence == sequence), None)

    def good_before(self, sequence: int) -> Arrival | None:
        """The last good record before a number; None before the first."""
        earlier = (arrival for arrival in reversed(self.ids) if arrival.is_good and arrival.sequence < sequence)
        return next(earlier, self.good if self.good is not None and self.good.sequence < sequence else None)

    def as_dict(self) -> dict[str, Any]:
        content = _encoded(self)
        content["nis"] = content.pop("nis_window")
        return dict(content)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> State:
        """What ``as_dict`` wrote.

        Raises:
            DataError: an array is not whole.
            KeyError, TypeError, ValueError, AttributeError, IndexError: it is no state.
        """
        state: State = _decoded(cls, {**content, "nis_window": content["nis"]})
        if set(state.counts) != {"accepted", "rejected", "ignored"}:
            raise ValueError(f"counts of {', '.join(state.counts)}")
        return state


def remembering(state: State, arrival: Arrival) -> State:
    ids = (*state.ids, arrival)
    gone = [earlier for earlier in ids[:-REMEMBERED] if earlier.is_good]
    return replace(state, ids=ids[-REMEMBERED:], good=gone[-1] if gone else state.good)


def troubled(state: State, decisions: Sequence[Decision], is_good: bool) -> State:
    """The state that knows whether its last record is good, and that none is from the first that a decision affects."""
    since = min((decision.since for decision in decisions), default=state.sequence + 1)
    *earlier, newest = (replace(a, is_good=False) if a.sequence >= since else a for a in state.ids)
    return replace(state, ids=(*earlier, replace(newest, is_good=is_good)))


def _encoded(value: Any) -> Any:
    """As JSON; of an array its shape, and its bytes in base64 (little-endian doubles)."""
    if isinstance(value, np.ndarray):
        raw = np.ascontiguousarray(value, dtype="<f8").tobytes()
        return {"shape": list(value.shape), "float64": base64.b64encode(raw).decode("ascii")}
    if isinstance(value, Belief):  # of its covariance, which is symmetric, the lower triangle
        mean, covariance = value.gaussian.mean, value.gaussian.covariance
        triangle = covariance[np.tril_indices(len(covariance))]
        return _encoded({"origin": value.origin, "mean": mean, "covariance": triangle})
    if is_dataclass(value):
        return {field.name: _encoded(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: _encoded(item) for key, item in value.items()}
    return [_encoded(item) for item in value] if isinstance(value, tuple) else value


def _decoded(kind: Any, content: Any) -> Any:
    """The value of a type that ``_encoded`` made ``content`` of."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        raw = np.frombuffer(base64.b64decode(content["float64"]), dtype="<f8")
        if raw.size != int(np.prod(content["shape"])):
            raise DataError("an array in the journal is not whole.", hint="Start again from the last calibration.yaml.")
        return np.array(raw.reshape(content["shape"]), dtype=float)
    if kind is Belief:
        place, mean, triangle = (_decoded(Array, content[name]) for name in ("origin", "mean", "covariance"))
        covariance = np.zeros((len(mean), len(mean)))
        rows, columns = np.tril_indices(len(mean))
        covariance[rows, columns] = covariance[columns, rows] = triangle
        return Belief(place, Gaussian(mean, covariance))
    if isinstance(kind, type) and is_dataclass(kind):
        kinds = get_type_hints(kind)
        return kind(**{field.name: _decoded(kinds[field.name], content[field.name]) for field in fields(kind)})
    if origin is UnionType:
        return None if content is None else _decoded(parts[0], content)
    if origin is tuple:
        kinds_of = parts[:1] * len(content) if parts[-1] is Ellipsis else parts
        return tuple(_decoded(one, item) for one, item in zip(kinds_of, content, strict=True))
    if origin is Mapping:
        return {str(key): _decoded(parts[1], item) for key, item in content.items()}
    if origin is Literal and content not in parts:
        raise ValueError(f"{content!r} is none of {', '.join(parts)}")
    return content if origin is Literal else kind(content)


def advanced(state: State, recent: Recent, setup: FilterSetup, estimator: OnlineEstimator, nis_window: int) -> State:
    """The state with a record taken in by an estimator.

    The state's belief is that at the record's time; of NIS it keeps ``nis_window``.

    Raises:
        NotConvergedError: the arm has no elastic equilibrium near the belief.
        ProblemError: the numbers of the belief are no longer sound.
    """
    space, before = setup.space, state.belief
    observation = setup.observer.observation(before, recent.readings, recent.joint_noise)
    belief = before.updated(space, estimator.update(before.gaussian, observation).posterior)
    if state.counts["accepted"] % _REFRESHED == _REFRESHED - 1:
        # Where bounds hold, steps of the mean lead the origin astray slowly.
        belief = belief.about(space, most_likely(space, belief))
    return replace(state, belief=belief, nis_window=(*state.nis_window, (recent.nis, recent.dof))[-nis_window:])
