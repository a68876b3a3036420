"""An experiment: a configuration with its settings, checked and built, before any data is read.

Settings go beyond what the arm is: data, parameters, estimator, validation, simulation, pose plan and its clearance.
"""

import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import filter as matching
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias

import numpy as np
from pydantic import Field, field_validator, model_validator

from armcal.arm.assembly import Arm, command_channels, only_arm
from armcal.arm.clearance import EVERYTHING, Clearance, ClearanceCheck, joints_of_frames
from armcal.base.arrays import Array, Indices
from armcal.base.config_text import ConfigText
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.settings import Angle, InputPath, Length, Settings
from armcal.calibration.calibration_file import identity_of
from armcal.calibration.intervals import PAYLOAD
from armcal.config.selection import ParameterSettings, select, without_groups
from armcal.config.system import StaticsSettings, System, build_component, build_system
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.errors import ConfigError, DataError, Location
from armcal.estimate.estimator import Estimator, Progress, no_progress
from armcal.estimate.robust import NoiseSettings, weighed
from armcal.estimate.simulation import SimulationRequest, Simulator
from armcal.estimate.validation import BootstrapSettings, Split, folds, hold_out, split_by_id, split_by_label
from armcal.measure.checks import noticed, records_of, require_conditions, warn_beyond_limits
from armcal.measure.groups import grouped_instances, groups_of, pose_numbers, unmatched
from armcal.measure.measurement import GroupedMeasurement
from armcal.measure.reader import Reader, ReadRequest, evidence_channels, requested_channels
from armcal.measure.tables import read_ids
from armcal.plugins import PluginRegistry, discover

_AT = ("plan", "clearance")


def clearance_check(settings: Clearance, arms: Mapping[str, Arm], source: ConfigSource) -> ClearanceCheck:
    arm = only_arm(arms, "clearance is checked for a single arm", "Leave the clearance out.", source.where(_AT))
    frames = joints_of_frames(arm)
    for name, shapes in settings.parts.items():
        for index, shape in enumerate(shapes):
            if unknown := [frame for frame in shape.frames if frame not in frames]:
                where, hint = source.where((*_AT, "parts", name, index)), f"The frames are {', '.join(frames)}."
                raise ConfigError(f"no frame is called {unknown[0]!r}.", where=where, hint=hint)
    for index, region in enumerate(settings.forbidden):
        if region.frames != ("base",):
            raise ConfigError(
                f"found the frame {region.frames[0]!r}, expected base: forbidden regions stand still.",
                where=source.where((*_AT, "forbidden", index, "centre")),
                hint="Give the centre in the base frame.",
            )
    check = ClearanceCheck(arm, settings)
    for index, (rule, pairs) in enumerate(zip(settings.rules, check.pairs, strict=True)):
        where, globs = source.where((*_AT, "rules", index)), (*rule.between, *rule.besides)
        if unknown := [glob for glob in globs if glob != EVERYTHING and not matching(settings.parts, glob)]:
            hint = f"The parts are {', '.join(settings.parts) or 'none'}."
            raise ConfigError(f"no part is called {unknown[0]!r}.", where=where, hint=hint)
        if not pairs:
            raise ConfigError(
                f"the rule between {' and '.join(rule.between)} matches no pair of parts.",
                where=where,
                hint="Parts with at most one joint between them do not count; name others, or remove the rule.",
            )
    return check


Levels: TypeAlias = dict[str, Annotated[tuple[Angle, ...], Field(min_length=1)]]
Travel: TypeAlias = dict[str, Annotated[tuple[Length, ...], Field(min_length=1)]]
Speed: TypeAlias = Annotated[float, Field(gt=0)]


class ValidationSettings(Settings):
    """Which records judge.

    ``holdout`` is a fraction chosen by ``seed``; ``train_ids`` a CSV of record ids to train on (the rest judge);
    ``train_groups`` are the values of the text column ``group_by`` to train on (by default the first label of a
    measurement's groups); ``folds`` cross-validates over the training records. Judged records whose error is above
    ``limit`` are listed and explained; without one, those beyond what noise allows.
    """

    holdout: float = 0.0
    folds: Annotated[int, Field(ge=0)] = 0
    seed: Annotated[int, Field(ge=0)] = 0
    train_ids: InputPath | None = None
    train_groups: tuple[str, ...] | None = None
    group_by: str | None = None
    limit: Length | None = None

    @field_validator("holdout")
    @classmethod
    def _share(cls, value: float) -> float:
        if not 0 <= value < 1:
            raise ValueError(f"found {value:g}, expected a share from 0 to below 1: write 0.25 for a quarter")
        return value

    @model_validator(mode="after")
    def _one_split(self) -> Self:
        given = {"holdout": self.holdout > 0, "train_ids": self.train_ids, "train_groups": self.train_groups}
        several = [name for name, value in given.items() if value]
        if len(several) > 1:
            raise ValueError(f"found both {several[0]} and {several[1]}, expected one of them: set holdout: 0")
        if self.folds == 1:
            raise ValueError("found folds: 1, expected 0 (none) or at least 2")
        if self.limit is not None and self.limit <= 0:
            raise ValueError(f"found a limit of {1000 * self.limit:g} mm, expected one above zero")
        return self


