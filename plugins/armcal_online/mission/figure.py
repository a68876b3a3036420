"""The figure of a mission: tip errors over days with what happened, day and night, and the level."""

import io
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from armcal.estimate.simulation import DAY_S, Mission

from armcal_online.mission.judge import ErrorCurve, Judgement

_MM = 1000.0
_INK, _GRID, _FAINT = "#333333", "#d9d9d9", "#6a6a6a"
_CURVES = {
    "frozen": ("#b5542a", 1.2, "calibration before launch, frozen"),
    "refit": ("#7a9a3a", 1.0, "robust refit of all records"),
    "refit_recent": ("#8b6fb3", 1.0, "robust refit of the last {records} records"),
    "recalibrated": ("#1f5fa8", 1.5, "recalibrated"),
}
"""Colour, width and name of each curve, those above last."""
_VERDICTS = {"right": "#2f7d4f", "vague": "#9a7a10", "wrong": "#b8322f", "missed": "#b8322f"}
_LEVELS = {"nominal": "#4c9f70", "watch": "#e3c14b", "suspect": "#dd7f33", "lost": "#b8322f"}
_LEAST_MM = 0.02
_NIGHT = (18.0, 30.0)
"""Hours from the mission's midnight; evening to morning."""
_WIDTH, _TURNED, _LINE, _COLUMNS = 0.26, 0.76, 12.5, 42
"""How much of the axes a label takes, from where on it stands to the left of its line, the height of a line in points,
and its most characters."""


def mission_figure(mission: Mission, judged: Judgement, title: str, records: int) -> bytes:
    """A PNG; the robust refit is one of so many recent records."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.5, 5.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes, band = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [16, 1], "hspace": 0.02})
    days = mission.seconds / DAY_S
    _draw_curves(axes, judged, days, records)
    above = _draw_events(axes, mission, judged)
    _draw_levels(band, judged.curve, days)
    below = {"loc": "upper right", "bbox_to_anchor": (1.0, -2.0), "borderaxespad": 0.0}
    band.legend(*axes.get_legend_handles_labels(), ncols=2, fontsize=8.5, frameon=False, **below)
    for plot in (axes, band):
        plot.set_xlim(0, days)
        plot.spines[["top", "right"]].set_visible(False)
    axes.set_title(title, loc="left", fontsize=12, color=_INK, pad=8 + above)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _draw_curves(axes: Any, judged: Judgement, days: float, records: int) -> None:
    curve = judged.curve
    at, shown = curve.times / DAY_S, np.vstack(list(curve.errors.values())) * _MM
    low, high = max(float(shown.min()), _LEAST_MM) / 1.4, max(float(shown.max()), judged.limit * _MM) * 1.6
    for day in range(-1, int(np.ceil(days))):
        evening, morning = (day + hour / 24 for hour in _NIGHT)
        axes.axvspan(max(evening, 0.0), min(morning, days), color="#eef0f4", lw=0, zorder=0)
    for height, (name, (color, width, label)) in enumerate(_CURVES.items(), 3):
        if name in curve.errors:
            text = label.format(records=records)
            axes.plot(at, curve.errors[name] * _MM, color=color, lw=width, label=text, zorder=height)
    axes.axhline(judged.limit * _MM, color=_INK, lw=0.9, ls=(0, (5, 4)), zorder=2)
    axes.annotate(
        f"limit {judged.limit * _MM:g} mm",
        (1.0, judged.limit * _MM),
        xycoords=("axes fraction", "data"),
        xytext=(-4, 3),
        textcoords="offset points",
        ha="right",
        fontsize=8.5,
        color=_INK,
    )
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    ticks = [digit * 10.0**power for power in range(-3, 5) for digit in (1, 3) if low <= digit * 10.0**power <= high]
    axes.set_yticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(axis="y", color=_GRID, lw=0.6)
    axes.set_axisbelow(True)
    axes.set_ylabel("mean tip error, mm", fontsize=10, color=_INK)
    axes.tick_params(labelsize=9, colors=_INK)


def _draw_events(axes: Any, mission: Mission, judged: Judgement) -> float:
    """Events as labelled lines, each label in the lowest free row; power cuts inside the axes.

    How high the labels reach, in points.
    """
    labels = []
    for report in judged.events:
        place, verdict = report.occurrence.time / mission.seconds, report.finding.verdict
        text = "\n".join([*textwrap.wrap(report.occurrence.label, _COLUMNS), f"{verdict}, {report.aftermath}"])
        labels.append((place, text, _VERDICTS[verdict]))
    rows = _rows([place for place, _, _ in labels])
    height = _LINE * max((text.count("\n") + 1 for _, text, _ in labels), default=0)
    for (place, text, color), row in zip(labels, rows, strict=True):
        day = place * mission.seconds / DAY_S
        axes.axvline(day, color=_INK, lw=1.0, zorder=3)
        side = "right" if place > _TURNED else "left"
        _write(axes, day, text, xytext=(2 if side == "right" else -2, 4 + height * row), ha=side, color=color)
    for time in mission.power_cuts:
        axes.axvline(time / DAY_S, color=_FAINT, lw=0.9, ls=":", zorder=3)
        _write(axes, time / DAY_S, "power cut", xytext=(3, -4), rotation=90, va="top", color=_FAINT)
    return height * (max(rows, default=-1) + 1)


def _write(axes: Any, day: float, text: str, **how: Any) -> None:
    """At the top of the axes, moved by ``xytext`` points."""
    where = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "annotation_clip": False}
    axes.annotate(text, (day, 1.0), fontsize=8.5, **where, **how)


def _rows(places: Sequence[float]) -> list[int]:
    """A line of text for each label (places from 0 to 1), so that neighbours do not run into each other."""
    taken: list[list[tuple[float, float]]] = []
    rows = []
    for place in places:
        first = place - _WIDTH if place > _TURNED else place
        free = [i for i, row in enumerate(taken) if all(first >= end or first + _WIDTH <= at for at, end in row)]
        row = free[0] if free else len(taken)
        taken[row : row + 1] = [[*(taken[row] if free else []), (first, first + _WIDTH)]]
        rows.append(row)
    return rows


def _draw_levels(band: Any, curve: ErrorCurve, days: float) -> None:
    from matplotlib.patches import Patch

    at = curve.times / DAY_S
    starts = [0, *(i for i in range(1, len(at)) if curve.levels[i] != curve.levels[i - 1])]
    for first, last in zip(starts, [*starts[1:], len(at) - 1], strict=True):
        end = days if last == len(at) - 1 else at[last]
        band.axvspan(at[first], end, color=_LEVELS.get(curve.levels[first], "#999999"), lw=0)
    seen = [level for level in _LEVELS if level in curve.levels]
    levels = band.legend(
        handles=[Patch(color=_LEVELS[level], label=level) for level in seen],
        loc="upper left",
        bbox_to_anchor=(0.0, -2.0),
        ncols=len(seen),
        fontsize=8.5,
        frameon=False,
        borderaxespad=0.0,
    )
    band.add_artist(levels)
    band.set_yticks([])
    band.set_ylabel("level", fontsize=9, rotation=0, ha="right", va="center", color=_INK)
    band.set_xlabel("days since the mission began", fontsize=10, color=_INK)
    band.tick_params(labelsize=9, colors=_INK)
    band.spines["left"].set_visible(False)
