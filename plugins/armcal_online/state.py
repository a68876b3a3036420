"""What a recalibration starts with, what it knows between two records (as JSON to the last bit), and what it writes."""

from __future__ import annotations

import base64
import fnmatch
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from datetime import UTC, datetime
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from armcal.arm.statics import gravity_tilt, unstated_payload
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.domains import Interval
from armcal.base.parameters import Parameters
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import (
    UNMOVED_SD,
    InformationRecord,
    ParameterRecord,
    identity_of,
    sealed,
    under_load,
)
from armcal.calibration.intervals import covariance_rows
from armcal.config.selection import quantity
from armcal.errors import ConfigError, DataError, Location
from armcal.estimate.estimator import interval
from armcal.estimate.online import Gaussian
from armcal.measure.groups import PairedMeasurement
from armcal.measure.measurement import Measurement
from armcal.measure.reader import ReadRequest, requested_channels
from armcal.problem.problem import Problem
from scipy.special import bdtrc, chdtrc, chdtri, fdtrc, fdtri, ndtri

from armcal_online.belief import (
    Belief,
    GaussMarkovState,
    GaussMarkovStates,
    Observer,
    ProcessNoise,
    StateSpace,
    most_likely,
    shared_error,
    variance_rates,
)
from armcal_online.decisions import LEVELS, Decision, Level
from armcal_online.hypotheses import Candidate, Recent, SlowState
from armcal_online.settings import ClockSettings, RecalibrateSettings
from armcal_online.window_evidence import ModelError

_VECTORS = ("gravity", "payload", "force", "torque")
_SIGNIFICANT_SD = 3.0  # residuals above the stated noise by less are chance's


@dataclass(frozen=True)
class FilterSetup:
    problem: Problem  # compiled once
    space: StateSpace  # of its free parameters
    observer: Observer  # makes observations of records
    belief: Belief  # that of the calibration
    process_noise: ProcessNoise  # how beliefs widen between records
    request: ReadRequest  # what a source should look for
    left_out: tuple[str, ...]  # measurements that cannot be taken one record at a time
    held: frozenset[str]  # parameters that are as they were calibrated until a decision opens them
    model_errors: Mapping[str, ModelError]  # by measurement, but those that err by no more than noise


def filter_setup(calibration: Calibration, settings: RecalibrateSettings, loads: bool = False) -> FilterSetup:
    system = calibration.system
    measurements = {n: m for n, m in system.measurements.items() if not isinstance(m, PairedMeasurement)}
    parameters, opened = _parameters(calibration, settings, loads)
    space = StateSpace(parameters)
    parts = (parameters, system.environment, _full_record(calibration, measurements), settings.evaluator)
    problem = Problem.build(system.arms, measurements, *parts, groups=calibration.record.groups)
    follows = settings.model_error == "calibrated"
    white, shared, model_errors = _noise_and_model_errors(calibration, measurements, follows)
    drifts = _drifts(calibration, space)
    followed = GaussMarkovStates((*drifts, *shared) if follows else ())
    noise = (white, _freedoms(calibration, white), _defaults(calibration))
    observer = Observer(
        problem,
        space,
        followed,
        GaussMarkovStates(() if follows else drifts),
        *noise,
        {block.name for block in calibration.parameters.nuisances if block.free} - _calibrated(calibration),
        _noise_scale(calibration),
    )
    return FilterSetup(
        problem,
        space,
        observer,
        _initial_belief(calibration, space, opened, observer.size),
        ProcessNoise(variance_rates(parameters, settings.process_noise), followed),
        ReadRequest(system.arms, measurements, requested_channels(system.arms, measurements, measured=True)),
        tuple(sorted(set(system.measurements) - set(measurements))),
        frozenset(block.name for block in parameters.free) - _calibrated(calibration) - set(opened),
        model_errors,
    )


def _calibrated(calibration: Calibration) -> set[str]:
    return {entry.name.partition("[")[0] for entry in calibration.record.parameters if entry.free}


