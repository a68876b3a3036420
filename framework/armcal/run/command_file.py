"""Commands as a CSV: what to command, where that leads, and what a controller of the nominal arm must be told."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armcal.arm.loading import LOAD_CHANNELS
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.pose_settings import quaternion_of
from armcal.base.units import UNITS
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import Targets
from armcal.calibration.tool_expression import APPROACH
from armcal.measure.csv_writer import write_csv
from armcal.measure.reader import RequestedChannel, requested_channels
from armcal.run.compensate import Assessed, commanded

_ENGLISH = {False: "no", True: "yes"}


def write_commands(
    path: Path, compensator: Compensator, targets: Targets, given: Dataset, assessed: Assessed, angle_unit: str
) -> None:
    """Write commands beside the targets' own ids; angles in ``deg`` or ``rad``.

    Raises:
        DataError: the file cannot be written.
    """
    arm, name = compensator.expression.arm, compensator.expression.name
    told = commanded(compensator, targets, assessed.commands)
    said = {f"{name}.{joint}" for joint in compensator.joints} | _worth_saying(told, given)
    channels = {channel: values for channel, values in told.channels.items() if channel in said}
    wanted = requested_channels({name: arm}, {}, measured=False)
    extra = dict(_extra(compensator, assessed))
    # A target file may be a pose file: its commands, in whatever unit, give way to those that were found.
    own = {f"{joint}_{unit}" for joint in compensator.joints for unit in UNITS}
    kept = {column: texts for column, texts in given.extra.items() if column not in extra and column not in own}
    dataset = replace(given, channels=channels, extra={**extra, **kept})
    write_csv(path, dataset, _shown(wanted, channels), {"angle": angle_unit})


def _shown(wanted: Sequence[RequestedChannel], channels: dict[str, Array]) -> list[RequestedChannel]:
    return [channel for channel in wanted if channel.channel in channels]


def _worth_saying(dataset: Dataset, given: Dataset) -> set[str]:
    """Loads and surroundings that the targets told, and approaches that are known."""
    loads = {channel for channel in dataset.channels if channel in LOAD_CHANNELS and given.has(channel)}
    others = {c for c in dataset.channels if APPROACH in c and dataset.channels[c].any()}
    return loads | others | {c for c in dataset.channels if "." not in c and c not in LOAD_CHANNELS}


def _extra(compensator: Compensator, assessed: Assessed) -> Iterator[tuple[str, tuple[str, ...]]]:
    commands = assessed.commands
    if commands.counts is not None:
        for i, joint in enumerate(compensator.joints):
            if joint in compensator.expression.servos:
                tick = compensator.expression.servos[joint][1].tick
                yield f"{joint}_counts", tuple(str(count) for count in commands.counts[:, i])
                yield f"{joint}_pulse_us", _texts(1e6 * tick * commands.counts[:, i])
    yield "reached", tuple(_ENGLISH[bool(had)] for had in commands.found)
    yield from _pose("tool", assessed.tools)
    yield "error_mm", _texts(1000 * commands.distances)
    yield "error_deg", _texts(np.asarray(np.degrees(commands.turns)))
    if assessed.radii is not None:
        yield "radius95_mm", _texts(1000 * assessed.radii)
    yield "nominal_error_mm", _texts(1000 * assessed.nominal_distances)
    if commands.moves is not None:
        kinds = [compensator.expression.arm.commanded[joint] for joint in compensator.joints]
        for kind, unit, scale in (("angle", "deg", 180 / np.pi), ("length", "mm", 1000.0)):
            own = [i for i, text in enumerate(kinds) if text == kind]
            if own:
                yield f"longest_move_{unit}", _texts(scale * np.abs(commands.moves[:, own]).max(axis=1))
    yield "bound_mm", _texts(1000 * commands.bounds)
    yield "reason", commands.reasons
    yield from _pose("tell_nominal", assessed.nominal_T_tool)


def _pose(name: str, poses: Array) -> Iterator[tuple[str, tuple[str, ...]]]:
    for i, axis in enumerate("xyz"):
        yield f"{name}_{axis}_mm", tuple(repr(float(x)) for x in 1000 * poses[:, i, 3])
    turns = np.array([quaternion_of(pose[:3, :3]) for pose in poses]).reshape(-1, 4)
    for i, axis in enumerate("wxyz"):
        yield f"{name}_q{axis}", tuple(repr(float(x)) for x in turns[:, i])


def _texts(values: NDArray[Any]) -> tuple[str, ...]:
    """Short numbers; empty where there is none."""
    return tuple(f"{value:.6g}" if np.isfinite(value) else "" for value in values.tolist())
