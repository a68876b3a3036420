"""The content of calibration.yaml: what it keeps, how it is written, and whether it is used with the physics that it
was made with.

Its check poses are the protection: they are predicted again whenever a calibration is loaded. Versions and sources
explain what they find.
"""

import hashlib
import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from pydantic import Field

from armcal import plugins
from armcal.arm import assembly
from armcal.arm.assembly import command_channels
from armcal.arm.statics import LOAD_CHANNELS, Environment
from armcal.base.arrays import Array, Indices
from armcal.base.config_text import finite, plain
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.settings import Settings
from armcal.calibration.intervals import PredictionRecord
from armcal.calibration.tool_expression import poses_of
from armcal.config.system import System
from armcal.config.yaml_source import ConfigSource, load_config, needs_quotes
from armcal.errors import ConfigError, Location
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import DeterminedBy
from armcal.measure.groups import PairedMeasurement
from armcal.measure.measurement import ArmsAlone, Measurement
from armcal.measure.reader import requested_channels
from armcal.plugins import PluginRegistry
from armcal.problem.problem import Problem
from armcal.version import __version__

SCHEMA = 1
UNMOVED_SD = 1e-4
"""In standard deviations: a step that ignores the bounds and is shorter than this is the solver's own tolerance."""
_LAST_LINE = "# sha256 of the lines above: "
_CHANGED_HINT = (
    "Take a whole copy, or run the calibration again; if it was edited on purpose: armcal calibration accept FILE."
)
_LINE_END = re.compile("[\n\r\x85\u2028\u2029]")


class ParameterRecord(Settings):
    """One canonical entry as it is kept; ``sd``, ``lower`` and ``upper`` are null where they are not known."""

    name: str
    unit: str
    nominal: float
    value: float
    free: bool
    sd: float | None = None
    lower: float | None = None
    upper: float | None = None
    determined_by: DeterminedBy | None = None  # null where it is fixed
    at_bound: bool = False
    unconstrained: float | None = None  # where records without bounds would have it; a bound is no evidence


class InformationRecord(Settings):
    """Square-root information of the increments of the free parameters about their values."""

    increments: tuple[str, ...]
    square_root: tuple[tuple[float, ...], ...]


class ComponentRecord(Settings):
    """A component that a calibration is made of, and the code behind it: ``source`` is a hash of its package."""

    kind: str
    name: str
    plugin: str
    distribution: str
    version: str
    source: str


class CheckRecord(Settings):
    """Predictions at some recorded commands (SI, a row a record) with all parameters at ``values``."""

    channels: tuple[str, ...]
    records: tuple[tuple[float, ...], ...]
    values: tuple[float, ...]
    predicted: dict[str, tuple[float, ...]]  # readings of instruments by channel
    tools: dict[str, tuple[tuple[float, ...], ...]]  # base_T_tool by arm, its upper three rows one after another
    half_widths: dict[str, float]  # the least of the 90 % intervals, by channel
    radius: float | None = None  # the least of a position, 95 % (m)

    @property
    def commands(self) -> Dataset:
        return Dataset.of_rows(self.channels, self.records, "the check poses")


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


SHARE = 0.05  # Of a stated half width or radius: predictions that moved by more are not those of the calibration
UNSTATED_M = 1e-5  # The same where no accuracy of the tool is stated: below what any tracker can resolve
CHECK_POSES = 8


def readable(system: System) -> Mapping[str, Measurement]:
    measurements = system.measurements.items()
    return {name: m for name, m in measurements if m.channels() and not isinstance(m, PairedMeasurement)}


def predict(system: System, parameters: Parameters, commands: Dataset) -> tuple[dict[str, Array], Array]:
    """Instruments' readings (SI, N each by channel) and base_T_tool (arms x N x 4 x 4), in elastic equilibrium."""
    fixed = parameters.with_free(())
    measurements, names = dict(readable(system)), tuple(system.arms)
    if tuple(next((m.arms for m in measurements.values()), ())) != names:  # the first shows where tools are
        measurements = {"_arms": ArmsAlone(names), **measurements}
    parts = (system.arms, measurements, fixed, system.environment, commands)
    problem = Problem.build(*parts, "interpreted", groups={})
    shown = problem.predict(fixed.nominal())
    return problem.by_channel(shown), poses_of(shown[0].tools)


