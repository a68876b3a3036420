"""Figures of a survey: sections through the workspace, and designs beside one another."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
from armcal.base.arrays import Array

from armcal_capability.cells import Voxels
from armcal_capability.drawing import INK, LABEL_POINTS, empty_figure, png_of, style
from armcal_capability.quantities import BY_NAME
from armcal_capability.settings import AreaSettings, CapabilitySettings
from armcal_capability.survey import Survey

_MM = 1000.0
_LIMIT, _ARM = "#555555", "#d95f02"
_GOOD_LOW, _GOOD_HIGH, _COUNTS = "cividis_r", "cividis", "Greys"
_DESIGN_COLOURS = ("#000000", "#e69f00", "#56b4e9", "#009e73", "#d55e00", "#cc79a7", "#0072b2", "#f0e442")
"""Distinct with any colour vision."""
_NAMES = "xyz"
DRAWN = (
    "sag_mm",
    "deflection_mm",
    "give_mm_per_N",
    "effort_ratio",
    "smallest_mm_per_rad",
    "manipulability",
    "inverse_condition",
    "expected_mm",
    "nominal_mm",
)
"""Quantities that have a figure."""


@dataclass(frozen=True)
class _Section:
    """A cut through the map: the axes shown, the one cut, where (m), and the limits of the whole workspace."""

    across: int
    up: int
    cut: int
    at: float


def sections_of(survey: Survey, settings: CapabilitySettings) -> tuple[_Section, _Section]:
    """The x-z section and the x-y section; where no z is given, through the middle of what is reached."""
    z = settings.sections.z
    level = float(np.median(survey.postures.positions[:, 2])) if z is None else z
    return _Section(0, 2, 1, settings.sections.y), _Section(0, 1, 2, level)


def reach_figure(survey: Survey, settings: CapabilitySettings) -> bytes:
    from matplotlib.colors import LogNorm

    counts = survey.voxels.counts.astype(float)
    how = {"cmap": _COUNTS, "norm": LogNorm(1, max(float(counts.max()), 2.0))}
    return _figure(survey, settings, counts, how, "postures of the sample in a cell", "Reach")


def quantity_figure(survey: Survey, settings: CapabilitySettings, name: str) -> bytes:
    quantity, cells = BY_NAME[name], survey.voxels.mean(name)
    low, high = np.percentile(cells, [2, 98]) if quantity.good == "high" else (0.0, np.percentile(cells, 98))
    how = {"cmap": _GOOD_LOW if quantity.good == "low" else _GOOD_HIGH, "vmin": low, "vmax": max(high, low + 1e-12)}
    unit = f", {quantity.unit}" if quantity.unit else ""
    title = quantity.words[0].upper() + quantity.words[1:]
    return _figure(survey, settings, cells, how, f"mean of the postures{unit}", title)


def _figure(
    survey: Survey, settings: CapabilitySettings, cells: Array, how: Mapping[str, Any], label: str, title: str
) -> bytes:
    figure = empty_figure((11.0, 5.0))
    axes = figure.subplots(1, 2)
    mesh = None
    for axis, section in zip(axes, sections_of(survey, settings), strict=True):
        mesh = _map(axis, survey.voxels, cells, section, how)
        _limits(axis, survey.voxels, section)
        _areas(axis, settings.areas, section)
        points = survey.outline[:, [section.across, section.up]] * _MM
        axis.plot(points[:, 0], points[:, 1], "-o", color="white", lw=3.6, ms=5.5, zorder=5)
        axis.plot(points[:, 0], points[:, 1], "-o", color=_ARM, lw=2.0, ms=3.5, zorder=6)
        axis.plot(points[-1, 0], points[-1, 1], "s", color=_ARM, mec="white", ms=6, zorder=6)
        where = f"{_NAMES[section.cut]} = {section.at * _MM:.0f} mm ± {survey.voxels.size * _MM:.0f} mm"
        axis.set_title(f"section at {where}", fontsize=LABEL_POINTS, color=INK)
        _plain_axes(axis, section)
    bar = figure.colorbar(mesh, ax=list(axes), shrink=0.85, pad=0.02, extend="max" if "vmax" in how else "neither")
    bar.set_label(label, fontsize=LABEL_POINTS, color=INK)
    bar.ax.tick_params(labelsize=8.5, colors=INK)
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, color=INK)
    handles = [_line(_LIMIT, "-", "limit of the tool, at any depth"), _line(_ARM, "-o", "arm, joints at mid travel")]
    if settings.areas:
        handles.append(_line(INK, "--", "areas"))
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=8.5, frameon=False)
    return png_of(figure)


def designs_figure(surveys: Mapping[str, Survey], tables: Mapping[str, Any], settings: CapabilitySettings) -> bytes:
    """Limits of the designs' tools in the x-z plane, and how much of each area each reaches and holds (PNG)."""
    figure = empty_figure((11.0, 5.2))
    side, bars = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    section = _Section(0, 2, 1, settings.sections.y)
    for survey, colour in zip(surveys.values(), cycle(_DESIGN_COLOURS), strict=False):
        _limits(side, survey.voxels, section, colour, 1.4)
        points = survey.outline * _MM
        side.plot(points[:, 0], points[:, 2], "-o", color=colour, lw=1.2, ms=2.5, zorder=6)
    _areas(side, settings.areas, section)
    side.set_title("limits of the tool, and the arms at mid travel", fontsize=LABEL_POINTS, color=INK)
    _plain_axes(side, section)
    _bars(bars, tables, list(settings.areas))
    handles = [_line(c, "-", name) for name, c in zip(surveys, cycle(_DESIGN_COLOURS), strict=False)]
    figure.legend(handles=handles, loc="outside lower left", ncols=4, fontsize=8.5, frameon=False)
    return png_of(figure)


