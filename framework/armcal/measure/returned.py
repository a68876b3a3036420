"""What the methods of readers and measurements return, checked where it is used."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from armcal.base.dataset import Dataset, SetAside
from armcal.base.se3 import Expression, column
from armcal.base.units import DIMENSIONS, ERROR_UNITS
from armcal.errors import ProblemError
from armcal.measure.checks import check_records
from armcal.measure.layout import layout_of
from armcal.measure.measurement import Channel, Measurement, noise_channels, residual_dimensions
from armcal.measure.reader import Reader, ReadRequest
from armcal.plugin_faults import refuse


def records_of(reader: Reader, request: ReadRequest) -> Dataset:
    """The records of a reader, checked whether or not it checked them; all that ask one for records ask here.

    Raises:
        DataError: the source is refused.
        PluginError: it returned no dataset, or one without a required channel, or parts of it are of other types.
    """
    dataset = reader.read(request)
    if fault := _dataset_fault(dataset):
        refuse(reader.read, *fault)
    for requested in request.channels:
        if requested.required and not requested.effects and not dataset.has(requested.channel):
            given = f"no channel {requested.channel!r} among {', '.join(dataset.channels) or 'none'}"
            refuse(reader.read, given, "every channel of the request that is required")
    layout = layout_of(request.channels, dataset, {}, {}, by_line=False)
    return check_records(dataset, replace(layout, units=dict.fromkeys(layout.revolute, "deg")))


def _dataset_fault(dataset: Any) -> tuple[Any, str] | None:
    """What is wrong with the parts of a dataset, and what was expected; None if nothing is."""
    if not isinstance(dataset, Dataset):
        return dataset, "a Dataset"
    if not _is_texts(dataset.ids):
        return f"the ids {dataset.ids!r:.60}", "a tuple of texts, one a record"
    count = len(dataset)
    if not isinstance(dataset.channels, Mapping) or not all(isinstance(name, str) for name in dataset.channels):
        return f"the channels {dataset.channels!r:.60}", "a mapping of names to numpy arrays"
    for name, values in dataset.channels.items():
        if np.shape(values) != (count,) or getattr(values, "dtype", None) != np.float64:
            given = f"the channel {name!r} as {type(values).__name__} of the shape {np.shape(values)}"
            return given, f"a numpy array of {count} numbers (float64), one a record"
    rows = dataset.rows
    if not isinstance(rows, tuple) or len(rows) not in (0, count) or not all(isinstance(row, int) for row in rows):
        return f"the rows {rows!r:.60}", f"a tuple of {count} ints, or an empty one"
    for part, columns in (("extra", dataset.extra), ("files", dataset.files)):
        whole = isinstance(columns, Mapping) and all(_is_texts(own) and len(own) == count for own in columns.values())
        if not whole:
            return f"{part} as {columns!r:.60}", f"a mapping of names to tuples of {count} texts"
    if not (isinstance(dataset.source, str) and isinstance(dataset.sha256, str)):
        return f"the source {dataset.source!r:.60} and sha256 {dataset.sha256!r:.60}", "texts"
    left = dataset.set_aside
    if not (_is_texts(dataset.warnings) and isinstance(left, tuple) and all(isinstance(own, SetAside) for own in left)):
        given = f"the warnings {dataset.warnings!r:.60} and set_aside {left!r:.60}"
        return given, "a tuple of texts and one of SetAside"
    return None


def _is_texts(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(text, str) for text in value)


def check_channels(measurement: Measurement) -> None:
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
