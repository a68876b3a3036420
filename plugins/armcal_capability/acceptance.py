"""``armcal acceptance``: how accurate and repeatable an arm is, by the terms of ISO 9283 [ISO9283].

Accuracy is how far the barycentre of what was attained is from what was commanded, repeatability how far single visits
are from that barycentre. Orientations are rotation vectors of the turn from the commanded to
the attained orientation, in the axes of the frame: to first order the standard's angles a, b, c about x, y, z.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import click
import numpy as np
from armcal.base.arrays import Array
from armcal.base.config_text import as_json
from armcal.cli.common import FILE, Console, accept, command_line, overrides, speaking
from armcal.estimate.prediction import RADIUS_LEVEL, Spread, quantile
from armcal.io.cells import csv_text
from armcal.io.folder import reserved
from armcal.report.numbers import decimals_for
from armcal.report.page import rendered
from armcal.report.tables import TextTable
from armcal.version import __version__
from scipy.stats import chi2

from armcal_capability.visits import (
    FEWEST,
    FRAMES,
    ArmToJudge,
    Comparison,
    FrameChoice,
    Group,
    Visits,
    compare,
    read_visits,
)

OURS = ("acceptance.html", "acceptance.json", "acceptance.csv")
ISO_CYCLES = 30
"""Visits to a pose that the standard asks for."""
_SECTIONS = {
    "poses": ("Poses: accuracy AP and repeatability RP, position (mm) and orientation (deg)", ("Pose", "Direction")),
    "distances": ("Pairs of poses: distance accuracy AD and repeatability RD (mm)", ("From", "To")),
    "directions": ("Several directions of approach: variation of accuracy vAP (mm)", ("Pose", "Directions")),
}
_BY_AXIS = ("AP_x_mm", "AP_y_mm", "AP_z_mm")
"""In the files, not in tables."""
_LARGEST, _MUCH = 1e4, 0.3
_MOST_ROWS = 40
"""Of a table on the screen and the page; the CSV has all."""
_COMMANDED = {
    "nominal": "the nominal arm at the commanded joint positions",
    "calibrated": "the calibrated arm at the same positions",
}
_MM = 1000.0
_TIMES = 3.0
"""Standard deviations that a repeatability counts."""
_MOST_PAIRED = 10
"""Poses of which all pairs are taken; of more, each with the next."""
_DRAWS, _FEWEST_DRAWS, _MOST_NUMBERS, _SEED = 2000, 200, 1_000_000, 9283
_LOW, _HIGH = (1 - RADIUS_LEVEL) / 2, (1 + RADIUS_LEVEL) / 2


@dataclass(frozen=True)
class Figure:
    """An estimate and its 95 % interval, in one unit (``high`` may be infinite)."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Row:
    """One figure of a pose by a direction, of two poses, or of a pose by several directions."""

    section: str  # poses, distances or directions
    names: tuple[str, str]
    cycles: int
    model: str  # nominal or calibrated; measured where no model has a part in it
    name: str  # with its unit: AP_mm
    figure: Figure


@click.command()
@click.argument("source", metavar="CALIBRATION|CONFIG", type=FILE)
@click.argument("records", type=FILE)
@click.option("--out", required=True, type=FILE, help="Where the results go.")
@click.option("--settings", type=FILE, help="A configuration whose section data says how RECORDS are read.")
@click.option(
    "--frame",
    type=click.Choice(FRAMES),
    default="auto",
    show_default=True,
    help="Where the instrument and the target are: as stated, found from RECORDS, or found where they are free.",
)
@accept
@overrides
@speaking
def acceptance(console: Console, source: Path, records: Path, out: Path, frame: FrameChoice, **given: Any) -> None:
    """Judge an arm by the terms of ISO 9283 from RECORDS of poses that were visited again and again.

    A calibration is set beside its nominal arm; a configuration is judged as its nominal arm.
    """
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    registry = console.registry()
    subject = ArmToJudge.load(source, given["settings"], given["overrides"], records, registry, given["accept"])
    visits = read_visits(subject, registry, records)
    comparisons = {model: compare(subject, model, visits, frame) for model in subject.models}
    rows = list(assess(visits, comparisons))
    warnings = [*visits.warnings, *(f"{model}: {text}" for model, c in comparisons.items() for text in c.warnings)]
    if subject.trained_on and visits.dataset.sha256 == subject.trained_on:
        warnings.append("the calibration was fitted to these very records: measure others to judge it by.")
    noise = next(iter(subject.system.measurements.values())).noise()
    content = _content(rows, visits, comparisons, repeatability_of(_MM * np.array(noise[:3])), warnings)
    texts, tables = _sentences(content, source.name), list(_tables(rows))
    facts = {"command": command_line(), "files": f"{source}, {records}", "sha256 of the records": visits.dataset.sha256}
    shown = [*texts, *(text[:1].upper() + text[1:] for text in warnings)]
    page = {"title": source.name, "sentences": shown, "tables": tables, "facts": facts, "version": __version__}
    lines = [
        (r.section, *r.names, r.cycles, r.model, r.name, r.figure.value, r.figure.low, r.figure.high) for r in rows
    ]
    headings = ("section", "of", "with", "cycles", "model", "figure", "value", "low_95", "high_95")
    figures = [dict(zip(headings, line, strict=True)) for line in lines]
    kept.place(
        {
            "acceptance.csv": csv_text([headings, *lines], ".6g"),
            "acceptance.json": as_json({"source": str(source), **content, "figures": figures}) + "\n",
            "acceptance.html": rendered("acceptance.html.j2", page, Path(__file__).parent),
        }
    )
    console.result({**content, "folder": str(out)})
    for table in tables:
        console.table(table.caption, [words for words, _ in table.headings], table.rows, left=("To", "Direction"))
    for text in warnings:
        console.warn(text)
    for text in texts:
        console.line(text)
    console.line(f"page: {out / 'acceptance.html'}")


