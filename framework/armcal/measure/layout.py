"""What the channels of a dataset are, and what they were called in its source."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from armcal.base.dataset import Dataset
from armcal.base.units import UNITS, to_unit
from armcal.errors import Location
from armcal.measure.reader import RequestedChannel

_APPROACH = ".approach."


@dataclass(frozen=True)
class Layout:
    """What the channels of a dataset are, and what they were called in its source.

    Attributes:
        units: channel to the unit that its column declares; absent or SI means SI.
        parts: channel to the measurements that need it; one that is absent belongs to the record as a whole.
    """

    joints: tuple[str, ...] = ()  # channels of commanded joint displacements, revolute (angle) and prismatic (length)
    revolute: tuple[str, ...] = ()  # those of ``joints`` that turn, but not on and on
    approach: tuple[str, ...] = ()  # channels of approach directions
    measured: tuple[str, ...] = ()  # channels of measured values, ``instance.name``
    columns: Mapping[str, str] = field(default_factory=dict)  # channel to its column in the source, for messages
    units: Mapping[str, str] = field(default_factory=dict)
    by_line: bool = False  # whether ``Dataset.rows`` are lines of a text file; otherwise they are row numbers
    deviations: tuple[str, ...] = ()  # channels of their standard deviations
    by_id: bool = False  # whether a record's id says where it stood, better than its row does
    parts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    of_points: frozenset[str] = frozenset()  # channels of points, of which a record may lack some but not all
    evidence: frozenset[str] = frozenset()  # channels that only the verdict reads, which a record may lack

    def column(self, channel: str) -> str:
        return self.columns.get(channel, channel)

    def place(self, dataset: Dataset, index: int) -> str:
        if self.by_id:
            return dataset.ids[index]
        return f"{'line' if self.by_line else 'row'} {dataset.row(index)}"

    def where(self, dataset: Dataset, index: int, channel: str | None = None) -> Location:
        column = self.column(channel) if channel else None
        if self.by_line:
            return Location(dataset.source or None, line=dataset.row(index), field=column)
        return dataset.where(index, column)

    def shown(self, channel: str, si_value: float) -> str:
        unit = self.units.get(channel, "1")
        value = to_unit(si_value, unit) if unit in UNITS else si_value
        return f"{value:.10g}" + ("" if unit == "1" else f" {unit}")


def layout_of(
    requested_channels: Sequence[RequestedChannel],
    dataset: Dataset,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    *,
    by_line: bool,
) -> Layout:
    """The layout of a dataset that was read for some wanted channels.

    A channel that has an approach (``arm.approach.q1``) is a joint (``arm.q1``); any other channel that belongs
    to an instance is measured; one that belongs to none (``payload``) describes the surroundings.
    """
    approach = [w.channel for w in requested_channels if _APPROACH in w.channel]
    moved = {joint.channel for joints in joints_by_arm(requested_channels).values() for joint in joints}
    joints = [w for w in requested_channels if w.channel in moved and dataset.has(w.channel)]
    deviations = [w.channel for w in requested_channels if w.is_deviation]
    measured = [
        w.channel for w in requested_channels if "." in w.channel and w.channel not in {*moved, *approach, *deviations}
    ]
    return Layout(
        joints=tuple(w.channel for w in joints),
        revolute=tuple(w.channel for w in joints if w.dimension == "angle" and not w.is_endless),
        approach=tuple(name for name in approach if dataset.has(name)),
        measured=tuple(name for name in measured if dataset.has(name)),
        columns=columns,
        units=units,
        by_line=by_line,
        deviations=tuple(name for name in deviations if dataset.has(name)),
        parts={w.channel: w.parts for w in requested_channels if w.parts and dataset.has(w.channel)},
        of_points=frozenset(w.channel for w in requested_channels if w.is_of_point and dataset.has(w.channel)),
        evidence=frozenset(w.channel for w in requested_channels if w.is_evidence),
    )


def joints_by_arm(requested_channels: Sequence[RequestedChannel]) -> dict[str, list[RequestedChannel]]:
    """The channels of each arm's joints: those that have an approach."""
    moved = {w.channel.replace(_APPROACH, ".", 1) for w in requested_channels if _APPROACH in w.channel}
    arms: dict[str, list[RequestedChannel]] = {}
    for w in requested_channels:
        if w.channel in moved:
            arms.setdefault(w.channel.rpartition(".")[0], []).append(w)
    return arms


def set_aside(dataset: Dataset, layout: Layout, faulty: Mapping[int, str], why: str, mend: str) -> Dataset:
    """The dataset without some records (index to reason), and with a warning that says so."""
    if not faulty:
        return dataset
    first = layout.place(dataset, min(faulty))
    count = f"{len(faulty)} of {len(dataset)} records {'was' if len(faulty) == 1 else 'were'} set aside"
    return warned(dataset.without(faulty), f"{count} because {why} (the first: {first}). {mend}")


def warned(dataset: Dataset, text: str) -> Dataset:
    place = f"{dataset.source}: " if dataset.source else ""
    return replace(dataset, warnings=(*dataset.warnings, place + text))
