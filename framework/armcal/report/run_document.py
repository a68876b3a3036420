"""What a run says, as a document: the picture, the headline, what to do, and what each of it rests on."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from armcal.base.units import readable
from armcal.diagnose.checks import Finding
from armcal.estimate.estimator import Estimate
from armcal.estimate.identifiability import (
    CORRELATED,
    bound_together,
    correlated_pairs,
    correlations,
    determined_in_words,
)
from armcal.plugins import PluginRegistry, said
from armcal.report import run_figures as figures
from armcal.report import run_tables as tables
from armcal.report.document import Code, Document, Level, Part, Section, Table
from armcal.report.numbers import NONE, count, fixed, plural, significant
from armcal.run.outputs import metrics
from armcal.run.result import RunResult

_STRONGEST = 20


class SectionMaker(Protocol):
    """A function of a run's ``armcal.RunResult`` (SI and radians) that gives an ``armcal.ReportSection(title, html)``.

    It gives None where it has nothing to say of the run. What it raises costs nobody the report: a warning stands in
    the section's place. ``html`` needs no other file and no script, since the page must open offline.
    """

    def __call__(self, result: RunResult) -> Section | None:
        """The section of this run, if there is one."""


def plugin_sections(result: RunResult, registry: PluginRegistry) -> tuple[list[Section], list[str]]:
    """The sections that plugins have for a run, by name, and why some could not be made."""
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
    """All that a run has to say; ``sections`` are those of plugins."""
    findings, warnings = result.verdict.findings, tuple(dict.fromkeys((*result.warnings, *result.dataset.warnings)))
    urgent = [finding for finding in findings if finding.grade in ("bad", "warning")]
    notes = [finding for finding in findings if finding.grade == "note"]
    passed = [finding for finding in findings if finding.grade == "good"]
    grade = next((g for g in ("bad", "warning") if g in {f.grade for f in findings}), "good" if findings else "note")
    verdict = result.verdict
    summary: list[Part] = list(filter(None, ("" if verdict.bad else verdict.claim, verdict.next_poses)))
    if findings and not urgent:
        summary.append("No warning: the calibration can be used.")
    own = [
        *_accuracy(result),
        *_parameters(result),
        *_records(result),
        Section("Notes", parts=notes, name="notes", level="verbose"),
        Section(f"{plural(len(passed), 'check')} passed", parts=passed, name="passed", folded=True, level="verbose"),
        *_determined(result.estimate),
        *_data(result, warnings),
        *sections,
        _origin(result),
    ]
    return Document(
        f"Calibration report: {result.name}",
        " ".join(filter(None, (result.verdict.headline, noise_text(result)))),
        [section for section in own if section.parts or section.html],
        grade,
        [*summary, *urgent],
        figures.in_space(result) or figures.distribution(result),
        metrics(result),
    )


def noise_text(result: RunResult) -> str:
    """How much of the error on the records that judge is the noise that their instrument is stated to have."""
    noise, errors = figures.noise_of(result), result.errors
    _, holdout = figures.roles(result)
    crossed = np.isfinite(errors.cross_validated_mm)
    own = holdout if holdout.any() else crossed
    judged = np.where(holdout, errors.calibrated_mm, errors.cross_validated_mm)[own]
    if noise is None or not len(judged) or not np.isfinite(judged).all():
        return ""
    measured, stated = float(np.mean(judged)), figures.mean_noise(noise[0][own], noise[1])
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
        shown.append(tables.errors_table(f"{result.errors.name} error, {unit}: {result.name}", result.table))
    if result.table.turns is not None:
        what = "Orientation" if result.errors.name == "Tip" else "Angle"
        shown.append(tables.errors_table(f"{what} error, deg: {result.name}", result.table.turns))
    groups = [tables.groups_table(result.groups, unit)] if result.groups else []
    curve = [figure for figure in (figures.distribution(result),) if figure]
    return [
        Section("Errors before and after", parts=[*shown, words, *curve], name="accuracy", level="always"),
        Section("By group", parts=groups, name="groups", level="always"),
    ]


def _parameters(result: RunResult) -> list[Section]:
    estimate, count_free = result.estimate, len(result.estimate.sources)
    if not count_free:
        text = "No parameter was free: the model stands as it was given."
        return [Section("Parameters", parts=[text], name="parameters")]
    table = tables.parameters_table(estimate, result.bootstrap)
    listed, title = _some(table, tables.principal_table(estimate)), f"Table of {plural(count_free, 'free parameter')}"
    level: Level = "verbose" if result.bootstrap is None else "always"
    return [
        Section("What was corrected", parts=_some(figures.corrections(estimate)), name="corrections"),
        Section(title, parts=listed, name="parameters", folded=True, level=level),
    ]


def _some(*parts: Part | None) -> list[Part]:
    return [part for part in parts if part is not None]


def _records(result: RunResult) -> list[Section]:
    worst = tables.worst_records(result)
    listed = _some(tables.worst_table(result, worst)) if len(worst) else []
    moved = _some(tables.moved_table(result))
    return [
        Section("What was learned beside the model", parts=moved, name="pose-residual"),
        Section("Where residuals come from", parts=_some(figures.against_joints(result)), name="joints"),
        Section(
            "Record by record",
            parts=_some(figures.in_order(result, worst)),
            name="records",
        ),
        Section("Largest errors", parts=listed, name="worst", folded=True),
    ]


def _determined(estimate: Estimate) -> list[Section]:
    """What the data hardly determine, or not: combinations of parameters, and pairs that are correlated."""
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
        shown = [(a, b, fixed(r, 3, signed=True)) for a, b, r in (*pairs[: tables.MOST_LISTED], *others)]
        caption = f"Pairs that correlate by more than {CORRELATED:g} ({count(len(pairs))}), then the strongest others"
        parts.append(Table(caption, ("Parameter", "Parameter", "Correlation"), shown, left=("Parameter",)))
    return [Section("What the data do not tell apart", parts=parts, name="determined", folded=not known.undetermined)]


def _data(result: RunResult, warnings: Sequence[str]) -> list[Section]:
    suspicious, scatter = _some(tables.suspicious_table(result)), _some(tables.scatter_table(result))
    findings = [Finding("warning", text) for text in warnings]
    aside = _some(tables.aside_table(result))
    return [
        Section("Warnings of the data and the configuration", parts=findings, name="warnings"),
        Section("Suspicious records", parts=suspicious, name="suspicious", level="verbose"),
        Section("Variance components", parts=scatter, name="components"),
        Section("Records set aside", parts=aside, name="data", level="verbose"),
    ]


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
    facts += [fact for fact in tables.provenance_facts(result.provenance) if fact[0] not in names]
    seconds = sorted(result.seconds.items(), key=lambda stage: stage[0] == "total")
    parts: list[Part] = [Code(result.command), Table("Provenance", ("What", "Value"), facts, left=("Value",))]
    parts.append(Table("Time taken", ("Stage", "Time"), [(name, f"{took:.2f} s") for name, took in seconds]))
    return Section("How to reproduce this", parts=parts, name="reproduce", folded=True)
