"""Visits to poses: a table of records, with pose, cycle and direction of approach, checked."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from armcal.arm.assembly import command_channels
from armcal.base.arrays import Indices
from armcal.base.dataset import Dataset
from armcal.base.units import DIMENSIONLESS
from armcal.config.system import build_component
from armcal.errors import DataError, Location
from armcal.io.plain_files import input_file
from armcal.measure.checks import records_of
from armcal.measure.environment import noticed
from armcal.measure.groups import pose_numbers
from armcal.measure.reader import CYCLE, Reader, ReadRequest, RequestedChannel, requested_channels
from armcal.plugins import PluginRegistry

from armcal_capability.acceptance.subject import ArmToJudge

POSE, DIRECTION = "pose", "direction"
COMMANDED = tuple(f"commanded_{axis}" for axis in "xyz")
COMMANDED_TURN = tuple(f"commanded_{part}" for part in ("qw", "qx", "qy", "qz"))
FEWEST = 2
_MOST_BYTES, _FEWEST_WORDS = 1 << 31, "Repeatability needs two visits, ISO 9283 asks for 30"
_OWN = (
    RequestedChannel(CYCLE, (CYCLE,), DIMENSIONLESS, required=False),
    *(RequestedChannel(name, (name,), "length", required=False) for name in COMMANDED),
    *(RequestedChannel(name, (name,), DIMENSIONLESS, required=False) for name in COMMANDED_TURN),
)
_REPEATS = "Records of one pose are held out together"
"""In what readers warn of: repeats, which are what is measured here."""


@dataclass(frozen=True)
class Group:
    """Visits to one pose from one direction: places of their records, in order of the cycles."""

    pose: str
    direction: str
    members: Indices

    def __len__(self) -> int:
        return len(self.members)


@dataclass(frozen=True)
class Visits:
    """Records of poses that were visited again and again.

    Attributes:
        dataset: the records.
        cycles: number of each record's cycle (N).
        groups: by pose and direction, in the order in which they first appear.
        labelled: whether a column names the poses; else they are found by their joint positions.
        numbered: whether a column numbers the cycles; else they are counted.
        warnings: for the user.
    """

    dataset: Dataset
    cycles: Indices
    groups: tuple[Group, ...]
    labelled: bool
    numbered: bool
    warnings: tuple[str, ...]

    @property
    def poses(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(group.pose for group in self.groups))

    def main(self, pose: str) -> Group:
        return max((group for group in self.groups if group.pose == pose), key=len)

    @property
    def timed(self) -> bool:
        return self.dataset.has("time")


def read_visits(subject: ArmToJudge, registry: PluginRegistry, path: Path) -> Visits:
    """The records of a table, as visits.

    Raises:
        DataError: the table is refused, or a pose has too few visits.
    """
    source, arms = subject.source, subject.system.arms
    channels = (*requested_channels(arms, subject.system.measurements, measured=True), *_OWN)
    section = dict(source.data["data"])
    if subject.columns:
        with input_file(path, _MOST_BYTES, "a table of records") as stream:
            names = _split(stream.readline(1 << 20), str(section.get("delimiter", ",")))
        known = {name: own for name, own in subject.columns.items() if own in names and name not in names}
        section["columns"] = {**known, **section.get("columns", {})}
    reader: Reader
    reader, _ = build_component(replace(source, data={**source.data, "data": section}), registry, "reader", ("data",))
    dataset = noticed(records_of(reader, ReadRequest(arms, subject.system.measurements, channels)))
    _require_whole(dataset, COMMANDED)
    _require_whole(dataset, COMMANDED_TURN)
    return visits_of(dataset, [*command_channels(arms)], path, section)


def visits_of(dataset: Dataset, joints: Sequence[str], path: Path, section: Mapping[str, object]) -> Visits:
    """Records as visits; poses are named by a column, or found by their joint channels.

    Raises:
        DataError: a cycle is no whole number or occurs twice, or a pose has too few visits.
    """
    labelled, numbered = POSE in dataset.extra, dataset.has(CYCLE)
    poses = (
        [text.strip() for text in dataset.extra[POSE]]
        if labelled
        else [f"pose {n + 1}" for n in pose_numbers(dataset, joints)]
    )
    directions = [text.strip() for text in dataset.extra.get(DIRECTION, ("",) * len(dataset))]
    if labelled and "" in poses:
        _refuse(dataset, poses.index(""), POSE, "no pose is named.", "Name the pose of every record, or of none.")
    members: dict[tuple[str, str], list[int]] = {}
    for i, key in enumerate(zip(poses, directions, strict=True)):
        members.setdefault(key, []).append(i)
    cycles = _cycles(dataset, members)
    order = {key: np.array(sorted(own, key=lambda i: cycles[i]), dtype=np.intp) for key, own in members.items()}
    groups = [Group(pose, direction, own) for (pose, direction), own in order.items()]
    if labelled:
        _require_visits(dataset, groups, path, str(section.get("delimiter", ",")))
    kept = tuple(group for group in groups if len(group) >= FEWEST)
    warnings = [text for text in dataset.warnings if _REPEATS not in text]
    if lost := len(groups) - len(kept):
        warnings.append(f"{lost} of {len(groups)} poses were visited once and are left out.")
    if not kept:
        raise DataError(
            f"none of {len(groups)} poses was visited twice.",
            where=Location(str(path)),
            hint=f"{_FEWEST_WORDS}: visit each pose again (armcal plan --iso-cube).",
        )
    return Visits(dataset, cycles, kept, labelled, numbered, tuple(warnings))


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
                place = _line(dataset, before)
                named = f"{pose} from {direction}" if direction else pose
                text = f"found cycle {stated[i]:g} of {named} again; the first is in line {place}."
                _refuse(dataset, i, CYCLE, text, "Number each visit of a pose once.")
    return np.asarray(stated, dtype=np.intp)


def _require_visits(dataset: Dataset, groups: Sequence[Group], path: Path, delimiter: str) -> None:
    """Named poses have enough visits; records that were set aside say which of theirs are lost."""
    lost = _lost_labels(dataset, path, delimiter)
    have = {group.pose: 0 for group in groups} | dict.fromkeys(lost, 0)
    for group in groups:
        have[group.pose] = max(have[group.pose], len(group))
    for pose, count in have.items():
        if count >= FEWEST:
            continue
        own = lost.get(pose, ())
        reason = {aside.row: aside.reason for aside in dataset.set_aside}.get(own[0], "") if own else ""
        more = f"; {len(own)} of its rows were set aside, the first because {reason}" if own else ""
        first = own[0] if own else _line(dataset, int(next(g for g in groups if g.pose == pose).members[0]))
        visits = "was never measured" if not count else "has one measured visit"
        raise DataError(
            f"the pose {pose} {visits}{more}.",
            where=Location(str(path), line=first, field=reason.split(" ")[0] if reason else POSE),
            hint=f"{_FEWEST_WORDS}: measure it again, or take its rows out.",
        )


def _lost_labels(dataset: Dataset, path: Path, delimiter: str) -> dict[str, list[int]]:
    """Lines of records that were set aside, by the pose that they name."""
    rows, lost = {aside.row for aside in dataset.set_aside}, dict[str, list[int]]()
    if not rows:
        return lost
    with input_file(path, _MOST_BYTES, "a table of records") as stream:
        place: int | None = None
        for number, raw in enumerate(stream, start=1):
            cells = _split(raw, delimiter) if place is None or number in rows else []
            if place is None:
                place = cells.index(POSE) if POSE in cells else None
            elif len(cells) > place:
                lost.setdefault(cells[place], []).append(number)
    return lost


def _split(raw: bytes, delimiter: str) -> list[str]:
    line = raw.decode("utf-8-sig", "replace").rstrip("\r\n")
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]


def _require_whole(dataset: Dataset, names: Sequence[str]) -> None:
    there = [name for name in names if dataset.has(name)]
    if there and len(there) < len(names):
        missing = next(name for name in names if name not in there)
        raise DataError(
            f"found {', '.join(there)}, expected {missing} too.",
            where=Location(dataset.source, line=1, field=missing),
            hint="Give the whole commanded pose, or none: then it is that of the commanded joint angles.",
        )


def _line(dataset: Dataset, index: int) -> int:
    return dataset.rows[index] if dataset.rows else index + 1


def _refuse(dataset: Dataset, index: int, field: str, message: str, hint: str) -> None:
    raise DataError(message, where=Location(dataset.source, line=_line(dataset, index), field=field), hint=hint)
