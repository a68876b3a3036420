"""The content of calibration.yaml: what it keeps, and how it is written."""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, model_validator

from armcal.base.config_text import finite, plain
from armcal.base.settings import Settings
from armcal.calibration.intervals import PredictionRecord
from armcal.calibration.physics import CheckRecord, ComponentRecord
from armcal.config.yaml_nodes import needs_quotes
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.errors import ConfigError, Location
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import DeterminedBy

SCHEMA = 1
UNMOVED_SD = 1e-4
"""In standard deviations: a step that ignores the bounds and is shorter than this is the solver's own tolerance."""
_LAST_LINE = "# sha256 of the lines above: "
_CHANGED_HINT = (
    "Take a whole copy, or run the calibration again; if it was edited on purpose: armcal calibration accept FILE."
)
_LINE_END = re.compile("[\n\r\x85\u2028\u2029]")


class ParameterRecord(Settings):
    """One canonical entry as it is kept; ``sd``, ``lower`` and ``upper`` are null where they are not known.

    ``determined_by`` is null where it is fixed. ``unconstrained`` is where the records would have it if no bound held
    any parameter, where that differs: who goes on from the calibration needs it, for a bound is no evidence.
    """

    name: str
    unit: str
    nominal: float
    value: float
    free: bool
    sd: float | None = None
    lower: float | None = None
    upper: float | None = None
    determined_by: DeterminedBy | None = None
    at_bound: bool = False
    unconstrained: float | None = None

    @model_validator(mode="before")
    @classmethod
    def _as_before(cls, record: Any) -> Any:
        """Earlier versions wrote two fields: whether the data determine it, and whether a prior holds it."""
        if isinstance(record, dict) and "determined" in record:
            by_data, by_prior = record["determined"], record.get("held_by_prior")
            by = None if by_data is None else "data" if by_data else "prior" if by_prior else "nothing"
            record = {k: v for k, v in record.items() if k not in ("determined", "held_by_prior")}
            record["determined_by"] = by
        return record


class InformationRecord(Settings):
    """Square-root information of the increments of the free parameters about their values."""

    increments: tuple[str, ...]
    square_root: tuple[tuple[float, ...], ...]


class CalibrationFile(Settings):
    """The schema of calibration.yaml.

    ``accepted`` says why and when it was last accepted by hand; errors are ``quality_px``, ``quality_mN`` and so on
    where nothing measured is a length (``ERROR_UNITS``).
    """

    armcal_calibration: int
    created: str
    experiment: str
    converged: bool
    software: dict[str, str]
    identity: dict[str, str]
    environment_columns: tuple[str, ...] = ()
    noise: dict[str, Any]
    quality_mm: dict[str, Any] = Field(default_factory=dict)
    quality_mrad: dict[str, Any] = Field(default_factory=dict)
    quality_px: dict[str, Any] = Field(default_factory=dict)
    quality_mN: dict[str, Any] = Field(default_factory=dict)
    quality_mNm: dict[str, Any] = Field(default_factory=dict)
    verdict: dict[str, Any]
    arms: dict[str, Any]
    measurements: dict[str, Any]
    statics: dict[str, Any]
    groups: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    parameters: tuple[ParameterRecord, ...]
    prediction: PredictionRecord | None = None
    components: tuple[ComponentRecord, ...] = ()
    checks: CheckRecord | None = None
    accepted: str | None = None
    information: InformationRecord
    recalibrated: dict[str, Any] | None = None

    @property
    def level(self) -> str | None:
        """How far the recalibration that wrote it trusts it; None where a run wrote it."""
        level = (self.recalibrated or {}).get("level")
        return None if level is None else str(level)


def identity_of(description: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(plain(description), sort_keys=True).encode()).hexdigest()


def parameter_records(estimate: Estimate) -> tuple[ParameterRecord, ...]:
    """Every canonical entry of an estimate."""
    parameters, nominal = estimate.parameters, estimate.parameters.nominal()
    units = [unit for block in parameters.blocks for unit in block.entry_units]
    place = {name: i for i, name in enumerate(estimate.names)}
    records = []
    for position, name in enumerate(parameters.entry_names):
        known: dict[str, Any] = {}
        if (i := place.get(name)) is not None:
            interval, sd, free = estimate.intervals[i], float(estimate.deviations[i]), float(estimate.unconstrained[i])
            known = {
                "sd": finite(sd),
                "lower": finite(float(interval.lower)),
                "upper": finite(float(interval.upper)),
                "determined_by": estimate.determined_by[i],
                "unconstrained": free if abs(free - estimate.values[position]) > UNMOVED_SD * sd else None,
            }
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
    return yaml.dump(plain(dict(content)), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


def sealed(content: Mapping[str, Any]) -> str:
    """The text of a calibration: YAML that ends in a hash of all that is above it."""
    text = dump(content)
    return f"{text}{_LAST_LINE}{_hash(text)}\n"


def read_record(path: str | Path, changed: bool = False, content: bytes | None = None) -> tuple[ConfigSource, bool]:
    """A calibration's content, and whether it is as armcal wrote it; if it must be, ``changed`` is false.

    ``content`` is what the file holds, where it need not be there.

    Raises:
        ConfigError: it cannot be read, is not a calibration of this schema, or was changed since it was written.
    """
    states: list[Literal["whole", "broken", "absent"]] = []

    def look(text: str) -> None:
        # Line ends may have become those of another system.
        above, marker, kept = text.replace("\r\n", "\n").rpartition(_LAST_LINE)
        states.append("absent" if not marker else "whole" if kept == f"{_hash(above)}\n" else "broken")
        if states == ["broken"] and not changed:
            reason = "its content is not what armcal wrote: it was edited or damaged."
            raise ConfigError(reason, where=Location(str(path)), hint=_CHANGED_HINT)

    source = load_config(path, check=look, content=content)
    schema = source.data.get("armcal_calibration")
    if schema != SCHEMA:
        raise ConfigError(
            f"found calibration schema {schema!r}, expected {SCHEMA}.",
            where=Location(str(path)),
            hint="Give the calibration.yaml of a run, or run the calibration again with this version.",
        )
    if states == ["absent"] and not changed:
        raise ConfigError(
            "it does not end in the hash of its content: it was cut, damaged, or written by an earlier version.",
            where=Location(str(path)),
            hint=_CHANGED_HINT,
        )
    return source, states == ["whole"]


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """Puts text of several lines in double quotes, the only style that keeps every kind of line end, and numbers that
    are text."""


def _quoted(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    style = '"' if _LINE_END.search(text) or needs_quotes(text) else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


def _in_line(dumper: yaml.SafeDumper, entries: list[Any]) -> yaml.SequenceNode:
    are_numbers = bool(entries) and all(isinstance(entry, int | float) for entry in entries)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", entries, flow_style=are_numbers)


_Dumper.add_representer(str, _quoted)
_Dumper.add_representer(list, _in_line)


def lost_calibration(record: CalibrationFile, path: str | Path) -> ConfigError:
    recalibrated = record.recalibrated or {}
    reason = str(recalibrated.get("why", "")).rstrip(".")
    return ConfigError(
        f"its level is lost, as of record {recalibrated.get('record') or recalibrated.get('sequence')}: {reason}.",
        where=Location(str(path)),
        hint="Roll its recalibration back to the last good record (armcal control DIR rollback good), or calibrate "
        "again. To use it all the same: --accept of predict, compensate, export and serve.",
    )
