"""``armcal rehearse``, and ``armcal simulated-bench``, against which it is done."""

import math
import sys
from pathlib import Path
from typing import Any

import click
from armcal.cli.common import Console
from armcal.devices.simulated import BOARD, CLOCK, BenchRequest
from armcal.errors import EXIT_DONE, EXIT_INCOMPLETE
from armcal.io.folder import check_folder
from armcal.run.experiment import Experiment

from armcal_bench.acquisition.preparation import prepare
from armcal_bench.acquisition.rehearsal import (
    make_bench_folder,
    overrides_for,
    part_with_port,
    port_instead_of_adapter,
    simulated_bench,
    truth,
)
from armcal_bench.acquisition.run_log import BENCH, OURS
from armcal_bench.bench import Bench
from armcal_bench.commands.acquire import driven, exit_code_of, schedule_forecast, show_forecast, show_outcome
from armcal_bench.commands.common import FILE, always, load, on_bench, plan_option

_ANGLE = 180 / math.pi
_UNITS = {
    **dict.fromkeys(("limits", "first_pulse", "drop"), (_ANGLE, "deg")),
    "speed": (_ANGLE, "deg/s"),
    "clearance": (1e3, "mm"),
    "pulse": (1e6, "us"),
    "heat": (1e2, "% of what the servo bears"),
    "energised_together": (1.0, "s apart"),
}
"""Of the bench's own account: what its numbers are multiplied by, and the unit that they then have."""


@click.command()
@plan_option
@click.option("--out", required=True, type=FILE, help="The folder to keep data, journal and the simulated bench in.")
@on_bench
def rehearse(console: Console, config: Path, plan: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Do what armcal acquire does, against the simulated bench of CONFIG, and say what its arm came to bear."""
    bench = out / BENCH
    stated = load(console, config, overrides)
    simulated = (*overrides, *overrides_for(bench, part_with_port(stated)), *port_instead_of_adapter(stated))
    prepared = prepare(Experiment.load(config, simulated, registry=stated.registry), plan)
    for text in prepared.warnings:
        console.danger(text)
    check_folder(out, OURS)
    if not console.json:
        show_forecast(console, prepared, schedule_forecast(prepared))
    with simulated_bench(config, overrides, bench):
        outcome = driven(console, prepared, plan, (out, "anew"), always, unchecked=True)
        account = truth(bench)
    outcome.summary["truth"] = account
    show_outcome(console, outcome, config, out)
    # What the simulated arm had to bear: how often, and the worst of each kind.
    offences, worst = account.get("offences", {}), account.get("worst", {})
    counted = []
    for kind, count in offences.items():
        if count:
            factor, unit = _UNITS.get(kind, (1.0, ""))
            limit = f"{factor * worst[kind]['limit']:.1f} {unit}" if kind in worst else ""
            worst_text = f" (worst: {_amount(kind, worst[kind])}, where {limit} is the limit)" if limit else ""
            counted.append(f"{kind} {count} times{worst_text}")
    console.line(f"on the simulated arm's side, unsafe was: {'; '.join(counted) or 'nothing'}.")
    for kind, what in (("first_pulse", "the largest jump at a first pulse"), ("drop", "the deepest fall when let go")):
        if kind in worst:
            console.line(f"{what}: {_amount(kind, worst[kind])}.")
    code = exit_code_of(outcome)
    sys.exit(EXIT_INCOMPLETE if code == EXIT_DONE and any(account.get("offences", {}).values()) else code)


def _amount(kind: str, entry: dict[str, Any]) -> str:
    factor, unit = _UNITS.get(kind, (1.0, ""))
    return f"{entry['joint'] or 'the arm'} {factor * entry['value']:.1f} {unit}".rstrip()


@click.command(name="simulated-bench")
@click.option("--dir", "folder", required=True, type=FILE, help="Where its port and clock are.")
@on_bench
def simulated_bench_command(console: Console, config: Path, folder: Path, overrides: tuple[str, ...]) -> None:
    """Stand in for the bench of CONFIG: a servo board at DIR/board, a clock at DIR/clock, a tracker.

    It serves until SIGTERM or Ctrl-C. Its time passes only while a client lets it pass.
    """
    experiment = load(console, config, overrides)
    bench = Bench.of(experiment).simulator()
    make_bench_folder(folder)
    console.result({"board": str(folder / BOARD), "clock": str(folder / CLOCK)})
    console.line(f"simulated bench: {folder / BOARD}, {folder / CLOCK}")
    bench.serve(BenchRequest(experiment, folder))
