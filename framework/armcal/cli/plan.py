"""``armcal plan`` and ``armcal simulate``: poses to measure, and what they would give."""

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from scipy.spatial.transform import Rotation

from armcal.base.dataset import Dataset
from armcal.cli.common import FILE, Console, overrides, spare_inputs, speaking
from armcal.errors import ConfigError, InputError, Location
from armcal.estimate.estimator import Progress
from armcal.estimate.identifiability import Measure
from armcal.estimate.simulation import TruthfulSimulator
from armcal.estimate.start import carriers_of
from armcal.io.plain_files import check_folder, write_over
from armcal.measure.measurement import Rendering, borrowed_names
from armcal.measure.tables import write_csv
from armcal.problem.problem import Problem
from armcal.report.document import Document, Section, Table
from armcal.run.experiment import Experiment, PlanSettings
from armcal.run.plan import NAMES, POINTS, PlanResult, counts_text, make_iso_plan, make_plan, read_poses, stated_beyond

_SHOWN = 8
_LARGEST_CUBE_MM = 10_000.0
_MM = 1000.0


@click.command()
@click.argument("config", type=FILE)
@click.option("--poses", "count", type=click.IntRange(min=1), help="How many poses to plan.")
@click.option(
    "--iso-cube",
    metavar="SIZE_MM|auto",
    help="Plan the test of ISO 9283 instead, in a cube with edges of this length, or in the largest that fits.",
)
@click.option("--cycles", type=click.IntRange(min=2), default=30, show_default=True, help="Of --iso-cube.")
@click.option(
    "--directions",
    type=click.IntRange(0, 3),
    default=3,
    show_default=True,
    help="Of --iso-cube: directions of approach for vAP, along x, y and z.",
)
@click.option("--out", required=True, type=FILE, help="The CSV to write, in the order of visit.")
@click.option("--data", type=FILE, help="A dataset to choose from instead of the configured one.")
@click.option("--candidates", type=FILE, help="A CSV of poses to choose from.")
@click.option("--given", type=FILE, help="A CSV of records that are there already.")
@click.option("--calibration", type=FILE, help="Plan about the values of this calibration.yaml.")
@click.option("--order", type=click.Choice(["travel", "none"]), help="Order of visit [default: travel].")
@overrides
@speaking
def plan(
    console: Console, config: Path, count: int | None, out: Path, overrides: tuple[str, ...], **given: Any
) -> None:
    """Choose the poses that determine the free parameters of CONFIG best, and say how good any could be."""
    began = time.perf_counter()
    if out.is_dir() or not out.absolute().parent.is_dir():
        text = "it is a directory" if out.is_dir() else "its directory is not there"
        raise ConfigError(f"--out {out}: {text}.", hint="Give the path of a CSV in a directory that is there.")
    registry = console.registry()
    edge = _edge(given, count)
    chosen = [f"plan.order={given['order']}"] if given["order"] else []
    experiment = Experiment.load(config, (*overrides, *chosen), given["data"], registry)
    settings = experiment.settings.plan or PlanSettings()
    for text in stated_beyond(experiment, {**settings.limits, **settings.travel_limits}):
        console.danger(text)
    if given["iso_cube"]:
        _show_iso_plan(console, experiment, edge, out, given)
        return
    assert count is not None
    with console.progress() as progress:
        result = make_plan(experiment, count, given["candidates"], given["given"], given["calibration"], progress)
    write_csv(out, result.dataset, experiment.request(measured=False).channels)
    seconds = time.perf_counter() - began
    for text in experiment.warnings:
        console.warn(text)
    console.show(_plan_document(experiment, result), out=str(out), seconds=seconds)
    console.line(f"plan: {out}  ({seconds:.1f} s)")


def _edge(given: Mapping[str, Any], count: int | None) -> float | None:
    """The edge of the cube (m); None for the largest, or where none is planned."""
    text = given["iso_cube"]
    if (text is None) == (count is None):
        raise InputError("give --poses N to calibrate, or --iso-cube SIZE_MM to test; one of them.")
    if text is None:
        return None
    if idle := [name for name in ("data", "candidates", "given", "order") if given[name]]:
        raise InputError(f"--{idle[0]} has no meaning with --iso-cube.", hint="Leave it out.")
    if text == "auto":
        return None
    try:
        size = float(text)
    except ValueError:
        size = math.nan
    if not 1 <= size <= _LARGEST_CUBE_MM:
        raise InputError(
            f"found {text!r}, expected an edge of 1 to {_LARGEST_CUBE_MM:g} mm, or auto.", where=Location("--iso-cube")
        )
    return size / 1000


