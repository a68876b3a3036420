"""``armcal predict``."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from armcal.base.config_text import ConfigText
from armcal.base.dataset import Dataset
from armcal.base.quaternions import quaternion_of
from armcal.base.units import DIMENSIONLESS, readable, to_unit
from armcal.calibration.calibration import Calibration
from armcal.calibration.intervals import PlusMinus
from armcal.calibration.recorded_range import beyond_records
from armcal.cli.common import FILE, Console, accept, spare_inputs, speaking
from armcal.measure.checks import records_of
from armcal.measure.csv_writer import column_names, write_csv
from armcal.measure.environment import noticed
from armcal.measure.reader import ReadRequest, RequestedChannel, requested_channels
from armcal.plugins import PluginRegistry
from armcal.run.compensate import short_texts

_MOST_NAMED = 8
_LAYOUT = "Name columns so, or as the calibration's data did, with commas between them and decimal points."


@click.command()
@click.argument("calibration", type=FILE)
@click.option("--poses", required=True, type=FILE, help="A CSV of commanded joint angles.")
@click.option("--out", required=True, type=FILE, help="The CSV to write.")
@accept
@speaking
def predict(console: Console, calibration: Path, poses: Path, out: Path, accept: bool) -> None:
    """Predict the tip of the arm in CALIBRATION for each row of commanded joint angles, and how far it may be off."""
    spare_inputs(out, calibration, poses)
    registry = console.registry()
    loaded = Calibration.load(calibration, registry, accept)
    system = loaded.system
    commands = read_commands(registry, loaded, poses)
    _warn_of_missing(console, loaded, commands)
    channels, placed = loaded.predict(commands)
    plus_minus = None
    if not loaded.readable:
        channels = {}
        for arm, tools in zip(system.arms, placed, strict=True):
            turns = np.array([quaternion_of(tool[:3, :3]) for tool in tools]).reshape(-1, 4)
            channels |= {f"{arm}.tool_{axis}": tools[:, i, 3] for i, axis in enumerate("xyz")}
            channels |= {f"{arm}.tool_q{axis}": turns[:, i] for i, axis in enumerate("wxyz")}
    elif loaded.record.prediction is None:
        console.warn("the calibration keeps nothing about the errors of predictions: run it again to have them.")
    else:
        plus_minus = loaded.plus_minus(commands)
        if unknown := [name for name in channels if not np.isfinite(plus_minus.half_widths.get(name, np.nan)).any()]:
            console.warn(f"how far {', '.join(unknown)} may be off is not known: no residual determines it.")
    requested = requested_channels(system.arms, loaded.readable, measured=False)
    if not loaded.readable:
        requested = (*requested, *_tool_channels(tuple(system.arms)))
    shown = [channel for channel in requested if channel.channel in channels]
    extra, medians = _half_widths(plus_minus, shown) if plus_minus else ({}, {})
    extra |= _beyond(console, loaded, commands, plus_minus)
    write_csv(out, replace(commands, channels=channels, extra=extra), shown)
    _show(console, commands, out, plus_minus, medians)


def _show(
    console: Console,
    commands: Dataset,
    out: Path,
    plus_minus: PlusMinus | None,
    medians: Mapping[str, float],
) -> None:
    typical = {}  # medians over the poses
    if plus_minus is not None and plus_minus.radii:
        half = [plus_minus.half_widths[f"{name}.{axis}"] for name in plus_minus.radii for axis in "xyz"]
        typical["half_width_90_mm"] = float(np.median(np.concatenate(half))) * 1000
        typical["radius_95_mm"] = float(np.median(np.concatenate(list(plus_minus.radii.values())))) * 1000
    if plus_minus is not None and plus_minus.turns:
        turns = np.concatenate(list(plus_minus.turns.values()))
        typical["turn_90_deg"] = float(np.rad2deg(np.median(turns)))
    console.result(
        {
            "poses": len(commands),
            "set_aside": len(commands.set_aside),
            "out": str(out),
            **typical,
            "half_width_90": medians,
        }
    )
    console.out.print(f"{len(commands)} poses predicted: {out}")
    named = [f"{column} {half:.2g}" for column, half in medians.items()]
    text = ", ".join(named[:_MOST_NAMED]) + (f" and {len(named) - _MOST_NAMED} more" if named[_MOST_NAMED:] else "")
    if typical:  # of a position; else of every column
        text = (
            f"{readable(typical['half_width_90_mm'])} mm a coordinate (90 %), "
            f"{readable(typical['radius_95_mm'])} mm in all (95 %)"
        )
        text += f", {typical['turn_90_deg']:.2g} deg (90 %)" if "turn_90_deg" in typical else ""
    elif text:
        text += " (90 %)"
    if text:
        console.out.print(f"+- {text}, in the median pose", soft_wrap=not typical)


def _tool_channels(arms: Sequence[str]) -> Iterator[RequestedChannel]:
    for arm in arms:
        names = [(f"tool_{axis}", "length") for axis in "xyz"] + [(f"tool_q{axis}", DIMENSIONLESS) for axis in "wxyz"]
        for name, dimension in names:
            own = f"{arm}.{name}"
            yield RequestedChannel(own, (own, name) if len(arms) == 1 else (own,), dimension, required=False)


def read_commands(registry: PluginRegistry, loaded: Calibration, poses: Path) -> Dataset:
    """The commands. Measured columns, if there are any, are not read: every row gets its prediction."""
    arms = loaded.system.arms
    requested = requested_channels(arms, {}, measured=False)
    reader_class = registry.find("reader", "csv").load()
    kept = loaded.record.prediction
    named = kept.columns_in(poses, requested) if kept else {}
    reader = reader_class(reader_class.Settings(path=ConfigText(str(poses)), columns=named))
    return noticed(records_of(reader, ReadRequest(arms, {}, requested, layout_hint=_LAYOUT)))


def _warn_of_missing(console: Console, loaded: Calibration, commands: Dataset) -> None:
    """What the calibration knew and these poses do not say."""
    order = ("time", "sequence")
    missing = [name for name in loaded.record.environment_columns if not commands.has(name) and name not in order]
    declared = [(f"{arm.name}.{effect}", c.name) for arm in loaded.system.arms.values() for effect, c in arm.declared]
    for effect, name in declared:
        if name in missing:
            console.warn(f"the effect {effect} reads {name}, which these poses do not state: it takes its reference.")
    plain = [name for name in missing if name not in {column for _, column in declared}]
    if plain:
        console.warn(f"the calibration's records had {', '.join(plain)}; these poses take the configured values.")
    for text in commands.warnings:
        console.warn(text)
    kept = loaded.record.prediction
    if kept is not None and kept.drifts and any(map(commands.has, order)):
        text = "these poses are taken for another recording than the calibration's, of whose drift nothing is known."
        console.warn(text)


def _beyond(
    console: Console, loaded: Calibration, commands: Dataset, plus_minus: PlusMinus | None
) -> dict[str, tuple[str, ...]]:
    kept = loaded.record.prediction
    if kept is None or not kept.ranges:
        return {}
    unknown = plus_minus.unknown if plus_minus else None
    beyond, text = beyond_records(kept.ranges, commands, loaded.system.arms, unknown)
    if text:
        console.warn(text)
    return {"beyond_records": tuple("1" if own else "0" for own in beyond)}


def _half_widths(
    plus_minus: PlusMinus, shown: Sequence[RequestedChannel]
) -> tuple[dict[str, tuple[str, ...]], dict[str, float]]:
    """Columns of half widths of 90 % intervals and of 95 % radii in mm; and medians of the former over the poses."""
    columns, medians = {}, {}
    for channel, (column, unit) in column_names(shown).items():
        if channel in plus_minus.half_widths:
            widths = to_unit(plus_minus.half_widths[channel], unit)
            columns[f"plus_minus_{column}"] = short_texts(widths)
            if np.isfinite(widths).any():
                medians[column] = float(np.nanmedian(widths))
    for column, unit, own in (("radius95", "mm", plus_minus.radii), ("turn90", "deg", plus_minus.turns)):
        for name, values in own.items():
            columns[f"{'' if len(own) == 1 else f'{name}.'}{column}_{unit}"] = short_texts(to_unit(values, unit))
    return columns, medians
