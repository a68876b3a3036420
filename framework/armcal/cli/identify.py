"""``armcal check`` and ``armcal identify``: what is known before anything is solved."""

import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array
from armcal.base.config_text import finite
from armcal.base.units import digits, to_unit
from armcal.cli.common import FILE, Console, data, overrides, say, speaking
from armcal.diagnose.fit import Prepared
from armcal.errors import ConfigError, Location, ProblemError
from armcal.estimate.identifiability import (
    CAUSES,
    CORRELATED,
    DETERMINED_BY,
    POOR_CONDITION,
    Combination,
    Dropped,
    Identifiability,
    Measure,
    correlated_pairs,
    determined_in_words,
    expected_covariance,
    expected_sources,
    explain,
    identify_from,
    minimal_set,
    require_solvable,
)
from armcal.estimate.start import Start, pose_words
from armcal.planning.candidates import observability
from armcal.problem.variants import factor_at_zero
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble
from armcal.run.study import FixedParameters, fixed_parameters

_MM = 1000.0


@click.command()
@click.argument("config", type=FILE)
@data
@overrides
@speaking
def check(console: Console, config: Path, data: Path | None, overrides: tuple[str, ...]) -> None:
    """Check CONFIG and its data without solving: counts, units, rank, excitation."""
    registry = console.registry()
    experiment = Experiment.load(config, overrides, data, registry)
    with console.progress() as progress:
        ready = assemble(experiment, Stopwatch(), progress=progress)
    start, refused = ready.problem.parameters.nominal(), None
    try:
        ready = replace(ready, warnings=(*ready.warnings, *require_solvable(ready.training, start)))
    except ProblemError as fault:
        refused = fault
    for text in ready.notices:
        console.warn(text)
    content = _checked(experiment, ready)
    if refused:
        content["error"] = {"message": str(refused), "exit_code": refused.exit_code}
    console.result(content)
    out, records, parameters = console.out, content["records"], content["parameters"]
    out.print(
        f"{experiment.name}: {records['used']} records ({records['train']} train, {records['holdout']} held out, "
        f"{len(records['set_aside'])} set aside), {content['equations']} equations for "
        f"{len(parameters['free'])} free of {len(parameters['all'])} parameters."
    )
    rows, kinds = [], command_channels(experiment.system.arms)
    for joint, seen in content["excitation_rad_or_m"].items():
        unit = "deg" if kinds[joint] == "angle" else "mm"
        rows.append((joint, *(f"{to_unit(seen[end], unit):.5g}" for end in ("min", "max")), unit, seen["levels"]))
    console.table("Excitation of the joints", ("joint", "from", "to", "unit", "levels"), rows)
    notes = (f"{finding.text} {finding.action}" for finding in ready.findings if finding.grade == "note")
    for line in (*_alignment_lines(ready.start), *notes):
        out.print(line, soft_wrap=True)
    condition = parameters["scaled_condition"]
    shown = "infinite" if condition is None else f"{condition:.3g}"
    words = determined_in_words(parameters["determined_by"])
    out.print(
        f"{words} (rank {parameters['rank']} of {len(parameters['free'])}, scaled condition {shown}).", soft_wrap=True
    )
    if parameters["weakest"]:
        hardly = "hardly" if condition is None or condition > POOR_CONDITION else "least"
        out.print(f"{hardly} determined: {parameters['weakest']}.")
    if console.verbose:
        for name in parameters["all"]:
            by = parameters["determined_by"].get(name)
            out.print(f"  {DETERMINED_BY[by] if by else 'fixed':<{max(map(len, DETERMINED_BY.values()))}} {name}")
    if refused:
        say(f"armcal: {refused}", err=True)
        sys.exit(refused.exit_code)
    console.out.print("Ready to run.", style="green")


