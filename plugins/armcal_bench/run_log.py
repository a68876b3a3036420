"""The folder of a measuring run or a recording: its journal is begun, or gone on with."""

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.devices.device import DeviceIdentity
from armcal.errors import ConfigError, InputError, Location
from armcal.io.journal import JOURNAL_FILES, Entry, Journal, JournalFailedError, JournalFullError, has_journal
from armcal.io.plain_files import check_folder, write_whole
from armcal.measure.tables import write_csv
from armcal.run.experiment import Experiment
from scipy.spatial.transform import Rotation
from typing_extensions import override

Start = Literal["anew", "resume"]


@contextmanager
def opened_journal(
    folder: Path, start: Start, ours: Collection[str], header: Mapping[str, Any], noun: str, same: Mapping[str, str]
) -> Iterator[Journal]:
    where = Location(str(folder))
    is_there = has_journal(folder)
    if start == "resume" and not is_there:
        raise InputError(f"it holds no {noun} to resume.", where=where, hint="Leave --resume out to begin one.")
    if not is_there:
        check_folder(folder, ours)
    with Journal(folder, header) as journal:
        if start == "anew" and not journal.is_new:  # a run that was refused before anything moved left an empty one
            hint = "Give another --out, or go on by --resume."
            raise InputError(f"it holds a {noun} already.", where=where, hint=hint)
        for key, name in same.items():
            begun, now, lists = journal.header.get(key), header[key], ""
            if begun != now:
                if isinstance(begun, list):
                    lists = f" ({', '.join(begun) or 'none'}, now {', '.join(now) or 'none'})"
                hint = f"Give the {name} that it was begun with, or another --out."
                raise InputError(f"it was begun with another {name}{lists}.", where=where, hint=hint)
        yield journal


STARTED, ENERGISED, GOING, HERE = "started", "energised", "going", "here"
MEASURED, LEFT_OUT, NOTICE, ENDED = "measured", "left_out", "told", "ended"  # Kinds of entries
DATASET, SUMMARY = "dataset.csv", "summary.json"
BENCH = "bench"  # Of a rehearsal: where its simulated bench lives
OURS = (DATASET, SUMMARY, *JOURNAL_FILES, BENCH)
_POSITION, _QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")


EndedHow = Literal["done", "held", "parked", "refused", "failed"]
"""``refused``: parked, since what the tracker gives cannot be the arm's poses in the units and frame expected.
``failed``: parked, since a joint gives way, or at the end, with most poses left out."""


@dataclass(frozen=True)
class Progress:
    measured: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # what was written, by pose id, in order
    left_out: Mapping[str, str] = field(default_factory=dict)  # why, by pose id
    angles: Mapping[str, float] = field(default_factory=dict)  # commanded last (rad, by joint); empty before the first
    thermal_state: Mapping[str, Sequence[float]] = field(default_factory=dict)  # of winding and case, with ``angles``
    at: float = 0.0  # unix s of that
    ended: str = ""  # how it ended, if it did: see ``EndedHow``

    def after(self, kind: str, content: Mapping[str, Any]) -> Self:
        if kind == STARTED:
            return replace(self, ended="")
        if kind == MEASURED:
            return replace(self, measured={**self.measured, str(content["pose"]): content})
        if kind == LEFT_OUT:
            return replace(self, left_out={**self.left_out, str(content["pose"]): str(content["why"])})
        if kind == ENERGISED:
            return replace(self, angles={**self.angles, content["joint"]: content["angle"]})
        if kind in (HERE, GOING):
            return replace(self, angles=content["angles"], thermal_state=content["warmth"], at=content["at"])
        if kind == ENDED:
            return replace(self, ended=content["how"])
        return self

    def at_the_end(self, total: int) -> tuple[EndedHow, str]:
        left_out = len(self.left_out)
        some = f"{total - left_out} of {total} poses are measured, {left_out} were left out"
        if 2 * left_out > total:
            return "failed", f"most poses are missing: {some}"
        return "done", some if left_out else "all poses are measured"


def progress_of(entries: Iterable[Entry]) -> Progress:
    return reduce(lambda progress, entry: progress.after(entry.kind, entry.content), entries, Progress())


class Log:
    """Where a run writes down what it does; this one nowhere, for motions that nobody goes on with."""

    def __init__(self) -> None:
        self.progress = Progress()

    def record(self, kind: str, content: Mapping[str, Any]) -> None:
        """An entry that outlasts a power loss."""
        self.progress = self.progress.after(kind, content)

    def note_angles(self, angles: Mapping[str, float], thermal_state: Mapping[str, Any], wall: float) -> None:
        """The commanded angles (rad); a power loss may take the last of these."""


