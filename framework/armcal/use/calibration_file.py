"""The content of calibration.yaml: what it keeps, and how it is written."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml
from pydantic import Field

from armcal.base.config_text import plain
from armcal.base.settings import Settings
from armcal.solve.estimator import Estimate
from armcal.use.intervals import PredictionRecord

SCHEMA = 1
UNMOVED_SD = 1e-4
"""In standard deviations: a step that ignores the bounds and is shorter than this is the solver's own tolerance."""
_LINE_END = re.compile("[\n\r\x85\u2028\u2029]")


class ParameterRecord(Settings):
    """One canonical entry as it is kept; ``sd``, ``lower`` and ``upper`` are null where they are not known.

    ``determined`` is by the records alone; what they do not determine may be held by a prior, and is no finding.
    ``unconstrained`` is where the records would have it if no bound held any parameter, where that differs: who goes on
    from the calibration needs it, for a bound is no evidence.
    """

    name: str
    unit: str
    nominal: float
    value: float
    free: bool
    sd: float | None = None
    lower: float | None = None
    upper: float | None = None
    determined: bool | None = None
    held_by_prior: bool = False
    at_bound: bool = False
    unconstrained: float | None = None


class InformationRecord(Settings):
    """Square-root information of the increments of the free parameters about their values."""

    increments: tuple[str, ...]
    square_root: tuple[tuple[float, ...], ...]


class CalibrationFile(Settings):
    """The schema of calibration.yaml."""

    armcal_calibration: int
    created: str
    experiment: str
    converged: bool
    software: dict[str, str]
    identity: dict[str, str]
    environment_columns: tuple[str, ...] = ()
    noise: dict[str, Any]
    quality_mm: dict[str, Any]
    verdict: dict[str, Any]
    arms: dict[str, Any]
    measurements: dict[str, Any]
    statics: dict[str, Any]
    groups: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    parameters: tuple[ParameterRecord, ...]
    prediction: PredictionRecord | None = None
    information: InformationRecord
    recalibrated: dict[str, Any] | None = None


def identity_of(description: Mapping[str, Any]) -> str:
    """A hash of an arm's whole description."""
    return hashlib.sha256(json.dumps(plain(description), sort_keys=True).encode()).hexdigest()


def parameter_records(estimate: Estimate) -> tuple[ParameterRecord, ...]:
    """Every canonical entry of an estimate."""
    parameters, nominal = estimate.parameters, estimate.parameters.nominal()
    units = [block.entry_unit for block in parameters.blocks for _ in block.entry_names]
    place = {name: i for i, name in enumerate(estimate.names)}
    records = []
    for position, name in enumerate(parameters.entry_names):
        i = place.get(name)
        known = {} if i is None else _uncertainty(estimate, i)
        records.append(
            ParameterRecord(
                name=name,
                unit=units[position],
                nominal=float(nominal[position]),
                value=float(estimate.values[position]),
                free=i is not None,
                at_bound=name in estimate.at_bound,
                **known,
            )
        )
    return tuple(records)


def dump(content: Mapping[str, Any]) -> str:
    """YAML text, keys in order, numbers to their last digit."""
    return yaml.dump(plain(dict(content)), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """Puts text of several lines in double quotes, the only style that keeps every kind of line end."""


def _quoted(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    style = '"' if _LINE_END.search(text) else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _quoted)


def _uncertainty(estimate: Estimate, index: int) -> dict[str, Any]:
    interval, free = estimate.intervals[index], float(estimate.unconstrained[index])
    moved = abs(free - estimate.values[estimate.free_entries[index]])
    return {
        "unconstrained": free if moved > UNMOVED_SD * estimate.deviations[index] else None,
        "sd": _finite(estimate.deviations[index]),
        "lower": _finite(interval.lower),
        "upper": _finite(interval.upper),
        "determined": estimate.told_by_data[index],
        "held_by_prior": estimate.determined[index] and not estimate.told_by_data[index],
    }


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None
