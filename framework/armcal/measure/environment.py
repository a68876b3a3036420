"""What a user is told of records: vectors without a part, misspelt names, jumps in time, commands beyond limits."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from armcal.arm.assembly import Arm, shown_joint
from armcal.base.dataset import Dataset
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


def warn_beyond_limits(dataset: Dataset, arms: Mapping[str, Arm]) -> Dataset:
    """The dataset, with a warning for all joints that were commanded beyond their limits."""
    texts = []
    for name, arm in arms.items():
        if not len(dataset) or not all(map(dataset.has, arm.command_channels)):
            continue
        commands = arm.joint_commands([dataset.column(channel) for channel in arm.command_channels])
        for joint, dimension, angles in zip(arm.nominal_chain.joints, arm.joint_dimensions, commands, strict=True):
            if joint.limits is None:
                continue
            over = np.maximum(joint.limits[0] - angles, angles - joint.limits[1])  # below zero inside
            over = np.nan_to_num(over, nan=-np.inf, neginf=-np.inf)
            count, unit = int(np.sum(over > TOLERANCE[dimension])), display_unit(dimension).name
            if count:
                low, high, worst = (to_unit(x, unit) for x in (*joint.limits, float(angles[int(np.argmax(over))])))
                shown = shown_joint(f"{name}.{joint.name}", arms)
                beyond = f"{shown} is beyond its limits {low:.4g} to {high:.4g} {unit}"
                texts.append(f"{beyond} in {count} of {len(dataset)} records, at worst {worst:.4g}")
    if not texts:
        return dataset
    text = f"{'; '.join(texts)}: check the joints' order, signs and units."
    return replace(dataset, warnings=(*dataset.warnings, text))
