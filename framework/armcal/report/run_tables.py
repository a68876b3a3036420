"""Tables of a run: errors, parameters, records, intervals."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from armcal.base.arrays import Indices
from armcal.base.domains import Semidefinite, symmetric
from armcal.base.units import shown_unit
from armcal.diagnose.outliers import large_errors
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import DETERMINED_BY
from armcal.estimate.uncertainty import Bootstrap
from armcal.estimate.validation import ErrorSummary
from armcal.report.document import Table
from armcal.report.numbers import NONE, common_decimals, count, decimals_for, fixed, significant
from armcal.run.result import ErrorTable, GroupError, RunResult

SETS = {"train": "training", "holdout": "held out", "cross_validated": "cross-validated"}
MOST_LISTED = 50  # of records set aside and of correlated pairs; the rest is counted
_WORST = 10


def errors_table(caption: str, errors: ErrorTable) -> Table:
    """Of each set that has records, errors of the nominal and the calibrated arm, and without knowledge of a drift."""
    models = (("nominal", errors.nominal), ("calibrated", errors.calibrated), ("drift unknown", errors.at_rest))
    shown: list[tuple[str, str, ErrorSummary]] = []
    for key, words in SETS.items():
        if key in errors.calibrated and errors.calibrated[key].count:
            shown += [(words, model, own[key]) for model, own in models if key in own]
    decimals = common_decimals((x for _, _, s in shown for x in (s.mean, s.max)), most=3)
    rows = [
        (
            words if model == "nominal" else "",
            count(own.count) if model == "nominal" else "",
            model,
            *(fixed(x, decimals) for x in (own.mean, own.rms, own.p95, own.max)),
        )
        for words, model, own in shown
    ]
    strong = [i for i, (_, model, _) in enumerate(shown) if model == "calibrated"]
    headings = ("Records", "Count", "Arm", "Mean", "RMS", "95 %", "Max")
    return Table(caption, headings, rows, left=("Arm",), strong=strong)


def groups_table(groups: Sequence[GroupError], unit: str) -> Table:
    """What the records of each group miss each other by, before and after; and known distances, where any is known."""
    distances = any(group.distance_error_mm is not None for group in groups)
    numbers = [
        [g.nominal_error_mm, g.error_mm, *([g.nominal_distance_error_mm, g.distance_error_mm] if distances else [])]
        for g in groups
    ]
    decimals = common_decimals(x for row in numbers for x in row)
    rows = []
    for group, row in zip(groups, numbers, strict=True):
        part = "judged" if not group.trained else "trained" if group.trained == group.records else "both"
        rows.append((group.name, part, str(group.records), *(fixed(x, decimals) for x in row)))
    headings = ["Group", "Part", "Records", "Nominal", "Calibrated"]
    headings += ["Distance, nominal", "Distance, calibrated"] if distances else []
    caption = f"By group, mean, {unit}: how far its records lie apart"
    caption += "; and how far known distances within it are missed" if distances else ""
    return Table(caption, headings, rows, left=("Part",))


def parameters_table(estimate: Estimate, bootstrap: Bootstrap | None = None) -> Table:
    """A row a free canonical entry in customary units, with its intervals by curvature and by refits."""
    nominal, rows = estimate.parameters.nominal(), list[tuple[str, ...]]()
    units = [unit for block in estimate.parameters.free for unit in block.entry_units]
    for i, (name, own) in enumerate(estimate.items()):
        factor, unit = shown_unit(units[i])
        numbers = (own.value, nominal[estimate.free_entries[i]], own.deviation)
        value, before, sd = (factor * float(number) for number in numbers)
        # Two digits of the standard deviation; five of the value where there is none, three decimals of a zero.
        size = sd if math.isfinite(sd) and sd > 0 else max(abs(value), abs(before)) / 1000
        digits = decimals_for(size) if size else 3
        span = partial(_span, factor, digits)
        words = span(own.interval.lower, own.interval.upper) if math.isfinite(sd) else NONE
        remarks = ["at its bound"] if name in estimate.at_bound else []
        remarks += [] if remarks else [f"{end} end at its bound" for end in own.interval.bounds]
        by = estimate.determined_by[i]
        remarks += [] if by == "data" else [DETERMINED_BY[by]]
        row = [name, *(fixed(x, digits) for x in (before, value)), fixed(value - before, digits, True)]
        row += [fixed(sd, digits), words]
        if bootstrap is not None:
            row += [fixed(factor * float(bootstrap.deviations[i]), digits), span(*bootstrap.intervals[i])]
        rows.append((*row, unit, ", ".join(remarks)))
    headings = ["Parameter", "Nominal", "Calibrated", "Correction", "sd", "95 % interval"]
    headings += ["Bootstrap sd", "By bootstrap"] if bootstrap else []
    caption = "Free parameters, with standard deviation (sd) and 95 % intervals"
    if bootstrap is not None:
        failed = f", {bootstrap.failed} more did not converge" if bootstrap.failed else ""
        caption += f". Bootstrap: {len(bootstrap.values)} refits{failed}; blocks of {bootstrap.block}"
    return Table(caption, (*headings, "Unit", "Remark"), rows, ("Unit", "Remark"), ("Nominal", "Correction", "sd"))


def _span(factor: float, digits: int, lower: float, upper: float) -> str:
    return " to ".join(fixed(factor * float(end), digits) for end in (lower, upper))


def principal_table(estimate: Estimate) -> Table | None:
    """Eigenvalues of compliances that are matrices."""
    factor, unit = shown_unit("rad_per_Nm")
    rows = []
    for block in estimate.parameters.free:
        if isinstance(block.domain, Semidefinite):
            sizes = np.linalg.eigvalsh(symmetric(estimate.values[estimate.parameters.entries_of(block.name)]))
            rows.append((block.name, *(significant(factor * max(size, 0.0)) for size in sizes)))
    return Table(f"Principal compliances, {unit}", ("Parameter", "Stiffest", "", "Softest"), rows) if rows else None


def worst_records(result: RunResult) -> Indices:
    errors = result.errors.calibrated_mm
    ranked = np.where(np.isnan(errors), np.inf, errors)
    return np.argsort(-ranked, kind="stable")[:_WORST].astype(np.intp)


def worst_table(result: RunResult, worst: Indices) -> Table:
    errors, data, turns = result.errors, result.dataset, result.errors.turns
    train, holdout = set(result.split.train.tolist()), set(result.split.holdout.tolist())
    crossed = bool(np.isfinite(errors.cross_validated_mm).any())
    columns = {"Nominal": errors.nominal_mm, "Calibrated": errors.calibrated_mm}
    columns |= {"Cross-validated": errors.cross_validated_mm} if crossed else {}
    if turns is not None:
        columns |= {"Nominal, deg": turns.nominal_deg, "Calibrated, deg": turns.calibrated_deg}
        columns |= {"Cross-validated, deg": turns.cross_validated_deg} if crossed else {}
    decimals = {name: common_decimals(numbers[worst].tolist()) for name, numbers in columns.items()}
    missed = result.fit.of(large_errors)
    unusual = {miss.record_id: "; ".join(miss.reasons) for miss in missed.explained} if missed else {}
    rows = []
    for i in worst.tolist():
        role = "train" if i in train else "holdout" if i in holdout else "not used"
        numbers = (fixed(float(own[i]), decimals[name]) for name, own in columns.items())
        row = str(data.rows[i]) if data.rows else NONE
        rows.append((data.ids[i], row, role, *numbers, unusual.get(data.ids[i], "")))
    caption = f"The records with the largest calibrated error, {errors.unit}, and what is unusual where noise does not "
    caption += "explain it"
    headings = ("Record", "Source row", "Role", *columns, "What is unusual")
    return Table(caption, headings, rows, left=("Role", "What is unusual"))


def moved_table(result: RunResult) -> Table | None:
    """How far the pose residual moves the tool, by part."""
    outcome = result.pose_residual
    if outcome is None or outcome.moved is None:
        return None
    parts = {"altogether": outcome.moved.altogether, **outcome.moved.parts}
    numbers = {name: (1000 * float(own.mean()), 1000 * float(own.max())) for name, own in parts.items()}
    decimals = common_decimals((x for pair in numbers.values() for x in pair), most=3)
    rows = [(name, *(fixed(x, decimals) for x in pair)) for name, pair in numbers.items()]
    caption = "How far the pose residual moves the tool, mm: altogether, and by what it adds to the tool and each joint"
    return Table(caption, ("Part", "Mean", "Max"), rows, strong=(0,))


def suspicious_table(result: RunResult) -> Table | None:
    noise, unit = result.noise, result.errors.unit
    rows = [
        (
            s.record_id,
            str(s.row or NONE),
            s.measurement,
            fixed(s.deviations, 1),
            fixed(s.limit, 1),
            fixed(s.error_mm, 2),
            s.fate,
        )
        for s in noise.suspicious[:MOST_LISTED]
    ]
    caption = f"{count(len(noise.suspicious))} suspicious records, farther from the fit than noise allows (1 % over all"
    caption += f"); loss {noise.loss}" + _more(len(noise.suspicious), "in residuals.csv")
    headings = ("Record", "Source row", "Measurement", "Distance, sd", "Limit, sd", f"Error, {unit}", "In the fit")
    return Table(caption, headings, rows, left=("Measurement", "In the fit")) if rows else None


def aside_table(result: RunResult) -> Table | None:
    aside = result.dataset.set_aside
    rows = [(str(record.row), record.record_id, record.reason) for record in aside[:MOST_LISTED]]
    caption = f"{count(len(aside))} records set aside" + _more(len(aside))
    return Table(caption, ("Source row", "Record", "Why"), rows, left=("Record", "Why")) if rows else None


def _more(total: int, where: str = "") -> str:
    return f"; {count(total - MOST_LISTED)} more {where}".rstrip() if total > MOST_LISTED else ""


def scatter_table(result: RunResult) -> Table | None:
    """Variance components in a customary unit, the largest share first."""
    rows: list[tuple[str, ...]] = []
    components = result.noise.components
    for c in sorted(components.components if components else (), key=lambda c: -c.share):
        factor, unit = {"rad": (180 / np.pi, "deg"), "m": (1000.0, "mm")}.get(c.unit, (1.0, "\u00d7 declared noise"))
        sd, lower, upper = (fixed(factor * x, 3) for x in (c.sd, c.lower, c.upper))
        rows.append((c.name, f"{100 * c.share:.1f} %", sd, unit, f"{lower} to {upper}", fixed(1000 * c.rms, 3)))
    caption = (
        "Estimated standard deviations (restricted maximum likelihood); a joint's is what acts like an angle error"
    )
    headings = ("Component", "Share", "sd", "Unit", "95 % interval", f"In a residual, {result.errors.unit}")
    return Table(caption, headings, rows, left=("Unit",)) if rows else None


def provenance_facts(provenance: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Names and values, those of mappings one by one."""
    facts: list[tuple[str, str]] = []
    for key, value in provenance.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            facts += provenance_facts(value, f"{name}: ")
        elif isinstance(value, (list, tuple)):
            facts.append((name, ", ".join(str(item) for item in value) or NONE))
        else:
            facts.append((name, NONE if value is None or value == "" else str(value)))
    return facts