def _bars(axes: Any, tables: Mapping[str, Any], areas: Sequence[str]) -> None:
    width = 0.8 / max(len(tables), 1)
    for row, (by_area, colour) in enumerate(zip(tables.values(), cycle(_DESIGN_COLOURS), strict=False)):
        at = np.arange(len(areas)) + (row - (len(tables) - 1) / 2) * width
        reached = [100 * by_area[area]["reached"] for area in areas]
        axes.bar(at, reached, width * 0.92, color=colour, alpha=0.35, lw=0)
        held = [None if by_area[area]["held"] is None else 100 * by_area[area]["held"] for area in areas]
        if all(h is not None for h in held):
            axes.bar(at, held, width * 0.92, color=colour, lw=0)
        for x, height in zip(at, reached, strict=True):
            axes.annotate(f"{height:.0f}", (x, height), ha="center", va="bottom", fontsize=8, color=INK)
    axes.set_xticks(range(len(areas)), labels=list(areas))
    axes.set_ylim(0, 108)
    held_text = any(area["held"] is not None for table in tables.values() for area in table.values())
    words = "reached" + ("; the dark part: held by the servos too" if held_text else "")
    axes.set_title(words, fontsize=LABEL_POINTS, color=INK)
    style(axes, up="share of the area, %", grid="")


def _map(axes: Any, voxels: Voxels, cells: Array, section: _Section, how: Mapping[str, Any]) -> Any:
    """The cells within one cell's size of the cut, averaged over that depth by their postures."""
    size = voxels.size
    depth = voxels.places[:, section.cut]
    layers = np.floor(section.at / size + np.array([-0.5, 0.5]) + 1e-9).astype(int)
    near = (depth >= layers[0]) & (depth <= layers[1])
    plane = voxels.places[near][:, [section.across, section.up]]
    low, high = voxels.places.min(axis=0), voxels.places.max(axis=0) + 1
    origin, shape = low[[section.across, section.up]], (high - low)[[section.across, section.up]]
    flat = np.ravel_multi_index(tuple((plane - origin).T), tuple(shape)) if len(plane) else np.zeros(0, dtype=int)
    weight = voxels.counts[near].astype(float)
    total = np.bincount(flat, weights=weight * cells[near], minlength=int(np.prod(shape)))
    counts = np.bincount(flat, weights=weight, minlength=int(np.prod(shape)))
    grid = np.divide(total, counts, out=np.full(len(total), np.nan), where=counts > 0).reshape(shape)
    x, y = ((origin[i] + np.arange(shape[i] + 1)) * size * _MM for i in range(2))
    return axes.pcolormesh(x, y, grid.T, **how, rasterized=True, zorder=2)


def _limits(axes: Any, voxels: Voxels, section: _Section, colour: str = _LIMIT, width: float = 1.0) -> None:
    from scipy.ndimage import binary_closing

    plane = voxels.places[:, [section.across, section.up]]
    origin = plane.min(axis=0) - 2
    shape = plane.max(axis=0) - origin + 3
    seen = np.zeros(shape, dtype=bool)
    seen[tuple((plane - origin).T)] = True
    x, y = ((origin[i] + np.arange(shape[i]) + 0.5) * voxels.size * _MM for i in range(2))
    closed = binary_closing(seen).astype(float)
    axes.contour(x, y, closed.T, levels=[0.5], colors=[colour], linewidths=width, zorder=4)


def _areas(axes: Any, areas: Mapping[str, AreaSettings], section: _Section) -> None:
    from matplotlib.patches import Rectangle

    for name, area in areas.items():
        low, high = (np.array(corner)[[section.across, section.up]] * _MM for corner in (area.low, area.high))
        box = Rectangle(tuple(low), *(high - low), fill=False, ls="--", lw=1.4, ec=INK, zorder=7)
        axes.add_patch(box)
        halo = {"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 0.8}
        axes.annotate(
            name, (low[0], high[1]), xytext=(1, 3), textcoords="offset points", fontsize=8.5, bbox=halo, zorder=8
        )


def _plain_axes(axes: Any, section: _Section) -> None:
    axes.set_aspect("equal", adjustable="datalim")
    style(axes, f"{_NAMES[section.across]}, mm", f"{_NAMES[section.up]}, mm")


def _line(colour: str, style: str, label: str) -> Any:
    from matplotlib.lines import Line2D

    mark = "o" if "o" in style else None
    return Line2D([], [], color=colour, ls=style.replace("o", ""), marker=mark, ms=3.5, label=label)
