"""Visits to poses: the arm that is judged, and a table of its records with pose, cycle and direction of approach."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NoReturn, Self

import numpy as np
from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.units import DIMENSIONLESS
from armcal.calibration.calibration import Calibration
from armcal.config.system import System, build_component
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.errors import ConfigError, DataError, Location
from armcal.io.plain_files import input_file
from armcal.measure.checks import records_of
from armcal.measure.environment import noticed
from armcal.measure.groups import pose_numbers
from armcal.measure.reader import CYCLE, Reader, ReadRequest, RequestedChannel, requested_channels
from armcal.plugins import PluginRegistry
from armcal.run.experiment import Experiment, with_data

from armcal_capability.designs import examined_arm

POSE, DIRECTION, FEWEST = "pose", "direction", 2
COMMANDED = tuple(f"commanded_{axis}" for axis in "xyz")
COMMANDED_TURN = tuple(f"commanded_{part}" for part in ("qw", "qx", "qy", "qz"))
_MOST_BYTES, _FEWEST_WORDS = 1 << 31, "Repeatability needs two visits, ISO 9283 asks for 30"
_OWN = (
    RequestedChannel(CYCLE, (CYCLE,), DIMENSIONLESS, required=False),
    *(RequestedChannel(name, (name,), "length", required=False) for name in COMMANDED),
    *(RequestedChannel(name, (name,), DIMENSIONLESS, required=False) for name in COMMANDED_TURN),
)
_REPEATS = "Records of one pose are held out together"
"""In what readers warn of: repeats, which are what is measured here."""
_FAR = 0.1
"""Of the typical distance of the positions that arms reach: no arm repeats as badly."""
_FACTORS = {1000.0: "m", 10.0: "cm", 25.4: "inches", 0.001: "thousandths of the column's unit"}
_NEAR, _MM = 0.02, 1000.0


@dataclass(frozen=True)
class ArmToJudge:
    """One arm as described, and as calibrated."""

    system: System  # with the arm, and the one measurement that is judged
    models: Mapping[str, Parameters]  # nominal and, from a calibration, calibrated; free are those without a prior
    source: ConfigSource  # with the section data, which says how records are read
    columns: Mapping[str, str] = field(default_factory=dict)  # what the calibration's data called its columns
    trained_on: str = ""  # hash of the data that the calibration comes from

    @classmethod
    def load(
        cls,
        path: Path,
        settings: Path | None,
        overrides: Sequence[str],
        records: Path,
        registry: PluginRegistry,
        accept: bool = False,
    ) -> Self:
        """From a calibration or a configuration; ``settings`` is one whose section ``data`` is taken instead."""
        given = load_config(path)
        rules = None if settings is None else load_config(settings, overrides)
        if "armcal_calibration" in given.data:
            calibration = Calibration.load(path, registry, accept)
            source = with_data(rules or replace(given, data={**given.data, "data": {"type": "csv"}}), records)
            record, kept = calibration.record, calibration.record.prediction
            free = {e.name.partition("[")[0] for e in record.parameters if e.free and not e.held_by_prior}
            models = {"nominal": calibration.nominal.with_free(free)}
            models["calibrated"] = calibration.parameters.with_free(free)
            columns = dict(kept.columns) if kept and rules is None else {}
            return cls(_judged(calibration.system, path), models, source, columns, record.identity.get("data", ""))
        experiment = Experiment.load(path, overrides if rules is None else (), records, registry)
        source = with_data(rules, records) if rules else experiment.source
        free = {b.name for b in experiment.parameters.free if b.prior_sd is None and not b.nuisance}
        return cls(_judged(experiment.system, path), {"nominal": experiment.parameters.with_free(free)}, source)


def _judged(system: System, path: Path) -> System:
    """With the measurement that reads positions of a target on the only arm."""
    examined_arm(system, path)
    for name, measurement in system.measurements.items():
        if {channel.name for channel in measurement.channels()}.issuperset("xyz"):
            return replace(system, measurements={name: measurement})
    raise ConfigError(
        f"found {', '.join(system.measurements) or 'no measurement'}, expected one that reads positions.",
        where=Location(str(path)),
        hint="Add a measurement tip_position or tip_pose: accuracy is judged by measured poses.",
    )


@dataclass(frozen=True)
class Group:
    """Visits to one pose from one direction: places of their records, in order of the cycles."""

    pose: str
    direction: str
    members: Indices


@dataclass(frozen=True)
class Visits:
    """Records of poses that were visited again and again."""

    dataset: Dataset
    cycles: Indices  # number of each record's cycle (N)
    groups: tuple[Group, ...]  # in the order in which they first appear
    warnings: tuple[str, ...]

    @property
    def poses(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(group.pose for group in self.groups))

    def main(self, pose: str) -> Group:
        return max((group for group in self.groups if group.pose == pose), key=lambda group: len(group.members))


def read_visits(subject: ArmToJudge, registry: PluginRegistry, path: Path) -> Visits:
    """The records of a table as visits; poses are named by a column, or found by their joint channels.

    Raises:
        DataError: the table is refused, a cycle is no whole number or occurs twice, or a pose has too few visits.
    """
    source, arms = subject.source, subject.system.arms
    channels = (*requested_channels(arms, subject.system.measurements, measured=True), *_OWN)
    section = dict(source.data["data"])
    if subject.columns:
        with input_file(path, _MOST_BYTES, "a table of records") as stream:
            line = stream.readline(1 << 20).decode("utf-8-sig", "replace").rstrip("\r\n")
        names = [cell.strip() for cell in next(csv.reader([line], delimiter=str(section.get("delimiter", ","))), [])]
        known = {name: own for name, own in subject.columns.items() if own in names and name not in names}
        section["columns"] = {**known, **section.get("columns", {})}
    reader: Reader
    reader, _ = build_component(replace(source, data={**source.data, "data": section}), registry, "reader", ("data",))
    dataset = noticed(records_of(reader, ReadRequest(arms, subject.system.measurements, channels)))
    for whole in (COMMANDED, COMMANDED_TURN):
        there = [name for name in whole if dataset.has(name)]
        if there and len(there) < len(whole):
            missing = next(name for name in whole if name not in there)
            raise DataError(
                f"found {', '.join(there)}, expected {missing} too.",
                where=Location(dataset.source, line=1, field=missing),
                hint="Give the whole commanded pose, or none: then it is that of the commanded joint angles.",
            )
    labelled = POSE in dataset.extra
    poses = [f"pose {n + 1}" for n in pose_numbers(dataset, [*command_channels(arms)])]
    if labelled:
        poses = [text.strip() for text in dataset.extra[POSE]]
    directions = [text.strip() for text in dataset.extra.get(DIRECTION, ("",) * len(dataset))]
    if "" in poses:
        _refuse(dataset, poses.index(""), POSE, "no pose is named.", "Name the pose of every record, or of none.")
    members: dict[tuple[str, str], list[int]] = {}
    for i, key in enumerate(zip(poses, directions, strict=True)):
        members.setdefault(key, []).append(i)
    cycles = _cycles(dataset, members)
    groups = [Group(*key, np.array(sorted(own, key=lambda i: cycles[i]))) for key, own in members.items()]
    kept = tuple(group for group in groups if len(group.members) >= FEWEST)
    warnings = [text for text in dataset.warnings if _REPEATS not in text]
    again = f"{_FEWEST_WORDS}: measure it again, or take its rows out."
    lost = [group for group in groups if labelled and group.pose not in {own.pose for own in kept}]
    if lost:
        text = f"the pose {lost[0].pose} has one measured visit."
        _refuse(dataset, int(lost[0].members[0]), POSE, text, again)
    if len(kept) < len(groups):
        warnings.append(f"{len(groups) - len(kept)} of {len(groups)} poses were visited once and are left out.")
    if not kept:
        hint = f"{_FEWEST_WORDS}: visit each pose again (armcal plan --iso-cube)."
        raise DataError(f"none of {len(groups)} poses was visited twice.", where=Location(str(path)), hint=hint)
    return Visits(dataset, cycles, kept, tuple(warnings))


def _cycles(dataset: Dataset, members: Mapping[tuple[str, str], Sequence[int]]) -> Indices:
    """The number of each record's cycle: its column, or which visit of its pose it is."""
    if not dataset.has(CYCLE):
        counted = np.zeros(len(dataset), dtype=np.intp)
        for own in members.values():
            counted[own] = np.arange(1, len(own) + 1)
        return counted
    stated = dataset.channels[CYCLE]
    broken = np.flatnonzero(stated != np.round(stated))
    if broken.size:
        text = f"found the cycle {stated[broken[0]]:g}, expected a whole number."
        _refuse(dataset, int(broken[0]), CYCLE, text, "Number the cycles 1, 2, 3, ...")
    for (pose, direction), own in members.items():
        seen: dict[float, int] = {}
        for i in own:
            before = seen.setdefault(stated[i], i)
            if before != i:
                named = f"{pose} from {direction}" if direction else pose
                text = f"found cycle {stated[i]:g} of {named} again; the first is in line {_line(dataset, before)}."
                _refuse(dataset, i, CYCLE, text, "Number each visit of a pose once.")
    return np.asarray(stated, dtype=np.intp)


