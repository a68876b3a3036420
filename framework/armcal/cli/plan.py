"""``armcal plan``."""

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
from scipy.spatial.transform import Rotation

from armcal.cli.common import FILE, Console, overrides, speaking
from armcal.errors import ConfigError, InputError, Location
from armcal.estimate.identifiability import Measure
from armcal.measure.csv_writer import write_csv
from armcal.planning.criterion import GOALS
from armcal.report.document import Document, Section, Table
from armcal.run.experiment import Experiment
from armcal.run.iso_plan import NAMES, POINTS, make_iso_plan
from armcal.run.plan import PlanResult, make_plan
from armcal.run.plan_poses import counts_text, stated_beyond
from armcal.run.settings import PlanSettings

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
@click.option("--given", type=FILE, help="Records that are there already: a CSV of them, or of their ids.")
@click.option("--calibration", type=FILE, help="Plan about the values of this calibration.yaml.")
@click.option("--goal", type=click.Choice(GOALS), help="D, A, E, or O1 to O5 [default: D, or the configured one].")
@click.option("--order", type=click.Choice(["travel", "torque", "none"]), help="Order of visit [default: travel].")
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
    chosen = [f"plan.{key}={given[key]}" for key in ("goal", "order") if given[key]]
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
    content = {**_content(experiment, result), "out": str(out), "seconds": time.perf_counter() - began}
    for text in experiment.warnings:
        console.warn(text)
    console.show(_document(content))
    console.line(f"plan: {out}  ({content['seconds']:.1f} s)")


def _edge(given: Mapping[str, Any], count: int | None) -> float | None:
    """The edge of the cube (m); None for the largest, or where none is planned.

    Raises:
        InputError: neither poses nor a cube are asked for, both are, or the size is none.
    """
    text = given["iso_cube"]
    if (text is None) == (count is None):
        raise InputError("give --poses N to calibrate, or --iso-cube SIZE_MM to test; one of them.")
    if text is None:
        return None
    if idle := [name for name in ("data", "candidates", "given", "goal", "order") if given[name]]:
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


def _content(experiment: Experiment, result: PlanResult) -> dict[str, Any]:
    settings, bound = experiment.settings.plan or PlanSettings(), result.certificate
    certificate = bound and {
        "upper": bound.bound,
        "gap": bound.bound - result.value,
        "efficiency": bound.efficiency,
    }
    units = [block.unit for block in experiment.parameters.coordinate_blocks]
    scales = experiment.parameters.scales()
    before, after = result.deviations
    return {
        "experiment": experiment.name,
        "goal": settings.goal,
        "poses": len(result.dataset),
        "ids": list(result.dataset.ids),
        "given_records": result.given,
        "candidates": {
            "kind": result.pool.kind,
            "count": len(result.pool.dataset),
            "left_out": dict(result.pool.left_out),
            "refined": result.refined,
        },
        "starts": result.starts,
        "value": result.value,
        "log_det": result.log_det,
        "bound": certificate,
        "observability": result.observability.as_dict(),
        "equations": result.equations,
        "parameters": [
            {
                "name": name,
                "unit": unit,
                "sd_before": float(before[i]) if math.isfinite(before[i]) else None,
                "sd_after": float(after[i]),
                "sd_in_ordinary_sizes": float(after[i] / scales[i]),
            }
            for i, (name, unit) in enumerate(zip(result.names, units, strict=True))
        ],
        "weakest": str(result.identifiability.weakest),
        "visit": {"order": settings.order, "travel_s": result.travel_s, "peak_squared_torque": result.peak},
    }


