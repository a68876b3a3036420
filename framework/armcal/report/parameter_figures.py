"""Figures of parameters: compliances with their intervals, correlations, singular values."""

import math
from collections.abc import Sequence

import numpy as np

from armcal.base.arrays import Array
from armcal.estimate.identifiability import Identifiability
from armcal.report import svg
from armcal.report.numbers import fixed, plural, significant
from armcal.report.svg import MONO, Axis, Box, Figure
from armcal.report.tables import ParameterRow

MOST_WHISKERS = 40
MOST_MAPPED = 40
"""More free parameters than this are no longer readable in a map."""
_ROW = 27.0
_DIAGONAL, _UNKNOWN = "#e9ecf0", "#c9ced6"
_BLUE, _ORANGE = (0, 68, 136), (187, 85, 0)


def compliances(rows: Sequence[ParameterRow]) -> Figure | None:
    """Dot and whisker of each compliance against its bound; None without compliances."""
    if not rows:
        return None
    ranked = sorted(range(len(rows)), key=lambda i: (not rows[i].at_bound, -abs(rows[i].raw.value)))
    shown = [rows[i] for i in sorted(ranked[:MOST_WHISKERS])]
    unit = shown[0].unit
    words = "Dot: value; whisker: 95 % interval; dark line at 0: the physical bound"
    words += "; hollow dot: ended at its bound" if any(r.at_bound for r in shown) else ""
    words += "; dashed: not determined" if not all(r.determined for r in shown) else ""
    words += "; small bar: nominal, where it is not 0" if any(r.raw.nominal for r in shown) else ""
    caption = (
        f"{words}. {len(shown)} of {len(rows)}: at a bound, or the largest." if len(shown) < len(rows) else f"{words}."
    )
    said = "; ".join(f"{r.name} {r.value} {unit}, {r.interval}" for r in shown[:12])
    ends = [0.0]
    for row in shown:
        raw = row.raw
        ends += [raw.value, raw.nominal]
        ends += [raw.lower, raw.upper] if math.isfinite(raw.sd) else []
    finite = [e for e in ends if math.isfinite(e)]
    low, high = min(finite), max(finite)
    room = (high - low) * 0.04 or 1e-3
    low, high = low - room, high + room

    def draw(width: float) -> tuple[float, list[str]]:
        most = 14 if width == svg.NARROW else 26
        left = MONO * max(len(svg.shorten(r.name, most)) for r in shown) + 18
        beside = (6.9 * max(len(_beside(r)) for r in shown) + 16) if width > svg.NARROW else 14
        box = Box(left, 8, width - beside, 8 + _ROW * len(shown))
        x = Axis(low, high, box.left, box.right)
        parts = svg.frame(box, x, None, (f"compliance, {unit}", ""), (8 if width > svg.NARROW else 4, 0))
        if low < 0 <= high:
            parts.append(svg.line(x.of(0), box.top, x.of(0), box.bottom, "bound"))
        for number, row in enumerate(shown):
            y = box.top + _ROW * (number + 0.5)
            parts.append(svg.text(left - 9, y + 4, svg.shorten(row.name, most), "mono", "end"))
            parts += _whisker(row, x, y)
            if width > svg.NARROW:
                parts.append(svg.text(box.right + 12, y + 4, _beside(row), "tick"))
        return box.bottom + 44, parts

    return svg.both("compliance", ("Compliances and their bounds", said, caption), draw)


def _beside(row: ParameterRow) -> str:
    return f"{row.value.strip()}   ({row.interval if row.determined else 'not determined'})"


def _whisker(row: ParameterRow, x: Axis, y: float) -> list[str]:
    raw = row.raw
    known = math.isfinite(raw.sd)
    left, right = (x.of(raw.lower), x.of(raw.upper)) if known else (x.start, x.end)
    parts = [svg.line(left, y, right, y, "whisker" if known else "whisker unknown")]
    if known:
        parts += [svg.line(end, y - 5, end, y + 5, "whisker") for end in (left, right)]
    if raw.nominal:
        parts.append(svg.line(x.of(raw.nominal), y - 9, x.of(raw.nominal), y + 9, "nominal"))
    parts.append(svg.circle(x.of(raw.value), y, 5, "hollow" if row.at_bound else "solid"))
    return parts