class PlanSettings(Settings):
    """How poses are planned.

    ``candidates``: ``recorded`` (the data's), ``grid`` (all combinations of ``levels``), or ``continuous``
    (``count`` poses spread over ``limits``, and the chosen ones moved from there to where they determine most). Sliding
    joints have their levels under ``travel`` and their limits under ``travel_limits``. Any candidate outside the
    limits is left out. ``speeds_deg_per_s`` and ``speeds_mm_per_s`` are by joint; 60 deg/s and 50 mm/s by default.
    """

    candidates: Literal["recorded", "grid", "continuous"] | None = None
    count: Annotated[int, Field(ge=1, le=1_000_000)] = 4096
    limits: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)
    travel_limits: dict[str, tuple[Length, Length]] = Field(default_factory=dict)
    levels: Levels = Field(default_factory=dict)
    travel: Travel = Field(default_factory=dict)
    starts: Annotated[int, Field(ge=0)] = 10
    seed: Annotated[int, Field(ge=0)] = 0
    sweeps: Annotated[int, Field(ge=0, le=100)] = 8
    clearance: Clearance | None = None
    order: Literal["travel", "none"] = "travel"
    speeds_deg_per_s: dict[str, Speed] = Field(default_factory=dict)
    speeds_mm_per_s: dict[str, Speed] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for joint, (low, high) in {**self.limits, **self.travel_limits}.items():
            if not low < high:
                raise ValueError(f"the limits of {joint} are not in rising order: give [lowest, highest]")
        return self


class ExperimentSettings(Settings):
    name: str = ""
    arms: dict[str, Any]
    measurements: dict[str, Any]
    statics: StaticsSettings = Field(default_factory=StaticsSettings)
    data: dict[str, Any] | None = None
    simulation: dict[str, Any] | None = None
    parameters: ParameterSettings = Field(default_factory=ParameterSettings)
    estimator: dict[str, Any] = Field(default_factory=lambda: {"type": "ipopt"})
    evaluator: Literal["auto", "compiled", "interpreted"] = "auto"
    validation: ValidationSettings = Field(default_factory=ValidationSettings)
    noise: NoiseSettings = Field(default_factory=NoiseSettings)
    uncertainty: BootstrapSettings = Field(default_factory=BootstrapSettings)
    plan: PlanSettings | None = None
    bench: dict[str, Any] | None = None


STANDARD_GRAVITY = {"earth": 9.80665, "moon": 1.62, "mars": 3.71}  # m/s^2; [Williams2024]
_HEAVY = 20.0
_GRAVITY_TOLERANCE = 0.02


