"""``armcal simulate``."""

from __future__ import annotations

from pathlib import Path

import click

from armcal.cli.common import FILE, Console, overrides, speaking
from armcal.measure.csv_writer import write_csv
from armcal.run.experiment import Experiment


@click.command()
@click.argument("config", type=FILE)
@click.option("--out", required=True, type=FILE, help="The CSV to write.")
@overrides
@speaking
def simulate(console: Console, config: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Simulate measurements as the simulation section of CONFIG says."""
    registry = console.registry()
    experiment = Experiment.load(config, overrides, registry=registry)
    dataset = experiment.simulator().simulate(experiment.simulation_request)
    write_csv(out, dataset, experiment.request(measured=True).channels)
    console.result({"records": len(dataset), "out": str(out)})
    console.out.print(f"{len(dataset)} records written: {out}")
