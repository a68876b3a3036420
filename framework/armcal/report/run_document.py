"""What a run says, as a document: the picture, the headline, what to do, and what each of it rests on."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from scipy.special import gamma, gammainc

from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.domains import Semidefinite, symmetric
from armcal.base.units import readable, shown_unit
from armcal.diagnose import record_checks
from armcal.diagnose.checks import Finding
from armcal.diagnose.record_checks import large_errors
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import (
    CORRELATED,
    DETERMINED_BY,
    bound_together,
    correlated_pairs,
    correlations,
    determined_in_words,
)
from armcal.estimate.validation import Bootstrap, ErrorSummary
from armcal.plugins import PluginRegistry, said
from armcal.report.document import Code, Document, Figure, Level, Marks, Panel, Part, Section, Table
from armcal.report.numbers import NONE, common_decimals, count, decimals_for, fixed, plural, significant
from armcal.run.result import ErrorTable, RunResult, metrics

_STRONGEST = 20


class SectionMaker(Protocol):
    """A function of a run's ``armcal.RunResult`` (SI and radians) that gives an ``armcal.ReportSection(title, html)``.

    It gives None where it has nothing to say of the run. What it raises costs nobody the report: a warning stands in
    the section's place. ``html`` needs no other file and no script, since the page must open offline.
    """

    def __call__(self, result: RunResult) -> Section | None:
        """The section of this run, if there is one."""


def plugin_sections(result: RunResult, registry: PluginRegistry) -> tuple[list[Section], list[str]]:
    sections, faults = list[Section](), list[str]()
    for name in sorted({c.name for c in registry.components if c.kind == "report_section"}):
        try:
            content = registry.find("report_section", name).load()(result)
            if content is not None and not isinstance(content, Section):
                raise TypeError(f"found {type(content).__name__}, expected an armcal.ReportSection or None")
        except Exception as fault:  # a plugin may fail in any way, and must not cost anybody a calibration
            faults.append(f"the report section {name!r} failed: {said(fault)}")
            sections.append(Section(name, parts=[Finding("warning", faults[-1], "")], name=f"plugin-{name}"))
        else:
            if content is not None:
                sections.append(replace(content, name=f"plugin-{name}"))
    return sections, faults


def run_document(result: RunResult, sections: Sequence[Section] = ()) -> Document:
    findings, warnings = result.verdict.findings, tuple(dict.fromkeys((*result.warnings, *result.dataset.warnings)))
    urgent = [finding for finding in findings if finding.grade in ("bad", "warning")]
    notes = [finding for finding in findings if finding.grade == "note"]
    passed = [finding for finding in findings if finding.grade == "good"]
    grade = next((g for g in ("bad", "warning") if g in {f.grade for f in findings}), "good" if findings else "note")
    verdict = result.verdict
    summary: list[Part] = list(filter(None, ("" if verdict.bad else verdict.claim, verdict.next_poses)))
    if findings and not urgent:
        summary.append("No warning: the calibration can be used.")
    errors = result.errors.calibrated_mm
    worst = np.argsort(-np.where(np.isnan(errors), np.inf, errors), kind="stable")[:_WORST].astype(np.intp)
    large = worst_table(result, worst) if len(worst) else None
    own = [
        *_accuracy(result),
        *_parameters(result),
        Section("What was learned beside the model", parts=_some(moved_table(result)), name="pose-residual"),
        Section("Where residuals come from", parts=_some(against_joints(result)), name="joints"),
        Section("Record by record", parts=_some(in_order(result, worst)), name="records"),
        Section("Largest errors", parts=_some(large), name="worst", folded=True),
        Section("Notes", parts=notes, name="notes", level="verbose"),
        Section(f"{plural(len(passed), 'check')} passed", parts=passed, name="passed", folded=True, level="verbose"),
        _determined(result.estimate),
        Section(
            "Warnings of the data and the configuration",
            parts=[Finding("warning", text) for text in warnings],
            name="warnings",
        ),
        Section("Suspicious records", parts=_some(suspicious_table(result)), name="suspicious", level="verbose"),
        Section("Variance components", parts=_some(scatter_table(result)), name="components"),
        Section("Records set aside", parts=_some(aside_table(result)), name="data", level="verbose"),
        *sections,
        _origin(result),
    ]
    return Document(
        f"Calibration report: {result.name}",
        " ".join(filter(None, (result.verdict.headline, noise_text(result)))),
        [section for section in own if section.parts or section.html],
        grade,
        [*summary, *urgent],
        in_space(result) or distribution(result),
        metrics(result),
    )


def noise_text(result: RunResult) -> str:
    noise, errors = noise_of(result), result.errors
    _, holdout = roles(result)
    crossed = np.isfinite(errors.cross_validated_mm)
    own = holdout if holdout.any() else crossed
    judged = np.where(holdout, errors.calibrated_mm, errors.cross_validated_mm)[own]
    if noise is None or not len(judged) or not np.isfinite(judged).all():
        return ""
    measured, stated = float(np.mean(judged)), mean_noise(noise[0][own], noise[1])
    names = " and ".join(result.system.measurements) or "the instrument"
    if stated >= measured:
        return f"The noise stated for {names} alone makes {readable(stated)} {errors.unit}."
    return f"Of {readable(measured)} {errors.unit}, {readable(stated)} {errors.unit} is the noise stated for {names}."


def _accuracy(result: RunResult) -> list[Section]:
    unit, split = result.errors.unit, result.split
    held = (
        f"{plural(len(split.holdout), 'record')} held out to judge" if len(split.holdout) else "none held out to judge"
    )
    if np.isfinite(result.errors.cross_validated_mm).any():
        held += "; each training record also judged by cross-validation"
    elif not len(split.holdout):
        held += ", so that these numbers flatter the model"
    free = plural(len(result.estimate.sources), "free parameter")
    words = f"{free} found from {plural(len(split.train), 'training record')}; {held}."
    shown: list[Part] = []
    if any(own.count for own in result.table.calibrated.values()):
        shown.append(errors_table(f"{result.errors.name} error, {unit}: {result.name}", result.table))
    if result.table.turns is not None:
        what = "Orientation" if result.errors.name == "Tip" else "Angle"
        shown.append(errors_table(f"{what} error, deg: {result.name}", result.table.turns))
    groups = [groups_table(result.groups, unit)] if result.groups else []
    curve = [figure for figure in (distribution(result),) if figure]
    return [
        Section("Errors before and after", parts=[*shown, words, *curve], name="accuracy", level="always"),
        Section("By group", parts=groups, name="groups", level="always"),
    ]


def _parameters(result: RunResult) -> list[Section]:
    estimate, count_free = result.estimate, len(result.estimate.sources)
    if not count_free:
        text = "No parameter was free: the model stands as it was given."
        return [Section("Parameters", parts=[text], name="parameters")]
    table = parameters_table(estimate, result.bootstrap)
    listed, title = _some(table, principal_table(estimate)), f"Table of {plural(count_free, 'free parameter')}"
    level: Level = "verbose" if result.bootstrap is None else "always"
    return [
        Section("What was corrected", parts=_some(corrections(estimate)), name="corrections"),
        Section(title, parts=listed, name="parameters", folded=True, level=level),
    ]


def _some(*parts: Part | None) -> list[Part]:
    return [part for part in parts if part is not None]


def _determined(estimate: Estimate) -> Section:
    known, names = estimate.identifiability, estimate.names
    parts: list[Part] = [f"{determined_in_words(estimate.sources)}."]
    parts += [f"The data does not determine a combination: {combination}." for combination in known.undetermined]
    if known.rank:
        parts.append(f"Least determined: {known.weakest}. Scaled condition {significant(known.condition)}.")
    if len(names) > 1:
        with np.errstate(invalid="ignore"):
            matrix = correlations(estimate.covariance)
        known_sd = np.isfinite(estimate.deviations)
        matrix = np.where(np.outer(known_sd, known_sd), matrix, 0.0)
        pairs = correlated_pairs(matrix, names, CORRELATED, bound_together(estimate.parameters))
        # The strongest pairs whatever their size, zeros left out.
        rows, columns = np.triu_indices(len(names), 1)
        order = np.argsort(-np.abs(matrix[rows, columns]), kind="stable")[:_STRONGEST]
        ends = [(names[rows[k]], names[columns[k]], float(matrix[rows[k], columns[k]])) for k in order]
        others = [(a, b, r) for a, b, r in ends if r and (a, b) not in {(c, d) for c, d, _ in pairs}]
        shown = [(a, b, fixed(r, 3, signed=True)) for a, b, r in (*pairs[:MOST_LISTED], *others)]
        caption = f"Pairs that correlate by more than {CORRELATED:g} ({count(len(pairs))}), then the strongest others"
        parts.append(Table(caption, ("Parameter", "Parameter", "Correlation"), shown, left=("Parameter",)))
    return Section("What the data do not tell apart", parts=parts, name="determined", folded=not known.undetermined)


def _origin(result: RunResult) -> Section:
    solver, data, estimate = result.estimate.verdict, result.dataset, result.estimate
    answer = "converged" if solver.converged else "did not converge"
    effort = f"{plural(solver.iterations, 'iteration')}, {solver.seconds:.2f} s"
    starts = f"{solver.agreeing_starts} of {solver.starts} came to the same answer" if solver.starts > 1 else "one"
    facts: list[tuple[str, Any]] = [
        ("data", data.source or NONE),
        ("data sha256", data.sha256 or NONE),
        ("records", f"{len(result.split.train)} training, {len(result.split.holdout)} held out"),
        ("solver", f"{solver.name}: {solver.status} ({answer}; {effort})"),
        ("starts", starts),
        ("backend", result.backend or NONE),
        ("noise scale", f"{significant(estimate.noise_scale)} times the declared noise"),
        ("degrees of freedom", significant(estimate.degrees_of_freedom, 4)),
    ]
    names = {name for name, _ in facts}
    facts += [fact for fact in provenance_facts(result.provenance) if fact[0] not in names]
    seconds = sorted(result.seconds.items(), key=lambda stage: stage[0] == "total")
    parts: list[Part] = [Code(result.command), Table("Provenance", ("What", "Value"), facts, left=("Value",))]
    parts.append(Table("Time taken", ("Stage", "Time"), [(name, f"{took:.2f} s") for name, took in seconds]))
    return Section("How to reproduce this", parts=parts, name="reproduce", folded=True)


MOST_POINTS = 3000  # of a panel; more are thinned out
_OF_JOINTS = 400
_CURVE_POINTS = 240
_LOG_FROM = 6.0
_OUTLIER = 4.0
_LEVELS = 7
_MOST_BARS, _MOST_JOINTS = 30, 14
_AXES = ("dot small", "dot small second", "dot small third")


def noise_of(result: RunResult) -> tuple[Array, float] | None:
    """How far the stated noise puts each record off (root mean square, N), and of how many numbers that is.

    None of images and of several measurements, whose errors are means over more numbers than a position has.
    """
    noise, errors = result.fit.of(record_checks.noise_of) if result.fit.converged else None, result.errors
    rows = sum(name.endswith(f"_{errors.unit}") for name in errors.residual_columns)
    return (1000 * noise[0], noise[1]) if noise is not None and rows <= 3 else None


def mean_noise(sizes: Array, numbers: float) -> float:
    """Mean distance of normal noise of so many numbers with these root mean squares."""
    share = np.sqrt(2 / numbers) * gamma((numbers + 1) / 2) / gamma(numbers / 2)
    return float(share * np.mean(sizes))


def roles(result: RunResult) -> tuple[Mask, Mask]:
    train, holdout = (np.zeros(len(result.dataset), dtype=bool) for _ in range(2))
    train[result.split.train] = True
    holdout[result.split.holdout] = True
    return train, holdout


def in_space(result: RunResult) -> Figure | None:
    errors, position = result.errors, result.errors.position_mm
    unit, panels = errors.unit, list[Panel]()
    shown = {"nominal": errors.nominal_mm, "calibrated": errors.calibrated_mm}
    shown = {name: own for name, own in shown.items() if np.isfinite(own).any()}
    if position.shape[0] < 3 or not shown:
        return None
    places = np.flatnonzero(np.isfinite([*position[:3], *shown.values()]).all(axis=0))
    if not len(places):
        return None
    # Bounds of the colours, evenly in the logarithm.
    some = np.concatenate([own[places] for own in shown.values()])
    low, high = (np.percentile(some[some > 0], p) for p in (2, 98)) if (some > 0).any() else (0.1, 1.0)
    ends = np.geomspace(low, max(high, 1.2 * low), _LEVELS + 1)[1:-1]
    chosen = _thinned(next(reversed(shown.values())), places)
    box, flat = _box(position[:3, places]), _projected(position[:3, chosen])
    small, bounds = " small" if len(chosen) > 600 else "", [significant(float(end), 2) for end in ends]
    names = [f"below {bounds[0]} {unit}", *(f"to {bound}" for bound in bounds[1:]), f"above {bounds[-1]} {unit}"]
    for name, own in shown.items():
        level = np.clip(np.searchsorted(ends, own[chosen]), 0, _LEVELS - 1)
        marks = [Marks(f"dot{small} l{i}", flat[:, level == i], name=names[i]) for i in range(_LEVELS)]
        panels.append(Panel(name, (*box, *marks), equal=True, bare=True))
    said = "; ".join(f"{n}: median {significant(float(np.median(own[places])))} {unit}" for n, own in shown.items())
    spans = [
        f"{axis} {low:.0f} to {high:.0f}"
        for axis, low, high in zip("xyz", *_ends_of(position[:3, places]), strict=True)
    ]
    caption = f"Places of the tip, {', '.join(spans)} mm, and the error of each record, {unit}, by one scale."
    caption += drawn_of(len(chosen), len(places))
    return Figure("Error by place", f"{plural(len(places), 'tip position')}; {said}.", caption, panels)


def _projected(places: Array) -> Array:
    """Places (3 x N) as seen from above at an angle (2 x N)."""
    turn, lift = np.radians(-60.0), np.radians(24.0)
    towards = np.cos(turn) * places[0] + np.sin(turn) * places[1]
    across = np.cos(turn) * places[1] - np.sin(turn) * places[0]
    return np.array([across, np.cos(lift) * places[2] - np.sin(lift) * towards])


def _ends_of(places: Array) -> tuple[Array, Array]:
    return places.min(axis=1), np.maximum(places.max(axis=1), places.min(axis=1) + 1.0)


def _box(places: Array) -> list[Marks]:
    low, high = _ends_of(places)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(corners[a] - corners[b]).sum() == 1]
    gap = np.full((1, 3), np.nan)
    edges = np.vstack([np.vstack([corners[a], corners[b], gap[0]]) for a, b in pairs])
    lines = _projected((low + edges * (high - low)).T)
    # The middles of the edges that end the picture below and to the right, and of the box.
    middles = np.array([[0.5, 0.0, 0.0], [1.0, 0.5, 0.0], [1.0, 1.0, 0.5], [0.5, 0.5, 0.5]])
    names = _projected((low + middles * (high - low)).T)
    names = names[:, 3:] + 1.15 * (names[:, :3] - names[:, 3:])
    return [Marks("box", lines), Marks("tick", names, texts="xyz")]


def distribution(result: RunResult) -> Figure | None:
    train, holdout = roles(result)
    errors = result.errors
    curves = {
        ("curve before", "nominal"): errors.nominal_mm,
        ("curve", "calibrated, training"): errors.calibrated_mm[train],
        ("curve holdout", "calibrated, held out"): errors.calibrated_mm[holdout],
        ("curve crossed", "calibrated, cross-validated"): errors.cross_validated_mm,
    }
    known = {key: own[np.isfinite(own)] for key, own in curves.items() if np.isfinite(own).any()}
    if not known:
        return None
    values = np.concatenate([*known.values()])
    medians = [float(np.median(own)) for own in known.values()]
    log = min(medians) > 0 and max(medians) / min(medians) > _LOG_FROM and float(values.min()) > 0
    low = max(float(np.percentile(values, 0.5)), float(values.max()) * 1e-6) * 0.8 if log else 0.0
    marks = [Marks(style, _steps(own, low), name=f"{name} ({count(len(own))})") for (style, name), own in known.items()]
    ends = np.array([low, float(values.max())])
    marks = [Marks("guide", (ends, np.full(2, share))) for share in (50.0, 95.0)] + marks
    if (noise := noise_of(result)) is not None:
        sizes, numbers = noise[0][:: max(1, len(noise[0]) // 500)], noise[1]
        x = np.geomspace(max(low, 1e-9), ends[1], 120) if log else np.linspace(0.0, ends[1], 120)
        shares = 100 * gammainc(numbers / 2, numbers * x[:, None] ** 2 / (2 * sizes**2)).mean(axis=1)
        marks.append(Marks("floor", (x, shares), name="stated noise alone"))
    pairs = zip(known, medians, strict=True)
    said = "; ".join(f"{name}: median {significant(middle)} {errors.unit}" for (_, name), middle in pairs)
    caption = "The further left a curve, the better; it cannot be left of what noise alone does for long."
    caption += " The error axis is logarithmic." if log else ""
    panel = Panel("", marks, f"error, {errors.unit}", "records below, %", log=log, low=0.0, high=100.0)
    return Figure("Share of records below each error", said, caption, [panel], columns=1)


def _steps(errors: Array, low: float) -> tuple[Array, Array]:
    ordered = np.sort(np.maximum(errors, low))
    if len(ordered) > _CURVE_POINTS:
        shares = np.linspace(0, 100, _CURVE_POINTS)
        return np.percentile(ordered, shares), shares
    return np.repeat(ordered, 2), np.repeat(np.arange(len(ordered) + 1) / len(ordered) * 100, 2)[1:-1]


def corrections(estimate: Estimate) -> Figure | None:
    nominal, rows = estimate.parameters.nominal(), dict[str, list[tuple[str, float, float, float]]]()
    entries = [(block, unit) for block in estimate.parameters.free for unit in block.entry_units]
    for i, (entry, (block, si)) in enumerate(zip(estimate.free_entries, entries, strict=True)):
        factor, unit = shown_unit(si)
        if block.nuisance or not unit:
            continue
        interval, before = estimate.intervals[i], nominal[entry]
        numbers = [factor * float(x - before) for x in (estimate.values[entry], interval.lower, interval.upper)]
        if np.isfinite(numbers[0]):
            rows.setdefault(unit, []).append((estimate.names[i], numbers[0], numbers[1], numbers[2]))
    panels = []
    for unit, own in rows.items():
        shown = sorted(sorted(own, key=lambda row: -abs(row[1]))[:_MOST_BARS], key=own.index)
        place, gap = np.arange(len(shown), dtype=float), np.full(len(shown), np.nan)
        values, lower, upper = (np.array([row[i] for row in shown]) for i in (1, 2, 3))
        lines = np.repeat(place, 3)
        marks = [
            Marks("bar", (np.stack([0 * values, values, gap]).T.ravel(), lines)),
            Marks("range", (np.stack([lower, upper, gap]).T.ravel(), lines)),
            Marks("dot", (values, place)),
        ]
        listed = "" if len(own) == len(shown) else f", the {len(shown)} largest of {len(own)}"
        names = [name for name, *_ in shown]
        panels.append(Panel(f"{unit}{listed}", marks, f"correction, {unit}", rows=names))
    said = f"Corrections of {plural(sum(map(len, rows.values())), 'parameter')}; the table has the numbers."
    caption = "Bar: calibrated minus nominal. Dark line: its 95 % interval; one that crosses zero may be no correction."
    return Figure("Corrections", said, caption, panels) if panels else None


def against_joints(result: RunResult) -> Figure | None:
    data, errors = result.dataset, result.errors
    residual = errors.calibrated_residual_mm
    own = [i for i, name in enumerate(errors.residual_columns) if name.endswith(f"_{errors.unit}")]
    by_axis = 0 < len(own) <= 3 and residual.shape[1] == len(data)
    names = [errors.residual_columns[i].removesuffix(f"_{errors.unit}") for i in own] if by_axis else ["error"]
    values = residual[own] if by_axis else errors.calibrated_mm[None]
    noise, panels = noise_of(result), []
    some = _thinned(errors.calibrated_mm, np.flatnonzero(np.isfinite(errors.calibrated_mm)), _OF_JOINTS)
    high = float(np.nanpercentile(np.abs(values[:, some]), 99)) if len(some) else 0.0
    for channel, dimension in command_channels(result.system.arms).items():
        joint = data.column(channel)[some] if data.has(channel) else np.zeros(0)
        if not len(joint) or not np.isfinite(joint).any() or np.nanmax(joint) - np.nanmin(joint) < 1e-9 or not high > 0:
            continue
        factor, unit = shown_unit("rad" if dimension == "angle" else "m")
        x, name = factor * joint, channel.partition(".")[2] if len(result.system.arms) == 1 else channel
        aside = 0.02 * float(np.nanmax(x) - np.nanmin(x))  # axes stand beside one another where a joint had few angles
        marks = [Marks(_AXES[i], (x + aside * (i - 1), row[some]), name=names[i]) for i, row in enumerate(values)]
        if noise is not None:
            reach = 2 * float(np.median(noise[0])) / np.sqrt(noise[1])
            ends = np.array([np.nanmin(x), np.nanmax(x)])
            floors = (-reach, reach) if by_axis else (float(np.sqrt(noise[1])) * reach / 2,)
            marks += [Marks("floor", (ends, np.full(2, level)), name="stated noise") for level in floors]
        low = -1.1 * high if by_axis else 0.0
        panels.append(Panel("", marks, f"{name}, {unit}", f"residual, {errors.unit}", low=low, high=1.1 * high))
    caption = "Residuals that follow a joint's angle have a cause that moves with it; noise does not. "
    caption += "Dashed: twice the standard deviation of the stated noise." if by_axis else "Dashed: the stated noise."
    caption += drawn_of(len(some), len(data))
    said = f"Residuals against {plural(len(panels), 'joint')}."
    return Figure("Residuals against each joint", said, caption, panels[:_MOST_JOINTS], columns=3) if panels else None


def in_order(result: RunResult, worst: Indices) -> Figure | None:
    errors, (train, holdout) = result.errors.calibrated_mm, roles(result)
    known = np.flatnonzero(np.isfinite(errors))
    if not len(known):
        return None
    ninety_five, largest = float(np.percentile(errors[known], 95)), float(errors[known].max())
    clipped = len(known) > 20 and largest > _OUTLIER * ninety_five > 0
    chosen, place = _thinned(errors, known), np.arange(1, len(errors) + 1, dtype=float)
    styles = (
        ("dot before", "not used", ~train & ~holdout),
        ("dot", "training", train),
        ("dot holdout", "held out", holdout),
    )
    ringed = worst[np.isfinite(errors[worst])]
    marks = [Marks("dot ring", (place[ringed], errors[ringed]), name="largest errors")]
    for style, name, own in styles:
        some = chosen[own[chosen]]
        marks += [Marks(style, (place[some], errors[some]), name=name)] if len(some) else []
    if len(known) == len(errors) >= 30:
        window = max(15, len(errors) // 12)
        starts = np.unique(np.linspace(0, len(errors) - window, _CURVE_POINTS).astype(np.intp))
        middle = np.array([np.median(errors[start : start + window]) for start in starts])
        marks.append(Marks("running", np.array([starts + (window + 1) / 2, middle]), name="running median"))
    ends = np.array([0.5, len(errors) + 0.5])
    if (noise := noise_of(result)) is not None:
        marks.append(Marks("floor", (ends, np.full(2, mean_noise(*noise))), name="stated noise, mean"))
    marks.append(Marks("guide", (ends, np.full(2, ninety_five)), name="95 % of records"))
    caption = "Where the running median wanders, the setup changed on the way." + drawn_of(len(chosen), len(known))
    caption += " Points on the upper edge lie beyond it." if clipped else ""
    said = f"{plural(len(errors), 'record')}; 95 % lie below {significant(ninety_five)} {result.errors.unit}, "
    said += f"all below {significant(largest)}."
    high = 2 * ninety_five if clipped else max(1.06 * largest, 1e-9)
    labels = ("record, in recorded order", f"calibrated error, {result.errors.unit}")
    panel = Panel("", marks, *labels, low=0.0, high=high)
    return Figure("Error of each record in recorded order", said, caption, [panel], columns=1)


def _thinned(numbers: Array, known: Indices, most: int = MOST_POINTS) -> Indices:
    """Of records, evenly through the recorded order, and those with the largest numbers in any case."""
    if len(known) <= most:
        return known
    worst = known[np.argsort(-numbers[known], kind="stable")[:50]]
    even = known[np.linspace(0, len(known) - 1, most - 50).astype(np.intp)]
    return np.unique(np.concatenate([even, worst]))


def drawn_of(chosen: int, total: int) -> str:
    if chosen == total:
        return ""
    return f" {count(chosen)} of {count(total)} drawn, evenly chosen, the 50 worst among them."


SETS = {"train": "training", "holdout": "held out", "cross_validated": "cross-validated"}
MOST_LISTED = 50  # of records set aside and of correlated pairs; the rest is counted
_WORST = 10


def errors_table(caption: str, errors: ErrorTable) -> Table:
    models = (("nominal", errors.nominal), ("calibrated", errors.calibrated), ("drift unknown", errors.at_rest))
    shown: list[tuple[str, str, ErrorSummary]] = []
    for key, words in SETS.items():
        if key in errors.calibrated and errors.calibrated[key].count:
            shown += [(words, model, own[key]) for model, own in models if key in own]
    decimals = common_decimals((x for _, _, s in shown for x in (s.mean, s.max)), most=3)
    rows = []
    for words, model, own in shown:
        first = (words, count(own.count)) if model == "nominal" else ("", "")
        rows.append((*first, model, *(fixed(x, decimals) for x in (own.mean, own.rms, own.p95, own.max))))
    strong = [i for i, (_, model, _) in enumerate(shown) if model == "calibrated"]
    headings = ("Records", "Count", "Arm", "Mean", "RMS", "95 %", "Max")
    return Table(caption, headings, rows, left=("Arm",), strong=strong)


def groups_table(groups: Mapping[str, Mapping[str, Any]], unit: str) -> Table:
    distances = any(group["distance_error_mm"] is not None for group in groups.values())
    shown = ["nominal_error_mm", "error_mm", *(["nominal_distance_error_mm", "distance_error_mm"] if distances else [])]
    decimals = common_decimals(group[key] for group in groups.values() for key in shown)
    rows = []
    for name, group in groups.items():
        part = "judged" if not group["trained"] else "trained" if group["trained"] == group["records"] else "both"
        rows.append((name, part, str(group["records"]), *(fixed(group[key], decimals) for key in shown)))
    headings = ["Group", "Part", "Records", "Nominal", "Calibrated"]
    headings += ["Distance, nominal", "Distance, calibrated"] if distances else []
    caption = f"By group, mean, {unit}: how far its records lie apart"
    caption += "; and how far known distances within it are missed" if distances else ""
    return Table(caption, headings, rows, left=("Part",))


def parameters_table(estimate: Estimate, bootstrap: Bootstrap | None = None) -> Table:
    """A row a free canonical entry in customary units, with its intervals by curvature and by refits."""
    nominal, rows = estimate.parameters.nominal(), list[tuple[str, ...]]()
    units = [unit for block in estimate.parameters.free for unit in block.entry_units]
    for i, (name, own) in enumerate(estimate.items()):
        factor, unit = shown_unit(units[i])
        numbers = (own.value, nominal[estimate.free_entries[i]], own.deviation)
        value, before, sd = (factor * float(number) for number in numbers)
        # Two digits of the standard deviation; five of the value where there is none, three decimals of a zero.
        size = sd if math.isfinite(sd) and sd > 0 else max(abs(value), abs(before)) / 1000
        digits = decimals_for(size) if size else 3
        spans = [(own.interval.lower, own.interval.upper), *([bootstrap.intervals[i]] if bootstrap is not None else [])]
        words = [" to ".join(fixed(factor * float(end), digits) for end in ends) for ends in spans]
        remarks = ["at its bound"] if name in estimate.at_bound else []
        remarks += [] if remarks else [f"{end} end at its bound" for end in own.interval.bounds]
        by = estimate.determined_by[i]
        remarks += [] if by == "data" else [DETERMINED_BY[by]]
        row = [name, *(fixed(x, digits) for x in (before, value)), fixed(value - before, digits, True)]
        row += [fixed(sd, digits), words[0] if math.isfinite(sd) else NONE]
        if bootstrap is not None:
            row += [fixed(factor * float(bootstrap.deviations[i]), digits), words[1]]
        rows.append((*row, unit, ", ".join(remarks)))
    headings = ["Parameter", "Nominal", "Calibrated", "Correction", "sd", "95 % interval"]
    headings += ["Bootstrap sd", "By bootstrap"] if bootstrap else []
    caption = "Free parameters, with standard deviation (sd) and 95 % intervals"
    if bootstrap is not None:
        failed = f", {bootstrap.failed} more did not converge" if bootstrap.failed else ""
        caption += f". Bootstrap: {len(bootstrap.values)} refits{failed}; blocks of {bootstrap.block}"
    return Table(caption, (*headings, "Unit", "Remark"), rows, ("Unit", "Remark"), ("Nominal", "Correction", "sd"))


def principal_table(estimate: Estimate) -> Table | None:
    factor, unit = shown_unit("rad_per_Nm")
    rows = []
    for block in estimate.parameters.free:
        if isinstance(block.domain, Semidefinite):
            sizes = np.linalg.eigvalsh(symmetric(estimate.values[estimate.parameters.entries_of(block.name)]))
            rows.append((block.name, *(significant(factor * max(size, 0.0)) for size in sizes)))
    return Table(f"Principal compliances, {unit}", ("Parameter", "Stiffest", "", "Softest"), rows) if rows else None


def worst_table(result: RunResult, worst: Indices) -> Table:
    errors, data, turns = result.errors, result.dataset, result.errors.turns
    train, holdout = set(result.split.train.tolist()), set(result.split.holdout.tolist())
    crossed = bool(np.isfinite(errors.cross_validated_mm).any())
    columns = {"Nominal": errors.nominal_mm, "Calibrated": errors.calibrated_mm}
    columns |= {"Cross-validated": errors.cross_validated_mm} if crossed else {}
    if turns is not None:
        columns |= {"Nominal, deg": turns.nominal_deg, "Calibrated, deg": turns.calibrated_deg}
        columns |= {"Cross-validated, deg": turns.cross_validated_deg} if crossed else {}
    decimals = {name: common_decimals(numbers[worst].tolist()) for name, numbers in columns.items()}
    missed = result.fit.of(large_errors)
    unusual = {miss.record_id: "; ".join(miss.reasons) for miss in missed.explained} if missed else {}
    rows = []
    for i in worst.tolist():
        role = "train" if i in train else "holdout" if i in holdout else "not used"
        numbers = (fixed(float(own[i]), decimals[name]) for name, own in columns.items())
        row = str(data.rows[i]) if data.rows else NONE
        rows.append((data.ids[i], row, role, *numbers, unusual.get(data.ids[i], "")))
    caption = f"The records with the largest calibrated error, {errors.unit}, and what is unusual where noise does not "
    caption += "explain it"
    headings = ("Record", "Source row", "Role", *columns, "What is unusual")
    return Table(caption, headings, rows, left=("Role", "What is unusual"))


def moved_table(result: RunResult) -> Table | None:
    outcome = result.pose_residual
    if outcome is None or outcome.moved is None:
        return None
    parts = {"altogether": outcome.moved.altogether, **outcome.moved.parts}
    numbers = {name: (1000 * float(own.mean()), 1000 * float(own.max())) for name, own in parts.items()}
    decimals = common_decimals((x for pair in numbers.values() for x in pair), most=3)
    rows = [(name, *(fixed(x, decimals) for x in pair)) for name, pair in numbers.items()]
    caption = "How far the pose residual moves the tool, mm: altogether, and by what it adds to the tool and each joint"
    return Table(caption, ("Part", "Mean", "Max"), rows, strong=(0,))


def suspicious_table(result: RunResult) -> Table | None:
    suspicious, unit, rows = result.suspicious, result.errors.unit, []
    for s in suspicious[:MOST_LISTED]:
        numbers = (fixed(s.deviations, 1), fixed(s.limit, 1), fixed(s.error_mm, 2))
        weight = "set aside" if s.weight == 0 else f"weight {s.weight:.2g}"
        rows.append((s.record_id, str(s.row or NONE), s.measurement, *numbers, weight))
    caption = f"{count(len(suspicious))} suspicious records, farther from the fit than noise allows (1 % over all"
    caption += f"); loss {result.noise['loss']}" + _more(len(suspicious), "in residuals.csv")
    headings = ("Record", "Source row", "Measurement", "Distance, sd", "Limit, sd", f"Error, {unit}", "In the fit")
    return Table(caption, headings, rows, left=("Measurement", "In the fit")) if rows else None


def aside_table(result: RunResult) -> Table | None:
    aside = result.dataset.set_aside
    rows = [(str(record.row), record.record_id, record.reason) for record in aside[:MOST_LISTED]]
    caption = f"{count(len(aside))} records set aside" + _more(len(aside))
    return Table(caption, ("Source row", "Record", "Why"), rows, left=("Record", "Why")) if rows else None


def _more(total: int, where: str = "") -> str:
    return f"; {count(total - MOST_LISTED)} more {where}".rstrip() if total > MOST_LISTED else ""


def scatter_table(result: RunResult) -> Table | None:
    rows: list[tuple[str, ...]] = []
    components = result.fit.fitted.components
    for c in sorted(components.components if components else (), key=lambda c: -c.share):
        factor, unit = {"rad": (180 / np.pi, "deg"), "m": (1000.0, "mm")}.get(c.unit, (1.0, "\u00d7 declared noise"))
        sd, lower, upper = (fixed(factor * x, 3) for x in (c.sd, c.lower, c.upper))
        rows.append((c.name, f"{100 * c.share:.1f} %", sd, unit, f"{lower} to {upper}", fixed(1000 * c.rms, 3)))
    caption = (
        "Estimated standard deviations (restricted maximum likelihood); a joint's is what acts like an angle error"
    )
    headings = ("Component", "Share", "sd", "Unit", "95 % interval", f"In a residual, {result.errors.unit}")
    return Table(caption, headings, rows, left=("Unit",)) if rows else None


def provenance_facts(provenance: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    facts: list[tuple[str, str]] = []
    for key, value in provenance.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            facts += provenance_facts(value, f"{name}: ")
        elif isinstance(value, (list, tuple)):
            facts.append((name, ", ".join(str(item) for item in value) or NONE))
        else:
            facts.append((name, NONE if value is None or value == "" else str(value)))
    return facts