@dataclass(frozen=True)
class Experiment:
    """A configuration made of real components."""

    name: str  # of the experiment; the configuration file's if it gives none
    source: ConfigSource  # the configuration as written
    settings: ExperimentSettings  # as checked
    system: System  # arms, measurements, statics
    parameters: Parameters  # with free ones, bounds and priors as configured
    estimator: Estimator  # built
    registry: PluginRegistry  # the plugins
    warnings: tuple[str, ...]  # what a user should know before data is read

    @classmethod
    def load(
        cls,
        path: str | Path,
        overrides: Sequence[str] = (),
        data: str | Path | None = None,
        registry: PluginRegistry | None = None,
    ) -> Self:
        """Read and check a configuration (YAML).

        ``overrides`` are ``a.b=value`` texts, as after ``--set``; ``data`` is read instead of the configured file, and
        may lie anywhere; ``registry`` are the plugins, if they were discovered before.

        Raises:
            ConfigError: the configuration is refused.
            PluginError: a component is missing or broken.
        """
        return cls.of(load_config(path, overrides), data, registry)

    @classmethod
    def of(cls, source: ConfigSource, data: str | Path | None = None, registry: PluginRegistry | None = None) -> Self:
        """Check a configuration that was read; else as ``load``."""
        registry = registry or discover()
        if data is not None:
            source = with_data(source, data)
        settings = validate(ExperimentSettings, source)
        system = build_system(source, registry)
        known = without_groups(settings.parameters, grouped_instances(system.measurements))
        parameters = select(system.parameters(), known, source)
        section = source.data.get("estimator") or {}
        named = source
        if "type" not in section:
            named = replace(source, data={**source.data, "estimator": {"type": "ipopt", **section}})
        estimator: Estimator
        estimator, _ = build_component(named, registry, "estimator", ("estimator",))
        name = settings.name or source.path.stem
        texts = tuple(_gravity_warnings(settings, np.array(system.environment.gravity)))
        return cls(str(name), source, settings, system, parameters, weighed(estimator, settings.noise), registry, texts)

    def read(self, progress: Progress = no_progress) -> Dataset:
        """The measured records.

        Raises:
            ConfigError: no data is configured, or not enough is known of the load.
            DataError: the data is refused.
        """
        if self.settings.data is None:
            raise ConfigError(
                "found no data.",
                where=self.source.where(("data",)),
                hint="Give data: {type: csv, path: FILE}, or --data FILE.",
            )
        reader: Reader
        reader, _ = build_component(self.source, self.registry, "reader", ("data",))
        request = replace(self.request(measured=True), report=partial(progress, "reading"))
        dataset = records_of(reader, request)
        elastic = [block.name for block in self.parameters.free if block.unit == "rad_per_Nm"]
        if elastic and self.settings.statics.payload is None and not dataset.has("payload"):
            # A compliance fitted under an unknown load is wrong by that load.
            raise ConfigError(
                f"compliances are calibrated ({elastic[0]}, ...) and the payload is not stated.",
                where=self.source.where(("statics", "payload")),
                hint="State what hung on the tool beyond the links: payload_g: 0 if nothing, or a column payload_g.",
            )
        require_conditions(dataset, request.channels)
        dataset = warn_beyond_limits(noticed(dataset), self.system.arms, self.parameters)
        texts, configured = list[str](), self.settings.statics.payload or 0.0
        payload = float(np.max(dataset.column("payload"))) if dataset.has("payload") else configured
        own = sum(mass.mass for arm in self.system.arms.values() for mass in arm.masses)
        if own and payload > _HEAVY * own:
            times = f"{payload / own:.0f} times the mass of the links ({own:.3g} kg)"
            texts.append(f"a payload of {payload:g} kg is {times}: is it in g?")
        if dataset.has("gravity_z"):
            typical = np.median(dataset.stacked(["gravity_x", "gravity_y", "gravity_z"]), axis=1)
            texts += [f"by its columns, {text}" for text in _gravity_warnings(self.settings, typical)]
        return replace(dataset, warnings=(*dataset.warnings, *texts))

    def of_records(self, dataset: Dataset) -> Self:
        """The experiment with the parameters that the groups of these records bring."""
        if not grouped_instances(self.system.measurements):
            return self
        groups = groups_of(dataset, self.system.measurements)
        chosen = select(self.system.parameters(groups), self.settings.parameters, self.source)
        texts = unmatched(self.system.measurements, groups)
        return replace(self, parameters=chosen, warnings=(*self.warnings, *texts))

    def poses(self, dataset: Dataset) -> Indices:
        """Which records are of one pose, by number (N): all arms near the same joint positions, under the same load."""
        return pose_numbers(dataset, [*command_channels(self.system.arms)])

    def split(self, dataset: Dataset) -> Split:
        """Which records train, and which are held out, as configured."""
        validation = self.settings.validation
        if validation.group_by is not None:
            self.labels(dataset)
        if validation.train_groups:
            return split_by_label(self.labels(dataset), validation.train_groups)
        if validation.train_ids is not None:
            return split_by_id(dataset.ids, read_ids(validation.train_ids))
        split = hold_out(len(dataset), validation.holdout, validation.seed, self.poses(dataset))
        if validation.holdout > 0 and not len(split.holdout):
            raise ConfigError(
                f"a share of {validation.holdout:g} of {len(dataset)} records is no record: none would be held out.",
                where=self.source.where(("validation", "holdout")),
                hint="Hold out a quarter (0.25), or none (0) and give folds: 5.",
            )
        return split

    def folds(self, training: Dataset) -> tuple[Split, ...]:
        """Folds of the training records; none if none are configured."""
        settings = self.settings.validation
        return folds(len(training), settings.folds, settings.seed, self.poses(training)) if settings.folds else ()

    @property
    def label(self) -> str | None:
        """The text column that separates groups; None if there is none."""
        grouped = [m for m in self.system.measurements.values() if isinstance(m, GroupedMeasurement)]
        return self.settings.validation.group_by or next((m.group_labels[0] for m in grouped if m.group_labels), None)

    def labels(self, dataset: Dataset, label: str | None = None, where: Location | None = None) -> tuple[str, ...]:
        """Which group each record belongs to, by the configured column, or by ``label`` (asked for ``where``)."""
        label = label or self.label
        if label == PAYLOAD and not (dataset.has(PAYLOAD) or label in dataset.extra):
            raise DataError(
                "no column states what hung on the tool.",
                where=Location(dataset.source),
                hint="Add a column payload_g to the data, or payloads_g to a simulation.",
            )
        if label is None or not (label in dataset.extra or label == PAYLOAD):
            raise ConfigError(
                f"found no column {label or 'of groups'} in the records; "
                f"they have {', '.join(dataset.extra) or 'none'}.",
                where=where or self.source.where(("validation",)),
                hint=f"Name a text column of the data, or {PAYLOAD}: group_by: NAME.",
            )
        return group_texts(dataset, label)

    def request(self, *, measured: bool) -> ReadRequest:
        """What a reader should look for; with ``measured`` the measured values are required."""
        system = self.system
        channels = requested_channels(system.arms, system.measurements, measured=measured)
        evidence = evidence_channels(system.arms) if measured else ()
        return ReadRequest(system.arms, system.measurements, (*channels, *evidence))

    def provenance(self, dataset: Dataset) -> dict[str, Any]:
        """Where the numbers of a run on these records come from: files, hashes, versions."""
        packages = {"python": sys.version.split()[0]}
        for name in ("armcal", "numpy", "scipy", "casadi", "cvxpy"):
            with suppress(PackageNotFoundError):
                packages[name] = version(name)
        return {
            "config": str(self.source.path),
            "config_files": [Path(file).name for file in self.source.files],
            "data": dataset.source,
            "data_sha256": dataset.sha256,
            "arm_sha256": identity_of(self.system.description),
            "versions": packages,
            "plugins": {p.name: f"{p.distribution} {p.version}" for p in self.registry.plugins if not p.fault},
        }

    def simulator(self) -> Simulator:
        """The configured simulator; a ConfigError if there is none."""
        if self.settings.simulation is None:
            raise ConfigError(
                "found no simulation.",
                where=self.source.where(("simulation",)),
                hint="Give simulation: {type: elastic_arm, truth: FILE, ...}.",
            )
        built: Simulator
        built, _ = build_component(self.source, self.registry, "simulator", ("simulation",))
        return built

    @property
    def simulation_request(self) -> SimulationRequest:
        system = self.system
        return SimulationRequest(system.arms, system.measurements, self.parameters, system.environment)


