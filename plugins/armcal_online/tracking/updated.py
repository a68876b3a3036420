"""The calibration as it has become: the file of the one it started from, with what is believed now."""

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

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.projection import most_likely
from armcal_online.tracking.state_space import StateSpace

_QUANTILE = float(ndtri(0.975))
_FLOOR = 1e-12


def deviations(space: StateSpace, belief: Belief) -> Array:
    """Standard deviations of the free entries."""
    n = len(space.scales)
    covariance = space.to_entries(belief.values(space), belief.gaussian.covariance[:n, :n])
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))


def calibration_text(calibration: Calibration, space: StateSpace, belief: Belief, told: Mapping[str, Any]) -> str:
    """The text of calibration.yaml; ``told`` says by what it has become so (records, health, last record)."""
    n, values, free = len(space.scales), most_likely(space, belief), belief.values(space)
    covariance = belief.gaussian.covariance[:n, :n]
    entries = space.to_entries(values, covariance)
    sd = np.sqrt(np.maximum(np.diag(entries), 0.0))
    place = {int(entry): i for i, entry in enumerate(space.entries)}
    bounds = _bounds(space)
    parameters = []
    for position, record in enumerate(calibration.record.parameters):
        i = place.get(position)
        changed: dict[str, Any] = {"value": float(values[position])}
        if i is not None:
            low, high = bounds.get(position, (-np.inf, np.inf))
            ends = free[position] - _QUANTILE * sd[i], free[position] + _QUANTILE * sd[i]
            changed |= {
                "free": True,
                "sd": float(sd[i]),
                "lower": float(np.clip(ends[0], low, high)),
                "upper": float(np.clip(ends[1], low, high)),
                "at_bound": bool(values[position] <= low or values[position] >= high),
                "unconstrained": float(free[position])
                if abs(free[position] - values[position]) > UNMOVED_SD * sd[i]
                else None,
            }
        parameters.append(record.model_copy(update=changed))
    names = tuple(space.parameters.entry_names[i] for i in space.entries)
    prediction = calibration.uncertainty.record.model_copy(
        update={"entries": names, "covariance": covariance_rows(entries)}
    )
    content = calibration.record.model_copy(
        update={
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "parameters": tuple(parameters),
            "prediction": prediction,
            "information": InformationRecord(increments=space.names, square_root=_root(space, covariance)),
            "verdict": _verdict(calibration.record.verdict, told),
            "recalibrated": dict(told),
        }
    )
    return sealed(content.to_config())


def _verdict(before: Mapping[str, Any], recalibrated: Mapping[str, Any]) -> dict[str, Any]:
    """Of the calibration's own run, under another headline where it no longer holds."""
    if recalibrated["level"] != "lost":
        return dict(before)
    return {**before, "headline": f"Lost, do not use: {recalibrated['why']}"}


def _bounds(space: StateSpace) -> dict[int, tuple[float, float]]:
    return {
        space.parameters.entries_of(block.name).start: (block.domain.lower, block.domain.upper)
        for block in space.parameters.free
        if isinstance(block.domain, Interval)
    }


def _root(space: StateSpace, covariance: Array) -> tuple[tuple[float, ...], ...]:
    """R with R'R the information on the coordinates; directions that are known exactly are left out."""
    size, directions = np.linalg.eigh(covariance)
    known = size > _FLOOR * max(float(size[-1]), _FLOOR)
    inverse = np.where(known, 1 / np.sqrt(np.where(known, size, 1.0)), 0.0)
    root = inverse[:, None] * directions.T / space.scales
    return tuple(tuple(row) for row in root.tolist())