def _parameters(
    calibration: Calibration, settings: RecalibrateSettings, loads: bool
) -> tuple[Parameters, dict[str, float]]:
    """Blocks about the calibrated values, those that were free then free, and the deviations of those opened now.

    With ``loads``, those of an elastic arm's load are free too; they are known exactly until a decision opens them.
    """
    parameters, free = calibration.parameters, _calibrated(calibration)
    opened: dict[str, float] = {}
    for glob, text in settings.free.items():
        names = fnmatch.filter(parameters.names, glob)
        if not names:
            raise ConfigError(f"no parameter is called {glob!r}.", where=Location(f"free.{glob}"))
        opened |= {n: quantity(parameters[n], text, None, ()) for n in names if n not in free}
    beyond = {
        block.name: replace(block, domain=Interval())
        for block in parameters.blocks
        if isinstance(block.domain, Interval) and block.domain.check(np.array(block.nominal))
    }
    if loads and any(arm.deflection_size for arm in calibration.system.arms.values()):
        parameters = Parameters((*parameters.blocks, *unstated_payload()))
        free |= {block.name for block in (*gravity_tilt(), *unstated_payload())}
    return parameters.replaced(beyond).with_free([n for n in parameters.names if n in free or n in opened]), opened


def _initial_belief(calibration: Calibration, space: StateSpace, opened: Mapping[str, float], size: int) -> Belief:
    """About the calibrated values: the mean where its records lead without bounds, its covariance, and 1 beside."""
    values, known = space.parameters.nominal(), calibration.uncertainty.record
    own = np.zeros((len(known.entries), len(known.entries)))
    for i, row in enumerate(known.covariance):
        own[i, : len(row)] = row
    names = [space.parameters.entry_names[i] for i in space.entries]
    place = [names.index(name) for name in known.entries]
    whole = np.zeros((len(names), len(names)))
    whole[np.ix_(place, place)] = own + np.tril(own, -1).T
    covariance = space.of_entries(values, whole)
    for i, block in enumerate(space.parameters.coordinate_blocks):
        if block.name in opened:
            covariance[i, i] = (opened[block.name] / block.scale) ** 2
    unconstrained = values.copy()
    for position, entry in enumerate(calibration.record.parameters):
        if entry.unconstrained is not None:
            unconstrained[position] = entry.unconstrained
    n, mean, of_all = len(space.scales), np.zeros(size), np.eye(size)
    mean[:n] = space.between(values, unconstrained)
    of_all[:n, :n] = 0.5 * (covariance + covariance.T)
    return Belief(values, Gaussian(mean, of_all))


def _noise_and_model_errors(
    calibration: Calibration, measurements: Mapping[str, Measurement], follows: bool
) -> tuple[dict[str, Array], list[GaussMarkovState], dict[str, ModelError]]:
    """Each measurement's own error from record to record (n_r x n_r), and what neighbours share if that is followed.

    And the model's own error, which poses near each other share: as much of the residuals as neighbours were seen to
    share, or as is above the stated noise. What neighbours share was seen as often as there are stretches of them.
    """
    variances: Mapping[str, Any] = calibration.record.noise.get("scatter") or {}
    white: dict[str, Array] = {}
    shared: list[GaussMarkovState] = []
    model_errors: dict[str, ModelError] = {}
    freedoms = _freedoms(calibration, measurements)
    for name, measurement in measurements.items():
        # Where joints are noisy the residuals vary with the pose: their noise is carried over to each record.
        is_noisy = any(calibration.system.arms[arm].joint_noise for arm in measurement.arms)
        residuals = None if is_noisy else variances.get(name)
        stated, share, over, channel = np.diag(np.array(measurement.noise()) ** 2), 0.0, 1.0, "record"
        covariance = stated * _noise_scale(calibration) ** 2
        if residuals is not None:
            covariance, share, over = np.array(residuals["covariance"]), residuals["share"], residuals["over"]
            channel = residuals.get("channel", channel)
        above = 1 - float(np.trace(np.linalg.solve(covariance, stated))) / len(stated)
        by_chance = _SIGNIFICANT_SD * np.sqrt(2 / (len(stated) * freedoms[name]))
        if (own := max(share, above if above > by_chance else 0.0)) > 0:
            model_errors[name] = ModelError(own * covariance, freedoms[name] / (1 + 2 * share * over))
        if follows and share > 0:
            shared += shared_error(name, share * covariance, over, channel)
            covariance = (1 - share) * covariance
        white[name] = covariance
    return white, shared, model_errors


