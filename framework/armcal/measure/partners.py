"""Measurements between two records: each record that names another one carries the other's joints as well."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.errors import DataError
from armcal.measure.measurement import Measurement

OTHER = "@other"
"""What follows an arm's or a channel's name where the other record is meant (``arm@other``, ``arm.q1@other``)."""


@runtime_checkable
class PairedMeasurement(Protocol):
    """What a measurement provides beside the rest if it lies between two records.

    It names its arm twice, ``arm`` and ``arm@other``, and is given both states.
    """

    @property
    def partner_label(self) -> str:
        """The text column with the id of the other record; empty where a record has none."""


def with_partners(dataset: Dataset, measurements: Mapping[str, Measurement]) -> Dataset:
    """The dataset with the joints of other records beside those of the records that name them; else not a number.

    Raises:
        DataError: a record names one that is not there, or itself.
    """
    channels: dict[str, Array] = {}
    for measurement in measurements.values():
        if isinstance(measurement, PairedMeasurement):
            partners = _partners(dataset, measurement.partner_label)
            arms = [name.removesuffix(OTHER) for name in measurement.arms if name.endswith(OTHER)]
            for channel, values in dataset.channels.items():
                if channel.partition(".")[0] in arms and not channel.endswith(OTHER):
                    channels[channel + OTHER] = np.where(partners >= 0, values[np.maximum(partners, 0)], np.nan)
    return replace(dataset, channels={**dataset.channels, **channels}) if channels else dataset


def _partners(dataset: Dataset, label: str) -> Array:
    """Of each record the place of the one it names (N); -1 where it names none."""
    named = dataset.extra.get(label, ("",) * len(dataset))
    place = {name: i for i, name in enumerate(dataset.ids)}
    partners = np.full(len(dataset), -1)
    for i, name in enumerate(cell.strip() for cell in named):
        if not name:
            continue
        if place.get(name, i) == i:
            raise DataError(
                f"found {name[:40]!r}, expected the id of another record.",
                where=dataset.where(i, field=label),
                hint="Correct it, or leave it empty; the other record may have been set aside.",
            )
        partners[i] = place[name]
    return partners
