"""``armcal rehearse``."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import click
from armcal.cli.common import Console, overrides, speaking
from armcal.errors import EXIT_DONE, EXIT_INCOMPLETE
from armcal.io.folder import check_folder
from armcal.plugins import discover
from armcal.run.experiment import Experiment

from armcal_bench.acquisition.outputs import BENCH, OURS
from armcal_bench.acquisition.preparation import prepare
from armcal_bench.acquisition.rehearsal import overrides_for, port_instead_of_adapter, simulated_bench, truth
from armcal_bench.commands.acquire import driven, exit_code_of, schedule_forecast, show_forecast, show_outcome
from armcal_bench.commands.energising import always

_ANGLE = 180 / math.pi
_FILE = click.Path(path_type=Path)


@click.command()
@click.argument("config", type=_FILE)
@click.option("--plan", required=True, type=_FILE, help="The poses to measure: a CSV, as armcal plan writes it.")
@click.option("--out", required=True, type=_FILE, help="The folder to keep data, journal and the simulated bench in.")
@overrides
@speaking
def rehearse(console: Console, config: Path, plan: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Do what armcal acquire does, against the simulated bench of CONFIG, and say what its arm came to bear."""
    registry = discover()
    console.plugin_faults(registry)
    bench = out / BENCH
    adapter = port_instead_of_adapter(Experiment.load(config, overrides, registry=registry))
    experiment = Experiment.load(config, (*overrides, *overrides_for(bench), *adapter), registry=registry)
    prepared = prepare(experiment, plan)
    check_folder(out, OURS)
    if not console.json:
        show_forecast(console, prepared, schedule_forecast(prepared))
    with simulated_bench(config, overrides, bench):
        outcome = driven(console, prepared, plan, (out, "anew"), always, unchecked=True)
        content = truth(bench)
    outcome.summary["truth"] = content
    show_outcome(console, outcome, config, out)
    _show_truth(console, content)
    code = exit_code_of(outcome)
    sys.exit(EXIT_INCOMPLETE if code == EXIT_DONE and any(content.get("offences", {}).values()) else code)


def _show_truth(console: Console, content: dict[str, Any]) -> None:
    """What the simulated arm had to bear: how often, and the worst of each kind."""
    offences, worst = content.get("offences", {}), content.get("worst", {})
    counted = [f"{kind} {count} times{_worst(kind, worst)}" for kind, count in offences.items() if count]
    console.out.print(
        f"on the simulated arm's side, unsafe was: {'; '.join(counted) or 'nothing'}.", markup=False, soft_wrap=True
    )
    for kind, what in (("first_pulse", "the largest jump at a first pulse"), ("drop", "the deepest fall when let go")):
        if kind in worst:
            console.out.print(f"{what}: {_amount(kind, worst[kind])}.", markup=False, soft_wrap=True)


_UNITS = {
    **dict.fromkeys(("limits", "first_pulse", "drop"), (_ANGLE, "deg")),
    "speed": (_ANGLE, "deg/s"),
    "clearance": (1e3, "mm"),
    "pulse": (1e6, "us"),
    "heat": (1e2, "% of what the servo bears"),
    "energised_together": (1.0, "s apart"),
}
"""Of the bench's own account: what its numbers are multiplied by, and the unit that they then have."""


def _worst(kind: str, worst: dict[str, Any]) -> str:
    if kind not in worst:
        return ""
    factor, unit = _UNITS.get(kind, (1.0, ""))
    return f" (worst: {_amount(kind, worst[kind])}, where {factor * worst[kind]['limit']:.1f} {unit} is the limit)"


def _amount(kind: str, entry: dict[str, Any]) -> str:
    factor, unit = _UNITS.get(kind, (1.0, ""))
    return f"{entry['joint'] or 'the arm'} {factor * entry['value']:.1f} {unit}".rstrip()
