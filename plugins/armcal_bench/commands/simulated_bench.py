"""``armcal simulated-bench``."""

from __future__ import annotations

from pathlib import Path

import click
from armcal.cli.common import Console, overrides, speaking
from armcal.devices.simulated import BOARD, CLOCK, BenchRequest
from armcal.errors import InputError, Location
from armcal.plugins import discover
from armcal.run.experiment import Experiment

from armcal_bench.bench import Bench


@click.command(name="simulated-bench")
@click.argument("config", type=click.Path(path_type=Path))
@click.option("--dir", "folder", required=True, type=click.Path(path_type=Path), help="Where its port and clock are.")
@overrides
@speaking
def simulated_bench(console: Console, config: Path, folder: Path, overrides: tuple[str, ...]) -> None:
    """Stand in for the bench of CONFIG: a servo board at DIR/board, a clock at DIR/clock, a tracker.

    It serves until SIGTERM or Ctrl-C. Its time passes only while a client lets it pass.
    """
    registry = discover()
    console.plugin_faults(registry)
    experiment = Experiment.load(config, overrides, registry=registry)
    bench = Bench.of(experiment).simulator()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise InputError(
            f"the folder cannot be made ({fault.strerror or fault}).",
            where=Location(str(folder)),
            hint="Give a folder that can be written.",
        ) from fault
    console.result({"board": str(folder / BOARD), "clock": str(folder / CLOCK)})
    console.out.print(f"simulated bench: {folder / BOARD}, {folder / CLOCK}", markup=False, soft_wrap=True)
    bench.serve(BenchRequest(experiment, folder))
