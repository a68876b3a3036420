"""Events of a recalibration: one JSON object each, with a finished sentence wherever something was decided."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from armcal.estimate.online import Linearised

from armcal_online.sources import Incoming
from armcal_online.tracking.decisions import LEVEL_ADVICE, LEVELS, Decision, advice, per_cent, spoken_time, sure
from armcal_online.tracking.hypotheses import CAUSES, LINK, Recent, Steps, spoken
from armcal_online.tracking.settings import RecalibrateSettings
from armcal_online.tracking.start import FilterSetup
from armcal_online.tracking.state import Arrival, Health, State
from armcal_online.tracking.window_evidence import SHOWN, TipError

_MOST_LOG_ODDS = 700.0


def started(
    state: State,
    setup: FilterSetup,
    settings: RecalibrateSettings,
    parameters: Mapping[str, Any],
    resumed: bool,
    steps: Steps,
    slowest: Mapping[str, float],
) -> dict[str, Any]:
    """At the beginning; ``slowest``: the rates (rad or m a day) of gradual changes that a week of records names."""
    rates = {name: SHOWN[f"{steps.dimension(name) or 'length'} a day"] for name in slowest}
    blocks = {
        n: unit for b in setup.space.parameters.free for n, unit in zip(b.entry_names, b.entry_units, strict=True)
    }
    return {
        **_event("started", state),
        "level": state.health.level,
        "gate": {"probability": settings.gate.probability},
        "parameters": [{"name": n, "unit": blocks[n], "value": v, "sd": sd} for n, (v, sd) in parameters.items()],
        "evaluator": setup.problem.backend,
        "resumed": resumed,
        "left_out": list(setup.left_out),
        "joint_steps": {joint.joint: joint.parameter or "several parameters" for joint in steps.joints},
        "joint_steps_not_followed": list(steps.unfollowed),
        "other_changes": [spoken(cause.subject) for cause in steps.causes],
        "sensor_motions": {name: list(which) for name, (_, which) in steps.sensors.items()},
        "slowest_named_in_a_week": {name: {key: factor * slowest[name]} for name, (key, _, factor) in rates.items()},
    }


def ignored(incoming: Incoming, state: State, why: str) -> dict[str, Any]:
    return {**_record(incoming, state, "ignored"), "why": f"Passed over: {why.rstrip('.')}."}


def judged(
    incoming: Incoming, state: State, recent: Recent, first: Linearised, limit: float, setup: FilterSetup
) -> dict[str, Any]:
    """A record that was accepted or rejected."""
    verdict = "rejected" if recent.rejected else "accepted"
    relation = "above" if recent.rejected else "within"
    nis = f"{recent.nis:,.0f}" if 1000 <= recent.nis < 1e9 else f"{recent.nis:.3g}"
    name = setup.problem.kernels[recent.readings[0].factor].factor.name
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


def decided(state: State, decision: Decision, tip: TipError | None, calm: int) -> dict[str, Any]:
    """Something that was decided: what, since when, how sure, how far the tip was off, what to do, what confirms it.

    ``state`` is that after the decision; after ``calm`` records without trouble the level improves.
    """
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


def noted(state: State, kind: str, text: str, calm: int) -> dict[str, Any]:
    sentence = f"{text[:1].upper()}{text[1:]}."
    texts = advice(kind, _names(state.good_before(state.sequence + 1), calm))
    return _event("decision", state, kind=kind, what=sentence, **texts, sentence=sentence)


def last_good(state: State) -> dict[str, Any] | None:
    return _named(state.good_before(state.sequence + 1))


def level_changed(state: State, before: str, health: Health, calm: int) -> dict[str, Any]:
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


def rolled_back(state: State, sequence: int, to: int, calm: int) -> dict[str, Any]:
    """The estimate was set back by an entry ``sequence`` to the state after entry ``to``, if the journal keeps it."""
    is_there = state.sequence <= to
    there = record_name(state.sequence, state.known(state.sequence)) if is_there else record_name(to, None)
    sentence = f"The estimate was set back to what it was after {there}."
    texts = advice("rollback", _names(None, calm))
    event = _event("decision", state, kind="rollback", to=to, what=sentence, **texts, sentence=sentence)
    return {
        **event,
        "sequence": sequence,
        "level": state.health.level,
        "last_good": last_good(state) if is_there else None,
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


def estimated(state: State, parameters: Mapping[str, list[float]]) -> dict[str, Any]:
    return _event("estimate", state, parameters=dict(parameters))


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
