"""Figures of the page: errors before and after, in recorded order, over the workspace, inside intervals; profiles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array, Indices, Mask
from armcal.base.units import shown_unit
from armcal.estimate.prediction import LEVELS
from armcal.estimate.profile import Profile
from armcal.estimate.validation import FEWEST_FOR_P95
from armcal.report import svg
from armcal.report.numbers import NONE, count, decimals_for, fixed, plural, significant
from armcal.report.svg import DIAMOND, Axis, Box, Figure
from armcal.run.judging import IntervalResult
from armcal.run.result import RunResult

_CURVE_POINTS = 240
_LOG_FROM = 6.0
_OUTLIER = 4.0
_TRIANGLE = "m-4 5l4-7l4 7z"
MOST_POINTS = 4000  # More positions than this are thinned out
_MOST_VECTORS = 500
_COLOURS = ("#9bd93c", "#4ac16d", "#1fa187", "#277f8e", "#365c8d", "#46327e", "#440154")
"""Light to dark, distinct with any colour vision."""
_STEPS = (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10, 20)
_NAMES = "xyz"
_RECORDINGS = {"same": "calibrated recording", "new": "new recording"}
_ENDS = {"crossed": "", "bound": "at its bound", "open": "does not end as far as was looked"}


def _roles(result: RunResult) -> tuple[Mask, Mask]:
    train, holdout = (np.zeros(len(result.dataset), dtype=bool) for _ in range(2))
    train[result.split.train] = True
    holdout[result.split.holdout] = True
    return train, holdout


def distribution(result: RunResult) -> Figure | None:
    """Share of records below each error, nominal and calibrated, on one axis; None without records."""
    train, holdout = _roles(result)
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
    chosen = _thinned(errors, np.flatnonzero(np.isfinite(errors)))
    beyond = int(np.sum(finite > top)) if clipped else 0
    words = "The dashed line marks 95 % of all records; rings mark the ten worst. "
    words += "The dark line is the running median: where it wanders, the setup changed on the way. "
    words += _drawn(len(chosen), len(finite))
    words += f"Triangles: {plural(beyond, 'record')} beyond the axis." if beyond else ""
    few = len(finite) < FEWEST_FOR_P95
    most = f"all lie below {significant(largest)}" if few else f"95 % lie below {significant(ninety_five)}"
    said = f"{plural(len(errors), 'record')}; {most} {result.errors.unit}."

    def draw(width: float) -> tuple[float, list[str]]:
        start, parts = svg.legend(52, width - 60, _order_legend(result))
        box = Box(52, start + 2, width - 16, start + (270 if width > svg.NARROW else 220))
        x = Axis(0.5, len(errors) + 0.5, box.left, box.right)
        y = Axis(0, top, box.bottom, box.top)
        labels = ("record, in recorded order", f"calibrated error, {result.errors.unit}")
        parts += svg.frame(box, x, y, labels, (10 if width > svg.NARROW else 5, 5))
        parts.append(svg.line(box.left, y.of(ninety_five), box.right, y.of(ninety_five), "guide"))
        parts += _one_by_one(result, chosen, x, y)
        ringed = worst[np.isfinite(errors[worst])]
        parts += [svg.circle(x.of(i + 1), y.of(float(errors[i])), 6, "ring") for i in ringed]
        return box.bottom + 44, parts

    return svg.both("order", ("Error of each record in recorded order", said, words), draw)


def _order_legend(result: RunResult) -> list[tuple[str, str]]:
    _, holdout = _roles(result)
    entries = [('<path class="dot train" d="M11 0h0"/>', "train")]
    if holdout.any():
        entries.append((f'<path class="diamond" d="M11 0{DIAMOND}"/>', "holdout"))
    ring = '<circle cx="11" cy="0" r="6" class="ring"/>'
    return [*entries, (ring, "ten worst" if len(holdout) > 10 else "worst first")]


def _one_by_one(result: RunResult, chosen: Indices, x: Axis, y: Axis) -> list[str]:
    whole = result.errors.calibrated_mm
    train, holdout = (role[chosen] for role in _roles(result))
    errors, place = whole[chosen], chosen.astype(np.float64) + 1
    inside, above = errors <= y.high, errors > y.high
    dotted = ((train & inside, "dot train"), (~train & ~holdout & inside, "dot before"))
    parts = [svg.dots(x.at(place[some]), y.at(errors[some]), css) for some, css in dotted]
    held = holdout & inside
    parts.append(svg.marks(x.at(place[held]), y.at(errors[held]), DIAMOND, "diamond"))
    for some, css in ((above & ~holdout, "fill-train"), (above & holdout, "fill-holdout")):
        parts.append(svg.marks(x.at(place[some]), y.at(errors[some]), _TRIANGLE, css))
    if np.isfinite(whole).all() and len(whole) >= 30:
        window = max(15, len(whole) // 12)
        starts = np.unique(np.linspace(0, len(whole) - window, _CURVE_POINTS).astype(np.intp))
        middle = np.array([np.median(whole[start : start + window]) for start in starts])
        parts.append(svg.polyline(x.at(starts.astype(np.float64) + (window + 1) / 2), y.at(middle), "running"))
    return parts


def _thinned(numbers: Array, known: Indices) -> Indices:
    """Of records, evenly through the recorded order, and those with the largest numbers in any case."""
    if len(known) <= MOST_POINTS:
        return known
    worst = known[np.argsort(-numbers[known], kind="stable")[:50]]
    even = known[np.linspace(0, len(known) - 1, MOST_POINTS - 50).astype(np.intp)]
    return np.unique(np.concatenate([even, worst]))


def _drawn(chosen: int, total: int) -> str:
    if chosen == total:
        return ""
    return f"{count(chosen)} of {count(total)} drawn, evenly chosen, the 50 worst among them. "


@dataclass(frozen=True)
class Coloured:
    """What colours the tip positions."""

    key: str  # of the figures on the page
    numbers: Array  # one a record (N)
    unit: str  # theirs
    name: str  # of one of them
    vectors: Array | None = None  # lines from the positions (3 x N; mm), if they are to be drawn


def views(result: RunResult) -> list[Figure]:
    errors = result.errors
    return _views(
        result, Coloured("workspace", errors.calibrated_mm, errors.unit, "calibrated error", _vectors(result))
    )


def moved_views(result: RunResult) -> list[Figure]:
    """The same of how far a pose residual moves the tip; empty where none was learned."""
    moved = result.pose_residual and result.pose_residual.moved
    if not moved:
        return []
    return _views(result, Coloured("pose-residual", 1000 * moved.altogether, "mm", "shift by the pose residual"))


def _views(result: RunResult, what: Coloured) -> list[Figure]:
    position = result.errors.position_mm
    if position.shape[0] < 3:
        return []
    known = np.flatnonzero(np.isfinite(what.numbers) & np.isfinite(position[:3]).all(axis=0))
    if not len(known):
        return []
    chosen = _thinned(what.numbers, known)
    chosen = chosen[np.argsort(what.numbers[chosen], kind="stable")]
    return [_view(position, what, chosen, len(known), axes) for axes in ((0, 1), (0, 2))]


def _vectors(result: RunResult) -> Array | None:
    """Residual vectors, where the residual is one measured position."""
    residual = result.errors.calibrated_residual_mm
    if result.errors.unit != "mm":
        return None
    ends = [name.removesuffix(".x") for name in result.dataset.channels if name.endswith(".x")]
    positions = [p for p in ends if result.dataset.has(f"{p}.y") and result.dataset.has(f"{p}.z")]
    return residual if residual.shape[0] == 3 and len(positions) == 1 else None


def _view(position: Array, what: Coloured, chosen: Indices, total: int, axes: tuple[int, int]) -> Figure:
    shown = position[list(axes)][:, chosen]
    across, up = (_NAMES[i] for i in axes)
    numbers, unit = what.numbers[chosen], what.unit
    vectors = what.vectors[:, chosen] if what.vectors is not None and len(chosen) <= _MOST_VECTORS else None
    if vectors is not None and not np.isfinite(vectors).all():
        vectors = None
    step = svg.nice_step(float(np.percentile(numbers, 98)) / len(_COLOURS), _STEPS)
    enlarged = _enlargement(shown, vectors)
    caption = f"Predicted tip positions; the darker, the larger the {what.name}."
    if enlarged:
        caption += f" Lines: residuals, {significant(enlarged, 1)} times enlarged."
    caption += f" {_drawn(len(chosen), total)}".rstrip()
    said = (
        f"{plural(len(chosen), 'tip position')} seen along {({'xy': 'z', 'xz': 'y'})[across + up]}; the largest "
        f"{what.name}, {significant(float(numbers[-1]))} {unit}, "
        f"at {across} {shown[0, -1]:.0f}, {up} {shown[1, -1]:.0f} mm."
    )

    def draw(width: float) -> tuple[float, list[str]]:
        box, x, y = _equal_axes(shown, width)
        parts = svg.frame(box, x, y, (f"{across}, mm", f"{up}, mm"), (5, 6))
        if vectors is not None and enlarged:
            tips = shown + enlarged * vectors[list(axes)]
            parts.append(svg.segments(x.at(shown[0]), y.at(shown[1]), x.at(tips[0]), y.at(tips[1]), "vector"))
        level = np.minimum((numbers / step).astype(int), len(_COLOURS) - 1)
        css = "dot" if len(chosen) <= 1000 else "dot small"
        for number, colour in enumerate(_COLOURS):
            here = level == number
            parts.append(svg.dots(x.at(shown[0, here]), y.at(shown[1, here]), css, colour))
        parts += _colour_key(box, step, f"{what.name}, {unit}")
        return box.bottom + 104, parts

    title = "Workspace from above (x, y)" if up == "y" else "Workspace from the side (x, z)"
    return svg.both(f"{what.key}-{across}{up}", (title, said, caption), draw, svg.HALF)


def _enlargement(shown: Array, vectors: Array | None) -> float:
    if vectors is None:
        return 0.0
    long = float(np.percentile(np.linalg.norm(vectors, axis=0), 95))
    extent = float(np.ptp(shown, axis=1).max())
    return svg.nice_step(extent / 15 / long / 2) if long > 0 and extent > 0 else 0.0


def _equal_axes(shown: Array, width: float) -> tuple[Box, Axis, Axis]:
    middle = (shown.max(axis=1) + shown.min(axis=1)) / 2
    extent = np.maximum(np.ptp(shown, axis=1) * 1.08, 10.0)
    left, right, top, tallest = 58.0, width - 16, 10.0, width * 0.86
    scale = min((right - left) / extent[0], tallest / extent[1])
    height = max(extent[1] * scale, 0.35 * width)
    box = Box(left, top, right, top + height)
    half = np.array([right - left, height]) / scale / 2
    x = Axis(float(middle[0] - half[0]), float(middle[0] + half[0]), box.left, box.right)
    return box, x, Axis(float(middle[1] - half[1]), float(middle[1] + half[1]), box.bottom, box.top)


def _colour_key(box: Box, step: float, words: str) -> list[str]:
    width = min((box.right - box.left) / len(_COLOURS), 44.0)
    left = (box.left + box.right - width * len(_COLOURS)) / 2
    y = box.bottom + 50
    parts = [svg.rect(left + i * width, y, width, 10, colour) for i, colour in enumerate(_COLOURS)]
    decimals = decimals_for(step, 2 if round(step / 10 ** np.floor(np.log10(step)), 6) % 1 else 1)
    for i in range(len(_COLOURS)):
        parts.append(svg.text(left + i * width, y + 24, fixed(i * step, decimals), "tick", "middle"))
    return [*parts, svg.text((box.left + box.right) / 2, y + 44, f"{words}; the darkest: and more", "tick", "middle")]


def share_rows(interval_result: IntervalResult) -> list[tuple[str, str, tuple[str, ...], tuple[str, ...]]]:
    """Shares held by the intervals of cross-validated and held-out records, in the calibrated and in a new recording.

    Name, records, shares as stated and as computed; of these one text a level, radii last.
    """
    sets = (("Cross-validated", interval_result.crossed), ("Held out", interval_result.holdout))
    rows = []
    for words, shares in sets:
        for name, share in shares.items():
            label = f"{words}, {_RECORDINGS[name]}" if len(shares) > 1 else words
            radius = share.stretched_radius if share.stretched else share.raw_radius
            percents = _percent([*share.stated, radius]), _percent([*share.raw, share.raw_radius])
            rows.append((label, count(share.records), *percents))
    return rows


def _percent(shares: Sequence[float | None]) -> tuple[str, ...]:
    return tuple(NONE if share is None else f"{100 * share:.1f} %" for share in shares)


def level_names() -> tuple[str, ...]:
    return (*(f"{100 * level:g} %" for level in LEVELS), "95 % radius")


def predicted_against_found(result: RunResult) -> Figure | None:
    """Error of each judged record over its 95 % radius; None where no position was judged."""
    scores = result.intervals.scores.get("same")
    if scores is None or len(scores.reaches) != 1:
        return None
    _, holdout = _roles(result)
    errors = result.errors
    judged = np.where(holdout, errors.calibrated_mm, errors.cross_validated_mm)
    reach = scores.reaches[0]
    known = np.isfinite(reach) & np.isfinite(judged) & (reach > 0)
    if not known.any():
        return None
    stretch = result.intervals.stretches.get("same")
    widened = stretch.radius if stretch and stretch.radius is not None else 1.0
    radius = np.where(known, widened * judged / np.where(known, reach, 1.0), np.nan)
    inside = float(np.mean(judged[known] <= radius[known]))
    said = f"{plural(int(known.sum()), 'record')} judged by a fit that did not see them; {100 * inside:.1f} % inside."
    caption = "Below the line the error is inside its 95 % radius. Spread along the line: the +- follows the pose."

    def draw(width: float) -> tuple[float, list[str]]:
        entries = []
        if (known & ~holdout).any():
            entries.append(('<path class="dot train" d="M11 0h0"/>', "cross-validated"))
        if (known & holdout).any():
            entries.append((f'<path class="diamond" d="M11 0{DIAMOND}"/>', "held out"))
        start, parts = svg.legend(52, width - 60, entries)
        box = Box(52, start + 2, width - 16, start + (270 if width > svg.NARROW else 220))
        low, high = float(np.nanmin(radius[known])), float(np.nanmax(radius[known]))
        margin = max(0.05 * (high - low), 0.02 * high)
        x = Axis(max(low - margin, 0.0), high + margin, box.left, box.right)
        y = Axis(0, 1.06 * max(float(judged[known].max()), high), box.bottom, box.top)
        labels = ("predicted 95 % radius, mm", "measured error, mm")
        parts += svg.frame(box, x, y, labels, (8 if width > svg.NARROW else 5, 5))
        parts.append(svg.line(x.start, y.of(x.low), x.end, y.of(x.high), "guide"))
        crossed, held = known & ~holdout, known & holdout
        parts.append(svg.dots(x.at(radius[crossed]), y.at(judged[crossed]), "dot train"))
        parts.append(svg.marks(x.at(radius[held]), y.at(judged[held]), DIAMOND, "diamond"))
        return box.bottom + 44, parts

    return svg.both("radii", ("Predicted and measured errors", said, caption), draw)


def profile_rows(result: RunResult) -> list[tuple[str, ...]]:
    """Name, value, interval by profile likelihood, customary unit and remark of each number asked for."""
    rows: list[tuple[str, ...]] = []
    for profile in result.profiles:
        factor, unit = _shown(result, profile)
        width = max(factor * max(profile.upper - profile.lower, 1e-12), 1e-12)
        digits = max(2, 1 - int(np.floor(np.log10(width))))
        ends = f"{fixed(factor * profile.lower, digits)} to {fixed(factor * profile.upper, digits)}"
        sides = (("lower", profile.lower_end), ("upper", profile.upper_end))
        remarks = [f"{side} end {_ENDS[end]}" for side, end in sides if _ENDS[end]]
        if profile.better:
            remarks.append("a better fit was found on the way: try more starts")
        rows.append((profile.name, fixed(factor * profile.value, digits), ends, unit, "; ".join(remarks)))
    return rows


def profile_figures(result: RunResult) -> tuple[Figure, ...]:
    return tuple(_curve(result, number, profile) for number, profile in enumerate(result.profiles))


def _curve(result: RunResult, number: int, profile: Profile) -> Figure:
    factor, unit = _shown(result, profile)
    label = f"{profile.name}, {unit}" if unit else profile.name
    places, rises = factor * profile.curve[0], profile.curve[1]
    top = 1.6 * profile.quantile
    caption = "The interval ends where the curve passes the level line. Dashed: the parabola of the standard deviation."
    said = f"From {significant(factor * profile.lower)} to {significant(factor * profile.upper)} {unit}."
    entries = [('<path class="curve train" d="M0 0h22"/>', "profile")]
    entries.append(('<path class="curve before" d="M0 0h22"/>', "by the curvature"))

    def draw(width: float) -> tuple[float, list[str]]:
        start, parts = svg.legend(52, width - 60, entries)
        box = Box(52, start + 2, width - 16, start + 200)
        margin = 0.05 * max(float(np.ptp(places)), 1e-12)
        x = Axis(float(places.min()) - margin, float(places.max()) + margin, box.left, box.right)
        y = Axis(0, top, box.bottom, box.top)
        parts += svg.frame(box, x, y, (label, "twice the rise of the cost"), (5, 4))
        parts.append(svg.line(box.left, y.of(profile.quantile), box.right, y.of(profile.quantile), "guide"))
        if np.isfinite(profile.deviation) and profile.deviation > 0:
            wide = np.linspace(x.low, x.high, 80)
            curvature = ((wide / factor - profile.value) / profile.deviation) ** 2
            shown = curvature <= top
            parts.append(svg.polyline(x.at(wide[shown]), y.at(curvature[shown]), "curve before"))
        fine = np.linspace(float(places.min()), float(places.max()), 120)
        # Between fits the root of the rise is nearly straight.
        root = np.interp(fine, places, np.sign(places - factor * profile.value) * np.sqrt(np.maximum(rises, 0.0)))
        parts.append(svg.polyline(x.at(fine), y.at(root**2), "curve train"))
        parts.append(svg.dots(x.at(places), y.at(rises), "dot train"))
        return box.bottom + 44, parts

    return svg.both(f"profile{number}", (f"Profile of {profile.name}", said, caption), draw, svg.HALF)


def _shown(result: RunResult, profile: Profile) -> tuple[float, str]:
    return shown_unit(result.estimate.parameters[profile.name].unit)
