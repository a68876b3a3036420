"""The postures of a recording, as they were captured: their journal, and the dataset that they make."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.dataset import Dataset
from armcal.io.journal import JOURNAL_FILES, Journal
from armcal.measure.csv_writer import write_csv
from armcal.run.experiment import Experiment

from armcal_bench.recording.window import Mean

DATASET = "dataset.csv"
IMAGES = "images"
OURS = (DATASET, *JOURNAL_FILES, IMAGES)
CAPTURED, UNDONE = "captured", "undone"  # Kinds of entries


@dataclass(frozen=True)
class Posture:
    """The mean of readings of arms that stood still."""

    name: str  # its number, counted from 1 over all that were ever captured here
    angles: Mapping[str, float]  # by channel (``arm.q1``; rad, or m of sliding joints)
    spread: float  # the largest less the smallest reading of the joint that moved most (rad or m)
    readings: int  # how many it is the mean of
    at: float  # unix seconds; of two postures the later one's is not the smaller
    labels: Mapping[str, str] = field(default_factory=dict)  # the group it belongs to (a socket's name), by column
    stamp: float | None = None  # when it was, by the source's own clock (s), where it says so
    image: str = ""  # the name of its image's file; empty where none was taken
    values: Mapping[str, float] = field(default_factory=dict)  # what the image says, by channel (``camera.u_3``, SI)

    @property
    def place(self) -> str:
        return "/".join(self.labels.values())

    def as_dict(self) -> dict[str, Any]:
        """As JSON, to be read back by ``Posture(**content)``, numbers bit for bit."""
        return {**self.__dict__, "angles": dict(self.angles), "labels": dict(self.labels), "values": dict(self.values)}


class RecordingLog:
    """An open journal and the postures in it, in order.

    Attributes:
        last: the newest that was captured, undone or not; None if there is none.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._postures: dict[str, Posture] = {}
        self.last: Posture | None = None
        self._count = 0
        for entry in journal.entries():
            if entry.kind == CAPTURED:
                self._take(Posture(**entry.content))
            elif entry.kind == UNDONE:
                self._postures.pop(entry.content["name"], None)

    @property
    def postures(self) -> tuple[Posture, ...]:
        return tuple(self._postures.values())

    def next_posture(self, mean: Mean, labels: Mapping[str, str], values: Mapping[str, float]) -> Posture:
        at = max(time.time(), self.last.at if self.last else 0.0)
        name = str(self._count + 1)
        return Posture(name, dict(mean.angles), mean.spread, mean.readings, at, dict(labels), mean.stamp, values=values)

    def capture(self, posture: Posture) -> None:
        """Write the next posture, which outlasts a power loss then; see ``Journal.record`` for what it raises."""
        self._journal.record(CAPTURED, posture.as_dict())
        self._take(posture)

    def undo(self) -> Posture | None:
        """Take the last posture back, for good; None if there is none."""
        if not self._postures:
            return None
        name = next(reversed(self._postures))
        self._journal.record(UNDONE, {"name": name})
        return self._postures.pop(name)

    def _take(self, posture: Posture) -> None:
        self._postures[posture.name] = self.last = posture
        self._count += 1


def dataset_of(postures: Sequence[Posture], doubts: Mapping[str, str] | None = None) -> Dataset:
    """The postures in the order of capture, at least one; ``doubts`` say why one is not to be trusted, by name."""
    first = postures[0]
    channels = {name: np.array([p.angles[name] for p in postures]) for name in first.angles}
    for name in dict.fromkeys(name for p in postures for name in p.values):
        channels[name] = np.array([p.values.get(name, np.nan) for p in postures])
    channels["time"] = np.array([p.at for p in postures])
    extra = {name: tuple(p.labels[name] for p in postures) for name in first.labels}
    if any(p.image for p in postures):
        extra["image"] = tuple(p.image for p in postures)
    extra["readings"] = tuple(str(p.readings) for p in postures)
    extra["doubt"] = tuple((doubts or {}).get(p.name, "") for p in postures)
    return Dataset(tuple(p.name for p in postures), channels, extra, source="recorded")


def write_dataset(folder: Path, experiment: Experiment, postures: Sequence[Posture], doubts: Mapping[str, str]) -> None:
    """Replace the dataset, whole; without postures there is none.

    Raises:
        DataError: it cannot be written.
    """
    if not postures:
        (folder / DATASET).unlink(missing_ok=True)
        return
    dataset = dataset_of(postures, doubts)
    write_csv(folder / DATASET, dataset, experiment.request(measured=True).channels)
