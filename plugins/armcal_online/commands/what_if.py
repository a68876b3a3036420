"""``armcal what-if``."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.cli.common import Console, speaking
from armcal.cli.predict import read_commands
from armcal.errors import InputError, Location
from armcal.estimate.validation import error_unit
from armcal.io.plain_files import check_output
from armcal.plugins import discover
from rich.table import Table

from armcal_online.tracking.pose_worth import PoseWorth, ranked
from armcal_online.tracking.settings import RecalibrateSettings
from armcal_online.tracking.start import filter_setup

_SHOWN = 10


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option("--poses", required=True, type=click.Path(path_type=Path), help="A CSV of commanded joint angles.")
@click.option("--out", type=click.Path(path_type=Path), help="A CSV to write all poses to, best first.")
@click.option("--columns", multiple=True, metavar="NAME=COLUMN", help="What the CSV calls a column: sequence=pose_id.")
@speaking
def what_if(console: Console, calibration: Path, poses: Path, out: Path | None, columns: tuple[str, ...]) -> None:
    """How much one more record at each of POSES would tell of the arm in CALIBRATION, best first.

    That is the information in bits, how well the prediction there is known, and the parameters whose standard
    deviations would shrink most.
    """
    registry = discover()
    console.plugin_faults(registry)
    loaded = Calibration.load(calibration, registry)
    commands = read_commands(registry, loaded, poses, columns)
    if out is not None and (out.resolve() in (poses.resolve(), calibration.resolve()) or not out.parent.is_dir()):
        raise InputError("it cannot be written there.", where=Location(str(out)), hint="Give another --out.")
    setup = filter_setup(loaded, RecalibrateSettings(evaluator="auto"), shares=False)
    pose_worths, lost = ranked(setup, commands)
    if lost:
        console.warn(f"{len(lost)} poses have no elastic equilibrium, the first is {commands.ids[lost[0]]}.")
    unit = error_unit(setup.problem)
    rows = [_row(rank, pose_worth, commands, unit) for rank, pose_worth in enumerate(pose_worths, 1)]
    if out is not None:
        _write(out, rows, unit)
    console.result({"poses": rows, "no_equilibrium": [commands.ids[place] for place in lost]})
    console.out.print(_table(rows, unit))
    if out is not None:
        console.out.print(f"{len(rows)} poses, best first: {out}", markup=False, soft_wrap=True)


def _row(rank: int, pose_worth: PoseWorth, commands: Dataset, unit: str) -> dict[str, Any]:
    return {
        "rank": rank,
        "id": commands.ids[pose_worth.place],
        "row": commands.rows[pose_worth.place] if commands.rows else pose_worth.place + 1,
        "bits": pose_worth.worth.bits,
        f"prediction_sd_{unit}": 1000 * pose_worth.worth.deviation,
        "tells_most": dict(pose_worth.worth.tells_most),
    }


def _shrinks(told: Mapping[str, float]) -> str:
    return ", ".join(f"{name} -{100 * (1 - left):.1f} %" for name, left in told.items())


def _write(out: Path, rows: Sequence[Mapping[str, Any]], unit: str) -> None:
    check_output(out)
    headings = ("rank", "id", "row", "bits", f"prediction_sd_{unit}", "tells_most")
    with out.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(headings)
        for row in rows:
            table.writerow([*(row[name] for name in headings[:-1]), _shrinks(row["tells_most"])])


def _table(rows: Sequence[Mapping[str, Any]], unit: str) -> Table:
    """The best poses."""
    table = Table(title=f"what one more record would tell: the best {min(_SHOWN, len(rows))} of {len(rows)} poses")
    for heading in ("pose", "bits", "prediction known to", "standard deviations that shrink most"):
        table.add_column(heading)
    for row in rows[:_SHOWN]:
        known = f"{row[f'prediction_sd_{unit}']:.3g} {unit}"
        table.add_row(str(row["id"]), f"{row['bits']:.2f}", known, _shrinks(row["tells_most"]))
    return table