def _content(
    rows: Sequence[Row], visits: Visits, comparisons: Mapping[str, Comparison], noise: float, warnings: Sequence[str]
) -> dict[str, Any]:
    """What the figures come to, in mm and deg; ``noise`` is the RP (mm) that the declared noise makes alone."""

    def ends(model: str, name: str) -> dict[str, float] | None:
        values = np.abs([row.figure.value for row in rows if (row.model, row.name) == (model, name)])
        return {"mean": float(np.mean(values)), "most": float(np.max(values))} if len(values) else None

    names = [row.name for row in rows if row.model != "measured" and row.name not in _BY_AXIS]
    sizes = [len(group.members) for group in visits.groups]
    return {
        "records": len(visits.dataset),
        "poses": len(visits.poses),
        "cycles": {"least": min(sizes), "most": max(sizes)},
        "commanded": {m: _COMMANDED[m] for m in comparisons},
        "frames": {m: {"words": c.words, "numbers_found": c.fitted} for m, c in comparisons.items()},
        "summary": {m: {name: ends(m, name) for name in dict.fromkeys(names)} for m in comparisons},
        "repeatability_mm": ends("measured", "RP_mm"),
        "of_instrument_mm": noise,
        "warnings": list(warnings),
    }


def _sentences(content: Mapping[str, Any], name: str) -> list[str]:
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


def _tables(rows: Sequence[Row]) -> Iterator[TextTable]:
    """A table a section: a row a pose or pair, a column a figure."""

    def shown_figure(figure: Figure) -> str:
        decimals = min(decimals_for(max(figure.value - figure.low, abs(figure.value) / 100)), 4)
        high = f"{figure.high:.{decimals}f}" if figure.high < _LARGEST else "?"
        return f"{figure.value:.{decimals}f} ({figure.low:.{decimals}f} to {high})"

    for section, (caption, names) in _SECTIONS.items():
        members: dict[tuple[str, str], list[Row]] = {}
        for row in rows:
            if row.section == section and row.name not in _BY_AXIS:
                members.setdefault(row.names, []).append(row)
        if not members:
            continue
        more = f"; the first {_MOST_ROWS} of {len(members)}" if len(members) > _MOST_ROWS else ""
        shown = [i for i in range(2) if any(own[i] for own in members)]
        headings = [(names[i], False) for i in shown] + [("Cycles", True)]
        for row in next(iter(members.values())):
            words, _, unit = row.name.rpartition("_")
            headings.append((f"{words.replace('_', ' ')} {row.model}".removesuffix(" measured") + f", {unit}", True))
        cells = [
            (*(own[i] for i in shown), str(figures[0].cycles), *(shown_figure(row.figure) for row in figures))
            for own, figures in list(members.items())[:_MOST_ROWS]
        ]
        yield TextTable(f"{caption}, 95 % intervals{more}", tuple(headings), tuple(cells))


