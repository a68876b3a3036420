"""The updated calibration: the file of the one it started from, with the values and covariance of the belief."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
from armcal.arm.statics import unstated_payload
from armcal.base.arrays import Array
from armcal.base.domains import Interval
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import UNMOVED_SD, InformationRecord, ParameterRecord, identity_of, sealed
from armcal.calibration.intervals import covariance_rows
from armcal.calibration.physics import under_load
from scipy.special import ndtri

from armcal_online.tracking.belief import Belief, most_likely
from armcal_online.tracking.start import FilterSetup
from armcal_online.tracking.state_space import StateSpace

_QUANTILE = float(ndtri(0.975))
_FLOOR = 1e-12
_LEAST_MASS = 0.005  # kg


def deviations(space: StateSpace, belief: Belief) -> Array:
    n = len(space.scales)
    covariance = space.to_entries(belief.values(space), belief.gaussian.covariance[:n, :n])
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))


def calibration_text(calibration: Calibration, setup: FilterSetup, belief: Belief, source: Mapping[str, Any]) -> str:
    """The text of calibration.yaml; ``source`` is where it comes from (records, health level, last record).

    A payload that was found is stated in its statics; parameters that no decision has opened are as they were.
    """
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
    """Every entry with its value and, where it is known, its standard deviation (``sd``, by place).

    ``free`` are the values that the records alone lead to, beyond the bounds.
    """
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
            is_moved = abs(free[i] - values[i]) > UNMOVED_SD * sd[i]
            changed |= {
                "free": True,
                "sd": sd[i],
                "lower": float(np.clip(free[i] - _QUANTILE * sd[i], low, high)),
                "upper": float(np.clip(free[i] + _QUANTILE * sd[i], low, high)),
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
