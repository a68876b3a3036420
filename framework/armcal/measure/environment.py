"""What a user is told of records: vectors without a part, misspelt names, jumps in time, commands beyond limits."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from armcal.arm.assembly import Arm, shown_joint
from armcal.arm.joints import Limits
from armcal.arm.servo import SteppedEffect
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.units import display_unit, split_suffix, to_unit
from armcal.errors import DataError, Location
from armcal.measure.reader import ENVIRONMENT, RequestedChannel

JUMP_RATIO = 50.0
SHORTEST_JUMP_S = 600.0


def require_conditions(dataset: Dataset, requested_channels: Sequence[RequestedChannel]) -> None:
    """Refuse records without a column that an effect reads, whatever reader they come from.

    Raises:
        DataError: with effect, column and source.
    """
    for channel in requested_channels:
        if channel.effects and channel.required and not dataset.has(channel.channel):
            raise DataError(
                f"found no {channel.what}.",
                where=dataset.where(field=channel.channel),
                hint="Use a source that records it, or remove the effect.",
            )


def noticed(dataset: Dataset) -> Dataset:
    """The dataset, with a warning for each unused column that looks like a misspelt one, and for a jump in time.

    Raises:
        DataError: a vector has some of its components only; the missing ones are not guessed.
    """
    for vector in ("gravity", "force", "torque", "payload"):
        parts = [f"{vector}_{axis}" for axis in "xyz"]
        missing = [name for name in parts if not dataset.has(name)]
        if 0 < len(missing) < 3:
            raise DataError(
                f"{vector} has no {', '.join(missing)}.",
                where=Location(dataset.source),
                hint="Give all three components, 0 where there is none.",
            )
    known, texts = [name for name, _ in ENVIRONMENT], []
    for column in dataset.extra:
        split = split_suffix(column)
        near = difflib.get_close_matches(split[0], known, n=1, cutoff=0.8) if split else []
        if near:
            texts.append(f"the column {column} is kept but not used: was {near[0]} meant?")
    if dataset.has("time") and len(dataset) > 2:
        # Pauses so long that arm or tracker may have been touched, or a clock set.
        steps = np.diff(dataset.column("time"))
        limit = max(JUMP_RATIO * float(np.median(steps)), SHORTEST_JUMP_S)
        texts += [
            f"{steps[i]:.0f} s pass between the records {dataset.ids[i]} and {dataset.ids[i + 1]}: if anything was "
            "moved there, calibrate the parts on their own."
            for i in np.flatnonzero(steps > limit)[:5]
        ]
    return replace(dataset, warnings=(*dataset.warnings, *texts))


TOLERANCE = {"angle": 1e-3, "length": 1e-4}
"""How far beyond a limit (rad, m) a command may be: limits are often rounded."""


def own_limits(arm: Arm, parameters: Parameters) -> dict[str, Limits]:
    """The limits of the model, by joint, of its commands (rad or m): zeros that effects state are taken off."""
    zeros = dict.fromkeys(arm.joint_names, 0.0)
    for name, effect in arm.effects.items():
        for parameter, number in effect.zeros().items():
            zeros[arm.joint_names[number - 1]] += parameters[f"{arm.name}.{name}.{parameter}"].nominal[0]
    known = {joint.name: joint.limits for joint in arm.nominal_chain.joints if joint.limits is not None}
    return {joint: (low - zeros[joint], high - zeros[joint]) for joint, (low, high) in known.items()}


def warn_beyond_limits(dataset: Dataset, arms: Mapping[str, Arm], parameters: Parameters) -> Dataset:
    """The dataset, with warnings of all joints that were commanded beyond their limits, or their pulse tables."""
    of_limits, of_tables = list[str](), list[str]()
    for name, arm in arms.items():
        if not len(dataset) or not all(map(dataset.has, arm.command_channels)):
            continue
        commands = arm.joint_commands([dataset.column(channel) for channel in arm.command_channels])
        joints = dict(zip(arm.joint_names, zip(arm.joint_dimensions, commands, strict=True), strict=True))
        for joint, ends in own_limits(arm, parameters).items():
            shown, (dimension, angles) = shown_joint(f"{name}.{joint}", arms), joints[joint]
            of_limits += _beyond(f"{shown} is beyond its limits", angles, ends, TOLERANCE[dimension], dimension)
        stepped = [effect.servos() for effect in arm.effects.values() if isinstance(effect, SteppedEffect)]
        for index, (table, clock) in (servo for servos in stepped for servo in servos.items()):
            shown, ends = shown_joint(f"{name}.{arm.joint_names[index]}", arms), (table.angles[0], table.angles[-1])
            half = clock.tick / table.least_slope / 2  # a board rounds to whole counts
            of_tables += _beyond(f"{shown} is beyond its pulse table", commands[index], ends, half, "angle")
    texts = [f"{'; '.join(of_limits)}: check the joints' order, signs and units."] if of_limits else []
    if of_tables:
        texts.append(
            f"{'; '.join(of_tables)}: pulses there are guessed along a straight line. Check the zero of the servo file "
            "(libraries that count from 0 to 180 deg have the middle at 90), or measure the table that far."
        )
    return replace(dataset, warnings=(*dataset.warnings, *texts))


def _beyond(what: str, values: Array, ends: Limits, tolerance: float, dimension: str) -> list[str]:
    """A sentence of values (rad or m) beyond ends by more than a tolerance; none where none are."""
    over = np.maximum(ends[0] - values, values - ends[1])  # below zero inside
    over = np.nan_to_num(over, nan=-np.inf, neginf=-np.inf)
    if not (count := int(np.sum(over > tolerance))):
        return []
    worst = to_unit(float(values[int(np.argmax(over))]), display_unit(dimension).name)
    spread = span_text((float(np.nanmin(values)), float(np.nanmax(values))), dimension)
    return [f"{what} {span_text(ends, dimension)} in {count} of {len(values)} records, at worst {worst:.4g} ({spread})"]


def span_text(ends: Limits, dimension: str) -> str:
    """Two ends (rad or m) as people read them: ``-100 to 100 deg``."""
    unit = display_unit(dimension).name
    return " to ".join(f"{to_unit(end, unit):.4g}" for end in ends) + f" {unit}"