def assess(visits: Visits, comparisons: Mapping[str, Comparison]) -> Iterator[Row]:
    """All figures: of each pose AP and RP, of pairs of poses AD and RD, of poses by several directions vAP."""
    first, of_pose = next(iter(comparisons.values())), dict[str, list[Group]]()
    attained, turned = _MM * first.attained, first.turns
    for group in visits.groups:
        of_pose.setdefault(group.pose, []).append(group)
        start, own = ("poses", (group.pose, group.direction), len(group.members)), group.members
        for model, comparison in comparisons.items():
            errors = _MM * (comparison.attained - comparison.commanded)[own]
            yield Row(*start, model, "AP_mm", accuracy(errors))
            for axis, along in zip("xyz", errors.T, strict=True):
                yield Row(*start, model, f"AP_{axis}_mm", mean_figure(along))
            for axis, turns in zip("abc", () if comparison.turns is None else comparison.turns[own].T, strict=False):
                yield Row(*start, model, f"AP_{axis}_deg", mean_figure(np.degrees(turns)))
        yield Row(*start, "measured", "RP_mm", repeatability(attained[own]))
        for axis, turns in zip("abc", () if turned is None else turned[own].T, strict=False):
            yield Row(*start, "measured", f"RP_{axis}_deg", spread_figure(np.degrees(turns)))
    # Pairs are of the visits in the same cycle.
    main = {pose: max(groups, key=lambda group: len(group.members)).members for pose, groups in of_pose.items()}
    for names in combinations(main, 2) if len(main) <= _MOST_PAIRED else pairwise(main):
        one, other = (main[name] for name in names)
        _, at_one, at_other = np.intersect1d(visits.cycles[one], visits.cycles[other], return_indices=True)
        one, other = one[at_one], other[at_other]
        if len(one) < FEWEST:
            continue
        apart = np.linalg.norm(attained[one] - attained[other], axis=1)
        for model, comparison in comparisons.items():
            commanded = _MM * np.linalg.norm(comparison.commanded[one] - comparison.commanded[other], axis=1)
            yield Row("distances", names, len(one), model, "AD_mm", mean_figure(apart - commanded))
        yield Row("distances", names, len(one), "measured", "RD_mm", spread_figure(apart))
    for pose, groups in of_pose.items():
        if len(groups) > 1:
            pairs = combinations([attained[group.members] for group in groups], 2)
            widest = max((barycentres_apart(*pair) for pair in pairs), key=lambda figure: figure.value)
            names, cycles = (pose, ", ".join(g.direction for g in groups)), min(len(g.members) for g in groups)
            yield Row("directions", names, cycles, "measured", "vAP_mm", widest)


def accuracy(errors: Array) -> Figure:
    """AP of one pose from attained minus commanded positions (n x 3): the length of their mean.

    The length of the true mean differs from that of the estimated one by no more than these differ: the interval is
    the radius that holds the mean with 95 %, to either side, and rather too wide than too narrow.
    """
    return _about(float(np.linalg.norm(errors.mean(axis=0))), np.cov(errors.T) / len(errors), len(errors) - 1)


def barycentres_apart(first: Array, second: Array) -> Figure:
    """Of two groups (n x 3 each): of two directions, their part of vAP."""
    size = float(np.linalg.norm(first.mean(axis=0) - second.mean(axis=0)))
    covariance = np.cov(first.T) / len(first) + np.cov(second.T) / len(second)
    return _about(size, covariance, min(len(first), len(second)) - 1)


def repeatability(positions: Array) -> Figure:
    """RP of one pose (n x 3): mean and three standard deviations of the distances from the barycentre.

    The interval is a parametric bootstrap: how a repeatability from n visits varies about the true one where positions
    are normal, with the covariance found. Of few visits it is wide, and lies above the estimate, which is then small.
    """
    estimate, count = float(_repeatability(positions[None])[0]), len(positions)
    values = np.linalg.eigvalsh(np.cov(positions.T))
    draws = max(_FEWEST_DRAWS, min(_DRAWS, _MOST_NUMBERS // count))
    random = np.random.default_rng(_SEED).standard_normal((draws, count, 3))
    drawn = random * np.sqrt(np.maximum(values, 0.0))
    far = np.linalg.norm(drawn, axis=2)
    true = float(far.mean() + _TIMES * far.std())
    if true == 0.0:
        return Figure(estimate, estimate, estimate)
    low, high = np.quantile(_repeatability(drawn) / true, [_LOW, _HIGH])
    return Figure(estimate, estimate / float(high), estimate / float(low) if low > 0 else np.inf)


def repeatability_of(deviations: Array) -> float:
    """RP of normal noise with these standard deviations along x, y and z (3)."""
    far = np.linalg.norm(np.random.default_rng(_SEED).standard_normal((_MOST_NUMBERS, 3)) * deviations, axis=1)
    return float(far.mean() + _TIMES * far.std())


def mean_figure(values: Array) -> Figure:
    mean = float(np.mean(values))
    half = float(quantile(RADIUS_LEVEL, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))
    return Figure(mean, mean - half, mean + half)


def spread_figure(values: Array) -> Figure:
    """Three standard deviations."""
    size, freedom = _TIMES * float(np.std(values, ddof=1)), len(values) - 1
    low, high = (np.sqrt(freedom / chi2.ppf(share, freedom)) for share in (_HIGH, _LOW))
    return Figure(size, size * float(low), size * float(high))


def _repeatability(positions: Array) -> Array:
    """Of many groups (m x n x 3)."""
    far = np.linalg.norm(positions - positions.mean(axis=1, keepdims=True), axis=2)
    return np.asarray(far.mean(axis=1) + _TIMES * far.std(axis=1, ddof=1))


def _about(size: float, covariance: Array, freedom: int) -> Figure:
    """A length with the radius that holds its vector with 95 %, from the covariance of this."""
    radius = float(Spread(covariance[None], freedom).radius(RADIUS_LEVEL)[0]) if np.trace(covariance) > 0 else 0.0
    return Figure(size, max(size - radius, 0.0), size + radius)