def _checked(experiment: Experiment, ready: Prepared) -> dict[str, Any]:
    parameters = ready.problem.parameters
    triangle = factor_at_zero(ready.training, parameters.nominal())
    known = identify_from(triangle, parameters)
    channels = [*command_channels(experiment.system.arms)]
    angles = {channel: ready.dataset.column(channel)[ready.split.train] for channel in channels}
    every, start, aligned = parameters.with_free(parameters.names), ready.start, None
    if (alignment := start.alignment) is not None:  # where the base and the target were found, in SI
        turned = zip(alignment.turn.tolist(), alignment.shift.tolist(), strict=True)
        aligned = {
            "tracker_T_base": [[*row, x] for row, x in turned],
            "target_moved_m": alignment.offset.tolist(),
            "typical_error_as_configured_m": start.configured,
            "typical_error_aligned_m": alignment.left,
            "undetermined": list(start.gauges),
            "start": "aligned" if start.taken else "configured",
        }
    return {
        "experiment": experiment.name,
        "records": {
            "used": len(ready.dataset),
            "train": len(ready.split.train),
            "holdout": len(ready.split.holdout),
            "set_aside": [{"row": a.row, "id": a.record_id, "reason": a.reason} for a in ready.dataset.set_aside],
        },
        "equations": ready.training.equations(),
        "parameters": {
            "all": list(every.coordinate_names),
            "free": list(known.names),
            "determined_by": expected_sources(known, parameters, triangle),
            "rank": known.rank,
            "scaled_condition": known.condition if np.isfinite(known.condition) else None,
            "undetermined": [str(combination) for combination in known.undetermined],
            "weakest": str(known.weakest) if len(known) else "",
        },
        "excitation_rad_or_m": {
            channel: {"min": float(values.min()), "max": float(values.max()), "levels": len(np.unique(values))}
            for channel, values in angles.items()
        },
        "alignment": aligned,
        "warnings": list(ready.notices),
    }


def _alignment_lines(start: Start) -> list[str]:
    if start.alignment is None:
        return []
    target = ", ".join(f"{x * _MM:.1f}" for x in start.alignment.offset)
    lines = [
        "alignment of the nominal arm with the positions: its base frame stands at "
        f"{pose_words(start.alignment)} in the "
        f"instrument's frame, the target is ({target}) mm from its configured place on the tool.",
        f"typical error of the nominal arm: {digits(start.configured * _MM)} mm as configured, "
        f"{digits(start.alignment.left * _MM)} mm aligned; the fit starts from "
        f"{'the alignment' if start.taken else 'the configuration'}.",
    ]
    lines += [f"not determined by these positions: {gauge}." for gauge in start.gauges]
    return lines


