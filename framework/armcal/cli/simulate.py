"""``armcal simulate``."""

from pathlib import Path

import click

from armcal.cli.common import FILE, Console, overrides, spare_inputs, speaking
from armcal.measure.csv_writer import write_csv
from armcal.run.experiment import Experiment
from armcal.run.simulated import simulated, with_images


@click.command()
@click.argument("config", type=FILE)
@click.option("--out", required=True, type=FILE, help="The CSV to write.")
@click.option("--poses", type=FILE, help="A CSV of poses to measure, such as a plan, in place of the configured ones.")
@click.option("--images", type=FILE, help="A folder for images of each record, drawn of what the cameras see.")
@overrides
@speaking
def simulate(
    console: Console, config: Path, out: Path, poses: Path | None, images: Path | None, overrides: tuple[str, ...]
) -> None:
    """Simulate measurements as the simulation section of CONFIG says."""
    spare_inputs(out, poses)
    registry = console.registry()
    experiment = Experiment.load(config, overrides, registry=registry)
    dataset = simulated(experiment, poses)
    if images is not None:
        with console.progress() as progress:
            dataset = with_images(experiment, dataset, images, progress)
    write_csv(out, dataset, experiment.request(measured=True).channels)
    console.result({"records": len(dataset), "out": str(out), "images": None if images is None else str(images)})
    console.out.print(f"{len(dataset)} records written: {out}")
    if images is not None:
        reading = f"--set 'data={{type: images, folder: {images}, poses: {out}}}'"
        console.out.print(f"next: armcal run {config} {reading} --out DIR", soft_wrap=True)
