"""An assessment as plain numbers, for JSON and CSV, and as tables and sentences, for people."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
from armcal.report.numbers import decimals_for
from armcal.report.tables import TextTable as Table

from armcal_capability.acceptance.assessment import MM, SERIES, Assessment, Row
from armcal_capability.acceptance.characteristics import Figure
from armcal_capability.acceptance.comparison import Comparison
from armcal_capability.acceptance.records import COMMANDED, Visits

ISO_CYCLES = 30
"""Visits to a pose that the standard asks for. [ISO9283]"""
_NAMES: Mapping[str, tuple[str, ...]] = {
    "poses": ("pose", "direction"),
    "distances": ("from", "to"),
    "directions": ("pose", "directions"),
    "drifts": ("pose", "direction"),
}
_LARGEST, _MUCH = 1e4, 0.3
_MOST_ROWS = 40
"""Of a table on the screen and the page; the CSV has all."""


def content_of(
    assessment: Assessment,
    visits: Visits,
    comparisons: Mapping[str, Comparison],
    noise: float,
    warnings: Sequence[str],
) -> dict[str, Any]:
    """Everything, for JSON: lengths in mm, angles in degrees, intervals of 95 %.

    ``noise`` is the repeatability that the declared noise of the instrument makes alone (m).
    """
    sections = _sections(assessment)
    stated = visits.dataset.has(COMMANDED[0])
    how = "columns of the records" if stated else "the nominal arm at the commanded joint positions"
    return {
        "records": len(visits.dataset),
        "poses": len(visits.poses),
        "cycles": {"least": min(map(len, visits.groups)), "most": max(map(len, visits.groups))},
        "poses_named_by": "the column pose" if visits.labelled else "joint positions",
        "cycles_named_by": "the column cycle" if visits.numbered else "the order of the records",
        "commanded": {m: how if m == "nominal" else "the calibrated arm at the same positions" for m in comparisons},
        "frames": {
            m: {"aligned": c.frame.aligned, "words": c.frame.words, "numbers_found": c.frame.fitted}
            for m, c in comparisons.items()
        },
        "summary": {model: _summary(assessment, model) for model in comparisons},
        "repeatability_mm": _ends([row.measured["RP_mm"].value for row in assessment.poses]),
        "of_instrument_mm": noise * MM,
        **{name: [_row(row, _NAMES[name]) for row in rows] for name, rows in sections.items()},
        "warnings": list(warnings),
    }


def csv_rows(assessment: Assessment) -> tuple[list[str], list[list[Any]]]:
    """Headings and rows of acceptance.csv: a row a figure."""
    headings = ["section", "of", "with", "cycles", "model", "figure", "value", "low_95", "high_95"]
    rows: list[list[Any]] = []
    for section, members in _sections(assessment).items():
        for row in members:
            start = [section, *row.names, row.count]
            for model, figures in (("measured", row.measured), *row.models.items()):
                rows += [[*start, model, name, f.value, f.low, f.high] for name, f in figures.items()]
            for model, numbers in row.numbers.items():
                rows += [[*start, model, name, number, "", ""] for name, number in numbers.items()]
    return headings, rows


def tables(assessment: Assessment) -> Iterator[Table]:
    """The sections as tables; those without a row are left out."""
    captions = {
        "poses": "Poses: accuracy AP and repeatability RP, position (mm) and orientation (deg), 95 % intervals",
        "distances": "Pairs of poses: distance accuracy AD and repeatability RD (mm), 95 % intervals",
        "directions": "Several directions of approach: variation of accuracy vAP (mm, deg), 95 % interval",
        "drifts": f"Drift from the first {SERIES} cycles to the last {SERIES} (mm), 95 % intervals",
    }
    for section, members in _sections(assessment).items():
        if not members:
            continue
        more = f"; the first {_MOST_ROWS} of {len(members)}" if len(members) > _MOST_ROWS else ""
        first, rows = members[0], members[:_MOST_ROWS]
        shown = [i for i in range(2) if any(row.names[i] for row in rows)]
        headings = [(_NAMES[section][i].capitalize(), False) for i in shown]
        headings.append(("Series" if section == "drifts" else "Cycles", True))
        headings += [(_heading(name, model), True) for model, figures in first.models.items() for name in figures]
        headings += [(_heading(name, ""), True) for name in (*first.measured, *first.numbers.get("measured", ()))]
        cells = []
        for row in rows:
            figures = [figure for model in (*row.models.values(), row.measured) for figure in model.values()]
            numbers = [f"{x:.3g}" for x in row.numbers.get("measured", {}).values()]
            cells.append((*(row.names[i] for i in shown), str(row.count), *map(_text, figures), *numbers))
        yield Table(captions[section] + more, tuple(headings), tuple(cells))


def sentences(content: Mapping[str, Any], name: str) -> list[str]:
    """The result in sentences, what it rests on, and what is to be known of it."""
    rp, ends = content["repeatability_mm"], "{mean:.3g} mm ({most:.3g} mm at the worst pose)"
    accuracy = "; ".join(f"{model} {ends.format(**own['AP_mm'])}" for model, own in content["summary"].items())
    texts = [f"{name}: mean pose accuracy AP {accuracy}; mean repeatability RP {ends.format(**rp)}."]
    for model, frame in content["frames"].items():
        texts.append(f"AP, {model}: commanded is {content['commanded'][model]}; the frame is {frame['words']}.")
    if content["of_instrument_mm"] > _MUCH * rp["mean"]:
        texts.append(
            f"RP holds the instrument's noise, which as declared makes {content['of_instrument_mm']:.2g} mm alone."
        )
    cycles = content["cycles"]
    if cycles["least"] < ISO_CYCLES:
        times = " to ".join(map(str, sorted({*cycles.values()})))
        texts.append(
            f"Poses were visited {times} times; ISO 9283 asks for {ISO_CYCLES} cycles. These are its formulas, "
            "not its test: read the intervals."
        )
    return texts


def _sections(assessment: Assessment) -> dict[str, tuple[Row, ...]]:
    return {name: getattr(assessment, name) for name in _NAMES}


def _summary(assessment: Assessment, model: str) -> dict[str, Any]:
    content: dict[str, Any] = {"AP_mm": _ends([row.models[model]["AP_mm"].value for row in assessment.poses])}
    axes = [f"AP_{axis}_deg" for axis in "abc"]
    if axes[0] in assessment.poses[0].models[model]:
        turned = [np.linalg.norm([row.models[model][axis].value for axis in axes]) for row in assessment.poses]
        content["AP_deg"] = _ends([float(turn) for turn in turned])
    if assessment.distances:
        content["AD_mm"] = _ends([abs(row.models[model]["AD_mm"].value) for row in assessment.distances])
    return content


def _ends(values: Sequence[float]) -> dict[str, float]:
    return {"mean": float(np.mean(values)), "most": float(np.max(values))}


def _row(row: Row, names: Sequence[str]) -> dict[str, Any]:
    content: dict[str, Any] = {**dict(zip(names, row.names, strict=True)), "cycles": row.count}
    content |= {name: figure.as_dict() for name, figure in row.measured.items()}
    for model in dict.fromkeys(chain(row.models, row.numbers)):
        figures = {name: figure.as_dict() for name, figure in row.models.get(model, {}).items()}
        content[model] = {**figures, **row.numbers.get(model, {})}
    return content


def _heading(name: str, model: str) -> str:
    words, _, unit = name.rpartition("_")
    if unit not in ("mm", "deg"):
        return name.capitalize()
    return " ".join(filter(None, (words.replace("_", " "), model))) + f", {unit}"


def _text(figure: Figure) -> str:
    decimals = min(decimals_for(max(figure.value - figure.low, abs(figure.value) / 100)), 4)
    high = f"{figure.high:.{decimals}f}" if figure.high < _LARGEST else "?"
    return f"{figure.value:.{decimals}f} ({figure.low:.{decimals}f} to {high})"
