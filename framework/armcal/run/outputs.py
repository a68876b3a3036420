"""What a run leaves behind: a directory that explains itself, written so that a crash leaves the old one whole."""

import warnings
from contextlib import AbstractContextManager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from armcal.base.config_text import as_json, finite
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import (
    SCHEMA,
    CalibrationFile,
    InformationRecord,
    check_poses,
    dump,
    parameter_records,
    sealed,
)
from armcal.diagnose.verdict import evidence
from armcal.errors import ArmcalError, CalibrationWarning, NotConvergedError
from armcal.estimate.validation import in_unit
from armcal.io import folder as folders
from armcal.measure.csv_writer import csv_text
from armcal.measure.reader import surroundings
from armcal.plugins import PluginRegistry
from armcal.run.experiment import Experiment
from armcal.run.result import RunResult

FILES = ("experiment.yaml", "residuals.csv", "metrics.json", "report.html", "calibration.yaml")
"""In the order in which they are put in place: the calibration last."""
NOT_CONVERGED_SUFFIX = ".not-converged"
DO_NOT_USE_SUFFIX = ".do-not-use"
UNREADABLE_SUFFIX = ".unreadable"
_OURS = (
    "bootstrap.csv",  # of runs by earlier versions, which made these three files
    "log.txt",
    "profile.json",
    *(f"calibration.yaml{suffix}" for suffix in (NOT_CONVERGED_SUFFIX, DO_NOT_USE_SUFFIX, UNREADABLE_SUFFIX)),
    *FILES,
)


def reserved(folder: Path) -> AbstractContextManager[folders.Reservation]:
    """Keep a folder for one run.

    Raises:
        InputError: a file, a directory with anything that is not a run's, or one that another run writes to.
    """
    return folders.reserved(folder, _OURS)


def calibration_name(result: RunResult, accepted: bool) -> str:
    """What the calibration is called: as no command loads it if it did not converge, or is bad and not accepted."""
    if not result.estimate.verdict.converged:
        return f"calibration.yaml{NOT_CONVERGED_SUFFIX}"
    return f"calibration.yaml{DO_NOT_USE_SUFFIX}" if result.verdict.bad and not accepted else "calibration.yaml"


def write(
    held: folders.Reservation, result: RunResult, experiment: Experiment, page: str, accepted: bool = False
) -> None:
    """Write all files into a reserved folder; those of an earlier run in the same place move to ``earlier/``.

    Raises:
        InputError: the folder cannot be written.
        ArmcalError: the calibration cannot be read back: it is left as ``calibration.yaml.unreadable``.
    """
    texts: dict[str, str] = {}
    fault: ArmcalError | None = None
    texts |= {
        "experiment.yaml": dump(experiment.source.data),
        "residuals.csv": residuals_text(result),
        "metrics.json": as_json(metrics(result)) + "\n",
        "report.html": page,
        calibration_name(result, accepted): sealed(calibration_content(result, experiment, accepted)),
    }
    if "calibration.yaml" in texts:
        try:
            read_back(texts["calibration.yaml"], experiment.registry)
        except ArmcalError as refusal:
            fault = refusal
            texts[f"calibration.yaml{UNREADABLE_SUFFIX}"] = texts.pop("calibration.yaml")
    held.place(texts)
    if fault is not None:
        hint = f"It was left as calibration.yaml{UNREADABLE_SUFFIX}, which nothing loads. {fault.hint}"
        raise ArmcalError(f"the calibration cannot be read back: {fault.message}", hint=hint) from fault


def metrics(result: RunResult) -> dict[str, Any]:
    """The numbers of a run for other programs."""
    estimate, known, verdict = result.estimate, result.estimate.identifiability, result.verdict
    content = {
        "experiment": result.name,
        "error_mm": _errors(result),
        **({"orientation_error_deg": result.table.turns.as_dict()} if result.table.turns else {}),
        "groups": {own.name: {k: v for k, v in asdict(own).items() if k != "name"} for own in result.groups},
        **({"pose_residual": result.pose_residual.as_dict()} if result.pose_residual else {}),
        "records": {
            "used": len(result.dataset),
            "train": len(result.split.train),
            "holdout": len(result.split.holdout),
            "set_aside": len(result.dataset.set_aside),
            "rejected": len(result.noise.set_aside),
        },
        "parameters": {
            "free": len(known),
            "rank": known.rank,
            "determined_by": estimate.sources,
            "at_bound": list(estimate.at_bound),
            "undetermined": [str(combination) for combination in known.undetermined],
            "scaled_condition": finite(float(known.condition)),
        },
        "noise": _noise(result),
        "solver": asdict(estimate.verdict),
        "verdict": {
            "usable": not verdict.bad,
            "grade": verdict.grade,
            "headline": verdict.headline,
            "findings": [asdict(finding) for finding in verdict.findings],
            "paragraph": verdict.paragraph,
        },
        "structure": evidence(result.fit),
        "prediction_intervals": result.intervals.as_dict(),
        "bootstrap": _bootstrap_metrics(result),
        "warnings": list(result.warnings),
        "evaluator": result.backend,
        "seconds": dict(result.seconds),
        "provenance": result.provenance,
    }
    return dict(in_unit(content, result.errors.unit))