def refuse_strangers(visits: Visits, measured: Array, reach: float) -> None:
    """Refuse visits that are nowhere near the others of their pose (N x 3; m) for an arm of this reach (m)."""
    middles = {group.pose: np.median(measured[group.members], axis=0) for group in visits.groups}
    for group in visits.groups:
        off = np.linalg.norm(measured[group.members] - middles[group.pose], axis=1)
        worst = int(np.argmax(off))
        if off[worst] <= _FAR * reach:
            continue
        place = measured[group.members[worst]]
        text = f"it is {off[worst] * _MM:.4g} mm from the other visits to {group.pose}"
        hint = "Measure it again, or take it out."
        for factor, unit in _FACTORS.items():
            if np.linalg.norm(factor * place - middles[group.pose]) < _NEAR * factor * np.linalg.norm(place):
                text += f", and among them if its coordinates are in {unit}"
                hint = "Write all rows in the unit of the column names."
        apart = {pose: float(np.linalg.norm(place - middle)) for pose, middle in middles.items()}
        nearest = min(apart, key=lambda pose: apart[pose])
        if nearest != group.pose and apart[nearest] < 0.1 * off[worst]:
            text += f", and {apart[nearest] * _MM:.3g} mm from those to {nearest}"
            hint = "If two rows were exchanged, put them right."
        _refuse(visits.dataset, int(group.members[worst]), POSE, f"{text}.", hint)


def _line(dataset: Dataset, index: int) -> int:
    return dataset.rows[index] if dataset.rows else index + 1


def _refuse(dataset: Dataset, index: int, field: str, message: str, hint: str) -> NoReturn:
    raise DataError(message, where=Location(dataset.source, line=_line(dataset, index), field=field), hint=hint)
