"""The report's tables as rows of finished text."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armcal.base.arrays import Indices
from armcal.base.units import shown_unit
from armcal.estimate.estimator import Estimate
from armcal.estimate.validation import ErrorSummary
from armcal.estimate.variance import VarianceComponents
from armcal.report.numbers import MINUS, NONE, common_decimals, decimals_for, entry_unit, fixed, ratio
from armcal.run.errors import ErrorTable
from armcal.run.result import GroupError, RunResult

_SETS = (("train", "Train"), ("holdout", "Holdout"), ("cross_validated", "Cross-validated"))
_STATISTICS = ("mean", "rms", "p95", "max")
_WORST = 10
_EMPTY = ErrorSummary(None, None, None, None, 0)
_FIGURE_SPACE, _POINT_SPACE = "\u2007", "\u2008"

_MM = 1000.0


@dataclass(frozen=True)
class TextTable:
    """Headings (words, whether numbers stand below) and rows of cells."""

    caption: str
    headings: tuple[tuple[str, bool], ...]
    rows: tuple[tuple[str, ...], ...]


def error_rows(table: ErrorTable) -> list[dict[str, Any]]:
    """Of each set that has records, errors before and after calibration, and their ratios.

    And after if nothing is known of a drift (``at_rest``), where something drifts.
    """
    nominal, calibrated = table.nominal, table.calibrated
    sets = [(k, w, nominal.get(k, _EMPTY), calibrated.get(k, _EMPTY)) for k, w in _SETS]
    extra = [k for k in {**nominal, **calibrated} if k not in {key for key, _ in _SETS}]
    sets += [(k, k.replace("_", " "), nominal.get(k, _EMPTY), calibrated.get(k, _EMPTY)) for k in extra]
    sets = [row for row in sets if row[2].count or row[3].count]
    decimals = common_decimals(v for _, _, *pair in sets for s in pair for v in _statistics(s))
    rows = []
    for key, words, before, after in sets:
        at_rest = table.at_rest.get(key)
        pairs = list(zip(_statistics(before), _statistics(after), strict=True))
        rows.append(
            {
                "name": words,
                "count": after.count or before.count,
                "nominal": [fixed(b, decimals) for b, _ in pairs],
                "calibrated": [fixed(a, decimals) for _, a in pairs],
                "ratios": [ratio(b, a) for b, a in pairs],
                "at_rest": [fixed(v, decimals) for v in _statistics(at_rest)] if at_rest else [],
            }
        )
    return rows


def _statistics(summary: ErrorSummary) -> tuple[float | None, ...]:
    return tuple(getattr(summary, name) for name in _STATISTICS)


@dataclass(frozen=True)
class Judged:
    """The set of records that the headline numbers come from, before and after."""

    words: str
    nominal: ErrorSummary
    calibrated: ErrorSummary


def judged(table: ErrorTable) -> Judged | None:
    """Held-out records if there are any, else cross-validation, else training records."""
    choices = (("holdout", "held-out records"), ("cross_validated", "cross-validation"), ("train", "training records"))
    for key, words in choices:
        after = table.calibrated.get(key, _EMPTY)
        if after.count and after.mean is not None and math.isfinite(after.mean):
            before = table.nominal.get(key, _EMPTY)
            return Judged(words, before if before.count else _EMPTY, after)
    return None


@dataclass(frozen=True)
class ParameterRow:
    """One free parameter, in words; ``held`` where only a prior holds it, or nothing."""

    name: str
    unit: str
    si_unit: str
    nominal: str
    value: str
    correction: str
    sd: str
    interval: str
    at_bound: bool
    determined: bool
    held: bool


def parameter_rows(estimate: Estimate) -> tuple[ParameterRow, ...]:
    """One row a free canonical entry, numbers aligned at their points."""
    nominal, numbers, decimals = estimate.parameters.nominal(), [], []
    units = [entry_unit(b, suffix) for b in estimate.parameters.free for suffix in b.domain.entries]
    for i, entry in enumerate(estimate.free_entries):
        own = (estimate.values[entry], nominal[entry], estimate.deviations[i])
        value, before, sd = (float(number) * shown_unit(units[i])[0] for number in own)
        # Two digits of the standard deviation; five of the value where there is none, three decimals of a zero.
        size = sd if math.isfinite(sd) and sd > 0 else max(abs(value), abs(before)) / 1000
        numbers.append((value, before, sd))
        decimals.append(decimals_for(size) if size else 3)
    rows, widest = [], max(decimals, default=0)
    for i, (name, (value, before, sd), digits) in enumerate(zip(estimate.names, numbers, decimals, strict=True)):
        factor, unit = shown_unit(units[i])
        padding = _FIGURE_SPACE * (widest - digits) + (_POINT_SPACE if digits == 0 < widest else "")
        written = [fixed(value, digits), fixed(before, digits), fixed(value - before, digits, True), fixed(sd, digits)]
        interval = estimate.intervals[i]
        lower, upper = (fixed(float(end) * factor, digits) for end in (interval.lower, interval.upper))
        words = f"{lower} to {upper}" if math.isfinite(sd) else NONE
        if math.isfinite(sd) and interval.bound:
            words = f"≤ {upper}" if interval.bound == "lower" else f"≥ {lower}"
        shown, was, moved, deviation = (text if text == NONE else text + padding for text in written)
        flags = (name in estimate.at_bound, math.isfinite(sd), not estimate.identified_by_data[i])
        rows.append(ParameterRow(name, unit, units[i], was, shown, moved, deviation, words, *flags))
    return tuple(rows)


def fixed_rows(estimate: Estimate) -> list[tuple[str, str, str]]:
    rows = []
    for block in estimate.parameters.blocks:
        if block.free:
            continue
        values = estimate.values[estimate.parameters.entries_of(block.name)]
        for name, suffix, value in zip(block.entry_names, block.domain.entries, values, strict=True):
            factor, unit = shown_unit(entry_unit(block, suffix))
            rows.append((name, f"{float(value) * factor:.7g}".replace("-", MINUS), unit))
    return rows


def worst_records(result: RunResult) -> Indices:
    errors = result.errors.calibrated_mm
    ranked = np.where(np.isnan(errors), np.inf, errors)
    return np.argsort(-ranked, kind="stable")[:_WORST].astype(np.intp)


def moved_rows(result: RunResult) -> list[tuple[str, str, str]]:
    """How far the pose residual moves the tool, by part: its name, the mean and the largest (mm)."""
    outcome = result.pose_residual
    if outcome is None or outcome.moved is None:
        return []
    parts = {"altogether": outcome.moved.altogether, **outcome.moved.parts}
    numbers = [1000 * float(number) for own in parts.values() for number in (own.mean(), own.max())]
    decimals = common_decimals(numbers, most=3)
    shown = [fixed(number, decimals) for number in numbers]
    return list(zip(parts, shown[::2], shown[1::2], strict=True))


def worst_rows(result: RunResult, worst: Indices) -> list[tuple[Any, ...]]:
    """Id, source row, role, and errors of these records: nominal, calibrated, cross-validated.

    Then a list of the same of orientations (deg), empty where none are measured.
    """
    errors, data = result.errors, result.dataset
    train, holdout = set(result.split.train.tolist()), set(result.split.holdout.tolist())
    columns = np.array([errors.nominal_mm[worst], errors.calibrated_mm[worst], errors.cross_validated_mm[worst]])
    decimals = common_decimals(columns.ravel().tolist())
    turned, own = np.zeros((0, len(worst))), errors.turns
    if own is not None:
        turned = np.array([own.nominal_deg[worst], own.calibrated_deg[worst], own.cross_validated_deg[worst]])
    digits = common_decimals(turned.ravel().tolist())
    rows = []
    for i, numbers, turns in zip(worst.tolist(), columns.T.tolist(), turned.T.tolist(), strict=True):
        role = "train" if i in train else "holdout" if i in holdout else "not used"
        row = str(data.rows[i]) if data.rows else NONE
        shown = (fixed(number, decimals) for number in numbers)
        rows.append((data.ids[i], row, role, *shown, [fixed(turn, digits) for turn in turns]))
    return rows


@dataclass(frozen=True)
class Fact:
    """A name and a value; a long value spans several lines."""

    name: str
    value: str

    @property
    def long(self) -> bool:
        return "\n" in self.value


def provenance_facts(provenance: Mapping[str, Any], prefix: str = "") -> tuple[Fact, ...]:
    facts: list[Fact] = []
    for key, value in provenance.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            facts += provenance_facts(value, f"{name}: ")
        elif isinstance(value, (list, tuple)):
            facts.append(Fact(name, ", ".join(str(item) for item in value) or NONE))
        else:
            facts.append(Fact(name, NONE if value is None or value == "" else str(value)))
    return tuple(facts)


def group_rows(groups: Sequence[GroupError]) -> list[tuple[str, str, int, list[str]]]:
    """Name, whether it trained or judged, records, errors before and after; then distances, where any is known."""
    with_distances = any(group.distance_error_mm is not None for group in groups)
    columns: list[list[float | None]] = []
    for group in groups:
        distances = [group.nominal_distance_error_mm, group.distance_error_mm] if with_distances else []
        columns.append([group.nominal_error_mm, group.error_mm, *distances])
    decimals = common_decimals(x for row in columns for x in row if x is not None)
    return [
        (group.name, part_of(group), group.records, [fixed(x, decimals) for x in row])
        for group, row in zip(groups, columns, strict=True)
    ]


def part_of(group: GroupError) -> str:
    if not group.trained:
        return "judged"
    return "trained" if group.trained == group.records else "both"


def scatter_rows(components: VarianceComponents | None) -> list[tuple[str, ...]]:
    """Variance components in a customary unit, the largest share first: name, share, sd, unit, interval, effect."""
    rows: list[tuple[str, ...]] = []
    for c in sorted(components.components if components else (), key=lambda c: -c.share):
        factor, unit = {"rad": (180 / np.pi, "deg"), "m": (_MM, "mm")}.get(c.unit, (1.0, "\u00d7 declared noise"))
        sd, lower, upper = (fixed(factor * x, 3) for x in (c.sd, c.lower, c.upper))
        rows.append((c.name, f"{100 * c.share:.1f} %", sd, unit, f"{lower} to {upper}", fixed(_MM * c.rms, 3)))
    return rows
