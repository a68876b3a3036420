"""What a measuring run leaves behind when it ends: a dataset and a summary. Until then its journal holds all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.errors import ConfigError
from armcal.io.journal.files import REAL_FILES, write_whole
from armcal.measure.csv_writer import write_csv
from armcal.run.experiment import Experiment
from scipy.spatial.transform import Rotation

from armcal_bench.acquisition.run_log import Progress
from armcal_bench.journal_folder import JOURNAL

DATASET, SUMMARY = "dataset.csv", "summary.json"
BENCH = "bench"
"""Of a rehearsal: where its simulated bench lives."""
OURS = (DATASET, SUMMARY, JOURNAL, BENCH)
_POSITION, _QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")


def measured_by(experiment: Experiment) -> tuple[str, tuple[str, ...]]:
    """The measurement (by instance) that a tracker's pose is, and its channels.

    Raises:
        ConfigError: none of the measurements is a position or a pose, or several are.
    """
    candidates = []
    for name, measurement in experiment.system.measurements.items():
        channels = tuple(channel.name for channel in measurement.channels())
        if channels in (_POSITION, (*_POSITION, *_QUATERNION)):
            candidates.append((name, channels))
    if len(candidates) != 1:
        names = ", ".join(name for name, _ in candidates) or "none"
        raise ConfigError(
            f"found {names} among the measurements, expected one tip_position or tip_pose.",
            where=experiment.source.where(("measurements",)),
            hint="Configure the one that the bench's tracker measures.",
        )
    return candidates[0]


def dataset_of(experiment: Experiment, progress: Progress, digests: Mapping[str, str]) -> Dataset:
    """The poses that are measured, in the order of measuring."""
    instance, local = measured_by(experiment)
    arm = next(iter(experiment.system.arms))
    records = list(progress.measured.values())
    channels: dict[str, Array] = {}
    for joint in records[0]["standing"] if records else ():
        channels[f"{arm}.{joint}"] = np.array([r["standing"][joint] for r in records])
        channels[f"{arm}.approach.{joint}"] = np.array([float(r["approach"][joint]) for r in records])
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
        **{name: (digest,) * len(records) for name, digest in digests.items()},
    }
    return Dataset(tuple(progress.measured), channels, extra, source="acquired")


def in_order(progress: Progress) -> bool:
    """Whether the wall clock went forward from pose to pose; where it was set back, times mean nothing."""
    times = [float(record["at"]) for record in progress.measured.values()]
    return all(before < after for before, after in pairwise(times))


def write_outputs(folder: Path, experiment: Experiment, progress: Progress, summary: Mapping[str, Any]) -> None:
    """Replace dataset and summary, each whole.

    Raises:
        DataError: they cannot be written.
    """
    if progress.measured:
        dataset = dataset_of(experiment, progress, summary["digests"])
        write_csv(folder / DATASET, dataset, experiment.request(measured=True).channels)
    write_whole(REAL_FILES, folder / SUMMARY, (json.dumps(summary, indent=2) + "\n").encode())
