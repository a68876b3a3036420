"""``armcal mission``, its table and its figure."""

import io
import time
from collections.abc import Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import click
import numpy as np
from armcal.base.config_text import as_json
from armcal.cli.common import Console, overrides, speaking
from armcal.io.folder import reserved
from armcal.io.plain_files import writing

from armcal_online.mission.mission import (
    BENCH,
    CALIBRATION,
    RECALIBRATION,
    RECORDS,
    ErrorCurve,
    MissionPlan,
    curve_text,
    run_mission,
)
from armcal_online.mission.simulator import DAY_S

FIGURES = ("mission.csv", "mission.json", "mission.png")
OURS = (BENCH, RECORDS, CALIBRATION, RECALIBRATION, *FIGURES)  # an earlier mission's move to earlier/N
_INK = "#333333"
_CURVES = {  # colour, width and name, those above last
    "frozen": ("#b5542a", 1.2, "frozen at launch"),
    "recalibrated": ("#1f5fa8", 1.5, "recalibrated"),
}
_LEVELS = {"nominal": "#4c9f70", "watch": "#e3c14b", "suspect": "#dd7f33", "lost": "#b8322f"}
_NIGHT = (18.0, 30.0)  # hours from the mission's midnight


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Where the mission goes.")
@overrides
@speaking
def mission(console: Console, config: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Simulate the mission of CONFIG, recalibrate over all of it, and compare that with the truth."""
    import_module("matplotlib")  # if it is missing, the command ends now
    began = time.monotonic()
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    plan = MissionPlan.load(config, overrides, console.registry())
    kept.place({})
    with console.progress() as progress:
        made, curve, content = run_mission(plan, out, progress)
    texts = (curve_text(curve, made).encode(), f"{as_json(content)}\n".encode(), mission_figure(curve, content))
    with writing(out, "Check the room on the disk."):
        for name, data in zip(FIGURES, texts, strict=True):
            (out / name).write_bytes(data)
    console.result({**content, "folder": str(out)})
    rows, share = list[tuple[str, ...]](), content["within_limit"]
    for name, sizes in content["error_mm"].items():
        rows.append((_CURVES[name][2], *(f"{size:.3f}" for size in sizes.values()), f"{share[name]:.1%}"))
    columns = ("calibration", "mean", "median", "95 %", "max", "last", f"within {content['limit_mm']:g} mm")
    console.table(f"Mean tip error over {content['days']:g} days, mm", columns, rows)
    for line in _lines(content):
        console.line(line)
    console.line(f"figure: {out / 'mission.png'}  ({time.monotonic() - began:.1f} s)")


def _lines(content: Mapping[str, Any]) -> Iterator[str]:
    for event in content["events"]:
        after = event["decided_after_hours"]
        decided = "nothing decided" if after is None else f"{event['decision']} after {after:.1f} h"
        yield f"day {event['day']:.2f}: {event['label']}: {decided}, {event['aftermath']}"
    counts = content["records"]
    yield f"{len(content['decisions'])} decisions; available {content['availability']:.1%} of the time"
    yield (
        f"{counts['arrived']} records: {counts['accepted']} accepted, {counts['rejected']} rejected "
        f"({counts['good_rejected']} of them good), {counts['ignored']} ignored; "
        f"{counts['outliers_accepted']} of {counts['outliers']} outliers accepted"
    )


def mission_figure(curve: ErrorCurve, content: Mapping[str, Any]) -> bytes:
    """A PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(11.5, 5.6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes, band = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [16, 1], "hspace": 0.02})
    days, at, limit = content["days"], curve.times / DAY_S, content["limit_mm"]
    for day in range(-1, int(np.ceil(days))):
        axes.axvspan(*(day + hour / 24 for hour in _NIGHT), color="#eef0f4", lw=0, zorder=0)
    for height, (name, (color, width, label)) in enumerate(_CURVES.items(), 3):
        axes.plot(at, 1000 * curve.errors[name], color=color, lw=width, label=label, zorder=height)
    axes.axhline(limit, color=_INK, lw=0.9, ls=(0, (5, 4)), zorder=2, label=f"limit {limit:g} mm")
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.grid(axis="y", color="#d9d9d9", lw=0.6)
    axes.set_ylabel("mean tip error, mm")
    over = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "fontsize": 8.5}
    for i, event in enumerate(content["events"]):
        axes.axvline(event["day"], color=_INK, lw=1.0, zorder=3)
        side, text = ("right" if event["day"] > 0.7 * days else "left"), f"{event['label']}\n{event['aftermath']}"
        axes.annotate(text, (event["day"], 1.0), xytext=(0, 4 + 24 * (i % 2)), ha=side, **over)
    for day in content["power_cuts"]:
        axes.axvline(day, color=_INK, lw=0.9, ls=":", zorder=3)
        axes.annotate("power cut", (day, 1.0), xytext=(3, -4), rotation=90, va="top", **over)
    changes = np.flatnonzero([a != b for a, b in zip(curve.levels, curve.levels[1:], strict=False)]) + 1
    named = set[str]()
    for first, last in zip([0, *changes], [*changes, len(at)], strict=True):
        level, end = curve.levels[first], days if last == len(at) else at[last]
        band.axvspan(at[first], end, color=_LEVELS[level], lw=0, label=None if level in named else level)
        named.add(level)
    band.set_yticks([])
    band.set_ylabel("level", rotation=0, ha="right", va="center")
    band.set_xlabel("days since the mission began")
    band.set_xlim(0, days)
    figure.suptitle(content["mission"], x=0.01, ha="left", fontsize=12)
    figure.legend(loc="outside lower center", ncols=5, fontsize=8.5, frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()
