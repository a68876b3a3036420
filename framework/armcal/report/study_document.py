"""What a study says, as a document: what to conclude, its tables, and a figure."""

import numpy as np

from armcal.report.document import Code, Document, Figure, Marks, Panel, Part, Section, Table
from armcal.report.numbers import NONE, common_decimals, count, fixed, plural, significant
from armcal.report.run_document import provenance_facts
from armcal.run.study import Cell, StudyResult

_SAME_MM = 1e-6
_FEW_GROUPS = 3
_LOG_FROM = 6.0


def study_document(result: StudyResult) -> Document:
    title = f"Study: {result.name}: {plural(len(result.variants), 'variant')}"
    title += f", trained at one {result.group_by}, judged at another" if result.cells else ""
    first, *others = conclusions(result)
    tables: list[Part] = [_cells(result), _variants(result)] if result.cells else [_variants(result)]
    facts = [*provenance_facts(result.provenance), *((name, f"{took:.2f} s") for name, took in result.seconds.items())]
    origin: list[Part] = [
        Code(result.command),
        Table("Provenance, and time taken", ("What", "Value"), facts, left=("Value",)),
    ]
    sections = [
        Section("Side by side", parts=tables, name="table", level="always"),
        Section("Errors", parts=[_ladder(result)], name="figures"),
        Section("Warnings", parts=result.warnings, name="warnings"),
        Section("How to reproduce this", parts=origin, name="reproduce", folded=True),
    ]
    return Document(title, first, [s for s in sections if s.parts], summary=others, data=result.as_dict())


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
    if result.nested is not None:
        chosen, judged, unit = result.nested.chosen, result.nested.crossed, result.unit
        listed = ", ".join(f"{name} in {chosen.count(name)}" for name in dict.fromkeys(chosen))
        texts.append(
            "The choice itself, made inside each fold's training records and judged outside: "
            f"{_shown(judged.mean, unit)} on average, 95 % below {_shown(judged.p95, unit)} (picked by the records "
            f"that judge it: {_shown(best.crossed.mean, unit)}). Chosen: {listed} of {result.folds} folds."
        )
    elif len(result.variants) > 1:
        texts.append("The records that judge it also picked it; study.nested: true judges the choice itself.")
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


def _transfers(result: StudyResult) -> list[str]:
    texts, several = [], len(result.groups) > _FEW_GROUPS
    for variant in result.variants:
        single = [c for c in result.cells if c.variant == variant.name and len(c.trained_at) == 1]
        own = {c.judged_at: c.error_mm.mean for c in single if c.cross_validated}
        pairs = [(c, own[c.judged_at]) for c in single if not c.cross_validated and c.error_mm.mean is not None]
        if several:  # the worst of many
            pairs = sorted(pairs, key=lambda pair: -(pair[0].error_mm.mean or 0.0))[:1]
        said = [
            f"{c.trained_at[0]} to {c.judged_at} {_shown(c.error_mm.mean, result.unit)}, against "
            f"{_shown(at_home, result.unit)} there"
            for c, at_home in pairs
        ]
        texts += [f"{variant.name}:{' at worst' if several else ''} from {'; from '.join(said)}."] if said else []
    return texts


def _variants(result: StudyResult) -> Table:
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
        rows.append((v.name, count(v.free), *train, *judged, *moved, *(turned or []), f"{v.fit_seconds:.2f} s"))
    words = f"Distance between measured and predicted, {result.unit}; cross-validated but for training: "
    words += f"{plural(len(result.dataset), 'record')}, {result.folds} folds"
    turns = ("Turn, deg", "Turn 95 %") if any(v.turns for v in result.variants) else ()
    names = ("Free", "Train", "Train 95 %", "Mean", "RMS", "95 %", "Max", "Change", "± se", "Helps", *turns, "Fit")
    return Table(words, ("Variant", *names), rows, page_only=("Train 95 %", "RMS", "Max", "Fit", "Turn 95 %"))


def _cells(result: StudyResult) -> Table:
    decimals = common_decimals([c.error_mm.mean for c in result.cells], most=3)
    few, rows, together = len(result.groups) <= _FEW_GROUPS, [], dict[tuple[str, tuple[str, ...]], list[Cell]]()
    for cell in result.cells:
        together.setdefault((cell.variant, cell.trained_at), []).append(cell)
    for (variant, trained), cells in together.items():
        words = "all" if len(trained) == len(result.groups) and not few else " and ".join(trained) or "nominal"
        words += f" ({plural(cells[0].failed_fits, 'fit')} failed)" if cells[0].failed_fits else ""
        figures = [
            fixed(x, digits) + ("*" if trained and not cell.cross_validated else "")
            for cell in cells
            for x, digits in (
                (cell.error_mm.mean, decimals),
                *([(cell.error_mm.p95, decimals)] if few else []),
                *([(cell.orientation_error_deg.mean, 3)] if cell.orientation_error_deg else []),
            )
        ]
        rows.append((variant, words, *figures))
    names = ["mean", *(["95 %"] if few else []), *(["turn mean, deg"] if result.cells[0].orientation_error_deg else [])]
    headings = ["Variant", "Trained at"]
    headings += [f"{group}, {name}" if len(names) > 1 else group for group in result.groups for name in names]
    counts = ", ".join(f"{n} at {group}" for group, n in result.groups.items())
    caption = f"{'Error' if few else 'Mean error'}, {result.unit}; "
    caption += f"{'simulated' if result.simulated else 'measured'} records: {counts}. "
    caption += f"Cross-validated; with *, judged at another {result.group_by} than it trained at"
    return Table(caption, headings, rows, left=("Trained at",))


def _shown(value: float | None, unit: str) -> str:
    return f"{value:.3f} {unit}" if value is not None else "not known"


def _ladder(result: StudyResult) -> Figure:
    said = "; ".join(
        f"{v.name}: mean {_said(v.crossed.mean)}, 95 % {_said(v.crossed.p95)} {result.unit}" for v in result.variants
    )
    numbers = {
        "dot": ("mean, cross-validated", [v.crossed.mean for v in result.variants]),
        "dot before": ("mean, training records", [v.train.mean for v in result.variants]),
        "dot holdout": ("95 %, cross-validated", [v.crossed.p95 for v in result.variants]),
    }
    marks = []
    for style, (name, errors) in numbers.items():
        known = [(x, float(place)) for place, x in enumerate(errors) if x is not None]
        marks.append(Marks(style, np.array(known).reshape(-1, 2).T, name=name))
    whole = np.concatenate([m.xy[0] for m in marks])
    log = len(whole) > 0 and float(whole.min()) > 0 and float(whole.max() / whole.min()) > _LOG_FROM
    panel = Panel("", marks, f"error, {result.unit}", rows=[v.name for v in result.variants], log=log)
    return Figure("Errors by variant", said, "The further left, the better.", [panel], columns=1)


def _said(value: float | None) -> str:
    return significant(value) if value is not None else "not known"
