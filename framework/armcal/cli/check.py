"""``armcal check``."""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from armcal.arm.assembly import command_channels
from armcal.base.units import digits, to_unit
from armcal.cli.common import FILE, Console, data, overrides, speaking
from armcal.cli.console import say
from armcal.diagnose.fit import Prepared
from armcal.errors import ProblemError
from armcal.estimate.identifiability import (
    DETERMINED_BY,
    POOR_CONDITION,
    determined_in_words,
    expected_sources,
    identify_from,
    require_solvable,
)
from armcal.estimate.start import Start, pose_words
from armcal.problem.variants import factor_at_zero
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble

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
    content = _content(experiment, ready)
    if refused:
        content["error"] = {"message": str(refused), "exit_code": refused.exit_code}
    console.result(content)
    out, records, parameters = console.out, content["records"], content["parameters"]
    out.print(
        f"{experiment.name}: {records['used']} records ({records['train']} train, {records['holdout']} held out, "
        f"{len(records['set_aside'])} set aside), {content['equations']} equations for "
        f"{len(parameters['free'])} free of {len(parameters['all'])} parameters."
    )
    rows = _excitation(experiment, content["excitation_rad_or_m"])
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


def _excitation(experiment: Experiment, excitation: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    """How far each joint moved, in degrees or mm."""
    arms = experiment.system.arms
    units = {f"{a}.{j}": "deg" if kind == "angle" else "mm" for a in arms for j, kind in arms[a].commanded.items()}
    for joint, seen in excitation.items():
        low, high = (f"{to_unit(seen[end], units[joint]):.5g}" for end in ("min", "max"))
        yield joint, low, high, units[joint], seen["levels"]


def _content(experiment: Experiment, ready: Prepared) -> dict[str, Any]:
    parameters = ready.problem.parameters
    triangle = factor_at_zero(ready.training, parameters.nominal())
    known = identify_from(triangle, parameters)
    channels = [*command_channels(experiment.system.arms)]
    angles = {channel: ready.dataset.column(channel)[ready.split.train] for channel in channels}
    every = parameters.with_free(parameters.names)
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
        "alignment": _alignment(ready.start),
        "warnings": list(ready.notices),
    }


def _alignment(start: Start) -> dict[str, Any] | None:
    """Where the base and the target were found, in SI; nothing where they are not looked for."""
    alignment = start.alignment
    if alignment is None:
        return None
    return {
        "tracker_T_base": [[*row, x] for row, x in zip(alignment.turn.tolist(), alignment.shift.tolist(), strict=True)],
        "target_moved_m": alignment.offset.tolist(),
        "typical_error_as_configured_m": start.configured,
        "typical_error_aligned_m": alignment.left,
        "undetermined": list(start.gauges),
        "start": "aligned" if start.taken else "configured",
    }


def _alignment_lines(start: Start) -> list[str]:
    """The same as people read it."""
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