def _plan_document(experiment: Experiment, result: PlanResult) -> Document:
    pool, parameters = result.pool, experiment.parameters
    units = [block.unit for block in parameters.coordinate_blocks]
    data: dict[str, Any] = {
        "experiment": experiment.name,
        "poses": len(result.dataset),
        "ids": list(result.dataset.ids),
        "given_records": result.given,
        "candidates": {
            "kind": pool.kind,
            "count": len(pool.dataset),
            "left_out": dict(pool.left_out),
            "refined": result.refined,
        },
        "starts": result.starts,
        "log_det": result.log_det,
        "bound": {"upper": result.bound, "gap": result.bound - result.log_det, "efficiency": result.efficiency},
        "observability": asdict(result.observability),
        "equations": result.equations,
        "parameters": [
            {"name": name, "unit": unit, "sd_before": before, "sd_after": after, "sd_in_ordinary_sizes": after / scale}
            for name, unit, before, after, scale in zip(
                result.names, units, *result.deviations.tolist(), parameters.scales().tolist(), strict=True
            )
        ],
        "weakest": str(result.identifiability.weakest),
        "visit": {"order": (experiment.settings.plan or PlanSettings()).order, "travel_s": result.travel_s},
    }
    omitted = f" ({counts_text(pool.left_out)} left out)" if pool.left_out else ""
    given = f" after {result.given} given records" if result.given else ""
    moved = f"; {result.refined} of the plan moved on from there" if result.refined else ""
    kinds = {"continuous": "spread through joint space", "grid": "of a grid", "listed": "listed"}
    headline = (
        f"{experiment.name}: {len(result.dataset)} of {len(pool.dataset)} candidates "
        f"{kinds.get(pool.kind, pool.kind)}{omitted}{moved}{given}, for {len(result.names)} parameters; "
        f"{result.starts} starts."
    )
    certified = f"D-efficiency at least {100 * result.efficiency:.2f} %, certified by the equivalence theorem"
    certified += " over the candidates listed here, not all of joint space" * (pool.kind == "continuous") + "."
    visit = f"order of visit: {data['visit']['order']}, {result.travel_s:.0f} s between poses."
    rows: list[tuple[str, ...]] = []
    for parameter in sorted(data["parameters"], key=lambda p: -p["sd_in_ordinary_sizes"])[:_SHOWN]:
        measure = Measure(parameter["unit"], 1.0)
        sds = (parameter["sd_before"], parameter["sd_after"])
        texts = [f"{measure.shown(sd)[0]:.3g}" if math.isfinite(sd) else "-" for sd in sds]
        rows.append((parameter["name"], *texts, measure.shown(0.0)[1] or parameter["unit"]))
    caption = "Predicted standard deviations, the largest first"
    table = Table(caption, ("parameter", "before", "after", "unit"), rows, left=("unit",))
    criterion = [
        f"log determinant {result.log_det:.4f}, upper bound {result.bound:.4f}",
        "observability: " + "  ".join(f"{name.upper()} {index:.4g}" for name, index in data["observability"].items()),
    ]
    sections = [
        Section("Precision", parts=[table, f"least determined: {data['weakest']}."], level="always"),
        Section("Criterion", parts=criterion, level="verbose"),
    ]
    return Document("Plan", headline, sections, summary=[certified, visit], data=data)


def _show_iso_plan(
    console: Console, experiment: Experiment, size: float | None, out: Path, options: Mapping[str, Any]
) -> None:
    began, cycles = time.perf_counter(), options["cycles"]
    cube, dataset, warnings = make_iso_plan(experiment, size, cycles, options["directions"], options["calibration"])
    write_csv(out, dataset, experiment.request(measured=False).channels)
    turned, words = None, "the tool turns from pose to pose."
    if cube.rotation is not None:
        turned = Rotation.from_matrix(cube.rotation).as_euler("xyz", degrees=True).tolist()
        words = f"tool at roll, pitch, yaw ({', '.join(f'{angle:.1f}' for angle in turned)}) deg."
    centre, places = (cube.centre * _MM).tolist(), ((cube.centre + cube.size * POINTS) * _MM).tolist()
    data = {
        "experiment": experiment.name,
        "cube": {"size_mm": cube.size * _MM, "centre_mm": centre},
        "tool_rpy_deg": turned,
        "poses": dict(zip(NAMES, places, strict=True)),
        "cycles": cycles,
        "visits": len(dataset),
        "directions": list(dict.fromkeys(dataset.extra["direction"])),
        "warnings": list(warnings),
    }
    for text in warnings:
        console.warn(text)
    at = ", ".join(f"{number:.1f}" for number in centre)
    headline = f"{experiment.name}: cube of {cube.size * _MM:g} mm about ({at}) mm, {words}"
    rows = [(name, *(f"{x:.1f}" for x in place)) for name, place in zip(NAMES, places, strict=True)]
    table = Table("Poses of the tool, mm, base frame", ("pose", "x", "y", "z"), rows)
    console.show(Document("Plan", headline, [Section("Poses", parts=[table], level="always")], data=data), out=str(out))
    console.line(f"{len(dataset)} visits in {cycles} cycles: {out}  ({time.perf_counter() - began:.1f} s)")
    console.line("Measure each visit, add the columns of the instrument, and give the table to armcal acceptance.")


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
    listed = None if poses is None else read_poses(experiment, poses)
    dataset = experiment.simulator().simulate(replace(experiment.simulation_request, poses=listed))
    if listed is not None and dataset.ids != listed.ids:
        raise ConfigError(
            f"the simulator made {len(dataset)} records of its own, expected the {len(listed)} poses of {poses}.",
            where=experiment.source.where(("simulation", "type")),
            hint="Leave --poses out, or use the simulator elastic_arm.",
        )
    if images is not None:
        with console.progress() as progress:
            dataset = _with_images(experiment, dataset, images, progress)
    write_csv(out, dataset, experiment.request(measured=True).channels)
    console.result({"records": len(dataset), "out": str(out), "images": None if images is None else str(images)})
    console.out.print(f"{len(dataset)} records written: {out}")
    if images is not None:
        reading = f"--set 'data={{type: images, folder: {images}, poses: {out}}}'"
        console.out.print(f"next: armcal run {config} {reading} --out DIR", soft_wrap=True)


def _with_images(experiment: Experiment, dataset: Dataset, folder: Path, progress: Progress) -> Dataset:
    """Simulated records with a file of an image each, in place of what was read of it; a folder for each camera."""
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
