"""``armcal simulated-bench``."""

from __future__ import annotations

from pathlib import Path

import click
from armcal.cli.common import Console
from armcal.devices.simulated import BOARD, CLOCK, BenchRequest

from armcal_bench.acquisition.rehearsal import make_bench_folder
from armcal_bench.bench import Bench
from armcal_bench.commands.common import FILE, load, on_bench


@click.command(name="simulated-bench")
@click.option("--dir", "folder", required=True, type=FILE, help="Where its port and clock are.")
@on_bench
def simulated_bench(console: Console, config: Path, folder: Path, overrides: tuple[str, ...]) -> None:
    """Stand in for the bench of CONFIG: a servo board at DIR/board, a clock at DIR/clock, a tracker.

    It serves until SIGTERM or Ctrl-C. Its time passes only while a client lets it pass.
    """
    experiment = load(console, config, overrides)
    bench = Bench.of(experiment).simulator()
    make_bench_folder(folder)
    console.result({"board": str(folder / BOARD), "clock": str(folder / CLOCK)})
    console.out.print(f"simulated bench: {folder / BOARD}, {folder / CLOCK}", markup=False, soft_wrap=True)
    bench.serve(BenchRequest(experiment, folder))
