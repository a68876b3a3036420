"""An experiment: a configuration, checked and built, before any data is read."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Self

import numpy as np

from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Indices
from armcal.base.config_text import ConfigText
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.calibration.calibration_file import identity_of
from armcal.calibration.recorded_range import PAYLOAD
from armcal.config.selection import select, without_groups
from armcal.config.system import System, build_component, build_system
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.errors import ConfigError, DataError, Location
from armcal.estimate.estimator import Estimator, Progress, no_progress
from armcal.estimate.robust import weighed
from armcal.estimate.simulation import SimulationRequest, Simulator
from armcal.estimate.validation import Split, folds, hold_out, split_by_id, split_by_label
from armcal.measure.checks import records_of
from armcal.measure.environment import noticed, require_conditions, warn_beyond_limits
from armcal.measure.groups import grouped_instances, groups_of, pose_numbers, unmatched
from armcal.measure.measurement import GroupedMeasurement
from armcal.measure.reader import Reader, ReadRequest, evidence_channels, read_ids, requested_channels
from armcal.plugins import PluginRegistry, discover
from armcal.run.settings import ExperimentSettings

STANDARD_GRAVITY = {"earth": 9.80665, "moon": 1.62, "mars": 3.71}  # m/s^2; [Williams2024]
_HEAVY = 20.0
_GRAVITY_TOLERANCE = 0.02


@dataclass(frozen=True)
class Experiment:
    """A configuration made of real components.

    Attributes:
        name: of the experiment; the configuration file's if it gives none.
        source: the configuration as written.
        settings: as checked.
        system: arms, measurements, statics.
        parameters: with free ones, bounds and priors as configured.
        estimator: built.
        registry: the plugins.
        warnings: what a user should know before data is read.
    """

    name: str
    source: ConfigSource
    settings: ExperimentSettings
    system: System
    parameters: Parameters
    estimator: Estimator
    registry: PluginRegistry
    warnings: tuple[str, ...]

    @classmethod
    def load(
        cls,
        path: str | Path,
        overrides: Sequence[str] = (),
        data: str | Path | None = None,
        registry: PluginRegistry | None = None,
    ) -> Self:
        """Read and check a configuration.

        Args:
            path: the YAML file.
            overrides: ``a.b=value`` texts, as after ``--set``.
            data: a file to read instead of the configured one; may lie anywhere.
            registry: plugins, if they were discovered before.

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
        if text := self._heavy(dataset):
            dataset = replace(dataset, warnings=(*dataset.warnings, text))
        if not dataset.has("gravity_z"):
            return dataset
        typical = np.median(dataset.stacked(["gravity_x", "gravity_y", "gravity_z"]), axis=1)
        texts = [f"by its columns, {text}" for text in _gravity_warnings(self.settings, typical)]
        return replace(dataset, warnings=(*dataset.warnings, *texts))

    def _heavy(self, dataset: Dataset) -> str:
        """A warning of a payload that no arm of this mass carries: grams called kilograms; else empty."""
        configured = self.settings.statics.payload or 0.0
        payload = float(np.max(dataset.column("payload"))) if dataset.has("payload") else configured
        own = sum(mass.mass for arm in self.system.arms.values() for mass in arm.masses)
        if not own or payload <= _HEAVY * own:
            return ""
        times = f"{payload / own:.0f} times the mass of the links ({own:.3g} kg)"
        return f"a payload of {payload:g} kg is {times}: is it in g?"

    def of_records(self, dataset: Dataset) -> Self:
        """The experiment with the parameters that the groups of these records bring.

        Raises:
            ConfigError: what is configured of a group's parameters is refused.
            DataError: a record's group is not stated.
        """
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
        """Which records train, and which are held out, as configured.

        Raises:
            ConfigError: no column separates the groups that are asked for, or no record is held out.
        """
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
        text = self.settings.validation.group_by
        if text is not None:
            return text
        labels = [
            measurement.group_labels
            for measurement in self.system.measurements.values()
            if isinstance(measurement, GroupedMeasurement)
        ]
        return next((label[0] for label in labels if label), None)

    def labels(self, dataset: Dataset, label: str | None = None, where: Location | None = None) -> tuple[str, ...]:
        """Which group each record belongs to, by the configured column, or by ``label`` (asked for ``where``).

        Raises:
            ConfigError: no column separates groups.
            DataError: records are grouped by payload, and none states one.
        """
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
        packages = {name: _version(name) for name in ("armcal", "numpy", "scipy", "casadi", "cvxpy")}
        return {
            "config": str(self.source.path),
            "config_files": [Path(file).name for file in self.source.files],
            "data": dataset.source,
            "data_sha256": dataset.sha256,
            "arm_sha256": identity_of(self.system.description),
            "versions": {"python": sys.version.split()[0], **{name: v for name, v in packages.items() if v}},
            "plugins": {p.name: f"{p.distribution} {p.version}" for p in self.registry.plugins if not p.fault},
        }

    def simulator(self) -> Simulator:
        """The configured simulator.

        Raises:
            ConfigError: none is configured.
        """
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


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
