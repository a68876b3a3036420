"""What a run leaves behind: a directory that explains itself, written so that a crash leaves the old one whole."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from armcal.config.yaml_source import ConfigSource
from armcal.errors import InputError, Location
from armcal.measure.reader import ENVIRONMENT
from armcal.run.experiment import Experiment
from armcal.run.result import RunResult
from armcal.use.calibration import SCHEMA, CalibrationFile, InformationRecord, dump, parameter_records

EARLIER = "earlier"
FILES = ("experiment.yaml", "residuals.csv", "metrics.json", "report.html", "log.txt", "calibration.yaml")
"""In the order in which they are put in place: the calibration last."""
NOT_CONVERGED_SUFFIX = ".not-converged"


def check_folder(folder: Path) -> None:
    """Refuse a place that is not ours to write to.

    Raises:
        InputError: a file, or a directory with anything that is not a run's.
    """
    where = Location(str(folder))
    if folder.exists() and not folder.is_dir():
        raise InputError("it is a file, expected a directory.", where=where, hint="Give another --out.")
    names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    ours = {*FILES, EARLIER, f"calibration.yaml{NOT_CONVERGED_SUFFIX}"}
    foreign = sorted(name for name in names if name not in ours and not name.startswith(".armcal-"))
    if foreign:
        raise InputError(
            f"it holds files that are not a run's ({', '.join(foreign[:3])}).",
            where=where,
            hint="Give --out a new or empty directory, or one of an earlier run.",
        )


def write(result: RunResult, experiment: Experiment, folder: Path, render: Callable[[RunResult], str]) -> None:
    """Write all files; those of an earlier run in the same place move to ``earlier/``.

    A run that did not converge leaves ``calibration.yaml.not-converged``, which nothing loads.

    Raises:
        InputError: the folder cannot be written.
    """
    texts = {
        "experiment.yaml": experiment_text(experiment.source),
        "residuals.csv": residuals_text(result),
        "metrics.json": json.dumps(metrics(result), indent=2) + "\n",
        "report.html": render(result),
        "log.txt": log_text(result),
        "calibration.yaml": dump(calibration_content(result, experiment)),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".armcal-", dir=folder))
        for name in FILES:
            _write_durably(staging / name, texts[name])
        _keep_earlier(folder)
        for name in FILES:
            kept = name
            if name == "calibration.yaml" and not result.estimate.verdict.converged:
                kept += NOT_CONVERGED_SUFFIX
            os.replace(staging / name, folder / kept)
        shutil.rmtree(staging)
    except OSError as fault:
        raise InputError(
            f"it cannot be written ({fault}).",
            where=Location(str(folder)),
            hint="Give --out a writable directory.",
        ) from fault


def metrics(result: RunResult) -> dict[str, Any]:
    """The numbers of a run for other programs."""
    estimate, told = result.estimate, result.estimate.verdict
    return {
        "experiment": result.name,
        "error_mm": result.table.as_dict(),
        "records": {
            "used": len(result.dataset),
            "train": len(result.split.train),
            "holdout": len(result.split.holdout),
            "set_aside": len(result.dataset.set_aside),
        },
        "parameters": {
            "free": len(estimate.names),
            "determined": int(sum(estimate.determined)),
            "at_bound": list(estimate.at_bound),
            "undetermined": [str(combination) for combination in estimate.identifiability.undetermined],
            "scaled_condition": _finite(estimate.identifiability.condition),
        },
        "noise": {"scale": estimate.noise_scale, "degrees_of_freedom": estimate.degrees_of_freedom},
        "solver": {
            "name": told.name,
            "status": told.status,
            "converged": told.converged,
            "iterations": told.iterations,
            "seconds": told.seconds,
            "starts": told.starts,
            "agreeing_starts": told.agreeing_starts,
        },
        "verdict": {
            "headline": result.verdict.headline,
            "findings": [{"grade": f.grade, "text": f.text} for f in result.verdict.findings],
        },
        "warnings": list(result.warnings),
        "evaluator": result.backend,
        "seconds": dict(result.seconds),
        "provenance": result.provenance,
    }


def calibration_content(result: RunResult, experiment: Experiment) -> dict[str, Any]:
    """The content of calibration.yaml."""
    estimate, provenance = result.estimate, result.provenance
    information = InformationRecord(
        increments=estimate.parameters.increment_names,
        square_root=tuple(tuple(float(x) for x in row) for row in estimate.square_root_information),
    )
    record = CalibrationFile(
        armcal_calibration=SCHEMA,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        experiment=result.name,
        converged=estimate.verdict.converged,
        software=dict(provenance["versions"]),
        identity={
            "arm": provenance["arm_sha256"],
            "data": provenance["data_sha256"],
            "source": provenance["data"],
        },
        environment_columns=tuple(name for name, _ in ENVIRONMENT if result.dataset.has(name)),
        noise={"scale": estimate.noise_scale, "degrees_of_freedom": estimate.degrees_of_freedom},
        quality_mm=result.table.as_dict(),
        verdict={"headline": result.verdict.headline, "findings": [f.text for f in result.verdict.findings]},
        arms=dict(experiment.system.description["arms"]),
        measurements=dict(experiment.system.description["measurements"]),
        statics=dict(experiment.system.description["statics"]),
        parameters=parameter_records(estimate),
        information=information,
    )
    return record.to_config()


def experiment_text(source: ConfigSource) -> str:
    """The merged configuration that was run."""
    return dump(source.data)


def residuals_text(result: RunResult) -> str:
    """A row a record, worst found easily by sorting."""
    errors, dataset = result.errors, result.dataset
    held = np.zeros(len(dataset), dtype=bool)
    held[result.split.holdout] = True
    rows = len(errors.calibrated_residual_mm)
    axes = ["dx_mm", "dy_mm", "dz_mm"] if rows == 3 else [f"residual{i}_mm" for i in range(1, rows + 1)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["pose_id", "source_row", "set", "nominal_mm", "calibrated_mm", "cross_validated_mm", *axes])
    for i, record in enumerate(dataset.ids):
        numbers = [errors.nominal_mm[i], errors.calibrated_mm[i], errors.cross_validated_mm[i]]
        numbers += list(errors.calibrated_residual_mm[:, i])
        row = dataset.rows[i] if dataset.rows else ""
        shown = ["" if not np.isfinite(x) else f"{x:.6f}" for x in numbers]
        writer.writerow([record, row, "holdout" if held[i] else "train", *shown])
    return text.getvalue()


def log_text(result: RunResult) -> str:
    """What happened, in sentences."""
    lines = [
        f"experiment: {result.name}",
        f"command: {result.command}",
        f"verdict: {result.verdict.headline}",
    ]
    lines += [f"{finding.grade}: {finding.text}" for finding in result.verdict.findings]
    lines += [f"warning: {text}" for text in result.warnings]
    lines += [f"set aside: row {a.row}, record {a.record_id}: {a.reason}" for a in result.dataset.set_aside]
    lines += [f"seconds in {stage}: {seconds:.3f}" for stage, seconds in result.seconds.items()]
    return "\n".join(lines) + "\n"


def _write_durably(path: Path, text: str) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def _keep_earlier(folder: Path) -> None:
    """Nothing is overwritten: an earlier run's files move to ``earlier/N``."""
    present = [p for n in (*FILES, f"calibration.yaml{NOT_CONVERGED_SUFFIX}") if (p := folder / n).exists()]
    if not present:
        return
    number = 1
    while (folder / EARLIER / str(number)).exists():
        number += 1
    place = folder / EARLIER / str(number)
    place.mkdir(parents=True)
    for path in present:
        os.replace(path, place / path.name)


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None