@click.command()
@click.argument("config", type=FILE)
@data
@click.option("--minimal", is_flag=True, help="Also choose a minimal set of the free parameters.")
@click.option("--prefer", multiple=True, metavar="GLOB", help="Keep these in the minimal set if possible; repeatable.")
@click.option("--most", type=click.IntRange(min=0), help="Keep no more than so many in the minimal set.")
@click.option(
    "--max-sd",
    type=click.FloatRange(min=0, min_open=True),
    help="Leave out of the minimal set what stays more uncertain than so many typical scales.",
)
@click.option("--fixed", is_flag=True, help="Also fit, and judge which fixed parameters are worth freeing.")
@overrides
@speaking
def identify(
    console: Console,
    config: Path,
    data: Path | None,
    minimal: bool,
    prefer: tuple[str, ...],
    most: int | None,
    max_sd: float | None,
    fixed: bool,
    overrides: tuple[str, ...],
) -> None:
    """Report which combinations of CONFIG's free parameters its poses determine, whatever their rank.

    Solves nothing, but with --fixed.
    """
    registry = console.registry()
    experiment = Experiment.load(config, overrides, data, registry)
    with console.progress() as progress:
        ready = assemble(experiment, Stopwatch(), progress=progress)
    parameters = ready.problem.parameters
    if not parameters.free:
        raise ConfigError("no parameter is free.", where=Location(str(config)), hint="Name some under parameters.free.")
    preferred = [parameters.select([glob]) for glob in prefer]
    for glob, names in zip(prefer, preferred, strict=True):
        if not any(parameters[name].free for name in names):
            raise ConfigError(
                f"--prefer {glob}: none of the parameters it names is free.",
                hint="Name them under parameters.free as well; a minimal set is chosen from the free ones.",
            )
    triangle = factor_at_zero(ready.training, parameters.nominal())
    known = identify_from(triangle, parameters)
    content = _identified(experiment, ready, triangle, known)
    if minimal or prefer or most is not None or max_sd is not None:
        smallest = minimal_set(triangle, parameters, preferred, most, np.inf if max_sd is None else max_sd)
        content["minimal"] = {
            "kept": list(smallest.kept),
            "redundant": [_dropped(dropped) for dropped in smallest.redundant],
            "left_out": [_dropped(dropped) for dropped in smallest.left_out],
            "sd_ordinary_sizes": {name: finite(sd) for name, sd in smallest.deviations.items()},
        }
    if fixed:
        with console.progress() as progress:
            judged = fixed_parameters(experiment.of_records(ready.dataset), ready, progress)
        content["fixed"] = asdict(judged)
    for text in ready.notices:
        console.warn(text)
    console.result(content)
    _show_identified(console, content)
    if "minimal" in content:
        _show_minimal(console, content["minimal"])
    if fixed:
        _show_fixed(console, judged)


def _identified(experiment: Experiment, ready: Prepared, triangle: Array, known: Identifiability) -> dict[str, Any]:
    parameters = ready.problem.parameters
    equations = ready.training.equations()
    covariance = expected_covariance(triangle, parameters)
    deviation = np.sqrt(np.diag(covariance))
    indices = asdict(observability(known.singular_values[: known.rank], equations)) if known.rank else None
    explained = explain(ready.training, parameters.nominal(), known)
    return {
        "experiment": experiment.name,
        "records": len(ready.split.train),
        "equations": equations,
        "free": list(known.names),
        "determined_by": expected_sources(known, parameters, triangle),
        "rank": known.rank,
        "rank_by_qr": known.rank_by_qr,
        "singular_values": [float(value) for value in known.singular_values],
        "scaled_condition": known.condition if np.isfinite(known.condition) else None,
        "observability_of_the_determined": indices,
        "undetermined": [
            {**_terms(undetermined.combination), "cause": undetermined.cause} for undetermined in explained
        ],
        "hardly_determined": [
            {**_terms(combination), "sd_ordinary_sizes": finite(sd)} for combination, sd in known.hardly
        ],
        "correlated": [
            {"one": one, "other": other, "correlation": r}
            for one, other, r in correlated_pairs(covariance, parameters.coordinate_names)
        ],
        "expected_sd": {n: float(sd) if sd > 0 else None for n, sd in zip(known.names, deviation, strict=True)},
        "warnings": list(ready.notices),
    }


def _terms(combination: Combination) -> dict[str, Any]:
    return {
        "text": str(combination),
        "terms": [
            {"name": name, "ordinary_sizes": weight, "amount": amount}
            for (name, weight), amount in zip(combination.terms, combination.amounts, strict=True)
        ],
    }


def _dropped(dropped: Dropped) -> dict[str, Any]:
    return {"name": dropped.name, "effect_left": dropped.left, **_terms(dropped.absorbed_by)}