def group_texts(dataset: Dataset, label: str) -> tuple[str, ...]:
    """A text column as groups are named by it, without spaces about it; a payload to the nearest tenth of a gram."""
    if label in dataset.extra:
        return tuple(text.strip() for text in dataset.extra[label])
    return tuple(f"{tenths / 10:g} g" for tenths in np.round(dataset.column(PAYLOAD) * 10_000).tolist())


def with_data(source: ConfigSource, data: str | Path) -> ConfigSource:
    section: dict[str, Any] = dict(source.data.get("data") or {"type": "csv"})
    section["path"] = ConfigText(str(data))
    return replace(source, data={**source.data, "data": section})


def _gravity_warnings(settings: ExperimentSettings, gravity: Array) -> list[str]:
    """Is gravity (3, m/s^2) what the declared body has (or any known one, if none is), and does it pull down?"""
    size, body = float(np.linalg.norm(gravity)), settings.statics.body
    bodies = STANDARD_GRAVITY if body is None else {body: STANDARD_GRAVITY[body]}
    texts = []
    if all(abs(size - expected) > _GRAVITY_TOLERANCE * expected for expected in bodies.values()):
        known = ", ".join(f"on the {name} {expected:.3f}" for name, expected in bodies.items())
        texts.append(f"gravity is {size:.3f} m/s^2; it is {known}.")
    if gravity[2] > 0:
        texts.append("gravity points up along the base frame's z axis: right only for an arm that hangs.")
    return texts