def correlation_map(correlation: Array, names: tuple[str, ...], known: Sequence[bool]) -> Figure | None:
    """The correlations of all free parameters as cells; None if fewer than two or too many."""
    number = len(names)
    if not 2 <= number <= MOST_MAPPED:
        return None
    short = [svg.shorten(name) for name in names]
    cell = min(26.0, max(14.0, 560.0 / number))
    margin = MONO * max(len(name) for name in short) + 14
    side = cell * number
    parts = []
    for i in range(len(names)):
        for j in range(i + 1):
            colour, title = _DIAGONAL, ""
            if i != j:
                both_known = known[i] and known[j]
                colour = _colour(float(correlation[i, j])) if both_known else _UNKNOWN
                shown = f"{correlation[i, j]:+.2f}" if both_known else "not known"
                title = f"{names[i]}, {names[j]}: {shown}"
            parts.append(svg.rect(margin + j * cell, 6 + i * cell, cell - 1, cell - 1, colour, title))
    for i, name in enumerate(short):
        at = (i + 0.5) * cell
        parts.append(svg.text(margin - 7, 6 + at + 4, name, "mono", "end"))
        parts.append(svg.text(margin + at + 4, 6 + side + 8, name, "mono", "end", -90))
    width, height = margin + side + 12, 6 + side + margin + 8
    x, y = margin + side - 176, 14  # of the key
    parts += [svg.rect(x + i * 16, y, 16, 10, _colour(v)) for i, v in enumerate(np.linspace(-1, 1, 11).tolist())]
    for at, value in ((8, -1), (88, 0), (168, 1)):
        parts.append(svg.text(x + at, y + 24, fixed(value, 0, signed=True), "tick", "middle"))
    parts.append(svg.text(x + 88, y - 4, "correlation", "tick", "middle"))
    said = f"Lower triangle of the correlations of {number} parameters; pairs above 0.95 are listed beside it."
    title = "Correlations of the parameters' estimates"
    drawn = svg.document("correlation-map", (width, height), title, said, parts)
    caption = "Dark cells: the data hardly separates the two."
    caption += "" if all(known) else " Grey: not determined, so no correlation is known."
    return Figure(title, caption, drawn)


def _colour(value: float) -> str:
    share = min(abs(value), 1.0)
    end = _BLUE if value < 0 else _ORANGE
    return "#" + "".join(f"{round(248 + (channel - 248) * share):02x}" for channel in end)


def singular_values(known: Identifiability) -> Figure | None:
    """The spectrum on a logarithmic axis; None without parameters."""
    values = known.singular_values[: len(known)]
    positive = values[np.isfinite(values) & (values > 0)]
    if not len(positive):
        return None
    largest = float(positive.max())
    low = max(float(positive.min()), largest * 1e-18)
    low, high = 10.0 ** math.floor(math.log10(low) - 0.01), 10.0 ** math.ceil(math.log10(largest) + 0.01)
    smallest = significant(float(values.min()))
    said = f"{plural(len(values), 'singular value')} from {significant(largest)} down to {smallest}."
    caption = "How sharply the data sees each combination of parameters, in typical scales of each."
    if known.rank < len(values):
        caption += f" Hollow: the {plural(len(values) - known.rank, 'combination')} that it does not see."

    def draw(width: float) -> tuple[float, list[str]]:
        box = Box(64, 10, width - 16, 200)
        x = Axis(0.3, len(values) + 0.7, box.left, box.right)
        y = Axis(low, high, box.bottom, box.top, log=True)
        labels = ("combination, the best seen first", "singular value")
        parts = svg.frame(box, x, y, labels, (min(10, len(values)), 5))
        place = x.at(np.arange(1.0, len(values) + 1))
        height = y.at(np.nan_to_num(values))
        seen = min(known.rank, len(values))
        parts.append(svg.segments(place, np.full(len(values), box.bottom), place, height, "stem"))
        parts += [svg.circle(a, b, 3.5, "solid") for a, b in zip(place[:seen], height[:seen], strict=True)]
        parts += [svg.circle(a, b, 3.5, "hollow") for a, b in zip(place[seen:], height[seen:], strict=True)]
        return box.bottom + 44, parts

    return svg.both("singular", ("Singular values", said, caption), draw)
