"""The page: everything a run knows, laid out so that a person can decide from it in a minute."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import CORRELATED, POOR_CONDITION, bound_together, correlated_pairs, correlations
from armcal.report import figures
from armcal.report.numbers import NONE, common_decimals, count, duration, fixed, plural, ratio, significant, unbroken
from armcal.report.sections import PluginSection
from armcal.report.tables import (
    Fact,
    error_rows,
    fixed_rows,
    group_rows,
    judged,
    moved_rows,
    parameter_rows,
    provenance_facts,
    scatter_rows,
    worst_records,
    worst_rows,
)
from armcal.run.result import RunResult
from armcal.version import __version__

MOST_LISTED = 50  # Of records set aside and of correlated pairs; the rest is counted
_STRONGEST = 20
_WORDS = {"bad": "Bad", "warning": "Warning", "note": "Note", "good": "Good"}
_SYMBOLS = {"bad": "✕", "warning": "!", "note": "i", "good": "✓"}


def render(result: RunResult, sections: Sequence[PluginSection] = ()) -> str:
    """One self-contained HTML file, plugins' sections too: no scripts, no references to anything outside of it."""
    grades = [finding.grade for finding in result.verdict.findings]
    parameters, aside, worst = parameter_rows(result.estimate), result.dataset.set_aside, worst_records(result)
    content = {
        "result": result,
        "unit": result.errors.unit,
        "version": __version__,
        "words": _WORDS,
        "symbols": _SYMBOLS,
        "worst_grade": next((g for g in _WORDS if g in grades), "note"),
        "grades": [(g, grades.count(g)) for g in _WORDS if g in grades],
        **_accuracy(result),
        "distribution": figures.distribution(result),
        "workspace": figures.views(result),
        "moved": figures.moved_views(result),
        "moved_rows": moved_rows(result),
        "order": figures.in_order(result, worst),
        "worst": worst_rows(result, worst),
        "missed": result.evidence.large_errors,
        "crossed": bool(np.isfinite(result.errors.cross_validated_mm).any()),
        "shares": figures.share_rows(result.intervals),
        "levels": figures.level_names(),
        "radii": figures.predicted_against_found(result),
        "profiles": figures.profile_rows(result),
        "profile_figures": figures.profile_figures(result),
        "parameters": parameters,
        "fixed": fixed_rows(result.estimate),
        **_correlations(result.estimate),
        **_determined(result.estimate),
        "suspicious": result.noise.suspicious[:MOST_LISTED],
        "more_suspicious": max(len(result.noise.suspicious) - MOST_LISTED, 0),
        "scatter": scatter_rows(result.noise.components),
        "sections": sections,
        "aside": aside[:MOST_LISTED],
        "more_aside": max(len(aside) - MOST_LISTED, 0),
        "warnings": tuple(dict.fromkeys((*result.warnings, *result.dataset.warnings))),
        **_origin(result),
    }
    return rendered("template.html.j2", content)


def rendered(template: str, content: Mapping[str, Any], *folders: Path) -> str:
    return str(_templates(folders).get_template(template).render(content))


@lru_cache(maxsize=4)
def _templates(folders: tuple[Path, ...]) -> Any:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader([*folders, Path(__file__).parent])
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.lstrip_blocks = True
    environment.filters.update(count=count, fixed=fixed, plural=plural, unbroken=unbroken)
    environment.filters["signed"] = lambda x: fixed(x, 3, signed=True)
    return environment


