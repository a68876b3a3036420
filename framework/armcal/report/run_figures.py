"""Figures of a run: errors over the workspace, before and after, against joints, in order, inside intervals."""

import numpy as np
from scipy.special import gamma, gammainc

from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.units import shown_unit
from armcal.diagnose import outliers
from armcal.estimate.estimator import Estimate
from armcal.report.document import Figure, Marks, Panel
from armcal.report.numbers import count, plural, significant
from armcal.run.result import RunResult

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
    noise, errors = result.fit.of(outliers.noise_of) if result.fit.converged else None, result.errors
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
    """Errors of the nominal and of the calibrated arm over the workspace, by one scale; None without positions."""
    errors, position = result.errors, result.errors.position_mm
    unit, panels = errors.unit, list[Panel]()
    shown = {"nominal": errors.nominal_mm, "calibrated": errors.calibrated_mm}
    shown = {name: own for name, own in shown.items() if np.isfinite(own).any()}
    if position.shape[0] < 3 or not shown:
        return None
    places = np.flatnonzero(np.isfinite([*position[:3], *shown.values()]).all(axis=0))
    if not len(places):
        return None
    ends = _levels(np.concatenate([own[places] for own in shown.values()]))
    chosen = _thinned(next(reversed(shown.values())), places)
    box, flat = _box(position[:3, places]), _projected(position[:3, chosen])
    small = " small" if len(chosen) > 600 else ""
    for name, own in shown.items():
        level = np.clip(np.searchsorted(ends, own[chosen]), 0, _LEVELS - 1)
        marks = [Marks(f"dot{small} l{i}", flat[:, level == i], name=_range(ends, i, unit)) for i in range(_LEVELS)]
        panels.append(Panel(name, (*box, *marks), equal=True, bare=True))
    said = "; ".join(f"{n}: median {significant(float(np.median(own[places])))} {unit}" for n, own in shown.items())
    spans = [
        f"{axis} {low:.0f} to {high:.0f}" for axis, low, high in zip("xyz", *_span(position[:3, places]), strict=True)
    ]
    caption = f"Places of the tip, {', '.join(spans)} mm, and the error of each record, {unit}, by one scale."
    caption += drawn_of(len(chosen), len(places))
    return Figure("Error by place", f"{plural(len(places), 'tip position')}; {said}.", caption, panels)


def _levels(numbers: Array) -> Array:
    """Bounds of the colours, evenly in the logarithm."""
    some = numbers[numbers > 0]
    low, high = (np.percentile(some, p) for p in (2, 98)) if len(some) else (0.1, 1.0)
    return np.asarray(np.geomspace(low, max(high, 1.2 * low), _LEVELS + 1)[1:-1])


def _range(ends: Array, level: int, unit: str) -> str:
    if level == 0:
        return f"below {significant(float(ends[0]), 2)} {unit}"
    if level == _LEVELS - 1:
        return f"above {significant(float(ends[-1]), 2)} {unit}"
    return f"to {significant(float(ends[level]), 2)}"


def _projected(places: Array) -> Array:
    """Places (3 x N) as seen from above at an angle (2 x N)."""
    turn, lift = np.radians(-60.0), np.radians(24.0)
    towards = np.cos(turn) * places[0] + np.sin(turn) * places[1]
    across = np.cos(turn) * places[1] - np.sin(turn) * places[0]
    return np.array([across, np.cos(lift) * places[2] - np.sin(lift) * towards])


def _span(places: Array) -> tuple[Array, Array]:
    return places.min(axis=1), np.maximum(places.max(axis=1), places.min(axis=1) + 1.0)


def _box(places: Array) -> list[Marks]:
    """The edges of the box that holds the places, and the names of its axes, outside of it."""
    low, high = _span(places)
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
    """Share of records below each error, nominal and calibrated, and what noise alone does; None without records."""
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
    """What was added to each parameter, with its 95 % interval: a panel a unit."""
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
    """Residuals against what each joint was commanded; None where none moved."""
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
    """Calibrated error of each record in recorded order; None without records."""
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
