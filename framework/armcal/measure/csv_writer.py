"""Writing a dataset as a CSV that reads back to the same SI values, and any rows as the text of one."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from armcal.base.dataset import Dataset
from armcal.base.units import DIMENSIONLESS, display_unit, to_unit, units_of
from armcal.errors import DataError, Location
from armcal.io.plain_files import write_over
from armcal.measure.reader import RequestedChannel

ID_COLUMN = "pose_id"
_CUSTOMARY: Mapping[str, str] = MappingProxyType({})


def write_csv(
    path: str | Path,
    dataset: Dataset,
    requested_channels: Sequence[RequestedChannel],
    units: Mapping[str, str] = _CUSTOMARY,
) -> None:
    """Write all records: ``pose_id``, the channels in the order of ``requested_channels``, then the extra columns.

    The file appears whole or not at all; one that is there already is replaced, but no link and no device. Numbers are
    written in full, so that reading them back gives the same SI values within one unit in the last place.

    Args:
        path: where to; its folder must exist.
        dataset: SI values; records set aside on reading are not in it and so are not written.
        requested_channels: what the columns of each channel may be called; the shortest name that only one has is used.
        units: of a column by its dimension; by default deg, mm, g, and otherwise the SI unit.

    Raises:
        DataError: a channel of the dataset is not in ``requested_channels``, or two columns would have one name.
        InputError: the file cannot be written.
        ValueError: a unit is not one of its dimension.
    """
    path = Path(path)
    columns = _columns(path, dataset, requested_channels, units)
    write_over({path: csv_text([columns, *zip(*columns.values(), strict=True)]).encode()})


def _columns(
    path: Path, dataset: Dataset, requested_channels: Sequence[RequestedChannel], units: Mapping[str, str]
) -> dict[str, Sequence[str]]:
    unknown = sorted(set(dataset.channels) - {w.channel for w in requested_channels})
    if unknown:
        raise DataError(
            f"no column is known for the channel {unknown[0]}.",
            where=Location(str(path)),
            hint="Name it among the wanted channels, or leave it out of the dataset.",
        )
    columns: dict[str, Sequence[str]] = {ID_COLUMN: dataset.ids}
    names = column_names([w for w in requested_channels if dataset.has(w.channel)], units)
    written: dict[str, Sequence[str]] = {}
    for channel, (column, unit) in names.items():
        values = to_unit(dataset.channels[channel], unit).tolist()
        written[column] = [_text(int(x) if unit == "1" and x.is_integer() else x) for x in values]
    for name, texts in [*written.items(), *dataset.extra.items()]:
        if name in columns:
            raise DataError(
                f"two columns would be called {name}.",
                where=Location(str(path), field=name),
                hint="Rename the extra column.",
            )
        columns[name] = texts
    return columns


def column_names(
    requested_channels: Sequence[RequestedChannel], units: Mapping[str, str] = _CUSTOMARY
) -> dict[str, tuple[str, str]]:
    """The column of each channel, with its unit as suffix, and the unit (``"1"``: none).

    Raises:
        ValueError: a unit is not one of its dimension.
    """
    taken = [name for w in requested_channels for name in set(w.columns)]
    columns = {}
    for w in requested_channels:
        own = [name for name in w.columns if taken.count(name) == 1] or [w.columns[0]]
        unit, name = "1", min(own, key=len)
        if w.dimension not in ("1", DIMENSIONLESS):
            unit = units.get(w.dimension) or display_unit(w.dimension).name
            known = [u.name for u in units_of(w.dimension)]
            if unit not in known:
                raise ValueError(f"{unit!r} is not a unit of {w.dimension}; expected one of {', '.join(known)}.")
        columns[w.channel] = (name if unit == "1" else f"{name}_{unit}", unit)
    return columns


def _text(number: float) -> str:
    return "" if math.isnan(number) else repr(number)


def csv_text(rows: Iterable[Iterable[object]], number: str = ".6f") -> str:
    """Rows as the text of a CSV file, floats in a format; one that is not finite is an empty cell."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for row in rows:
        cells = [(format(x, number) if math.isfinite(x) else "") if isinstance(x, float) else x for x in row]
        writer.writerow(cells)
    return text.getvalue()
