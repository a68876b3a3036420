"""A calibration kept true: takes one record at a time, and reports what it made of it as events.

What comes out is a function of the calibration, the settings and the records alone, times and arrival included: no
clock, no chance, no thread takes part, so that a journal of the records reproduces every state to the last bit.
An event is a JSON object, with a finished sentence wherever something was decided.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.calibration.calibration import Calibration
from armcal.config.system import build_component
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ArmcalError, DataError, Location
from armcal.estimate.online import Linearised, OnlineEstimator, normalised_innovation_squared
from armcal.measure.reader import ReadRequest
from armcal.plugins import PluginRegistry, discover

from armcal_online.belief import Belief, Reading, most_likely
from armcal_online.decisions import EXPLAINED, LEVEL_ADVICE, LEVELS, Decision, advice, per_cent, spoken_time, sure
from armcal_online.hypotheses import (
    CAUSES,
    GRADUAL,
    LINK,
    Recent,
    SlowChanges,
    find_steps,
    hypotheses,
    slow_changes,
    spoken,
)
from armcal_online.judge import Judge, beside_model_error
from armcal_online.settings import RecalibrateSettings
from armcal_online.sources import Incoming
from armcal_online.state import (
    Arrival,
    Health,
    State,
    Tick,
    calibration_text,
    deviations,
    filter_setup,
    nis_limit,
    remembering,
    ticked,
    troubled,
)
from armcal_online.window_evidence import SHOWN, HypothesisFilter, TipError, in_model_errors, tip_error

_WEEK = 7.0  # days
_REFRESHED = 25  # after so many accepted records the origin is put where it is most likely within the bounds
_FARTHEST = 100.0  # rad or m; a joint beyond it is a fault of the record


class Recalibrator:
    """A session that begins at a calibration: mutable, and nothing but a ``State`` changes in it."""

    def __init__(
        self, calibration: Calibration, settings: RecalibrateSettings, registry: PluginRegistry | None = None
    ) -> None:
        source = ConfigSource({"estimator": settings.estimator}, {(): Location()}, Path(), Path(), ())
        estimator: OnlineEstimator = build_component(source, registry or discover(), "online", ("estimator",))[0]
        self._calibration, self.settings, self._estimator = calibration, settings, estimator
        self.setup = setup = filter_setup(calibration, settings, settings.gating)
        self.steps = steps = find_steps(calibration, setup.observer, setup.belief.origin)
        hypothesis_filter = HypothesisFilter(setup.observer, estimator, setup.process_noise, settings.outliers)
        changes = hypotheses(setup.space, steps, settings.changes, setup.observer.size)
        slow = slow_changes(changes, steps, settings.changes, setup.observer.size)
        if hypothesis_filter.is_model_wrong:
            # Neighbours err alike: a load that no record shows cannot be distinguished from the error of the model.
            slow = tuple(change for change in slow if change.kind in GRADUAL)
        self._slow = SlowChanges(slow, setup.process_noise, settings.changes.probability)
        self._judge = Judge(setup.space, steps, hypothesis_filter, changes, self._slow, settings)
        self.state = State(setup.belief)

    @property
    def request(self) -> ReadRequest:
        return self.setup.request

    @property
    def values(self) -> Array:
        return most_likely(self.setup.space, self.state.belief)

    @property
    def estimate(self) -> dict[str, list[float]]:
        """Value and standard deviation of the free entries, by name (SI); none that no decision has opened."""
        space, held = self.setup.space, self.setup.held
        values = self.values[space.entries].tolist()
        names = [space.parameters.entry_names[i] for i in space.entries]
        rows = zip(names, values, deviations(space, self.state.belief).tolist(), strict=True)
        return {name: [value, sd] for name, value, sd in rows if sd > 0 or name not in held}

    def take(self, incoming: Incoming, sequence: int, passed_over: str = "") -> tuple[dict[str, Any], ...]:
        """The events of a record; ``passed_over`` is why it counts as ignored before it is looked at."""
        if passed_over:
            return self._ignored(incoming, replace(self.state, sequence=sequence), passed_over)
        time = incoming.channels.get("time")
        time = time if time is not None and math.isfinite(time) else None
        tick = ticked(self.state.clock, time, incoming.arrived, self.settings.clock)
        state, why = self._admitted(incoming, replace(self.state, sequence=sequence), time, tick)
        readings = () if why else self.setup.observer.readings(incoming.channels, incoming.labels)
        if not why and not readings:
            why = "no measurement can use it: numbers are missing, or its group is none that the calibration found"
        if why:
            return self._ignored(incoming, state, why)
        place = incoming.channels.get("sequence", math.nan)
        passed = {"time": tick.passed, "record": 1.0, "sequence": 1.0}
        if math.isfinite(place):
            passed["sequence"] = 1e9 if state.place is None else abs(place - state.place)
            state = replace(state, place=place)
        judged = self._judged(incoming, replace(state, clock=tick.clock), readings, passed)
        if not tick.note:
            return judged
        sentence = f"{tick.note[:1].upper()}{tick.note[1:]}."
        texts = advice("clock", _names(self.state.good_before(self.state.sequence + 1), self.settings.levels.calm))
        return (_event("decision", self.state, kind="clock", what=sentence, **texts, sentence=sentence), *judged)

    def _admitted(self, incoming: Incoming, state: State, time: float | None, tick: Tick) -> tuple[State, str]:
        """The state with the record known, and why it is passed over, if it is."""
        if incoming.fault:
            return state, incoming.fault
        at = incoming.arrived if time is None else time
        state = remembering(state, Arrival(incoming.record_id, state.sequence, at))
        if tick.stale:
            return replace(state, clock=tick.clock), tick.stale
        state = replace(state, at=at)
        for arm in self._calibration.system.arms.values():
            for joint in arm.commanded:
                angle = incoming.channels.get(f"{arm.name}.{joint}", 0.0)
                if not abs(angle) < _FARTHEST:
                    return state, f"{arm.name}.{joint} is {angle:g}, expected less than {_FARTHEST:g} (rad or m)"
        infinite = next((name for name, value in incoming.channels.items() if math.isinf(value)), None)
        return state, f"{infinite} is not finite" if infinite else ""

    def _ignored(self, incoming: Incoming, state: State, why: str) -> tuple[dict[str, Any], ...]:
        self.state = _counted(state, "ignored")
        return ({**_record(incoming, self.state, "ignored"), "why": f"Passed over: {why.rstrip('.')}."},)

    def _judged(
        self, incoming: Incoming, state: State, readings: tuple[Reading, ...], passed: Mapping[str, float]
    ) -> tuple[dict[str, Any], ...]:
        process_noise, observer = self.setup.process_noise, self.setup.observer
        before = self._slow.carried(state.slow, process_noise.faded(state.belief, passed), passed["time"])
        state = replace(state, belief=before, slow=self._slow.passed(state.slow, passed))
        try:
            gated, first, limit = self._gated(state, readings, passed)
            state, decisions = self._judge.after(gated) if self.settings.gating else (gated, ())
        except ArmcalError as fault:
            return self._ignored(incoming, state, fault.message)
        recent = gated.recent[-1]
        decisions = tuple(self._beside_model_error(decision, gated, state.belief) for decision in decisions)
        health, level = self._judge.health(gated, decisions, first), self.state.health.level
        record_events = [self._record_event(incoming, state, recent, first, limit)]
        is_good = not recent.rejected and not decisions and health.level == "nominal"
        self.state = state = troubled(replace(state, health=health), decisions, is_good)
        calm = self.settings.levels.calm
        for decision in decisions:
            # These two stand until something else is decided: they are news once.
            if decision.kind not in ("unexplained", "model_no_longer_fits") or decision.level != level:
                explained = state.belief if decision.kind in EXPLAINED else gated.belief
                tip = tip_error(observer, gated.recent, decision.since, gated.belief, explained)
                record_events.append(decided(state, decision, tip, calm))
        if health.level != level:
            record_events.append(_level_changed(state, level, health, calm))
        every = self.settings.output.estimate_every_records
        if decisions or (state.counts["accepted"] % every == 0 and not recent.rejected):
            record_events.append(_event("estimate", self.state, parameters=self.estimate))
        return tuple(record_events)

    def _beside_model_error(self, decision: Decision, gated: State, after: Belief) -> Decision:
        if not (decision.subject or decision.candidates or decision.kind == "general_change"):
            return decision
        since = [record for record in gated.recent if record.sequence >= decision.since]
        first = since[0].before if since and since[0].sequence == decision.since else None
        before = first or self.state.before_change or gated.belief
        moved = in_model_errors(self.setup.observer, self.setup.model_errors, since, before, after)
        return beside_model_error(decision, *moved, self.settings.changes)

    def _gated(
        self, state: State, readings: tuple[Reading, ...], passed: Mapping[str, float]
    ) -> tuple[State, Linearised, float]:
        """The state with a record, accepted or rejected; the record at its prior mean, and the limit of its NIS."""
        observer, space, before = self.setup.observer, self.setup.space, state.belief
        noise = observer.joint_noise(space.inside(before.values(space)), readings)
        observation = observer.observation(before, readings, noise)
        first = observation.at(before.gaussian.mean)
        covariance = first.slope @ before.gaussian.covariance @ first.slope.T + first.noise
        nis, dof = normalised_innovation_squared(first.innovation, covariance), len(first.innovation)
        limit = nis_limit(dof, self.settings.gate.probability, observer.freedom(readings))
        rejected = self.settings.gating and not nis <= limit
        recent = Recent(state.sequence, readings, noise, passed, before, rejected, nis, dof)
        counted = _counted(state, "rejected" if rejected else "accepted")
        if not rejected:
            belief = before.updated(space, self._estimator.update(before.gaussian, observation).posterior)
            if counted.counts["accepted"] % _REFRESHED == 0:
                # Where bounds hold, steps of the mean lead the origin astray slowly.
                belief = belief.about(space, most_likely(space, belief))
            slow = self._slow.after(state.slow, state.sequence, before.gaussian, first, covariance)
            nis_window = (*state.nis, (nis, dof))[-self.settings.levels.window :]
            counted = replace(counted, belief=belief, slow=slow, nis=nis_window)
        return replace(counted, recent=(*counted.recent, recent)[-self.settings.gate.window :]), first, limit

    def _record_event(
        self, incoming: Incoming, state: State, recent: Recent, first: Linearised, limit: float
    ) -> dict[str, Any]:
        verdict = "rejected" if recent.rejected else "accepted"
        relation = "above" if recent.rejected else "within"
        nis = f"{recent.nis:,.0f}" if 1000 <= recent.nis < 1e9 else f"{recent.nis:.3g}"
        name = self.setup.problem.kernels[recent.readings[0].factor].factor.name
        event = {
            **_record(incoming, state, verdict),
            "why": f"Its NIS {nis} is {relation} the limit {limit:.3g}.",
            "nis": recent.nis,
            "limit": limit,
            "dof": recent.dof,
            "measurement": name,
        }
        measured = np.array([incoming.channels.get(f"{name}.{axis}", math.nan) for axis in "xyz"])
        if len(recent.readings) == 1 and len(first.innovation) >= 3 and np.isfinite(measured).all():
            # A single instrument read a position.
            residual = 1000 * first.innovation[:3]
            event |= {
                "residual_mm": residual.tolist(),
                "measured_mm": (1000 * measured).tolist(),
                "predicted_mm": (1000 * measured - residual).tolist(),
            }
        return event

    def started_event(self, resumed: bool) -> dict[str, Any]:
        steps, setup, estimate = self.steps, self.setup, self.estimate
        slowest = self._slow.slowest(_WEEK, self.settings.changes.odds)
        rates = {name: SHOWN[f"{steps.dimension(name) or 'length'} a day"] for name in slowest}
        units = {
            n: unit for b in setup.space.parameters.free for n, unit in zip(b.entry_names, b.entry_units, strict=True)
        }
        return {
            **_event("started", self.state),
            "level": self.state.health.level,
            "gate": {"probability": self.settings.gate.probability},
            "parameters": [{"name": n, "unit": units[n], "value": v, "sd": sd} for n, (v, sd) in estimate.items()],
            "evaluator": setup.problem.backend,
            "resumed": resumed,
            "left_out": list(setup.left_out),
            "joint_steps": {joint.joint: joint.parameter or "several parameters" for joint in steps.joints},
            "joint_steps_not_followed": list(steps.unfollowed),
            "other_changes": [spoken(cause.subject) for cause in steps.causes],
            "sensor_motions": {name: list(which) for name, (_, which) in steps.sensors.items()},
            "slowest_named_in_a_week": {
                name: {key: factor * slowest[name]} for name, (key, _, factor) in rates.items()
            },
        }

    def rolled_back_event(self, sequence: int, to: int) -> dict[str, Any]:
        """That entry ``sequence`` set the estimate back to what it was after entry ``to``, where it is now."""
        state = self.state
        is_there = state.sequence <= to  # else the journal does not keep that record
        there = record_name(state.sequence, state.known(state.sequence)) if is_there else record_name(to, None)
        sentence = f"The estimate was set back to what it was after {there}."
        texts = advice("rollback", _names(None, self.settings.levels.calm))
        return {
            **_event("decision", state, kind="rollback", to=to, what=sentence, **texts, sentence=sentence),
            "sequence": sequence,
            "level": state.health.level,
            "last_good": last_good(state) if is_there else None,
        }

    def status(self) -> dict[str, Any]:
        state = self.state
        return {
            "level": state.health.level,
            "why": state.health.sentence,
            "counts": dict(state.counts),
            "record_time": state.at,
            "last_good": last_good(state),
            "parameters": self.estimate,
            "evaluator": self.setup.problem.backend,
        }

    def snapshot(self) -> dict[str, Any]:
        return self.state.as_dict()

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        state = State.from_dict(snapshot)
        count, expected = len(state.belief.gaussian.mean), self.setup.observer.size
        if count != expected:
            raise DataError(
                f"found a state of {count} numbers in the journal, expected {expected} by the calibration and its "
                "settings.",
                hint="Go on with the calibration and settings of the journal.",
            )
        self.state = state

    def calibration_text(self) -> str:
        state = self.state
        source = {
            "records": dict(state.counts),
            "sequence": state.sequence,
            "record": state.ids[-1].record_id if state.ids else None,
            "time_s": state.at,
            "level": state.health.level,
            "why": state.health.sentence,
        }
        return calibration_text(self._calibration, self.setup, state.belief, source)


def _counted(state: State, what: str) -> State:
    return replace(state, counts={**state.counts, what: state.counts[what] + 1})


_MOST_LOG_ODDS = 700.0


def decided(state: State, decision: Decision, tip: TipError | None, calm: int) -> dict[str, Any]:
    """``state`` is that after the decision; after ``calm`` records without trouble the level improves."""
    first, good = state.known(decision.since), state.good_before(decision.since)
    log_odds = min(max(decision.log_odds, -_MOST_LOG_ODDS), _MOST_LOG_ODDS)
    event = _event("decision", state, kind=decision.kind, level=decision.level, what=f"{decision.what}.")
    event["since"] = decision.since
    if first is not None:
        event |= {"since_id": first.record_id, "since_at": first.at}
    event |= {"sure_percent": per_cent(log_odds), "log_odds": log_odds, "why": f"{decision.why}."}
    if tip is not None:
        event |= {f"tip_error_{tip.unit}": tip.size, "tip_error_is": tip.source}
    subject, kind = spoken(decision.subject or "it"), decision.kind
    names = {
        "subject": f"joint {subject}" if kind.startswith("joint") else subject,
        "candidates": (" and " if kind == "joint_stepped" else " or ").join(map(spoken, decision.candidates))
        or subject,
        **_names(good, calm),
    }
    event |= {**advice(decision.kind, names), "last_good": _named(good)}
    if LEVELS.index(state.health.level) > LEVELS.index(decision.level):
        # What explains the last records does not end what was worse before.
        event["do"] = LEVEL_ADVICE[state.health.level].format_map(names)
    off = "" if tip is None else f" The tip was {tip.size:.3g} {tip.unit} off."
    text = f"{decision.what}. First record affected: {record_name(decision.since, first)}. {sure(log_odds)}.{off}"
    event["sentence"] = text
    if decision.kind == "link_bent":
        event["link"] = decision.subject.removeprefix(LINK)
    elif decision.subject and decision.kind not in CAUSES:
        event["joint" if decision.kind.startswith("joint") else "measurement"] = decision.subject
    if len(decision.candidates) > 1:
        event["candidates"] = list(decision.candidates)
    if decision.size and decision.size.dimension:
        key, _, factor = SHOWN[decision.size.dimension]
        event[key] = factor * decision.size.value
    return event


def last_good(state: State) -> dict[str, Any] | None:
    return _named(state.good_before(state.sequence + 1))


def _level_changed(state: State, before: str, health: Health, calm: int) -> dict[str, Any]:
    good, newest = state.good_before(state.sequence), state.known(state.sequence)
    return {
        **_event("level", state),
        "since_id": None if newest is None else newest.record_id,
        "from": before,
        "to": health.level,
        "do": LEVEL_ADVICE[health.level].format_map(_names(good, calm)),
        "last_good": _named(good),
        "sentence": health.sentence,
    }


def record_name(sequence: int, arrival: Arrival | None) -> str:
    if arrival is None:
        return f"entry {sequence}"
    return f"record {arrival.record_id} ({spoken_time(arrival.at)}, entry {sequence})"


def _names(good: Arrival | None, calm: int) -> dict[str, Any]:
    if good is None:
        return {"calm": calm, "good": "the calibration that it began from"}
    return {"calm": calm, "good": record_name(good.sequence, good)}


def _named(arrival: Arrival | None) -> dict[str, Any] | None:
    return None if arrival is None else {"sequence": arrival.sequence, "id": arrival.record_id, "at": arrival.at}


def _event(kind: str, state: State, /, **content: Any) -> dict[str, Any]:
    return {"event": kind, "sequence": state.sequence, "at": state.at, **content}


def _record(incoming: Incoming, state: State, verdict: str) -> dict[str, Any]:
    return {
        "event": "record",
        "sequence": state.sequence,
        "id": incoming.record_id,
        "at": state.at if verdict != "ignored" else incoming.arrived,
        "verdict": verdict,
        "level": state.health.level,
        "inputs": {name: value for name, value in incoming.channels.items() if np.isfinite(value)},
    }
