"""``armcal rehearse``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from armcal.bench.acquisition.outputs import BENCH, OURS
from armcal.bench.acquisition.preparation import prepare
from armcal.bench.acquisition.rehearsal import overrides_for, port_instead_of_adapter, simulated_bench, truth
from armcal.cli.acquire import driven, outlook_of, show_outcome, show_outlook
from armcal.cli.common import Voice, overrides, speaking
from armcal.cli.energising import always
from armcal.errors import EXIT_DONE, EXIT_STOPPED
from armcal.plugins import discover
from armcal.run.experiment import Experiment
from armcal.run.folder import check_folder

_FILE = click.Path(path_type=Path)


@click.command()
@click.argument("config", type=_FILE)
@click.option("--plan", required=True, type=_FILE, help="The poses to measure: a CSV, as armcal plan writes it.")
@click.option("--out", required=True, type=_FILE, help="The folder to keep data, journal and the simulated bench in.")
@overrides
@speaking
def rehearse(voice: Voice, config: Path, plan: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Do what armcal acquire does, against the simulated bench of CONFIG, and say what its arm came to bear."""
    registry = discover()
    voice.plugin_faults(registry)
    bench = out / BENCH
    adapter = port_instead_of_adapter(Experiment.load(config, overrides, registry=registry))
    experiment = Experiment.load(config, (*overrides, *overrides_for(bench), *adapter), registry=registry)
    prepared = prepare(experiment, plan)
    check_folder(out, OURS)
    if not voice.json:
        show_outlook(voice, prepared, outlook_of(prepared))
    with simulated_bench(config, overrides, bench):
        outcome = driven(voice, prepared, plan, out, "anew", always)
        found = truth(bench)
    outcome.summary["truth"] = found
    show_outcome(voice, outcome, config, out)
    _show_truth(voice, found)
    sys.exit(EXIT_DONE if outcome.ending.how == "done" else EXIT_STOPPED)


def _show_truth(voice: Voice, found: dict[str, Any]) -> None:
    """What the simulated arm had to bear."""
    offences = found.get("offences", {})
    told = ", ".join(f"{kind} {count} times" for kind, count in offences.items() if count) or "nothing"
    voice.out.print(f"on the simulated arm's side, unsafe was: {told}.", markup=False, soft_wrap=True)
