"""Postures as they were captured, and the dataset that they make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.dataset import Dataset
from armcal.measure.csv_writer import write_csv
from armcal.run.experiment import Experiment

DATASET = "dataset.csv"


@dataclass(frozen=True)
class Posture:
    """The mean of readings of arms that stood still.

    Attributes:
        name: its number, counted from 1 over all that were ever captured here.
        angles: by channel (``arm.q1``; rad, or m of sliding joints).
        spread: the largest less the smallest reading of the joint that moved most (rad or m).
        readings: how many it is the mean of.
        at: unix seconds; of two postures the later one's is not the smaller.
        labels: the group it belongs to (a socket's name), by column.
        stamp: when it was, by the source's own clock (s), where it says so.
    """

    name: str
    angles: Mapping[str, float]
    spread: float
    readings: int
    at: float
    labels: Mapping[str, str] = field(default_factory=dict)
    stamp: float | None = None

    @property
    def place(self) -> str:
        """The name of its group, for people."""
        return "/".join(self.labels.values())

    def as_dict(self) -> dict[str, Any]:
        """As JSON, to be read back by ``Posture(**content)``, numbers bit for bit."""
        return {**self.__dict__, "angles": dict(self.angles), "labels": dict(self.labels)}


def dataset_of(postures: Sequence[Posture], doubts: Mapping[str, str] | None = None) -> Dataset:
    """The postures in the order of capture, at least one; ``doubts`` say why one is not to be trusted, by name."""
    first = postures[0]
    channels = {name: np.array([p.angles[name] for p in postures]) for name in first.angles}
    channels["time"] = np.array([p.at for p in postures])
    extra = {name: tuple(p.labels[name] for p in postures) for name in first.labels}
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
    write_csv(folder / DATASET, dataset_of(postures, doubts), experiment.request(measured=True).channels)
