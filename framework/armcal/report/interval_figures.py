"""Prediction intervals and profiles on the page: what was claimed beside what was measured."""

from collections.abc import Sequence

import numpy as np

from armcal.base.units import shown_unit
from armcal.estimate.prediction import LEVELS
from armcal.estimate.profile import Profile
from armcal.report import svg
from armcal.report.error_figures import roles
from armcal.report.numbers import NONE, count, fixed, plural, significant
from armcal.report.svg import DIAMOND, Axis, Box, Figure
from armcal.run.judging import IntervalResult
from armcal.run.result import RunResult

_RECORDINGS = {"same": "calibrated recording", "new": "new recording"}
_ENDS = {"crossed": "", "bound": "at its bound", "open": "does not end as far as was looked"}


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
    _, holdout = roles(result)
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
