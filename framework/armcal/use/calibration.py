"""A calibration as a file: everything needed to use it, check it and go on from it."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import Field

from armcal.base.config_text import plain
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.base.settings import Settings
from armcal.config.system import System, build_system
from armcal.config.validate import validate
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, DataError, Location
from armcal.measure.contact import ArmsAlone
from armcal.measure.measurement import Measurement
from armcal.measure.partners import PairedMeasurement
from armcal.plugins import PluginRegistry, discover
from armcal.solve.coverage import Recording
from armcal.solve.estimator import Estimate
from armcal.solve.problem import Problem
from armcal.solve.variance import Component
from armcal.use.intervals import PlusMinus, PredictionRecord, Uncertainty

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


@dataclass(frozen=True)
class Calibration:
    """A calibrated arm.

    Attributes:
        system: arms, measurements and statics.
        parameters: all blocks; their nominal values are the calibrated ones.
        record: the file's content.
    """

    system: System
    parameters: Parameters
    record: CalibrationFile

    @classmethod
    def load(cls, path: str | Path, registry: PluginRegistry | None = None) -> Calibration:
        """Read a calibration.

        Raises:
            ConfigError: not a calibration, of another schema, damaged, or its description was changed.
            PluginError: it needs a plugin that is not there.
        """
        source = load_config(path)
        schema = source.data.get("armcal_calibration")
        if schema != SCHEMA:
            raise ConfigError(
                f"found calibration schema {schema!r}, expected {SCHEMA}.",
                where=Location(str(path)),
                hint="Give the calibration.yaml of a run, or run the calibration again with this version.",
            )
        record = validate(CalibrationFile, source)
        if not record.converged:
            raise ConfigError(
                "the solver did not converge: these values are no calibration.",
                where=Location(str(path)),
                hint="Run the calibration again with better start values or more data.",
            )
        rows = record.information.square_root
        if [len(row) for row in rows] != [len(record.information.increments)] * len(record.information.increments):
            raise ConfigError(
                "its information does not fit its parameters: the file was cut or damaged.",
                where=Location(str(path)),
                hint="Take a whole copy, or run the calibration again.",
            )
        description = {key: plain(source.data[key]) for key in ("arms", "measurements", "statics")}
        if identity_of(description) != record.identity.get("arm"):
            raise ConfigError(
                "the description of the arm does not match its identity: the file was edited or damaged.",
                where=Location(str(path)),
                hint="Change the experiment's configuration and run it again.",
            )
        system = build_system(source, registry or discover())
        parameters = system.parameters(record.groups)
        return cls(system, parameters.with_nominal(_values(parameters, record, path)), record)

    @property
    def readable(self) -> Mapping[str, Measurement]:
        """The measurements whose readings a single pose has: a contact reads nothing."""
        measurements = self.system.measurements.items()
        return {name: m for name, m in measurements if m.channels() and not isinstance(m, PairedMeasurement)}

    def predict(self, commands: Dataset) -> tuple[dict[str, Array], Array]:
        """What instruments would read and where the first measurement's arms' tools are, in elastic equilibrium.

        Args:
            commands: records with joint angles; load and gravity where they differ from the configured ones.

        Returns:
            values (N) by channel (SI), and base_T_tool (arms x N x 4 x 4).

        Raises:
            DataError: the arm is elastic and neither records nor calibration say what hangs on the tool.
            NotConvergedError: a record has no equilibrium.
        """
        elastic = any(arm.deflection_size for arm in self.system.arms.values())
        if elastic and self.system.statics.payload is None and not commands.has("payload"):
            raise DataError(
                "the arm is elastic and its payload is not stated.",
                where=Location(commands.source or None),
                hint="Add a column payload_g; the calibration was made with one.",
            )
        fixed = self.parameters.with_free(())
        problem = Problem.build(
            self.system.arms,
            self.readable or {"pose": ArmsAlone(tuple(self.system.arms))},
            fixed,
            self.system.environment,
            commands,
            "interpreted",
            groups={},
        )
        shown = problem.predict(fixed.nominal(), problem.records(commands))
        channels = {
            channel: values[row]
            for kernel, values in zip(problem.kernels, shown, strict=True)
            for row, channel in enumerate(kernel.factor.output_channels)
        }
        return channels, _poses(shown[0][len(problem.kernels[0].factor.output_channels) :])

    @property
    def uncertainty(self) -> Uncertainty:
        """How far its predictions may be off.

        Raises:
            ConfigError: the file does not say, or what it says does not fit its parameters.
        """
        kept, noise = self.record.prediction, self.record.noise
        if kept is None:
            raise ConfigError(
                "the calibration keeps nothing about the errors of its predictions.",
                hint="It was written by an earlier version; run the calibration again.",
            )
        entries = self.record.parameters
        free = {entry.name.partition("[")[0] for entry in entries if entry.free}
        names = tuple(entry.name for entry in entries if entry.free)
        if kept.entries != names or [len(row) for row in kept.covariance] != [*range(1, len(names) + 1)]:
            raise ConfigError(
                "the covariance in the calibration does not fit its free parameters.",
                hint="The file was edited or damaged; run the calibration again.",
            )
        fitted = self.parameters.with_nominal(np.array([entry.nominal for entry in entries])).with_free(free)
        components = tuple(_component(each) for each in noise.get("components", ()))
        measure = (float(noise["scale"]), int(noise["degrees_of_freedom"]))
        return Uncertainty(
            replace(self.system, measurements=self.readable),
            fitted,
            self.parameters.nominal(),
            kept,
            *measure,
            components,
        )

    def plus_minus(self, commands: Dataset, recording: Recording = "new") -> PlusMinus:
        """How far measurements at these commands may lie from ``predict``.

        In the ``same`` recording as the calibration's, with the drift that it tells of, which ``shift`` adds to the
        predicted channels.

        Raises:
            ConfigError: the calibration does not say, or was recalibrated since.
            DataError: in the same recording, and the records do not say their place in it.
            NotConvergedError: a record has no equilibrium.
        """
        if recording == "same" and self.record.recalibrated is not None:
            raise ConfigError(
                "the calibration was kept true since its recording, which no longer tells of its drift.",
                hint="Predict for a new recording.",
            )
        return self.uncertainty.plus_minus(commands, recording)

    def forward(self, joint_angles: Array, arm: str | None = None) -> Array:
        """base_T_tool (N x 4 x 4) at commanded joint angles (N x n; rad, or m on sliding joints).

        Raises:
            ValueError: no such arm, or the number of joints differs.
            NotConvergedError: a record has no equilibrium.
        """
        name = arm or next(iter(self.system.arms))
        if name not in self.system.arms:
            raise ValueError(f"no arm is called {name!r}; the arms are {', '.join(self.system.arms)}")
        joints = tuple(self.system.arms[name].commanded)
        angles = np.atleast_2d(np.asarray(joint_angles, dtype=float))
        if angles.shape[1] != len(joints):
            raise ValueError(f"found {angles.shape[1]} joint angles a row, the arm {name} has {len(joints)} joints")
        channels = {f"{name}.{joint}": angles[:, i] for i, joint in enumerate(joints)}
        commands = Dataset(tuple(str(i) for i in range(len(angles))), channels)
        alone = replace(self.system, measurements={"pose": ArmsAlone([name])})
        poses = replace(self, system=alone).predict(commands)[1]
        return np.asarray(poses[0])


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


def _component(kept: Mapping[str, Any]) -> Component:
    """One estimated variance; not a number where null is kept."""
    known: dict[str, Any] = {key: float("nan") if value is None else value for key, value in kept.items()}
    return Component(**known)


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None


def _values(parameters: Parameters, record: CalibrationFile, path: str | Path) -> Array:
    kept = {entry.name: entry.value for entry in record.parameters}
    if tuple(kept) != parameters.entry_names:
        differing: Sequence[str] = sorted(set(kept) ^ set(parameters.entry_names))
        raise ConfigError(
            f"its parameters are not those of its arm: {', '.join(differing[:5]) or 'their order differs'}.",
            where=Location(str(path)),
            hint="It was written by another version of a plugin; run the calibration again.",
        )
    return np.array(list(kept.values()))


def _poses(tools: Array) -> Array:
    """Stacked 3x4 columns (12 an arm x N) as homogeneous matrices (arms x N x 4 x 4)."""
    count = tools.shape[1]
    columns = tools.reshape(-1, 4, 3, count)
    poses = np.zeros((len(columns), count, 4, 4))
    poses[:, :, :3, :] = columns.transpose(0, 3, 2, 1)
    poses[:, :, 3, 3] = 1.0
    return poses
