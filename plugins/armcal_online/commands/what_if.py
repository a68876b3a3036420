"""``armcal what-if``."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from armcal.calibration.calibration import Calibration
from armcal.cli.common import Console, speaking
from armcal.cli.predict import read_commands
from armcal.errors import InputError, Location
from armcal.estimate.validation import error_unit
from armcal.io.plain_files import check_output
from rich.table import Table

from armcal_online.tracking.settings import RecalibrateSettings
from armcal_online.tracking.start import filter_setup
from armcal_online.tracking.what_if import ranked

_SHOWN = 10


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option("--poses", required=True, type=click.Path(path_type=Path), help="A CSV of commanded joint angles.")
@click.option("--out", type=click.Path(path_type=Path), help="A CSV to write all poses to, best first.")
@click.option("--columns", multiple=True, metavar="NAME=COLUMN", help="What the CSV calls a column: sequence=pose_id.")
@speaking
def what_if(console: Console, calibration: Path, poses: Path, out: Path | None, columns: tuple[str, ...]) -> None:
    """Rank POSES by the information that one more record there would add to CALIBRATION, best first.

    Shown are the information in bits, the standard deviation of the prediction there, and the parameters whose
    standard deviations would shrink most.
    """
    registry = console.registry()
    loaded = Calibration.load(calibration, registry)
    commands = read_commands(registry, loaded, poses, columns)
    if out is not None and (out.resolve() in (poses.resolve(), calibration.resolve()) or not out.parent.is_dir()):
        raise InputError("it cannot be written there.", where=Location(str(out)), hint="Give another --out.")
    setup = filter_setup(loaded, RecalibrateSettings(evaluator="auto"), shares=False)
    worths, lost = ranked(setup, commands)
    if lost:
        console.warn(f"{len(lost)} poses have no elastic equilibrium, the first is {commands.ids[lost[0]]}.")
    unit = error_unit(setup.problem)
    rows: list[dict[str, Any]] = [
        {
            "rank": rank,
            "id": commands.ids[place],
            "row": commands.rows[place] if commands.rows else place + 1,
            "bits": worth.bits,
            f"prediction_sd_{unit}": 1000 * worth.deviation,
            "tells_most": dict(worth.tells_most),
        }
        for rank, (place, worth) in enumerate(worths, 1)
    ]
    if out is not None:
        check_output(out)
        with out.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, ["rank", "id", "row", "bits", f"prediction_sd_{unit}", "tells_most"])
            writer.writeheader()
            writer.writerows({**row, "tells_most": _reductions(row["tells_most"])} for row in rows)
    console.result({"poses": rows, "no_equilibrium": [commands.ids[place] for place in lost]})
    table = Table(title=f"what one more record would add: the best {min(_SHOWN, len(rows))} of {len(rows)} poses")
    for heading in ("pose", "bits", "prediction known to", "standard deviations that shrink most"):
        table.add_column(heading)
    for row in rows[:_SHOWN]:
        known = f"{row[f'prediction_sd_{unit}']:.3g} {unit}"
        table.add_row(str(row["id"]), f"{row['bits']:.2f}", known, _reductions(row["tells_most"]))
    console.out.print(table)
    if out is not None:
        console.line(f"{len(rows)} poses, best first: {out}")


def _reductions(remaining: Mapping[str, float]) -> str:
    """Of standard deviations, from the part of each that remains."""
    return ", ".join(f"{name} -{100 * (1 - part):.1f} %" for name, part in remaining.items())