def components(system: System, registry: PluginRegistry) -> tuple[ComponentRecord, ...]:
    plugins = {(plugin.name, plugin.module): plugin for plugin in registry.plugins}
    core = ComponentRecord(
        kind="core",
        name="arm",
        plugin="armcal",
        distribution="armcal",
        version=__version__,
        source=_source(assembly.__name__),
    )
    records, used = {("core", "arm"): core}, list[tuple[str, str]]()
    for arm in system.description["arms"].values():
        used.append(("model", arm["model"]["type"]))
        used += [("effect", effect["type"]) for effect in arm.get("effects", {}).values()]
    used += [("measurement", measurement["type"]) for measurement in system.description["measurements"].values()]
    for kind, name in used:
        component = registry.find(kind, name)
        plugin = plugins[component.plugin, component.module]
        records[kind, name] = ComponentRecord(
            kind=kind,
            name=name,
            plugin=plugin.name,
            distribution=plugin.distribution,
            version=plugin.version,
            source=_source(component.target.partition(":")[0]),
        )
    return tuple(records.values())


def differences(kept: tuple[ComponentRecord, ...], now: tuple[ComponentRecord, ...]) -> list[str]:
    """What is another than it was, a phrase each: versions, and sources of the same version."""
    texts: dict[str, None] = {}
    present = {(record.kind, record.name): record for record in now}
    for old in kept:
        new = present.get((old.kind, old.name))
        if new is None or new == old:
            continue
        if (old.distribution, old.version) != (new.distribution, new.version):
            texts[f"{_release(old)}, now {_release(new)}"] = None
        elif old.kind == "core":
            texts[f"the mechanics of {_release(old)}, now with another source"] = None
        else:
            texts[f"the {old.kind} {old.name} of {_release(old)}, now with another source"] = None
    return list(texts)


def check_poses(system: System, dataset: Dataset, candidates: Indices) -> Dataset | None:
    """Some of the candidates (rows of a dataset) as commands; None where no record has all joints."""
    names = {requested.channel for requested in requested_channels(system.arms, {}, measured=False)} & set(
        dataset.channels
    )
    joints = tuple(command_channels(system.arms))
    if not set(joints) <= names:
        return None
    known = np.asarray(np.isfinite(dataset.stacked(joints)).all(axis=0))
    rows = np.array([row for row in candidates if known[row]], dtype=np.intp)
    if not len(rows):
        return None
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, CHECK_POSES).round().astype(int))]
    chosen = {name: dataset.column(name)[rows] for name in dataset.channels if name in names}
    finite = {name: column for name, column in chosen.items() if np.isfinite(column).all()}
    return Dataset(tuple(str(row + 1) for row in rows), finite)


def under_load(kept: CheckRecord, environment: Environment) -> CheckRecord:
    """The same, its commands with the payload that they were predicted with: it may be stated otherwise from now on."""
    stated = zip(LOAD_CHANNELS, environment.acting, strict=True)
    silent = {c: value for c, value in stated if c.startswith("payload") and c not in kept.channels}
    records = tuple((*record, *silent.values()) for record in kept.records)
    return kept.model_copy(update={"channels": (*kept.channels, *silent), "records": records})


def movement(system: System, parameters: Parameters, kept: CheckRecord) -> tuple[float, float, str]:
    """How far predictions at the check poses are from those that are kept.

    The farthest that a tool moved (m), or a point 1 m from it by its rotation; the largest movement of a channel or
    tool, in units of what is stated for it; and the name of that channel or arm.
    """
    channels, tools = predict(system, parameters.with_nominal(np.array(kept.values)), kept.commands)
    shares, tool_m = {}, 0.0
    for name, poses in zip(system.arms, tools, strict=True):
        before = np.array(kept.tools.get(name, ()), dtype=float).reshape(len(poses), 3, 4)
        apart = float(np.linalg.norm(poses[:, :3] - before, axis=1).max())
        shares[name] = apart / (UNSTATED_M / SHARE if kept.radius is None else kept.radius)
        tool_m = max(tool_m, apart)
    for name, width in kept.half_widths.items():
        if name in kept.predicted:
            after = channels.get(name, np.full(len(kept.records), np.nan))
            shares[name] = float(np.abs(after - kept.predicted[name]).max()) / width
    worst = max(shares, key=lambda name: np.inf if np.isnan(shares[name]) else shares[name])
    return tool_m, float(np.nan_to_num(shares[worst], nan=np.inf)), worst


def _source(module: str) -> str:
    """A hash of the source files of a module's package, or of the module alone; empty where they cannot be read."""
    loaded = sys.modules.get(module)
    file = getattr(loaded, "__file__", None)
    if not file:
        return ""
    path, digest = Path(file), hashlib.sha256()
    try:
        packaged = getattr(loaded, "__package__", "") not in ("", plugins.__name__)
        for module_file in sorted(path.parent.glob("*.py")) if packaged else [path]:
            digest.update(f"{module_file.name}\0".encode() + module_file.read_bytes() + b"\0")
    except OSError:
        return ""
    return digest.hexdigest()[:16]


def _release(component: ComponentRecord) -> str:
    if component.distribution:
        return f"{component.distribution} {component.version}"
    return f"the plugin {component.plugin}"
