"""``armcal correction-table``."""

from pathlib import Path

import click
import numpy as np

from armcal.calibration.calibration import Calibration
from armcal.calibration.measured_point import Point
from armcal.cli.common import FILE, Console, accept, arm, point, spare_inputs, speaking, warn_of_target, within
from armcal.run.compensate import Bench
from armcal.run.correction_table import correction_table as made_table
from armcal.run.correction_table import read_table_settings, write_table


@click.command("correction-table")
@click.argument("calibration", type=FILE)
@click.option("--grid", required=True, type=FILE, help="A YAML file that describes the grid.")
@click.option("--out", required=True, type=FILE, help="The CSV to write.")
@arm
@within
@point
@accept
@speaking
def correction_table(
    console: Console,
    calibration: Path,
    grid: Path,
    out: Path,
    arm: str | None,
    within: Path | None,
    point: Point | None,
    accept: bool,
) -> None:
    """Make a table of what to send to a controller that takes the arm in CALIBRATION for the nominal one."""
    spare_inputs(out, calibration, grid, within)
    registry = console.registry()
    settings = read_table_settings(grid)
    loaded = Calibration.load(calibration, registry, accept)
    loaded.require_payload(settings.payload is not None)
    bench = Bench.of(loaded, arm, within, "nearest", registry, point or "tool")
    if point is None:
        warn_of_target(console, "this table brings", bench.target)
    table = made_table(bench.compensator(), bench.nominal(), settings)
    write_table(out, table)
    with_table, without = (1000 * column[np.isfinite(column)] for column in table.tried.T)
    figures = {
        "nodes": table.reached.size,
        "reached": int(table.reached.sum()),
        "tried": len(table.tried),
        "largest_shift_mm": 1000 * float(np.nanmax(np.linalg.norm(table.shifts, axis=-1))),
        "error_mm": float(with_table.mean()) if with_table.size else None,
        "error_95_mm": float(np.percentile(with_table, 95)) if with_table.size else None,
        "nominal_error_mm": float(without.mean()) if without.size else None,
    }
    console.result({**figures, "point": bench.point, "out": str(out)})
    console.line(f"{figures['reached']} of {figures['nodes']} nodes are reached: {out}")
    if not with_table.size:
        console.warn("no cell of the grid is reached at all its corners: the table was not tried between nodes")
        return
    text = f"between nodes {figures['error_mm']:.3g} mm (95 %: {figures['error_95_mm']:.3g} mm)"
    if figures["nominal_error_mm"] is not None:
        text += f", without the table {figures['nominal_error_mm']:.3g} mm"
    console.line(text)