def _freedoms(calibration: Calibration, names: Iterable[str]) -> dict[str, float]:
    noise = calibration.record.noise
    own, of_fit = noise.get("scatter") or {}, max(noise["degrees_of_freedom"], 1)
    return {name: float((own.get(name) or {}).get("freedom") or of_fit) for name in names}


def _drifts(calibration: Calibration, space: StateSpace) -> tuple[GaussMarkovState, ...]:
    place = {name: i for i, name in enumerate(space.names)}
    return tuple(
        GaussMarkovState(f"drift of {name}", d.over, d.channel, place[name], d.sd / float(space.scales[place[name]]))
        for name, d in calibration.uncertainty.record.drifts.items()
    )


def _noise_scale(calibration: Calibration) -> float:
    return float(calibration.record.noise.get("scale") or 1.0)


def _full_record(calibration: Calibration, measurements: Mapping[str, Measurement]) -> Dataset:
    arms = calibration.system.arms
    names = [w.channel for w in requested_channels(arms, measurements, measured=True) if "." in w.channel]
    names += [f"gravity_{axis}" for axis in "xyz"] + ["payload"]
    names += [name for name in calibration.record.environment_columns if name not in names]
    names += [name for arm in arms.values() for name in arm.conditions if name not in names]
    return Dataset(("",), {name: np.ones(1) for name in dict.fromkeys(names)})


def _defaults(calibration: Calibration) -> dict[str, float]:
    environment = calibration.system.environment
    vectors = (environment.gravity, environment.payload_com, environment.force, environment.torque)
    components = {
        f"{name}_{axis}": float(value)
        for name, vector in zip(_VECTORS, vectors, strict=True)
        for axis, value in zip("xyz", vector, strict=True)
    }
    arms = calibration.system.arms.values()
    approaches = {f"{arm.name}.approach.{joint}": 0.0 for arm in arms for joint in arm.commanded}
    return {**components, **approaches, "payload": environment.payload_mass}


_QUANTILE = float(ndtri(0.975))
_FLOOR = 1e-12
_LEAST_MASS = 0.005  # kg


def deviations(space: StateSpace, belief: Belief) -> Array:
    n = len(space.scales)
    covariance = space.to_entries(belief.values(space), belief.gaussian.covariance[:n, :n])
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))


def calibration_text(calibration: Calibration, setup: FilterSetup, belief: Belief, source: Mapping[str, Any]) -> str:
    """A payload that was found is stated in its statics; parameters that no decision has opened are as they were."""
    space = setup.space
    values = most_likely(space, belief)
    covariance = belief.gaussian.covariance[: len(space.scales), : len(space.scales)]
    entries, names = space.to_entries(values, covariance), [space.parameters.entry_names[i] for i in space.entries]
    known = {entry.name for entry in calibration.record.parameters}
    own = [k for k, name in enumerate(names) if name in known and (name not in setup.held or entries[k, k] > 0)]
    kept = [k for k, n in enumerate(space.names) if n not in setup.held or (n in known and covariance[k, k] > 0)]
    entries = entries[np.ix_(own, own)]
    sd = dict(zip(space.entries[own].tolist(), np.sqrt(np.maximum(np.diag(entries), 0.0)).tolist(), strict=True))
    verdict = dict(calibration.record.verdict)
    if source["level"] == "lost":
        verdict["headline"] = f"Lost, do not use: {source['why']}"
    content = calibration.record.model_copy(
        update={
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "parameters": _parameter_records(calibration, space, values, belief.values(space), sd),
            **_statics(calibration, setup, values),
            "prediction": calibration.uncertainty.record.model_copy(
                update={
                    "entries": tuple(names[k] for k in own),
                    "covariance": covariance_rows(entries),
                }
            ),
            "information": InformationRecord(
                increments=tuple(space.names[k] for k in kept),
                square_root=_square_root(space.scales[kept], covariance[np.ix_(kept, kept)]),
            ),
            "verdict": verdict,
            "recalibrated": dict(source),
        }
    )
    return sealed(content.to_config())


