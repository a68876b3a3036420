"""Events of a recalibration: one JSON object each, with a finished sentence wherever something was decided."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from armcal.estimate.online import Linearised

from armcal_online.sources.source import Incoming
from armcal_online.tracking.directions import Steps
from armcal_online.tracking.health import Health
from armcal_online.tracking.hypotheses import Recent
from armcal_online.tracking.sentences import Decision
from armcal_online.tracking.settings import RecalibrateSettings
from armcal_online.tracking.start import FilterSetup
from armcal_online.tracking.state import State


def started(
    state: State,
    setup: FilterSetup,
    settings: RecalibrateSettings,
    parameters: Mapping[str, Any],
    resumed: bool,
    steps: Steps,
) -> dict[str, Any]:
    """At the beginning."""
    blocks = {name: block.entry_unit for block in setup.space.parameters.free for name in block.entry_names}
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
        "sensor_motions": {name: list(which) for name, (_, which) in steps.sensors.items()},
    }


def ignored(incoming: Incoming, state: State, why: str) -> dict[str, Any]:
    """A record that was passed over."""
    return {**_record(incoming, state, "ignored"), "why": f"Passed over: {why.rstrip('.')}."}


def judged(
    incoming: Incoming, state: State, recent: Recent, first: Linearised, limit: float, setup: FilterSetup
) -> dict[str, Any]:
    """A record that was accepted or rejected."""
    verdict = "rejected" if recent.rejected else "accepted"
    relation = "above" if recent.rejected else "within"
    name = setup.problem.kernels[recent.readings[0].factor].factor.name
    event = {
        **_record(incoming, state, verdict),
        "why": f"Its NIS {recent.nis:.3g} is {relation} the limit {limit:.3g}.",
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


def decided(state: State, decision: Decision) -> dict[str, Any]:
    """Something that was decided."""
    event = _event("decision", state, kind=decision.kind, since=decision.since, sentence=decision.sentence)
    if decision.subject:
        event["joint" if decision.kind.startswith("joint") else "measurement"] = decision.subject
    if len(decision.candidates) > 1:
        event["candidates"] = list(decision.candidates)
    if decision.size is not None:
        turned = decision.dimension == "angle"
        event["size_deg" if turned else "size_mm"] = math.degrees(decision.size) if turned else 1000 * decision.size
    return event


def noted(state: State, kind: str, text: str) -> dict[str, Any]:
    """Something odd that did no harm."""
    return _event("decision", state, kind=kind, sentence=f"{text[:1].upper()}{text[1:]}.")


def level_changed(state: State, before: str, health: Health) -> dict[str, Any]:
    """Health got better or worse."""
    return {**_event("level", state), "from": before, "to": health.level, "sentence": health.sentence}


def estimated(state: State, parameters: Mapping[str, list[float]]) -> dict[str, Any]:
    """What is believed: value and standard deviation by entry (SI)."""
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
