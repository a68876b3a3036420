"""``armcal simulate``."""

from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from armcal.base.dataset import Dataset
from armcal.cli.common import FILE, Console, overrides, spare_inputs, speaking
from armcal.errors import ConfigError
from armcal.estimate.estimator import Progress
from armcal.estimate.simulation import TruthfulSimulator
from armcal.estimate.start import carriers_of
from armcal.io.folder import check_folder
from armcal.io.plain_files import write_over
from armcal.measure.csv_writer import write_csv
from armcal.measure.instrument import Rendering
from armcal.measure.measurement import borrowed_names
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal.run.plan_poses import read_poses


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
    dataset = _simulated(experiment, poses)
    if images is not None:
        with console.progress() as progress:
            dataset = _with_images(experiment, dataset, images, progress)
    write_csv(out, dataset, experiment.request(measured=True).channels)
    console.result({"records": len(dataset), "out": str(out), "images": None if images is None else str(images)})
    console.out.print(f"{len(dataset)} records written: {out}")
    if images is not None:
        reading = f"--set 'data={{type: images, folder: {images}, poses: {out}}}'"
        console.out.print(f"next: armcal run {config} {reading} --out DIR", soft_wrap=True)


def _simulated(experiment: Experiment, poses: Path | None) -> Dataset:
    """Records as the configured simulator makes them, at the poses of a file if one is given.

    Raises:
        ConfigError: no simulator is configured, or it does not take poses.
        DataError: the poses are refused.
    """
    listed = None if poses is None else read_poses(experiment, poses)
    dataset = experiment.simulator().simulate(replace(experiment.simulation_request, poses=listed))
    if listed is not None and dataset.ids != listed.ids:
        raise ConfigError(
            f"the simulator made {len(dataset)} records of its own, expected the {len(listed)} poses of {poses}.",
            where=experiment.source.where(("simulation", "type")),
            hint="Leave --poses out, or use the simulator elastic_arm.",
        )
    return dataset


def _with_images(experiment: Experiment, dataset: Dataset, folder: Path, progress: Progress) -> Dataset:
    """Simulated records with a file of an image each, in place of what was read of it.

    Of several cameras each has a folder of its own name.

    Raises:
        ConfigError: no measurement draws images, or the simulator does not say what is true.
        InputError: the images cannot be written.
        PluginError: a library is not there.
    """
    simulator, cameras = experiment.simulator(), experiment.system.measurements
    drawing = {name: m for name, m in cameras.items() if isinstance(m, Rendering)}
    if not drawing or not isinstance(simulator, TruthfulSimulator):
        part = "measurements" if not drawing else "simulation"
        message = "none of them draws images." if not drawing else "this simulator does not say what is true."
        hint = "Configure a measurement of type camera, and the simulator elastic_arm."
        raise ConfigError(message, where=experiment.source.where((part,)), hint=hint)
    true, stood = simulator.stood(experiment.simulation_request, dataset)
    fixed = true.parameters.with_free(())
    problem = Problem.build(true.arms, true.measurements, fixed, true.environment, stood, "interpreted")
    records, values, files = problem.of(stood).records, fixed.nominal(), tuple(f"{name}.png" for name in dataset.ids)
    for number, kernel in enumerate(problem.kernels):
        name = kernel.factor.name
        if name not in drawing:
            continue
        place = folder if len(drawing) == 1 else folder / name
        check_folder(place, files)
        place.mkdir(parents=True, exist_ok=True)
        full = {b.name.removeprefix(f"{name}."): b.name for b in fixed.blocks if b.name.startswith(f"{name}.")}
        full |= borrowed_names(drawing[name])  # of another camera's boards
        own = {local: values[fixed.entries_of(block)] for local, block in full.items()}
        frames = carriers_of(problem.with_records(records).subset(np.arange(len(stood))), values, stood, number)
        for done, content in enumerate(drawing[name].rendered(frames, own), start=1):
            write_over({place / files[done - 1]: content})
            progress("drawing", done / len(dataset))
    channels = {c: v for c, v in dataset.channels.items() if c.partition(".")[0] not in drawing}
    return replace(dataset, channels=channels, extra={**dataset.extra, "image": files})
