"""The updated calibration: the file of the one it started from, with the values and covariance of the belief."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
from armcal.base.domains import Array, Interval
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import UNMOVED_SD, InformationRecord, sealed
from armcal.calibration.intervals import covariance_rows
from scipy.special import ndtri

from armcal_online.tracking.belief import Belief, most_likely
from armcal_online.tracking.state_space import StateSpace

_QUANTILE = float(ndtri(0.975))
_FLOOR = 1e-12


def deviations(space: StateSpace, belief: Belief) -> Array:
    """Standard deviations of the free entries."""
    n = len(space.scales)
    covariance = space.to_entries(belief.values(space), belief.gaussian.covariance[:n, :n])
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))


def calibration_text(calibration: Calibration, space: StateSpace, belief: Belief, source: Mapping[str, Any]) -> str:
    """The text of calibration.yaml; ``source`` is where it comes from (records, health level, last record)."""
    n, values, free = len(space.scales), most_likely(space, belief), belief.values(space)
    covariance = belief.gaussian.covariance[:n, :n]
    entries = space.to_entries(values, covariance)
    sd = dict(zip(space.entries.tolist(), np.sqrt(np.maximum(np.diag(entries), 0.0)).tolist(), strict=True))
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
    verdict = dict(calibration.record.verdict)
    if source["level"] == "lost":
        verdict["headline"] = f"Lost, do not use: {source['why']}"
    content = calibration.record.model_copy(
        update={
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "parameters": tuple(parameters),
            "prediction": calibration.uncertainty.record.model_copy(
                update={
                    "entries": tuple(space.parameters.entry_names[i] for i in space.entries),
                    "covariance": covariance_rows(entries),
                }
            ),
            "information": InformationRecord(increments=space.names, square_root=_square_root(space, covariance)),
            "verdict": verdict,
            "recalibrated": dict(source),
        }
    )
    return sealed(content.to_config())


def _square_root(space: StateSpace, covariance: Array) -> tuple[tuple[float, ...], ...]:
    """R with R'R the information on the coordinates; directions that are known exactly are left out."""
    size, directions = np.linalg.eigh(covariance)
    known = size > _FLOOR * max(float(size[-1]), _FLOOR)
    inverse = np.where(known, 1 / np.sqrt(np.where(known, size, 1.0)), 0.0)
    root = inverse[:, None] * directions.T / space.scales
    return tuple(tuple(row) for row in root.tolist())
