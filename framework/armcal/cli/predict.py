"""``armcal predict``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from armcal.base.config_text import ConfigText
from armcal.cli.common import Voice, speaking
from armcal.errors import DataError, Location
from armcal.measure.csv_writer import write_csv
from armcal.measure.environment import noticed
from armcal.measure.reader import ReadRequest, wanted_channels
from armcal.plugins import discover
from armcal.use.calibration import Calibration


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option("--poses", required=True, type=click.Path(path_type=Path), help="A CSV of commanded joint angles.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The CSV to write.")
@speaking
def predict(voice: Voice, calibration: Path, poses: Path, out: Path) -> None:
    """Predict the tip of the arm in CALIBRATION for each row of commanded joint angles."""
    registry = discover()
    voice.plugin_faults(registry)
    loaded = Calibration.load(calibration, registry)
    system = loaded.system
    reader_class = registry.find("reader", "csv").load()
    reader = reader_class(reader_class.Settings(path=ConfigText(str(poses))))
    # Measured columns, if there are any, are not read: every row of commands gets its prediction.
    commands = noticed(reader.read(ReadRequest(system.arms, {}, wanted_channels(system.arms, {}, measured=False))))
    missing = [name for name in loaded.record.environment_columns if not commands.has(name) and name != "time"]
    if missing:
        voice.warn(f"the calibration's records had {', '.join(missing)}; these poses take the configured values.")
    for text in commands.warnings:
        voice.warn(text)
    channels, _ = loaded.predict(commands)
    if out.resolve() == poses.resolve():
        raise DataError("it is the file of poses itself.", where=Location(str(out)), hint="Give another --out.")
    predicted = replace(commands, channels=channels, extra={})
    wanted = wanted_channels(system.arms, system.measurements, measured=False)
    write_csv(out, predicted, [channel for channel in wanted if channel.channel in channels])
    voice.result({"poses": len(commands), "set_aside": len(commands.set_aside), "out": str(out)})
    voice.out.print(f"{len(commands)} poses predicted: {out}", markup=False)