def _document(content: dict[str, Any]) -> Document:
    pool, visit, parameters = content["candidates"], content["visit"], content["parameters"]
    omitted = f" ({counts_text(pool['left_out'])} left out)" if pool["left_out"] else ""
    given = f" after {content['given_records']} given records" if content["given_records"] else ""
    moved = f"; {pool['refined']} of the plan moved on from there" if pool["refined"] else ""
    kinds = {"continuous": "spread through joint space", "grid": "of a grid", "listed": "listed"}
    headline = (
        f"{content['experiment']}: {content['poses']} of {pool['count']} candidates "
        f"{kinds.get(pool['kind'], pool['kind'])}{omitted}{moved}{given}, goal {content['goal']}, for "
        f"{len(parameters)} parameters; {content['starts']} starts."
    )
    goal_value = "" if content["goal"] in ("D", "O1") else f", goal's value {content['value']:.6g}"
    indices = "  ".join(f"{name.upper()} {value:.4g}" for name, value in content["observability"].items())
    rows: list[tuple[str, ...]] = []
    worst = np.argsort([-p["sd_in_ordinary_sizes"] for p in parameters], kind="stable")[:_SHOWN]
    for p in (parameters[i] for i in worst):
        measure = Measure(p["unit"], 1.0)
        texts = ["-" if p[key] is None else f"{measure.shown(p[key])[0]:.3g}" for key in ("sd_before", "sd_after")]
        rows.append((p["name"], *texts, measure.shown(0.0)[1] or p["unit"]))
    caption = "Predicted standard deviations, the largest first"
    table = Table(caption, ("parameter", "before", "after", "unit"), rows, left=("unit",))
    hot = visit["peak_squared_torque"]
    heat_text = f"; squared torque, averaged over 5 poses, at most {hot:.2f} of the largest" if hot is not None else ""
    criterion = [f"log determinant {content['log_det']:.4f}{goal_value}", f"observability: {indices}"]
    certified = "how good another choice could be is not known for this goal."
    if (bound := content["bound"]) is not None:
        criterion.append(f"upper bound {bound['upper']:.4f}, gap {bound['gap']:.4f}")
        certified = (
            f"{content['goal']}-efficiency at least {100 * bound['efficiency']:.2f} %, certified by the equivalence "
        )
        certified += "theorem"
        certified += " over the candidates listed here, not all of joint space" * (pool["kind"] == "continuous") + "."
    sections = [
        Section("Precision", parts=[table, f"least determined: {content['weakest']}."], level="always"),
        Section("Criterion", parts=criterion, level="verbose"),
    ]
    order = f"order of visit: {visit['order']}, {visit['travel_s']:.0f} s between poses{heat_text}."
    return Document("Plan", headline, sections, summary=[certified, order], data=content)


def _show_iso_plan(
    console: Console, experiment: Experiment, size: float | None, out: Path, options: Mapping[str, Any]
) -> None:
    """Plan the test in a cube of this size (m; None: the largest), write it to ``out`` and show it."""
    began = time.perf_counter()
    cube, dataset, warnings = make_iso_plan(
        experiment, size, options["cycles"], options["directions"], options["calibration"]
    )
    write_csv(out, dataset, experiment.request(measured=False).channels)
    turned = None
    if cube.rotation is not None:
        turned = Rotation.from_matrix(cube.rotation).as_euler("xyz", degrees=True).tolist()
    centre, poses = (
        (cube.centre * _MM).tolist(),
        dict(zip(NAMES, ((cube.centre + cube.size * POINTS) * _MM).tolist(), strict=True)),
    )
    console.result(
        {
            "experiment": experiment.name,
            "cube": {"size_mm": cube.size * _MM, "centre_mm": centre},
            "tool_rpy_deg": turned,
            "poses": poses,
            "cycles": options["cycles"],
            "visits": len(dataset),
            "directions": list(dict.fromkeys(dataset.extra["direction"])),
            "warnings": list(warnings),
            "out": str(out),
        }
    )
    for text in warnings:
        console.warn(text)
    at, angles = (", ".join(f"{number:.1f}" for number in numbers) for numbers in (centre, turned or ()))
    console.line(
        f"{experiment.name}: cube of {cube.size * _MM:g} mm about ({at}) mm, "
        + (f"tool at roll, pitch, yaw ({angles}) deg." if turned else "the tool turns from pose to pose.")
    )
    rows = ((name, *(f"{coordinate:.1f}" for coordinate in place)) for name, place in poses.items())
    console.table("Poses of the tool, mm, base frame", ("pose", "x", "y", "z"), rows)
    visits = f"{len(dataset)} visits in {options['cycles']} cycles"
    console.line(f"{visits}: {out}  ({time.perf_counter() - began:.1f} s)")
    console.line("Measure each visit, add the columns of the instrument, and give the table to armcal acceptance.")
