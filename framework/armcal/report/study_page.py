"""The page of a study: its tables and figures, what to conclude, and which records gain and lose."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from armcal.report import svg
from armcal.report.numbers import NONE, common_decimals, count, duration, fixed, plural, significant
from armcal.report.page import rendered
from armcal.report.svg import MONO, Axis, Box, Figure
from armcal.report.tables import TextTable, provenance_facts
from armcal.run.study_result import Cell, StudyResult, VariantResult
from armcal.version import __version__

PAGE_ONLY = ("Train 95 %", "RMS", "Max", "Fit", "Turn 95 %")
"""Columns of ``study_tables`` for which a terminal has no room."""
_SAME_MM = 1e-6
_FEW_GROUPS = 3
_ROW = 34.0
_LOG_FROM = 6.0
_DIAMOND = "m-4.2 0l4.2-4.2l4.2 4.2l-4.2 4.2z"


def render_study(result: StudyResult) -> str:
    """One self-contained HTML file."""
    title = f"{result.name}: {plural(len(result.variants), 'variant')}"
    content: dict[str, Any] = {
        "result": result,
        "title": title + (f", trained at one {result.group_by}, judged at another" if result.cells else ""),
        "sentences": conclusions(result),
        "tables": study_tables(result),
        "figures": [_by_group(result), _ladder(result)] if result.cells else [_ladder(result)],
        "changes": [(v.name, v.change) for v in result.variants if v.change],
        "version": __version__,
        "facts": [fact for fact in provenance_facts(result.provenance) if not fact.long],
        "seconds": [(name, duration(value)) for name, value in result.seconds.items()],
    }
    return rendered("study.html.j2", content)


def study_tables(result: StudyResult) -> list[TextTable]:
    """Errors by what was trained and judged at, where records are grouped; then the variants."""
    return [_cells(result), _variants(result)] if result.cells else [_variants(result)]


def conclusions(result: StudyResult) -> list[str]:
    best = result.variant(result.best)
    texts = _transfers(result)
    if len(result.variants) > 1 or not result.cells:
        texts.append(
            f"Lowest cross-validated error: {best.name}, {_shown(best.crossed.mean, result.unit)} on average, 95 % "
            f"below {_shown(best.crossed.p95, result.unit)}."
        )
    if result.simplest != result.best:
        simple = result.variant(result.simplest)
        texts.append(
            f"Simplest within one standard error of it: {simple.name}, {simple.free} free parameters, "
            f"{_shown(simple.crossed.mean, result.unit)}."
        )
    texts += _nested_words(result, best)
    for v in result.variants:
        if abs((v.at_rest.mean or 0.0) - (v.crossed.mean or 0.0)) > _SAME_MM:
            texts.append(
                f"{v.name} knows the drift at a record from the training records near it; without that, "
                f"{_shown(v.at_rest.mean, result.unit)} on average, 95 % below {_shown(v.at_rest.p95, result.unit)}."
            )
    compared = [v.change for v in result.variants if v.change]
    if compared:
        against = {c.against for c in compared}
        words = f"against {compared[0].against}" if len(against) == 1 else "against the variant before"
        blocks = sorted({c.block for c in compared})
        span = f"{blocks[0]}" if len(blocks) == 1 else f"{blocks[0]} to {blocks[-1]}"
        texts.append(
            f"Change: the mean difference of each record's error {words}, ± one standard error from blocks of {span} "
            "neighbouring records; fits are taken as given."
        )
    return texts


def _nested_words(result: StudyResult, best: VariantResult) -> list[str]:
    if result.nested is None:
        if len(result.variants) == 1:
            return []
        return ["The records that judge it also picked it; study.nested: true judges the choice itself."]
    chosen = result.nested.chosen
    listed = ", ".join(f"{name} in {chosen.count(name)}" for name in dict.fromkeys(chosen))
    return [
        "The choice itself, made inside each fold's training records and judged outside: "
        f"{_shown(result.nested.crossed.mean, result.unit)} on average, 95 % below "
        f"{_shown(result.nested.crossed.p95, result.unit)} (picked by the records that judge it: "
        f"{_shown(best.crossed.mean, result.unit)}). Chosen: {listed} of {result.folds} folds."
    ]


def _transfers(result: StudyResult) -> list[str]:
    """How much an error grows from the group that trained to another."""
    texts, several = [], len(result.groups) > _FEW_GROUPS
    for variant in result.variants:
        single = [c for c in result.cells if c.variant == variant.name and len(c.trained) == 1]
        own = {c.judged: c.errors.mean for c in single if c.seen}
        pairs = [(c, own[c.judged]) for c in single if not c.seen and c.errors.mean is not None]
        if several:  # the worst of many
            pairs = sorted(pairs, key=lambda pair: -(pair[0].errors.mean or 0.0))[:1]
        said = [
            f"{c.trained[0]} to {c.judged} {_shown(c.errors.mean, result.unit)}, against "
            f"{_shown(at_home, result.unit)} there"
            for c, at_home in pairs
        ]
        texts += [f"{variant.name}:{' at worst' if several else ''} from {'; from '.join(said)}."] if said else []
    return texts


def _variants(result: StudyResult) -> TextTable:
    rows = []
    for v in result.variants:
        moved = [NONE] * 3
        if v.change:
            spread = (fixed(v.change.mean, 3, signed=True), fixed(v.change.standard_error, 3))
            moved = [*spread, f"{v.change.helped:.0%}".replace("%", " %")]
        train = [fixed(x, 3) for x in (v.train.mean, v.train.p95)]
        judged = [fixed(x, 3) for x in (v.crossed.mean, v.crossed.rms, v.crossed.p95, v.crossed.max)]
        if v.failed_folds:  # over fewer records than the others
            judged = [f"({text})" for text in judged]
        turned = v.turns and [fixed(x, 3) for x in (v.turns["cross_validated"].mean, v.turns["cross_validated"].p95)]
        rows.append((v.name, count(v.free), *train, *judged, *moved, *(turned or []), duration(v.fit_seconds)))
    words = f"Distance between measured and predicted, {result.unit}; cross-validated but for training: "
    words += f"{plural(len(result.dataset), 'record')}, {result.folds} folds"
    words += f" drawn {result.repeats} times" if result.repeats > 1 else ""
    turns = ("Turn, deg", "Turn 95 %") if any(v.turns for v in result.variants) else ()
    names = ("Free", "Train", "Train 95 %", "Mean", "RMS", "95 %", "Max", "Change", "± se", "Helps", *turns, "Fit")
    return TextTable(words, (("Variant", False), *((n, True) for n in names)), tuple(rows))


def _rows(result: StudyResult) -> dict[tuple[str, tuple[str, ...]], list[Cell]]:
    rows: dict[tuple[str, tuple[str, ...]], list[Cell]] = {}
    for cell in result.cells:
        rows.setdefault((cell.variant, cell.trained), []).append(cell)
    return rows


def _trained(trained: Sequence[str], result: StudyResult) -> str:
    if len(trained) == len(result.groups) > _FEW_GROUPS:
        return "all"
    return " and ".join(trained) or "nominal"


def _cells(result: StudyResult) -> TextTable:
    """A row for each variant and what it was trained at, errors at each group beside one another."""
    decimals = common_decimals([c.errors.mean for c in result.cells], most=3)
    few, rows = len(result.groups) <= _FEW_GROUPS, []
    for (variant, trained), cells in _rows(result).items():
        words = _trained(trained, result)
        words += f" ({plural(cells[0].failed_fits, 'fit')} failed)" if cells[0].failed_fits else ""
        figures = [
            fixed(x, digits) + ("*" if trained and not cell.seen else "")
            for cell in cells
            for x, digits in (
                (cell.errors.mean, decimals),
                *([(cell.errors.p95, decimals)] if few else []),
                *([(cell.turns.mean, 3)] if cell.turns else []),
            )
        ]
        rows.append((variant, words, *figures))
    names = ["mean", *(["95 %"] if few else []), *(["turn mean, deg"] if result.cells[0].turns else [])]
    headings = [("Variant", False), ("Trained at", False)]
    headings += [(f"{group}, {name}" if len(names) > 1 else group, True) for group in result.groups for name in names]
    counts = ", ".join(f"{n} at {group}" for group, n in result.groups.items())
    caption = f"{'Error' if few else 'Mean error'}, {result.unit}; "
    caption += f"{'simulated' if result.simulated else 'measured'} records: {counts}. "
    caption += f"Cross-validated; with *, judged at another {result.group_by} than it trained at"
    return TextTable(caption, tuple(headings), tuple(rows))


def _shown(value: float | None, unit: str) -> str:
    return f"{value:.3f} {unit}" if value is not None else "not known"


def _ladder(result: StudyResult) -> Figure:
    """Errors of each variant."""
    rows = {
        v.name: [(v.train.mean, "hollow", ""), (v.crossed.mean, "solid", ""), (v.crossed.p95, "diamond", "")]
        for v in result.variants
    }
    said = "; ".join(
        f"{v.name}: mean {_said(v.crossed.mean)}, 95 % {_said(v.crossed.p95)} {result.unit}" for v in result.variants
    )
    entries = [
        ('<circle cx="11" cy="0" r="5" class="solid"/>', "mean, cross-validated"),
        ('<circle cx="11" cy="0" r="5" class="hollow"/>', "mean, training records"),
        (f'<path class="diamond" d="M11 0{_DIAMOND}"/>', "95 %, cross-validated"),
    ]
    return _dots(rows, ("Errors by variant", said, "The further left, the better."), f"error, {result.unit}", entries)


def _by_group(result: StudyResult) -> Figure:
    """Mean error at each group, by variant and by what it was trained at."""
    few = len(result.groups) <= _FEW_GROUPS
    rows = {
        f"{variant}, {_trained(trained, result)}": [
            (c.errors.mean, "solid" if c.seen else "hollow", c.judged if few else "") for c in cells
        ]
        for (variant, trained), cells in _rows(result).items()
    }
    texts = [(f"{c.variant}, {_trained(c.trained, result)}", c.judged, _said(c.errors.mean)) for c in result.cells]
    said = "; ".join(f"{trained}, judged at {at}: {mean} {result.unit}" for trained, at, mean in texts)
    caption = "Mean errors. A filled dot: of records that also trained (cross-validated); a ring: of others."
    return _dots(rows, (f"Errors by {result.group_by}", said, caption), f"mean error, {result.unit}", [])


def _dots(
    rows: Mapping[str, Sequence[tuple[float | None, str, str]]],
    words: tuple[str, str, str],
    label: str,
    entries: Sequence[tuple[str, str]],
) -> Figure:
    """Numbers of each row on one axis, marked by class, with a text at each; ``words``: title, description, caption."""
    known = {name: [(x, style, text) for x, style, text in row if x is not None] for name, row in rows.items()}
    numbers = [x for row in known.values() for x, _, _ in row]
    high = max(numbers, default=1.0) or 1.0
    low = min((x for x in numbers if x > 0), default=high)

    def draw(width: float) -> tuple[float, list[str]]:
        narrow = width <= svg.NARROW
        most = 16 if narrow else 40
        left = MONO * max(len(svg.shorten(name, most)) for name in known) + 18
        top, parts = svg.legend(left, width - left - 8, entries) if entries else (4.0, [])
        box = Box(left, top + 4, width - 14, top + 4 + _ROW * len(known))
        x = Axis(0, high * 1.05, box.left, box.right)
        if high / low > _LOG_FROM:
            x = Axis(low * 0.85, high * 1.15, box.left, box.right, log=True)
        parts += svg.frame(box, x, None, (label, ""), (4 if narrow else 8, 0))
        for place, (name, row) in enumerate(known.items()):
            y = box.top + _ROW * (place + 0.5)
            parts.append(svg.text(left - 9, y + 4, svg.shorten(name, most), "mono", "end"))
            ends = [x.of(number) for number, _, _ in row] or [left]
            parts.append(svg.line(min(ends), y, max(ends), y, "stem"))
            for number, ((_, style, text), at) in enumerate(zip(row, ends, strict=False)):
                if style == "diamond":
                    parts.append(svg.marks(np.array([at]), np.array([y]), _DIAMOND, style))
                else:
                    parts.append(svg.circle(at, y, 5, style))
                parts.append(svg.text(at, y + (16 if number % 2 else -8), text, "tick", "middle") if text else "")
        return box.bottom + 44, parts

    return svg.both("ladder" if entries else "groups", words, draw)


def _said(value: float | None) -> str:
    return significant(value) if value is not None else "not known"