def _errors(result: RunResult) -> dict[str, Any]:
    """The table, and of training and judging groups the mean of their means: a group of few records counts as much."""
    table, groups = result.table.as_dict(), result.groups
    for key, own in (("train", [g for g in groups if g.trained]), ("holdout", [g for g in groups if not g.trained])):
        if own:
            table["nominal"][key]["mean_of_groups"] = float(np.mean([g.nominal_error_mm for g in own]))
            table["calibrated"][key]["mean_of_groups"] = float(np.mean([g.error_mm for g in own]))
            known = [g.distance_error_mm for g in own if g.distance_error_mm is not None]
            table["calibrated"][key]["distance_mean_of_groups"] = float(np.mean(known)) if known else None
    return table


def calibration_content(result: RunResult, experiment: Experiment, accepted: bool = False) -> dict[str, Any]:
    """The content of calibration.yaml; nothing loads one whose verdict is bad, unless it was ``accepted``."""
    estimate, provenance, unit = result.estimate, result.provenance, result.errors.unit
    quality: dict[str, Any] = {f"quality_{unit}": result.table.as_dict()}
    information = InformationRecord(
        increments=estimate.parameters.coordinate_names,
        square_root=tuple(tuple(float(x) for x in row) for row in estimate.square_root_information),
    )
    record = CalibrationFile(
        armcal_calibration=SCHEMA,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        experiment=result.name,
        converged=estimate.verdict.converged,
        software=dict(provenance["versions"]),
        identity={"arm": provenance["arm_sha256"], "data": provenance["data_sha256"], "source": provenance["data"]},
        environment_columns=tuple(filter(result.dataset.has, surroundings(result.system.arms))),
        noise=in_unit(_noise(result), unit),
        **quality,
        verdict={
            "headline": result.verdict.headline,
            "usable": not result.verdict.bad,
            "accepted": accepted,
            "findings": [f.text for f in result.verdict.findings],
        },
        arms=dict(result.system.description["arms"]),
        measurements=dict(result.system.description["measurements"]),
        statics=dict(result.system.description["statics"]),
        groups={owner: tuple(keys) for owner, keys in result.fit.problem.blueprint.groups.items()},
        parameters=parameter_records(estimate),
        prediction=result.prediction,
        information=information,
    )
    system, registry = result.system, experiment.registry
    parameters = system.parameters(record.groups).with_nominal(estimate.values)
    calibration = Calibration(system, parameters, record)
    try:
        calibration = calibration.checked(check_poses(system, result.dataset, result.split.train), registry)
    except NotConvergedError:  # the arm does not settle at the check poses
        calibration = calibration.checked(None, registry)
    return dict(finite(calibration.record.to_config()))


def read_back(text: str, registry: PluginRegistry) -> Calibration:
    """The calibration that a text is once it is a file.

    Raises:
        ArmcalError: it is none.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        return Calibration.load("calibration.yaml", registry, content=text.encode())


def _noise(result: RunResult) -> dict[str, Any]:
    estimate = result.estimate
    fit = {"scale": estimate.noise_scale, "degrees_of_freedom": estimate.degrees_of_freedom}
    return {**fit, **result.noise.as_dict()}


def residuals_text(result: RunResult) -> str:
    """A row a record, worst found easily by sorting."""
    errors, dataset = result.errors, result.dataset
    held = np.zeros(len(dataset), dtype=bool)
    held[result.split.holdout] = True
    numbered = [f"residual{i}_{errors.unit}" for i in range(1, len(errors.calibrated_residual_mm) + 1)]
    axes = list(errors.residual_columns) or numbered
    columns = ["pose_id", "source_row", "set", "weight"]
    models, turns = ("nominal", "calibrated", "cross_validated"), errors.turns
    columns += [*(f"{model}_{errors.unit}" for model in models), *axes]
    columns += [f"{model}_deg" for model in models if turns]
    rows: list[list[object]] = [[*columns]]
    for i, record in enumerate(dataset.ids):
        row = dataset.rows[i] if dataset.rows else ""
        weight = "" if held[i] or result.noise.weights is None else f"{result.noise.weights[i]:.6g}"
        numbers = [errors.nominal_mm[i], errors.calibrated_mm[i], errors.cross_validated_mm[i]]
        turned = [turns.nominal_deg[i], turns.calibrated_deg[i], turns.cross_validated_deg[i]] if turns else []
        residual = errors.calibrated_residual_mm[:, i]
        rows.append([record, row, "holdout" if held[i] else "train", weight, *numbers, *residual, *turned])
    return csv_text(rows)


def _bootstrap_metrics(result: RunResult) -> dict[str, Any] | None:
    bootstrap = result.bootstrap
    if bootstrap is None:
        return None
    rows = zip(bootstrap.names, bootstrap.deviations, bootstrap.intervals, strict=True)
    return {
        "refits": len(bootstrap.values),
        "failed": bootstrap.failed,
        "block_records": bootstrap.block,
        "parameters": {
            name: finite({"sd": float(sd), "lower": float(low), "upper": float(high)}) for name, sd, (low, high) in rows
        },
    }