def _show_identified(console: Console, content: dict[str, Any]) -> None:
    free, rank = len(content["free"]), content["rank"]
    condition = content["scaled_condition"]
    console.line(
        f"{content['experiment']}: {content['records']} records, {content['equations']} equations, {free} free "
        f"parameters."
    )
    by_qr = f" ({content['rank_by_qr']} by QR)" if content["rank_by_qr"] != rank else ""
    text = f", scaled condition {condition:.3g}" if condition is not None else ""
    console.line(f"rank {rank} of {free}{by_qr}{text}.")
    if content["observability_of_the_determined"]:
        shown = ", ".join(f"{n.upper()} {v:.3g}" for n, v in content["observability_of_the_determined"].items())
        console.line(f"observability of {'them' if rank == free else f'the {rank} determined combinations'}: {shown}.")
    for cause, words in CAUSES.items():
        own = [one["text"] for one in content["undetermined"] if one["cause"] == cause]
        _section(console, f"Undetermined, {words} ({len(own)}):", own)
    refused = "; armcal run refuses them" if "nothing" in content["determined_by"].values() else ""
    console.line(f"{determined_in_words(content['determined_by'])}{refused}.")
    hardly = [
        f"{pair['text']}: sd {pair['sd_ordinary_sizes'] or np.inf:.3g} typical scales"
        for pair in content["hardly_determined"]
    ]
    _section(console, "Hardly determined (worse than a typical scale of correction, by the declared noise):", hardly)
    pairs = [f"{pair['one']} and {pair['other']} ({pair['correlation']:+.3f})" for pair in content["correlated"]]
    _section(console, f"Correlated above {CORRELATED:g}:", pairs)
    if console.verbose:
        deviations = content["expected_sd"].items()
        by = content["determined_by"]
        shown_sd = [
            f"{name}: {'' if sd is None else f'{sd:.3g}, '}{DETERMINED_BY[by[name]]}" for name, sd in deviations
        ]
        _section(console, "Expected standard deviations by the declared noise and the priors (SI):", shown_sd)


def _show_minimal(console: Console, content: dict[str, Any]) -> None:
    redundant = [combination["text"] for combination in content["redundant"]]
    _section(console, f"Not needed, the kept ones do the same ({len(redundant)}):", redundant)
    left_out = [
        f"{combination['name']} ({100 * combination['effect_left']:.0f} % of its effect is its own)"
        for combination in content["left_out"]
    ]
    _section(console, f"Left out as asked, though determined ({len(left_out)}):", left_out)
    within = sorted({name for name, sd in content["sd_ordinary_sizes"].items() if sd is None})
    _section(console, "Kept, and undetermined in part (these need priors):", within)
    console.line(f"A minimal set of {len(content['sd_ordinary_sizes'])} free parameters:", "bold")
    for text in ("parameters:", "  free:", *(f"    - {name}" for name in content["kept"])):
        console.line(text)


def _section(console: Console, title: str, lines: list[str]) -> None:
    if lines:
        console.line(title, "bold")
        for text in lines:
            console.line(f"  {text}")


def _show_fixed(console: Console, judged: FixedParameters) -> None:
    if judged.error is not None:
        first = f"held out: {judged.error:.3g} {judged.unit} as configured; with each freed beside those above it"
        console.line(f"Fixed parameters that would explain residuals (mean error of records {first}):", "bold")
    width = max((len(step.name) for step in judged.gaining), default=0)
    for step in judged.gaining:
        sizes = f"{_shown(step.change, step.unit)} (sd {_shown(step.sd, step.unit)})"
        error = "" if step.error is None else f"{step.error:.3g} {judged.unit}"
        console.line(f"  {step.name:{width}}  {sizes:34}  {error:10} {'free it' if step.recommended else ''}")
    if others := judged.determined_and_nothing_gained:
        console.line(f"Determined too, and nothing is gained ({len(others)}): {', '.join(others)}.")
    if judged.recommended:
        console.line("Add to parameters.free:", "bold")
        console.line(f"  [{', '.join(judged.recommended)}]")
    else:
        console.line("Free no more: records held out would not be predicted better than by chance.", "green")


def _shown(numbers: Sequence[float], unit: str) -> str:
    measure = Measure(unit, 1.0)
    return f"{', '.join(f'{measure.shown(number)[0]:.2g}' for number in numbers)} {measure.shown(0.0)[1]}".strip()
