"""The recorded postures as a dataset, written anew whenever one is captured or taken back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from armcal.base.dataset import Dataset
from armcal.measure.csv_writer import write_csv
from armcal.run.experiment import Experiment

from armcal_bench.recording.posture import Posture
from armcal_bench.recording.recording_log import DATASET


def dataset_of(postures: Sequence[Posture], doubts: Mapping[str, str]) -> Dataset:
    """The postures in the order of capture; ``doubts`` say why one is not to be trusted, by name."""
    first = postures[0]
    channels = {name: np.array([p.angles[name] for p in postures]) for name in first.angles}
    channels["time"] = np.array([p.at for p in postures])
    extra = {name: tuple(p.labels[name] for p in postures) for name in first.labels}
    extra["readings"] = tuple(str(p.readings) for p in postures)
    extra["doubt"] = tuple(doubts.get(p.name, "") for p in postures)
    return Dataset(tuple(p.name for p in postures), channels, extra, source="recorded")


def write_dataset(folder: Path, experiment: Experiment, postures: Sequence[Posture], doubts: Mapping[str, str]) -> None:
    """Replace the dataset, whole; without postures there is none.

    Raises:
        DataError: it cannot be written.
    """
    if not postures:
        (folder / DATASET).unlink(missing_ok=True)
        return
    write_csv(folder / DATASET, dataset_of(postures, doubts), experiment.request(measured=True).wanted)
