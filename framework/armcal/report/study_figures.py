"""Figures of a study: the variants as a ladder, and what a payload that was not trained at costs."""

import math
from collections.abc import Sequence

import numpy as np

from armcal.base.arrays import Array
from armcal.report import svg
from armcal.report.numbers import significant
from armcal.report.svg import MONO, Axis, Box, Figure
from armcal.run.study_result import StudyResult, TransferCell, TransferResult, VariantResult

_ROW = 34.0
_LOG_FROM = 6.0
_GAP = 46.0
_DIAMOND = "m-4.2 0l4.2-4.2l4.2 4.2l-4.2 4.2z"


def ladder(result: StudyResult) -> Figure:
    """Errors of each variant, and beside them how each record's error changes."""
    changed = [v for v in result.variants if v.change]
    numbers = [x for v in result.variants for x in (v.train.mean, v.crossed.mean, v.crossed.p95) if x is not None]
    spreads = {v.name: _spread(result, v) for v in changed}
    said = "; ".join(
        f"{v.name}: mean {_said(v.crossed.mean)}, 95 % {_said(v.crossed.p95)} {result.unit}" for v in result.variants
    )
    caption = "The further left, the better. Beside it, on a wide page, the change of each record's error: "
    caption += "median, half and 90 % of the records; left of the line they gain."
    entries = [
        ('<circle cx="11" cy="0" r="5" class="solid"/>', "mean, cross-validated"),
        ('<circle cx="11" cy="0" r="5" class="hollow"/>', "mean, training records"),
        (f'<path class="diamond" d="M11 0{_DIAMOND}"/>', "95 %, cross-validated"),
    ]

    def draw(width: float) -> tuple[float, list[str]]:
        narrow = width <= svg.NARROW
        most = 14 if narrow else 26
        left = MONO * max(len(svg.shorten(v.name, most)) for v in result.variants) + 18
        start, parts = svg.legend(left, width - left - 8, entries)
        bottom = start + 4 + _ROW * len(result.variants)
        beside = 0.0 if narrow or not changed else 0.4 * (width - left)
        box = Box(left, start + 4, width - beside - 14, bottom)
        x = _axis(numbers, box)
        parts += svg.frame(box, x, None, (f"error, {result.unit}", ""), (4 if narrow else 7, 0))
        for place, v in enumerate(result.variants):
            y = start + 4 + _ROW * (place + 0.5)
            parts.append(svg.text(left - 9, y + 4, svg.shorten(v.name, most), "mono", "end"))
            ends = [n for n in (v.train.mean, v.crossed.p95) if n is not None]
            parts += [svg.line(x.of(min(ends)), y, x.of(max(ends)), y, "stem")] if ends else []
            if v.crossed.p95 is not None:
                parts.append(svg.marks(np.array([x.of(v.crossed.p95)]), np.array([y]), _DIAMOND, "diamond"))
            if v.train.mean is not None:
                parts.append(svg.circle(x.of(v.train.mean), y, 5, "hollow"))
            if v.crossed.mean is not None:
                parts.append(svg.circle(x.of(v.crossed.mean), y, 4, "solid"))
        if beside:
            right = Box(width - beside + _GAP - 14, start + 4, width - 14, bottom)
            parts += _changes(result, spreads, right)
        return bottom + 44, parts

    return svg.both("ladder", ("Errors by variant", said, caption), draw)


def _said(value: float | None) -> str:
    return significant(value) if value is not None else "not known"


def _axis(numbers: Sequence[float], box: Box) -> Axis:
    high = max(numbers, default=1.0) or 1.0
    low = min((n for n in numbers if n > 0), default=high)
    if high / low > _LOG_FROM:
        return Axis(low * 0.85, high * 1.15, box.left, box.right, log=True)
    return Axis(0, high * 1.05, box.left, box.right)


def _spread(result: StudyResult, v: VariantResult) -> Array:
    """5, 25, 50, 75 and 95 % of the change of each record's error."""
    other = result.variant(v.change.against if v.change else v.name)
    difference = v.errors_mm - other.errors_mm
    difference = difference[np.isfinite(difference)]
    return np.percentile(difference, [5, 25, 50, 75, 95]) if len(difference) else np.full(5, math.nan)


def _changes(result: StudyResult, spreads: dict[str, Array], box: Box) -> list[str]:
    known = np.array([s for s in spreads.values() if np.isfinite(s).all()]).reshape(-1, 5)
    low, high = min(known.min(initial=0.0), 0.0), max(known.max(initial=0.0), 0.0)
    room = (high - low) * 0.06 or 1.0
    x = Axis(low - room, high + room, box.left, box.right)
    parts = svg.frame(box, x, None, (f"change of a record's error, {result.unit}", ""), (5, 0))
    parts.append(svg.line(x.of(0), box.top, x.of(0), box.bottom, "bound"))
    for place, v in enumerate(result.variants):
        spread = spreads.get(v.name)
        if spread is None or not np.isfinite(spread).all():
            continue
        y = box.top + _ROW * (place + 0.5)
        at = x.at(spread)
        parts.append(svg.line(at[0], y, at[4], y, "whisker"))
        parts.append(svg.rect(at[1], y - 6, max(at[3] - at[1], 1), 12, "#cfe3f1"))
        parts.append(svg.line(at[2], y - 8, at[2], y + 8, "running"))
    return parts


def transfers(result: TransferResult) -> Figure:
    """Mean error at each payload, by variant and by what it was trained at."""
    rows: dict[tuple[str, tuple[float, ...]], list[TransferCell]] = {}
    for cell in result.cells:
        rows.setdefault((cell.variant, cell.trained_g), []).append(cell)
    numbers = [c.errors.mean for c in result.cells if c.errors.mean is not None]
    said = "; ".join(
        f"{c.variant} {_trained(c.trained_g)} judged at {c.judged_g:g} g: {_said(c.errors.mean)} {result.unit}"
        for c in result.cells
    )
    caption = "Mean errors. A filled dot: at a payload that also trained (cross-validated); a ring: at another load."
    labels = {key: f"{key[0]} {_trained(key[1])}" for key in rows}

    def draw(width: float) -> tuple[float, list[str]]:
        most = 18 if width <= svg.NARROW else 44
        left = MONO * max(len(svg.shorten(label, most)) for label in labels.values()) + 18
        box = Box(left, 8, width - 14, 8 + _ROW * len(rows))
        x = _axis(numbers, box)
        parts = svg.frame(box, x, None, (f"mean error, {result.unit}", ""), (4 if width <= svg.NARROW else 8, 0))
        for place, (key, cells) in enumerate(rows.items()):
            y = box.top + _ROW * (place + 0.5)
            parts.append(svg.text(left - 9, y + 4, svg.shorten(labels[key], most), "mono", "end"))
            known = [c for c in cells if c.errors.mean is not None]
            ends = [x.of(c.errors.mean or 0.0) for c in known]
            parts.append(svg.line(min(ends, default=left), y, max(ends, default=left), y, "stem"))
            for number, (cell, at) in enumerate(zip(known, ends, strict=True)):
                parts.append(svg.circle(at, y, 5, "solid" if cell.seen else "hollow"))
                parts.append(svg.text(at, y + (16 if number % 2 else -8), f"{cell.judged_g:g} g", "tick", "middle"))
        return box.bottom + 44, parts

    return svg.both("transfer", ("Errors by payload", said, caption), draw)


def _trained(payloads_g: tuple[float, ...]) -> str:
    return f"trained at {' and '.join(f'{g:g} g' for g in payloads_g)}" if payloads_g else "nominal"