def _accuracy(result: RunResult) -> dict[str, Any]:
    from_set, turns = judged(result.table), result.table.turns
    tiles = []
    if from_set:
        before, after = from_set.nominal, from_set.calibrated
        pairs = [("Mean error", before.mean, after.mean), ("95 % below", before.p95, after.p95)]
        pairs.append(("Largest error", before.max, after.max))
        pairs = [pair for pair in pairs if pair[2] is not None]  # few records have no 95 %
        decimals = common_decimals([v for _, b, a in pairs for v in (b, a)], most=3)
        tiles = [(name, fixed(b, decimals), fixed(a, decimals), ratio(b, a)) for name, b, a in pairs]
    rows = group_rows(result.groups.errors)
    distances = bool(rows) and len(rows[0][-1]) > 2
    shown = {"group_rows": rows, "group_distances": distances}
    errors = f"Distance between measured and predicted, {result.errors.unit}"
    parts = {errors: result.table, "Turn between measured and predicted, deg": turns}
    listed = [(caption, of_sets) for caption, table in parts.items() if table and (of_sets := error_rows(table))]
    turned = {"turned": turns is not None, "judged_turns": judged(turns) if turns else None}
    return {"judged": from_set, "tiles": tiles, "error_tables": listed, **turned, **shown}


def _correlations(estimate: Estimate) -> dict[str, Any]:
    names = estimate.names
    if len(names) < 2:
        return {"pairs": (), "more_pairs": 0, "strongest": ()}
    with np.errstate(invalid="ignore"):
        matrix = correlations(estimate.covariance)
    matrix = np.where(np.outer(estimate.determined, estimate.determined), matrix, 0.0)
    pairs = correlated_pairs(matrix, names, CORRELATED, bound_together(estimate.parameters))
    # The strongest pairs whatever their size, zeros left out.
    rows, columns = np.triu_indices(len(names), 1)
    sizes = np.abs(matrix[rows, columns])
    order = [k for k in np.argsort(-sizes, kind="stable")[:_STRONGEST] if sizes[k] > 0]
    ends = [(names[i], names[j], float(matrix[i, j])) for i, j in zip(rows[order], columns[order], strict=True)]
    listed = {(a, b) for a, b, _ in pairs}
    return {
        "pairs": [(a, b, fixed(r, 3, signed=True)) for a, b, r in pairs[:MOST_LISTED]],
        "more_pairs": max(len(pairs) - MOST_LISTED, 0),
        "strongest": [(a, b, fixed(r, 3, signed=True)) for a, b, r in ends if (a, b) not in listed],
    }


def _determined(estimate: Estimate) -> dict[str, Any]:
    known = estimate.identifiability
    return {
        "known": known,
        "combinations": [str(combination) for combination in known.undetermined],
        "condition": significant(known.condition),
        "poor": len(known) > 0 and known.condition > POOR_CONDITION,
        "poor_limit": f"{POOR_CONDITION:.0e}".replace("e+0", "e"),
        "weakest": str(known.weakest) if len(known) and known.rank else "",
    }


def _origin(result: RunResult) -> dict[str, Any]:
    solver, data = result.estimate.verdict, result.dataset
    answer = "converged" if solver.converged else "did not converge"
    effort = f"{plural(solver.iterations, 'iteration')}, {duration(solver.seconds)}"
    starts = f"{solver.agreeing_starts} of {solver.starts} came to the same answer" if solver.starts > 1 else "one"
    facts = [
        Fact("data", data.source or NONE),
        Fact("data sha256", data.sha256 or NONE),
        Fact("records", f"{len(result.split.train)} train, {len(result.split.holdout)} holdout"),
        Fact("solver", f"{solver.name}: {solver.status} ({answer}; {effort})"),
        Fact("starts", starts),
        Fact("backend", result.backend or NONE),
        Fact("noise scale", f"{significant(result.estimate.noise_scale)} times the declared noise"),
        Fact("degrees of freedom", significant(result.estimate.degrees_of_freedom, 4)),
    ]
    names, seconds = {fact.name for fact in facts}, result.seconds.items()  # the total last
    facts += [fact for fact in provenance_facts(result.provenance) if fact.name not in names]
    return {
        "facts": [f for f in facts if not f.long],
        "long_facts": [f for f in facts if f.long],
        "seconds": [(name, duration(value)) for name, value in sorted(seconds, key=lambda stage: stage[0] == "total")],
    }