def _parameter_records(
    calibration: Calibration, space: StateSpace, values: Array, free: Array, sd: Mapping[int, float]
) -> tuple[ParameterRecord, ...]:
    """``free`` are the values that the records alone lead to, beyond the bounds; ``sd`` is by place."""
    bounds = {
        space.parameters.entries_of(block.name).start: (block.domain.lower, block.domain.upper)
        for block in space.parameters.free
        if isinstance(block.domain, Interval)
    }
    parameters = []
    for i, record in enumerate(calibration.record.parameters):
        changed: dict[str, Any] = {"value": float(values[i])}
        if i in sd:
            low, high = bounds.get(i, (-np.inf, np.inf))
            own = interval(values[i], free[i], sd[i], low, high, _QUANTILE)
            is_moved = abs(free[i] - values[i]) > UNMOVED_SD * sd[i]
            changed |= {
                "free": True,
                "sd": sd[i],
                "lower": own.lower,
                "upper": own.upper,
                "at_bound": bool(values[i] <= low or values[i] >= high),
                "unconstrained": float(free[i]) if is_moved else None,
            }
        parameters.append(record.model_copy(update=changed))
    return tuple(parameters)


def _statics(calibration: Calibration, setup: FilterSetup, values: Array) -> dict[str, Any]:
    """What acts where a record does not say, with the payload beyond the stated one; and the identity of that."""
    record, parameters = calibration.record, setup.space.parameters
    beyond = [values[parameters.entries_of(b.name)][0] for b in unstated_payload() if b.name in setup.held]
    if not any(beyond):
        return {}
    environment = calibration.system.environment
    mass = environment.payload_mass + beyond[0]
    moment = environment.payload_mass * np.array(environment.payload_com) + np.array(beyond[1:])
    # A mass below zero, as noise makes it, is none; one that is hardly there has its centre at the tool frame.
    centre = moment / mass if mass > _LEAST_MASS else np.zeros(3)
    kept = {key: value for key, value in record.statics.items() if not key.startswith("payload")}
    statics = {**kept, "payload_kg": max(float(mass), 0.0), "payload_com_m": centre.tolist()}
    described = {"arms": record.arms, "measurements": record.measurements, "statics": statics}
    checks = record.checks and under_load(record.checks, environment)
    return {"statics": statics, "identity": {**record.identity, "arm": identity_of(described)}, "checks": checks}


def _square_root(scales: Array, covariance: Array) -> tuple[tuple[float, ...], ...]:
    size, directions = np.linalg.eigh(covariance)
    known = size > _FLOOR * max(float(size[-1]), _FLOOR)
    inverse = np.where(known, 1 / np.sqrt(np.where(known, size, 1.0)), 0.0)
    root = inverse[:, None] * directions.T / scales
    return tuple(tuple(row) for row in root.tolist())


@dataclass(frozen=True)
class Health:
    level: Level = "nominal"
    calm: int = 0  # records since the last trouble
    sentence: str = "The records agree with the calibration."  # why the level is what it is
    best: Level = "nominal"  # it gets no better while a change is unexplained, however well the records fit

    def troubled(self, level: Level, sentence: str) -> Health:
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

    Where few degrees of ``freedom`` determined the noise, it has an F distribution, Hotelling's [Hotelling1931].
    """
    if math.isinf(freedom):
        return float(chdtri(float(dof), 1 - probability))
    return dof * float(fdtri(float(dof), freedom, probability))


def many_outliers(count: int, records: int, fraction: float) -> float:
    """How probable at least ``count`` outliers among some records are, if ``fraction`` of all are."""
    return float(bdtrc(count - 1, records, fraction)) if count > 0 else 1.0


def improbability(nis_window: Sequence[tuple[float, int]], known: float = math.inf) -> float:
    """How probable NIS (each with its degrees of freedom, in order) at least as large in sum are by chance.

    Neighbours that resemble each other count for less than their number: by their first serial correlation.
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


