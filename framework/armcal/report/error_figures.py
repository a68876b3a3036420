"""Figures of errors: their distribution before and after, and in the order of recording."""

import numpy as np

from armcal.base.arrays import Array, Indices, Mask
from armcal.estimate.validation import FEWEST_FOR_P95
from armcal.report import svg
from armcal.report.numbers import count, plural, significant
from armcal.report.svg import DIAMOND, Axis, Box, Figure
from armcal.run.result import RunResult

PLAIN_POINTS = 3000
"""More records than this are drawn as bands, not one by one."""
_CURVE_POINTS = 240
_LOG_FROM = 6.0
_OUTLIER = 4.0
_TRIANGLE = "m-4 5l4-7l4 7z"


def roles(result: RunResult) -> tuple[Mask, Mask]:
    train, holdout = (np.zeros(len(result.dataset), dtype=bool) for _ in range(2))
    train[result.split.train] = True
    holdout[result.split.holdout] = True
    return train, holdout


def distribution(result: RunResult) -> Figure | None:
    """Share of records below each error, nominal and calibrated, on one axis; None without records."""
    train, holdout = roles(result)
    errors = result.errors
    curves = [
        ("before", "nominal", errors.nominal_mm),
        ("train", "calibrated, train", errors.calibrated_mm[train]),
        ("holdout", "calibrated, holdout", errors.calibrated_mm[holdout]),
        ("crossed", "calibrated, cross-validated", errors.cross_validated_mm),
    ]
    finite = [(css, name, values[np.isfinite(values)]) for css, name, values in curves]
    curves = [(css, f"{name} ({count(len(values))})", values) for css, name, values in finite if len(values)]
    if not curves:
        return None
    values = np.concatenate([errors for _, _, errors in curves])
    medians = [float(np.median(errors)) for _, _, errors in curves]
    high = max(float(values.max()), 1e-9)
    log = min(medians) > 0 and max(medians) / min(medians) > _LOG_FROM and float(values.min()) > 0
    named = zip(curves, medians, strict=True)
    said = "; ".join(f"{name}: median {significant(middle)} {result.errors.unit}" for (_, name, _), middle in named)
    caption = "The further left a curve, the better. The dashed lines mark half and 95 % of the records."
    caption += " The error axis is logarithmic." if log else ""
    entries = [(f'<path class="curve {css}" d="M0 0h22"/>', name) for css, name, _ in curves]

    def draw(width: float) -> tuple[float, list[str]]:
        top, parts = svg.legend(52, width - 60, entries)
        box = Box(52, top + 2, width - 16, top + (270 if width > svg.NARROW else 220))
        low = max(float(np.percentile(values, 0.5)), high * 1e-6) * 0.8 if log else 0.0
        x = Axis(low, high * (1.15 if log else 1.03), box.left, box.right, log=log)
        y = Axis(0, 100, box.bottom, box.top)
        parts += svg.frame(
            box, x, y, (f"error, {result.errors.unit}", "records below, %"), (8 if width > svg.NARROW else 5, 5)
        )
        parts += [svg.line(box.left, y.of(p), box.right, y.of(p), "guide") for p in (50, 95)]
        parts += [_ecdf(errors, x, y, f"curve {css}") for css, _, errors in curves]
        return box.bottom + 44, parts

    return svg.both("distribution", ("Errors before and after", said, caption), draw)


def _ecdf(errors: Array, x: Axis, y: Axis, css: str) -> str:
    ordered = np.sort(errors)
    if len(ordered) > _CURVE_POINTS:
        shares = np.linspace(0, 100, _CURVE_POINTS)
        return svg.polyline(x.at(np.percentile(ordered, shares)), y.at(shares), css)
    steps = np.repeat(np.arange(len(ordered) + 1) / len(ordered) * 100, 2)[1:-1]
    return svg.polyline(x.at(np.repeat(ordered, 2)), y.at(steps), css)