class RunLog(Log):
    """An open journal; that it is full or failed is raised once alone: what comes after that is the way home."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self.progress = progress_of(journal.entries())
        started = [entry.content for entry in journal.entries() if entry.kind == STARTED]
        self.identity = DeviceIdentity(started[-1]["name"], started[0]["device"]) if started else None
        self._failed = False

    def begin(self, identity: DeviceIdentity, at: float) -> None:
        self.record(STARTED, {"at": at, "device": identity.digest, "name": identity.name})
        self.identity = identity

    @override
    def record(self, kind: str, content: Mapping[str, Any]) -> None:
        self._write(self._journal.record, kind, content)
        super().record(kind, content)

    @override
    def note_angles(self, angles: Mapping[str, float], thermal_state: Mapping[str, Any], wall: float) -> None:
        self._write(self._journal.note, HERE, {"angles": dict(angles), "warmth": dict(thermal_state), "at": wall})

    def _write(self, how: Callable[[str, Any], object], kind: str, content: Mapping[str, Any]) -> None:
        try:
            how(kind, dict(content))
        except (JournalFullError, JournalFailedError):
            if not self._failed:
                self._failed = True
                raise


def measured_by(experiment: Experiment) -> tuple[str, tuple[str, ...]]:
    """The measurement (by instance) that a tracker's pose is, and its channels; ConfigError where it is not one."""
    named = [(name, tuple(c.name for c in m.channels())) for name, m in experiment.system.measurements.items()]
    candidates = [pair for pair in named if pair[1] in (_POSITION, (*_POSITION, *_QUATERNION))]
    if len(candidates) != 1:
        names = ", ".join(name for name, _ in candidates) or "none"
        text = f"found {names} among the measurements, expected one tip_position or tip_pose."
        hint = "Configure the one that the bench's tracker measures."
        raise ConfigError(text, where=experiment.source.where(("measurements",)), hint=hint)
    return candidates[0]


def dataset_of(experiment: Experiment, progress: Progress, digests: Mapping[str, str]) -> Dataset:
    instance, local = measured_by(experiment)
    arm = next(iter(experiment.system.arms))
    records = list(progress.measured.values())
    channels: dict[str, Array] = {}
    for joint in records[0]["standing"] if records else ():
        channels[f"{arm}.{joint}"] = np.array([r["standing"][joint] for r in records])
        channels[f"{arm}.approach.{joint}"] = np.array([float(r["approach"][joint]) for r in records])
    beside = {
        f"{kind}_{joint}_deg": tuple(f"{np.rad2deg(r[kind][joint]):.4f}" for r in records)
        for kind in ("commanded", "measured")
        if records and all(kind in r for r in records)
        for joint in records[0][kind]
    }
    poses = np.full((len(records), len(_POSITION) + len(_QUATERNION)), np.nan)
    for pose, record in zip(poses, records, strict=True):
        pose[:3] = record["position"]
        if record["rotation"] is not None:
            x, y, z, w = Rotation.from_matrix(record["rotation"]).as_quat(canonical=True)
            pose[3:] = w, x, y, z
    channels |= {f"{instance}.{name}": poses[:, i] for i, name in enumerate(local)}
    if in_order(progress):
        channels["time"] = np.array([float(r["at"]) for r in records])
    channels["sequence"] = np.arange(1.0, len(records) + 1)
    temperatures = [r.get("temperature") for r in records]
    if records and all(t is not None for t in temperatures):
        channels["temperature"] = np.array(temperatures, dtype=float)
    extra = {
        "mean_sd_mm": tuple(f"{1000 * max(r['deviation']):.4f}" for r in records),
        "frames": tuple(str(r["frames"]) for r in records),
        **beside,
        **{name: (digest,) * len(records) for name, digest in digests.items()},
    }
    return Dataset(tuple(progress.measured), channels, extra, source="acquired")


def in_order(progress: Progress) -> bool:
    """Whether the wall clock went forward from pose to pose; where it was set back, times mean nothing."""
    times = [float(record["at"]) for record in progress.measured.values()]
    return all(before < after for before, after in pairwise(times))


def write_measured(folder: Path, experiment: Experiment, progress: Progress, digests: Mapping[str, str]) -> None:
    if progress.measured:
        dataset = dataset_of(experiment, progress, digests)
        write_csv(folder / DATASET, dataset, experiment.request(measured=True).channels)


def write_outputs(folder: Path, experiment: Experiment, progress: Progress, summary: Mapping[str, Any]) -> None:
    write_measured(folder, experiment, progress, summary["digests"])
    write_whole(folder / SUMMARY, (json.dumps(summary, indent=2) + "\n").encode())