REMEMBERED = 128  # so many records are remembered, to name the first after a change


@dataclass(frozen=True)
class Clock:
    now: float | None = None  # time (s) of the newest record
    late: int = 0  # so many in a row have been older since
    behind: float = 0.0  # the latest of them


@dataclass(frozen=True)
class Tick:
    clock: Clock  # after a record
    passed: float  # the time (s) that parameters had to wander
    stale: str = ""  # why the record is
    note: str = ""  # what was odd


def ticked(clock: Clock, time: float | None, arrived: float, settings: ClockSettings) -> Tick:
    """A clock that jumps ahead counts as its longest step; set back, it makes records stale until enough agree."""
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
    record_id: str  # its own name
    sequence: int  # its number
    at: float  # its time (as ``State.at``)
    is_good: bool = False  # whether it was accepted, nothing was decided, and the level was nominal after it


@dataclass(frozen=True)
class State:
    """Between two records; with it and the records after, everything comes out again."""

    belief: Belief  # about parameters and Gauss-Markov states
    recent: tuple[Recent, ...] = ()  # the last records, for judgement
    clock: Clock = field(default_factory=Clock)  # by records
    place: float | None = None  # the last record's ``sequence``; None before the first
    health: Health = field(default_factory=Health)  # and why
    nis: tuple[tuple[float, int], ...] = ()  # NIS and degrees of freedom of the last accepted records
    counts: Mapping[str, int] = field(
        default_factory=lambda: {"accepted": 0, "rejected": 0, "ignored": 0}
    )  # of records
    ids: tuple[Arrival, ...] = ()  # the last records, in order
    good: Arrival | None = None  # the last good record of those before
    wary: bool = False  # whether the last records look like a change, which is not certain yet
    suspects: tuple[
        Candidate, ...
    ] = ()  # joints that no record distinguished when one stepped, each followed by itself
    suspected: int = 0  # the first record after that
    before_change: Belief | None = None  # the belief before it
    drifted: int = 0  # how often in a row the NIS as a whole was too large
    changes: tuple[int, ...] = ()  # sequence numbers of the last changes that nothing explained
    sequence: int = 0  # of the last entry
    at: float = 0.0  # time of the last record (unix seconds, or as records count it)
    slow: SlowState = field(default_factory=SlowState)  # evidence of slow changes, and trends that were found

    def known(self, sequence: int) -> Arrival | None:
        return next((arrival for arrival in reversed(self.ids) if arrival.sequence == sequence), None)

    def good_before(self, sequence: int) -> Arrival | None:
        earlier = (arrival for arrival in reversed(self.ids) if arrival.is_good and arrival.sequence < sequence)
        return next(earlier, self.good if self.good is not None and self.good.sequence < sequence else None)

    def as_dict(self) -> dict[str, Any]:
        return dict(_encoded(self))

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> State:
        state: State = _decoded(cls, content)
        if set(state.counts) != {"accepted", "rejected", "ignored"}:
            raise ValueError(f"counts of {', '.join(state.counts)}")
        return state


def remembering(state: State, arrival: Arrival) -> State:
    ids = (*state.ids, arrival)
    gone = [earlier for earlier in ids[:-REMEMBERED] if earlier.is_good]
    return replace(state, ids=ids[-REMEMBERED:], good=gone[-1] if gone else state.good)


def troubled(state: State, decisions: Sequence[Decision], is_good: bool) -> State:
    """No record is good from the first that a decision affects."""
    since = min((decision.since for decision in decisions), default=state.sequence + 1)
    *earlier, newest = (replace(a, is_good=False) if a.sequence >= since else a for a in state.ids)
    return replace(state, ids=(*earlier, replace(newest, is_good=is_good)))


def _encoded(value: Any) -> Any:
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
