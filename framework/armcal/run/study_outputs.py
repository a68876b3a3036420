"""What a study leaves behind: its numbers, a row a record, a page, and the configuration that was run."""

from __future__ import annotations

import csv
import io
from typing import Any

import numpy as np

from armcal.base.config_text import as_json
from armcal.calibration.calibration_file import dump
from armcal.config.variants import SECTION
from armcal.run.study import Study
from armcal.run.study_result import StudyResult, TransferResult

FILES = ("experiment.yaml", "study.csv", "study.json", "study.html")


def files(result: StudyResult | TransferResult, study: Study, page: str) -> dict[str, str]:
    """The texts of all files by their names."""
    return {
        "experiment.yaml": dump(self_contained(study)),
        "study.csv": _csv_text(result),
        "study.json": as_json(result.as_dict()) + "\n",
        "study.html": page,
    }


def self_contained(study: Study) -> dict[str, Any]:
    """The configuration with each variant as the sections in which it differs: no other file is needed."""
    read = next((e.source.data["data"] for e in study.experiments.values() if "data" in e.source.data), None)
    data = study.source.data if read is None else {**study.source.data, "data": read}
    base = {key: section for key, section in data.items() if key != SECTION}
    variants = {}
    for name, experiment in study.experiments.items():
        own = experiment.source.data
        differing = {key: section for key, section in own.items() if base.get(key) != section}
        variants[name] = {"set": differing | {key: None for key in base if key not in own}}
    return {**data, SECTION: {**data[SECTION], "variants": variants}}


def _csv_text(result: StudyResult | TransferResult) -> str:
    """A row a record, an error a variant, by a fit that did not see the record."""
    if isinstance(result, StudyResult):
        columns = {f"{v.name}_{result.unit}": v.errors_mm for v in result.variants}
        if result.nested:
            columns[f"chosen_inside_{result.unit}"] = result.nested.errors_mm
    else:
        columns = {
            f"{name}_trained_at_{'_and_'.join(f'{g:g}' for g in trained)}_g_{result.unit}": errors
            for (name, trained), errors in result.errors_mm.items()
        }
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    dataset = result.dataset
    payload = {"payload_g": dataset.column("payload") * 1000} if isinstance(result, TransferResult) else {}
    writer.writerow(["pose_id", "source_row", *payload, *columns])
    for i, record in enumerate(dataset.ids):
        numbers = [*(each[i] for each in payload.values()), *(column[i] for column in columns.values())]
        row = dataset.rows[i] if dataset.rows else ""
        writer.writerow([record, row, *("" if not np.isfinite(x) else f"{x:.6f}" for x in numbers)])
    return text.getvalue()
