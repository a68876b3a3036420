"""The page of a study: one table, one figure, what to conclude, and which records gain and lose."""

from typing import Any

from armcal.report import study_figures
from armcal.report.numbers import NONE, common_decimals, count, duration, fixed, plural
from armcal.report.page import rendered
from armcal.report.tables import TextTable, provenance_facts
from armcal.run.study_result import StudyResult, TransferCell, TransferResult, VariantResult
from armcal.version import __version__

_SAME_MM = 1e-6


def render_study(result: StudyResult | TransferResult) -> str:
    """One self-contained HTML file of a comparison, or of a load transfer study."""
    changes: list[tuple[str, Any]] = []
    if isinstance(result, StudyResult):
        title, sentences = f"{result.name}: {plural(len(result.variants), 'variant')}", conclusions(result)
        table, figure = _variants(result), study_figures.ladder(result)
        changes = [(v.name, v.change) for v in result.variants if v.change]
    else:
        title, sentences = f"{result.name}: trained at one load, judged at another", transfer_conclusions(result)
        table, figure = transfer_table(result), study_figures.transfers(result)
    content = {
        "result": result,
        "title": title,
        "sentences": sentences,
        "table": table,
        "figure": figure,
        "changes": changes,
        "version": __version__,
        "facts": [fact for fact in provenance_facts(result.provenance) if not fact.long],
        "seconds": [(name, duration(value)) for name, value in result.seconds.items()],
    }
    return rendered("study.html.j2", content)


def conclusions(result: StudyResult) -> list[str]:
    """What to conclude from a comparison."""
    best = result.variant(result.best)
    texts = [
        f"Lowest cross-validated error: {best.name}, {_shown(best.crossed.mean, result.unit)} on average, 95 % below "
        f"{_shown(best.crossed.p95, result.unit)}."
    ]
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


def transfer_conclusions(result: TransferResult) -> list[str]:
    """How much an error grows from the load that trained to another."""
    texts = []
    for name in dict.fromkeys(cell.variant for cell in result.cells):
        single = [c for c in result.cells if c.variant == name and len(c.trained_g) == 1 and c.errors.mean is not None]
        own = {c.judged_g: c.errors.mean for c in single if c.seen}
        pairs = [
            f"{c.trained_g[0]:g} g to {c.judged_g:g} g {_shown(c.errors.mean, result.unit)}, against "
            f"{_shown(own.get(c.judged_g), result.unit)} there"
            for c in single
            if not c.seen
        ]
        texts.append(f"{name}: from {'; from '.join(pairs)}.")
    return texts


def _variants(result: StudyResult) -> TextTable:
    numbers = [x for v in result.variants for x in (v.train.mean, v.crossed.mean)]
    decimals = common_decimals(numbers, most=3)
    rows = []
    for v in result.variants:
        moved = (NONE, NONE)
        if v.change:
            spread = f"{fixed(v.change.mean, decimals, signed=True)} ± {fixed(v.change.standard_error, decimals)}"
            moved = (spread, f"{v.change.helped:.0%}".replace("%", " %"))
        train = [fixed(x, decimals) for x in (v.train.mean, v.train.p95)]
        errors = (*train, *(fixed(x, decimals) for x in (v.crossed.mean, v.crossed.rms, v.crossed.p95, v.crossed.max)))
        failed = v.failed_folds + (not v.converged)
        remark = f"{plural(failed, 'fit')} failed, {plural(v.crossed.count, 'record')} judged" if failed else ""
        turned = [] if v.turns is None else [fixed(x, 3) for x in (v.turns.crossed.mean, v.turns.crossed.p95)]
        rows.append((v.name, count(v.free), *errors, *moved, *turned, duration(v.fit_seconds), remark))
    words = f"Distance between measured and predicted, {result.unit}; "
    words += f"{plural(len(result.dataset), 'record')}, {result.folds} folds"
    words += f" drawn {result.repeats} times" if result.repeats > 1 else ""
    turns = ("Turn mean, deg", "Turn 95 %, deg") if any(v.turns for v in result.variants) else ()
    names = ("Free", "Train mean", "Train 95 %", "Mean", "RMS", "95 %", "Max", "Change", "Helps", *turns, "Fit")
    return TextTable(words, (("Variant", False), *((n, True) for n in names), ("", False)), tuple(rows))


def transfer_table(result: TransferResult) -> TextTable:
    """A row for each variant and what it was trained at, errors at each payload beside one another."""
    decimals = common_decimals([c.errors.mean for c in result.cells], most=3)
    groups: dict[tuple[str, tuple[float, ...]], list[TransferCell]] = {}
    for cell in result.cells:
        groups.setdefault((cell.variant, cell.trained_g), []).append(cell)
    rows = []
    for (variant, trained), cells in groups.items():
        words = " and ".join(f"{g:g} g" for g in trained) or "nominal"
        words += f" ({plural(cells[0].failed_fits, 'fit')} failed)" if cells[0].failed_fits else ""
        figures = [
            fixed(x, digits) + ("*" if trained and not cell.seen else "")
            for cell in cells
            for x, digits in (
                (cell.errors.mean, decimals),
                (cell.errors.p95, decimals),
                *([(cell.turns.mean, 3)] if cell.turns else []),
            )
        ]
        rows.append((variant, words, *figures))
    names = ("mean", "95 %", *(["turn mean, deg"] if any(c.turns for c in result.cells) else []))
    headings = [("Variant", False), ("Trained at", False)]
    headings += [(f"{g:g} g, {name}", True) for g in result.payloads_g for name in names]
    counts = ", ".join(f"{n} at {g:g} g" for g, n in zip(result.payloads_g, result.counts, strict=True))
    caption = f"error, {result.unit}; {'simulated' if result.simulated else 'measured'} records: {counts}. "
    caption += "Cross-validated; with *, judged at another load than it trained at"
    return TextTable(caption, tuple(headings), tuple(rows))


def _shown(value: float | None, unit: str) -> str:
    return f"{value:.3f} {unit}" if value is not None else "not known"
