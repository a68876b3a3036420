"""Figures of an assessment: accuracy and repeatability by pose, where visits fell, and how both moved over time."""

from collections.abc import Mapping

import numpy as np

from armcal_capability.acceptance import characteristics as of
from armcal_capability.acceptance.assessment import MM, Assessment, series_of
from armcal_capability.acceptance.comparison import Comparison
from armcal_capability.acceptance.records import Visits
from armcal_capability.drawing import INK, Picture, empty_figure, png_of, style

_COLOURS = {"nominal": "#d95f02", "calibrated": "#1b6ca8", "RP": "#777777"}
_CLOUDS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999", "#000000")
_MOST_POSES = 40
"""Of which bars can be distinguished."""
_MOST_CLOUDS = 8


def pictures(assessment: Assessment, visits: Visits, comparisons: Mapping[str, Comparison]) -> tuple[Picture, ...]:
    """All that the visits give."""
    made = []
    if len(assessment.poses) <= _MOST_POSES:
        text = "Accuracy AP of each pose by each model, and its repeatability RP, with 95 % intervals."
        made.append(Picture("by_pose", "Accuracy and repeatability by pose", _by_pose(assessment), text))
    else:
        text = "Share of the poses whose accuracy AP, and whose repeatability RP, is better than so much."
        made.append(Picture("by_pose", "Accuracy and repeatability of the poses", _shares(assessment), text))
    if len(visits.poses) <= _MOST_CLOUDS:
        text = (
            "Each visit beside the barycentre of its pose, in the planes of the frame. Circles have the radius RP; "
            "marks are directions of approach."
        )
        made.append(Picture("visits", "Where visits fell", _visits(visits, comparisons), text))
    if assessment.drifts:
        text = "Accuracy and repeatability of each ten cycles, over time, one line a pose."
        made.append(Picture("drift", "Over time", _over_time(visits, comparisons), text))
    return tuple(made)


def _by_pose(assessment: Assessment) -> bytes:
    figure, rows = empty_figure((11.0, 4.2)), assessment.poses
    axes = figure.subplots()
    models = list(rows[0].models)
    columns = [(f"AP, {model}", _COLOURS[model], [row.models[model]["AP_mm"] for row in rows]) for model in models]
    columns.append(("RP", _COLOURS["RP"], [row.measured["RP_mm"] for row in rows]))
    width = 0.8 / len(columns)
    tallest = max(figure.value for _, _, figures in columns for figure in figures)
    for i, (label, colour, figures) in enumerate(columns):
        at = np.arange(len(rows)) + (i - (len(columns) - 1) / 2) * width
        values = np.array([figure.value for figure in figures])
        ends = np.array([[figure.low, min(figure.high, 3 * tallest)] for figure in figures]).T
        axes.bar(at, values, 0.92 * width, color=colour, label=label, lw=0)
        axes.vlines(at, *ends, color=INK, lw=1.0)
    names = [" ".join(filter(None, row.names)) for row in rows]
    axes.set_xticks(range(len(rows)), labels=names, rotation=0 if len(rows) < 16 else 90)
    axes.set_ylim(0, None)
    axes.legend(fontsize=8.5, frameon=False, ncols=len(columns), loc="upper left", bbox_to_anchor=(0, 1.12))
    style(axes, up="mm", grid="y")
    return png_of(figure)


def _shares(assessment: Assessment) -> bytes:
    figure, rows = empty_figure((11.0, 4.2)), assessment.poses
    axes = figure.subplots()
    columns = {f"AP, {model}": [row.models[model]["AP_mm"] for row in rows] for model in rows[0].models}
    columns["RP"] = [row.measured["RP_mm"] for row in rows]
    for label, figures in columns.items():
        values = np.sort([one.value for one in figures])
        shares = 100 * np.arange(1, len(values) + 1) / len(values)
        axes.step(values, shares, color=_COLOURS[label.split()[-1]], label=label)
    axes.set_xlim(0, None)
    axes.set_ylim(0, 100)
    axes.legend(fontsize=8.5, frameon=False, loc="lower right")
    style(axes, "mm", "share of the poses, %")
    return png_of(figure)


def _visits(visits: Visits, comparisons: Mapping[str, Comparison]) -> bytes:
    first, poses = next(iter(comparisons.values())), visits.poses
    figure = empty_figure((11.0, 4.0))
    marks = dict(zip(dict.fromkeys(group.direction for group in visits.groups), "o^sDvPX*", strict=False))
    for axes, (across, up) in zip(figure.subplots(1, 3), ((0, 1), (0, 2), (1, 2)), strict=True):
        for pose, colour in zip(poses, _CLOUDS, strict=False):
            middle = first.attained[visits.main(pose).members].mean(axis=0)
            for group in (group for group in visits.groups if group.pose == pose):
                points = (first.attained[group.members] - middle) * MM
                axes.plot(
                    *points[:, [across, up]].T, marks.get(group.direction, "."), ms=3.0, color=colour, alpha=0.6, lw=0
                )
            radius = of.repeatability(first.attained[visits.main(pose).members]).value * MM
            angles = np.linspace(0, 2 * np.pi, 73)
            axes.plot(radius * np.cos(angles), radius * np.sin(angles), color=colour, lw=1.0, label=pose)
        axes.set_aspect("equal", adjustable="datalim")
        style(axes, f"{'xyz'[across]}, mm", f"{'xyz'[up]}, mm")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=8, fontsize=8.5, frameon=False)
    return png_of(figure)


def _over_time(visits: Visits, comparisons: Mapping[str, Comparison]) -> bytes:
    first, time = next(iter(comparisons.values())), visits.dataset.column("time")
    figure = empty_figure((11.0, 3.8))
    left, right = figure.subplots(1, 2)
    for pose, colour in zip(visits.poses, _CLOUDS * len(visits.poses), strict=False):
        series = series_of(visits, visits.main(pose))
        if len(series) < 2:
            continue
        hours = [float(np.mean(time[own]) - time.min()) / 3600 for own in series]
        for (name, comparison), line in zip(comparisons.items(), ("--", "-"), strict=False):
            values = [of.accuracy(comparison.errors[own]).value * MM for own in series]
            left.plot(hours, values, line, color=colour, lw=1.2, label=f"{pose}, {name}")
        spread = [of.repeatability(first.attained[own]).value * MM for own in series]
        right.plot(hours, spread, "-", color=colour, lw=1.2)
    for axes, words in ((left, "AP, mm"), (right, "RP, mm")):
        axes.set_ylim(0, None)
        style(axes, "hours", words)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles[:12], labels[:12], loc="outside lower left", ncols=6, fontsize=8, frameon=False)
    return png_of(figure)
