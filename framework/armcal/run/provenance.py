"""Where the numbers of a run come from."""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from armcal.base.dataset import Dataset
from armcal.calibration.calibration_file import identity_of
from armcal.run.experiment import Experiment


def provenance(experiment: Experiment, dataset: Dataset) -> dict[str, Any]:
    """Where the numbers of a run come from: files, hashes, versions."""
    packages = ("armcal", "numpy", "scipy", "casadi", "cvxpy")
    return {
        "config": str(experiment.source.path),
        "config_files": [Path(file).name for file in experiment.source.files],
        "data": dataset.source,
        "data_sha256": dataset.sha256,
        "arm_sha256": identity_of(experiment.system.description),
        "versions": {
            "python": sys.version.split()[0],
            **{name: version(name) for name in packages},
        },
        "plugins": {p.name: f"{p.distribution} {p.version}" for p in experiment.registry.plugins if not p.fault},
    }