def in_order(result: RunResult, worst: Indices) -> Figure | None:
    """Calibrated error of each record in recorded order; None without records."""
    errors = result.errors.calibrated_mm
    finite = errors[np.isfinite(errors)]
    if not len(finite):
        return None
    ninety_five, largest = float(np.percentile(finite, 95)), float(finite.max())
    clipped = len(finite) > 20 and largest > _OUTLIER * ninety_five > 0
    top = 2 * ninety_five if clipped else max(largest * 1.06, 1e-9)
    thinned = len(errors) > PLAIN_POINTS
    beyond = int(np.sum(finite > top)) if clipped else 0
    words = "The dashed line marks 95 % of all records; rings mark the ten worst. "
    if thinned:
        words += f"{plural(len(errors), 'record')} are too many to draw one by one: drawn as bands. "
    else:
        words += "The dark line is the running median: where it wanders, the setup changed on the way. "
    words += f"Triangles: {plural(beyond, 'record')} beyond the axis." if beyond else ""
    few = len(finite) < FEWEST_FOR_P95
    most = f"all lie below {significant(largest)}" if few else f"95 % lie below {significant(ninety_five)}"
    said = f"{plural(len(errors), 'record')}; {most} {result.errors.unit}."

    def draw(width: float) -> tuple[float, list[str]]:
        start, parts = svg.legend(52, width - 60, _order_legend(result, thinned))
        box = Box(52, start + 2, width - 16, start + (270 if width > svg.NARROW else 220))
        x = Axis(0.5, len(errors) + 0.5, box.left, box.right)
        y = Axis(0, top, box.bottom, box.top)
        labels = ("record, in recorded order", f"calibrated error, {result.errors.unit}")
        parts += svg.frame(box, x, y, labels, (10 if width > svg.NARROW else 5, 5))
        parts.append(svg.line(box.left, y.of(ninety_five), box.right, y.of(ninety_five), "guide"))
        parts += _banded(result, x, y) if thinned else _one_by_one(result, x, y)
        ringed = worst[np.isfinite(errors[worst])]
        parts += [svg.circle(x.of(i + 1), y.of(float(errors[i])), 6, "ring") for i in ringed]
        return box.bottom + 44, parts

    return svg.both("order", ("Error of each record in recorded order", said, words), draw)


def _order_legend(result: RunResult, thinned: bool) -> list[tuple[str, str]]:
    _, holdout = roles(result)
    if thinned:
        entries = [('<path class="spread" d="M0-6h22v12h-22z"/>', "5 to 95 % of the records")]
        entries.append(('<path class="running" d="M0 0h22"/>', "train, median"))
        held = ('<path class="curve holdout" d="M0 0h22"/>', "holdout, median")
    else:
        entries = [('<path class="dot train" d="M11 0h0"/>', "train")]
        held = (f'<path class="diamond" d="M11 0{DIAMOND}"/>', "holdout")
    if holdout.any():
        entries.append(held)
    ring = '<circle cx="11" cy="0" r="6" class="ring"/>'
    return [*entries, (ring, "ten worst" if len(holdout) > 10 else "worst first")]


def _one_by_one(result: RunResult, x: Axis, y: Axis) -> list[str]:
    errors = result.errors.calibrated_mm
    train, holdout = roles(result)
    place = np.arange(1, len(errors) + 1, dtype=float)
    inside, above = errors <= y.high, np.isfinite(errors) & (errors > y.high)
    dotted = ((train & inside, "dot train"), (~train & ~holdout & inside, "dot before"))
    parts = [svg.dots(x.at(place[chosen]), y.at(errors[chosen]), css) for chosen, css in dotted]
    held = holdout & inside
    parts.append(svg.marks(x.at(place[held]), y.at(errors[held]), DIAMOND, "diamond"))
    for chosen, css in ((above & ~holdout, "fill-train"), (above & holdout, "fill-holdout")):
        parts.append(svg.marks(x.at(place[chosen]), y.at(errors[chosen]), _TRIANGLE, css))
    if np.isfinite(errors).all() and len(errors) >= 30:
        window = max(15, len(errors) // 12)
        middle = np.median(np.lib.stride_tricks.sliding_window_view(errors, window), axis=1)
        centre = place[: len(middle)] + (window - 1) / 2
        parts.append(svg.polyline(x.at(centre), y.at(middle), "running"))
    return parts


def _banded(result: RunResult, x: Axis, y: Axis) -> list[str]:
    errors = np.where(np.isfinite(result.errors.calibrated_mm), result.errors.calibrated_mm, np.nan)
    train, holdout = roles(result)
    number = max(20, int(abs(x.end - x.start) / 5))
    bins = np.array_split(np.arange(len(errors)), number)
    centre = x.at([float(b.mean()) + 1 for b in bins])
    spread = np.array([_percentiles(errors[b], (5, 95)) for b in bins])
    known = np.isfinite(spread).all(axis=1)
    parts = [svg.band(centre[known], y.at(spread[known, 0]), y.at(spread[known, 1]), "spread")]
    for mask, css in ((train, "running"), (holdout, "curve holdout")):
        middle = np.array([_percentiles(errors[b][mask[b]], (50,))[0] for b in bins])
        seen = np.isfinite(middle)
        parts.append(svg.polyline(centre[seen], y.at(middle[seen]), css))
    return parts


def _percentiles(values: Array, shares: tuple[int, ...]) -> Array:
    values = values[np.isfinite(values)]
    return np.percentile(values, shares) if len(values) else np.full(len(shares), np.nan)
