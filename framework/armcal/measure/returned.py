"""What the methods of readers and measurements return, checked where it is used."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.se3 import Expression, column
from armcal.base.units import DIMENSIONS, ERROR_UNITS
from armcal.errors import ProblemError
from armcal.measure.measurement import Channel, Measurement, noise_channels, residual_dimensions
from armcal.measure.reader import Reader, ReadRequest
from armcal.plugin_faults import refuse


def records_of(reader: Reader, request: ReadRequest) -> Dataset:
    """The records of a reader.

    Raises:
        DataError: the source is refused.
        PluginError: it returned no dataset, or a channel is no array of a number each record.
    """
    dataset = reader.read(request)
    if not isinstance(dataset, Dataset):
        refuse(reader.read, dataset, "a Dataset")
    for name, values in dataset.channels.items():
        if np.shape(values) != (len(dataset),) or getattr(values, "dtype", None) != np.float64:
            given = f"the channel {name!r} as {type(values).__name__} of the shape {np.shape(values)}"
            refuse(reader.read, given, f"a numpy array of {len(dataset)} numbers (float64), one a record")
    return dataset


def check_channels(measurement: Measurement) -> None:
    """Refuse channels that are none (PluginError)."""
    channels = measurement.channels()
    if not isinstance(channels, Sequence):
        refuse(measurement.channels, channels, "a sequence of Channel(name, dimension)")
    for channel in channels:
        if not isinstance(channel, Channel) or channel.dimension not in DIMENSIONS:
            refuse(measurement.channels, repr(channel), f"Channel(name, dimension), of {', '.join(DIMENSIONS)}")


def checked_outputs(measurement: Measurement, outputs: Any) -> dict[str, Expression]:
    """The outputs of a measurement, each an expression (1 x 1), by local names of its channels.

    Raises:
        PluginError: they are none.
    """
    channels = [channel.name for channel in measurement.channels()]
    if not isinstance(outputs, Mapping) or not set(outputs) <= set(channels):
        given = f"the channels {', '.join(outputs)}" if isinstance(outputs, Mapping) else outputs
        refuse(measurement.outputs, given, f"the expression of each channel by name: {', '.join(channels)}")
    return {name: column(measurement.outputs, own, 1, f"one number as {name!r}") for name, own in outputs.items()}


def checked_residual(name: str, measurement: Measurement, residual: Expression) -> Expression:
    """The residual of a measurement whose noise, dimensions and noise columns are those of its entries.

    Raises:
        PluginError: the residual is no column, or noise is none.
        ProblemError: with what differs.
    """
    residual, noise = column(measurement.residual, residual, None, "a column of m or rad"), measurement.noise()
    if not isinstance(noise, Sequence) or not all(isinstance(sd, float | int) and 0 < sd < math.inf for sd in noise):
        refuse(measurement.noise, f"{noise}", "a sequence of standard deviations above zero, one a residual entry")
    rows, dimensions, own = residual.numel(), residual_dimensions(measurement), noise_channels(measurement)
    counts = {"noise": len(noise), "dimensions": len(dimensions), "noise columns": len(own) or rows}
    odd = [f"{kind} of {count} entries" for kind, count in counts.items() if count != rows]
    odd += [f"dimension {kind!r}" for kind in dimensions if kind not in ERROR_UNITS]
    odd += [
        f"noise column {channel.name} of dimension {channel.dimension}"
        for channels, kind in zip(own, dimensions, strict=False)
        for channel in channels
        if channel.dimension != kind
    ]
    if odd:
        raise ProblemError(
            f"the measurement {name} has a residual of {rows} entries ({', '.join(dimensions)}), and {', '.join(odd)}.",
            hint="Correct noise(), dimensions() or noise_channels() in its plugin.",
        )
    return residual
